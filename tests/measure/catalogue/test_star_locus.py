"""Stars among galaxies: the locus, its cuts, completeness and purity, stamps."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.table import Table

import pachon
from pachon.measure.catalogue.objects import DetectedObjects
from pachon.measure.catalogue.star_locus import StarCut

SIDE, RADIUS = 910, 2.4


def catalogue(n_stars=80, n_galaxies=400, seed=1):
    """Stars on a grid with a locus of 2 %, galaxies of many sizes, magnitudes of both, and which are stars."""
    rng = np.random.default_rng(seed)
    n = n_stars + n_galaxies
    star = np.arange(n) < n_stars
    snr = np.exp(rng.uniform(np.log(20.0), np.log(2000.0), n))
    radius = np.where(star, RADIUS, RADIUS * rng.uniform(1.0, 3.0, n)) * (1.0 + rng.normal(0.0, 0.02, n))
    radius *= 1.0 + rng.normal(0.0, 1.0, n) / snr
    e = np.where(star, 0.02, rng.uniform(0.0, 0.5, n))
    a = radius / 1.18 * (1.0 + e)
    order = rng.permutation(n)
    grid = np.stack(np.meshgrid(np.arange(30) * 30.0 + 20.0, np.arange(30) * 30.0 + 20.0), axis=-1).reshape(-1, 2)[:n]
    objects = DetectedObjects(
        x=grid[:, 0] + rng.uniform(-0.5, 0.5, n),
        y=grid[:, 1] + rng.uniform(-0.5, 0.5, n),
        flux=1e3 * snr[order],
        flux_error=np.full(n, 1e3),
        half_light_radius=radius[order],
        fwhm=2.0 * radius[order],
        a=a[order],
        b=(a * (1.0 - e) / (1.0 + e))[order],
        theta=np.full(n, 0.3),
        peak=np.ones(n),
        neighbour_distance=np.full(n, 30.0),
        flags=np.zeros(n, dtype=np.int32),
        segmentation=np.zeros((SIDE, SIDE), dtype=np.int32),
        background=np.full((SIDE, SIDE), 5.0),
    )
    return objects, star[order]


IMAGE = np.full((SIDE, SIDE), 5.0)


def test_the_locus_of_stars_among_five_times_as_many_galaxies():
    objects, star = catalogue()
    found = pachon.select_stars(objects, IMAGE)
    assert found.half_light_radius == pytest.approx(RADIUS, rel=0.01)
    # Of those that determine it, the S/N is 60 and up: a width of 2 % and a little.
    assert found.width == pytest.approx(0.02 * RADIUS, rel=0.35)
    assert found.completeness(star) > 0.95
    # Round galaxies as small as stars: a tenth of 400 within the locus, a fifth of them round enough.
    assert found.purity(star) > 0.8
    assert np.array_equal(found.snr, objects.snr[found.index])
    np.testing.assert_array_equal(found.positions[:, 0], objects.x[found.index])


def test_each_cut_has_its_bit():
    objects, _ = catalogue()
    chosen = pachon.select_stars(objects, IMAGE).index[:6]
    fields = {
        name: getattr(objects, name).copy()
        for name in ("flags", "flux", "half_light_radius", "fwhm", "a", "neighbour_distance")
    }
    fields["flags"][chosen[0]] = 2
    fields["flux"][chosen[1]] = 29.0 * 1e3
    fields["half_light_radius"][chosen[2]] *= 1.5
    fields["fwhm"][chosen[3]] *= 0.5
    fields["a"][chosen[4]] *= 1.6
    fields["neighbour_distance"][chosen[5]] = 11.0
    cuts = pachon.select_stars(replace(objects, **fields), IMAGE).cuts[chosen]
    expected = [StarCut.FLAGGED, StarCut.FAINT, StarCut.SIZE, StarCut.WIDTH, StarCut.SHAPE, StarCut.NEIGHBOUR]
    assert [int(c) for c in cuts] == [int(c) for c in expected]


def test_stars_with_spoilt_stamps_are_left_out():
    objects, _ = catalogue()
    first = pachon.select_stars(objects, IMAGE).index[:3]
    image, mask = IMAGE.copy(), np.zeros(IMAGE.shape, dtype=np.uint8)
    x, y = (np.rint(v[first]).astype(int) for v in (objects.x, objects.y))
    image[y[0] - 1 : y[0] + 2, x[0] - 2 : x[0] + 3] = np.nan  # most pixels within the half-light radius
    mask[y[1] - 2 : y[1] + 3, x[1] - 1 : x[1] + 2] = 8
    moved = objects.y.copy()
    moved[first[2]] = 14.0  # of 15 pixels below the middle of a stamp
    found = pachon.select_stars(replace(objects, y=moved), image, mask=mask)
    assert (found.cuts[first] == StarCut.FLAGGED).all()
    assert not set(first) & set(found.index)


def test_stars_with_masked_pixels_far_from_them_stay():
    objects, _ = catalogue()
    complete = pachon.select_stars(objects, IMAGE)
    assert complete.masks is None
    image, star = IMAGE.copy(), complete.index[0]
    x, y = round(objects.x[star]), round(objects.y[star])
    image[y + 11, x - 3] = -1e30
    masked = pachon.select_stars(objects, image)
    assert np.array_equal(masked.index, complete.index)
    rows, columns = np.nonzero(masked.masks[0])
    # The stamp is shifted by up to half a pixel, and what falls on a pixel by a tenth masks it.
    assert 1 <= len(rows) <= 4
    assert {15 + 11} <= set(rows) <= {15 + 10, 15 + 11, 15 + 12}
    assert {15 - 3} <= set(columns) <= {15 - 4, 15 - 3, 15 - 2}
    assert not masked.masks[1:].any()
    np.testing.assert_array_equal(masked.stamps, complete.stamps)  # filled from the other side: sky without noise
    assert np.array_equal(masked.without(np.arange(len(masked)) > 0).masks, masked.masks[:1])


def test_completeness_counts_stars_that_are_bright_enough():
    objects, star = catalogue()
    found = pachon.select_stars(objects, IMAGE, min_snr=200.0)
    bright = star & (objects.snr >= 200.0)
    assert found.completeness(star) == (found.cuts[bright] == 0).sum() / bright.sum()
    assert found.purity(star) == star[found.index].mean()
    assert np.isnan(found.completeness(np.zeros(len(star), dtype=bool)))


def test_no_locus_is_one_clear_line():
    objects, _ = catalogue(n_stars=5, n_galaxies=3)
    with pytest.raises(
        pachon.errors.DomainError, match=r"no stellar locus: \d bright objects without flags, expected at least 10"
    ):
        pachon.select_stars(objects, IMAGE)
    galaxies, _ = catalogue(n_stars=0)
    message = (
        r"no stellar locus: \d+ of \d+ bright objects within 8 % of a half-light radius of [\d.]+ pixels, expected"
    )
    with pytest.raises(pachon.errors.DomainError, match=message):
        pachon.select_stars(galaxies, IMAGE)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"min_snr": 0.0}, "min_snr = 0.0: expected a positive"),
        ({"n_sigma": np.nan}, "n_sigma = nan"),
        ({"size": 30}, "size = 30: expected an odd number"),
        ({"mask": np.zeros((9, 9))}, r"mask has shape \(9, 9\): expected \(910, 910\)"),
        ({"image": np.zeros((9, 9))}, r"image has shape \(9, 9\): expected \(910, 910\)"),
    ],
)
def test_bad_options(options, message):
    objects, _ = catalogue()
    with pytest.raises(pachon.errors.DomainError, match=message):
        pachon.select_stars(**({"objects": objects, "image": IMAGE} | options))


def test_bad_searches_of_the_locus():
    objects, _ = catalogue()
    with pytest.raises(pachon.errors.DomainError, match=r"^bright_snr = -1"):
        pachon.measure.LocusSearch(bright_snr=-1.0)
    with pytest.raises(pachon.errors.DomainError, match=r"^radius_range = 0"):
        pachon.measure.LocusSearch(radius_range=(0.0, 3.0))
    with pytest.raises(
        pachon.errors.ConfigError, match=r"^min_stars: no argument of .*; expected locus=LocusSearch\(min_s"
    ):
        pachon.select_stars(objects, IMAGE, min_stars=3)


def test_truth_of_another_shape():
    objects, star = catalogue()
    with pytest.raises(pachon.errors.DomainError, match="is_star has shape"):
        pachon.select_stars(objects, IMAGE).purity(star[1:])


@pytest.fixture(scope="module")
def starry():
    """An image of 36 stars and 36 galaxies of known places, and what select_stars makes of it."""
    rng = np.random.default_rng(3)
    side, sky = 420, 50.0
    at = np.stack(np.meshgrid(np.arange(6) * 70.0 + 35.0, np.arange(6) * 70.0 + 35.0), axis=-1).reshape(-1, 2)
    places = np.concatenate([at - 8.0, at + 24.0]) + rng.uniform(-0.5, 0.5, (72, 2))
    places = places[(places < side - 20).all(axis=1)]
    star = np.arange(len(places)) < 36
    width = np.where(star, 1.6, rng.uniform(2.2, 4.0, len(places)))
    flux = np.exp(rng.uniform(np.log(8e3), np.log(8e4), len(places)))
    yy, xx = np.indices((side, side))
    light = np.zeros((side, side))
    for (x, y), w, f in zip(places, width, flux, strict=True):
        light += f / (2.0 * np.pi * w**2) * np.exp(-0.5 * ((xx - x) ** 2 + (yy - y) ** 2) / w**2)
    variance = light + sky
    image = light + sky + rng.normal(size=light.shape) * np.sqrt(variance)
    objects = pachon.detect_objects(image, variance)
    return image, objects, pachon.select_stars(objects, image), places, star


def test_stars_of_an_image(starry):
    _, objects, stars, places, is_star = starry
    match = pachon.measure.match_positions(objects.x, objects.y, *places.T, 1.5)
    truth = (match >= 0) & is_star[match]
    assert truth.sum() == 36
    assert stars.completeness(truth) > 0.9
    assert stars.purity(truth) == 1.0


def test_stars_with_scattered_bad_pixels_are_those_of_the_complete_image(starry):
    image, _, complete, _, _ = starry
    mask = (np.random.default_rng(4).random(image.shape) < 0.02).astype(np.int32)
    objects = pachon.detect_objects(np.where(mask, np.nan, image), np.abs(image) + 1.0, mask)
    stars = pachon.select_stars(objects, image, mask=mask)
    assert len(stars) >= 0.9 * len(complete)
    match = pachon.measure.match_positions(*stars.positions.T, *complete.positions.T, 1.0)
    assert (match >= 0).all()
    good = ~stars.masks
    deviation = np.where(good, stars.stamps - complete.stamps[match], 0.0)
    # Fills leak into good pixels by the shift, less than noise does.
    assert np.sqrt((deviation**2).sum() / good.sum()) < 0.5 * np.sqrt(50.0)
    hidden = stars.stamps[stars.masks] - complete.stamps[match][stars.masks]
    assert abs(hidden.sum()) < 0.01 * complete.stamps.sum()


def test_stamps_are_centred_and_go_to_the_models(starry):
    _, objects, stars, _, _ = starry
    assert stars.stamps.shape == (len(stars), 31, 31)
    shapes = pachon.measure_shapes(stars.stamps, 1.0, 4.0)
    # Noise of a centroid at S/N 60 and up, twice: 0.06 pixels.
    assert np.abs(shapes.x).max() < 0.06
    assert np.abs(shapes.y).max() < 0.06
    np.testing.assert_allclose(stars.stamps.sum(axis=(1, 2)), objects.flux[stars.index], rtol=0.1)
    model = pachon.PsfModel.fit(stars.stamps, stars.positions, n_components=3, order=1)
    at = np.arange(31) - 15.0
    expected = np.exp(-0.5 * (at[:, None] ** 2 + at**2) / 1.6**2)
    np.testing.assert_allclose(model.at([[200.0, 200.0]])[0], expected / expected.sum(), rtol=0, atol=2e-3)
    table = Table(stars.positions, names=("x", "y"), units=(u.pix, u.pix))
    table["ccd"], table["snr"] = "R22_S11", stars.snr
    taken = pachon.FocalPlaneStars.from_table(table, stamps=stars.stamps, pixel_scale=0.2 * np.pi / 648000)
    assert taken.usable.all()
