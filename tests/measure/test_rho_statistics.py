import numpy as np
import pytest

from pachon.core.errors import DomainError
from pachon.measure.correlation import SeparationBins, shear_correlation
from pachon.measure.rho_statistics import rho_statistics, trace_of_moments
from pachon.measure.shapes import measure_shapes

ARCMIN = np.pi / 180.0 / 60.0
BINS = SeparationBins(2.0 * ARCMIN, 60.0 * ARCMIN, 5)


def columns(count=300, seed=0):
    """Stars over one degree and a model that is off in ellipticity and size: x, y, e1, e2, size and the model's."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, 60.0 * ARCMIN, (2, count))
    e1 = 0.04 + 0.01 * np.sin(x / (9 * ARCMIN))
    e2 = -0.03 + 0.01 * np.cos((x + 2 * y) / (15 * ARCMIN))
    size = 0.3 + 0.01 * np.cos(y / (20 * ARCMIN))
    model = e1 - 0.01 - rng.normal(0.0, 0.002, count), e2 + 0.008 - rng.normal(0.0, 0.002, count)
    return x, y, e1, e2, size, *model, size * (0.95 + rng.normal(0.0, 0.005, count))


def brute_force(x, y, f, g):
    """Mean of Re(f g*) over pairs in both orders, in each bin."""
    edges = np.geomspace(BINS.min_sep, BINS.max_sep, BINS.n_bins + 1)
    i, j = np.nonzero(~np.eye(len(x), dtype=bool))
    bins = np.digitize(np.hypot(x[j] - x[i], y[j] - y[i]), edges) - 1
    return np.array([(f[i] * g[j].conj()).real[bins == b].mean() for b in range(BINS.n_bins)])


def test_brute_force_pair_counting():
    x, y, e1, e2, size, m1, m2, model_size = columns()
    rho = rho_statistics(x, y, e1, e2, size, m1, m2, model_size, bins=BINS)

    # Semi-axes from size = sqrt(a b) and |e| = (a - b)/(a + b), and T = a^2 + b^2.
    def trace(s, f1, f2):
        ratio = (1.0 - np.hypot(f1, f2)) / (1.0 + np.hypot(f1, f2))
        return s**2 / ratio + s**2 * ratio

    e, de = e1 + 1j * e2, e1 - m1 + 1j * (e2 - m2)
    w = e * (1.0 - trace(model_size, m1, m2) / trace(size, e1, e2))
    expected = {"rho1": (de, de), "rho2": (e, de), "rho3": (w, w), "rho4": (de, w), "rho5": (e, w)}
    for name, correlation in rho.items():
        # Coherent offsets: no sum cancels, and single precision in TreeCorr leaves 2^-23.
        np.testing.assert_allclose(correlation.xi_plus, brute_force(x, y, *expected.pop(name)), rtol=1e-6)
    assert not expected


def test_a_perfect_model_has_none():
    x, y, e1, e2, size, *_ = columns()
    rho = rho_statistics(x, y, e1, e2, size, e1, e2, size, bins=BINS)
    for _, correlation in rho.items():
        np.testing.assert_array_equal(correlation.xi_plus, 0.0)


def test_a_model_right_in_shape_and_wrong_in_size():
    # Sizes 1 % too small everywhere: dT/T = 1 - 0.99^2, so rho3 and rho5 are xi+ of the stars times its square and it.
    x, y, e1, e2, size, *_ = columns()
    rho = rho_statistics(x, y, e1, e2, size, e1, e2, 0.99 * size, bins=BINS)
    xi = shear_correlation(x, y, e1, e2, bins=BINS).xi_plus
    growth = 1.0 - 0.99**2
    for name in ("rho1", "rho2", "rho4"):
        np.testing.assert_array_equal(getattr(rho, name).xi_plus, 0.0)
    np.testing.assert_allclose(rho.rho3.xi_plus, growth**2 * xi, rtol=1e-6)  # single precision in TreeCorr
    np.testing.assert_allclose(rho.rho5.xi_plus, growth * xi, rtol=1e-6)


def test_a_model_off_by_a_constant():
    x, y, e1, e2, size, *_ = columns()
    rho = rho_statistics(x, y, 0 * e1 + 0.05, 0 * e2, size, 0 * e1 + 0.03, 0 * e2 - 0.01, size, bins=BINS)
    np.testing.assert_allclose(rho.rho1.xi_plus, 0.02**2 + 0.01**2, rtol=1e-6)
    np.testing.assert_allclose(rho.rho2.xi_plus, 0.05 * 0.02, rtol=1e-6)


def test_rowes_sum_rule():
    # <e_m* e_m> = <e* e> - 2 <e* de> + <de* de>: the definition of the difference.
    x, y, e1, e2, size, m1, m2, model_size = columns()
    rho = rho_statistics(x, y, e1, e2, size, m1, m2, model_size, bins=BINS)
    star, model = (shear_correlation(x, y, *e, bins=BINS).xi_plus for e in ((e1, e2), (m1, m2)))
    np.testing.assert_allclose(star - 2 * rho.rho2.xi_plus + rho.rho1.xi_plus, model, rtol=2e-6)


def test_errors_are_those_of_a_jackknife():
    c = columns()
    patch = (c[0] > 30 * ARCMIN) * 2 + (c[1] > 30 * ARCMIN)
    rho = rho_statistics(*c, patch=patch, bins=BINS)
    left = [rho_statistics(*(v[patch != k] for v in c), bins=BINS) for k in range(4)]
    for name, correlation in rho.items():
        xi = np.array([getattr(r, name).xi_plus for r in left])
        expected = np.sqrt(0.75 * ((xi - xi.mean(axis=0)) ** 2).sum(axis=0))
        np.testing.assert_allclose(correlation.error_plus, expected, rtol=1e-8)  # sums in another order


def test_one_column_takes_a_star_out_of_all():
    c = [v.copy() for v in columns()]
    for i, column in enumerate(c):
        column[10 * i] = np.nan
    keep = np.isfinite(c).all(axis=0)
    assert keep.sum() == 292
    rho, kept = rho_statistics(*c, bins=BINS), rho_statistics(*(v[keep] for v in c), bins=BINS)
    for name, correlation in rho.items():
        assert correlation.n_stars == 292
        assert correlation.xi_plus.tobytes() == getattr(kept, name).xi_plus.tobytes()


def test_trace_of_the_moments_of_an_image():
    # An elliptical Gaussian under a weight so wide that it does nothing: T = a^2 + b^2.
    grid = np.arange(-32.0, 33.0)
    u, v = np.meshgrid(grid, grid)
    a, b, angle = 4.0, 2.5, 0.4
    along, across = u * np.cos(angle) + v * np.sin(angle), v * np.cos(angle) - u * np.sin(angle)
    image = np.exp(-0.5 * ((along / a) ** 2 + (across / b) ** 2))
    shape = measure_shapes(image, 1.0, 1e5)
    # The weight is wider by 1e4, its square by 1e8.
    assert trace_of_moments(shape.size, shape.e1, shape.e2)[0] == pytest.approx(a**2 + b**2, rel=1e-7)
    assert trace_of_moments(0.3, 0.0, 0.0) == pytest.approx(2 * 0.3**2, rel=1e-15)


def test_bad_arguments():
    c = list(columns(10))
    with pytest.raises(DomainError, match="expected \\[n\\] six times"):
        rho_statistics(*c[:4], c[4][:5], *c[5:], bins=BINS)
    with pytest.raises(DomainError, match="model_size: expected positive sizes, the least is -1"):
        rho_statistics(*c[:7], -np.ones(10), bins=BINS)
    with pytest.raises(DomainError, match="real numbers"):
        rho_statistics(*c[:7], ["a"] * 10, bins=BINS)
    with pytest.raises(DomainError, match="shapes"):
        rho_statistics(c[0][:3], *c[1:], bins=BINS)
