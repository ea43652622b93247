"""Images of other programs: planes, world coordinates, gain, zero point; what is missing or wrong is one line."""

import gzip

import numpy as np
import pytest
from astropy.coordinates import FK4, FK5, ICRS, SkyCoord
from astropy.io import fits
from astropy.nddata import CCDData, InverseVariance, StdDevUncertainty, VarianceUncertainty
from astropy.wcs import WCS
from drawn_fields import GAIN, SIDE, header_of, world
from numpy.polynomial import chebyshev, legendre, polynomial

import pachon
from pachon.core.errors import ConfigError, PachonError, ProductError
from pachon.core.units import ARCSEC
from pachon.imaging.image_formats.load import image_sources
from pachon.measure.catalogue.matching import match_positions

SATURATED, BAD = 1, 2


def write(path, *hdus):
    fits.HDUList(list(hdus)).writeto(path, overwrite=True)
    return path


def plain(path, field, header=None):
    return write(path, fits.PrimaryHDU(field.image, header_of() if header is None else header))


def test_a_plain_image_has_the_noise_that_it_shows(field, tmp_path):
    image = pachon.load_image(plain(tmp_path / "a.fits", field))
    # Sky in 25 cells: its rms is good to a per cent, objects hide none of it.
    assert np.median(image.variance / field.variance) == pytest.approx(1.0, abs=0.05)
    bright = field.variance > 3.0 * field.sky_variance
    assert np.median((image.variance / field.variance)[bright]) == pytest.approx(1.0, abs=0.1)
    assert (image.gain, image.zero_point, image.band, image.name) == (GAIN, 30.0, "r", "a")
    assert image.header["SKY"] == pytest.approx(400.0, abs=2.0)
    assert image.pixel_scale == pytest.approx(0.263 * ARCSEC, rel=1e-6)
    assert image.origins["gain"] == "GAIN"
    assert not image.mask.any()


@pytest.mark.parametrize(
    ("uncertainty", "power"), [(StdDevUncertainty, 0.5), (VarianceUncertainty, 1.0), (InverseVariance, -1.0)]
)
def test_uncertainties_of_astropy_are_of_their_kind(field, tmp_path, uncertainty, power):
    """All were taken for rms: variances of bright pixels came out 15 times too large."""
    noise = uncertainty(field.variance.astype(np.float64) ** power)
    CCDData(field.image, unit="adu", wcs=WCS(world()), uncertainty=noise, meta={"GAIN": GAIN}).write(
        tmp_path / "a.fits"
    )
    np.testing.assert_allclose(pachon.load_image(tmp_path / "a.fits").variance, field.variance, rtol=1e-5)


@pytest.mark.parametrize("name", ["SCI", ""])
def test_errors_count_before_weights(field, tmp_path, name):
    """Drizzled images have both; from relative weights no gain follows."""
    header = changed(GAIN=None, BUNIT="MJy/sr")
    image = fits.ImageHDU(field.image, header, name=name)
    errors = fits.ImageHDU(np.sqrt(field.variance), name="ERR")
    weights = fits.ImageHDU(np.full(field.image.shape, 800.0), name="WHT")
    loaded = pachon.load_image(write(tmp_path / "a.fits", fits.PrimaryHDU(), image, weights, errors))
    np.testing.assert_allclose(loaded.variance, field.variance, rtol=1e-5)
    assert loaded.gain == pytest.approx(GAIN, rel=0.02)


def test_corners_of_zeros_are_masked(field, tmp_path):
    """Resampled images have them; without a plane of weights they had "no noise"."""
    outside = np.add(*np.indices(field.image.shape)) < 0.8 * SIDE
    path = write(tmp_path / "a.fits", fits.PrimaryHDU(np.where(outside, np.float32(0.0), field.image), header_of()))
    image = pachon.load_image(path)
    assert np.array_equal(image.mask == BAD, outside)
    assert np.median((image.variance / field.variance)[~outside]) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("cards", [{}, {"SATURATE": 65535.0}])
def test_clipped_pixels_are_saturated_whatever_the_card(field, tmp_path, cards):
    """Their stars made the PSF of an image wide, and its galaxies 20 % too elliptical."""
    level = np.float32(0.5 * field.image.max())
    path = write(tmp_path / "a.fits", fits.PrimaryHDU(np.minimum(field.image, level), header_of(**cards)))
    image = pachon.load_image(path)
    assert np.array_equal(image.mask == SATURATED, field.image >= level)
    assert image.origins["saturation"] == "clipped pixels"


def des_parts(field, compressed):
    kind = fits.CompImageHDU if compressed else fits.ImageHDU
    mask = np.zeros(field.image.shape, dtype=np.int16)
    mask[10, 10], mask[11, 11], mask[12, 12], mask[13, 13] = 2, 1, 32, 2 | 4
    weight = (1.0 / field.variance).astype(np.float32)
    weight[20, 20] = 0.0
    options = {"quantize_level": 64} if compressed else {}
    return [
        fits.PrimaryHDU(),
        kind(field.image, header_of(), name="SCI", **options),
        kind(mask, name="MSK"),
        kind(weight, name="WGT", **options),
    ]


@pytest.mark.parametrize("compressed", [False, True])
def test_an_image_of_des(field, tmp_path, compressed):
    fits.HDUList(des_parts(field, compressed)).writeto(tmp_path / "D01.fits.fz", checksum=True)
    image = pachon.load_image(tmp_path / "D01.fits.fz")
    at = {(10, 10): SATURATED, (11, 11): BAD, (12, 12): 0, (13, 13): SATURATED, (20, 20): BAD, (0, 0): 0}
    assert {place: image.mask[place] for place in at} == at
    good = image.mask == 0
    # Compression rounds pixels to a fraction of their noise.
    np.testing.assert_allclose(image.variance[good], field.variance[good], rtol=0.02)
    np.testing.assert_allclose(image.image[good], field.image[good], atol=0.5)
    assert image.name == "D01"


def lsst_parts(field):
    planes = fits.Header({"MP_BAD": 0, "MP_SAT": 1, "MP_INTRP": 2, "HIERARCH MP_NOT_DEBLENDED": 9})
    mask = np.full(field.image.shape, 1 << 9, dtype=np.int32)
    mask[10, 10] |= 2 | 4
    mask[11, 11] |= 4
    header = world()
    header["BUNIT"] = "nJy"
    return [
        fits.PrimaryHDU(header=fits.Header({"FILTER": "i2", "EXPTIME": 30.0})),
        fits.ImageHDU(field.image, header, name="IMAGE"),
        fits.ImageHDU(mask, planes, name="MASK"),
        fits.ImageHDU(field.variance.astype(np.float32), name="VARIANCE"),
        fits.ImageHDU(np.ones((5, 5)), name="PSF"),
    ]


def test_an_image_of_lsst_has_the_gain_of_its_variance(field, tmp_path):
    image = pachon.load_image(write(tmp_path / "calexp.fits", *lsst_parts(field)))
    assert {place: image.mask[place] for place in ((10, 10), (11, 11), (0, 0))} == {
        (10, 10): SATURATED,
        (11, 11): BAD,
        (0, 0): 0,
    }
    assert image.gain == pytest.approx(GAIN, rel=0.02)
    assert (image.zero_point, image.band, image.header["EXPTIME"]) == (31.4, "i2", 30.0)


def test_units_in_which_variances_are_no_numbers(field, tmp_path):
    """As of erg/s/cm^2/Hz: no objects were detected."""
    path = write(tmp_path / "a.fits", fits.PrimaryHDU(1e-24 * field.image.astype(float), header_of(GAIN=1e24)))
    with pytest.raises(ProductError, match=r"a\.fits: noise of 1\.\de-23 in a pixel: expected 1e-21 or more"):
        pachon.load_image(path)


def test_whole_numbers_have_the_sky_of_the_light(field, tmp_path):
    """Cameras write them: the mode by a median of whole numbers was 0.9 off, fluxes 20 % at a noise of 1.5."""
    light = (field.image / 9.0).astype(np.float32)
    images = [
        pachon.load_image(write(tmp_path / f"{pixels.dtype}.fits", fits.PrimaryHDU(pixels, header_of(GAIN=9.0 * GAIN))))
        for pixels in (light, np.rint(light).astype(np.int16))
    ]
    skies = [image.header["SKY"] for image in images]
    assert skies[1] == pytest.approx(skies[0], abs=0.05)
    measured, whole = (pachon.detect_objects(image.image, image.variance) for image in images)
    assert abs(whole.background - measured.background).max() < 0.1
    matched = match_positions(measured.x, measured.y, whole.x, whole.y, 1.0)
    ratio = whole.flux[matched[matched >= 0]] / measured.flux[matched >= 0]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.005)


def test_weights_and_masks_of_files_of_their_own(field, tmp_path):
    path = plain(tmp_path / "a.fits", field)
    # Of the sky alone, in a scale of its own, as SExtractor takes them.
    weight = np.full(field.image.shape, 7.0, dtype=np.float32)
    weight[5] = 0.0
    mask = np.zeros(field.image.shape, dtype=np.uint8)
    mask[:, 7] = 1
    write(tmp_path / "w.fits", fits.PrimaryHDU(weight))
    write(tmp_path / "m.fits", fits.PrimaryHDU(mask))
    image = pachon.load_image(
        path,
        settings=pachon.imaging.ImageSettings(weight=tmp_path / "w.fits", mask=tmp_path / "m.fits", saturation=3000.0),
    )
    assert (image.mask[5] & BAD).all()
    assert (image.mask[:, 7] & BAD).all()
    good = image.mask == 0
    assert np.median(image.variance[good] / field.variance[good]) == pytest.approx(1.0, abs=0.05)
    np.testing.assert_array_equal(image.mask == SATURATED, (field.image >= 3000.0) & ((image.mask & BAD) == 0))
    assert "scaled to the noise of the sky" in image.origins["variance"]
    for kind, values in (("rms", np.sqrt(field.variance)), ("variance", field.variance)):
        write(tmp_path / "w.fits", fits.PrimaryHDU(values.astype(np.float32)))
        settings = pachon.imaging.ImageSettings(weight=tmp_path / "w.fits", weight_kind=kind)
        np.testing.assert_allclose(pachon.load_image(path, settings=settings).variance, field.variance, rtol=1e-5)


def test_a_file_of_many_images(field, tmp_path):
    header = header_of()
    write(
        tmp_path / "m.fits",
        fits.PrimaryHDU(header=fits.Header({"FILTER": "z"})),
        fits.ImageHDU(field.image, header, name="N4"),
        fits.ImageHDU(field.image.T, header, name="S4"),
    )
    with pytest.raises(ProductError, match=r"m\.fits: has 2 images: expected extension = one of N4, S4"):
        pachon.load_image(tmp_path / "m.fits")
    image = pachon.load_image(tmp_path / "m.fits", extension="s4")
    np.testing.assert_array_equal(image.image, field.image.T)
    assert image.name == "S4"
    assert np.array_equal(pachon.load_image(tmp_path / "m.fits", extension="1").image, field.image)
    with pytest.raises(ProductError, match="extension = S5: expected one of N4, S4"):
        pachon.load_image(tmp_path / "m.fits", extension="S5")


def test_images_of_one_name_have_the_planes_of_their_version(field, tmp_path):
    # As in files of HST's cameras of two chips.
    hdus = [fits.PrimaryHDU()]
    for version in (1, 2):
        mask = np.zeros(field.image.shape, dtype=np.int16)
        mask[: 10 * version] = 4
        rms = np.sqrt(field.variance * (1.0 + 0.1 * version))
        hdus.append(fits.ImageHDU(field.image, header_of(), name="SCI", ver=version))
        hdus.append(fits.ImageHDU(rms.astype(np.float32), name="ERR", ver=version))
        hdus.append(fits.ImageHDU(mask, name="DQ", ver=version))
    path = write(tmp_path / "chips.fits", *hdus)
    with pytest.raises(ProductError, match=r"has 2 images: expected extension = one of SCI,1, SCI,2"):
        pachon.load_image(path)
    with pytest.raises(ProductError, match=r"extension = SCI,3: expected one of SCI,1, SCI,2"):
        pachon.load_image(path, extension="SCI,3")
    for extension, version in (("SCI,1", 1), ("sci,2", 2), ("4", 2)):
        image = pachon.load_image(path, extension=extension)
        assert image.name == f"SCI,{version}"
        assert ((image.mask != 0).sum(axis=1) > 0).sum() == 10 * version
        good = image.mask == 0
        expected = (1.0 + 0.1 * version) * field.variance[good]
        np.testing.assert_allclose(image.variance[good], expected, rtol=1e-5)
    assert [source.extension for source in image_sources(path)] == ["SCI,1", "SCI,2"]


def test_pixels_without_a_value_have_no_weight(field, tmp_path):
    data, variance = field.image.copy(), field.variance.astype(np.float32)
    data[10:20], data[30, 30], variance[40], variance[50, 50] = np.nan, -np.inf, np.nan, 0.0
    variance[60, 60] = 1e30  # SExtractor's, by which the detection found the image too bright
    write(
        tmp_path / "a.fits",
        fits.PrimaryHDU(),
        fits.ImageHDU(data, header_of(CCDNUM="N4"), name="SCI"),
        fits.ImageHDU(variance, name="VAR"),
    )
    image = pachon.load_image(tmp_path / "a.fits")
    for place in ((10, 3), (30, 30), (40, 7), (50, 50), (60, 60)):
        assert image.mask[place] == BAD
    assert np.isfinite(image.image).all()
    assert (image.mask != 0).sum() == 10 * SIDE + 1 + SIDE + 2
    # An image without noise has no sky to measure.
    write(tmp_path / "b.fits", fits.PrimaryHDU(np.full((64, 64), 5.0), header_of()))
    with pytest.raises(ProductError, match="its pixels have no noise"):
        pachon.load_image(tmp_path / "b.fits")


def test_gzip(field, tmp_path):
    path = plain(tmp_path / "a.fits", field)
    (tmp_path / "b.fits.gz").write_bytes(gzip.compress(path.read_bytes(), 1))
    image = pachon.load_image(tmp_path / "b.fits.gz")
    assert image.name == "b"
    assert np.array_equal(image.image, field.image)


@pytest.mark.parametrize(
    ("cards", "gain"),
    [
        ({"GAIN": 0.0, "EGAIN": 1.7}, 1.7),
        ({"GAINA": 4.0, "GAINB": 5.0}, 4.5),
        ({"BUNIT": "electron", "GAIN": 4.0}, 1.0),
        ({"BUNIT": "electron/s", "EXPTIME": 50.0}, 50.0),
        ({"HIERARCH ESO DET OUT1 CONAD": 2.2, "GAIN": 0.45}, 2.2),
        ({"GAIN": "1.9"}, 1.9),
    ],
)
def test_gains_of_headers(field, tmp_path, cards, gain):
    header = world()
    header.update({"EXPTIME": 90.0} | cards)
    assert pachon.load_image(plain(tmp_path / "a.fits", field, header)).gain == pytest.approx(gain)


def test_zero_points_of_headers(field, tmp_path):
    for cards, expected in (
        ({"MAGZPT": 25.5}, 25.5),
        ({"FLUXMAG0": 10.0**10.8}, 27.0),
        ({"BUNIT": "nanomaggy", "GAIN": 1.0}, 22.5),
        ({}, None),
    ):
        header = world()
        header.update({"GAIN": GAIN} | cards)
        settings = pachon.imaging.ImageSettings(gain=2.0)
        found = pachon.load_image(plain(tmp_path / "a.fits", field, header), settings=settings).zero_point
        assert found == (None if expected is None else pytest.approx(expected))


def tnx_header(kind, cross, terms, projection="TNX"):
    """World coordinates of IRAF: coefficients of x^i y^j, i faster; 0, 1, 2: no, all, half of the cross terms."""
    header = world()
    for axis, word, coordinate in (("1", "lngcor", 0), ("2", "latcor", 1)):
        header[f"CTYPE{axis}"] = header[f"CTYPE{axis}"].replace("TAN", projection)
        numbers = " ".join(repr(float(value)) for value in terms[coordinate])
        sky, limits = ("ra", "dec")[coordinate], "-0.1 0.1 -0.2 0.2"
        text = f'wtype=tnx axtype={sky} {word} = "{kind}. 4. 4. {cross}. {limits} {numbers} "'
        for i in range(0, len(text), 68):
            header[f"WAT{axis}_{i // 68 + 1:03d}"] = text[i : i + 68]
    return header


@pytest.mark.parametrize(("kind", "cross", "count"), [(1, 2, 10), (2, 1, 16), (3, 2, 10), (3, 0, 7)])
def test_tnx_is_its_polynomial(field, tmp_path, kind, cross, count):
    terms = np.random.default_rng(kind).normal(0.0, 1e-4, (2, count))
    image = pachon.load_image(plain(tmp_path / "a.fits", field, header_of(**tnx_header(kind, cross, terms))))
    pixels = np.random.default_rng(1).uniform(0, SIDE - 1, (5, 2))
    scale = 0.263 / 3600
    xi, eta = ((pixels + 1 - 0.5 * SIDE) * [-scale, scale]).T
    corrected = []
    for values, coefficients in zip((xi, eta), terms, strict=True):
        table, k = np.zeros((4, 4)), 0
        for j in range(4):
            for i in range({1: 4, 2: 4 - j, 0: 4 if j == 0 else 1}[cross]):
                table[i, j] = coefficients[k]
                k += 1
        evaluate = {1: chebyshev.chebval2d, 2: legendre.legval2d, 3: polynomial.polyval2d}[kind]
        corrected.append(values + evaluate(*((xi, eta) if kind == 3 else (xi / 0.1, eta / 0.2)), table))
    tangent = WCS({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 150.0, "CRVAL2": 2.0, "CRPIX1": 1.0,
                   "CRPIX2": 1.0, "CDELT1": 1.0, "CDELT2": 1.0})  # fmt: skip
    expected = tangent.all_pix2world(np.stack(corrected, axis=1), 0)
    np.testing.assert_allclose(image.celestial(pixels), expected, atol=1e-9)
    np.testing.assert_allclose(image.pixels_at(expected), pixels, atol=1e-4)


@pytest.mark.parametrize("kind", ["TPV", "SIP", "PC", "CDELT", "SCAMP"])
def test_world_coordinates_agree_with_galsim(field, tmp_path, kind):
    galsim = pytest.importorskip("galsim")
    header = header_of()
    if kind in ("TPV", "SCAMP"):
        # SCAMP's first headers have the polynomials of TPV under TAN.
        if kind == "TPV":
            header["CTYPE1"], header["CTYPE2"] = "RA---TPV", "DEC--TPV"
        header.update({"PV1_0": 1e-4, "PV1_1": 1.001, "PV1_2": 2e-4, "PV1_4": 0.1, "PV1_7": 0.2})
        header.update({"PV2_0": -1e-4, "PV2_1": 0.999, "PV2_2": 1e-4, "PV2_5": 0.2, "PV2_7": -0.1})
    elif kind == "SIP":
        header["CTYPE1"], header["CTYPE2"] = "RA---TAN-SIP", "DEC--TAN-SIP"
        header.update({"A_ORDER": 2, "B_ORDER": 2, "A_2_0": 1e-5, "A_1_1": 2e-6, "B_0_2": -1e-5, "B_1_1": 3e-6})
    else:
        for key in ("CD1_1", "CD1_2", "CD2_1", "CD2_2"):
            del header[key]
        header["CDELT1"], header["CDELT2"] = -0.263 / 3600, 0.263 / 3600
        if kind == "PC":
            header.update({"PC1_1": 0.8, "PC1_2": -0.6, "PC2_1": 0.6, "PC2_2": 0.8})
    image = pachon.load_image(plain(tmp_path / "a.fits", field, header))
    wcs = galsim.FitsWCS(header=galsim.FitsHeader(header=header))
    for x, y in ((0.0, 0.0), (300.0, 17.5)):
        sky = wcs.toWorld(galsim.PositionD(x + 1, y + 1))
        expected = [sky.ra / galsim.degrees, sky.dec / galsim.degrees]
        # A microarcsecond.
        np.testing.assert_allclose(image.celestial(np.array([[x, y]]))[0], expected, atol=3e-10)


@pytest.mark.parametrize("axes", [{"GLAT-TAN": -20.0, "GLON-TAN": 120.0}, {"GLON-TAN": 120.0, "GLAT-TAN": -20.0}])
def test_galactic_coordinates_and_swapped_axes(field, tmp_path, axes):
    header = header_of()
    (header["CTYPE1"], header["CRVAL1"]), (header["CTYPE2"], header["CRVAL2"]) = axes.items()
    image = pachon.load_image(plain(tmp_path / "a.fits", field, header))
    at = np.array([[0.5 * SIDE - 1.0] * 2])
    expected = SkyCoord(l=120.0, b=-20.0, unit="deg", frame="galactic").icrs
    np.testing.assert_allclose(image.celestial(at)[0], [expected.ra.deg, expected.dec.deg], atol=1e-9)
    np.testing.assert_allclose(image.pixels_at(image.celestial(at)), at, atol=1e-6)


@pytest.mark.parametrize(
    ("cards", "frame"),
    [
        ({"EPOCH": 1950.0}, FK4(equinox="B1950")),
        ({"RADECSYS": "FK4"}, FK4(equinox="B1950")),
        ({"RADESYS": "icrs"}, ICRS()),
        ({"RADECSYS": "FK5", "EQUINOX": 1975.0}, FK5(equinox="J1975")),
        ({"RADECSYS": "ICRS", "EQUINOX": 2000.0, "EPOCH": 1950.0}, ICRS()),
        ({"EPOCH": "survey"}, ICRS()),
    ],
)
def test_equinox_and_system_by_their_old_names(field, tmp_path, cards, frame):
    image = pachon.load_image(plain(tmp_path / "a.fits", field, header_of(**cards)))
    at = np.array([[0.5 * SIDE - 1.0] * 2])
    expected = SkyCoord(150.0, 2.0, unit="deg", frame=frame).icrs
    np.testing.assert_allclose(image.celestial(at)[0], [expected.ra.deg, expected.dec.deg], atol=1e-9)
    np.testing.assert_allclose(image.pixels_at(image.celestial(at)), at, atol=1e-6)


def changed(**cards):
    header = header_of()
    for key, value in cards.items():
        if value is None:
            del header[key]
        else:
            header[key] = value
    return header


@pytest.mark.parametrize(
    ("header", "settings", "text"),
    [
        (changed(GAIN=None), {}, r"a\.fits: no gain \(none of EGAIN, GAIN, .*: expected gain"),
        (changed(GAIN="NaN"), {}, r"a\.fits: GAIN = nan: expected a finite number"),
        (changed(GAIN=-2.0), {}, r"a\.fits: GAIN = -2\.0: expected a number above 0"),
        (changed(MAGZERO="unknown"), {}, r"a\.fits: MAGZERO = 'unknown': expected a finite number"),
        (changed(CRVAL1="NaN"), {}, r"a\.fits: CRVAL1 = 'NaN': expected a finite number"),
        (changed(CD1_1=0.0, CD2_1=0.0), {}, r"a\.fits: CD1_1, .*: expected a matrix with an inverse"),
        (changed(CD1_1=0.0, CD2_2=0.0), {}, r"a\.fits: CD1_1, .*: expected a matrix with an inverse"),
        (changed(CTYPE1="RA---XYZ", CTYPE2="DEC--XYZ"), {}, r"a\.fits: CTYPE1 = RA---XYZ: expected world"),
        (changed(CTYPE1="LINEAR", CTYPE2="LINEAR"), {}, r"a\.fits: no world coordinates \(CTYPE1 = 'LINEAR'"),
        # astropy takes ecliptic coordinates for those of ICRS, and has no frame for other systems.
        (changed(CTYPE1="ELON-TAN", CTYPE2="ELAT-TAN"), {}, r"a\.fits: no world coordinates \(CTYPE1 = 'ELON-TAN'"),
        (changed(BSOFTEN=3.0), {}, r"a\.fits: BSOFTEN = 3\.0: pixels are inverse hyperbolic sines .* expected linear"),
        (changed(RADECSYS="J2000"), {}, r"a\.fits: RADECSYS = J2000: expected ICRS, FK5, FK4 or FK4-NO-E"),
        (
            changed(CTYPE2="RA---TAN"),
            {},
            r"a\.fits: CTYPE1 = RA---TAN: .* reads \(Inconsistent projection",
        ),
        (changed(SATURATE=10.0), {}, r"a\.fits: all pixels are masked, saturated or not finite"),
        (changed(), {"weight": "none.fits"}, r"none\.fits: no such file"),
    ],
)
def test_headers_that_lack_or_damage_something(field, tmp_path, header, settings, text):
    path = plain(tmp_path / "a.fits", field, header)
    with pytest.raises(PachonError, match=text) as caught:
        pachon.load_image(path, settings=pachon.imaging.ImageSettings(**settings))
    assert "\n" not in str(caught.value)


def test_a_card_that_is_no_fits_value(field, tmp_path):
    path = plain(tmp_path / "a.fits", field)
    data = path.read_bytes()
    i = data.index(b"GAIN    =")
    path.write_bytes(data[:i] + b"GAIN    =                  NaN".ljust(80) + data[i + 80 :])
    with pytest.raises(ProductError, match=r"a\.fits: GAIN"):
        pachon.load_image(path)


def test_planes_that_do_not_fit(field, tmp_path):
    path = plain(tmp_path / "a.fits", field)
    other = tmp_path / "w.fits"
    for values, kind, text in (
        (np.zeros(field.image.shape), "weight", r"w\.fits: image: no pixel has a weight above zero"),
        (np.ones((10, 12)), "weight", r"w\.fits: image has 12 x 10 pixels: expected 320 x 320, those of the image"),
        (np.ones((10, 12)), "mask", r"w\.fits: image has 12 x 10 pixels: expected 320 x 320, those of the image"),
        (np.full(field.image.shape, 0.5), "mask", r"w\.fits: mask .*: expected whole numbers"),
        (np.ones(field.image.shape), "mask", r"a\.fits: all pixels are masked, saturated or not finite"),
    ):
        write(other, fits.PrimaryHDU(values))
        with pytest.raises(ProductError, match=text):
            pachon.load_image(path, settings=pachon.imaging.ImageSettings(**{kind: other}))
    write(other, fits.PrimaryHDU(), fits.ImageHDU(field.image, name="A"), fits.ImageHDU(field.image, name="B"))
    with pytest.raises(ProductError, match=r"w\.fits: has 2 images: expected one"):
        pachon.load_image(path, settings=pachon.imaging.ImageSettings(weight=other))
    for data, text in ((b"this is no FITS file", "damaged or not FITS"), (path.read_bytes()[:9000], "truncated")):
        other.write_bytes(data)
        with pytest.raises(ProductError, match=rf"w\.fits: .*{text}"):
            pachon.load_image(other)
    write(other, fits.PrimaryHDU(np.zeros((3, 40, 40))))
    with pytest.raises(ProductError, match="has no image of two axes"):
        pachon.load_image(other)


def test_a_wrong_checksum_is_damage(field, tmp_path):
    path = tmp_path / "a.fits"
    fits.PrimaryHDU(field.image, header_of()).writeto(path, checksum=True)
    assert np.array_equal(pachon.load_image(path).image, field.image)
    data = bytearray(path.read_bytes())
    data[-4000] ^= 16
    path.write_bytes(data)
    with pytest.raises(ProductError, match="does not match its checksum"):
        pachon.load_image(path)


def test_settings():
    for settings, text in (
        ({"gain": 0.0}, "gain = 0"),
        ({"weight_kind": "sigma"}, "weight_kind = 'sigma': expected one of weight, variance, rms"),
        ({"zero_point": np.nan}, "zero_point = nan"),
        ({"pixel_scale": -1.0}, "pixel_scale"),
    ):
        with pytest.raises((ConfigError, pachon.errors.DomainError), match=text):
            pachon.imaging.ImageSettings(**settings)


def test_without_world_coordinates_the_scale_of_a_pixel_is_enough(field, tmp_path):
    path = plain(tmp_path / "a.fits", field, fits.Header({"GAIN": GAIN}))
    image = pachon.load_image(path, settings=pachon.imaging.ImageSettings(pixel_scale=0.2 * ARCSEC))
    assert not image.has_sky
    assert image.pixel_scale == pytest.approx(0.2 * ARCSEC)
    assert image.plot() is not None


def test_images_of_this_program_are_read_as_they_are(field, tmp_path):
    header = header_of()
    header.update({"ZEROPNT": 30.0})
    image = pachon.imaging.CcdImage("R22_S11", field.image, field.variance, np.zeros(field.image.shape, int), header)
    image.write(tmp_path / "own.fits")
    back = pachon.load_image(tmp_path / "own.fits")
    assert back.name == "R22_S11"
    assert np.array_equal(back.image, field.image)
    assert len(back.objects["X"]) == 0
    # Without FILTER's EXPTIME, ZEROPNT and objects there is still a picture.
    bare = pachon.imaging.CcdImage("a", field.image, field.variance, back.mask, fits.Header({"FILTER": "r"}))
    assert bare.plot() is not None
    bare.write(tmp_path / "bare.fits")
    assert pachon.imaging.CcdImage.read(tmp_path / "bare.fits").zero_point is None
