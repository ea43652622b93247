"""System data of a Zemax file: units, wavelengths, fields, aperture; and the paraxial pupils.

Like Zemax, the paraxial trace follows the surfaces along their thicknesses and ignores coordinate breaks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ...paraxial import ParaxialSurfaces, StopImage, reference_radius
from .design import Fields
from .file import Block, Findings, ZemaxFile
from .text import scaled

UNITS = {"MM": 1e-3, "CM": 1e-2, "IN": 0.0254, "INCH": 0.0254, "METER": 1.0, "METERS": 1.0, "M": 1.0}
#: Field radius [rad] of a file with the axis alone.
LEAST_FIELD = math.radians(0.1)
#: Aperture lines of a header, the first of which counts.
APERTURES = ("ENPD", "FNUM", "OBNA", "OBSN", "FLOA")


@dataclass(frozen=True)
class Wavelengths:
    """Wavelengths of a file [m], their weights and the primary one."""

    values: tuple[float, ...]
    weights: tuple[float, ...]
    primary: float

    def band(self, low: float, high: float) -> tuple[float, float]:
        """Return the span of the wavelengths, at least 2 % wide, within the limits."""
        return max(min(self.values) * 0.99, low), min(max(self.values) * 1.01, high)


def read_wavelengths(header: Block) -> Wavelengths:
    """Return the wavelengths: lines WAVM, as many as FTYP counts, or the older WAVL; PrescriptionError if none."""
    lines = header.all("WAVM")
    listed = header.last("WAVL")
    count = header.number("FTYP", 0.0, 3) if (kind := header.last("FTYP")) and len(kind.words) > 3 else 0.0
    if lines:
        table = {line.integer(0): line.number(1) for line in lines}
        # Files list 24 wavelengths; those beyond the count are fillers.
        numbers = range(1, int(count) + 1) if 1 <= count <= 24 else sorted(table)
        for number in numbers:
            if number not in table:
                raise header.problem(f"WAVM {number} is missing")
        values = [table[number] for number in numbers]
        amounts = {line.integer(0): line.number(2, 1.0) for line in lines}
        weights = [amounts[number] for number in numbers]
    elif listed is not None:
        values = [listed.number(i) for i in range(len(listed.words))]
        stated = header.last("WWGT")
        weights = [1.0 if stated is None else stated.number(i, 1.0) for i in range(len(values))]
    else:
        values, weights = [], []
    if not values or not all(0 < v < 1e4 for v in values):
        raise header.problem(f"WAVM {values}: expected at least one positive wavelength in um")
    primary = header.number("PWAV", 1.0)
    if not 1 <= primary <= len(values) or primary != int(primary):
        raise header.problem(f"PWAV {primary:g}: expected 1 to {len(values)}")
    metres = tuple(scaled(v, -6) for v in values)
    return Wavelengths(metres, tuple(weights), metres[int(primary) - 1])


@dataclass(frozen=True)
class Pupil:
    """Entrance pupil of a file: the image of its stop, its diameter [m], and what follows from them.

    `aperture` is the size of the beam as the file states it, in the terms of :class:`DesignData`, `reference_radius`
    the radius of the reference sphere [m].
    """

    image: StopImage
    diameter: float
    aperture: tuple[str, float]
    field_radius: float
    reference_radius: float


def read_pupil(
    file: ZemaxFile, surfaces: ParaxialSurfaces, unit: float, wavelength: float, fields: Fields, findings: Findings
) -> Pupil:
    """Return the paraxial entrance pupil and the field of a file at its primary `wavelength` [m].

    `unit` is the lens unit [m]. PrescriptionError if pupil and object are at infinity, or the pupil has no size or,
    unless lenient, the aperture is given twice.
    """
    header = file.header
    distance = file.surfaces[0].number("DISZ", math.inf, infinite=True) * unit
    # Lens files write "at infinity" as a distance of 1e10 units too.
    distance = math.inf if distance >= 1e9 * unit else distance
    telecentric = fields.telecentric and math.isfinite(distance)
    # The trace starts at the first surface; a distance to a break in front of it does not count.
    image = StopImage.of(surfaces, wavelength, distance, telecentric=telecentric)
    if image is None:
        raise header.problem("the stop makes an entrance pupil at infinity (telecentric): not supported")
    found = {keyword: aperture for keyword in APERTURES if (aperture := _aperture(header, keyword, surfaces, unit))}
    if not found:
        raise header.problem("expected the aperture: a line ENPD, FNUM or FLOA")
    keyword, aperture = next(iter(found.items()))
    diameter = image.diameter(*aperture)
    if not 0 < diameter < math.inf:
        raise header.problem(f"{keyword}: expected an entrance pupil of finite size, not {diameter:g} m")
    if len(found) > 1:
        findings.report(header.problem(f"{' and '.join(found)}: two apertures"), f"{keyword} is taken")
    to_pupil = image.image_scale / image.image_slope if image.image_slope else math.inf
    radius = reference_radius(to_pupil, image.focal_length, diameter)
    return Pupil(image, diameter, aperture, _field_radius(header, fields, unit, image), radius)


def _aperture(header: Block, keyword: str, surfaces: ParaxialSurfaces, unit: float) -> tuple[str, float] | None:
    """Return an aperture line of the header in the terms of :class:`DesignData`."""
    line = header.last(keyword)
    if line is None:
        return None
    if keyword == "FLOA":
        return "stop", surfaces.stop_radius
    value = line.number(0, 0.0)
    if keyword == "ENPD":
        return "entrance_pupil", value * unit
    if keyword == "FNUM":
        return "working_f_number" if line.number(1, 0.0) == 1 else "f_number", value
    return "object_na", value


def _field_radius(header: Block, fields: Fields, unit: float, image: StopImage) -> float:
    """Return the largest field angle [rad]; heights become angles by their paraxial scales."""
    if fields.kind == 0:
        # As the two angles are given: the square root of the sum of their squares.
        radius = math.radians(fields.largest)
    else:
        reach = abs(image.object_distance + image.z if fields.kind == 1 else image.image_scale)
        radius = math.atan(fields.largest * unit / reach) if 0 < reach < math.inf else 0.0
    if not radius < math.radians(89.0):
        raise header.problem("XFLN, YFLN: expected fields within 89 degrees of the axis")
    return max(radius, LEAST_FIELD)
