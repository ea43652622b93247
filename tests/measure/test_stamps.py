import numpy as np
import pytest

from pachon.core.errors import DomainError
from pachon.measure.shapes import measure_shapes
from pachon.measure.stamps import center_stamps, fourier_shift, fourier_shifts, observe_stamps

ARCSEC = np.pi / 180.0 / 3600.0
PIXEL = 0.2 * ARCSEC
WEIGHT = 0.7 * ARCSEC


def kolmogorov(size, dx, dy, shear=0.03, grid=512, fwhm=0.55):
    """Kolmogorov PSF of a FWHM ["], stretched along x, in pixels of 0.2", from Fourier space on a far larger grid."""
    frequency = np.fft.fftfreq(grid)
    kx, ky = frequency[None, :], frequency[:, None]
    otf = np.exp(-((5.67 * fwhm / 0.55 * np.hypot(kx * (1 + shear), ky * (1 - shear))) ** (5.0 / 3.0)))
    middle = grid // 2
    phase = np.exp(-2j * np.pi * (kx * (dx + middle) + ky * (dy + middle)))
    image = np.fft.ifft2(otf * np.sinc(kx) * np.sinc(ky) * phase).real
    low = middle - size // 2
    return image[low : low + size, low : low + size]


def gaussian(size, x0, y0, sx=1.7, sy=1.4):
    y, x = np.mgrid[:size, :size] - (size - 1) / 2.0
    return np.exp(-0.5 * (((x - x0) / sx) ** 2 + ((y - y0) / sy) ** 2)) / (2 * np.pi * sx * sy)


@pytest.mark.parametrize("size", [31, 41])
@pytest.mark.parametrize("offset", [(0.37, -0.29), (0.5, 0.5), (-0.13, 0.02)])
def test_centring_adds_no_ellipticity(size, offset):
    direct = measure_shapes(kolmogorov(31, 0.0, 0.0), PIXEL, WEIGHT)
    image = kolmogorov(size, *offset)
    found = measure_shapes(image, PIXEL, WEIGHT)
    stamp = center_stamps(image, found.x, found.y)
    centred = measure_shapes(stamp, PIXEL, WEIGHT)
    # What wraps round the edge is 1e-4 of the light at most, and lies where the weight is below 1e-9; what is left is
    # the pixel sums' own dependence on the sub-pixel position, 1e-7.
    assert centred.e1[0] == pytest.approx(direct.e1[0], abs=3e-7)
    assert centred.e2[0] == pytest.approx(direct.e2[0], abs=3e-7)
    assert (centred.x[0], centred.y[0]) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert stamp.sum() == pytest.approx(1.0, rel=1e-14)


# What pixels of 0.2" do not sample goes with FWHM: measured 5.3e-7, 4.2e-8 and 2.0e-9 in e, 9.5e-7, 6.8e-8 and 2.7e-9
# in size, all over the pixel; a star measured where it fell shows ten times more of it.
@pytest.mark.parametrize(("fwhm", "most"), [(0.4, 1e-6), pytest.param(0.55, 1e-7, marks=pytest.mark.slow), (0.7, 5e-9)])
def test_ellipticity_added_anywhere_in_a_pixel(fwhm, most):
    centre = measure_shapes(kolmogorov(31, 0.0, 0.0, fwhm=fwhm), PIXEL, WEIGHT)
    steps = np.linspace(-0.5, 0.5, 5)
    fallen = np.stack([kolmogorov(41, dx, dy, fwhm=fwhm) for dx in steps for dy in steps])
    found = measure_shapes(fallen, PIXEL, WEIGHT)
    moved = measure_shapes(center_stamps(fallen, found.x, found.y), PIXEL, WEIGHT)
    added = np.hypot(moved.e1 - centre.e1, moved.e2 - centre.e2)
    assert added.max() < most
    assert added.max() < 0.2 * np.hypot(found.e1 - centre.e1, found.e2 - centre.e2).max()
    np.testing.assert_allclose(moved.size, centre.size[0], rtol=2.0 * most)
    np.testing.assert_allclose(np.stack([moved.x, moved.y]), 0.0, atol=1e-5)


def test_ellipticity_added_to_noisy_stars():
    # S/N of about 30. Each star is compared with itself: centring adds nothing but what noise beyond the Nyquist
    # frequency of image times weight does to the pixel sums, to no side.
    rng = np.random.default_rng(11)
    offsets = rng.uniform(-0.5, 0.5, (200, 2))
    images = np.stack([kolmogorov(41, dx, dy, grid=128) for dx, dy in offsets])
    seen = observe_stamps(images, 5000.0, 400.0, 9.0, rng)
    before = measure_shapes(seen, PIXEL, WEIGHT)
    after = measure_shapes(center_stamps(seen, before.x, before.y), PIXEL, WEIGHT)
    assert before.usable.all()
    for one, other in ((before.e1, after.e1), (before.e2, after.e2)):
        change = other - one
        assert change.std() < 0.02 * one.std()
        assert abs(change.mean()) < 4.0 * change.std() / np.sqrt(200)


@pytest.mark.parametrize(("ny", "nx"), [(31, 31), (40, 40), (41, 36), (32, 33)])
def test_shift_equals_the_shifted_function(ny, nx):
    x0, y0 = 1.3, -0.8
    y, x = np.mgrid[:ny, :nx].astype(float)
    x, y = x - (nx - 1) / 2 - x0, y - (ny - 1) / 2 - y0
    image = 500.0 * np.exp(-0.5 * ((x / 1.7) ** 2 + (y / 1.4) ** 2)) / (2 * np.pi * 1.7 * 1.4)
    size = min(ny, nx) - (min(ny, nx) + 1) % 2
    stamp = center_stamps(image, x0, y0, size, normalize=False)[0]
    # Aliases of the narrow axis, exp(-(pi 1.4)^2 / 2) = 6e-5 of the highest Fourier coefficient.
    np.testing.assert_allclose(stamp, 500.0 * gaussian(size, 0.0, 0.0), atol=2e-4 * 500.0 * gaussian(1, 0, 0)[0, 0])
    assert stamp.sum() == pytest.approx(image.sum(), rel=1e-5)  # flux is kept up to the light cut off


def test_whole_pixels_are_exact():
    rng = np.random.default_rng(3)
    image = rng.normal(size=(41, 41))
    stamp = center_stamps(image, 3.0, -2.0, normalize=False)[0]
    np.testing.assert_allclose(stamp, image[5 - 2 : 36 - 2, 5 + 3 : 36 + 3], atol=1e-14)


def test_white_noise_stays_white():
    rng = np.random.default_rng(4)
    image = rng.normal(size=(41, 41))
    shifted = center_stamps(image, 0.31, 0.47, 41, normalize=False)
    # An odd grid has no unpaired frequency: the shift is unitary, so the sum of squares is kept.
    assert (shifted**2).sum() == pytest.approx((image**2).sum(), rel=1e-13)


def test_unusable_stars_become_nan():
    images = np.stack([gaussian(31, 0, 0), gaussian(31, 0, 0), -gaussian(31, 0, 0)])
    stamps = center_stamps(images, [0.0, np.nan, 0.0], 0.0, 21)
    assert np.isnan(stamps).all(axis=(1, 2)).tolist() == [False, True, True]


def test_each_star_is_centred_alone():
    rng = np.random.default_rng(5)
    images = rng.normal(size=(5, 33, 33)) + 10.0
    x, y = rng.uniform(-0.5, 0.5, (2, 5))
    whole = center_stamps(images, x, y)
    for i in range(5):
        assert center_stamps(images[i], x[i], y[i]).tobytes() == whole[i].tobytes()


def test_noise_has_the_variance_of_photons_and_readout():
    psf = np.repeat(gaussian(31, 0.2, 0.1)[None], 400, axis=0)
    counts, sky, read = 20000.0, 300.0, 9.0
    images = observe_stamps(psf, counts, sky, read, np.random.default_rng(1))
    expected = counts * psf[0]
    variance = expected + sky + read**2
    # 400 draws per pixel: the mean of 961 standardised means is good to 1/sqrt(400 * 961) = 1.6e-3, the mean variance
    # ratio to sqrt(2) times that; 4 sigma of each.
    deviation = (images - expected) / np.sqrt(variance)
    assert abs(deviation.mean()) < 6.5e-3
    assert abs((deviation**2).mean() - 1.0) < 9.2e-3
    # and pixel by pixel: chi^2 of 400 has a scatter of 0.07, five sigma over 961 pixels.
    assert np.abs((deviation**2).mean(axis=0) - 1.0).max() < 0.36


def test_first_stars_do_not_depend_on_how_many_follow():
    psf = np.stack([gaussian(31, 0.1 * i, 0.0) for i in range(6)])
    counts = np.linspace(1e3, 1e5, 6)
    all_six = observe_stamps(psf, counts, 400.0, 9.0, np.random.default_rng(8))
    first = observe_stamps(psf[:4], counts[:4], 400.0, 9.0, np.random.default_rng(8))
    assert first.tobytes() == all_six[:4].tobytes()


def test_without_light_or_noise():
    images = observe_stamps(np.zeros((2, 5, 5)) - 1e-9, 1e4, 0.0, 0.0, np.random.default_rng(0))
    assert not images.any()


def test_bad_arguments():
    psf = gaussian(31, 0, 0)
    rng = np.random.default_rng(0)
    with pytest.raises(DomainError, match="electrons"):
        observe_stamps(psf, [1.0, 2.0], 1.0, 1.0, rng)
    with pytest.raises(DomainError, match="electrons"):
        observe_stamps(psf, -1.0, 1.0, 1.0, rng)
    with pytest.raises(DomainError, match="sky"):
        observe_stamps(psf, 1.0, -1.0, 1.0, rng)
    with pytest.raises(DomainError, match="read_noise"):
        observe_stamps(psf, 1.0, 1.0, np.nan, rng)
    with pytest.raises(DomainError, match=r"psf_images\[1\]"):
        observe_stamps(np.stack([psf, psf * np.nan]), 1.0, 1.0, 1.0, rng)
    with pytest.raises(DomainError, match="size = 30"):
        center_stamps(psf, 0.0, 0.0, 30)
    with pytest.raises(DomainError, match="size = 33"):
        center_stamps(psf, 0.0, 0.0, 33)
    with pytest.raises(DomainError, match="x and y"):
        center_stamps(psf, [0.0, 1.0], 0.0)
    with pytest.raises(DomainError, match="images"):
        center_stamps(np.zeros(4), 0.0, 0.0)
    with pytest.raises(DomainError, match="images"):
        center_stamps("stars", 0.0, 0.0)


@pytest.mark.parametrize("shape", [(9, 9), (10, 12)])
def test_images_shifted_together_are_those_shifted_one_by_one(shape):
    rng = np.random.default_rng(4)
    images, shifts = rng.normal(size=(3, *shape)), rng.uniform(-2.0, 2.0, (3, 2))
    expected = [fourier_shift(image, *shift) for image, shift in zip(images, shifts, strict=True)]
    np.testing.assert_allclose(fourier_shifts(images, *shifts.T), expected, rtol=0.0, atol=1e-12)
