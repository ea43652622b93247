"""Build a telescope from the description of a lens.

Frame: a lens sends light along +z, a telescope along -z. The telescope's axes are those of the lens rotated by half a
turn about y, ``(x, y, z) = (-X, Y, Z0 - Z)``; `Z0` is where the first surface with power lies, so that its vertex is at
z = 0. A field of the lens at angles (tx, ty) is the field (-tx, ty) here.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ....core.errors import PrescriptionError, error_context
from ...design_data import DesignData
from ...element_groups import element_groups
from ...media.medium import RelativeToAir
from ...paraxial import ParaxialSurfaces, StopImage, reference_radius
from ...shapes.shape import Plane
from ...surface import Interaction, Surface
from ...telescope import Telescope
from ...thickness import impossible_thicknesses
from ..glass_catalogue import GlassCatalogue
from ..writable import unmet_pickup
from .description import PUPIL_PLANE, WIDEST, LensDescription, LensSurface, StatedAperture
from .frame import HALF_TURN, rotated_aperture, rotated_axes, rotated_shape
from .glasses import Glasses
from .source import Findings, Source

#: Reads the description of a lens from a file.
Reader = Callable[[Path, Findings, Glasses], LensDescription]
#: Field radius [rad] of a file with the axis alone.
LEAST_FIELD = math.radians(0.1)
#: Distance of an object from a thin lens below which it is in the lens [m].
LEAST_DISTANCE = 1e-9


def read_lens(
    path: Path,
    reader: Reader,
    *,
    lenient: bool = False,
    glass_catalogues: Iterable[GlassCatalogue | str | os.PathLike[str]] = (),
) -> Telescope:
    """Read a lens file with the reader of its format."""
    findings = Findings(lenient)
    with error_context(file=path):
        telescope = telescope_of(reader(path, findings, Glasses(path, glass_catalogues)))
    for text in impossible_thicknesses(telescope):
        findings.doubt(PrescriptionError(text, file=path), "read as it is: rays go back within it")
    return telescope


def telescope_of(lens: LensDescription) -> Telescope:
    """Return the telescope that a lens file describes; PrescriptionError, in the words of the file, if there is none.

    Lengths are in metres, indices as in the file: relative to air, whose index is 1.
    """
    if not lens.design.wavelengths:
        raise lens.problem(f"expected the wavelengths: {lens.format.wavelengths}")
    surfaces = _in_order(lens)
    pupil = _pupil(lens, surfaces)
    surfaces = _with_conjugates(lens, surfaces, pupil.image.surfaces)
    names = surface_names(surfaces)
    stop = next((i for i in range(len(surfaces) - 1, -1, -1) if surfaces[i].stop), 0)
    pupil_plane = stop == 0 and surfaces[0].stop and surfaces[0].name == PUPIL_PLANE
    design = _design_data(lens, pupil, None if pupil_plane else names[stop])
    low, high = _wavelength_range(lens, surfaces)
    if pupil_plane:
        surfaces, names = surfaces[1:], names[1:]
    z0 = _first_power(surfaces)
    placed = tuple(_placed(surface, name, z0) for surface, name in zip(surfaces, names, strict=True))
    reach = max(max(abs(v) for s in placed for v in s.vertex), abs(pupil.image.z + z0), pupil.diameter)
    limit = min(max(2 * pupil.field_radius, math.radians(5.0)), math.radians(85.0))
    waves = lens.design.wavelengths
    telescope = Telescope(
        name=lens.path.stem,
        source=f"{lens.format.program} file {lens.path.name}",
        version=lens.version,
        description=lens.title,
        surfaces=placed,
        # Heights count against the light.
        stop_z=float(z0 - pupil.image.z) + 0.0,
        pupil_diameter=pupil.diameter,
        pupil_obscuration=0.0,
        launch_distance=3.0 * reach / math.cos(limit),
        reference_sphere_radius=pupil.reference_radius,
        field_radius=pupil.field_radius,
        field_limit=limit,
        wavelength_range=(low, high),
        default_wavelength=lens.primary_wavelength,
        # At least 2 % wide.
        band=(max(min(waves) * 0.99, low), min(max(waves) * 1.01, high)),
        medium_before=lens.medium,
        object_distance=float(z0 + pupil.image.object_distance),
        groups=element_groups(placed, lens.medium),
        design_data=design,
    )
    return _linked(telescope, lens)


def _in_order(lens: LensDescription) -> list[LensSurface]:
    """Return the surfaces with their distances along the axis, the last of them a detector.

    Where the file states places alone, heights count from the first vertex. The axis starts along z and is reflected
    by each mirror.
    """
    surfaces = list(lens.surfaces)
    origin, axis, sign = np.array([0.0, 0.0, surfaces[0].position[2]]), np.array([0.0, 0.0, 1.0]), 1.0
    first = origin.copy()
    for i, surface in enumerate(surfaces):
        if surface.distance is not None:
            continue
        distance = float(sign * axis @ (surface.position - origin))
        surfaces[i] = replace(surface, distance=distance, position=surface.position - first)
        origin = origin + sign * distance * axis
        if surface.interaction == Interaction.MIRROR:
            normal = surface.axes[:, 2]
            axis, sign = axis - 2.0 * (axis @ normal) * normal, -sign
    last = surfaces[-1]
    if last.interaction != Interaction.MIRROR:
        last = replace(last, interaction=Interaction.DETECTOR, after=last.before)
    return [*surfaces[:-1], last]


def surface_names(surfaces: Sequence[LensSurface]) -> list[str]:
    """Return a name for each surface: that of the file, with its number where it is taken, or S and the number."""
    names: list[str] = []
    for surface in surfaces:
        name = surface.name or ("Image" if surface is surfaces[-1] else f"S{surface.number}")
        names.append(name if name not in names else f"{name} (S{surface.number})")
    return names


@dataclass(frozen=True)
class _Pupil:
    """Entrance pupil of a lens: the image of its stop, its diameter [m], and what follows from them.

    `aperture` is the size of the beam as the file states it, `reference_radius` the radius of the reference sphere [m].
    """

    image: StopImage
    diameter: float
    aperture: StatedAperture
    field_radius: float
    reference_radius: float


def _pupil(lens: LensDescription, surfaces: Sequence[LensSurface]) -> _Pupil:
    """Return the paraxial entrance pupil at the primary wavelength, and the field.

    Like that of Zemax, the paraxial trace follows the surfaces along the axis as if they were centred on it.
    PrescriptionError if pupil and object are at infinity, or the pupil has no size or, unless lenient, the aperture or
    the stop is not stated once.
    """
    paraxial, stop_source = ParaxialSurfaces(), Source(str(lens.path), keyword="the stop")
    for surface in surfaces:
        paraxial.advance(surface.distance or 0.0)
        if surface.stop:
            paraxial.mark_stop(surface.semi_diameter)
            stop_source = surface.source
        mirror = surface.interaction == Interaction.MIRROR
        power = 0.0 if surface.thin_lens is None else 1.0 / surface.thin_lens.focal_length
        paraxial.add(surface.shape.curvatures, surface.before, surface.after, mirror=mirror, power=power)
    if not any(surface.stop for surface in surfaces):
        lens.findings.report(lens.problem(f"no surface is the stop ({lens.format.stop})"), "the first is taken")
        paraxial.mark_stop(0.0, first=True)
    telecentric = lens.telecentric and math.isfinite(lens.object_distance)
    image = StopImage.of(paraxial, lens.primary_wavelength, lens.object_distance, telecentric=telecentric)
    if image is None:
        raise stop_source.problem("the stop makes an entrance pupil at infinity (telecentric): not supported")
    if not lens.apertures:
        raise lens.problem(f"expected the aperture: {lens.format.aperture}")
    aperture, *further_apertures = lens.apertures
    value = paraxial.stop_radius if aperture.kind == "stop" else aperture.value
    diameter = image.diameter(aperture.kind, value)
    if not 0 < diameter < math.inf:
        raise aperture.source.error(f"an entrance pupil of finite size, not {diameter:g} m")
    if further_apertures:
        keywords = [stated.source.keyword for stated in lens.apertures]
        text = f"{' and '.join(keywords)}: two apertures"
        lens.findings.report(further_apertures[0].source.problem(text), f"{keywords[0]} is taken")
    to_pupil = image.image_scale / image.image_slope if image.image_slope else math.inf
    radius = reference_radius(to_pupil, image.focal_length, diameter, image.beam_radius(diameter))
    return _Pupil(image, diameter, replace(aperture, value=value), _field_radius(lens, image), radius)


def _with_conjugates(
    lens: LensDescription, surfaces: list[LensSurface], paraxial: ParaxialSurfaces
) -> list[LensSurface]:
    """Return the surfaces with thin lenses whose paths are equal from the object on the axis to its image."""
    placed = list(surfaces)
    for i, surface in enumerate(surfaces):
        if surface.thin_lens is not None:
            distance = paraxial.object_distance_at(i, lens.primary_wavelength, lens.object_distance)
            # An object in the lens itself has no such paths.
            distance = distance if abs(distance) > LEAST_DISTANCE else math.inf
            placed[i] = replace(surface, thin_lens=replace(surface.thin_lens, object_distance=distance))
    return placed


def _field_radius(lens: LensDescription, image: StopImage) -> float:
    """Return the largest field angle [rad]; heights become angles by their paraxial scales."""
    kind = lens.design.field_type
    if kind == "angle":
        # As the two angles are given: the square root of the sum of their squares.
        radius = math.radians(lens.largest_field)
    else:
        reach = abs(image.object_distance + image.z if kind == "object_height" else image.image_scale)
        radius = math.atan(lens.largest_field * lens.unit / reach) if 0 < reach < math.inf else 0.0
    if not radius < WIDEST:
        source = lens.sources["fields"]
        raise source.problem(f"{source.keyword}: expected fields within 89 degrees of the axis")
    return max(radius, LEAST_FIELD)


def _design_data(lens: LensDescription, pupil: _Pupil, stop: str | None) -> DesignData:
    telecentric = pupil.image.telecentric
    return replace(
        lens.design,
        aperture=pupil.aperture.kind,
        aperture_value=pupil.aperture.value,
        stop=stop,
        # No rays are aimed in a telecentric object space; a file without a stop has nothing to aim at.
        aiming="off" if telecentric or stop is None else lens.design.aiming,
        telecentric=telecentric,
    )


def _placed(surface: LensSurface, name: str, z0: float) -> Surface:
    x, y, z = (float(v) for v in HALF_TURN @ (surface.position - np.array([0.0, 0.0, z0])) + 0.0)
    with surface.source.context():
        return Surface(
            name=name,
            interaction=surface.interaction,
            shape=rotated_shape(surface.shape),
            vertex=(x, y, z),
            medium_after=surface.after,
            aperture=None if surface.aperture is None else rotated_aperture(surface.aperture),
            rotation=rotated_axes(surface.axes),
            # What follows the light is computed where it is shown, of the lens as it has become.
            semi_diameter=surface.semi_diameter if surface.semi_diameter > 0 and not surface.automatic else None,
            grating=None if surface.grating is None else surface.grating.rotated(),
            thin_lens=surface.thin_lens,
        )


def _first_power(surfaces: Sequence[LensSurface]) -> float:
    """Return where along the axis the first curved mirror or lens surface is, or else the first flat one."""
    powerful = (Interaction.MIRROR, Interaction.REFRACT, Interaction.THIN_LENS)
    acting = [s for s in surfaces if s.interaction in powerful]
    curved = [s for s in acting if not isinstance(s.shape, Plane) or s.thin_lens is not None]
    return float((curved or acting or surfaces)[0].position[2])


def _wavelength_range(lens: LensDescription, surfaces: Sequence[LensSurface]) -> tuple[float, float]:
    waves, source = lens.design.wavelengths, lens.sources["wavelengths"]
    low, high = min(0.1e-6, *waves), max(20e-6, *waves)
    for medium in (lens.medium, *(s.after for s in surfaces)):
        glass = medium.relative if isinstance(medium, RelativeToAir) else medium
        covered = getattr(glass, "wavelength_range", ())
        if not covered:
            continue
        if not covered[0] <= min(waves) <= max(waves) <= covered[1]:
            raise source.problem(
                f"{source.keyword} {min(waves) * 1e6:g} to {max(waves) * 1e6:g} um: expected "
                f"{covered[0] * 1e6:g} to {covered[1] * 1e6:g} um, which glass {medium.name} covers"
            )
        low, high = max(low, covered[0]), min(high, covered[1])
    return low, high


def _linked(telescope: Telescope, lens: LensDescription) -> Telescope:
    """Return a telescope with the pickups and solves of its file; pickups that its values do not meet are left out."""
    pickups = []
    for source, choices in lens.pickups:
        met = next((pickup for pickup in choices if unmet_pickup(telescope, pickup) is None), None)
        if met is not None:
            pickups.append(met)
        else:
            text = f"{choices[0].address}: the file has another value"
            lens.findings.doubt(source.problem(text), "it is not kept")
    if not (pickups or lens.solves):
        return telescope
    return telescope.with_design(pickups=tuple(pickups), solves=tuple(lens.solves))
