"""Shear of rings of galaxies: the closed form, and that of rendered galaxies."""

import numpy as np
import pytest

import pachon

galsim = pytest.importorskip("galsim")


def sheared(e, g):
    """Ellipticity after a reduced shear, Seitz & Schneider 1997, eq. 3.2."""
    return (e + g) / (1.0 + np.conj(g) * e)


def rings(n, k, seed=1):
    """Ellipticities [n, k] of rings."""
    rng = np.random.default_rng(seed)
    e = rng.uniform(0.05, 0.4, (n, 1)) * np.exp(1j * rng.uniform(0.0, 2.0 * np.pi, (n, 1)))
    return e * np.exp(2j * np.pi * np.arange(k) / k)


SHEARS = 0.02 * np.exp(2j * np.pi * np.arange(8) / 8)


def test_the_mean_of_a_ring_is_its_shear():
    # Responsivity 1: pairs leave g* e^2, four orientations nothing that counts.
    e = sheared(rings(8, 4), SHEARS[:, None])
    np.testing.assert_allclose(e.mean(axis=1), SHEARS, rtol=0, atol=1e-6)
    pairs = sheared(rings(8, 2), SHEARS[:, None])
    left = -np.conj(SHEARS) * rings(8, 2)[:, 0] ** 2
    np.testing.assert_allclose(pairs.mean(axis=1) - SHEARS, left, rtol=0, atol=1e-5)


def test_calibration_is_a_straight_line():
    e = (1.0 + 0.05) * SHEARS[:, None] + (0.003 - 0.002j) + 0.1 * np.array([[1.0, -1.0]])
    found = pachon.measure.shear_calibration(e.real, e.imag, SHEARS.real, SHEARS.imag)
    np.testing.assert_allclose(found.m, 0.05, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.c, [0.003, -0.002], rtol=0, atol=1e-14)
    assert (found.m_error < 1e-12).all()
    assert found.n_rings == 8


def test_errors_of_the_line_are_their_scatter():
    rng = np.random.default_rng(4)
    found = []
    for _ in range(300):
        e = SHEARS[:, None] + rng.normal(0.0, 0.01, (8, 2)) + 1j * rng.normal(0.0, 0.01, (8, 2))
        found.append(pachon.measure.shear_calibration(e.real, e.imag, SHEARS.real, SHEARS.imag))
    m, c = np.array([f.m for f in found]), np.array([f.c for f in found])
    # rms of errors against scatter: both are known to 6 % of 300 draws.
    for error, scatter in (("m_error", m), ("c_error", c)):
        rms = np.sqrt(np.mean([getattr(f, error) ** 2 for f in found], axis=0))
        np.testing.assert_allclose(rms, scatter.std(axis=0), rtol=0.15)


def calibration(profile, draw, psf):
    """Calibration from four rings of four galaxies at random sub-pixel places, and mean of shear over true shear.

    The mean of 1 / g over the four directions is zero, so the additive bias cancels.
    """
    shears = SHEARS[::2]
    rng = np.random.default_rng(6)
    stamps = [
        draw(
            profile.shear(g1=e.real, g2=e.imag).shear(g1=g.real, g2=g.imag).shift(*rng.uniform(-0.5, 0.5, 2)),
        )
        for g, ring in zip(shears, rings(4, 4, seed=5), strict=True)
        for e in ring
    ]
    fits = pachon.measure.fit_galaxy_stamps(np.stack(stamps), 1.0, psf)
    assert fits.good.all()
    e1, e2 = (e.reshape(4, 4) for e in (fits.e1, fits.e2))
    return pachon.measure.shear_calibration(e1, e2, shears.real, shears.imag), (
        (e1 + 1j * e2).mean(axis=1) / shears
    ).mean()


def test_shear_of_gaussian_galaxies_is_recovered(render, psf):
    # The fit is exact, under a PSF that is not round, and so is the shear.
    found, ratio = calibration(galsim.Gaussian(sigma=1.8), render, psf)
    assert np.abs(found.m).max() < 1e-3
    assert np.abs(found.c).max() < 1e-5
    assert 0.02 * ratio == pytest.approx(0.02, abs=2e-5)


@pytest.mark.parametrize(
    ("profile", "bias"), [(galsim.Exponential, (-0.07, -0.05)), (galsim.DeVaucouleurs, (-0.27, -0.2))]
)
def test_shear_of_other_profiles_is_underestimated(profile, bias, psf_profile, psf):
    # The page on measuring images has these figures: a Gaussian is no galaxy.
    def draw(galaxy):
        both = galsim.Convolve(galaxy, psf_profile)
        return both.drawImage(nx=32, ny=32, scale=1.0, method="no_pixel", dtype=float).array

    found, ratio = calibration(profile(half_light_radius=2.1), draw, psf)
    assert bias[0] < ratio.real - 1.0 < bias[1]
    assert np.abs(found.c).max() > 1e-4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)), "have shapes .* expected"),
        (
            (np.zeros((2, 4)), np.zeros((2, 4)), [0.0, 1.0], [0.0, 1.0]),
            "2 of 2 rings are complete: expected at least 3",
        ),
        ((np.zeros((3, 4)), np.zeros((3, 4)), [0.1] * 3, [0.0, 1.0, 2.0]), "shear1 = 0.1 of all rings"),
        ((np.full((4, 2), np.nan), np.zeros((4, 2)), np.arange(4), np.arange(4)), "0 of 4 rings"),
    ],
)
def test_bad_input(arguments, message):
    with pytest.raises(pachon.errors.DomainError, match=message):
        pachon.measure.shear_calibration(*arguments)
