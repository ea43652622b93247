"""The desk of a run: views of its stars, without a browser; Bokeh is not needed."""

from dataclasses import replace

import numpy as np
import pytest

from pachon.core.errors import DomainError, PachonError, ProductError
from pachon.desk.run_views import KINDS, RunBench, run_correlation, run_numbers, run_stamps, run_whiskers
from pachon.reconstruction.ccd_product import read_product

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def bench(finished_run):
    return RunBench(finished_run)


def test_whiskers_are_the_ellipticities_of_the_products(bench, finished_run):
    products = [read_product(path) for path in sorted(finished_run.glob("ccd_*.fits"))]
    columns = {
        "observed": lambda p: p.observed.g1,
        "model": lambda p: p.observed.model_g1,
        "observed - model": lambda p: p.observed.g1 - p.observed.model_g1,
        "noise-free": lambda p: p.holdout.g1,
        "noise-free - model": lambda p: p.holdout.g1 - p.holdout.model_g1,
    }
    for kind in KINDS:
        expected = np.concatenate([columns[kind](p) for p in products])
        view = run_whiskers(bench, replace(bench.start, kind=kind))
        np.testing.assert_array_equal(view.e1, expected[np.isfinite(expected)])
        number = run_numbers(view, len(products))["adaptive ellipticity g, rms"]
        assert number == (pytest.approx(100 * np.sqrt(np.mean(view.e1**2 + view.e2**2))), "%")
    x = np.concatenate([p.observed.x[np.isfinite(p.observed.g1)] for p in products])
    np.testing.assert_allclose(run_whiskers(bench, bench.start).x_mm, 1e3 * x)


def test_a_range_of_magnitudes_selects_the_observed_stars(bench):
    low, high = bench.start.magnitudes
    brighter = replace(bench.start, magnitudes=(low, 0.5 * (low + high)))
    magnitude = np.concatenate([s.observed.magnitude for s in bench.ccds.values()])
    usable = np.isfinite(np.concatenate([s.observed.g1 for s in bench.ccds.values()]))
    count = np.count_nonzero(usable & (magnitude <= 0.5 * (low + high)))
    assert len(run_whiskers(bench, brighter).e1) == count
    with pytest.raises(DomainError, match=r"^0 stars are selected: expected 20 for a correlation$"):
        run_correlation(bench, replace(bench.start, magnitudes=(high + 1, high + 2)))


def test_the_correlation_is_that_of_all_pairs_by_brute_force(bench):
    state = replace(bench.start, kind="noise-free")
    view = run_correlation(bench, state)
    stars = [s.holdout for s in bench.ccds.values()]
    x, y, g1, g2 = (np.concatenate([getattr(s, n) for s in stars]) for n in ("field_x", "field_y", "g1", "g2"))
    first, second = np.triu_indices(len(x), 1)
    r = np.hypot(x[first] - x[second], y[first] - y[second]) / np.deg2rad(1 / 60)
    product = g1[first] * g1[second] + g2[first] * g2[second]
    edges = np.geomspace(1 / 6, np.hypot(np.ptp(x), np.ptp(y)) / np.deg2rad(1 / 60), 13)
    counts, _ = np.histogram(r, edges)
    fullest = int(counts.argmax())
    near = (r > edges[fullest]) & (r < edges[fullest + 1])
    # TreeCorr takes cells of stars together at the edges of a bin.
    assert view.xi_plus[fullest] == pytest.approx(product[near].mean(), abs=0.05 * np.abs(product).mean())


def test_stamps_are_star_model_and_difference(bench):
    view = run_stamps(bench, bench.start)
    side = view.image.shape[0] // 3
    difference, model, star = (view.image[k * side : (k + 1) * side] for k in range(3))
    np.testing.assert_allclose(difference, star - model, atol=1e-12)
    assert view.image.shape[1] == view.stars * side
    # The model of each star has its peak at one.
    np.testing.assert_allclose(model.reshape(side, view.stars, side).max(axis=(0, 2)), 1.0, rtol=1e-6)


def test_what_is_no_run_or_no_selection_is_one_line(bench, tmp_path):
    with pytest.raises(ProductError, match="expected a folder with ccd_"):
        RunBench(tmp_path)
    for change in ({"kind": "dark"}, {"ccd": "R99_S99"}, {"magnitudes": (20.0, 19.0)}):
        with pytest.raises(PachonError):
            run_whiskers(bench, replace(bench.start, **change))
    x, y = 1e3 * np.array(bench.ccds[bench.start.ccd].center)
    assert bench.nearest_ccd(x + 3.0, y) == bench.start.ccd
