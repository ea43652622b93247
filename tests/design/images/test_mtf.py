"""Modulation transfer against closed forms and the transform of the image."""

import tracemalloc

import numpy as np
import pytest
from scipy.special import j1

from pachon.core.errors import DomainError
from pachon.design.images.diffraction import fft_psf
from pachon.design.images.mtf import mtf
from pachon.design.metrics.spots import spots
from pachon.wavefront.request import Request

WAVE = 500e-9


def shared_area(shift, obscuration, n=1201):
    """Brute force: the part of an annular pupil that it shares with itself, shifted by a part of its diameter."""
    u = (2.0 * np.arange(n) + 1.0) / n - 1.0
    x, y = np.meshgrid(u, u)

    def inside(x):
        r = np.hypot(x, y)
        return (r <= 1.0) & (r >= obscuration)

    return np.array([(inside(x - s) & inside(x + s)).sum() for s in shift]) / inside(x).sum()


def annulus_mtf(frequency: np.ndarray, obscuration: float) -> np.ndarray:
    """Return the modulation transfer of a perfect annular pupil (O'Neill 1956, J. Opt. Soc. Am. 46, 285).

    Frequencies are over the cut-off, 1 / (wavelength times focal ratio).
    """
    shift = np.asarray(frequency, dtype=np.float64)
    whole = _discs(shift, 1.0, 1.0)
    if obscuration > 0:
        whole = whole + _discs(shift, obscuration, obscuration) - 2.0 * _discs(shift, 1.0, obscuration)
    return whole / (np.pi * (1.0 - obscuration**2))


def _discs(shift: np.ndarray, large: float, small: float) -> np.ndarray:
    """Return the common area of two discs whose centres are twice a shift apart."""
    d = 2.0 * np.abs(shift)
    part = np.clip(d, max(large - small, 1e-300), large + small)
    a = np.arccos(np.clip((part**2 + large**2 - small**2) / (2.0 * part * large), -1.0, 1.0))
    b = np.arccos(np.clip((part**2 + small**2 - large**2) / (2.0 * part * small), -1.0, 1.0))
    kite = (large + small + part) * (small + large - part) * (part + large - small) * (part + small - large)
    area = large**2 * a + small**2 * b - 0.5 * np.sqrt(np.maximum(kite, 0.0))
    return np.where(d <= large - small, np.pi * small**2, np.where(d >= large + small, 0.0, area))


@pytest.mark.long
@pytest.mark.parametrize(
    "obscuration", [pytest.param(0.0, marks=pytest.mark.slow), pytest.param(0.3, marks=pytest.mark.slow), 0.62]
)
def test_closed_form_of_an_annulus(obscuration):
    shift = np.array([0.0, 0.05, 0.19, 0.31, 0.5, 0.62, 0.81, 0.95, 1.0, 1.2])
    # A lattice of 1201 points knows areas to a thousandth.
    assert annulus_mtf(shift, obscuration) == pytest.approx(shared_area(shift, obscuration), abs=1.5e-3)


@pytest.mark.parametrize("obscuration", [0.0, 0.612])
def test_a_perfect_pupil(paraboloid, obscuration):
    result = mtf(paraboloid(f_number=30.0, obscuration=obscuration), [[0.0, 0.0]], WAVE)
    expected = annulus_mtf(result.frequency * WAVE * 30.0, obscuration)
    for found in (result.tangential, result.sagittal, result.tangential_limit, result.sagittal_limit):
        # What the rim leaves of a cell is averaged before cells are multiplied: a thousandth at 256 points.
        assert found[0] == pytest.approx(expected, abs=2e-3)
    assert result.cutoff[0] == pytest.approx(1.0 / (WAVE * 30.0), rel=1e-3)


@pytest.mark.long
def test_it_is_the_transform_of_the_image(lsst_r):
    field = [np.deg2rad([0.0, 1.2])]
    result = mtf(lsst_r, field, [560e-9, 690e-9], n_pupil=192)
    psf = fft_psf(lsst_r, field, [560e-9, 690e-9], pixel=0.2e-6, pixels=320, n_pupil=256)
    some = np.array([8, 20, 45, 90])
    for row, along in ((result.tangential[0], 1), (result.sagittal[0], 0)):
        profile = psf.image[0].sum(axis=1 if along == 1 else 0)
        phase = np.exp(-2j * np.pi * np.outer(result.frequency[some], psf.axis))
        # The image leaves 3 % of the light in its wings beside it, which is what the two may differ by.
        assert np.abs(phase @ profile) == pytest.approx(row[some], abs=0.03)


@pytest.mark.long
def test_tangential_turns_with_the_field(lsst_r):
    angles = np.deg2rad([[0.0, 1.2], [1.2, 0.0], [-0.72, 0.96]])
    # Rotating the slopes, not the angles, keeps the telescope the same.
    slope = np.tan(np.deg2rad(1.2))
    angles[2] = np.arctan([-0.6 * slope, 0.8 * slope])
    result = mtf(lsst_r, angles, n_pupil=128)
    for row in (result.tangential, result.sagittal, result.tangential_limit, result.geometric_sagittal):
        # Lattices that are turned cut the rims in other places.
        assert row[1] == pytest.approx(row[0], abs=4e-3)
        assert row[2] == pytest.approx(row[0], abs=4e-3)
    assert np.abs(result.tangential - result.sagittal).max() > 0.1


def test_rays_alone_are_the_transform_of_the_spot(lsst_r):
    field = [np.deg2rad([0.0, 1.2])]
    result = mtf(lsst_r, field, n_pupil=64)
    spot = spots(lsst_r, field)
    lit = spot.weight[0, 0] > 0
    y, w = spot.displacement[0, 0, lit, 1], spot.weight[0, 0, lit]
    expected = [abs((w * np.exp(2j * np.pi * f * y)).sum()) / w.sum() for f in result.frequency]
    assert result.geometric_tangential[0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.long
def test_bounds_and_summary(lsst_r):
    result = mtf(lsst_r, n_pupil=96)
    assert (result.tangential <= result.tangential_limit + 5e-3).all()
    assert (result.sagittal <= result.sagittal_limit + 5e-3).all()
    assert result.tangential[:, 0] == pytest.approx(1.0)
    summary = result.summary()
    half = np.array(summary["half_contrast_cycles_per_mm"])
    assert half.shape == (5, 2)
    assert half[0] == pytest.approx(half[0, 0], rel=1e-3)
    # 10.3 m of focal length: 20 cycles/mm are one per arc second.
    assert half / np.array(summary["half_contrast_cycles_per_arcsec"]) == pytest.approx(20.0, rel=5e-3)
    assert result.plot().get_size_inches()[0] > 5


def test_what_cannot_be_had_is_an_error(lsst_r, paraboloid):
    with pytest.raises(DomainError, match="n_pupil = 4"):
        mtf(lsst_r, n_pupil=4)
    with pytest.raises(DomainError, match="too few for spots"):
        mtf(paraboloid(f_number=20.0, shift=5e-3), [[0.0, 0.0]], WAVE, n_pupil=16)
    with pytest.raises(DomainError, match="contrast = 2"):
        mtf(lsst_r, [[0.0, 0.0]], n_pupil=16).frequency_at(2)


@pytest.mark.long
def test_the_lattice_is_as_fine_as_spots_need(paraboloid):
    # 400 wavelengths times focal ratio of defocus: contrast falls as that of the rays.
    found = mtf(paraboloid(f_number=20.0, shift=400 * 20.0**2 * WAVE), [[0.0, 0.0]], WAVE)
    assert len(found.frequency) > 400
    low = found.frequency < 2e3
    assert found.tangential[0, low] == pytest.approx(found.geometric_tangential[0, low], abs=0.02)


def test_many_rays_take_no_more_memory_than_some(paraboloid):
    """The contrast of a disc of light, of 100000 rays."""
    request = Request.of(paraboloid(f_number=20.0, shift=1e-3), [[0.0, 0.0]], WAVE, sampling="spiral", n_pupil=100_000)
    tracemalloc.start()
    found = mtf(request, n_pupil=64)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # All at once, with two complex numbers a ray and frequency, they take 200 MB and more.
    assert peak < 100e6
    argument = np.pi * (1e-3 / 20.0) * found.frequency[1:20]
    assert found.geometric_tangential[0, 1:20] == pytest.approx(np.abs(2.0 * j1(argument) / argument), abs=1e-3)
