import dataclasses
import os
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from astropy.io import fits

from pachon.core.errors import ConfigError, DomainError, ProductError
from pachon.reconstruction.psf_model.model import PsfModel
from pachon.reconstruction.psf_model.outliers import SigmaClipping

#: The recipe of the paper, where a test does not say otherwise.
fit = partial(PsfModel.fit, recipe="paper")
SIZE = 31
EXTENT = (-20.0, 20.0, 100.0, 140.0)


def profile(width=1.6):
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2
    image = np.exp(-0.5 * (x**2 + y**2) / width**2)
    return image / image.sum()


def modes(width=1.6):
    """Changes of shape that leave the sum: dipoles, quadrupoles, size and trefoils."""
    y, x = (np.mgrid[:SIZE, :SIZE] - SIZE // 2) / width
    base = profile(width)
    factors = (x, y, x**2 - y**2, x * y, x**2 + y**2, x**3 - 3 * x * y**2, 3 * x**2 * y - y**3)
    return np.stack([f * base - (f * base).sum() * base for f in factors])


def leaves(value):
    """The arrays of a model and of the objects in it."""
    if dataclasses.is_dataclass(value):
        return [leaf for field in dataclasses.fields(value) for leaf in leaves(getattr(value, field.name))]
    return [np.asarray(value)]


def positions(count, seed):
    rng = np.random.default_rng(seed)
    return np.stack([rng.uniform(EXTENT[0], EXTENT[1], count), rng.uniform(EXTENT[2], EXTENT[3], count)], axis=1)


def psf(places, seed=0, order=3, change=0.015):
    """PSFs of unit sum whose shape is a polynomial in position, restated here as plain monomials."""
    coefficients = np.random.default_rng(seed).normal(0.0, change, ((order + 1) * (order + 2) // 2, 7))
    u, v = places[:, 0] / 20.0, (places[:, 1] - 120.0) / 20.0
    terms = [u**a * v**b for a in range(order + 1) for b in range(order + 1 - a)]
    return profile() + np.tensordot(np.stack(terms, axis=1) @ coefficients, modes(), 1)


def noisy(count=40, sigma=2e-4, seed=0):
    places = positions(count, seed)
    return psf(places) + np.random.default_rng(seed + 50).normal(0.0, sigma, (count, SIZE, SIZE)), places


@pytest.mark.parametrize("change", [0.015, 0.15])  # by 13 % and by 130 % of the peak
@pytest.mark.parametrize("clip", [SigmaClipping(), None])
def test_cubic_field_is_recovered_between_the_stars(change, clip):
    elsewhere, peak = positions(200, 2), profile().max()
    truth = psf(elsewhere, change=change)
    for seed in (1, 3):
        places = positions(40, seed)
        fluxes = np.random.default_rng(3).uniform(1.0, 1e5, (40, 1, 1))
        model = fit(psf(places, change=change) * fluxes, places, extent=EXTENT, clipping=clip)
        assert model.n_rejected == 0
        # The field lies in the model's space: only rounding is left, enlarged where the stars leave a corner empty.
        np.testing.assert_allclose(model.at(elsewhere), truth, atol=1e-12 * peak)
        np.testing.assert_allclose(model.at(elsewhere).sum(axis=(1, 2)), 1.0, rtol=1e-12)
        assert model.explained == pytest.approx(1.0, abs=1e-12)
        assert model.leave_one_out_rms < 1e-12 * peak
    # Without an extent the positions are mapped differently, but onto the same polynomials.
    places = positions(40, 1)
    other = fit(psf(places, change=change), places, clipping=clip)
    np.testing.assert_allclose(other.at(elsewhere), truth, atol=1e-11 * peak)


def test_too_low_an_order_leaves_something():
    places, elsewhere = positions(60, 1), positions(100, 2)
    error = [
        np.abs(fit(psf(places), places, order=n, clipping=None).at(elsewhere) - psf(elsewhere)).max() for n in (1, 2, 3)
    ]
    assert error[0] > error[1] > 1e-3 * profile().max() > 1e6 * error[2]


def test_twenty_components_hold_the_variance_of_smooth_stars():
    # A PSF that is no finite sum of modes: width, stretch and centre change smoothly, not as polynomials.
    places = positions(100, 4)
    u, v = places[:, 0] / 20.0, (places[:, 1] - 120.0) / 20.0
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2
    width = (1.6 + 0.2 * np.sin(2 * u))[:, None, None]
    stretch = (1.0 + 0.1 * np.cos(3 * v + u))[:, None, None]
    shift = (0.1 * np.sin(4 * v))[:, None, None]
    stamps = np.exp(-0.5 * (((x - shift) * stretch) ** 2 + (y / stretch) ** 2) / width**2)
    model = fit(stamps, places, extent=EXTENT, order=4, clipping=None)
    assert model.explained > 0.99
    np.testing.assert_allclose(model.explained, model.explained_variance.sum(), rtol=1e-14)


def test_components_are_an_ordered_basis():
    stamps, places = noisy()
    model = fit(stamps, places, extent=EXTENT)
    flat = model.components.reshape(20, -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(20), atol=1e-13)
    assert np.all(flat[np.arange(20), np.abs(flat).argmax(axis=1)] > 0.0)
    assert np.all(np.diff(model.eigenvalues) <= 0.0)
    assert model.eigenvalues.shape == (39,)
    # The covariance of the stamps, directly: its trace, and the variance along each component.
    unit = stamps / stamps.sum(axis=(1, 2), keepdims=True)
    deviations = (unit - unit.mean(axis=0)).reshape(40, -1)
    np.testing.assert_allclose(model.eigenvalues.sum(), (deviations**2).sum() / 39, rtol=1e-12)
    np.testing.assert_allclose((deviations @ flat.T).var(axis=0, ddof=1), model.eigenvalues[:20], rtol=1e-10)
    np.testing.assert_allclose(model.mean, unit.mean(axis=0), atol=1e-16)
    # Own projections: everything but what lies outside the components.
    leftover = ((unit - model.reconstruct()) ** 2).sum(axis=(1, 2))
    np.testing.assert_allclose(leftover, model.unexplained, rtol=1e-9)
    full = fit(stamps, places, n_components=39)
    np.testing.assert_allclose(full.reconstruct(), unit, atol=1e-15)


def test_polynomials_are_unweighted_least_squares():
    stamps, places = noisy()
    model = fit(stamps, places, extent=EXTENT)
    u, v = places[:, 0] / 20.0, (places[:, 1] - 120.0) / 20.0
    terms = np.stack([u**a * v**b for a in range(4) for b in range(4 - a)], axis=1)
    solution = np.linalg.lstsq(terms, model.coefficients, rcond=None)[0]
    scale = np.abs(model.coefficients).max()
    np.testing.assert_allclose(model.amplitudes(places), terms @ solution, atol=1e-12 * scale)
    # Residuals of a fit with a constant sum to zero over the CCD: the reason why they flatter.
    np.testing.assert_allclose((model.coefficients - model.amplitudes(places)).sum(axis=0), 0.0, atol=1e-12 * scale)


def test_leave_one_out_equals_fitting_without_the_star():
    stamps, places = noisy()
    model = fit(stamps, places, extent=EXTENT, n_components=5)
    u, v = places[:, 0] / 20.0, (places[:, 1] - 120.0) / 20.0
    terms = np.stack([u**a * v**b for a in range(4) for b in range(4 - a)], axis=1)
    predicted = model.leave_one_out()
    for i in (0, 11, 39):
        keep = np.arange(40) != i
        solution = np.linalg.lstsq(terms[keep], model.coefficients[keep], rcond=None)[0]
        expected = model.mean + np.tensordot(terms[i] @ solution, model.components, 1)
        np.testing.assert_allclose(predicted[i], expected, atol=1e-13)
    unit = stamps / stamps.sum(axis=(1, 2), keepdims=True)
    assert model.leave_one_out_rms == pytest.approx(np.sqrt(((unit - predicted) ** 2).mean()), rel=1e-10)
    in_the_fit = np.sqrt(((unit - model.at(places)) ** 2).mean())
    assert model.leave_one_out_rms > in_the_fit
    exact = fit(stamps[:10], places[:10], n_components=2)  # ten stars, ten terms
    assert np.isnan(exact.leave_one_out()).all()


def test_cosmic_rays_change_little():
    # One star in ten has three struck pixels, off by a few tenths of its flux.
    stamps, places = noisy()
    elsewhere = positions(100, 9)
    truth = psf(elsewhere)
    with_rays = stamps.copy()
    rng = np.random.default_rng(7)
    struck = rng.choice(40, 4, replace=False)
    for i in struck:
        x, y = rng.integers(3, 28, 2)
        with_rays[i, y : y + 3, x] += rng.uniform(0.05, 0.3, 3)
    cleaned_stars = fit(stamps, places, extent=EXTENT)
    model = fit(with_rays, places, extent=EXTENT)
    unclipped = fit(with_rays, places, extent=EXTENT, clipping=None)

    def rms(m):
        return np.sqrt(((m.at(elsewhere) - truth) ** 2).mean())

    assert model.rejected[struck].min() >= 3
    assert model.n_rejected <= 16  # 5 sigma of 38 000 pixels: none but the cosmic rays and a few by bad luck
    assert rms(model) < 1.3 * rms(cleaned_stars)
    assert rms(unclipped) > 5.0 * rms(cleaned_stars)


@pytest.mark.parametrize("fraction", [0.01, 0.05])
def test_bad_pixels_in_every_star(fraction):
    stamps, places = noisy(sigma=1e-4)
    elsewhere = positions(100, 9)
    truth = psf(elsewhere)
    rng = np.random.default_rng(8)
    bad = rng.random(stamps.shape) < fraction
    struck = np.where(bad, rng.uniform(0.0, 0.1, stamps.shape), stamps)  # up to 1.6 times the peak

    def rms(pixels, clip):
        model = fit(pixels, places, extent=EXTENT, n_components=7, clipping=clip)
        return np.sqrt(((model.at(elsewhere) - truth) ** 2).mean())

    # The bad pixels that are found get the mean PSF, which costs the star's own change there: a small part of the
    # change that the model is to follow, where without rejection far more than all of it is lost.
    change = np.sqrt(((truth - truth.mean(axis=0)) ** 2).mean())
    assert rms(struck, SigmaClipping()) < 0.5 * change
    assert rms(struck, None) > 5.0 * change


def test_order_of_the_stars_does_not_matter():
    stamps, places = noisy()
    shuffle = np.random.default_rng(1).permutation(40)
    one = fit(stamps, places, extent=EXTENT)
    other = fit(stamps[shuffle], places[shuffle], extent=EXTENT)
    # Rounding of the SVD, enlarged by the small gaps between eigenvalues of noise.
    np.testing.assert_allclose(other.mean, one.mean, atol=1e-16)
    np.testing.assert_allclose(other.components, one.components, atol=1e-9)
    np.testing.assert_allclose(other.coefficients, one.coefficients[shuffle], atol=1e-11)
    np.testing.assert_allclose(other.at(places), one.at(places), atol=1e-14)


def test_same_bytes_and_splitting():
    stamps, places = noisy()
    one, other = (fit(stamps, places, extent=EXTENT) for _ in range(2))
    for first, second in zip(leaves(one), leaves(other), strict=True):
        assert first.tobytes() == second.tobytes()
    elsewhere = positions(37, 5)
    whole = one.at(elsewhere)
    for i in range(0, 37, 5):
        assert one.at(elsewhere[i : i + 5]).tobytes() == whole[i : i + 5].tobytes()
    assert one.at(elsewhere[3]).tobytes() == whole[3].tobytes()


@pytest.mark.slow
def test_bytes_do_not_depend_on_blas_threads():
    code = (
        "import numpy as np, zlib; from pachon import PsfModel; g = np.random.default_rng(0);"
        "m = PsfModel.fit(1 + g.random((150, 31, 31)), g.random((150, 2)), recipe='paper');"
        "print(zlib.crc32(m.components.tobytes() + m.interpolation.polynomial.tobytes() + m.eigenvalues.tobytes()))"
    )
    sums = {
        subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "OPENBLAS_NUM_THREADS": n},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for n in ("1", "2")
    }
    assert len(sums) == 1


def test_elbow_is_where_the_eigenvalues_flatten():
    rng = np.random.default_rng(2)
    patterns = rng.normal(size=(SIZE * SIZE, 5))
    basis = np.linalg.qr(patterns - patterns.mean(axis=0))[0].T.reshape(
        5, SIZE, SIZE
    )  # sums of zero, so unit sums stay
    amplitudes = rng.normal(size=(80, 5)) * np.array([5.0, 4.0, 3.0, 2.5, 2.0]) * 1e-2
    noise = rng.normal(0.0, 1e-5, (80, SIZE, SIZE))
    noise -= noise.mean(axis=(1, 2), keepdims=True)  # else the normalisation makes of its sum a sixth component
    stamps = profile() + np.tensordot(amplitudes, basis, 1) + noise
    assert fit(stamps, positions(80, 1), clipping=None).elbow == 5


def test_equal_stars_have_no_variance():
    model = fit(np.repeat(profile()[None] * 2.0**10, 15, axis=0), positions(15, 1), n_components=3)
    assert model.explained == pytest.approx(0.0, abs=1e-12) or model.eigenvalues.max() < 1e-30
    np.testing.assert_allclose(model.at(positions(5, 2)), np.repeat(profile()[None], 5, axis=0), atol=1e-16)


@pytest.mark.parametrize("n_components", [1, 20])
def test_fits_round_trip_is_lossless(tmp_path, n_components):
    stamps, places = noisy()
    model = fit(stamps, places, extent=(-20.1, 20.3, 99.7, 140.9), n_components=n_components)
    path = tmp_path / "model.fits"
    fits.HDUList([fits.PrimaryHDU(), *model.to_hdus("R22_S11")]).writeto(path)
    with fits.open(path) as hdus:
        again = PsfModel.from_hdus(hdus, "R22_S11")
        with pytest.raises(ProductError, match="'R22_S12'"):
            PsfModel.from_hdus(hdus, "R22_S12")
    pairs = zip(leaves(model), leaves(again), strict=True)
    for first, second in pairs:
        assert first.dtype == second.dtype
        assert first.shape == second.shape
        assert first.tobytes() == second.tobytes()
    assert again.at(places).tobytes() == model.at(places).tobytes()
    in_memory = PsfModel.from_hdus(model.to_hdus())
    assert in_memory.components.tobytes() == model.components.tobytes()


def test_bad_arguments():
    stamps, places = noisy(12)
    with pytest.raises(ConfigError, match=r"n_components = 12: expected 1 to 11, .*\(12\)"):
        fit(stamps, places, n_components=12)
    with pytest.raises(ConfigError, match="n_components = 0"):
        fit(stamps, places, n_components=0)
    with pytest.raises(ConfigError, match="order = 4: its 15 polynomial terms need as many stars, 12 given"):
        fit(stamps, places, n_components=3, order=4)
    with pytest.raises(ConfigError, match="order = -1"):
        fit(stamps, places, n_components=3, order=-1)
    with pytest.raises(ConfigError, match="order = -1: expected a polynomial order from 0"):
        fit(stamps, places, n_components=3, interpolation="kriging", order=-1)
    with pytest.raises(ConfigError, match=r"^sigma = 0\.0: expected a positive number"):
        SigmaClipping(0.0)
    with pytest.raises(ConfigError, match=r"^max_iterations = 0: expected at least 1"):
        SigmaClipping(max_iterations=0)
    line = np.stack([np.linspace(0, 1, 12), np.linspace(0, 1, 12)], axis=1)
    with pytest.raises(DomainError, match="do not determine"):
        fit(stamps, line, n_components=3)
    with pytest.raises(DomainError, match="positions: 11 given"):
        fit(stamps, places[:11], n_components=3)
    with pytest.raises(DomainError, match=r"positions\[2\]"):
        fit(stamps, np.where(np.arange(12)[:, None] == 2, np.nan, places), n_components=3)
    with pytest.raises(DomainError, match=r"stamps\[4\] has pixels"):
        fit(np.where(np.arange(12)[:, None, None] == 4, np.nan, stamps), places, n_components=3)
    with pytest.raises(DomainError, match=r"stamps\[5\] has no light"):
        fit(np.where(np.arange(12)[:, None, None] == 5, 0.0, stamps), places, n_components=3)
    with pytest.raises(DomainError, match="stamps have shape"):
        fit(stamps[0], places, n_components=3)
    with pytest.raises(DomainError, match="stamps"):
        fit("stars", places, n_components=3)
    for extent in ((0.0, 1.0), (1.0, 0.0, 0.0, 1.0), (0.0, np.nan, 0.0, 1.0), "all"):
        with pytest.raises(DomainError, match="extent"):
            fit(stamps, places, n_components=3, extent=extent)
    far = np.where(np.arange(12)[:, None] == 3, 1e9, places)
    with pytest.raises(DomainError, match=r"positions: star 3 at .* is .* times the extent away from its middle"):
        fit(stamps, far, n_components=3, extent=(-1.0, 1.0, -1.0, 1.0))
    model = fit(stamps, places, n_components=3)
    with pytest.raises(DomainError, match="positions"):
        model.at(np.zeros((3, 3)))
    with pytest.raises(DomainError, match="positions"):
        model.at("here")
