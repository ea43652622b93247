"""Bases, interpolations, masks, weights, files: what the PSF model can do besides the paper's own way."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from pachon.core.errors import ConfigError, DomainError, ProductError
from pachon.reconstruction.psf_model.model import PsfModel
from pachon.reconstruction.psf_model.outliers import SigmaClipping
from pachon.reconstruction.psf_model.shapelets import shapelet_images

#: The recipe of the paper, where a test does not say otherwise.
fit = partial(PsfModel.fit, recipe="paper")
SIZE = 31
EXTENT = (0.0, 4000.0, 0.0, 4000.0)
WIDTH = 1.6
BASES = ("pca", "pixels", "shapelets")


def leaves(value):
    """The arrays of a model and of the objects in it."""
    if dataclasses.is_dataclass(value):
        return [leaf for field in dataclasses.fields(value) for leaf in leaves(getattr(value, field.name))]
    return [np.asarray(value)]


def positions(count, seed):
    return np.random.default_rng(seed).uniform(0.0, 4000.0, (count, 2))


def psf(places, seed=0, order=3, change=0.015):
    """Gauss-Hermite PSFs of unit sum, their shape a polynomial in position; in the span of every basis."""
    y, x = (np.mgrid[:SIZE, :SIZE] - SIZE // 2) / WIDTH
    base = np.exp(-0.5 * (x**2 + y**2))
    base /= base.sum()
    factors = (x, y, x**2 - y**2, x * y, x**2 + y**2, x**3 - 3 * x * y**2, 3 * x**2 * y - y**3)
    modes = np.stack([f * base - (f * base).sum() * base for f in factors])
    coefficients = np.random.default_rng(seed).normal(0.0, change, ((order + 1) * (order + 2) // 2, 7))
    u, v = places.T / 2000.0 - 1.0
    terms = [u**a * v**b for a in range(order + 1) for b in range(order + 1 - a)]
    return base + np.tensordot(np.stack(terms, axis=1) @ coefficients, modes, 1)


def noisy(count=40, sigma=2e-4, seed=0):
    places = positions(count, seed)
    return psf(places) + np.random.default_rng(seed + 50).normal(0.0, sigma, (count, SIZE, SIZE)), places


def rms(model, places, truth):
    return np.sqrt(((model.at(places) - truth) ** 2).mean())


ELSEWHERE = positions(200, 9)
TRUTH = psf(ELSEWHERE)
PEAK = TRUTH.max()


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("order", [1, 3, 5])
def test_recoverable_fields_are_recovered_in_every_basis(basis, order):
    places = positions(60, 1)
    fluxes = np.random.default_rng(3).uniform(1.0, 1e5, (60, 1, 1))
    model = fit(psf(places, order=order) * fluxes, places, basis=basis, order=order, extent=EXTENT)
    # Rounding only: 1e-6 is what is asked for, and nothing stands between.
    np.testing.assert_allclose(model.at(ELSEWHERE), psf(ELSEWHERE, order=order), atol=1e-11 * PEAK)
    np.testing.assert_allclose(model.leave_one_out(), psf(places, order=order), atol=1e-10 * PEAK)
    np.testing.assert_allclose(model.reconstruct(), psf(places, order=order), atol=1e-12 * PEAK)
    assert model.explained == pytest.approx(1.0, abs=1e-12)
    assert model.draw(300.0, 2000.0).tobytes() == model.at([[300.0, 2000.0]])[0].tobytes()
    assert model.draw(300.0, 2000.0).shape == (SIZE, SIZE)
    if basis == "shapelets":
        # Orders 0 and 3 at most: any other scale would leave something.
        assert model.basis.scale == pytest.approx(WIDTH, rel=1e-6)


def test_shapelets_are_gauss_hermite_functions():
    x = np.arange(41) - 20.0
    images = shapelet_images(10, (41, 41), 2.3)
    # H_3(t) = 8 t^3 - 12 t, with the norm of the harmonic oscillator (Refregier 2003, eq. 1 and 2).
    t = x / 2.3
    third = (8 * t**3 - 12 * t) * np.exp(-0.5 * t**2) / np.sqrt(2.0**3 * 6 * np.sqrt(np.pi) * 2.3)
    zeroth = np.exp(-0.5 * t**2) / np.sqrt(np.sqrt(np.pi) * 2.3)
    np.testing.assert_allclose(images[6], zeroth[:, None] * third[None, :], atol=1e-15)
    np.testing.assert_allclose(images[9], third[:, None] * zeroth[None, :], atol=1e-15)
    # Sums over pixels stand for integrals of these functions: orthonormal to rounding.
    flat = images.reshape(10, -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(10), atol=1e-12)


@pytest.mark.parametrize("size", [30, 31])
def test_shapelets_are_centred_where_stars_are(size):
    """On stamps of an even size they stood half a pixel beside the stars, and left eleven times as much."""
    y, x = np.mgrid[:size, :size] - size // 2
    places = positions(20, 2)
    width = 2.0 + 0.2 * places[:, 0] / 4000.0
    stars = np.exp(-0.5 * (x**2 + y**2) / width[:, None, None] ** 2)
    stars /= stars.sum(axis=(1, 2), keepdims=True)
    model = fit(stars, places, basis="shapelets", n_components=14, order=2, clipping=None)
    # Gaussians as much as a tenth wider or narrower than that of the basis: terms up to the fourth order leave 1e-5.
    assert np.sqrt(model.unexplained.mean() / size**2) < 1e-5 * stars.max()


def test_shapelets_truncate_the_wings():
    # Moffat wings fall as a power: whatever the scale, a Gaussian times a polynomial leaves part of them
    # (Jee & Tyson 2011, sec. 3), where the mean of the stars holds them.
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2
    places = positions(40, 2)
    width = 2.0 + 0.1 * places[:, 0] / 4000.0
    stars = (1.0 + (x**2 + y**2) / width[:, None, None] ** 2) ** -2.5
    stars /= stars.sum(axis=(1, 2), keepdims=True)
    wings = np.hypot(x, y) > 9.0
    left = {}
    for basis in ("pca", "shapelets"):
        model = fit(stars, places, basis=basis, clipping=None)
        left[basis] = np.abs((model.at(places) - stars)[:, wings]).sum(axis=1).mean()
        np.testing.assert_allclose(model.at(places).sum(axis=(1, 2)), 1.0, rtol=1e-12)
    assert left["shapelets"] > 1e-3 > 1e4 * left["pca"]


def test_given_scale_is_kept():
    stamps, places = noisy()
    assert fit(stamps, places, basis="shapelets", scale=1.9).basis.scale == 1.9
    chosen = fit(stamps, places, basis="shapelets")
    nearby = [
        fit(stamps, places, basis="shapelets", scale=chosen.basis.scale * f).unexplained.sum() for f in (0.98, 1.02)
    ]
    assert chosen.unexplained.sum() < min(nearby)


def test_pixels_are_all_principal_components():
    # Unweighted polynomials of every pixel are those of every principal component: both are linear in the stars.
    stamps, places = noisy()
    pixels = fit(stamps, places, basis="pixels", extent=EXTENT)
    components = fit(stamps, places, n_components=39, extent=EXTENT)
    np.testing.assert_allclose(pixels.at(ELSEWHERE), components.at(ELSEWHERE), atol=1e-13)
    np.testing.assert_allclose(pixels.leave_one_out(), components.leave_one_out(), atol=1e-13)
    # A pixel on its own, restated.
    unit = stamps / stamps.sum(axis=(1, 2), keepdims=True)
    u, v = places.T / 2000.0 - 1.0
    terms = np.stack([u**a * v**b for a in range(4) for b in range(4 - a)], axis=1)
    expected = terms @ np.linalg.lstsq(terms, unit[:, 15, 17], rcond=None)[0]
    np.testing.assert_allclose(pixels.at(places)[:, 15, 17], expected, atol=1e-14)


@pytest.mark.parametrize("basis", BASES)
def test_weighted_polynomials(basis):
    stamps, places = noisy()
    weights = np.random.default_rng(4).uniform(0.1, 3.0, 40)
    weights[5] = 0.0
    model = fit(stamps, places, basis=basis, weights=weights, extent=EXTENT)
    u, v = places.T / 2000.0 - 1.0
    terms = np.stack([u**a * v**b for a in range(4) for b in range(4 - a)], axis=1)
    root = np.sqrt(weights)[:, None]
    solution = np.linalg.lstsq(root * terms, root * model.coefficients, rcond=None)[0]
    np.testing.assert_allclose(model.amplitudes(places), terms @ solution, atol=1e-12)
    # Leaving star 11 out, by fitting without it.
    keep = np.arange(40) != 11
    without = np.linalg.lstsq((root * terms)[keep], (root * model.coefficients)[keep], rcond=None)[0]
    expected = model.mean + np.tensordot(terms[11] @ without, model.components, 1)
    np.testing.assert_allclose(model.leave_one_out()[11], expected, atol=1e-13)
    equal = fit(stamps, places, basis=basis, weights=np.full(40, 7.0), extent=EXTENT)
    plain = fit(stamps, places, basis=basis, extent=EXTENT)
    np.testing.assert_allclose(equal.at(ELSEWHERE), plain.at(ELSEWHERE), atol=1e-14)


@pytest.mark.long
@pytest.mark.parametrize("basis", BASES)
def test_masked_pixels_have_no_say(basis):
    places = positions(40, 1)
    stars = psf(places)
    rng = np.random.default_rng(5)
    masks = rng.random(stars.shape) < 0.05
    masks[7, :, 20:] = True  # a star at the edge of the CCD
    masks[9, 14:18, 14:18] = True  # and one with a saturated core
    junk = np.where(masks, rng.choice([np.nan, np.inf, -1e9, 3e4], stars.shape), stars)
    model = fit(junk * 1e4, places, basis=basis, masks=masks, extent=EXTENT)
    # Noise-free, so what the other stars say of a pixel is true: exact, but for the passes' own end at 1e-12.
    np.testing.assert_allclose(model.at(ELSEWHERE), TRUTH, atol=1e-9 * PEAK)
    np.testing.assert_allclose(model.reconstruct(), stars, atol=1e-9 * PEAK)
    assert model.n_rejected == 0
    other = fit(np.where(masks, 0.0, stars) * 1e4, places, basis=basis, masks=masks, extent=EXTENT)
    assert other.at(ELSEWHERE).tobytes() == model.at(ELSEWHERE).tobytes()
    none = fit(stars, places, basis=basis, masks=np.zeros(stars.shape, dtype=bool), extent=EXTENT)
    assert none.at(places).tobytes() == fit(stars, places, basis=basis, extent=EXTENT).at(places).tobytes()


def test_masks_cost_little_of_noisy_stars():
    stamps, places = noisy()
    masks = np.random.default_rng(6).random(stamps.shape) < 0.05
    plain = rms(fit(stamps, places, extent=EXTENT), ELSEWHERE, TRUTH)
    masked = rms(
        fit(np.where(masks, np.nan, stamps), places, masks=masks, extent=EXTENT),
        ELSEWHERE,
        TRUTH,
    )
    # 5 % less light, and corners where a pixel's nearest star is masked.
    assert masked < 1.15 * plain


# The mean in a struck pixel costs the star's own change there, which is seen where stars are quieter than any real one.
@pytest.mark.parametrize(
    ("replacement", "snr"),
    [(r, snr) for r in ("mean", "polynomial") for snr in (30.0, 100.0, 300.0, 1000.0)] + [("polynomial", 3500.0)],
)
def test_outliers_in_a_tenth_of_the_stars_change_the_error_by_less_than_a_tenth(replacement, snr):
    # Equal noise in as many pixels as a Gaussian star is worth, 4 pi sigma^2.
    sigma = 1.0 / (snr * np.sqrt(4.0 * np.pi) * WIDTH)
    clipping = SigmaClipping(replacement=replacement)
    for seed in range(3):
        stamps, places = noisy(sigma=sigma, seed=seed)
        rng = np.random.default_rng(70 + seed)
        hit = stamps.copy()
        for i in rng.choice(40, 4, replace=False):
            x, y = rng.integers(3, 28, 2)
            # Cosmic rays do not get fainter with the star.
            hit[i, y : y + 3, x] += rng.uniform(0.05, 0.3, 3) * max(1.0, 300.0 / snr)
        plain, struck, spoiled = (
            rms(
                fit(s, places, extent=EXTENT, clipping=clip),
                ELSEWHERE,
                TRUTH,
            )
            for s, clip in ((stamps, clipping), (hit, clipping), (hit, None))
        )
        assert abs(struck / plain - 1.0) < 0.1
        assert spoiled > (1.2 if snr == 30.0 else 1.5) * plain


def test_leave_one_out_of_fewer_components():
    stamps, places = noisy(80, sigma=1e-5)
    twenty = fit(stamps, places, extent=EXTENT)
    assert twenty.leave_one_out_curve.shape == (21,)
    assert twenty.leave_one_out_curve[-1] == pytest.approx(twenty.leave_one_out_rms, rel=1e-12)
    # The curve is that of fits with fewer components.
    five = fit(stamps, places, n_components=5, extent=EXTENT)
    assert twenty.leave_one_out_curve[5] == pytest.approx(five.leave_one_out_rms, rel=1e-9)
    short = twenty.truncated(5)
    np.testing.assert_allclose(short.unexplained, five.unexplained, rtol=1e-9)
    np.testing.assert_allclose(short.at(ELSEWHERE), five.at(ELSEWHERE), atol=1e-15)


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("interpolation", ["polynomial", "kriging"])
def test_files_are_lossless(tmp_path, basis, interpolation):
    stamps, places = noisy(25)
    weights = np.linspace(0.5, 2.0, 25) if interpolation == "polynomial" else None
    few = {} if basis == "pixels" else {"n_components": 3}
    model = fit(stamps, places, basis=basis, interpolation=interpolation, weights=weights, gain=None, **few)
    path = tmp_path / "model.fits"
    model.write(path)
    first = path.read_bytes()
    again = PsfModel.read(path)
    assert (type(again.basis), type(again.interpolation)) == (type(model.basis), type(model.interpolation))
    for one, other in zip(leaves(model), leaves(again), strict=True):
        assert (one.dtype, one.shape, one.tolist()) == (other.dtype, other.shape, other.tolist())
    assert again.at(ELSEWHERE).tobytes() == model.at(ELSEWHERE).tobytes()
    again.write(path)
    assert path.read_bytes() == first


def test_files_that_are_none(tmp_path):
    stamps, places = noisy()
    path = tmp_path / "model.fits"
    fit(stamps, places).write(path)
    whole = path.read_bytes()
    for end in (0, 100, 2880, 2880 * 4, len(whole) - 2880, len(whole) - 1):
        path.write_bytes(whole[:end])
        with pytest.raises(ProductError, match=r"model\.fits") as caught:
            PsfModel.read(path)
        assert "\n" not in str(caught.value)
    path.write_bytes(b"x, y\n1, 2\n" * 1000)
    with pytest.raises(ProductError, match=r"model\.fits: damaged or no FITS"):
        PsfModel.read(path)
    with pytest.raises(ProductError, match="no such file"):
        PsfModel.read(tmp_path / "nothing.fits")
    path.write_bytes(whole)
    with pytest.raises(ProductError, match=r"model\.fits: no PSF model 'R22_S11'"):
        PsfModel.read(path, "R22_S11")
    with pytest.raises(ProductError, match="cannot write"):
        PsfModel.read(path).write(tmp_path / "no" / "folder.fits")


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("interpolation", ["polynomial", "kriging"])
def test_splitting_changes_no_byte(basis, interpolation):
    stamps, places = noisy(30)
    few = {} if basis == "pixels" else {"n_components": 4}
    model = fit(stamps, places, basis=basis, interpolation=interpolation, gain=None, **few)
    whole = model.at(ELSEWHERE)
    for i in range(0, 200, 23):
        assert model.at(ELSEWHERE[i : i + 23]).tobytes() == whole[i : i + 23].tobytes()
    assert model.at(ELSEWHERE[3]).tobytes() == whole[3].tobytes()


@pytest.mark.long
@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"basis": "shapelets"}, marks=pytest.mark.slow),
        {"interpolation": "kriging", "gain": None},
        pytest.param({"masks": True}, marks=pytest.mark.slow),
        pytest.param({"n_components": "auto"}, marks=pytest.mark.slow),
    ],
)
def test_bytes_do_not_depend_on_blas_threads(options):
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:21, :21] - 10
    images = np.exp(-(x**2 + y**2) / 6) + 0.01 * rng.random((60, 21, 21))
    places, at = rng.random((60, 2)), rng.random((50, 2))
    if "masks" in options:
        options = {"masks": rng.random(images.shape) < 0.01}
    found = set()
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            model = PsfModel.fit(images, places, **({"recipe": "paper", "n_components": 3} | options))
            found.add(model.components.tobytes() + model.at(at).tobytes() + model.eigenvalues.tobytes())
    assert len(found) == 1


def test_bad_input_is_one_clear_line():
    stamps, places = noisy(20)

    def refused(error, match, stamps=stamps, places=places, **options):
        with pytest.raises(error, match=match) as caught:
            fit(stamps, places, **options)
        assert "\n" not in str(caught.value)

    refused(ConfigError, "n_components = 20: expected 1 to 19, no more than the stars")
    refused(ConfigError, "n_components = 'many'", n_components="many")
    refused(ConfigError, "n_components = 961: expected 1 to 960", basis="shapelets", n_components=961)
    refused(ConfigError, "n_components = 900: stamps of 31 x 31", basis="shapelets", n_components=900)
    refused(ConfigError, "n_components = 5: expected None", basis="pixels", n_components=5)
    refused(ConfigError, "order = 5: its 21 polynomial terms need as many stars, 20", n_components=3, order=5)
    refused(ConfigError, "basis = 'fourier': expected one of pca, pixels", basis="fourier")
    refused(ConfigError, "interpolation = 'spline'", interpolation="spline", n_components=3)
    with pytest.raises(ConfigError, match=r"^replacement = 'median': expected one of mean, polynomial"):
        SigmaClipping(replacement="median")
    refused(ConfigError, r"^replacement: no argument of .*; expected clipping=SigmaClipping", replacement="mean")
    refused(ConfigError, r"^clip_sigma: no argument of .*; expected clipping=SigmaClipping.* None", clip_sigma=None)
    refused(TypeError, r"fit\(\) got an unexpected keyword argument 'degree'", degree=2)
    refused(ConfigError, "scale = 2", scale=2.0, n_components=3)
    refused(ConfigError, "scale = -1", scale=-1.0, basis="shapelets")
    refused(DomainError, "stamps have shape", stamps=stamps[:0], places=places[:0])
    refused(DomainError, r"stamps\[3\] has pixels", np.where(np.arange(20)[:, None, None] == 3, np.nan, stamps))
    refused(DomainError, r"weights have shape \(3,\)", weights=[1, 2, 3], n_components=3)
    refused(DomainError, r"weights\[2\] = -1", weights=np.where(np.arange(20) == 2, -1.0, 1.0), n_components=3)
    refused(ConfigError, "recipe = 'plain': expected one of kriging, paper", recipe="plain")
    refused(ConfigError, "'gp': expected one of polynomial, kriging, which replaced gp", interpolation="gp")
    refused(ConfigError, "weights = 'bright': expected real numbers or noise", weights="bright", n_components=3)
    few = np.where(np.arange(20) < 9, 1.0, 0.0)
    refused(ConfigError, "10 polynomial terms need as many stars, 9", weights=few, n_components=3)
    masks = np.zeros(stamps.shape, dtype=bool)
    refused(DomainError, "masks have shape", masks=masks[:3], n_components=3)
    refused(DomainError, "masks = .*: expected an array of True and False", masks=masks.astype(int) - 1, n_components=3)
    refused(DomainError, "no star is left", masks=~masks, n_components=3)
    one = masks.copy()
    one[4] = True
    refused(DomainError, r"masks\[4\] masks the whole star", masks=one, n_components=3)
    pixel = masks.copy()
    pixel[:, 7, 30] = True
    refused(DomainError, r"pixel \[7, 30\] is masked in every star", masks=pixel, n_components=3)
    twice = places.copy()
    twice[9] = twice[2]
    refused(DomainError, "stars 2 and 9 are both at", stamps[:10], twice[:10], n_components=3)
    fit(stamps, twice, n_components=3)  # harmless where there are stars to spare


def test_truncated_refuses():
    stamps, places = noisy(20)
    with pytest.raises(ConfigError, match="n_components = 4: expected 1 to 3"):
        fit(stamps, places, n_components=3).truncated(4)
    with pytest.raises(ConfigError, match="n_components = 4"):
        fit(stamps, places, basis="pixels").truncated(4)
