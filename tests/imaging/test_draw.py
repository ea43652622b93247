"""Galaxies under a PSF, against closed forms, GalSim, and the two ways against each other."""

import numpy as np
import pytest

from pachon.core.errors import ConfigError
from pachon.core.units import ARCSEC
from pachon.imaging.draw import SIZES, Window, add_stamps, draw_galaxies, grid_sizes
from pachon.imaging.psf_field import PsfField
from pachon.measure.shapes import measure_shapes
from pachon.sky.galaxies import Galaxies

#: Half-light radius of a Gaussian of unit rms width, sqrt(2 ln 2).
HALF_LIGHT = np.sqrt(2.0 * np.log(2.0))
PART = Window(1000, 2000, 400, 300)


def placed(wcs, pixels, **options):
    """Galaxies of one component at pixels."""
    sky = wcs.to_sky(pixels)
    values = {"magnitude": np.full(len(sky), 24.0), "radius": np.full(len(sky), 0.5 * ARCSEC)} | options
    return Galaxies.single(sky[:, 0], sky[:, 1], **values)


def cut(image, pixel, window=PART, size=63):
    """Return a stamp about the pixel nearest to a place, and the place from its middle."""
    x, y = np.rint(pixel).astype(int)
    rows, columns = (slice(v - o - size // 2, v - o + size // 2 + 1) for v, o in ((y, window.y), (x, window.x)))
    return image[rows, columns], np.asarray(pixel) - (x, y)


@pytest.mark.long
@pytest.mark.parametrize("way", ["direct", "eigen"])
def test_gaussian_galaxies_under_gaussian_psfs_have_the_sum_of_the_covariances(wcs, psf, way, gaussian, psf_covariance):
    pixels = np.array([[1080.3, 2101.8], [1290.0, 2090.45]])
    e = np.array([0.25 + 0.1j, -0.1 + 0.2j])
    radius = 0.6 * ARCSEC
    galaxies = placed(wcs, pixels, e1=e.real, e2=e.imag, sersic=0.5, radius=np.full(2, radius))
    electrons = np.array([1e5, 3e4])
    image = draw_galaxies(galaxies, electrons, psf, wcs, window=PART, way=way)
    for pixel, shape, light in zip(pixels, e, electrons, strict=True):
        # Covariance of the galaxy on the sky, of axes a, b with ab = sigma^2 and (a - b)/(a + b) = |e|.
        turn = shape / abs(shape)
        long, short = (1.0 + abs(shape)) / (1.0 - abs(shape)), (1.0 - abs(shape)) / (1.0 + abs(shape))
        mean, half = 0.5 * (long + short), 0.5 * (long - short)
        on_sky = (radius / HALF_LIGHT) ** 2 * np.array(
            [[mean + half * turn.real, half * turn.imag], [half * turn.imag, mean - half * turn.real]]
        )
        jacobian = wcs.jacobians(pixel)[0]
        stamp, offset = cut(image, pixel)
        expected = light * gaussian(63, jacobian @ on_sky @ jacobian.T + psf_covariance(pixel), offset)
        # Twenty components hold the PSFs to 1e-5 of their peak, single precision and the sampling to less.
        assert np.abs(stamp - expected).max() < 1e-4 * expected.max()


def test_no_light_is_lost_or_gained(wcs, psf):
    pixels = np.random.default_rng(1).uniform([1100, 2100], [1300, 2200], (30, 2))
    galaxies = placed(wcs, pixels, sersic=1.0)
    electrons = np.linspace(10.0, 1e4, 30)
    image = draw_galaxies(galaxies, electrons, psf, wcs, window=PART)
    assert image.sum(dtype=np.float64) == pytest.approx(electrons.sum(), rel=1e-5)
    assert image.dtype == np.float32


@pytest.mark.long
@pytest.mark.parametrize("way", ["direct", "eigen"])
def test_no_byte_depends_on_threads_and_no_pixel_on_the_window(wcs, psf, way):
    pixels = np.random.default_rng(1).uniform([900, 1900], [1500, 2400], (60, 2))
    galaxies = placed(wcs, pixels)
    light = np.linspace(10.0, 3e4, 60)
    one, three = (draw_galaxies(galaxies, light, psf, wcs, window=PART, way=way, threads=n) for n in (1, 3))
    assert one.tobytes() == three.tobytes()
    inner = Window(1100, 2060, 150, 100)
    part = draw_galaxies(galaxies, light, psf, wcs, window=inner, way=way)
    # The ways cut the scene at other places: differences are those of rounding, and of softened light cut at its rim.
    assert np.abs(part - one[60:160, 100:250]).max() < (1e-6 if way == "direct" else 1e-4) * one.max()


def test_both_ways_have_the_same_moments(wcs, psf):
    # Isolated galaxies, small and large, of all profiles.
    pixels = np.array([[1050.2, 2051.7], [1150.8, 2050.1], [1250.5, 2050.5], [1340.0, 2052.2], [1100.3, 2200.6]])
    galaxies = placed(
        wcs,
        pixels,
        radius=np.array([0.05, 0.2, 0.4, 0.3, 0.8]) * ARCSEC,
        sersic=np.array([1.0, 1.0, 0.5, 4.0, 1.0]),
        e1=np.array([0.2, -0.3, 0.1, 0.2, 0.3]),
        e2=np.array([0.1, 0.2, -0.2, 0.0, -0.1]),
    )
    electrons = np.full(5, 1e5)
    shapes = []
    for way in ("direct", "eigen"):
        image = draw_galaxies(galaxies, electrons, psf, wcs, window=PART, way=way, noise=0.1)
        stamps = np.stack([cut(image, pixel)[0] for pixel in pixels])
        shapes.append(measure_shapes(stamps.astype(np.float64), 0.2 * ARCSEC, 0.9 * ARCSEC))
    direct, eigen = shapes
    # What differs is that the eigen way has the PSF of each pixel of a galaxy, and not that of its centre.
    for name in ("e1", "e2"):
        assert np.abs(getattr(direct, name) - getattr(eigen, name)).max() < 1e-4
    assert np.abs(direct.size / eigen.size - 1.0).max() < 1e-4
    assert np.abs(np.stack([direct.x - eigen.x, direct.y - eigen.y])).max() < 1e-3


def test_what_wraps_round_is_below_a_hundredth_of_the_noise(wcs, psf):
    # The grid chosen for a galaxy against the largest one.
    pixels = np.array([[1200.0, 2150.0]])
    # Elongated ones, of axis ratios of a quarter and a sixth, had grids of round ones: 1.2 and 2.3 electrons wrapped.
    for sersic, radius, light, e in (
        (4.0, 0.5, 3e4, 0.0), (1.0, 1.5, 1e5, 0.0), (1.0, 0.2, 100.0, 0.0), (4.0, 0.2, 5.8e4, 0.6), (1.0, 4.0, 6e4, 0.7)
    ):  # fmt: skip
        galaxy = placed(wcs, pixels, sersic=sersic, radius=np.array([radius * ARCSEC]), e1=e)
        size = grid_sizes(galaxy, np.array([light]), np.array([5.0 / ARCSEC]), psf.profile(), 24.0)[0]
        assert size < SIZES[-1]
        window = Window(1200 - 150, 2150 - 150, 300, 300)
        chosen, largest = (
            draw_galaxies(galaxy, np.array([light]), psf, wcs, window=window, noise=n) for n in (24.0, 1e-6)
        )
        # Four images of the galaxy meet in a corner of the grid, two at its sides.
        assert np.abs(chosen - largest).max() < 4.0 * 0.01 * 24.0


def test_brighter_and_larger_galaxies_have_larger_grids():
    profile = np.array([0.1, 1e-3, 1e-4, 1e-5])
    light, one = np.array([10.0, 1e4, 1e6, 1e10]), np.ones(4)
    galaxies = Galaxies.single(0.0, 0.0, 20.0, np.array([1.0, 1.0, 3.0, 20.0]), sersic=4.0)
    sizes = grid_sizes(galaxies, light, one, profile, 24.0)
    assert (np.diff(sizes) >= 0).all()
    assert (sizes[0], sizes[-1]) == (SIZES[0], SIZES[-1])
    assert (grid_sizes(galaxies, light, one, profile, 0.24) >= sizes).all()


def test_stamps_are_cut_at_the_rim():
    image, brute = np.zeros((10, 12), dtype=np.float32), np.zeros((30, 32))
    stamps = np.arange(3 * 16, dtype=np.float32).reshape(3, 4, 4)
    corners = np.array([[-2, 3], [10, 8], [-9, 0]])
    add_stamps(image, stamps, corners)
    for stamp, (x, y) in zip(stamps, corners, strict=True):
        brute[y + 10 : y + 14, x + 10 : x + 14] += stamp
    assert (image == brute[10:20, 10:22]).all()


def test_a_psf_on_a_smaller_grid_wraps_round(psf):
    stamp = np.fft.irfft2(psf.transforms(24), s=(24, 24))
    brute = np.zeros((24, 24))
    for (y, x), value in np.ndenumerate(psf.model.mean):
        brute[(y - 15 + 12) % 24, (x - 15 + 12) % 24] += value
    assert np.allclose(stamp[0], brute, atol=1e-7)


def test_psf_and_lit_fraction_are_those_of_the_place(psf, gaussian, psf_covariance):
    place = np.array([[700.0, 3000.0], [4000.0, 100.0]])
    drawn = np.einsum("nk,kij->nij", psf.amplitudes(place), np.fft.irfft2(psf.transforms(31), s=(31, 31)))
    for image, at in zip(drawn, place, strict=True):
        # Of a peak of 0.08; what is left is of the fifth order in the place.
        assert np.abs(image - gaussian(31, psf_covariance(at))).max() < 2e-5
    assert np.allclose(psf.lit_fraction(place), 1.0 - 0.1 * place[:, 0] / 4096)


@pytest.mark.long
def test_kriging_interpolates_too(gaussian, psf_covariance):
    places = np.random.default_rng(3).uniform(0, 4096, (40, 2))
    stamps = np.stack([gaussian(21, psf_covariance(place)) for place in places])
    field = PsfField.fit(stamps, places, 4096, interpolation="kriging", n_components=6)
    place = (2000.0, 2000.0)
    spectrum = np.einsum("k,kij->ij", field.amplitudes(place)[0], field.transforms(21))
    assert np.abs(np.fft.irfft2(spectrum, s=(21, 21)) - gaussian(21, psf_covariance(place))).max() < 1e-4


@pytest.mark.parametrize(("width", "chosen"), [(2000.0, "polynomial"), (500.0, "kriging")])
def test_polynomials_are_left_where_they_do_not_describe_the_psf(width, chosen):
    # As at the rim of a vignetted field, where aberrations move the light by pixels.
    y, x = np.indices((21, 21)) - 10.0
    rng = np.random.default_rng(4)

    def psfs(places):
        moved = 3.0 * np.tanh((places[:, 0] - 2000.0) / width)
        image = np.exp(-0.5 * ((x - moved[:, None, None]) ** 2 + y**2) / 4.0)
        return image / image.sum(axis=(1, 2), keepdims=True)

    places, others = rng.uniform(0.0, 4096.0, (100, 2)), rng.uniform(200.0, 3900.0, (50, 2))
    fields = {
        key: PsfField.fit(psfs(places), places, 4096, interpolation=key) for key in (None, "polynomial", "kriging")
    }
    drawn = {key: field.model.at(others) for key, field in fields.items()}
    np.testing.assert_array_equal(drawn[None], drawn[chosen])
    error = {key: np.abs(images - psfs(others)).max() for key, images in drawn.items()}
    assert error[chosen] == min(error.values())


def test_an_unknown_way_is_named(wcs, psf):
    with pytest.raises(ConfigError, match="way = 'fast': expected one of direct, eigen"):
        draw_galaxies(placed(wcs, np.array([[10.0, 10.0]])), np.ones(1), psf, wcs, way="fast")


@pytest.mark.long
def test_galsim_draws_the_same_galaxies(wcs, psf):
    galsim = pytest.importorskip("galsim")
    pixel, electrons = np.array([1200.3, 2150.2]), 1e5
    for sersic, radius, e in ((1.0, 0.4, 0.3 + 0.1j), (4.0, 0.3, -0.2 + 0.1j), (2.5, 0.8, 0.1 - 0.3j)):
        galaxy = placed(wcs, pixel[None], sersic=sersic, radius=np.array([radius * ARCSEC]), e1=e.real, e2=e.imag)
        stamp, offset = cut(draw_galaxies(galaxy, np.array([electrons]), psf, wcs, window=PART, noise=1e-3), pixel)
        jacobian = wcs.jacobians(pixel)[0] * ARCSEC
        # In pixels: galaxy mapped by the Jacobian, PSF images as they are, without another pixel.
        profile = galsim.Sersic(sersic, half_light_radius=radius).shear(galsim.Shear(g1=e.real, g2=e.imag))
        profile = galsim.Transform(profile, jac=jacobian, flux_ratio=1.0 / abs(np.linalg.det(jacobian)))
        image = galsim.Image(np.ascontiguousarray(psf.model.at(pixel)[0]), scale=1.0)
        both = galsim.Convolve(
            profile, galsim.InterpolatedImage(image, x_interpolant="lanczos15", normalization="flux")
        )
        options = galsim.GSParams(folding_threshold=1e-4, maximum_fft_size=16384)
        drawn = (
            both.withGSParams(options)
            .withFlux(electrons)
            .drawImage(nx=63, ny=63, scale=1.0, offset=tuple(offset), method="no_pixel")
        )
        # GalSim's interpolation between pixels, and light of untruncated profiles that wraps round in its FFT.
        assert np.abs(stamp - drawn.array).max() < 3e-4 * drawn.array.max()
