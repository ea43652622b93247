"""Galaxies cut out of a mosaic and planted: detection, neighbours, transforms, the same galaxies in every region."""

import numpy as np
import pytest
from astropy.io import fits

from pachon.core.errors import DomainError, ProductError
from pachon.core.units import ARCMIN, ARCSEC
from pachon.sky.cutouts import Mosaic, cut_galaxies
from pachon.sky.mosaic import GalaxyStamps, PlantedGalaxies

#: LSST pixels, rotated and stretched a little.
JACOBIAN = np.array([[1.0, 0.1], [-0.15, 0.95]]) / (0.2 * ARCSEC)


@pytest.fixture(scope="module")
def stamps(mosaic):
    return GalaxyStamps.from_mosaic(mosaic.path)


def planted(stamps, angle=0.3):
    """Every stamp once, at one angle."""
    n = len(stamps)
    upright = PlantedGalaxies(stamps, np.arange(n), np.zeros(n), np.zeros(n), np.tile(np.eye(2), (n, 1, 1)))
    return upright.rotated(angle)


def brute_force(image, center, matrix, offset, size):
    """Transform of an image's pixels, each a point at matrix @ (pixel - centre) + offset."""
    y, x = np.mgrid[: len(image), : len(image)] - len(image) // 2
    places = np.stack([x - center[0], y - center[1]], axis=-1) @ matrix.T + offset
    kx, ky = np.meshgrid(np.fft.rfftfreq(size), np.fft.fftfreq(size))
    turns = kx[..., None, None] * places[..., 0] + ky[..., None, None] * places[..., 1]
    return np.sum(np.exp(-2j * np.pi * turns) * image, axis=(2, 3))


def test_transforms_are_those_of_the_pixels(stamps):
    g1, g2 = 0.1, -0.05
    galaxies = planted(stamps).sheared(g1, g2)
    n = len(galaxies)
    offset = np.random.default_rng(0).uniform(-2, 2, (n, 2))
    got = galaxies.transform(np.arange(n), np.tile(JACOBIAN, (n, 1, 1)), offset, 24)
    c, s = np.cos(0.3), np.sin(0.3)
    shear = np.array([[1 + g1, g2], [g2, 1 - g1]]) / np.sqrt(1 - g1**2 - g2**2)
    # The mosaic has east to the left.
    matrix = JACOBIAN @ shear @ np.array([[c, -s], [s, c]]) @ np.diag([-1.0, 1.0]) * 0.03 * ARCSEC
    for i in range(n):
        expected = brute_force(stamps.images[i], stamps.center[i], matrix, offset[i], 24)
        # Cubic interpolation at eight steps a cycle; most of the error is that of noise at the edges of stamps.
        assert np.abs(got[i] - expected).max() < 3e-4
    assert np.abs(got[:, 0, 0] - 1.0).max() < 1e-6


def test_transforms_are_galsims(stamps):
    galsim = pytest.importorskip("galsim")
    galaxies = planted(stamps, angle=0.0)
    size = 16
    brightest = int(np.argmin(stamps.magnitude))
    got = galaxies.transform([brightest], JACOBIAN[None], np.zeros((1, 2)), size)[0]
    image = galsim.Image(stamps.images[brightest].astype(float), scale=1.0)
    profile = galsim.InterpolatedImage(image, x_interpolant="lanczos15", normalization="flux")
    profile = profile.shift(*-stamps.center[brightest])
    matrix = JACOBIAN @ np.diag([-1.0, 1.0]) * 0.03 * ARCSEC
    profile = profile.transform(*matrix.ravel()) / abs(np.linalg.det(matrix))
    kx, ky = np.meshgrid(np.fft.rfftfreq(size), np.fft.fftfreq(size))
    wave = zip(2 * np.pi * kx.ravel(), 2 * np.pi * ky.ravel(), strict=True)
    expected = np.array([profile.kValue(*k) for k in wave]).reshape(kx.shape)
    # Lanczos's transform is 1 to 1e-3 here, and GalSim interpolates too.
    assert np.abs(got - expected).max() < 2e-3


def test_planted_galaxies_look_like_those_of_the_mosaic(mosaic, stamps):
    # The four brightest galaxies, at the seeing and the pixels of the LSST.
    galaxies = mosaic.galaxies
    wanted = np.argsort(galaxies.magnitude)[:4]
    size = 32
    k = np.fft.rfftfreq(size) ** 2 + np.fft.fftfreq(size)[:, None] ** 2
    psf = np.exp(-2 * (np.pi * 1.5) ** 2 * k)
    jacobian, offset = np.tile(JACOBIAN, (4, 1, 1)), np.zeros((4, 2))
    true = np.fft.irfft2(galaxies.transform(wanted, jacobian, offset, size) * psf)
    found = np.argsort(stamps.magnitude)[:4]
    seen = np.fft.irfft2(planted(stamps, angle=0.0).transform(found, jacobian, offset, size) * psf)
    alike = np.sum(true * seen, axis=(1, 2)) / np.sqrt(np.sum(true**2, axis=(1, 2)) * np.sum(seen**2, axis=(1, 2)))
    mirrored = np.sum(true * np.roll(seen[:, :, ::-1], 1, axis=2), axis=(1, 2))
    mirrored /= np.sqrt(np.sum(true**2, axis=(1, 2)) * np.sum(seen**2, axis=(1, 2)))
    # Squares of five semi-major axes cut off what lies outside, detection some faint parts.
    assert np.all(alike > 0.985)
    assert np.any(mirrored < alike - 0.01)
    # They hold less of the light, squares of ten more of it; pieces taken for neighbours are missing in both.
    lost = stamps.magnitude[found] - galaxies.magnitude[wanted]
    assert np.all((lost > 0.0) & (lost < 0.35))
    wider = np.sort(GalaxyStamps.from_mosaic(mosaic.path, side=10.0).magnitude)[:3] - galaxies.magnitude[wanted[:3]]
    assert np.all((wider > 0.0) & (wider < lost[:3] - 0.02))


def test_stars_are_left_out(mosaic, stamps):
    assert stamps.psf_radius == pytest.approx(mosaic.psf_radius, rel=0.06)
    assert np.all(stamps.radius > 1.1 * mosaic.psf_radius)
    # With a PSF that is smaller than the stars they stay in.
    all_of_them = GalaxyStamps.from_mosaic(mosaic.path, psf_radius=0.3 * mosaic.psf_radius)
    assert len(all_of_them) >= len(stamps) + len(mosaic.stars)


def test_faint_galaxies_are_found_to_the_noise(mosaic, stamps):
    bright = mosaic.galaxies.magnitude < 25.0
    resolved = mosaic.galaxies.radius > 1.5 * mosaic.psf_radius
    # Blends and the edge take some, irregular galaxies come in pieces.
    assert len(stamps) > 0.7 * np.sum(bright & resolved)
    assert len(stamps) < 2.0 * len(mosaic.galaxies)


def two_galaxies(gap, noise=1.0):
    """Two round galaxies of 3 pixels sigma a few sigma apart, and noise."""
    y, x = np.mgrid[:121, :141].astype(float)
    first = 300.0 * np.exp(-((x - 60) ** 2 + (y - 60) ** 2) / 18.0)
    second = 300.0 * np.exp(-((x - 60 - gap) ** 2 + (y - 60) ** 2) / 18.0)
    sky = np.random.default_rng(3).normal(5.0, noise, x.shape)
    return first, Mosaic("two", (first + second + sky).astype(np.float32), np.diag([-PIXEL, PIXEL]), 25.0)


PIXEL = 0.03 * ARCSEC


def test_neighbours_become_noise_of_the_sky():
    gap = 18
    first, image = two_galaxies(gap)
    cut = cut_galaxies(image, side=16.0, psf_radius=0.5, seed=1)
    square = cut.images[0]
    assert len(cut.images) == 2
    middle = len(square) // 2
    # The peak of the neighbour, of 300, is gone; on both sides there is the sky of rms 1.
    for column in (middle - gap, middle + gap):
        patch = square[middle - 4 : middle + 5, column - 4 : column + 5]
        assert np.std(patch) == pytest.approx(1.0, abs=0.3)
        assert abs(patch.mean()) < 0.6
    # The background of 5 is gone too, and the galaxy is all there.
    assert square.sum() == pytest.approx(first.sum(), rel=0.02)
    assert np.abs(cut.center).max() < 0.6
    # Half-light radius of a Gaussian.
    assert cut.radius == pytest.approx(3.0 * np.sqrt(2.0 * np.log(2.0)), rel=0.05)


def test_any_region_has_the_same_galaxies(stamps):
    population = stamps.population(5, density=40.0)
    whole = population.galaxies_in((-2 * ARCMIN, 2 * ARCMIN), (-2 * ARCMIN, 2 * ARCMIN))
    part = population.galaxies_in((-1.5 * ARCMIN, 0.3 * ARCMIN), (0.2 * ARCMIN, 1.1 * ARCMIN))
    inside = (whole.xi >= -1.5 * ARCMIN) & (whole.xi < 0.3 * ARCMIN)
    inside &= (whole.eta >= 0.2 * ARCMIN) & (whole.eta < 1.1 * ARCMIN)
    assert 20 < inside.sum() == len(part)
    for name in ("xi", "eta", "index", "distortion", "magnitude", "radius"):
        assert np.array_equal(getattr(part, name), getattr(whole, name)[inside])
    # Four sigma of a Poisson number; all stamps are used, at all angles.
    assert abs(len(whole) - 16 * 40) < 4 * np.sqrt(640)
    assert np.unique(whole.index).size > 0.9 * len(stamps)
    assert np.abs(whole.distortion.mean(axis=0)).max() < 0.15
    assert not np.isin(stamps.population(6, density=40.0).galaxies_in((0, 1e-3), (0, 1e-3)).xi, whole.xi).any()


def test_the_default_density_is_that_of_the_mosaic(mosaic, stamps):
    area = (mosaic.side * 0.03 / 60) ** 2
    assert stamps.population(1).density == pytest.approx(len(stamps) / area)


def test_transforms_do_not_depend_on_threads(stamps):
    galaxies = planted(stamps).take(slice(0, 5))
    jacobian, offset = np.tile(JACOBIAN, (5, 1, 1)), np.zeros((5, 2))
    one, three = (galaxies.transform(np.arange(5), jacobian, offset, 16, threads=t) for t in (1, 3))
    assert one.tobytes() == three.tobytes()


def test_rotations_and_positions(stamps):
    galaxies = stamps.population(5, density=40.0).galaxies_in((-ARCMIN, ARCMIN), (-ARCMIN, ARCMIN))
    turned = galaxies.rotated(np.pi / 2, positions=True)
    assert np.allclose([turned.xi, turned.eta], [-galaxies.eta, galaxies.xi], atol=1e-18)
    back = turned.sheared(0.2, 0.1, positions=True).sheared(-0.2, -0.1, positions=True).rotated(-np.pi / 2)
    assert np.allclose(back.distortion, galaxies.distortion, atol=1e-14)


def write(path, image, header):
    fits.PrimaryHDU(np.asarray(image, dtype=np.float32), header).writeto(path)
    return path


@pytest.mark.parametrize(
    ("change", "options", "text"),
    [
        ({"CTYPE1": "X", "CTYPE2": "Y"}, {}, "no celestial coordinates"),
        ({"MAGZPT": None}, {}, "MAGZPT or .* in its header, expected an AB zero point"),
        ({"MAGZPT": "bright"}, {}, "MAGZPT = 'bright': expected a finite AB zero point"),
        ({}, {"zero_point": np.inf}, "zero_point = inf: expected a finite"),
        ({}, {"zero_point": "PHOTZP"}, "no PHOTZP in its header"),
        ({}, {"psf_radius": 10 * ARCSEC}, "larger than the PSF"),
    ],
)
def test_mosaics_with_something_wrong(mosaic, tmp_path, change, options, text):
    header = mosaic.header.copy()
    for key, value in change.items():
        if value is None:
            del header[key]
        else:
            header[key] = value
    path = write(tmp_path / "wrong.fits", mosaic.image[:300, :300], header)
    with pytest.raises(ProductError, match=text) as error:
        GalaxyStamps.from_mosaic(path, **options)
    assert "wrong.fits" in str(error.value)
    assert "\n" not in str(error.value)


def test_mosaics_without_objects_or_images(mosaic, tmp_path):
    empty = np.random.default_rng(0).normal(size=(64, 64))
    # No eight connected pixels of a chequerboard stand above its own rms.
    empty = np.where(np.indices((64, 64)).sum(axis=0) % 2, 1.0, -1.0) + 0.01 * empty
    with pytest.raises(ProductError, match="no objects of 8 connected pixels"):
        GalaxyStamps.from_mosaic(write(tmp_path / "empty.fits", empty, mosaic.header))
    with pytest.raises(ProductError, match="no noise"):
        GalaxyStamps.from_mosaic(write(tmp_path / "flat.fits", np.ones((64, 64)), mosaic.header))
    with pytest.raises(ProductError, match="no finite pixels"):
        GalaxyStamps.from_mosaic(write(tmp_path / "nan.fits", np.full((64, 64), np.nan), mosaic.header))
    with pytest.raises(ProductError, match="no image of two axes"):
        GalaxyStamps.from_mosaic(write(tmp_path / "cube.fits", np.ones((2, 3, 4)), mosaic.header))
    (tmp_path / "text.fits").write_text("no FITS")
    with pytest.raises(ProductError, match="cannot be read as FITS"):
        GalaxyStamps.from_mosaic(tmp_path / "text.fits")
    with pytest.raises(ProductError, match="no such file"):
        GalaxyStamps.from_mosaic(tmp_path / "none.fits")
    few = write(tmp_path / "few.fits", mosaic.image[:200, :200], mosaic.header)
    with pytest.raises(ProductError, match="to find the stars"):
        GalaxyStamps.from_mosaic(few)


def test_images_in_extensions(mosaic, stamps, tmp_path):
    image = fits.ImageHDU(mosaic.image.astype(np.float32), mosaic.header)
    table = fits.BinTableHDU.from_columns([fits.Column("a", "D", array=[1.0])])
    fits.HDUList([fits.PrimaryHDU(), table, image]).writeto(tmp_path / "extension.fits")
    again = GalaxyStamps.from_mosaic(tmp_path / "extension.fits")
    assert np.array_equal(again.magnitude, stamps.magnitude)
    assert all(np.array_equal(a, b) for a, b in zip(again.images, stamps.images, strict=True))


def test_zero_points_of_the_hst_header(mosaic, tmp_path):
    header = mosaic.header.copy()
    # F775W of the Ultra Deep Field: the zero point of its catalogue is 25.654 (Beckwith et al. 2006).
    header["PHOTFLAM"], header["PHOTPLAM"] = 9.92e-20, 7693.0
    path = write(tmp_path / "hst.fits", mosaic.image, header)
    ours, given = GalaxyStamps.from_mosaic(path), GalaxyStamps.from_mosaic(path, zero_point="MAGZPT")
    assert ours.magnitude - given.magnitude == pytest.approx(25.654 - mosaic.zero_point, abs=0.02)


def test_densities_that_bury_the_sky(stamps):
    with pytest.raises(DomainError, match=r"density = 1e\+06 per square arcminute: galaxies would cover the sky"):
        stamps.population(1, density=1e6)
    with pytest.raises(DomainError, match="density"):
        stamps.population(1, density=-1.0)
    with pytest.raises(DomainError, match="seed = -2"):
        stamps.population(-2)


def test_pixels_that_are_too_fine(stamps):
    galaxies = planted(stamps)
    with pytest.raises(DomainError, match=r"finer than the stamps are made for, expected 0.2 arcsec or more"):
        galaxies.transform([0], np.eye(2)[None] / (0.05 * ARCSEC), np.zeros((1, 2)), 16)
