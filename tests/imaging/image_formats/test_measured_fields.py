"""Images of other programs measured: shapes and fluxes against the truth, few stars, stars and PSFs of one's own."""

import json
import re
from dataclasses import replace
from pathlib import Path

import drawn_fields
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from drawn_fields import PSF, draw_field, gaussian, header_of
from scipy import ndimage

import pachon
from pachon.commands.cli import main
from pachon.core.errors import ConfigError, DomainError, PachonError, ProductError
from pachon.core.long_work import Execution
from pachon.imaging.image_formats.load import ImageSource
from pachon.imaging.image_psf import psfs_on
from pachon.imaging.image_stars import detected_objects, few_or_many_stars
from pachon.imaging.measure_files import FileMeasurement, MeasureOptions, images_among, measure_files
from pachon.imaging.star_positions import table_in
from pachon.measure.catalogue.matching import match_positions

DATA = Path(__file__).parents[2] / "data"


def loaded(field, tmp_path, name="a.fits"):
    fits.PrimaryHDU(field.image, header_of()).writeto(tmp_path / name)
    return pachon.load_image(tmp_path / name)


def galaxies_of(catalogue, field):
    """Rows of usable galaxies, and of their truth."""
    rows = catalogue.galaxies
    match = match_positions(catalogue.objects.x[rows], catalogue.objects.y[rows], *field.places.T, 1.0)
    good = (match >= 0) & catalogue.usable
    good[good] &= ~field.star[match[good]]
    return good, match[good]


@pytest.fixture(scope="module")
def image(field, tmp_path_factory):
    return loaded(field, tmp_path_factory.mktemp("field"))


@pytest.fixture(scope="module")
def catalogue(image):
    return pachon.measure_image(image, threads=1)


@pytest.mark.long
def test_galaxies_of_a_plain_image_have_their_shapes_and_fluxes(catalogue, field):
    good, truth = galaxies_of(catalogue, field)
    assert good.sum() > 45
    for values, errors, true in (
        (catalogue.fits.e1, catalogue.fits.e1_error, field.shear[truth, 0]),
        (catalogue.fits.e2, catalogue.fits.e2_error, field.shear[truth, 1]),
    ):
        pull = (values[good] - true) / errors[good]
        # Errors are honest, and there is no bias beyond them: 50 galaxies.
        assert abs(pull.mean()) < 3.5 / np.sqrt(good.sum())
        assert 0.75 < pull.std() < 1.35
    ratio = catalogue.fits.flux[good] / field.flux[truth]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)
    table = catalogue.table()
    # The Kron ellipse has 94 to 100 % of a Gaussian.
    assert np.median(table["flux"][good] / field.flux[truth]) == pytest.approx(0.97, abs=0.04)
    magnitude = 30.0 - 2.5 * np.log10(table["flux"][good])
    np.testing.assert_allclose(table["magnitude"][good], magnitude, atol=1e-6)
    sky = catalogue.image.celestial(np.stack([table["x"], table["y"]], axis=1))
    np.testing.assert_allclose(np.stack([table["ra"], table["dec"]], axis=1), sky, rtol=1e-14)
    # East is at negative x and north at positive y: x points west, as shapes on the sky have it.
    np.testing.assert_allclose(table["g1_sky"][good], table["e1"][good], atol=2e-3)
    np.testing.assert_allclose(table["g2_sky"][good], table["e2"][good], atol=2e-3)
    assert catalogue.warnings == ()
    assert len(catalogue.stars) >= 25


@pytest.mark.parametrize("extension", ["CCD 1/2", "../../x", "DET1.CHIP1"])
def test_products_stay_beside_their_image_whatever_its_extension_is_called(tmp_path, extension):
    """The slash of an extension was that of a folder: the command ended after the image was measured."""
    product = FileMeasurement(None, MeasureOptions()).product(ImageSource(tmp_path / "a.fits", extension), "_psf")
    assert product.parent == tmp_path
    assert images_among([tmp_path / "a.fits", product]) == [tmp_path / "a.fits"]


def test_why_no_object_may_be_a_star(field, tmp_path):
    """Of an image with bad cores the message was that of 0 objects the smallest have different sizes."""
    pixels = field.image.copy()
    for x, y in np.rint(field.places).astype(int):
        pixels[y - 1 : y + 2, x - 2 : x + 3] = np.nan
    fits.PrimaryHDU(pixels, header_of()).writeto(tmp_path / "a.fits")
    text = (
        r"no stars: 0 of \d+ objects may be stars, expected at least 3 \(left out: .*\d+ saturated, .* masked in most"
    )
    with pytest.raises(DomainError, match=text):
        pachon.measure_image(pachon.load_image(tmp_path / "a.fits"), threads=1)


def test_scattered_bad_pixels_leave_the_stars(field, catalogue, tmp_path):
    """One bad pixel in the inner half of the stamp flagged a star: of an image with 1 % of them there was none."""
    pixels = field.image.copy()
    pixels[np.random.default_rng(1).random(pixels.shape) < 0.03] = np.nan
    fits.PrimaryHDU(pixels, header_of()).writeto(tmp_path / "a.fits")
    masked = pachon.measure_image(pachon.load_image(tmp_path / "a.fits"), threads=1)
    assert len(masked.stars) >= 0.9 * len(catalogue.stars)
    middle = [[160.0, 160.0]]
    before, after = (pachon.adaptive_moments(c.psf.at(middle), 1.0) for c in (catalogue, masked))
    assert after.T[0] == pytest.approx(before.T[0], rel=0.01)
    np.testing.assert_allclose([after.g1, after.g2], [before.g1, before.g2], rtol=0, atol=4e-3)
    # Peaks of the functionals are none near masked pixels, which was a traceback.
    assert masked.shear is None
    assert any("no shear of functionals: no peaks" in warning for warning in masked.warnings)


def test_stars_too_sharp_for_the_pixels_are_told(tmp_path, monkeypatch):
    """Errors of ellipticities were two to nine times those given at a FWHM of 1.8 to 1.5 pixels, without a word."""
    monkeypatch.setattr(drawn_fields, "PSF", (0.5, 0.0, 0.5))
    image = loaded(draw_field(15, 5, side=200), tmp_path)
    catalogue = pachon.measure_image(image, threads=1)
    (warning,) = catalogue.warnings
    assert re.match(r"its stars have a FWHM of 1\.[5-9]\d* pixels: below 2 ", warning)
    assert catalogue.metrics()["warnings"] == [warning]
    # With a model of the PSF there was none: errors are right with it, but the shear of functionals is too small.
    (warning,) = pachon.measure_image(image, psf=catalogue.psf, threads=1).warnings
    assert re.match(r"its PSF model has a FWHM of 1\.[5-9]\d* pixels: .* shears are too small", warning)


@pytest.mark.slow
def test_shapes_and_fluxes_beside_hsm_and_sep(catalogue, field):
    galsim, sep = pytest.importorskip("galsim"), pytest.importorskip("sep")
    good, truth = galaxies_of(catalogue, field)
    image = np.ascontiguousarray(field.image.astype(float) - catalogue.objects.background)
    yy, xx = np.indices((41, 41), dtype=float) - 20.0
    psf = galsim.Image(gaussian(yy, xx, 0.0, 0.0, PSF, 1.0), scale=1.0)
    ours, theirs, true = [], [], []
    for row, star in zip(np.flatnonzero(good), truth, strict=True):
        x, y = np.rint(field.places[star]).astype(int)
        if min(x, y) < 13 or max(x, y) > image.shape[0] - 14:
            continue
        stamp = galsim.Image(np.ascontiguousarray(image[y - 13 : y + 14, x - 13 : x + 14]), scale=1.0)
        shape = galsim.hsm.EstimateShear(stamp, psf, strict=False)
        if shape.error_message:
            continue
        distortion = galsim.Shear(e1=shape.corrected_e1, e2=shape.corrected_e2)
        theirs.append([distortion.g1, distortion.g2])
        ours.append([catalogue.fits.e1[row], catalogue.fits.e2[row]])
        true.append(field.shear[star])
    ours, theirs, true = map(np.array, (ours, theirs, true))
    assert len(ours) > 30
    # Both measure the same noise: they agree better with each other than with the truth, and ours is no worse.
    assert np.sqrt(np.mean((ours - true) ** 2)) < 1.15 * np.sqrt(np.mean((theirs - true) ** 2))
    assert np.abs(np.mean(ours - theirs)) < 0.01
    # SEP's aperture of 9 pixels holds a galaxy of 3 pixels rms within a per cent.
    flux, _, _ = sep.sum_circle(image, *field.places[truth].T, 9.0)
    assert np.median(catalogue.fits.flux[good] / flux) == pytest.approx(1.0, abs=0.02)


@pytest.mark.long
@pytest.mark.parametrize(
    "n_stars", [3, pytest.param(5, marks=pytest.mark.slow), pytest.param(8, marks=pytest.mark.slow)]
)
def test_a_field_of_few_stars_has_a_constant_psf(n_stars, tmp_path):
    field = draw_field(n_stars, 30, seed=n_stars, side=250)
    catalogue = pachon.measure_image(loaded(field, tmp_path), threads=1)
    assert 3 <= len(catalogue.stars) <= n_stars
    match = match_positions(*catalogue.stars.positions.T, *field.places.T, 1.0)
    assert field.star[match].all()
    assert catalogue.psf.order == 0
    (warning,) = catalogue.warnings
    assert f"from {len(catalogue.stars)} stars" in warning
    good, truth = galaxies_of(catalogue, field)
    assert good.sum() > 15
    pull = (catalogue.fits.e1[good] - field.shear[truth, 0]) / catalogue.fits.e1_error[good]
    assert abs(np.median(pull)) < 1.0


@pytest.mark.long
def test_saturated_stars_are_no_galaxies(field, tmp_path):
    # A bright star that blooms is as wide as a galaxy, and only the top of it is clipped.
    side = len(field.image)
    empty = ndimage.distance_transform_edt(field.image < 450.0)[40:-40, 40:-40]
    place = tuple(40 + at for at in np.unravel_index(np.argmax(empty), empty.shape))
    yy, xx = np.indices((side, side), dtype=float)
    star = gaussian(yy, xx, place[1], place[0], tuple(1.8 * c for c in PSF), 2e5)
    level = 0.95 * float((field.image + star)[place])
    image = np.minimum(field.image + star, level).astype(np.float32)
    for name, header in (("a.fits", header_of(SATURATE=0.999 * level)), ("b.fits", header_of())):
        fits.PrimaryHDU(image, header).writeto(tmp_path / name)
    catalogues = [pachon.measure_image(pachon.load_image(tmp_path / name), threads=1) for name in ("a.fits", "b.fits")]
    usable = [
        bool(c.usable[np.hypot(c.objects.x - place[1], c.objects.y - place[0])[c.galaxies] < 2.0].any())
        for c in catalogues
    ]
    assert usable == [False, True]


@pytest.mark.parametrize(("n_stars", "n_galaxies"), [(0, 20), (2, 20), (1, 40)])
def test_fewer_stars_than_three_are_too_few(n_stars, n_galaxies, tmp_path):
    """Of forty galaxies of about one size eleven were stars, without a word."""
    field = draw_field(n_stars, n_galaxies, seed=3, side=320 if n_galaxies == 40 else 250)
    image = loaded(field, tmp_path)
    with pytest.raises(DomainError, match="; or a lower min_snr, a catalogue") as caught:
        pachon.measure_image(image)
    assert str(caught.value).startswith("CCD a: no stars")


def test_stars_among_many_galaxies_of_one_size(tmp_path):
    """The mode of sizes was that of galaxies: none of 65 stars was one."""
    field = draw_field(30, 300, seed=2, side=920)
    image = loaded(field, tmp_path)
    stars = few_or_many_stars(image, detected_objects(image), 30.0)
    match = match_positions(*stars.positions.T, *field.places.T, 1.0)
    assert len(stars) == 30
    assert field.star[match].all()


@pytest.mark.slow
def test_stars_of_a_catalogue(image, field, tmp_path):
    chosen = np.flatnonzero(field.star)[:12]
    catalogue = pachon.measure_image(image, stars=field.places[chosen], threads=1)
    match = match_positions(*catalogue.stars.positions.T, *field.places.T, 1.0)
    assert set(match) <= set(chosen)
    assert len(match) >= 9
    for stars, text in (
        (np.full((4, 2), 0.3), "none of 4 is within 3 pixels of an object"),
        (field.places[chosen[:2]], r"[12] stars are good: expected at least 3"),
        (np.zeros((0, 2)), "expected finite positions"),
        ([[np.nan, 1.0]], "expected finite positions"),
    ):
        with pytest.raises(PachonError, match=text):
            pachon.measure_image(image, stars=stars)


@pytest.mark.slow
def test_catalogues_of_stars_by_pixels_and_by_the_sky(image, field, tmp_path, capsys):
    x, y = field.places[field.star].T
    sky = image.celestial(field.places[field.star])
    tables = {
        "zero.csv": Table({"x": x, "y": y}),
        "one.fits": Table({"XWIN_IMAGE": x + 1, "YWIN_IMAGE": y + 1}),
        "sky.ecsv": Table({"ra": sky[:, 0], "dec": sky[:, 1]}),
        "radian.fits": Table({"coord_ra": np.deg2rad(sky[:, 0]), "coord_dec": np.deg2rad(sky[:, 1])}),
    }
    fits.PrimaryHDU(field.image, header_of()).writeto(tmp_path / "a.fits")
    counts = set()
    for name, table in tables.items():
        table.write(tmp_path / name)
        command = ["measure", str(tmp_path / "a.fits"), "--stars", str(tmp_path / name), "--json", "--quiet"]
        assert main([*command, "-o", str(tmp_path / "out")]) == 0
        counts.add(json.loads(capsys.readouterr().out)["images"]["a.fits"]["stars"])
    assert len(counts) == 1
    assert counts.pop() >= 25
    for table, text in (
        (Table({"u": x}), "has no positions of stars: expected columns x and y, xwin_image and ywin_image, ra and dec"),
        (Table({"x": x + 1e6, "y": y}), r"none of its 30 stars lies on image a"),
    ):
        table.write(tmp_path / "bad.csv", overwrite=True)
        assert main(["measure", str(tmp_path / "a.fits"), "--stars", str(tmp_path / "bad.csv"), "--quiet"]) == 2
        assert text in capsys.readouterr().err


def test_a_table_of_stars_in_another_format_names_those_that_are_read(tmp_path):
    path = tmp_path / "stars.parquet"
    path.write_bytes(b"PAR1\x15\x80")
    with pytest.raises(ProductError, match="no table of stars in FITS, ECSV or CSV"):
        table_in(path)


@pytest.mark.slow
def test_a_psf_model_from_a_file(image, field, catalogue, tmp_path, capsys):
    fits.PrimaryHDU(field.image, header_of()).writeto(tmp_path / "a.fits")
    catalogue.psf.write(tmp_path / "a_model.fits")
    command = ["measure", str(tmp_path / "a.fits"), "--json", "--quiet", "-o", str(tmp_path / "out")]
    assert main([*command, "--psf", str(tmp_path / "{stem}_model.fits")]) == 0
    capsys.readouterr()
    product = tmp_path / "out" / "a_galaxies.fits"
    table = Table.read(product)
    np.testing.assert_array_equal(table["e1"], catalogue.fits.e1)
    assert not (tmp_path / "out" / "a_psf.fits").exists()
    # PSFEx with the true PSF, sampled at half a pixel: shapes are as good.
    half = np.arange(-30, 31) * 0.5
    true = gaussian(half[:, None], half, 0.0, 0.0, PSF, 1.0)
    column = fits.Column("PSF_MASK", format="3721E", dim="(61,61,1)", array=[true[None].astype(np.float32)])
    hdu = fits.BinTableHDU.from_columns([column], name="PSF_DATA")
    hdu.header.update({"POLNAXIS": 0, "PSF_SAMP": 0.5})
    hdu.writeto(tmp_path / "a.psf")
    assert main([*command, "--psf", str(tmp_path / "a.psf")]) == 0
    capsys.readouterr()
    table = Table.read(product)
    good, truth = galaxies_of(catalogue, field)
    assert np.abs(np.mean(table["e1"][good] - field.shear[truth, 0])) < 0.02
    # Without stars, too.
    empty = draw_field(0, 20, seed=4, side=250)
    alone = pachon.measure_image(
        loaded(empty, tmp_path, "b.fits"), psf=pachon.reconstruction.load_psfex(tmp_path / "a.psf")
    )
    assert len(alone.stars) == 0
    # Half of the light of a Gaussian is within 1.18 rms.
    assert alone.stars.half_light_radius == pytest.approx(1.1774 * (PSF[0] * PSF[2] - PSF[1] ** 2) ** 0.25, rel=0.03)
    assert alone.usable.sum() > 12
    (tmp_path / "a.psf").write_bytes(b"no model")
    assert main([*command, "--psf", str(tmp_path / "a.psf")]) == 2
    assert "a.psf: no PSF model (PsfModel: " in capsys.readouterr().err
    with pytest.raises(ConfigError, match="recipe is of a model of the CCD"):
        pachon.measure_image(image, psf=catalogue.psf, recipe="paper")


@pytest.mark.slow
def test_a_psf_model_of_piff(image, catalogue):
    model = pachon.load_piff(DATA / "piff" / "gaussian.piff")
    measured = pachon.measure_image(image, psf=model, threads=1)
    # Piff counts pixels from one.
    places = np.array([[100.0, 50.0], [20.0, 280.0]])
    drawn = psfs_on(image, model, places, 1)
    direct = model.at(places + 1.0, size=drawn.shape[1])
    np.testing.assert_allclose(drawn, direct / direct.sum(axis=(1, 2), keepdims=True), rtol=1e-12)
    assert len(measured.stars) == len(catalogue.stars)
    several = pachon.load_piff(DATA / "piff" / "grid_chips.piff")
    with pytest.raises(DomainError, match=r"PSF model of a: chip = None: expected one of"):
        psfs_on(image, several, places, 1)
    number = next(iter(several.chips))
    header = image.header.copy()
    header["CCDNUM"] = number
    assert psfs_on(replace(image, header=header), several, places, 1).shape[0] == 2
    with pytest.raises(DomainError, match="PSF model of a: properties: expected values of"):
        psfs_on(image, pachon.load_piff(DATA / "piff" / "grid_color.piff"), places, 1)


def test_a_psf_model_of_piff_takes_colours(image):
    model = pachon.load_piff(DATA / "piff" / "grid_color.piff")
    (name,) = model.property_names
    places = np.array([[100.0, 50.0], [20.0, 280.0], [30.0, 40.0]])
    drawn = psfs_on(image, model, places, 1, np.array([0.5, 1.5, np.nan]))
    direct = model.at(places + 1.0, size=drawn.shape[1], properties={name: [0.5, 1.5, 1.0]})
    np.testing.assert_allclose(drawn, direct / direct.sum(axis=(1, 2), keepdims=True), rtol=1e-12)
    with pytest.raises(DomainError, match="properties: expected values of"):
        psfs_on(image, model, places, 1, np.nan)


def test_stars_on_the_shallow_part_of_a_stack(field, tmp_path):
    """The noise of the deeper half of the pixels made defects of theirs: of 7 none was left."""
    shallow = np.arange(len(field.image)) < 150
    variance = np.where(shallow, 9.0, 1.0) * field.variance
    noise = np.random.default_rng(2).normal(size=variance.shape) * np.sqrt(variance - field.variance)
    planes = fits.PrimaryHDU(field.image + noise, header_of()), fits.ImageHDU(variance, name="VARIANCE")
    fits.HDUList(list(planes)).writeto(tmp_path / "a.fits")
    image = pachon.load_image(tmp_path / "a.fits")
    stars = few_or_many_stars(image, detected_objects(image), 30.0)
    inner = (np.abs(field.places[field.star] - 0.5 * len(field.image)) < 140.0).all(axis=1)
    expected = (field.places[field.star, 0] < 145.0) & inner
    assert expected.sum() > 5
    assert (stars.positions[:, 0] < 145.0).sum() >= expected.sum() - 1


def test_ccds_that_are_out_of_order_are_left_out(tmp_path):
    """DECam has two: the command ended at the first of them, and --resume as well."""
    field = draw_field(12, 3, side=160)
    dead = [np.zeros_like(field.image), np.full_like(field.image, np.nan)]
    ccds = [fits.ImageHDU(pixels, header_of(), name=f"N{i}") for i, pixels in enumerate([*dead, field.image])]
    fits.HDUList([fits.PrimaryHDU(), *ccds]).writeto(tmp_path / "a.fits")
    measured = measure_files([tmp_path / "a.fits"], execution=Execution(threads=1))
    assert list(measured.metrics) == ["a.fits[N2]"]
    assert "its pixels have no noise" in measured.left_out["a.fits[N0]"]
    assert "all pixels are masked" in measured.left_out["a.fits[N1]"]


@pytest.mark.slow
def test_all_images_of_a_file(field, tmp_path, capsys):
    blank = np.random.default_rng(1).normal(100.0, 5.0, (64, 64)).astype(np.float32)
    fits.HDUList(
        [
            fits.PrimaryHDU(),
            fits.CompImageHDU(field.image, header_of(), name="N4", quantize_level=64),
            fits.ImageHDU(field.image[::-1].copy(), header_of(), name="S4"),
            fits.ImageHDU(blank, header_of(), name="F1"),
        ]
    ).writeto(tmp_path / "exposure.fits.fz")
    command = ["measure", str(tmp_path / "exposure.fits.fz"), "--json", "--quiet"]
    assert main([*command, "--pictures"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found["images"]) == ["exposure.fits.fz[N4]", "exposure.fits.fz[S4]"]
    assert "no objects" in found["left_out"]["exposure.fits.fz[F1]"]
    names = {path.name for path in tmp_path.glob("*_*.fits")}
    assert names == {f"exposure_{ccd}_{kind}.fits" for ccd in ("N4", "S4") for kind in ("galaxies", "psf")}
    for ccd in ("N4", "S4"):
        assert (tmp_path / f"exposure_{ccd}_measured.png").read_bytes().startswith(b"\x89PNG")
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*_*.fits")}
    # Products beside the images are no images; those that are whole stay.
    assert main(["measure", *map(str, sorted(tmp_path.glob("*.fits*"))), "--json", "--quiet", "--resume"]) == 0
    assert list(json.loads(capsys.readouterr().out)["images"]) == list(found["images"])
    assert {path: path.stat().st_mtime_ns for path in before} == before
    # A picture that is missing is drawn, with --pictures.
    picture = tmp_path / "exposure_N4_measured.png"
    picture.unlink()
    assert main([*command, "--resume"]) == 0
    assert not picture.exists()
    assert main([*command, "--resume", "--pictures"]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    # Another gain makes another catalogue.
    assert main([*command, "--resume", "--extension", "S4", "--gain", "2.4"]) == 0
    assert (tmp_path / "exposure_S4_galaxies.fits").stat().st_mtime_ns != before[tmp_path / "exposure_S4_galaxies.fits"]


@pytest.mark.long
def test_without_a_zero_point_there_are_instrumental_magnitudes(catalogue):
    header = catalogue.image.header.copy()
    del header["ZEROPNT"], header["EXPTIME"]
    without = replace(catalogue, image=replace(catalogue.image, header=header))
    assert "magnitude" not in without.table().colnames
    assert without.plot().axes[0].get_xlabel() == "instrumental magnitude"
    assert without.image.plot().axes[0].get_title(loc="left") == "a, r band"


@pytest.mark.long
def test_images_that_lack_something_are_one_line(field, tmp_path, capsys):
    fits.PrimaryHDU(field.image).writeto(tmp_path / "a.fits")
    for options, text in (
        ((), "no world coordinates"),
        (("--pixel-scale", "0.2"), "no gain"),
        (("--pixel-scale", "-1"), "pixel_scale"),
        (("--pixel-scale", "0.2", "--gain", "0"), "gain = 0"),
        (("--weight-kind", "x"), "--weight-kind = 'x': expected one of weight, variance, rms"),
        (("--extension", "N4"), "extension = N4: expected one of 0"),
        (("--psf", "x.fits", "--recipe", "paper"), "expected none with --psf"),
        (("--psf", "x.fits", "--model", "focal_plane"), "--psf: expected with --model ccd alone"),
        (("--gain", "2", "--model", "focal_plane"), "--gain: expected with --model ccd alone"),
        (("--stars", "x.csv", "--model", "focal_plane"), "--stars: expected with --model ccd alone"),
        (("--weight-kind", "rms"), "--weight-kind: expected --weight with it"),
    ):
        assert main(["measure", str(tmp_path / "a.fits"), "--quiet", *options]) == 2
        error = capsys.readouterr().err
        assert text in error
        assert error.count("\n") == 1
        assert "Traceback" not in error
