"""Telescopes whose images are known in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from pachon.models.aperture import Circle
from pachon.models.media.medium import ConstantIndex
from pachon.models.shapes.shape import Conic, Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope


@pytest.fixture(scope="session")
def paraboloid():
    """``paraboloid(focal_length, f_number, ...)``: one mirror, its stop in the plane of its vertex, a flat detector.

    ``shift``: height of the detector above the focus [m]. ``baffle``: height and radius of a clear circle in front [m].
    """

    def build(focal_length=2.0, f_number=20.0, *, obscuration=0.0, shift=0.0, baffle=None, aperture=None, stop_z=0.0):
        mirror = Surface(
            "mirror", Interaction.MIRROR, Conic(2.0 * focal_length, -1.0), (0.0, 0.0, 0.0), VACUUM, aperture
        )
        detector = Surface("detector", Interaction.DETECTOR, Plane(), (0.0, 0.0, focal_length + shift), VACUUM)
        surfaces = (mirror, detector)
        if baffle is not None:
            height, radius = baffle
            front = Surface("baffle", Interaction.PASS, Plane(), (0.0, 0.0, height), VACUUM, Circle(radius))
            surfaces = (front, *surfaces)
        return Telescope(
            name="paraboloid",
            surfaces=surfaces,
            stop_z=stop_z,
            pupil_diameter=focal_length / f_number,
            pupil_obscuration=obscuration,
            launch_distance=5.0 * focal_length,
            reference_sphere_radius=focal_length,
            field_radius=float(np.deg2rad(0.5)),
            field_limit=float(np.deg2rad(2.0)),
            wavelength_range=(3e-7, 1e-6),
            default_wavelength=5e-7,
        )

    return build


@pytest.fixture(scope="session")
def afocal(paraboloid):
    """``afocal(fold)``: a plate of glass, or a flat mirror, 20 mm across and without power; a detector behind it."""

    def build(fold):
        glass = ConstantIndex(1.5)
        plate = (
            Surface("front", Interaction.REFRACT, Plane(), (0.0, 0.0, 0.0), glass),
            Surface("back", Interaction.REFRACT, Plane(), (0.0, 0.0, -0.01), VACUUM),
        )
        mirror = (Surface("fold", Interaction.MIRROR, Plane(), (0.0, 0.0, 0.0), VACUUM),)
        detector = Surface("detector", Interaction.DETECTOR, Plane(), (0.0, 0.0, 0.2 if fold else -0.2), VACUUM)
        return replace(
            paraboloid(), surfaces=(*(mirror if fold else plate), detector), pupil_diameter=0.02, launch_distance=1.0
        )

    return build
