"""The desk of a run: views of its stars, without a browser; Bokeh is not needed."""

from dataclasses import replace

import numpy as np
import pytest

from pachon.core.errors import DomainError, PachonError, ProductError
from pachon.desk.run_views import (
    KINDS,
    RunBench,
    run_components,
    run_correlation,
    run_numbers,
    run_stamps,
    run_whiskers,
)
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
        "observed - model without the star": lambda p: p.observed.g1 - p.observed.leave_one_out_g1,
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


def test_a_box_on_the_field_selects_stars_of_both_kinds(bench):
    x, y = 1e3 * np.array(bench.ccds[bench.start.ccd].center)
    box = replace(bench.start, x_mm=(x - 30.0, x), y_mm=(y - 30.0, y + 5.0))
    for kind, stars in (("observed", "observed"), ("noise-free", "holdout")):
        columns = [getattr(s, stars) for s in bench.ccds.values()]
        inside = [
            (1e3 * s.x <= x) & (1e3 * s.y <= y + 5) & (1e3 * s.x >= x - 30) & (1e3 * s.y >= y - 30) for s in columns
        ]
        expected = np.concatenate([s.g1[i] for s, i in zip(columns, inside, strict=True)])
        assert 0 < len(expected) < sum(map(len, columns))
        np.testing.assert_array_equal(run_whiskers(bench, replace(box, kind=kind)).e1, expected[np.isfinite(expected)])


def test_components_are_those_of_the_model_of_the_ccd(bench, finished_run):
    ccd = list(bench.ccds)[-1]
    [row] = run_components(bench, replace(bench.start, ccd=ccd)).rows.values()
    model = read_product(finished_run / f"ccd_{ccd}.fits").model
    np.testing.assert_allclose(row[0], model.mean / model.mean.max())
    for image, component in zip(row[1:], model.components, strict=False):
        np.testing.assert_allclose(image, component / np.abs(component).max())


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
    assert view.image.shape[1] == view.columns * side
    # The model of each star has its peak at one.
    np.testing.assert_allclose(model.reshape(side, view.columns, side).max(axis=(0, 2)), 1.0, rtol=1e-6)


def test_what_is_no_run_or_no_selection_is_one_line(bench, tmp_path):
    with pytest.raises(ProductError, match="expected a folder with ccd_"):
        RunBench(tmp_path)
    for change in ({"kind": "dark"}, {"ccd": "R99_S99"}, {"magnitudes": (20.0, 19.0)}, {"x_mm": (2.0, 1.0)}):
        with pytest.raises(PachonError):
            run_whiskers(bench, replace(bench.start, **change))
    x, y = 1e3 * np.array(bench.ccds[bench.start.ccd].center)
    assert bench.nearest_ccd(x + 3.0, y) == bench.start.ccd


def test_a_box_that_is_drawn_sets_the_sliders_and_an_empty_one_changes_nothing(bench):
    pytest.importorskip("bokeh", reason="a desk needs Bokeh: pip install 'pachon[desk]'")
    from pachon.desk.run_session import RunSession

    session = RunSession(bench)
    (left, right), (bottom, top) = bench.start.x_mm, bench.start.y_mm
    half = 0.5 * (left + right)
    session._brush({"type": "rect", "x0": half, "x1": left - 50.0, "y0": bottom, "y1": top + 9.0})
    assert session.ranges["x_mm"].value == (left, half)
    assert session.region.visible
    state = replace(bench.start, x_mm=(left, half))
    selected = run_numbers(run_whiskers(bench, state), len(bench.ccds))
    assert f">{selected['stars'][0]:.4g}</b>" in session.table.text
    session._brush({"type": "rect", "x0": half, "x1": half, "y0": bottom, "y1": bottom})
    assert session.status.visible
    assert session.ranges["x_mm"].value == (left, half)
    # Too few stars for a correlation: its picture goes, the others stay.
    session._brush({"type": "rect", "x0": left, "x1": left + 12.0, "y0": bottom, "y1": bottom + 12.0})
    assert [picture.figure.visible for picture in session.pictures] == [True, False, True, True]
    assert "expected 20 for a correlation" in session.status.text
