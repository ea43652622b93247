"""PSF models of stars from other programs: what is kept, how well held-out stars are predicted, and the command."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from matplotlib.figure import Figure

import pachon
from pachon import PsfModel
from pachon.commands.cli import main
from pachon.core.errors import ConfigError, DomainError
from pachon.measure.pixel_masks import clipped_stars
from pachon.measure.shapes import measure_shapes
from pachon.measure.star_selection import StarFlag
from pachon.reconstruction.own_stars.own_stars import fit_own_stars
from pachon.reconstruction.own_stars.star_catalogue import StarCutouts, load_stars
from pachon.reconstruction.stamp_gallery import StampGallery

PIXEL = np.deg2rad(0.2 / 3600.0)
SIZE, SKY, COUNT = 33, 22.0, 60


def profiles(positions, dx, dy):
    """Moffat profiles of unit sum whose shape changes linearly over 4000 pixels, at places within a pixel."""
    y, x = np.indices((SIZE, SIZE)) - SIZE // 2
    u, v = (positions.T / 2000.0 - 1.0)[:, :, None, None]
    x, y = x - dx[:, None, None], y - dy[:, None, None]
    square = x**2 * (1 - 0.02 * u) + y**2 * (1 + 0.02 * u) - 0.04 * v * x * y
    images = (1.0 + square / (2.8 * (1.0 + 0.01 * u)) ** 2) ** -3
    return images / images.sum(axis=(1, 2), keepdims=True)


@pytest.fixture(scope="module")
def stars():
    """Sixty stars in electrons over a background, one hit by a cosmic ray, one with a neighbour, one too faint."""
    rng = np.random.default_rng(4)
    positions = rng.uniform(1.0, 4000.0, (COUNT, 2))
    electrons = 5000.0 * 10.0 ** rng.uniform(0.3, 1.5, COUNT)
    electrons[5] = 1500.0
    light = electrons[:, None, None] * profiles(positions, *rng.uniform(-0.5, 0.5, (2, COUNT)))
    light[7] += 0.4 * np.roll(light[7], (7, 4), axis=(0, 1))
    stamps = light + rng.normal(size=light.shape) * np.sqrt(SKY**2 + light)
    stamps[9, 12:14, 20] += 0.6 * stamps[9].max()
    return StarCutouts(stamps + 300.0, positions)


@pytest.fixture(scope="module")
def own(stars):
    return fit_own_stars(*stars, PIXEL)


def test_stars_with_defects_are_masked_and_faint_ones_left_out(own):
    assert own.flags[7] & StarFlag.NEIGHBOUR
    assert own.flags[9] & StarFlag.COSMIC_RAY
    assert own.snr[5] < 20.0
    assert set(np.flatnonzero(~own.used)) == {5}
    masks = own.masks[np.searchsorted(np.flatnonzero(own.used), [7, 9])]
    centre = own.masks.shape[1] // 2
    assert masks[0, centre + 7, centre + 4]  # the middle of the neighbour
    assert masks[1, 12 - 16 + centre : 14 - 16 + centre, 20 - 16 + centre].all()  # the cosmic ray
    assert not masks[:, centre, centre].any()
    assert np.isfinite(own.held_out.e1[[7, 9]]).all()
    table = own.table()
    assert table["masked"][5] == -1
    assert table["masked"][7] == masks[0].sum()


def test_the_model_is_that_of_the_truth_between_the_stars(own):
    rng = np.random.default_rng(8)
    places = rng.uniform(200.0, 3800.0, (80, 2))
    truth = profiles(places, *np.zeros((2, 80)))
    drawn = own.model.at(places)
    rim = (SIZE - drawn.shape[1]) // 2
    made, true = (measure_shapes(i, PIXEL, own.weight_fwhm) for i in (drawn, truth[:, rim:-rim, rim:-rim]))
    noise = own.summary()["rms_e_noise"]
    assert np.sqrt(np.mean((made.e1 - true.e1) ** 2 + (made.e2 - true.e2) ** 2) / 2.0) < 0.35 * noise
    assert np.std(true.e1) > 0.5 * noise, "the field varies"
    assert np.sqrt(np.mean((made.size / true.size - 1.0) ** 2)) < 0.006


def test_a_neighbour_cut_by_the_edge_of_a_stamp_leaves_the_star_as_it_is(stars, own):
    """Its sharp edge would ring along whole rows when the star is centred."""
    yy, xx = np.indices((SIZE, SIZE))
    stamps = stars.stamps.copy()
    stamps[20] += 5000.0 * np.exp(-((xx - SIZE) ** 2 + (yy - 19.0) ** 2) / (2.0 * 2.0**2))
    found = fit_own_stars(stamps, stars.positions, PIXEL)
    assert found.flags[20] & StarFlag.NEIGHBOUR
    assert found.used[20]
    number = int(np.flatnonzero(found.used).searchsorted(20))
    rim = np.s_[:, :-12]  # free of the neighbour
    difference = found.stamps[number][rim] - own.stamps[int(np.flatnonzero(own.used).searchsorted(20))][rim]
    # Below the noise of a pixel, and a tenth of the ringing.
    assert np.sqrt(np.mean(difference**2)) < 0.5 * SKY / own.electrons[number]


def test_clipped_stars_are_left_out_without_a_level_of_saturation(stars, own):
    """Where three pixels of a star have exactly its greatest value; those with fewer of that value are clipped too."""
    level = np.sort(stars.stamps.max(axis=(1, 2)))[-6]
    clipped = (stars.stamps >= level).any(axis=(1, 2))
    found = fit_own_stars(np.minimum(stars.stamps, level), stars.positions, PIXEL)
    assert ((found.flags & StarFlag.SATURATED) > 0).tolist() == clipped.tolist()
    assert not found.used[clipped].any()
    # Not where a level is given, nor in images without noise, whose stars may have equal pixels about a corner.
    unclipped = fit_own_stars(np.minimum(stars.stamps, level), stars.positions, PIXEL, saturation=10.0 * level)
    assert ((unclipped.flags & StarFlag.SATURATED) > 0).sum() < clipped.sum()
    assert not clipped_stars(np.ones((5, 9, 9)), np.zeros((5, 9, 9), dtype=bool)).any()


def test_stars_of_which_most_are_clipped_at_one_level_are_not_without_noise(stars):
    peaks = stars.stamps.max(axis=(1, 2))
    level = np.quantile(peaks, 0.3)
    clipped = clipped_stars(np.minimum(stars.stamps, level), np.zeros(stars.stamps.shape, dtype=bool))
    assert clipped.tolist() == (peaks >= level).tolist()
    # Symmetric stars without noise have four equal pixels each.
    squares = np.add.outer(*2 * [(np.arange(8) - 3.5) ** 2])
    symmetric = np.exp(-0.2 * squares) * np.ones((9, 1, 1))
    assert not clipped_stars(symmetric, np.zeros(symmetric.shape, dtype=bool)).any()


def test_residuals_of_held_out_stars_are_their_noise(own):
    d1, d2, size = own.residuals()
    assert 0.8 < np.std(np.concatenate([d1, d2]) / np.tile(own.sigma_e, 2)) < 1.35
    assert 0.8 < np.std(size / own.sigma_size) < 1.35
    rho = own.rho_statistics()
    assert abs(np.nanmean(rho.rho1.xi_plus)) < 0.2 * own.summary()["rms_e"] ** 2
    with pytest.raises(DomainError, match="bins = 1001: expected a whole number of at most 1000"):
        own.rho_statistics(1001)
    with pytest.raises(DomainError, match=r"positions: the stars lie within .* rad; expected 1e-10 to 6.283 rad"):
        replace(own, positions=1e-60 * own.positions).rho_statistics()


def test_g_of_the_table_is_that_of_hsm(own):
    """The weighted e is about half of it: a user who measures the stamps elsewhere must find the table's numbers."""
    galsim = pytest.importorskip("galsim")
    table = own.table()
    used = np.flatnonzero(own.used)
    for images, start in ((own.stamps, ""), (own.predicted, "held_out_")):
        for row, image in zip(used[::9], images[::9], strict=True):
            moments = galsim.hsm.FindAdaptiveMom(galsim.Image(image))
            expected = [moments.observed_shape.g1, moments.observed_shape.g2, moments.moments_sigma * 0.2]
            # Both iterate until steps are below 1e-6.
            assert [table[start + name][row] for name in ("g1", "g2", "sigma")] == pytest.approx(expected, abs=2e-6)
    assert np.isnan(table["g1"][5])
    residual = np.stack([table[f"g{i}"] - table[f"held_out_g{i}"] for i in (1, 2)])[:, used]
    assert own.summary()["rms_g_held_out"] == pytest.approx(np.sqrt((residual**2).mean()))


@pytest.mark.long
def test_the_parts_held_out_are_those_of_the_seed(stars, own):
    options = {"basis": "pixels", "interpolation": "polynomial", "order": 1, "weights": "noise"}
    one, again, other = (fit_own_stars(*stars, PIXEL, seed=seed, **options) for seed in (1, 1, 2))
    assert np.array_equal(again.predicted, one.predicted)
    assert np.array_equal(other.model.at((5.0, 5.0)), one.model.at((5.0, 5.0)))
    assert not np.array_equal(other.predicted, one.predicted)
    assert (one.kind, own.kind) == ("given", "kriging of pixels")
    assert (one.model.order, one.model.interpolation.name) == (1, "polynomial")


def test_names_of_columns_of_sextractor(stars, tmp_path):
    stamps = stars.stamps.copy()
    stamps[3, 0, 0] = -1e30
    header = Table({"Field Header Card": np.array(["SIMPLE  =  T"])})
    table = Table({"XWIN_IMAGE": stars.positions[:, 0], "YWIN_IMAGE": stars.positions[:, 1], "VIGNET": stamps})
    parts = [fits.PrimaryHDU(), fits.table_to_hdu(header), fits.table_to_hdu(table)]
    fits.HDUList(parts).writeto(tmp_path / "ldac.cat")
    found = load_stars(tmp_path / "ldac.cat")
    assert np.array_equal(found.positions, stars.positions)
    assert np.isnan(found.stamps[3, 0, 0])
    assert np.array_equal(found.stamps[4], stars.stamps[4])
    assert fit_own_stars(*found, PIXEL, interpolation="polynomial", order=0).used[3]


@pytest.mark.long
def test_the_command_leaves_model_picture_and_table(stars, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    stamps = stars.stamps.copy()
    stamps[2, 5, 5] = np.nan
    stamps[3, 14:19, 14:19] = -1e30
    Table({"x": stars.positions[:, 0], "y": stars.positions[:, 1], "stamp": stamps}).write("stars.fits")
    assert main(["model", "stars.fits", "--json", "--picture", "stars_psf.png"]) == 0
    found = json.loads(capsys.readouterr().out)
    # Without the faint one, and the one whose core is masked.
    assert (found["stars"], found["used"]) == (COUNT, COUNT - 2)
    assert (found["flagged"]["cosmic_ray"], found["flagged"]["masked"]) == (1, 1)
    assert PsfModel.read("stars_psf.fits").draw(2000.0, 2000.0).sum() == pytest.approx(1.0)
    assert (tmp_path / "stars_psf.png").read_bytes().startswith(b"\x89PNG")
    table = Table.read("stars_psf.ecsv")
    assert len(table) == COUNT
    assert np.isnan(table["held_out_e1"][5])


@pytest.mark.parametrize("options", [{}, {"interpolation": "polynomial", "order": 0}])
def test_stars_listed_twice_are_refused(stars, options):
    """The message counted among those used; polynomials took them, and predicted each star from its double."""
    rows = np.append(np.arange(30), [7, 12])
    with pytest.raises(DomainError, match=r"positions: 2 of 31 stars stand there twice, such as that at \(\d+\.?\d*, "):
        fit_own_stars(stars.stamps[rows], stars.positions[rows], PIXEL, **options)


@pytest.mark.parametrize("empty", [(), (3,)])
def test_stars_that_all_have_neighbours_are_masked(stars, empty):
    """Of a crowded field none was left; with one star without a neighbour all were used. A lost stamp has no place."""
    rng = np.random.default_rng(5)
    stamps = stars.stamps[10:30] - 300.0
    for stamp, (row, column) in zip(stamps, rng.choice([-10, 10], (20, 2)), strict=True):
        stamp += 0.5 * np.roll(stamp, (row, column), axis=(0, 1))
    stamps[list(empty)] = rng.normal(0.0, SKY, (len(empty), SIZE, SIZE))
    own = fit_own_stars(stamps, stars.positions[10:30], PIXEL, interpolation="polynomial", order=0)
    assert (own.flags[own.used] & StarFlag.NEIGHBOUR).all()
    assert own.used.sum() >= 18
    alone = fit_own_stars(stars.stamps[10:30], stars.positions[10:30], PIXEL, interpolation="polynomial", order=0)
    sizes = [pachon.adaptive_moments(fit.model.at([[2e3, 2e3]]), PIXEL).T[0] for fit in (own, alone)]
    assert sizes[0] == pytest.approx(sizes[1], rel=5e-3)


@pytest.mark.parametrize("level", [300.3, 300.45])
def test_stamps_of_whole_numbers(stars, level):
    """As cameras write them: medians of whole numbers as sky made models 1 % too large, and S/N 15 % wrong."""
    light = (stars.stamps[10:30] - 300.0) / 40.0 + level
    fits = [fit_own_stars(stamps, stars.positions[10:30], PIXEL, gain=40.0) for stamps in (light, np.rint(light))]
    sizes = [pachon.adaptive_moments(fit.model.at([[2e3, 2e3]]), PIXEL).T[0] for fit in fits]
    assert sizes[1] == pytest.approx(sizes[0], rel=2e-3)
    assert np.median(fits[1].snr) == pytest.approx(np.median(fits[0].snr), rel=0.05)


def test_undersampled_stars_have_no_adaptive_moments(tmp_path, monkeypatch, capsys):
    """As of HSM, whose matrix becomes singular: the table of the command ended in a TypeError."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(3)
    positions, centres = rng.uniform(0.0, 1000.0, (12, 2)), rng.uniform(-0.2, 0.2, (12, 2, 1, 1))
    y, x = np.indices((21, 21)) - 10
    light = (
        4e4 / (2.0 * np.pi * 0.45**2) * np.exp(-0.5 * ((x - centres[:, 0]) ** 2 + (y - centres[:, 1]) ** 2) / 0.45**2)
    )
    stamps = light + rng.normal(size=light.shape) * np.sqrt(25.0 + light)
    Table({"x": positions[:, 0], "y": positions[:, 1], "stamp": stamps}).write("stars.fits")
    assert main(["model", "stars.fits", "--no-picture", "--interpolation", "polynomial", "--order", "0"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"rms of g, weighted e of the stars +-, \d+\.\d\d %", out)
    assert re.search(r"rms dT/T, held out +-\s", out)


def test_stars_that_sextractor_flags_are_left_out(stars, tmp_path, monkeypatch, capsys):
    """As PSFEx leaves them out (SAMPLE_FLAGMASK 0x00fe): blended, saturated and cut ones, not those with neighbours."""
    monkeypatch.chdir(tmp_path)
    flags = np.zeros(COUNT, dtype=np.int16)
    flags[[1, 2, 3, 4]] = 3, 4, 24, 1
    x, y = stars.positions.T
    columns = {"XWIN_IMAGE": x, "YWIN_IMAGE": y, "VIGNET": stars.stamps, "FLAGS": flags}
    Table(columns).write("stars.fits")
    Table({name: values[(flags & 0xFE) == 0] for name, values in columns.items() if name != "FLAGS"}).write("good.fits")
    options = ["--no-picture", "--interpolation", "polynomial", "--order", "0"]

    def model(file, *more):
        assert main(["model", file, *options, *more]) == 0
        return capsys.readouterr().out, Table.read(file.replace(".fits", "_psf.ecsv"))

    out, table = model("stars.fits")
    assert "2 saturated" not in out
    assert "1 blended, 1 saturated, 1 cut by an edge, 1 with incomplete apertures; --flag-mask 0 keeps them" in out
    assert table["x"].tolist() == x.tolist()
    assert np.flatnonzero(table["flags"] == StarFlag.FLAGGED_IN_CATALOGUE).tolist() == [1, 2, 3]
    assert set(np.flatnonzero(~table["used"])) == {1, 2, 3, 5}
    # They leave no trace in the model of the others.
    _, good = model("good.fits")
    np.testing.assert_allclose(good["held_out_g1"], np.delete(table["held_out_g1"], [1, 2, 3]))
    stamps = [PsfModel.read(f"{name}_psf.fits").draw(2000.0, 2000.0) for name in ("stars", "good")]
    assert np.array_equal(*stamps)
    out, table = model("stars.fits", "--flag-mask", "0")
    assert "--flag-mask" not in out
    assert table["used"].sum() == COUNT - 1
    flags[:] = 2
    Table(columns | {"FLAGS": flags}).write("stars.fits", overwrite=True)
    assert main(["model", "stars.fits"]) == 2
    assert "0 of 60 stars left (60 flagged in catalogue): expected at least 5" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size": 30}, "size = 30: expected an odd number of pixels from 9 to 33"),
        ({"size": 35}, "size = 35: expected an odd number"),
        ({"gain": 0.0}, r"gain = 0\.0: expected a positive, finite number of electrons"),
        ({"gain": 1e308}, r"gain = 1e\+308: expected a positive, finite number of electrons"),
        ({"min_snr": np.nan}, "min_snr = nan: expected the least S/N of a star"),
        ({"min_snr": 1e6}, "0 of 60 stars left"),
        ({"pixel_scale": -1.0}, "pixel_scale"),
        ({"extent": "wide"}, r"^extent = 'wide': expected real numbers"),
    ],
)
def test_bad_values_are_named(stars, change, message):
    with pytest.raises(DomainError, match=message):
        fit_own_stars(*stars, **({"pixel_scale": PIXEL} | change))
    with pytest.raises(DomainError, match="stamps of 7 pixels along a side: expected at least 13, or size"):
        fit_own_stars(stars.stamps[:, :7, :7], stars.positions, PIXEL)


@pytest.mark.parametrize(("pixel", "bar"), [(1e-4, "0.001 arcsec"), (0.2, "2 arcsec"), (50.0, "500 arcsec")])
def test_the_bar_under_stamps_fits_pixels_of_any_size(pixel, bar):
    """No bar was short enough for pixels of less than 0.0005 arcsec."""
    axes = Figure().add_subplot()
    StampGallery(axes, 31, np.deg2rad(pixel / 3600.0)).finish(1, 1)
    assert [text.get_text() for text in axes.texts] == [bar]


def test_options_of_the_model_are_checked(stars):
    with pytest.raises(ConfigError, match=r"^weights = 3\.0: expected noise$"):
        fit_own_stars(*stars, PIXEL, weights=3.0)
    with pytest.raises(TypeError, match="unexpected keyword argument 'clip'"):
        fit_own_stars(*stars, PIXEL, clip=3.0)


def test_stars_too_faint_for_their_gain_are_told_from_bad_ones():
    rng = np.random.default_rng(1)
    light = profiles(rng.uniform(1.0, 4000.0, (20, 2)), *np.zeros((2, 20)))  # of unit flux: not in electrons
    stamps, positions = light + rng.normal(scale=1e-4, size=light.shape), rng.uniform(size=(20, 2))
    with pytest.raises(DomainError, match=r"0 of 20 stars left \(20 of S/N below min_snr = 20, of 0\.99\d electrons"):
        fit_own_stars(stamps, positions, PIXEL, background=False)
    options = {"recipe": "paper", "basis": "pixels", "order": 0, "background": False}
    assert fit_own_stars(stamps, positions, PIXEL, gain=1e5, **options).used.all()


def test_stamps_of_noise_are_no_stars():
    noise = np.random.default_rng(1).normal(size=(20, 21, 21))
    with pytest.raises(DomainError, match="stars"):
        fit_own_stars(noise, np.random.default_rng(2).uniform(size=(20, 2)), PIXEL)
