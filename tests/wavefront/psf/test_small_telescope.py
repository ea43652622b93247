"""The wave engine on a telescope of 0.2 m: its pupil is as finely sampled as that of a large one."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.models.aperture import Annulus
from pachon.models.shapes.shape import Conic, Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope


def paraboloid(focal):
    radius = 0.1
    mirror = Surface("M1", Interaction.MIRROR, Conic(2 * focal, -1.0), (0, 0, 0), VACUUM, Annulus(0.025, radius))
    detector = Surface("Detector", Interaction.DETECTOR, Plane(), (0.0, 0.0, focal), VACUUM)
    return Telescope(
        name="newtonian", surfaces=(mirror, detector), stop_z=0.0, pupil_diameter=2 * radius, pupil_obscuration=0.25,
        launch_distance=2.0 * focal, reference_sphere_radius=focal, field_radius=0.01, field_limit=0.02,
        wavelength_range=(3e-7, 1e-6), default_wavelength=6e-7,
    )  # fmt: skip


@pytest.fixture(scope="module")
def newtonian():
    return paraboloid(1.0)


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


def defocused_annulus(height, radii, focal, rim=0.1, hole=0.025, wave=6e-7):
    """Light of a paraboloid at radii [m] on a detector so far behind its focus: Huygens' integral over the mirror."""
    from scipy.special import j0

    node, weight = np.polynomial.legendre.leggauss(1000)
    rho = 0.5 * (rim + hole + (rim - hole) * node)
    sag = rho**2 / (4.0 * focal)
    distance = np.sqrt(rho**2 + (focal + height - sag) ** 2 + radii[:, None] ** 2)
    wavenumber = 2.0 * np.pi / wave
    waves = np.exp(1j * wavenumber * (distance - focal - sag)) * j0(wavenumber * rho * radii[:, None] / distance)
    return np.abs(waves @ (weight * rho)) ** 2


@pytest.mark.long
def test_a_small_pupil_far_from_focus_diffracts():
    """Rays less strips along the rims, as large pupils have them, would make the edge of this donut negative."""
    focal, height, size, pixel, fine = 4.0, 0.14, 101, 80e-6, 8
    psf = pachon.make_psfs(
        paraboloid(focal).perturbed("Detector", shift=(0.0, 0.0, height)),
        [(0.0, 0.0)],
        [6e-7],
        atmosphere=pachon.Atmosphere.from_site("cerro_pachon", seed=1, r0=5.0, exposure=30.0),
        engine="long_exposure",
        stamps=pachon.Stamps(size, pixel_size=pixel, diffusion=0.0),
    )
    line = (np.arange(size * fine) + 0.5 - 0.5 * size * fine) * pixel / fine
    radii = np.linspace(0.0, 1.5 * line[-1], 1001)
    pattern = np.interp(np.hypot(line, line[:, None]), radii, defocused_annulus(height, radii, focal))
    expected = pattern.reshape(size, fine, size, fine).sum(axis=(1, 3))
    expected /= expected.sum()
    # The rims of the lattice are staircases: 1.7 % of the peak, and 0.9 % with half the spacing.
    assert np.abs(psf.image[0] - expected).max() < 0.02 * expected.max()


def test_a_small_pupil_too_far_from_focus_is_refused(newtonian):
    air = pachon.Atmosphere.from_site("cerro_pachon", seed=1, exposure=30.0)
    far = newtonian.perturbed("Detector", shift=(0.0, 0.0, 25e-3))
    stamps = pachon.Stamps(151, pixel_size=4e-5)
    with pytest.raises(DomainError, match="too far from focus for a pupil"):
        pachon.make_psfs(far, [(0.0, 0.0)], [6e-7], atmosphere=air, engine="long_exposure", stamps=stamps)
