"""Lenses from tables of radii, thicknesses and glasses."""

import numpy as np
import pytest

from pachon.models.io.glass_catalogue import GlassCatalogue
from pachon.models.shapes.shape import Plane, Sphere
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope

D, F, C = 587.5618e-9, 486.1327e-9, 656.2725e-9


@pytest.fixture(scope="session")
def lens():
    """``lens(rows, ...)``: rows of radius [mm], thickness [mm] and glass.

    Radii are as in lens tables, positive with the centre behind the surface. An empty name is air; the last thickness
    leads to the flat detector. The entrance pupil is ``stop`` mm behind the first vertex.
    """

    def build(rows, *, pupil, field_deg, stop=0.0, name="lens"):
        catalogue, surfaces, z = GlassCatalogue.bundled(), [], 0.0
        for i, (radius, thickness, glass) in enumerate(rows, start=1):
            shape = Sphere(-1e-3 * radius) if np.isfinite(radius) else Plane()
            medium = catalogue[glass] if glass else VACUUM
            surfaces.append(Surface(f"S{i}", Interaction.REFRACT, shape, (0.0, 0.0, z), medium))
            z -= 1e-3 * thickness
        surfaces.append(Surface("Image", Interaction.DETECTOR, Plane(), (0.0, 0.0, z), VACUUM))
        return Telescope(
            name=name,
            surfaces=tuple(surfaces),
            stop_z=-1e-3 * stop,
            pupil_diameter=1e-3 * pupil,
            pupil_obscuration=0.0,
            launch_distance=0.2,
            reference_sphere_radius=0.1,
            field_radius=float(np.deg2rad(field_deg)),
            field_limit=float(np.deg2rad(min(2.0 * field_deg, 60.0))),
            wavelength_range=(4.3e-7, 7e-7),
            default_wavelength=D,
        )

    return build
