import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

from pachon.core.errors import ConfigError, DomainError
from pachon.measure.correlation import (
    EXACT_LIMIT,
    SeparationBins,
    jackknife_error,
    patches_of_jackknife,
    shear_correlation,
)

ARCMIN = np.pi / 180.0 / 60.0
BINS = SeparationBins(1.0 * ARCMIN, 60.0 * ARCMIN, 8)


def catalogue(count=300, seed=0):
    """Smooth ellipticity field with a mean and noise over one degree."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, 60.0 * ARCMIN, (2, count))
    e1 = 0.02 + 0.01 * np.sin(x / (9 * ARCMIN)) + rng.normal(0.0, 0.003, count)
    e2 = -0.01 + 0.01 * np.cos((x + 2 * y) / (15 * ARCMIN)) + rng.normal(0.0, 0.003, count)
    return x, y, e1, e2


def test_brute_force_pair_counting():
    x, y, e1, e2 = catalogue()
    c = shear_correlation(x, y, e1, e2, bins=BINS)
    edges = np.geomspace(BINS.min_sep, BINS.max_sep, 9)
    e = e1 + 1j * e2
    i, j = np.triu_indices(len(x), 1)
    dx, dy = x[j] - x[i], y[j] - y[i]
    bins = np.digitize(np.hypot(dx, dy), edges) - 1
    phase = np.exp(-4j * np.arctan2(dy, dx))
    for b in range(8):
        here = bins == b
        a, d = e[i[here]], e[j[here]]
        assert c.n_pairs[b] == here.sum()
        # TreeCorr keeps ellipticities of 0.03 in single precision: 2 * 2^-24 * 0.03^2.
        assert c.xi_plus[b] == pytest.approx((a * d.conj()).real.mean(), abs=1e-10)
        assert c.xi_minus[b] == pytest.approx((a * d * phase[here]).real.mean(), abs=1e-10)
        assert c.r[b] == pytest.approx(np.hypot(dx, dy)[here].mean(), rel=1e-10)  # sums in another order
    assert c.n_stars == 300
    np.testing.assert_allclose(c.r_arcmin, c.r / ARCMIN, rtol=1e-14)


def test_constant_field():
    x, y, _, _ = catalogue()
    c = shear_correlation(x, y, np.full(300, 0.03), np.full(300, -0.04), bins=BINS)
    np.testing.assert_allclose(c.xi_plus, 0.05**2, rtol=1.2e-7)  # single precision in TreeCorr, 2^-23
    flat = shear_correlation(x, y, np.full(300, 0.03), np.full(300, -0.04), subtract_mean=True, bins=BINS)
    np.testing.assert_allclose(flat.xi_plus, 0.0, atol=1e-30)


def test_tangential_pattern_and_flips():
    # Ellipses around the origin, e = -|e| exp(2 i phi), at the two ends of diameters: both point across the line that
    # joins them, so xi- = |e|^2, as long as e2 changes its sign with y.
    angle = np.linspace(0.0, 2 * np.pi, 40, endpoint=False) + 0.1
    x, y = 10 * ARCMIN * np.cos(angle), 10 * ARCMIN * np.sin(angle)
    e1, e2 = -0.1 * np.cos(2 * angle), -0.1 * np.sin(2 * angle)
    bins = SeparationBins(19.97 * ARCMIN, 20.03 * ARCMIN, 1)
    single = 1.2e-9  # TreeCorr's single precision, 2^-23 of |e|^2
    for c in (shear_correlation(x, y, e1, e2, bins=bins), shear_correlation(x, -y, e1, -e2, bins=bins)):
        assert c.n_pairs[0] == 20
        assert c.xi_minus[0] == pytest.approx(0.01, abs=single)
        assert c.xi_plus[0] == pytest.approx(0.01, abs=single)
    wrong = shear_correlation(x, -y, e1, e2, bins=bins)
    # phi -> -phi alone: the mean of 0.01 cos(8 phi) over twenty evenly spread directions.
    assert wrong.xi_minus[0] == pytest.approx(0.0, abs=single)
    assert wrong.xi_plus[0] == pytest.approx(0.01, abs=single)


def test_unusable_stars_are_dropped():
    x, y, e1, e2 = catalogue()
    e1[7], e2[20], x[33] = np.nan, np.nan, np.nan
    keep = np.isfinite(e1 + e2 + x)
    c = shear_correlation(x, y, e1, e2, bins=BINS)
    d = shear_correlation(x[keep], y[keep], e1[keep], e2[keep], bins=BINS)
    assert c.n_stars == 297
    assert c.xi_plus.tobytes() == d.xi_plus.tobytes()


def test_empty_bins_are_nan():
    c = shear_correlation(
        [0.0, ARCMIN], [0.0, 0.0], [0.1, 0.1], [0.0, 0.0], bins=SeparationBins(0.5 * ARCMIN, 50 * ARCMIN)
    )
    assert (c.n_pairs == 0).sum() == 19
    for values in (c.xi_plus, c.xi_minus, c.error_plus, c.error_minus):
        assert np.isnan(values).sum() == 19
    assert np.all(np.isfinite(c.r))


def test_shot_noise_error():
    # Pure noise: the scatter of xi over many fields is what the error bar claims, where pairs share few stars.
    results = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        x, y = rng.uniform(0.0, 60 * ARCMIN, (2, 100))
        e1, e2 = rng.normal(0.0, 0.02, (2, 100))
        results.append(shear_correlation(x, y, e1, e2, bins=SeparationBins(10 * ARCMIN, 60 * ARCMIN, 1)))
    scatter = np.std([c.xi_plus[0] for c in results])
    claimed = np.mean([c.error_plus[0] for c in results])
    assert scatter / claimed == pytest.approx(1.0, abs=0.2)  # 200 fields: 5 % each, four sigma


def test_shot_noise_error_of_two_ellipticities_of_the_same_stars():
    """Equal ones have the error of one; of others the scatter over many fields is what the error bar claims."""
    bins = SeparationBins(10 * ARCMIN, 60 * ARCMIN, 1)
    x, y, e1, e2 = catalogue(100)
    weight = np.random.default_rng(9).uniform(0.5, 1.5, 100)
    for weights in (None, weight):
        one = shear_correlation(x, y, e1, e2, bins=bins, weight=weights)
        both = shear_correlation(x, y, e1, e2, other=(e1, e2), bins=bins, weight=weights)
        assert both.error_plus == pytest.approx(one.error_plus, rel=1e-6)
        assert both.error_minus == pytest.approx(one.error_minus, rel=1e-6)
    results = []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        x, y = rng.uniform(0.0, 60 * ARCMIN, (2, 60))
        e, noise = rng.normal(0.0, 0.02, (2, 2, 60))
        # A correlation of i: f lies at 45 degrees to e, and xi+ has a smaller error than of unrelated ones.
        f = np.stack([-e[1], e[0]]) + 0.3 * noise
        results.append(shear_correlation(x, y, *e, other=f, bins=bins))
    for sign in ("plus", "minus"):
        scatter = np.std([getattr(c, f"xi_{sign}")[0] for c in results])
        claimed = np.mean([getattr(c, f"error_{sign}")[0] for c in results])
        assert scatter / claimed == pytest.approx(1.0, abs=0.15), sign  # 400 fields: 3.5 % each, four sigma


def test_stars_without_weight_are_left_out():
    x, y, e1, e2 = catalogue(60)
    weight = np.where(np.arange(60) < 20, 0.0, 1.0)
    patch = np.arange(60) // 20
    some = shear_correlation(x[20:], y[20:], e1[20:], e2[20:], bins=BINS, patch=patch[20:])
    whole = shear_correlation(x, y, e1, e2, bins=BINS, weight=weight, patch=patch)
    assert (whole.n_stars, whole.n_patches) == (40, 2)
    np.testing.assert_array_equal(whole.n_pairs, some.n_pairs)
    np.testing.assert_allclose(whole.error_plus, some.error_plus, rtol=1e-6)
    with pytest.raises(DomainError, match="0 of 60 stars are usable, expected at least 2"):
        shear_correlation(x, y, e1, e2, bins=BINS, weight=np.zeros(60), subtract_mean=True)


def test_means_over_ranges_count_pairs_by_their_weights():
    """The mean over bins is xi+ of one bin as wide as all of them, jackknife included."""
    x, y, e1, e2 = catalogue(80)
    options = {"weight": np.random.default_rng(10).uniform(0.0, 1.0, 80) ** 4, "patch": np.arange(80) // 16}
    many = shear_correlation(x, y, e1, e2, bins=SeparationBins(1.0 * ARCMIN, 9.0 * ARCMIN, 6), **options)
    one = shear_correlation(x, y, e1, e2, bins=SeparationBins(1.0 * ARCMIN, 9.0 * ARCMIN, 1), **options)
    assert many.mean_xi_plus("short") == pytest.approx(one.xi_plus[0], rel=1e-6)
    assert many.error_mean_xi_plus("short") == pytest.approx(one.error_plus[0], rel=1e-5)


def test_cells_agree_with_pairs():
    x, y, e1, e2 = catalogue(3000)
    pairs = shear_correlation(x, y, e1, e2, bins=BINS)
    cells = shear_correlation(x, y, e1, e2, bins=replace(BINS, exact=False))
    # bin_slop = 0.1 blurs bins of 0.5 in ln r by 5 %; the field changes by its own size over about a bin.
    np.testing.assert_allclose(cells.xi_plus, pairs.xi_plus, atol=2e-6)
    assert EXACT_LIMIT >= 189 * 40  # the observed stars of the whole focal plane are counted pair by pair


@pytest.mark.parametrize("exact", [True, False])
def test_same_bytes_again(exact):
    x, y, e1, e2 = catalogue(2000)
    first = shear_correlation(x, y, e1, e2, bins=replace(BINS, exact=exact))
    second = shear_correlation(x, y, e1, e2, bins=replace(BINS, exact=exact))
    assert first.xi_plus.tobytes() == second.xi_plus.tobytes()
    assert first.xi_minus.tobytes() == second.xi_minus.tobytes()


def test_quantities():
    x, y, e1, e2 = catalogue()
    c = shear_correlation(x, y, e1, e2, bins=BINS)
    q = shear_correlation(
        x * u.rad, y * u.rad, e1, e2, bins=SeparationBins(1.0 * u.arcmin, 60.0 * u.arcmin, BINS.n_bins)
    )
    np.testing.assert_allclose(q.xi_plus, c.xi_plus, rtol=1e-9)  # bin edges differ by rounding


def grid_patches(x, y, side=3):
    """Names of square patches, side by side, over one degree."""
    column, row = (np.minimum((v / (60.0 * ARCMIN) * side).astype(int), side - 1) for v in (x, y))
    return np.array([f"R{r}_S{c}" for r, c in zip(row, column, strict=True)])


@pytest.mark.parametrize("cross", [False, True])
def test_jackknife_is_delete_one_patch(cross):
    x, y, e1, e2 = catalogue()
    other = (0.3 * e2 + 0.01, 0.5 * e1) if cross else None
    patch = grid_patches(x, y)
    c = shear_correlation(x, y, e1, e2, patch=patch, other=other, bins=BINS)
    left = []
    for name in np.unique(patch):
        k = patch != name
        part = None if other is None else (other[0][k], other[1][k])
        left.append(shear_correlation(x[k], y[k], e1[k], e2[k], other=part, bins=BINS))
    for sign in ("plus", "minus"):
        xi = np.array([getattr(d, f"xi_{sign}") for d in left])
        expected = np.sqrt(8.0 / 9.0 * np.sum((xi - xi.mean(axis=0)) ** 2, axis=0))
        # Sums of up to 1e4 products in another order, xi about 1e-4, errors about 1e-5.
        np.testing.assert_allclose(getattr(c, f"error_{sign}"), expected, rtol=1e-9)
    np.testing.assert_allclose(c.leave_one_out_plus, [d.xi_plus for d in left], rtol=1e-9)
    np.testing.assert_array_equal(c.leave_one_out_pairs, [d.n_pairs for d in left])
    assert c.n_patches == 9
    assert left[0].n_patches == 0
    assert left[0].leave_one_out_plus.shape == (0, 8)


def test_jackknife_takes_labels_not_their_numbers():
    x, y, e1, e2 = catalogue()
    patch = grid_patches(x, y)
    names, number = np.unique(patch, return_inverse=True)
    a = shear_correlation(x, y, e1, e2, patch=patch, bins=BINS)
    b = shear_correlation(x, y, e1, e2, patch=7 * number + 3, bins=BINS)
    assert len(names) == 9
    assert a.error_plus.tobytes() == b.error_plus.tobytes()


def test_patches_leave_the_correlation():
    x, y, e1, e2 = catalogue()
    plain = shear_correlation(x, y, e1, e2, bins=BINS)
    c = shear_correlation(x, y, e1, e2, patch=grid_patches(x, y), bins=BINS)
    np.testing.assert_array_equal(c.n_pairs, plain.n_pairs)
    np.testing.assert_allclose(c.xi_plus, plain.xi_plus, rtol=1e-10)  # sums in another order
    np.testing.assert_allclose(c.xi_minus, plain.xi_minus, rtol=1e-8, atol=1e-12)
    assert np.all(c.error_plus > plain.error_plus)  # patches of a smooth field are not noise
    again = shear_correlation(x, y, e1, e2, patch=grid_patches(x, y), bins=BINS)
    assert c.error_plus.tobytes() == again.error_plus.tobytes()


@pytest.mark.slow
def test_jackknife_of_independent_patches():
    # Each of 25 patches has its own constant ellipticity: the scatter of xi over 200 such fields, inside a patch.
    edge = np.arange(5) * 60.0 * ARCMIN
    results = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        x, y = (np.repeat(v.ravel(), 8) + rng.uniform(0.0, 5.0 * ARCMIN, 200) for v in np.meshgrid(edge, edge))
        e1, e2 = (np.repeat(rng.normal(0.0, 0.01, 25), 8) for _ in range(2))
        bins = SeparationBins(0.5 * ARCMIN, 8.0 * ARCMIN, 1)
        results.append(shear_correlation(x, y, e1, e2, patch=np.repeat(np.arange(25), 8), bins=bins))
    scatter = np.std([c.xi_plus[0] for c in results])
    claimed = np.sqrt(np.mean([c.error_plus[0] ** 2 for c in results]))
    assert scatter / claimed == pytest.approx(1.0, abs=0.2)  # 200 fields: 5 % each, four sigma


def test_no_jackknife_where_one_patch_holds_all_pairs():
    # Two patches far apart: pairs between them are gone without either.
    x = np.array([0.0, 1.0, 50.0, 51.0]) * ARCMIN
    bins = SeparationBins(0.5 * ARCMIN, 60.0 * ARCMIN, 2)
    c = shear_correlation(x, np.zeros(4), [0.1, 0.2, 0.1, 0.1], np.zeros(4), patch=[0, 0, 1, 1], bins=bins)
    np.testing.assert_array_equal(c.n_pairs, [2, 4])
    # Without one patch only the pair of the other is left: 0.01 and 0.02, so sqrt((2 - 1) / 2 * 2 * 0.005^2).
    assert c.error_plus[0] == pytest.approx(0.005, rel=1e-6)  # single precision
    assert np.isnan(c.error_plus[1])
    assert np.isfinite(c.xi_plus[1])


def test_patches_of_a_run_are_a_jackknife_from_five_on():
    """The error of a jackknife of n patches is good to 1/sqrt(2 (n - 1)), as that of the variance of n numbers."""
    assert patches_of_jackknife(np.repeat(np.arange(4), 9)) is None
    assert patches_of_jackknife(np.repeat(np.arange(5), 2)).tolist() == np.repeat(np.arange(5), 2).tolist()
    values = np.random.default_rng(6).normal(size=(4000, 5))
    variances = [jackknife_error((v.sum() - v) / 4.0) ** 2 for v in values]  # of the mean of five
    assert np.mean(variances) == pytest.approx(0.2, rel=0.05)
    assert np.std(variances) / np.mean(variances) / 2.0 == pytest.approx(1.0 / np.sqrt(8.0), rel=0.05)


def test_cross_correlation_counts_both_orders():
    x, y, e1, e2 = catalogue(60)
    f1, f2 = 0.01 + e2**2, -0.02 + 0.3 * e1
    c = shear_correlation(x, y, e1, e2, other=np.stack([f1, f2]), bins=BINS)
    edges = np.geomspace(BINS.min_sep, BINS.max_sep, 9)
    i, j = np.triu_indices(60, 1)
    bins = np.digitize(np.hypot(x[j] - x[i], y[j] - y[i]), edges) - 1
    e, f = e1 + 1j * e2, f1 + 1j * f2
    phase = np.exp(-4j * np.arctan2(y[j] - y[i], x[j] - x[i]))
    both = 0.5 * (e[i] * f[j].conj() + f[i] * e[j].conj()).real
    turned = 0.5 * ((e[i] * f[j] + f[i] * e[j]) * phase).real
    for b in range(8):
        assert c.n_pairs[b] == (bins == b).sum()
        if c.n_pairs[b]:
            assert c.xi_plus[b] == pytest.approx(both[bins == b].mean(), abs=1e-10)
            assert c.xi_minus[b] == pytest.approx(turned[bins == b].mean(), abs=1e-10)


def test_bad_patches():
    x, y, e1, e2 = catalogue(10)
    with pytest.raises(DomainError, match=r"patch has shape \(3,\)"):
        shear_correlation(x, y, e1, e2, patch=[0, 1, 2], bins=BINS)
    with pytest.raises(DomainError, match="of patch R22_S11, expected at least 2"):
        shear_correlation(x, y, e1, e2, patch=["R22_S11"] * 10, bins=BINS)
    with pytest.raises(DomainError, match="shapes"):
        shear_correlation(x, y, e1, e2, other=(e1, e2[:5]), bins=BINS)
    with pytest.raises(DomainError, match=r"other = .*: expected a sequence of 2"):
        shear_correlation(x, y, e1, e2, other=(e1, e2, e1), bins=BINS)


def test_bad_arguments():
    x, y, e1, e2 = catalogue(10)
    with pytest.raises(DomainError, match="shapes"):
        shear_correlation(x, y[:5], e1, e2, bins=BINS)
    with pytest.raises(DomainError, match="shapes"):
        shear_correlation(0.0, 0.0, 0.0, 0.0, bins=BINS)
    with pytest.raises(DomainError, match="e1 = "):
        shear_correlation(x, y, ["a"] * 10, e2, bins=BINS)
    with pytest.raises(DomainError, match="0 of 10 stars"):
        shear_correlation(x, y, e1 * np.nan, e2, bins=BINS)
    for low, high in ((0.0, 1.0), (2.0, 1.0), (np.nan, 1.0), (1.0, np.inf)):
        with pytest.raises(DomainError, match="min_sep"):
            SeparationBins(low, high)
    with pytest.raises(DomainError, match="n_bins"):
        SeparationBins(0.1, 1.0, n_bins=0)
    with pytest.raises(DomainError, match=r"^min_sep = 3.0 m: expected"):
        SeparationBins(3.0 * u.m, 1.0)
    with pytest.raises(ConfigError, match=r"^min_sep: no argument of shear_correlation; expected bins=SeparationBins"):
        shear_correlation(x, y, e1, e2, min_sep=0.1, max_sep=1.0)


#: Calls with separations or bins of no physical sense, and what the one line of each begins with.
BEYOND_RANGES = (
    (
        {"min_sep": 1e-200, "max_sep": 0.1},
        "min_sep = 1e-200, max_sep = 0.1: expected separations of 1e-12 to 6.2",
    ),
    ({"min_sep": 5e-324, "max_sep": 0.1}, "min_sep = 5e-324, max_sep = 0.1: expected separations"),
    ({"min_sep": -1.0, "max_sep": 0.1}, "min_sep = -1.0, max_sep = 0.1: expected separations"),
    ({"min_sep": 1e-3, "max_sep": 1e10}, "min_sep = 0.001, max_sep = 10000000000.0: expected separations"),
    ({"min_sep": 1e-3, "max_sep": 1e60}, "max_sep = 1e+60: expected one angle below 1e+50 in SI"),
    ({"min_sep": 0.5, "max_sep": 0.5000001}, "min_sep = 0.5, max_sep = 0.5000001: expected a max_sep of at least"),
    ({"min_sep": 0.1, "max_sep": 1.0, "n_bins": 1001}, "n_bins = 1001: expected a whole number of at most 1000"),
)
_CALLS = f"""
import numpy as np, pachon
x, y, e1, e2 = np.random.default_rng(0).normal(0.0, 0.01, (4, 60))
x[1], y[1] = x[0], y[0]
size = np.ones(60)
for options, _ in {BEYOND_RANGES!r}:
    for call, columns in (
        (pachon.shear_correlation, (e1, e2)),
        (pachon.rho_statistics, (e1, e2, size, 0.9 * e1, 0.9 * e2, size)),
    ):
        try:
            call(x, y, *columns, bins=pachon.SeparationBins(**options))
        except pachon.PachonError as error:
            print(error)
# The widest range of all, with two stars at one place.
print(pachon.shear_correlation(x, y, e1, e2, bins=pachon.SeparationBins(1e-12, 6.28, 1000)).n_pairs.sum())
"""


@pytest.mark.long
def test_separations_and_bins_beyond_their_ranges_are_refused():
    # In a process of its own, which a segmentation fault ends: TreeCorr looks for the bin of log(0) in its arrays.
    run = subprocess.run([sys.executable, "-c", _CALLS], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    *errors, pairs = run.stdout.splitlines()
    assert len(errors) == 2 * len(BEYOND_RANGES)
    for i, (_, begin) in enumerate(BEYOND_RANGES):
        assert all(line.startswith(begin) for line in errors[2 * i : 2 * i + 2])
    # All pairs of 60 stars but the one of no separation.
    assert int(pairs) == 60 * 59 // 2 - 1


def test_whole_weights_are_stars_that_many_times():
    rng = np.random.default_rng(8)
    x, y = rng.uniform(0, 60 * ARCMIN, (2, 80))
    e1, e2 = rng.normal(0, 0.02, (2, 80))
    count = rng.integers(0, 4, 80)
    # Copies of a star are apart by less than the first bin.
    many = [np.repeat(v, count) for v in (x, y, e1, e2)]
    one, other = shear_correlation(x, y, e1, e2, weight=count, bins=BINS), shear_correlation(*many, bins=BINS)
    filled = other.n_pairs > 0
    assert filled.sum() > 3
    for key in ("xi_plus", "xi_minus"):
        np.testing.assert_allclose(getattr(one, key)[filled], getattr(other, key)[filled], rtol=1e-6, atol=1e-10)
    shifted = shear_correlation(x, y, e1, e2, weight=count, subtract_mean=True, bins=BINS)
    expected = shear_correlation(*many, subtract_mean=True, bins=BINS)
    np.testing.assert_allclose(shifted.xi_plus[filled], expected.xi_plus[filled], rtol=1e-6, atol=1e-10)
    for wrong in (count[1:], -count - 1.0, np.full(80, np.nan)):
        with pytest.raises(DomainError, match=r"^weight: expected 80 finite numbers from 0, one for each star$"):
            shear_correlation(x, y, e1, e2, weight=wrong, bins=BINS)
