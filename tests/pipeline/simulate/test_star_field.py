import numpy as np
import pytest
from astropy import units as u

from pachon.core.errors import DomainError, UnknownNameError
from pachon.pipeline.simulate import photometry
from pachon.pipeline.simulate.star_field import CcdOutline, Depth, draw_magnitudes, make_star_field

BOUNDS = (-0.02048, 0.02048, 0.10652, 0.14748)
FWHM = 0.7 * photometry.ARCSEC


def field(ccd="R22_S11", n_holdout=100, n_observed=40, seed=1, pixel_size=1e-5, margin=20, **depth):
    outline = CcdOutline(ccd, BOUNDS, pixel_size)
    return make_star_field(outline, n_holdout, n_observed, seed, fwhm=FWHM, depth=Depth(**depth), margin=margin)


def test_positions_and_pixels():
    stars = field(n_holdout=4000, n_observed=4000)
    for positions, margin in ((stars.holdout, 0), (stars.observed, 20)):
        assert positions.shape == (4000, 2)
        low = np.array([BOUNDS[0], BOUNDS[2]]) + margin * 1e-5
        high = np.array([BOUNDS[1], BOUNDS[3]]) - margin * 1e-5
        assert np.all((positions >= low) & (positions <= high))
        unit = (positions - low) / (high - low)
        # Uniform: mean 1/2 with a scatter of 0.289/sqrt(4000) = 0.0046 per axis, and no correlation (1/sqrt(4000)); 4
        # sigma.
        assert np.abs(unit.mean(axis=0) - 0.5).max() < 0.019
        assert abs(np.corrcoef(unit.T)[0, 1]) < 0.064
    pixel = stars.observed_pixel
    # The outer edges of a 4096-pixel CCD lie at -0.5 and 4095.5.
    assert pixel.min() >= 19.5
    assert pixel.max() <= 4075.5
    np.testing.assert_allclose(stars.ccd.to_pixel([[BOUNDS[0] + 5e-6, BOUNDS[2] + 15e-6]]), [[0.0, 1.0]], atol=1e-8)
    fraction = pixel % 1.0
    assert abs(fraction.mean() - 0.5) < 0.014  # sub-pixel phases are uniform: 4 sigma of 8000 numbers
    assert not np.any(np.isin(stars.holdout, stars.observed))


def test_magnitudes_follow_the_star_counts():
    bright, faint, count = 16.0, 22.0, 20000
    magnitudes = draw_magnitudes(np.random.default_rng(2), count, bright, faint)
    edges = np.linspace(bright, faint, 13)
    cumulative = (10 ** (0.2 * edges) - 10 ** (0.2 * bright)) / (10 ** (0.2 * faint) - 10 ** (0.2 * bright))
    expected = count * np.diff(cumulative)
    found, _ = np.histogram(magnitudes, edges)
    # chi^2 of 11 degrees of freedom: 31 is its 99.9 % point; the draw is fixed, so this holds or does not, once for
    # all.
    assert ((found - expected) ** 2 / expected).sum() < 31.0
    assert magnitudes.min() >= bright
    assert magnitudes.max() <= faint


def test_observed_stars_are_bright_but_not_saturated():
    stars = field(n_observed=500)
    ratio = photometry.signal_to_noise(stars.magnitude, "r", 15.0, FWHM)
    assert ratio.min() >= 30.0
    assert stars.magnitude.min() >= photometry.saturation_magnitude("r", 15.0, FWHM)
    np.testing.assert_array_equal(stars.electrons, photometry.electrons(stars.magnitude, "r", 15.0))
    limited = field(bright=18.0, faint=19.0)
    assert (limited.bright, limited.faint) == (18.0, 19.0)
    assert np.all((limited.magnitude >= 18.0) & (limited.magnitude <= 19.0))


def test_stars_depend_on_seed_and_ccd_alone():
    stars = field()
    again = field(n_holdout=30, n_observed=70)
    assert again.holdout.tobytes() == stars.holdout[:30].tobytes()
    assert again.observed[:40].tobytes() == stars.observed.tobytes()
    assert again.magnitude[:40].tobytes() == stars.magnitude.tobytes()
    for other in (field(seed=2), field("R22_S12")):
        assert not np.any(np.isin(other.holdout, stars.holdout))
        assert not np.any(np.isin(other.magnitude, stars.magnitude))


def test_quantities():
    bounds = [v * 1e3 * u.mm for v in BOUNDS]
    outline = CcdOutline("R22_S11", bounds, 10 * u.um)
    stars = make_star_field(outline, 100, 40, 1, fwhm=0.7 * u.arcsec, depth=Depth())
    np.testing.assert_allclose(stars.holdout, field().holdout, rtol=1e-12)  # the conversion's rounding
    np.testing.assert_allclose(stars.magnitude, field().magnitude, rtol=1e-12)


def test_no_stars():
    stars = field(n_holdout=0, n_observed=0)
    assert stars.holdout.shape == stars.observed.shape == (0, 2)
    assert stars.magnitude.shape == (0,)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"n_holdout": -1}, "n_holdout"),
        ({"n_observed": -1}, "n_observed"),
        ({"margin": 2048}, "margin"),
        ({"margin": -1}, "margin"),
        ({"bright": 20.0, "faint": 19.0}, "bright"),
        ({"exposure": 0.0}, "exposure"),
        ({"snr": -1.0}, "snr"),
        ({"pixel_size": 0.0}, "pixel_size"),
    ],
)
def test_bad_arguments(options, name):
    with pytest.raises(DomainError, match=name):
        field(**options)


def test_bad_bounds_and_band():
    for bounds in ((0.0, 1.0, 2.0), (1.0, 0.0, 0.0, 1.0), (0.0, np.nan, 0.0, 1.0)):
        with pytest.raises(DomainError, match="bounds"):
            CcdOutline("R22_S11", bounds, 1e-5)
    with pytest.raises(UnknownNameError, match="band"):
        field(band="x")
