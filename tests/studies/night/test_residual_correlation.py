"""Correlations of visits and of a night against sums over all pairs."""

import json

import numpy as np
import pytest

from pachon.core.long_work import Execution
from pachon.core.products import read_fits
from pachon.studies.night.night import run_night
from pachon.studies.night.report import verdict
from pachon.studies.night.residual_correlation import mean_correlations, range_means


def visit(r, xi, pairs):
    return {"R": np.array(r), "PAIRS": np.array(pairs), "XI_TRUTH": np.array(xi) * 10.0, "XI_AWAY": np.array(xi)}


def test_a_visit_counts_by_its_pairs_and_errors_are_those_of_the_scatter():
    visits = [visit([2.0, 20.0], [3.0, np.nan], [10, 0]), visit([4.0, 20.0], [6.0, 1.0], [20, 5])]
    away = mean_correlations(visits)["away"]
    np.testing.assert_allclose(away.xi_plus, [(10 * 3.0 + 20 * 6.0) / 30, 1.0])
    np.testing.assert_allclose(away.r_arcmin, [(10 * 2.0 + 20 * 4.0) / 30, 20.0])
    assert away.pairs.tolist() == [30, 5]
    assert away.visits == 2
    # Two values with shares 1/3 and 2/3 of mean 5: (4/9 + 4/9) * 2/1.
    np.testing.assert_allclose(away.error_plus, [np.sqrt((2.0 / 3) ** 2 + (2.0 / 3) ** 2) * np.sqrt(2.0), np.nan])
    metrics = range_means(visits)
    assert metrics["xi_plus_g_away_short"] == pytest.approx(5.0)
    assert metrics["xi_plus_g_truth_short"] == pytest.approx(50.0)
    assert metrics["xi_plus_g_away_long"] == pytest.approx(1.0)
    assert np.isnan(metrics["error_xi_plus_g_away_long"])


def test_the_error_of_a_mean_over_many_visits_is_that_of_their_scatter():
    rng = np.random.default_rng(3)
    means, errors = [], []
    for _ in range(400):
        visits = [visit([2.0], [value], [100]) for value in rng.normal(size=12)]
        away = mean_correlations(visits)["away"]
        means.append(away.xi_plus[0])
        errors.append(away.error_plus[0])
    assert np.mean(np.square(errors)) == pytest.approx(np.var(means), rel=0.2)
    assert np.var(means) == pytest.approx(1 / 12, rel=0.2)


def test_visits_without_models_and_none_at_all():
    visits = [visit([2.0], [1.0], [10]) | {"XI_AWAY": np.array([np.nan])}]
    assert list(mean_correlations(visits)) == ["truth"]
    assert list(range_means(visits)) == ["xi_plus_g_truth_short", "error_xi_plus_g_truth_short"]
    assert mean_correlations([]) == range_means([]) == {}


def test_a_verdict_of_nights_without_models_or_bands():
    assert verdict({"finished": 2, "visits": 3, "left_out": {"1": "low"}, "bands": {}}) == "1 of 3 visits have a PSF."
    text = verdict({"finished": 3, "visits": 3, "left_out": {}, "bands": {"r": {}}})
    assert text == "3 of 3 visits have a PSF; median limiting magnitudes (S/N 5): r."


@pytest.mark.long
@pytest.mark.usefixtures("empty_pictures")
def test_a_night_has_the_correlation_of_its_products_and_a_page(night_config, tmp_path):
    config = night_config(run={"ccds": ["R22_S11", "R22_S12"]}, products=True, maps={"nside": 0})
    result = run_night(config, tmp_path / "night", execution=Execution(threads=1))
    products = [read_fits(result.folder / "visits" / f"visit_1001_ccd_{name}.fits") for name in ("R22_S11", "R22_S12")]
    tables = [hdus["TRUTH"].data for hdus in products]
    g1, g2 = (np.concatenate([t[f"G{i}"] - t[f"MODEL_G{i}"] for t in tables]) for i in (1, 2))
    x, y = (np.concatenate([t[key] for t in tables]) for key in ("X", "Y"))
    first, second = np.triu_indices(len(x), 1)
    # 0.01 mm are 0.2 arcsec, near the axis.
    separation = np.hypot(x[first] - x[second], y[first] - y[second]) / 0.01 * 0.2 / 60
    products_of_pairs = g1[first] * g1[second] + g2[first] * g2[second]
    xi = read_fits(result.folder / "visits" / "visit_1001.fits")["XI"].data
    shortest = 10.0**2 / 180.0
    assert xi["PAIRS"].sum() == (separation > shortest).sum()
    expected = products_of_pairs[separation > shortest].mean()
    bins = xi[xi["PAIRS"] > 0]
    assert np.average(bins["XI_AWAY"], weights=bins["PAIRS"]) == pytest.approx(expected, rel=1e-3, abs=1e-12)
    summary = json.loads((result.folder / "summary.json").read_text())
    assert summary["correlation_g"]["r"]["away"]["visits"] == 1
    page = (result.folder / "report.html").read_text()
    assert "2 of 3 visits have a PSF; median limiting magnitudes (S/N 5): i " in page
    assert "zenith_angle_deg" in page  # why the second is left out
