"""Assembly of a centred telescope from a few surfaces, with pupil, field, apertures and focus from paraxial rays."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...core.errors import DomainError
from ...core.units import require_within
from ..aperture import Aperture, Circle
from ..first_order import first_order, footprints
from ..media.medium import Medium
from ..paraxial import reference_radius
from ..shapes.shape import Plane, Shape
from ..surface import Interaction, Surface
from ..telescope import VACUUM, Telescope

#: Clear apertures over the paraxial footprint of the light, for the aberrations of real rays.
CLEAR = 1.05
#: Lines F, d and C [m].
LINES = (486.1327e-9, 587.5618e-9, 656.2725e-9)
#: Diameters of apertures [m], focal ratios and radii of fields [rad] that designs are made for.
_DIAMETERS, _FOCAL_RATIOS, _FIELD_RADII = (1e-6, 1e3), (0.1, 1e6), (1e-9, 1.5)


def require_design(diameter: float, f_number: float, field_radius: float, **focal_ratios: float) -> None:
    """Raise :class:`DomainError` where aperture, a focal ratio or the field of a design is out of range."""
    require_within(diameter, "diameter", *_DIAMETERS, "m")
    for name, value in {"f_number": f_number, **focal_ratios}.items():
        require_within(value, name, *_FOCAL_RATIOS)
    require_within(field_radius, "field_radius", *_FIELD_RADII, "rad")


def mirror(name: str, shape: Shape, z: float, aperture: Aperture | None = None) -> Surface:
    """Return a mirror in vacuum with its vertex at a height [m]."""
    return Surface(name, Interaction.MIRROR, shape, (0.0, 0.0, z), VACUUM, aperture)


def interface(name: str, shape: Shape, z: float, medium: Medium) -> Surface:
    """Return a lens surface with its vertex at a height [m] and the medium behind it."""
    return Surface(name, Interaction.REFRACT, shape, (0.0, 0.0, z), medium)


def detector(z: float, shape: Shape | None = None) -> Surface:
    """Return the detector at a height [m], flat unless it has a shape."""
    return Surface("Detector", Interaction.DETECTOR, shape or Plane(), (0.0, 0.0, z), VACUUM)


def centred(name: str, description: str, source: str, surfaces: Sequence[Surface], **options: Any) -> Telescope:
    """Return a telescope of surfaces and a detector; options are stop_z, pupil_diameter, field_radius and others."""
    heights = [s.vertex[2] for s in surfaces]
    diameter, field = options["pupil_diameter"], options["field_radius"]
    defaults: dict[str, Any] = {
        "pupil_obscuration": 0.0,
        "launch_distance": max(heights) + abs(options["stop_z"]) + 2.0 * diameter,
        "reference_sphere_radius": 1.0,
        "field_limit": min(2.0 * field, 0.5 * (field + 0.5 * math.pi)),
        "wavelength_range": (0.3e-6, 1.2e-6),
        "default_wavelength": LINES[1],
        "band": (LINES[0], LINES[2]),
        "version": "1",
    }
    return Telescope(name, tuple(surfaces), description=description, source=source, **defaults | options)


def focused(telescope: Telescope, detector_at: Callable[[float], Surface] = detector) -> Telescope:
    """Return a telescope with its detector at the paraxial focus, and the reference sphere through the exit pupil."""
    optics = first_order(telescope)
    distance = optics.exit_pupil_z - optics.focus_z
    radius = reference_radius(distance, optics.focal_length, telescope.pupil_diameter)
    end = detector_at(optics.focus_z)
    edge = abs(optics.focal_length) * math.tan(telescope.field_radius)
    end = replace(end, aperture=Circle(1.2 * edge + 1e-3 * telescope.pupil_diameter))
    return replace(telescope, surfaces=(*telescope.surfaces[:-1], end), reference_sphere_radius=radius)


def cleared(telescope: Telescope, **apertures: Aperture) -> Telescope:
    """Return a telescope with circles about the light of the whole field on its surfaces; some are given by name."""
    acting = [s.name for s in telescope.surfaces if s.interaction in (Interaction.MIRROR, Interaction.REFRACT)]
    radii = dict(zip(acting, footprints(telescope, telescope.field_radius), strict=True))

    def clear(surface: Surface) -> Surface:
        if surface.name in apertures:
            return replace(surface, aperture=apertures[surface.name])
        if surface.name in radii:
            return replace(surface, aperture=Circle(CLEAR * float(radii[surface.name])))
        return surface

    return replace(telescope, surfaces=tuple(clear(s) for s in telescope.surfaces))


def solved(residuals: Callable[[np.ndarray], np.ndarray], start: Sequence[float], what: str) -> np.ndarray:
    """Return parameters at which residuals of order one vanish, by least squares from a start."""
    from scipy.optimize import least_squares

    scale = np.maximum(np.abs(start), 0.1)
    solution = least_squares(residuals, start, x_scale=scale, method="trf", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    if not np.abs(solution.fun).max() < 1e-9:
        raise DomainError(f"{what}: expected values at which the third-order equations have a solution")
    return np.asarray(solution.x)
