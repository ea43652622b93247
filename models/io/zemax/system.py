"""System data of a Zemax file: units, wavelengths, fields, aperture; and the paraxial pupils.

Like Zemax, the paraxial trace follows the surfaces along their thicknesses and ignores coordinate breaks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ...media.medium import Medium
from .file import Block, Findings, ZemaxFile

UNITS = {"MM": 1e-3, "CM": 1e-2, "IN": 0.0254, "INCH": 0.0254, "METER": 1.0, "METERS": 1.0, "M": 1.0}
#: Field radius [rad] of a file with the axis alone.
LEAST_FIELD = math.radians(0.1)
FIELD_TYPES = ("angle", "object height", "paraxial image height", "real image height")


@dataclass(frozen=True)
class Wavelengths:
    """Wavelengths of a file [m] and the primary one."""

    values: tuple[float, ...]
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
    elif listed is not None:
        values = [listed.number(i) for i in range(len(listed.words))]
    else:
        values = []
    if not values or not all(0 < v < 1e4 for v in values):
        raise header.problem(f"WAVM {values}: expected at least one positive wavelength in um")
    primary = header.number("PWAV", 1.0)
    if not 1 <= primary <= len(values) or primary != int(primary):
        raise header.problem(f"PWAV {primary:g}: expected 1 to {len(values)}")
    metres = tuple(v / 1e6 for v in values)
    return Wavelengths(metres, metres[int(primary) - 1])


@dataclass
class ParaxialSurfaces:
    """Surfaces of the paraxial trace: curvatures [1/m], media, mirrors and the distance to the next [m].

    Like Zemax it traces in the plane x = 0; where no surface is curved there, in the plane y = 0.
    """

    rows: list[tuple[tuple[float, float], Medium, Medium, bool]] = field(default_factory=list)
    distances: list[float] = field(default_factory=list)
    stop: int = 0
    stop_radius: float = 0.0
    _ahead: float = 0.0

    def add(self, curvatures: tuple[float, float], before: Medium, after: Medium, *, mirror: bool) -> None:
        """Add a surface of given curvatures along x and y."""
        self.rows.append((curvatures, before, after, mirror))
        self.distances.append(self._ahead)
        self._ahead = 0.0

    def advance(self, thickness: float) -> None:
        """Go on along the axis [m]; coordinate breaks do it too."""
        self._ahead += thickness

    def mark_stop(self, radius: float, *, first: bool = False) -> None:
        """Take the next surface (or the first) for the stop, with its semi-diameter [m]."""
        self.stop, self.stop_radius = (0 if first else len(self.rows)), radius

    def trace(self, height: float, slope: float, wavelength: float) -> tuple[np.ndarray, float]:
        """Return the heights [m] at the surfaces, and the last slope, of a ray by its first height [m] and slope."""
        heights = []
        n = float(self.rows[0][1].index(wavelength))
        axis = 1 if any(curvatures[1] for curvatures, *_ in self.rows) else 0
        for (curvatures, _, after, mirror), distance in zip(self.rows, self.distances, strict=True):
            height += slope * distance
            heights.append(height)
            glass = float(after.index(wavelength))
            n_after = -n if mirror else math.copysign(glass, n)
            slope = (n * slope - height * curvatures[axis] * (n_after - n)) / n_after
            n = n_after
        return np.array(heights), slope


@dataclass(frozen=True)
class Pupil:
    """Height and diameter of the entrance pupil [m], field, and radius of the reference sphere [m].

    `z` and `object_z`, the plane of the object, count along the light from the first surface.
    """

    z: float
    diameter: float
    field_radius: float
    reference_radius: float
    object_z: float


def read_pupil(
    file: ZemaxFile, surfaces: ParaxialSurfaces, unit: float, wavelength: float, before: Medium, findings: Findings
) -> Pupil:
    """Return the paraxial entrance pupil and the field of a file at its primary `wavelength` [m].

    `unit` is the lens unit [m], `before` the medium of the object space. PrescriptionError if the pupil is at infinity
    or has no size or, unless lenient, the aperture is given twice.
    """
    header = file.header
    # The trace starts at the first surface; a distance to a break in front of it does not count.
    heights, end_slope = surfaces.trace(1.0, 0.0, wavelength)
    across, _ = surfaces.trace(0.0, 1.0, wavelength)
    scale, offset = float(heights[surfaces.stop]), float(across[surfaces.stop])
    # The entrance pupil is the image of the stop by what lies in front of it; 1e-9 of its own size is no image at all.
    if abs(scale) < 1e-9 * max(1.0, abs(offset)):
        raise header.problem("the stop makes an entrance pupil at infinity (telecentric): not supported")
    pupil_z = offset / scale
    focal_length = -1.0 / end_slope if end_slope else math.inf
    distance = file.surfaces[0].number("DISZ", math.inf, infinite=True) * unit
    # Lens files write "at infinity" as a distance of 1e10 units too.
    distance = math.inf if distance >= 1e9 * unit else distance
    line = header.last("FTYP")
    if line is not None and line.number(1, 0.0) == 1 and math.isfinite(distance):
        findings.note(line.problem(f"{line.shown}: a telecentric object space is not read"), "the stop limits the rays")
    diameter = _pupil_diameter(
        header, surfaces, unit, scale, focal_length, wavelength, distance, distance + pupil_z, findings
    )
    chief, chief_slope = surfaces.trace(-pupil_z, 1.0, wavelength)
    # From the exit pupil to the image; where that is infinite or nothing, the focal length.
    candidates = (float(chief[-1]) / chief_slope if chief_slope else math.inf, focal_length, 1.0)
    least, largest = 1e-2 * diameter, 1e4
    reference = next(abs(v) for v in candidates if least < abs(v) < largest or v == 1.0)
    field_radius = _field_radius(header, unit, float(chief[-1]), distance + pupil_z)
    return Pupil(pupil_z, diameter, field_radius, reference, -distance)


def _pupil_diameter(
    header: Block,
    surfaces: ParaxialSurfaces,
    unit: float,
    scale: float,
    focal_length: float,
    wavelength: float,
    object_distance: float,
    distance: float,
    findings: Findings,
) -> float:
    """Return the diameter of the entrance pupil [m] from the one aperture line of the header."""
    found: dict[str, float] = {}
    for keyword in ("ENPD", "FNUM", "OBNA", "OBSN", "FLOA"):
        line = header.last(keyword)
        if line is None:
            continue
        value = line.number(0, 0.0)
        if keyword == "ENPD":
            found[keyword] = value * unit
        elif keyword == "FNUM":
            if line.number(1, 0.0) == 1 and math.isfinite(object_distance):
                # The paraxial working f-number, 1 / (2 n u): of the cone of light from the object to the image.
                _, slope = surfaces.trace(object_distance, 1.0, wavelength)
                cone = abs(slope * float(surfaces.rows[-1][2].index(wavelength)))
                found[keyword] = abs(distance) / (value * cone) if value > 0 and cone > 0 else 0.0
            else:
                found[keyword] = abs(focal_length) / value if value > 0 else 0.0
        elif keyword == "FLOA":
            found[keyword] = 2 * surfaces.stop_radius / abs(scale)
        elif math.isfinite(distance) and 0 < value < 1:
            found[keyword] = 2 * abs(distance) * math.tan(math.asin(value))
    if not found:
        raise header.problem("expected the aperture: a line ENPD, FNUM or FLOA")
    keyword, diameter = next(iter(found.items()))
    if not 0 < diameter < math.inf:
        raise header.problem(f"{keyword}: expected an entrance pupil of finite size, not {diameter:g} m")
    if len(found) > 1:
        findings.report(header.problem(f"{' and '.join(found)}: two apertures"), f"{keyword} is taken")
    return diameter


def _field_radius(header: Block, unit: float, scale: float, distance: float) -> float:
    """Return the largest field angle [rad]; `scale` is the paraxial image height [m] for each unit of its tangent.

    Image heights become angles by this scale, object heights by the distance to the entrance pupil.
    """
    columns = []
    for keywords in (("XFLN", "XFLD"), ("YFLN", "YFLD")):
        line = next((found for k in keywords if (found := header.last(k)) is not None), None)
        columns.append([line.number(i) for i in range(len(line.words))] if line else [0.0])
    size = max(map(len, columns))
    x, y = (np.array(c + [0.0] * (size - len(c))) for c in columns)
    kind = round(header.number("FTYP", 0.0))
    if not 0 <= kind < len(FIELD_TYPES):
        raise header.problem(f"FTYP {kind}: expected 0 to {len(FIELD_TYPES) - 1}")
    if kind == 0:
        # As the two angles are given: the square root of the sum of their squares.
        radius = math.radians(float(np.hypot(x, y).max()))
    else:
        reach = abs(distance) if kind == 1 else abs(scale)
        radius = math.atan(float(np.hypot(x, y).max()) * unit / reach) if 0 < reach < math.inf else 0.0
    if not radius < math.radians(89.0):
        raise header.problem("XFLN, YFLN: expected fields within 89 degrees of the axis")
    return max(radius, LEAST_FIELD)
