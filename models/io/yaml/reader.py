"""Read a telescope from the sections of a prescription file; the format is described in `prescription`."""

from __future__ import annotations

import math
from collections.abc import Callable
from decimal import Decimal
from typing import cast

from ....core.errors import PrescriptionError
from ....core.yaml_reader import Section, as_number
from ...media.medium import Medium
from ...surface import IDENTITY, Interaction, Matrix, Surface, Vector
from ...telescope import VACUUM, Telescope, rotation_matrix
from .apertures import APERTURE_KEYS, read_aperture, read_obstructions
from .media import read_medium
from .shapes import read_shape, shape_keys

INTERACTIONS = {
    "mirror": Interaction.MIRROR,
    "refract": Interaction.REFRACT,
    "detector": Interaction.DETECTOR,
    "baffle": Interaction.PASS,
    "phase": Interaction.PHASE,
}


def _power_of_ten(exponent: int) -> Callable[[float], float]:
    """Return a conversion that moves the decimal point of the figure as written: 0.545 um is the float 545e-9 m."""
    return lambda v: float(Decimal(repr(v)).scaleb(exponent))


LENGTHS = {"m": _power_of_ten(0), "mm": _power_of_ten(-3)}
ANGLES: dict[str, Callable[[float], float]] = {"rad": _power_of_ten(0), "deg": math.radians}
WAVELENGTHS = {"m": _power_of_ten(0), "um": _power_of_ten(-6), "nm": _power_of_ten(-9)}

HEADER = (
    "name",
    "description",
    "source",
    "version",
    "units",
    "stop",
    "pupil",
    "launch_distance",
    "object_distance",
    "reference_sphere_radius",
    "field",
    "wavelengths",
    "camera",
    "medium_before",
    "media",
    "groups",
    "obstructions",
    "surfaces",
)
SURFACE_KEYS = ("name", "type", "shape", "x", "y", "z", "tilt", "rotation", "medium", *APERTURE_KEYS)


def read_telescope(top: Section) -> Telescope:
    """Return the telescope that the top level of a prescription file describes."""
    top.allow(*HEADER)
    units = top.section("units")
    units.allow("length", "angle", "wavelength")
    length = LENGTHS[units.choice("length", tuple(LENGTHS))]
    angle = ANGLES[units.choice("angle", tuple(ANGLES))]
    wavelength = WAVELENGTHS[units.choice("wavelength", tuple(WAVELENGTHS))]
    media = {"vacuum": VACUUM} | _read_media(top.section("media", optional=True), wavelength)
    stop, pupil = top.section("stop"), top.section("pupil")
    field, waves = top.section("field"), top.section("wavelengths")
    stop.allow("z")
    pupil.allow("diameter", "obscuration")
    field.allow("radius", "limit")
    waves.allow("range", "default", "band")
    medium_before = _read_medium(top, "medium_before", media, VACUUM)
    surfaces: list[Surface] = []
    for section in top.sections("surfaces", "name"):
        medium = surfaces[-1].medium_after if surfaces else medium_before
        surfaces.append(_read_surface(section, media, medium, length, angle))
    band = tuple(wavelength(v) for v in waves.numbers("band", 2)) if "band" in waves else None
    groups, frames = _read_groups(top.section("groups", optional=True), length)
    shortest, longest = (wavelength(v) for v in waves.numbers("range", 2))
    try:
        return Telescope(
            name=top.text("name"),
            description=top.text("description", ""),
            source=top.text("source"),
            version=top.text("version"),
            surfaces=tuple(surfaces),
            stop_z=length(stop.number("z")),
            pupil_diameter=length(pupil.number("diameter", positive=True)),
            pupil_obscuration=pupil.number("obscuration"),
            launch_distance=length(top.number("launch_distance", positive=True)),
            object_distance=length(top.number("object_distance")) if "object_distance" in top else math.inf,
            reference_sphere_radius=length(top.number("reference_sphere_radius", positive=True)),
            field_radius=angle(field.number("radius", positive=True)),
            field_limit=angle(field.number("limit", positive=True)),
            wavelength_range=(shortest, longest),
            default_wavelength=wavelength(waves.number("default", positive=True)),
            band=cast("tuple[float, float] | None", band),
            medium_before=medium_before,
            groups=groups,
            group_frames=frames,
            camera=top.text("camera") if "camera" in top else None,
            obstructions=read_obstructions(top),
        )
    except PrescriptionError as error:
        # Values of single keys carry their place already; what several keys say together does not.
        raise top.placed(error) from None


def _read_media(media: Section, wavelength: Callable[[float], float]) -> dict[str, Medium]:
    found: dict[str, Medium] = {}
    for name in media.keys():  # noqa: SIM118 - a Section is no mapping
        if name == "vacuum":
            raise media.error(name, "another name: vacuum is defined already, with index 1")
        found[name] = read_medium(media.section(name), wavelength)
    return found


def _read_medium(section: Section, key: str, media: dict[str, Medium], default: Medium) -> Medium:
    return media[section.choice(key, tuple(media))] if key in section else default


def _read_groups(
    section: Section, length: Callable[[float], float]
) -> tuple[dict[str, tuple[str, ...]], dict[str, tuple[Vector, Matrix]]]:
    groups, frames = {}, {}
    for name in section.keys():  # noqa: SIM118 - a Section is no mapping
        if isinstance(section.value(name), dict):
            group = section.section(name)
            group.allow("surfaces", "pivot", "rotation")
            groups[name] = group.names("surfaces")
            x, y, z = (length(v) for v in group.numbers("pivot", 3))
            frames[name] = ((x, y, z), _read_matrix(group))
        else:
            groups[name] = section.names(name)
    return groups, frames


def _read_matrix(section: Section) -> Matrix:
    if "rotation" not in section:
        return IDENTITY
    rows = section.value("rotation")
    if not (isinstance(rows, list) and len(rows) == 3 and all(isinstance(r, list) and len(r) == 3 for r in rows)):
        raise section.error("rotation", "three rows of three numbers")
    numbers = [[as_number(v) for v in row] for row in rows]
    if any(n is None for row in numbers for n in row):
        raise section.error("rotation", "three rows of three numbers")
    return cast(Matrix, tuple(tuple(row) for row in numbers))


def _read_surface(
    section: Section,
    media: dict[str, Medium],
    medium_before: Medium,
    length: Callable[[float], float],
    angle: Callable[[float], float],
) -> Surface:
    section.allow(*SURFACE_KEYS, *shape_keys(section))
    interaction = INTERACTIONS[section.choice("type", tuple(INTERACTIONS))]
    if interaction == Interaction.REFRACT:
        section.text("medium")
    if "tilt" in section and "rotation" in section:
        raise section.error("tilt", "tilt or rotation, not both")
    rotation = _read_matrix(section)
    if "tilt" in section:
        turned = rotation_matrix([angle(v) for v in section.numbers("tilt", 3)])
        rotation = cast(Matrix, tuple(tuple(float(v) for v in row) for row in turned))
    try:
        return Surface(
            name=section.text("name"),
            interaction=interaction,
            shape=read_shape(section, length),
            vertex=(length(section.number("x", 0.0)), length(section.number("y", 0.0)), length(section.number("z"))),
            medium_after=_read_medium(section, "medium", media, medium_before),
            aperture=read_aperture(section, length, angle),
            rotation=rotation,
        )
    except PrescriptionError as error:
        raise section.placed(error) from None
