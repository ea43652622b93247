"""Ideal telescopes, for stars that are blurred by atmosphere and camera alone."""

from __future__ import annotations

import math
from dataclasses import replace

from .aperture import Annulus
from .shapes.shape import Conic, Plane
from .surface import Interaction, Surface
from .telescope import VACUUM, Telescope


def ideal_telescope(telescope: Telescope, focal_ratio: float = 1000.0) -> Telescope:
    """Return a telescope with a pupil of the same size and negligible aberrations: one slow paraboloid in vacuum.

    Obstructions stay that block light on its way to the first surface.
    At f/N (`focal_ratio`) its coma, 3 theta / (16 N^2), and its astigmatism, theta^2 / (2 N), blur a star at an angle
    theta from the axis: at f/1000 by 1e-4 and 9e-4 arcsec 10 arcmin from it, at f/100 000 by 1e-7 and 1e-3 arcsec at
    1.75 degrees.
    """
    length = focal_ratio * telescope.pupil_diameter
    origin, focus = (0.0, 0.0, 0.0), (0.0, 0.0, length)
    outer = 0.5 * telescope.pupil_diameter
    # The mirror has the rims of the pupil too, so that single rays are vignetted as in the engines.
    ring = Annulus(telescope.pupil_obscuration * outer, outer)
    first = next((s.name for s in telescope.surfaces if s.interaction != Interaction.PASS), "")
    obstructions = (o for o in telescope.obstructions if o.before is None or first in o.before)
    surfaces = (
        Surface("M1", Interaction.MIRROR, Conic(2.0 * length, -1.0), origin, VACUUM, ring),
        Surface("Detector", Interaction.DETECTOR, Plane(), focus, VACUUM),
    )
    return replace(
        telescope.with_other_surfaces(surfaces, VACUUM, [replace(o, before=("M1",)) for o in obstructions]),
        name=f"paraboloid of f/{focal_ratio:g}",
        stop_z=0.0,
        launch_distance=1.5 * length,
        reference_sphere_radius=length,
        camera=None,
        object_distance=math.inf,
        pupil_center=(0.0, 0.0),
    )
