"""Lenses whose aberrations are known in closed form, or by a brute-force trace in a plane."""

from dataclasses import replace

import numpy as np
import pytest

from pachon.models.media.dispersion import model_glass
from pachon.models.media.medium import ConstantIndex
from pachon.models.shapes.shape import Plane, Sphere
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM


@pytest.fixture(scope="session")
def sphere(paraboloid):
    """``sphere(stop_z)``: a spherical mirror of radius 4 m, f/10, its stop at a height, a flat detector at R/2."""

    def build(stop_z):
        telescope = paraboloid(2.0, 10.0, stop_z=stop_z)
        mirror = replace(telescope.surfaces[0], shape=Sphere(4.0))
        return replace(telescope, surfaces=(mirror, telescope.surfaces[1]), launch_distance=20.0)

    return build


@pytest.fixture(scope="session")
def singlet(paraboloid):
    """``singlet(thickness, stop_z)``: plano-convex, f 100 mm, n 1.5168 and V 64.17 at the d line, flat side behind."""

    def build(thickness=1e-6, stop_z=0.0, glass=None):
        medium = model_glass(1.5168, 64.17) if glass is None else ConstantIndex(glass)
        surfaces = (
            Surface("front", Interaction.REFRACT, Sphere(-0.05168), (0.0, 0.0, 0.0), medium),
            Surface("back", Interaction.REFRACT, Plane(), (0.0, 0.0, -thickness), VACUUM),
            Surface("detector", Interaction.DETECTOR, Plane(), (0.0, 0.0, -0.1 - thickness), VACUUM),
        )
        return replace(
            paraboloid(),
            surfaces=surfaces,
            pupil_diameter=0.01,
            stop_z=stop_z,
            launch_distance=1.0,
            wavelength_range=(0.4e-6, 0.8e-6),
            band=(486.1327e-9, 656.2725e-9),
            default_wavelength=587.5618e-9,
            reference_sphere_radius=0.1,
            field_limit=float(np.deg2rad(20.0)),
        )

    return build


@pytest.fixture(scope="session")
def meridional():
    """``meridional(index, thickness, height, slope)``: a ray through the singlet in a plane, by Snell's law.

    Height [m] on the plane of the vertex and tangent of the angle before it; both behind the lens, on its flat side.
    """

    def trace(index, thickness, height, slope):
        angle = np.arctan(slope)
        # The front: centre at 51.68 mm behind the vertex; s along the light.
        radius = 0.05168
        s = 0.0
        for _ in range(50):
            y = height + slope * s
            s = radius - np.sqrt(radius**2 - y**2)
        y = height + slope * s
        normal = np.arcsin(y / radius)
        inside = np.arcsin(np.sin(angle + normal) / index) - normal
        y = y + np.tan(inside) * (thickness - s)
        return y, np.tan(np.arcsin(index * np.sin(inside)))

    return trace
