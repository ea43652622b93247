"""Scenes and files of a small run: stars against their own PSFs, places, table, bytes."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData
from astropy.table import Table

import pachon
from pachon.core.errors import ConfigError, DomainError, ProductError
from pachon.core.products import Stamp, is_whole
from pachon.core.units import ARCSEC
from pachon.imaging.draw import Window
from pachon.imaging.exposure import Exposure
from pachon.imaging.image_file import OBJECT_COLUMNS, CcdImage
from pachon.imaging.scene import STAR_ROOM, deep_exposures, draw_ccd, ellipticities, middle_window
from pachon.measure.shapes import measure_shapes
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate.ccd_exposure import ccd_stars, expose_positions
from pachon.sky.galaxies import Galaxies
from pachon.sky.pointing import Pointing

POINTING, ROLL = (0.3, 0.2), 0.7
STAMP = Stamp("ab" * 32, 7)


def nothing(xi, eta):
    return Galaxies.concatenate([])


def two_galaxies(xi, eta):
    middle = np.mean(xi), np.mean(eta)
    places = [[-60.0, 20.0], [30.0, -40.0]] * np.full((2, 1), ARCSEC) + middle
    return Galaxies.single(*places.T, [20.0, 21.0], [0.8 * ARCSEC, 0.5 * ARCSEC], e1=[0.2, 0.0], e2=[0.1, -0.3])


@pytest.fixture(scope="module")
def stars(small_run):
    """Scene of stars alone on the whole CCD."""
    return draw_ccd(small_run, "R22_S11", nothing, pointing=Pointing(*POINTING, ROLL))


@pytest.fixture(scope="module")
def image(small_run):
    scene = draw_ccd(
        small_run,
        "R22_S11",
        two_galaxies,
        pointing=Pointing(*POINTING, ROLL),
        window=Window(1500, 1500, 900, 800),
        exposure=Exposure("r", 2.0, 3),
    )
    return scene.exposed()


@pytest.mark.long
def test_zero_point_has_the_vignetting_of_the_middle(tiny):
    """At the edge of the field a star is 0.1 mag fainter than on the axis; its flux and ZEROPNT give its magnitude."""
    run = Experiment.from_config(
        tiny(ccds=("R01_S02",), psf__engine="long_exposure", psf__n_pupil=300, psf__stamp=63, stars__truth=24)
    )
    image = draw_ccd(run, "R01_S02", two_galaxies, window=Window(1700, 1700, 600, 600)).exposed()
    galaxies = np.flatnonzero(~image.objects["STAR"])
    flux = image.objects["FLUX"][galaxies] / image.header["GAIN"]
    np.testing.assert_allclose(image.zero_point - 2.5 * np.log10(flux), image.objects["MAG"][galaxies], atol=0.01)
    assert Exposure.of_run(run).zero_point - image.zero_point == pytest.approx(0.1, abs=0.03)


def test_stars_are_their_own_psfs_times_their_electrons(stars, small_run):
    field = ccd_stars(small_run, "R22_S11", 0.7 * ARCSEC)
    pixels = np.stack([stars.objects["X"], stars.objects["Y"]], axis=1)
    center = small_run.camera.centers[small_run.camera.ccd_index("R22_S11")]
    # The pixels' x and y run along y and x of the focal plane.
    assert np.allclose((field.observed - center)[:, ::-1] / 10e-6 + [2047.5, 2001.5], pixels, rtol=0, atol=1e-6)
    nearest = np.rint(pixels).astype(int)
    psfs = expose_positions(small_run, field.observed, room=STAR_ROOM, offsets=(pixels - nearest)[:, ::-1])
    checked = 0
    for i, (x, y) in enumerate(nearest):
        far = np.abs(nearest - (x, y)).max(axis=1) > 130
        if min(x, y) < 63 or max(x, y) > 4004 - 64 or far.sum() < len(far) - 1:
            continue
        expected = psfs.image[i].T * stars.objects["FLUX"][i]
        drawn = stars.electrons[y - 63 : y + 64, x - 63 : x + 64]
        assert np.abs(drawn - expected).max() < 1e-6 * expected.max()
        checked += 1
    assert checked > 3


def test_electrons_of_stars_are_those_of_their_magnitudes(stars, small_run):
    # SMTN-002: r of 28.36 is one electron a second; no vignetting at the centre of the field.
    light = small_run.config.atmosphere.exposure_s * 10.0 ** (0.4 * (28.36 - stars.objects["MAG"]))
    assert np.allclose(stars.objects["FLUX"], light, rtol=1e-3)
    assert stars.objects["STAR"].all()


def test_header_and_table_place_stars_where_they_are(stars):
    image = stars.exposed(Exposure("r", 2.0, noise=False))
    objects = image.objects
    celestial = np.stack([objects["RA"], objects["DEC"]], axis=1)
    pixels = image.wcs.all_world2pix(celestial, 0)
    assert np.allclose(pixels, np.stack([objects["X"], objects["Y"]], axis=1), rtol=0, atol=2e-3)
    # The long-exposure PSF has no image motion: what is left is the coma of the design, a few hundredths of a pixel.
    brightest = np.argsort(objects["MAG"])
    for i in brightest[:5]:
        x, y = np.rint(pixels[i]).astype(int)
        if min(x, y) >= 16 and max(x, y) < 3988:
            stamp = image.image[y - 15 : y + 16, x - 15 : x + 16].astype(np.float64)[None]
            found = measure_shapes(stamp, 0.2 * ARCSEC, 0.7 * ARCSEC)
            assert np.hypot(x + found.x[0] - pixels[i, 0], y + found.y[0] - pixels[i, 1]) < 0.1


def test_an_image_comes_back_as_it_was_written(image, tmp_path):
    path = tmp_path / "image.fits"
    image.write(path)
    back = CcdImage.read(path)
    for name in ("image", "variance", "mask"):
        assert (getattr(back, name) == getattr(image, name)).all()
        assert getattr(back, name).dtype == getattr(image, name).dtype
    for key in OBJECT_COLUMNS:
        assert np.array_equal(back.objects[key], image.objects[key]), key
    first = path.read_bytes()
    back.write(tmp_path / "again.fits")
    image.write(path)
    assert path.read_bytes() == first
    damaged = bytearray(first)
    damaged[len(first) // 2] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(ProductError, match="checksum"):
        CcdImage.read(path)


def test_another_product_is_no_image(tmp_path):
    from pachon.core.products import image_hdu, write_fits

    write_fits(tmp_path / "other.fits", [image_hdu("MEAN", np.zeros((3, 3)), "")], None, [])
    with pytest.raises(ProductError, match=r"other\.fits: no image of a CCD"):
        CcdImage.read(tmp_path / "other.fits")


@pytest.fixture
def parts(image, tmp_path):
    """Write an image, and return its parts without checksums and the number of parts, as other programs write them."""
    replace(image, stamp=STAMP).write(tmp_path / "image.fits")
    assert is_whole(tmp_path / "image.fits", STAMP)
    with fits.open(tmp_path / "image.fits", lazy_load_hdus=False) as hdus:
        copies = fits.HDUList([hdu.copy() for hdu in hdus])
    for hdu in copies:
        for key in ("CHECKSUM", "DATASUM", "NPARTS"):
            hdu.header.remove(key, ignore_missing=True)
    return copies


def test_an_image_without_checksums_is_not_damaged(image, parts, tmp_path):
    path = tmp_path / "foreign.fits"
    parts.writeto(path)
    back = CcdImage.read(path)
    for name in ("image", "variance", "mask"):
        assert np.array_equal(getattr(back, name), getattr(image, name))
    assert np.array_equal(back.objects["X"], image.objects["X"])
    # Going on with a command takes only what that command itself has written whole.
    assert not is_whole(path, STAMP)
    # A sum that is there must hold, of the data alone too.
    parts["IMAGE"].header["DATASUM"] = "1"
    parts.writeto(path, overwrite=True)
    with pytest.raises(ProductError, match=r"foreign\.fits: damaged \(IMAGE does not match its DATASUM\)"):
        CcdImage.read(path)
    for hdu in parts:
        hdu.add_datasum()
    parts.writeto(path, overwrite=True)
    assert np.array_equal(CcdImage.read(path).image, image.image)
    path.write_bytes(path.read_bytes()[:-2880])
    with pytest.raises(ProductError, match=r"foreign\.fits: damaged or not FITS"):
        CcdImage.read(path)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda parts: parts.pop(1), r"no image of a CCD \(IMAGE is missing"),
        (lambda parts: parts.pop(4), r"no image of a CCD \(the table TRUTH is missing\)"),
        (lambda parts: parts[0].header.remove("CCD"), r"no image of a CCD \(Keyword 'CCD' not found\.\)"),
        (lambda parts: setattr(parts["MASK"], "data", np.zeros(3, np.int16)), r"no image of a CCD \(MASK "),
        (lambda parts: setattr(parts["MASK"], "data", np.zeros((3, 2), np.int16)), r".* MASK have shapes .*\(3, 2\);"),
        (lambda parts: setattr(parts["TRUTH"].columns["ETA"], "name", "ETTA"), r"no image of a CCD \(.*ETA"),
    ],
)
def test_a_file_of_another_program_that_is_no_image_is_one_line(parts, tmp_path, change, text):
    change(parts)
    parts.writeto(tmp_path / "foreign.fits")
    with pytest.raises(ProductError, match=rf"foreign\.fits: {text}"):
        CcdImage.read(tmp_path / "foreign.fits")


def test_astropy_reads_image_uncertainty_mask_and_table(image, tmp_path):
    path = tmp_path / "image.fits"
    image.write(path)
    with fits.open(path, checksum=True) as hdus:
        header = hdus["IMAGE"].header
        assert [hdu.name for hdu in hdus[1:]] == ["IMAGE", "VARIANCE", "MASK", "TRUTH"]
        assert (header["EXPTIME"], header["NEXP"], header["GAIN"], header["FILTER"]) == (6.0, 3, 1.0, "r")
        assert header["ZEROPNT"] == pytest.approx(28.36 + 2.5 * np.log10(6.0), abs=1e-6)
        assert header["SATURATE"] == pytest.approx(3e5 - header["SKY"], abs=0.02)  # float32
        # Of no visit: instrument and detector, and the epoch of catalogues as the date.
        assert (header["INSTRUME"], header["DETECTOR"]) == ("LSSTCam", 94)
        assert (header["MJD-OBS"], header["DATE-OBS"]) == (51544.5, "2000-01-01T12:00:00.000")
        assert header["DATE-AVG"] == "2000-01-01T12:00:03.000"  # the middle of EXPTIME, all exposures together
        assert hdus["MASK"].header["MP_SAT"] == 0
        assert "DATE" not in header
    data = CCDData.read(path, hdu=1, hdu_uncertainty="VARIANCE", hdu_mask="MASK", unit="adu")
    assert (data.data == image.image).all()
    assert (data.uncertainty.array == image.variance).all()
    truth = Table.read(path, hdu="TRUTH")
    galaxies = truth[~truth["STAR"]]
    assert len(galaxies) == 2
    assert galaxies["RADIUS"] == pytest.approx([0.8, 0.5], rel=1e-9)
    assert galaxies["E1"] == pytest.approx([0.2, 0.0], abs=1e-9)
    assert galaxies["E2"] == pytest.approx([0.1, -0.3], abs=1e-9)
    assert galaxies["FLUX"] == pytest.approx(6.0 * 10.0 ** (0.4 * (28.36 - np.array([20.0, 21.0]))), rel=2e-3)
    place = data.wcs.all_world2pix(np.stack([galaxies["RA"], galaxies["DEC"]], axis=1), 0)
    # X and Y of the table are pixels of the CCD, those of the image begin at its corner.
    assert np.allclose(place + 1500.0, np.stack([galaxies["X"], galaxies["Y"]], axis=1), rtol=0, atol=2e-3)


@pytest.mark.long
def test_a_deeper_exposure_of_a_scene_has_more_of_everything(small_run, stars):
    deep = stars.exposed(Exposure("r", 2.0, 100, noise=False))
    plain = stars.exposed(Exposure("r", 2.0, noise=False))
    unclipped = plain.mask == 0
    assert np.allclose(deep.image[unclipped], 100.0 * plain.image[unclipped], rtol=1e-5, atol=1e-2)
    assert np.allclose(deep.objects["FLUX"], 100.0 * plain.objects["FLUX"], rtol=1e-12)
    # The middle of the exposure is that of all of its time.
    assert [scene.header["DATE-AVG"][-12:] for scene in (plain, deep)] == ["12:00:01.000", "12:01:40.000"]


def test_wings_of_bright_stars_do_not_end_at_a_square(tiny, tmp_path):
    """On stamps of 127 pixels those of magnitude 8 ended at 120 electrons a pixel, five times the noise."""
    Table({"field_x": [0.0], "field_y": [0.0], "mag": [8.0]}).write(tmp_path / "bright.ecsv")
    stars = {"stars__catalogue": str(tmp_path / "bright.ecsv"), "stars__brightest": 5.0, "stars__faintest": 25.0}
    psf = {"psf__engine": "long_exposure", "psf__n_pupil": 300, "psf__stamp": 63}
    experiment = Experiment.from_config(
        tiny(ccds=("R22_S11",), stars__truth=24, wavelengths_nm=[620.0], **psf, **stars)
    )
    scene = draw_ccd(experiment, "R22_S11", nothing, window=Window(1700, 1700, 700, 700))
    x, y = np.rint([scene.objects["X"][0], scene.objects["Y"][0]]).astype(int) - 1700
    profile = np.array([scene.electrons[y, x + r - 2 : x + r + 3].mean() for r in (40, 60, 70, 100, 140)])
    # As the power of the distance by which it falls, between those of diffraction and turbulence.
    slopes = np.diff(np.log(profile)) / np.diff(np.log([40, 60, 70, 100, 140]))
    assert ((slopes > -4.5) & (slopes < -2.5)).all()


def test_light_beyond_the_grids_is_below_the_noise_of_the_deep_cutout(small_run):
    """A spheroid of 22 mag: its grid is chosen for one exposure, but in the middle for all of those of the cutout."""

    def spheroids(xi, eta):
        middle, corner = (np.mean(xi), np.mean(eta)), (np.mean(xi) + 120.0 * ARCSEC, np.mean(eta))
        return Galaxies.single(*np.transpose([middle, corner]), [22.0, 22.0], [0.8 * ARCSEC] * 2, sersic=4.0)

    one = Exposure("r", 15.0)
    deep = Exposure("r", 15.0, deep_exposures(one))
    window = Window(1300, 1300, 1500, 1500)
    shallow, wide = (
        draw_ccd(small_run, "R22_S11", spheroids, window=window, exposure=e).electrons for e in (one, deep)
    )
    lost = np.abs(shallow * np.float32(deep.exposures) - wide) / deep.noise_rms
    cutout = middle_window(window, one)
    inside = np.zeros(window.shape, dtype=bool)
    inside[cutout.y - window.y :, cutout.x - window.x :][: cutout.height, : cutout.width] = True
    assert cutout.width < 600
    # Elsewhere the edge of a grid is a twentieth of the noise of the deep image and more; bright stars are rounded.
    assert lost[inside].max() < 0.01
    assert (lost - 4.0 * np.spacing(wide) / deep.noise_rms).max() > 0.03


def test_whole_galaxies_have_the_moments_of_their_components():
    # Two round components side by side along xi = eta, and a bulge in a disc of the same shape.
    galaxies = Galaxies(
        xi=[0.0, 0.0],
        eta=[0.0, 0.0],
        magnitude=[20.0, 20.0],
        radius=[1.0, 1.0],
        first=[0, 2, 4],
        dx=[1.0, -1.0, 0.0, 0.0],
        dy=[1.0, -1.0, 0.0, 0.0],
        fraction=[0.5, 0.5, 0.3, 0.7],
        component_radius=[0.5, 0.5, 0.2, 0.9],
        e1=[0.0, 0.0, 0.3, 0.3],
        e2=[0.0, 0.0, -0.2, -0.2],
        sersic=[1.0, 1.0, 4.0, 1.0],
    )
    # Q = r^2 + d d^T = [[1.25, 1], [1, 1.25]]: axes sqrt(2.25) and sqrt(0.25), (1.5 - 0.5)/(1.5 + 0.5) along xi = eta.
    e1, e2 = ellipticities(galaxies)
    assert np.allclose([e1[0], e2[0]], [0.0, 0.5])
    assert np.allclose([e1[1], e2[1]], [0.3, -0.2])


def test_galaxies_that_bury_the_sky_are_refused(small_run):
    def crowd(xi, eta):
        rng = np.random.default_rng(1)
        return Galaxies.single(rng.uniform(*xi, 300), rng.uniform(*eta, 300), 15.0, ARCSEC)

    with pytest.raises(DomainError, match=r"galaxies of .* electrons a pixel bury the sky"):
        draw_ccd(small_run, "R22_S11", crowd, window=Window(0, 0, 200, 200))


def test_a_run_without_atmosphere_is_refused(tiny):
    alone = Experiment.from_config(tiny(ccds=("R22_S11",), atmosphere__enabled=False))
    with pytest.raises(ConfigError, match=r"atmosphere\.enabled = false: images expect pixels of 10 um"):
        draw_ccd(alone, "R22_S11", nothing)


def test_public_names():
    assert pachon.draw_ccd is draw_ccd
    assert pachon.imaging.CcdImage is CcdImage
