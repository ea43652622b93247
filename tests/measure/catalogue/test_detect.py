"""Detected objects against closed forms of Gaussians, and their flags."""

import numpy as np
import pytest
from astropy.table import Table

import pachon
from pachon.core.table_files import write_table
from pachon.measure.catalogue.objects import ObjectFlag

SIDE, SIGMA, NOISE = 160, 2.0, 1.0
PLACES = np.array([[30.3, 40.8], [90.5, 35.2], [120.7, 120.1], [50.2, 110.6], [60.4, 75.0]])
FLUXES = np.array([2000.0, 5000.0, 20000.0, 60000.0, 4000.0])


def gaussian(x, y, flux, a=SIGMA, b=SIGMA, theta=0.0, side=SIDE):
    yy, xx = np.indices((side, side)) - np.array([y, x])[:, None, None]
    u, v = xx * np.cos(theta) + yy * np.sin(theta), yy * np.cos(theta) - xx * np.sin(theta)
    return flux / (2.0 * np.pi * a * b) * np.exp(-0.5 * ((u / a) ** 2 + (v / b) ** 2))


def image_of(places=PLACES, fluxes=FLUXES, seed=1):
    light = sum(gaussian(x, y, flux) for (x, y), flux in zip(places, fluxes, strict=True))
    return light + np.random.default_rng(seed).normal(0.0, NOISE, (SIDE, SIDE))


VARIANCE = np.full((SIDE, SIDE), NOISE**2)


@pytest.fixture(scope="module")
def found():
    sky = 200.0 + 0.1 * np.arange(SIDE)
    return pachon.detect_objects(image_of() + sky, VARIANCE, background_size=40)


def test_positions_fluxes_and_sizes_of_gaussians(found):
    index = pachon.measure.match_positions(found.x, found.y, *PLACES.T, 1.0)
    assert sorted(index) == [0, 1, 2, 3, 4]
    true = PLACES[index]
    # Errors of a centroid are 2 sigma / S/N or so: 0.2 pixels at worst.
    assert np.abs(found.x - true[:, 0]).max() < 0.15
    assert np.abs(found.y - true[:, 1]).max() < 0.15
    bright = FLUXES[index] > 1e4
    assert bright.sum() == 2
    assert np.hypot(found.x - true[:, 0], found.y - true[:, 1])[bright].max() < 0.02
    # A Kron aperture of 2.5 radii holds 94 to 100 % of a Gaussian.
    assert (np.abs(found.flux / FLUXES[index] - 0.98) < 0.05).all()
    np.testing.assert_allclose(found.half_light_radius[bright], np.sqrt(2.0 * np.log(2.0)) * SIGMA, rtol=0.03)
    np.testing.assert_allclose(found.fwhm[bright], np.sqrt(8.0 * np.log(2.0)) * SIGMA, rtol=0.02)
    np.testing.assert_allclose(found.magnitude(30.0), 30.0 - 2.5 * np.log10(found.flux), rtol=1e-12)
    assert (found.flags == 0).all()


@pytest.mark.parametrize("sigma", [1.5, 12.0, 20.0, 35.0])
def test_widths_of_small_and_large_objects(sigma):
    image = gaussian(200.3, 199.6, 1e7, sigma, sigma, side=400)
    noise = np.random.default_rng(2).normal(0.0, NOISE, image.shape)
    objects = pachon.detect_objects(image + noise, np.full_like(image, NOISE**2), background_size=None)
    np.testing.assert_allclose(objects.fwhm[objects.flux.argmax()], np.sqrt(8.0 * np.log(2.0)) * sigma, rtol=5e-3)


def test_flux_errors_are_those_of_the_aperture():
    # Twenty images: the scatter of a flux is known to 16 %.
    catalogues = [pachon.detect_objects(image_of(seed=s), VARIANCE, background_size=None) for s in range(20)]
    fluxes, errors = (np.array([c_values(c, name) for c in catalogues]) for name in ("flux", "flux_error"))
    assert np.median(fluxes.std(axis=0, ddof=1) / np.median(errors, axis=0)) == pytest.approx(1.0, abs=0.35)


def c_values(catalogue, name):
    """Values in the order of the places."""
    index = pachon.measure.match_positions(*PLACES.T, catalogue.x, catalogue.y, 1.0)
    return getattr(catalogue, name)[index]


def test_the_background_is_found(found):
    expected = 200.0 + 0.1 * np.arange(SIDE)
    assert np.abs(found.background - expected).max() < 3.0
    assert np.abs((found.background - expected).mean()) < 0.5


def test_segmentation_numbers_objects_in_order(found):
    assert set(np.unique(found.segmentation)) == set(range(len(found) + 1))
    at = np.rint(found.y).astype(int), np.rint(found.x).astype(int)
    assert found.segmentation[at].tolist() == list(range(1, len(found) + 1))


def test_shapes_of_elongated_objects():
    image = gaussian(80.2, 79.7, 1e6, 4.0, 2.0, 0.5) + np.random.default_rng(3).normal(0.0, NOISE, (SIDE, SIDE))
    found = pachon.detect_objects(image, VARIANCE, background_size=None)
    i = int(found.flux.argmax())
    # SEP takes moments on the filtered image: its kernel has a variance of half a pixel along x and y.
    a, b = np.sqrt(4.0**2 + 0.5), np.sqrt(2.0**2 + 0.5)
    e = (a - b) / (a + b)
    np.testing.assert_allclose([found.a[i], found.b[i]], [a, b], rtol=2e-3)
    np.testing.assert_allclose([found.e1[i], found.e2[i]], [e * np.cos(1.0), e * np.sin(1.0)], rtol=0, atol=1e-3)
    assert found.theta[i] == pytest.approx(0.5, abs=1e-3)


def test_flags_and_neighbours():
    places = np.array([[2.0, 50.0], [80.0, 80.0], [88.0, 80.0], [120.0, 40.0], [40.0, 130.0]])
    image = image_of(places, np.full(5, 1e4))
    mask = np.zeros(image.shape, dtype=np.int32)
    mask[38:43, 119:122] = 2
    mask[128:133, 35:38] = 1
    found = pachon.detect_objects(image, VARIANCE, mask, saturated=2, background_size=None)
    flags = [int(c_flag) for c_flag in found.flags[pachon.measure.match_positions(*places.T, found.x, found.y, 2.0)]]
    assert flags[0] == ObjectFlag.EDGE
    assert flags[1] & flags[2] & ObjectFlag.BLENDED
    assert flags[3] == ObjectFlag.SATURATED
    assert flags[4] == ObjectFlag.MASKED
    # The neighbour's light is none of the width: with it, the area above half the peak would be twice as large.
    pair = pachon.measure.match_positions(*places[1:3].T, found.x, found.y, 2.0)
    np.testing.assert_allclose(found.fwhm[pair], np.sqrt(8.0 * np.log(2.0)) * SIGMA, rtol=0.05)
    near = found.neighbour_distance[pachon.measure.match_positions([80.0, 120.0], [80.0, 40.0], found.x, found.y, 2.0)]
    # Each piece of a blend has some of the other's light.
    assert near[0] == pytest.approx(8.0, abs=0.4)
    assert near[1] == pytest.approx(np.hypot(32.0, 40.0), abs=0.1)


def test_scattered_bad_pixels_are_filled_by_their_objects():
    clean = image_of()
    mask = np.random.default_rng(2).random(clean.shape) < 0.03
    x, y = np.rint(PLACES).astype(int).T
    mask[y, x] = True  # the brightest pixel of each
    mask[:, x[3] + 1] = True
    complete = pachon.detect_objects(clean, VARIANCE, background_size=None)
    masked = pachon.detect_objects(np.where(mask, 1e5, clean), VARIANCE, mask, background_size=None)
    one, other = (pachon.measure.match_positions(*PLACES.T, o.x, o.y, 1.0) for o in (complete, masked))
    assert (masked.flags[other] == 0).all()
    pulls = (masked.flux[other] - complete.flux[one]) / complete.flux_error[one]
    assert np.abs(pulls).max() < 1.5
    assert (masked.flux_error[other] > 1.01 * complete.flux_error[one]).all()
    np.testing.assert_allclose(masked.half_light_radius[other], complete.half_light_radius[one], rtol=0.03)
    near = [(getattr(masked, name)[other], getattr(complete, name)[one]) for name in "xy"]
    # A centroid of S/N 60 has an error of 0.05 pixels.
    for values, expected in near:
        np.testing.assert_allclose(values, expected, rtol=0, atol=0.07)


def test_a_single_object_has_no_neighbour():
    found = pachon.detect_objects(gaussian(80.0, 80.0, 1e4), VARIANCE, background_size=None)
    assert found.neighbour_distance.tolist() == [np.inf]


def test_masked_pixels_may_hold_anything():
    image = image_of()
    mask = np.zeros(image.shape, dtype=bool)
    mask[5:9, 5:9] = True
    before = pachon.detect_objects(image, VARIANCE, mask)
    image[mask] = np.nan
    after = pachon.detect_objects(image, np.where(mask, -1.0, VARIANCE), mask)
    assert np.array_equal(before.flux, after.flux)
    assert np.array_equal(before.segmentation, after.segmentation)


def test_a_kernel_finds_fainter_objects():
    places = np.stack(np.meshgrid(np.arange(15, 150, 16), np.arange(15, 150, 16)), axis=-1).reshape(-1, 2) * 1.0
    image = image_of(places, np.full(len(places), 40.0), seed=4)
    at = np.arange(-4, 5)
    kernel = np.exp(-0.5 * (at[:, None] ** 2 + at**2) / SIGMA**2)
    plain, matched = (
        (pachon.measure.match_positions(c.x, c.y, *places.T, 2.0) >= 0).sum()
        for c in (
            pachon.detect_objects(image, VARIANCE, background_size=None, kernel=k, threshold=4.0, min_area=3)
            for k in (None, kernel)
        )
    )
    assert matched > 1.5 * plain


@pytest.mark.parametrize("ending", ["ecsv", "fits", "parquet"])
def test_tables(found, tmp_path, ending):
    if ending == "parquet":
        pytest.importorskip("pyarrow")
    table, path = found.table(zero_point=30.0), tmp_path / f"objects.{ending}"
    write_table(path, table)
    if ending == "parquet":
        from pyarrow import parquet

        columns = parquet.read_table(path).to_pydict()
    else:
        columns = Table.read(path, format="ascii.ecsv" if ending == "ecsv" else "fits")
        assert columns["theta"].unit == "rad"
        assert columns["x"].unit == "pix"
    for name in table.colnames:
        assert np.array_equal(np.asarray(columns[name]), np.asarray(table[name])), name
    if ending == "ecsv":
        assert all(columns[name].description for name in table.colnames)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": np.zeros((SIDE, SIDE))}, "no objects: expected 5 connected pixels above 3 standard deviations"),
        ({"image": np.full((SIDE, SIDE), np.nan)}, "mask: expected at least one pixel that is not masked, and finite"),
        ({"image": np.zeros(5)}, "image has shape"),
        ({"variance": np.ones((4, 4))}, r"variance has shape \(4, 4\)"),
        ({"variance": np.zeros((SIDE, SIDE))}, "expected positive where the mask is zero"),
        ({"mask": np.zeros((SIDE, SIDE))}, "mask has type float64: expected integers"),
        ({"mask": np.ones((SIDE, SIDE), dtype=int)}, "at least one pixel that is not masked"),
        ({"threshold": 0.0}, "threshold = 0.0: expected a positive"),
        ({"min_area": 0}, "min_area = 0: expected a whole number of at least 1"),
        ({"deblend_levels": 0}, "deblend_levels = 0: expected a whole number of at least 1"),
        ({"deblend_contrast": 2.0}, "deblend_contrast = 2.0: expected a number from 0 to 1"),
        ({"background_size": 0}, "background_size = 0: expected a whole number of at least 1"),
        ({"kernel": np.zeros((3, 3))}, "expected .* with a positive sum"),
    ],
)
def test_bad_input_is_one_clear_line(change, message):
    good = {"image": image_of(), "variance": VARIANCE}
    with pytest.raises(pachon.errors.DomainError, match=message) as caught:
        pachon.detect_objects(**(good | change))
    assert "\n" not in str(caught.value)


def test_zero_points_are_finite(found):
    with pytest.raises(pachon.errors.DomainError, match="zero_point = nan"):
        found.table(np.nan)
