"""Numbers of designs with as many digits as mean something, for files."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import replace
from typing import Any

from .aperture import Annulus, Aperture, Circle
from .paraxial import stop_makes_pupil, with_moved_pupil
from .shapes.shape import Conic, EvenAsphere, Plane, Shape, Sphere
from .surface import Surface, Vector
from .telescope import Telescope

#: Decimals of lengths of new designs in metres: a nanometre is far below every tolerance of a polished surface.
_LENGTH = 9
#: Decimals of lengths of optimised designs in metres, which are to measure as the optimum does.
_OPTIMISED = 12
#: Decimals of the radii of apertures in metres.
_APERTURE = 6
#: Decimals of conic constants and of ratios: 4 fm of sag at the rim of a mirror of 8 m.
_CONIC = 12
#: Significant digits of the coefficients of aspheres.
_COEFFICIENT = 12


def with_few_digits(telescope: Telescope) -> Telescope:
    """Return a new design with lengths in nanometres, apertures in micrometres and conic constants to 1e-9."""
    return replace(
        telescope,
        surfaces=tuple(
            replace(_surface(surface, _LENGTH), aperture=_aperture(surface.aperture)) for surface in telescope.surfaces
        ),
        stop_z=_length(telescope.stop_z),
        launch_distance=_length(telescope.launch_distance),
        reference_sphere_radius=_length(telescope.reference_sphere_radius),
        pupil_obscuration=round(telescope.pupil_obscuration, _CONIC),
    )


def with_optimised_digits(telescope: Telescope) -> Telescope:
    """Return an optimised telescope with vertices and radii in picometres.

    It is returned as it is where its stop and its stated aperture would not make its entrance pupil any more, or where
    values follow others by pickups and solves.
    """
    data = telescope.design_data
    if data.pickups or data.solves:
        return telescope
    surfaces = tuple(_surface(surface, _OPTIMISED) for surface in telescope.surfaces)
    frames = {name: (_point(pivot, _OPTIMISED), axes) for name, (pivot, axes) in telescope.group_frames.items()}
    rounded = replace(telescope, surfaces=surfaces, group_frames=frames)
    rounded = with_moved_pupil(rounded)
    if stop_makes_pupil(telescope) and not stop_makes_pupil(rounded):
        return telescope
    return rounded if rounded.design_data == data else telescope


def _surface(surface: Surface, decimals: int) -> Surface:
    return replace(surface, vertex=_point(surface.vertex, decimals), shape=_shape(surface.shape, decimals))


def _point(point: Vector, decimals: int) -> Vector:
    x, y, z = (_length(v, decimals) for v in point)
    return x, y, z


def _length(value: float, decimals: int = _LENGTH) -> float:
    return round(value, decimals) + 0.0


def _shape(shape: Shape, decimals: int) -> Shape:
    if isinstance(shape, Plane) or not isinstance(shape, Sphere | Conic | EvenAsphere):
        return shape
    numbers: dict[str, Any] = {"radius": _length(shape.radius, decimals)}
    if isinstance(shape, Conic | EvenAsphere):
        numbers["conic"] = round(shape.conic, _CONIC)
    if isinstance(shape, EvenAsphere):
        numbers["coefficients"] = tuple(float(f"{a:.{_COEFFICIENT}g}") for a in shape.coefficients)
    return replace(shape, **numbers)


def _aperture(aperture: Aperture | None) -> Aperture | None:
    """Return a circle or a ring with rims that are at least as large, and holes that are at most as large."""
    if not isinstance(aperture, Circle | Annulus):
        return aperture
    size = 10.0**_APERTURE
    rims = {f.name: getattr(aperture, f.name) for f in dataclasses.fields(aperture) if f.name in ("radius", "outer")}
    rounded = {name: math.ceil(round(radius * size, 3)) / size for name, radius in rims.items()}
    if isinstance(aperture, Annulus):
        rounded["inner"] = math.floor(round(aperture.inner * size, 3)) / size
    return replace(aperture, **rounded)
