"""Metrics of a run: the ranges of separation of its mean correlations."""

import numpy as np
import pytest

from pachon.measure.correlation import Correlation
from pachon.pipeline.summary import run_metrics
from pachon.reconstruction.ccd_product import read_product

ARCMIN = np.deg2rad(1 / 60)


def correlation(r_arcmin, xi_plus, n_pairs):
    xi_plus = np.array(xi_plus)
    return Correlation(
        np.array(r_arcmin) * ARCMIN, xi_plus, xi_plus, xi_plus, xi_plus, np.array(n_pairs), n_stars=sum(n_pairs)
    )


def test_long_separations_are_those_from_10_to_180_arcmin(finished_run):
    products = [read_product(finished_run / "ccd_R22_S11.fits")]
    found = correlation([1.0, 9.9, 10.1, 100.0, 181.0, 210.0], [4.0, 8.0, 1.0, 2.0, 50.0, 60.0], [1, 3, 2, 2, 5, 5])
    metrics = run_metrics(products, {"truth": found})["all"]
    assert metrics["xi_plus_truth_short"] == pytest.approx((4.0 + 3 * 8.0) / 4)
    assert metrics["xi_plus_truth_long"] == pytest.approx(1.5)
    assert np.isnan(metrics["error_xi_plus_truth_long"])


def test_no_pairs_within_a_range_give_no_mean():
    found = correlation([1.0, 200.0], [4.0, 8.0], [1, 1])
    assert np.isnan(found.mean_xi_plus("long"))
    assert found.mean_xi_plus("short") == 4.0
