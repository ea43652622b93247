"""Galaxies of Sersic components: their transforms against closed forms and GalSim, and shear against its definition."""

import numpy as np
import pytest

from pachon.core.errors import DomainError
from pachon.core.units import ARCSEC
from pachon.sky.galaxies import Galaxies

galsim = pytest.importorskip("galsim")

PIXEL = 0.2 * ARCSEC
# East to the right and north up, of pixels a little sheared and rotated, mirrored too.
JACOBIANS = np.array([[[1.0, 0.0], [0.0, 1.0]], [[-0.98, 0.1], [0.07, 1.02]]]) / PIXEL


def one(**options):
    """A galaxy of one component at the pointing."""
    return Galaxies.single(0.0, 0.0, 24.0, **({"radius": 0.4 * ARCSEC} | options))


def two_components():
    """A round bulge aside of the centre of a disc."""
    return Galaxies(
        xi=[1e-5, 2e-5],
        eta=[3e-5, 4e-5],
        magnitude=[24.0, 25.0],
        radius=[0.5 * ARCSEC, 0.3 * ARCSEC],
        first=[0, 2, 3],
        dx=np.array([0.0, 0.3, 0.0]) * ARCSEC,
        dy=np.array([0.0, -0.2, 0.0]) * ARCSEC,
        fraction=[0.7, 0.3, 1.0],
        component_radius=np.array([0.6, 0.15, 0.3]) * ARCSEC,
        e1=[0.3, 0.0, -0.1],
        e2=[-0.2, 0.0, 0.25],
        sersic=[1.0, 3.5, 2.2],
    )


def frequencies(size):
    """Frequencies (kx, ky) [cycles/pixel] of a grid, [size, size // 2 + 1] each."""
    return np.meshgrid(np.fft.rfftfreq(size), np.fft.fftfreq(size))


def galsim_transform(galaxies, index, jacobian, offset, size):
    """Transform of one galaxy by GalSim's profiles: the sum of its components, in pixels."""
    total = None
    for c in range(galaxies.first[index], galaxies.first[index + 1]):
        profile = galsim.Sersic(galaxies.sersic[c], half_light_radius=galaxies.component_radius[c])
        profile = profile.shear(g1=galaxies.e1[c], g2=galaxies.e2[c]).shift(galaxies.dx[c], galaxies.dy[c])
        profile = profile.withFlux(galaxies.fraction[c])
        total = profile if total is None else total + profile
    total = total.transform(*jacobian.ravel()) / abs(np.linalg.det(jacobian))
    total = total.shift(*offset)
    kx, ky = (2.0 * np.pi * k for k in frequencies(size))
    return np.array([[total.kValue(x, y) for x, y in zip(*row, strict=True)] for row in zip(kx, ky, strict=True)])


@pytest.mark.parametrize("sersic", [0.5, 1.0])
def test_transform_has_the_closed_form_of_gaussians_and_exponentials(sersic):
    size, radius = 32, 0.7
    got = one(radius=radius * PIXEL, sersic=sersic).transform([0], JACOBIANS[:1], np.zeros((1, 2)), size)[0]
    kx, ky = frequencies(size)
    squared = (2.0 * np.pi * radius) ** 2 * (kx**2 + ky**2)
    # Half of the light of exp(-b r^2) lies within r = 1 for b = ln 2; of exp(-b r) for b = 1.6783470.
    expected = np.exp(-squared / (4.0 * np.log(2.0))) if sersic == 0.5 else (1.0 + squared / 1.6783470**2) ** -1.5
    # The table is interpolated to 4e-6.
    assert np.abs(got - expected).max() < 1e-5
    assert got.dtype == np.complex64


@pytest.mark.parametrize("sersic", [0.3, 0.37, 0.8, 1.7, 2.5, 4.0, 6.2])
def test_transform_is_galsims(sersic):
    galaxy = one(e1=-0.4, e2=0.5, sersic=sersic)
    offset = np.array([0.3, -1.2])
    for jacobian in JACOBIANS:
        got = galaxy.transform([0], jacobian[None], offset[None], 12)[0]
        # GalSim's own tables are good to 1e-5 by default.
        assert np.abs(got - galsim_transform(galaxy, 0, jacobian, offset, 12)).max() < 3e-5


def test_transform_of_components_is_galsims_sum():
    galaxies = two_components()
    offset = np.array([[0.25, 0.4], [-2.0, 1.0]])
    for size in (13, 16):
        got = galaxies.transform([1, 0], JACOBIANS, offset, size)
        for k, index in enumerate([1, 0]):
            assert np.abs(got[k] - galsim_transform(galaxies, index, JACOBIANS[k], offset[k], size)).max() < 3e-5


@pytest.mark.parametrize("size", [48, 49])
def test_image_stands_where_the_convention_says(size):
    # A Gaussian of 1.5 pixels sigma holds nothing beyond the Nyquist frequency: its samples are exact.
    sigma = 1.5
    radius = sigma * np.sqrt(2.0 * np.log(2.0)) * PIXEL
    offset = np.array([2.3, -3.6])
    transform = one(radius=radius, sersic=0.5).transform([0], JACOBIANS[:1], offset[None], size)[0]
    y, x = np.mgrid[:size, :size] - size // 2
    expected = np.exp(-((x - offset[0]) ** 2 + (y - offset[1]) ** 2) / (2 * sigma**2)) / (2 * np.pi * sigma**2)
    assert np.allclose(np.fft.fftshift(np.fft.irfft2(transform, (size, size))), expected, atol=3e-6)
    psf = np.zeros((size, size))
    psf[size // 2, size // 2] = 1.0
    assert np.allclose(np.fft.irfft2(transform * np.fft.rfft2(psf), (size, size)), expected, atol=3e-6)


def test_transforms_do_not_depend_on_threads_or_company():
    galaxies = two_components()
    indices, offset = [0, 1, 0], np.array([[0.1, 0.2], [0.3, 0.4], [0.1, 0.2]])
    jacobian = JACOBIANS[[0, 0, 0]]
    one_thread = galaxies.transform(indices, jacobian, offset, 20, threads=1)
    assert one_thread.tobytes() == galaxies.transform(indices, jacobian, offset, 20, threads=3).tobytes()
    assert np.array_equal(one_thread[0], one_thread[2])
    alone = galaxies.take([1]).transform([0], jacobian[:1], offset[1:2], 20)
    assert np.array_equal(alone[0], one_thread[1])
    assert galaxies.transform([], np.zeros((0, 2, 2)), np.zeros((0, 2)), 20).shape == (0, 20, 11)


def test_shear_distorts_the_sky():
    galaxies = two_components()
    g1, g2 = 0.2, -0.3
    distortion = np.array([[1 + g1, g2], [g2, 1 - g1]]) / np.sqrt(1 - g1**2 - g2**2)
    sheared = galaxies.sheared(g1, g2)
    offset = np.zeros((2, 2))
    got = sheared.transform([0, 1], JACOBIANS, offset, 16)
    # The same light, seen through the distortion.
    expected = galaxies.transform([0, 1], JACOBIANS @ distortion, offset, 16)
    # Both round in single precision in their own way.
    assert np.abs(got - expected).max() < 1e-6
    assert np.array_equal(sheared.xi, galaxies.xi)
    moved = galaxies.sheared(np.full(2, g1), g2, positions=True)
    assert np.allclose([moved.xi, moved.eta], distortion @ [galaxies.xi, galaxies.eta], rtol=1e-12)


def test_shear_and_back_is_nothing():
    galaxies = two_components()
    back = galaxies.sheared(0.4, 0.1, positions=True).sheared(-0.4, -0.1, positions=True)
    for name in ("xi", "eta", "dx", "dy", "e1", "e2", "component_radius"):
        assert np.allclose(getattr(back, name), getattr(galaxies, name), atol=1e-15, rtol=1e-12)


def test_rotation_turns_the_sky():
    galaxies = two_components()
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s], [s, c]])
    got = galaxies.rotated(0.7).transform([0, 1], JACOBIANS, np.zeros((2, 2)), 16)
    expected = galaxies.transform([0, 1], JACOBIANS @ turn, np.zeros((2, 2)), 16)
    assert np.abs(got - expected).max() < 1e-6
    moved = galaxies.rotated(0.7, positions=True)
    assert np.allclose([moved.xi, moved.eta], turn @ [galaxies.xi, galaxies.eta], rtol=1e-12)


def test_take_and_concatenate():
    galaxies = two_components()
    both = Galaxies.concatenate([galaxies.take([1]), galaxies.take([True, False])])
    assert np.array_equal(both.first, [0, 1, 3])
    assert np.array_equal(both.sersic, [2.2, 1.0, 3.5])
    assert np.array_equal(both.magnitude, [25.0, 24.0])
    assert np.array_equal(galaxies.take([0, 1, 0]).first, [0, 2, 3, 5])
    assert len(Galaxies.concatenate([])) == 0


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"radius": -1.0}, r"^radius \[0\] = -1: expected a positive radius"),
        ({"e1": 0.8, "e2": 0.7}, r"^e1, e2 \[0\] = 1\.06301: expected an ellipticity below 1"),
        ({"sersic": 0.2}, r"^sersic \[0\] = 0\.2: expected 0\.3 to 6\.2"),
        ({"sersic": np.nan}, "sersic: expected finite"),
    ],
)
def test_values_that_no_galaxy_has(change, text):
    with pytest.raises(DomainError, match=text):
        one(**change)


def test_arguments_that_do_not_match():
    galaxy = one()
    with pytest.raises(DomainError, match="indices"):
        galaxy.transform([1], JACOBIANS[:1], np.zeros((1, 2)), 16)
    with pytest.raises(DomainError, match="jacobian"):
        galaxy.transform([0], JACOBIANS, np.zeros((1, 2)), 16)
    with pytest.raises(DomainError, match="offset"):
        galaxy.transform([0], JACOBIANS[:1], np.zeros(2), 16)
    with pytest.raises(DomainError, match="size"):
        galaxy.transform([0], JACOBIANS[:1], np.zeros((1, 2)), 0)
    with pytest.raises(DomainError, match="g1, g2"):
        galaxy.sheared(1.0, 0.0)
