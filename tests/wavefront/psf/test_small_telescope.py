"""The wave engine on a telescope of 0.2 m: its pupil is as finely sampled as that of a large one."""

import numpy as np
import pytest

import pachon
from pachon.models.aperture import Annulus
from pachon.models.shapes.shape import Conic, Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope


@pytest.fixture(scope="module")
def newtonian():
    radius, focal = 0.1, 1.0
    mirror = Surface("M1", Interaction.MIRROR, Conic(2 * focal, -1.0), (0, 0, 0), VACUUM, Annulus(0.025, radius))
    detector = Surface("Detector", Interaction.DETECTOR, Plane(), (0.0, 0.0, focal), VACUUM)
    return Telescope(
        name="newtonian", surfaces=(mirror, detector), stop_z=0.0, pupil_diameter=2 * radius, pupil_obscuration=0.25,
        launch_distance=2.0, reference_sphere_radius=focal, field_radius=0.01, field_limit=0.02,
        wavelength_range=(3e-7, 1e-6), default_wavelength=6e-7,
    )  # fmt: skip


@pytest.mark.parametrize("engine", ["wave", "fast"])
def test_the_light_of_a_small_telescope_is_all_there(newtonian, engine):
    psf = pachon.make_psfs(
        newtonian, [(0.0, 0.0)], [6e-7], threads=1, engine=engine, stamps=pachon.Stamps(25, pixel_size=2e-6)
    )
    # A disc of 96 points across is a lattice of 7000: it misses its area by the square root of its rim's points.
    assert psf.lit_fraction[0] == pytest.approx(1.0, abs=5e-3)


def test_its_image_is_that_of_an_annulus(newtonian):
    """Half of the peak of [2 J1(v)/v - e^2 2 J1(e v)/(e v)]^2 lies at a radius that scipy's root finds."""
    from scipy.optimize import brentq
    from scipy.special import j1

    psf = pachon.make_psfs(
        newtonian,
        [(0.0, 0.0)],
        [6e-7],
        threads=1,
        engine="wave",
        stamps=pachon.Stamps(41, pixel_size=0.25e-6, diffusion=0.0),
    )
    obscuration = 0.25

    def amplitude(v):
        return 2 * j1(v) / v - obscuration**2 * 2 * j1(obscuration * v) / (obscuration * v)

    half = brentq(lambda v: (amplitude(v) / (1 - obscuration**2)) ** 2 - 0.5, 0.5, 2.5)
    row = psf.image[0, 20]
    fwhm = 2 * np.interp(-0.5, -row[20:] / row[20], np.arange(21)) * 0.25e-6
    # lambda f / (pi D) times v, at f/5; pixels of a sixteenth of it average little.
    assert fwhm == pytest.approx(2 * half * 6e-7 * 5 / np.pi, rel=0.01)
