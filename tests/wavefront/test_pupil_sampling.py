import numpy as np
import pytest
from scipy.integrate import quad

from pachon.core.errors import ConfigError, DomainError
from pachon.wavefront.pupil_sampling import (
    PupilSampling,
    gauss_annulus,
    pupil_sampling,
    ring_annulus,
    spiral_annulus,
    square_annulus,
)


def mean_power(a, b, radius, obscuration):
    """The mean of x^a y^b over an annulus, by one-dimensional integrals over angle and radius."""
    angle = quad(lambda t: np.cos(t) ** a * np.sin(t) ** b, 0, 2 * np.pi)[0] / (2 * np.pi)
    inner = obscuration * radius
    return angle * quad(lambda r: r ** (a + b + 1), inner, radius)[0] * 2 / (radius**2 - inner**2)


@pytest.mark.parametrize("obscuration", [0.0, 0.3, 0.9])
def test_gauss_quadrature_is_exact_for_polynomials(obscuration):
    sample = gauss_annulus(2.0, obscuration, 4, 16)
    assert sample.weights.sum() == pytest.approx(1.0, abs=1e-15)
    x, y = sample.points.T
    for a in range(16):
        for b in range(16 - a):
            # Rounding of sums of terms as large as 2^15.
            expected = mean_power(a, b, 2.0, obscuration)
            assert sample.weights @ (x**a * y**b) == pytest.approx(expected, abs=3e-15 * 2.0 ** (a + b), rel=1e-12)


@pytest.mark.parametrize("obscuration", [0.0, 0.5])
def test_rings_are_exact_for_quadratics_and_converge_as_the_square_of_their_number(obscuration):
    def error(rings, power):
        sample = ring_annulus(1.0, obscuration, rings)
        x, _ = sample.points.T
        return abs(sample.weights @ x**power - mean_power(power, 0, 1.0, obscuration))

    assert error(3, 2) < 1e-15
    assert 0.2 < error(20, 4) / error(10, 4) < 0.3


@pytest.mark.parametrize("obscuration", [0.0, 0.6])
def test_spiral_and_square_fill_the_annulus_evenly(obscuration):
    for sample in (spiral_annulus(1.0, obscuration, 4000), square_annulus(1.0, obscuration, 80)):
        radius = np.hypot(*sample.points.T)
        assert obscuration <= radius.min()
        assert radius.max() <= 1.0
        assert np.ptp(sample.weights) == 0
        x, y = sample.points.T
        for a, b in ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (4, 0)):
            # Points number thousands and the rim cuts through some hundred cells: a few in a thousand.
            assert sample.weights @ (x**a * y**b) == pytest.approx(mean_power(a, b, 1.0, obscuration), abs=4e-3)


def test_a_sampling_of_given_points_is_normalised_and_returned_unchanged(lsst_r):
    own = PupilSampling([[0.0, 0.01], [0.02, 0.0]], [1.0, 3.0])
    assert own.weights.tolist() == [0.25, 0.75]
    assert pupil_sampling(lsst_r, own) is own


def test_the_default_fills_the_telescopes_pupil(lsst_r):
    for kind in ("gauss", "rings", "spiral", "square"):
        radius = np.hypot(*pupil_sampling(lsst_r, kind).points.T)
        assert 0.612 * 4.18 <= radius.min() < 0.63 * 4.18
        assert 0.98 * 4.18 < radius.max() <= 4.18


def test_bad_input_is_refused(lsst_r):
    with pytest.raises(ConfigError, match="sampling = 'hexagonal': expected one of gauss, rings, spiral, square"):
        pupil_sampling(lsst_r, "hexagonal")
    with pytest.raises(DomainError, match=r"n_pupil = 0: expected a whole number"):
        pupil_sampling(lsst_r, "gauss", 0)
    with pytest.raises(DomainError, match="expected more points"):
        square_annulus(1.0, 0.999, 2)
    with pytest.raises(DomainError, match="obscuration = 1"):
        gauss_annulus(1.0, 1.0, 3, 3)
    with pytest.raises(DomainError, match=r"expected shapes \[n, 2\] and \[n\]"):
        PupilSampling(np.zeros((3, 3)), np.ones(3))
    with pytest.raises(DomainError, match="positive sum"):
        PupilSampling(np.zeros((1, 2)), np.zeros(1))
