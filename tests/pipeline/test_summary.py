"""Metrics of a run: the ranges of separation of its mean correlations."""

from dataclasses import fields, replace

import numpy as np
import pytest

from pachon.measure.correlation import Correlation, shear_correlation
from pachon.pipeline.summary import bins_up_to, ccd_metrics, run_metrics, scatter, size_scatter
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


def test_the_field_of_a_ccd_is_that_of_its_middle_wherever_its_stars_are(finished_run):
    product = read_product(finished_run / "ccd_R22_S11.fits")
    right = product.holdout.x > np.median(product.holdout.x)
    half = {f.name: getattr(product.holdout, f.name) for f in fields(product.holdout)}
    half = {name: values if values is None else values[right] for name, values in half.items()}
    # The middle of R22_S11 lies on the axis.
    assert ccd_metrics(product)["field_deg"] == pytest.approx(0.0, abs=2e-4)
    metrics = ccd_metrics(replace(product, holdout=type(product.holdout)(**half)))
    assert metrics["field_deg"] == pytest.approx(0.0, abs=2e-4)


def test_one_measured_psf_of_a_ccd_has_no_scatter(finished_run):
    """As of images narrower than a pixel, of which adaptive moments measure few: not a scatter of zero."""
    product = read_product(finished_run / "ccd_R22_S11.fits")
    missing = np.full_like(product.holdout.g1, np.nan)
    missing[0] = product.holdout.g1[0]
    one = replace(product, holdout=replace(product.holdout, g1=missing))
    assert np.isnan(scatter([one], "g"))
    assert np.isnan(size_scatter([one]))
    assert scatter([one, product], "g") == scatter([product], "g")
    metrics = run_metrics([one, product], {})["all"]
    assert metrics["truth_psfs_with_g"] == metrics["truth_psfs"] // 2 + 1


def test_no_pairs_within_a_range_give_no_mean():
    found = correlation([1.0, 200.0], [4.0, 8.0], [1, 1])
    assert np.isnan(found.mean_xi_plus("long"))
    assert found.mean_xi_plus("short") == 4.0


@pytest.mark.parametrize("longest", [9.0, 47.0, 180.0, 215.0])
def test_mean_xi_plus_is_that_of_all_pairs_within_the_range(longest):
    """Whichever separations the stars reach, no pair of one range is counted in the other."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0.0, longest / np.sqrt(2.0), (2, 150))
    e = rng.normal(size=(2, 150)) * 0.1 + np.stack([x, y]) / longest
    result = shear_correlation(x * ARCMIN, y * ARCMIN, *e, bins=bins_up_to(longest * ARCMIN))
    first, second = np.triu_indices(150, 1)
    separation = np.hypot(x[first] - x[second], y[first] - y[second])
    products = (e[:, first] * e[:, second]).sum(axis=0)
    for name, low, high in (("short", 10.0**2 / 180.0, 10.0), ("long", 10.0, 180.0)):
        of_range = (separation >= low) & (separation < high)
        if not of_range.any():
            assert np.isnan(result.mean_xi_plus(name))
            continue
        # TreeCorr keeps ellipticities in single precision.
        assert result.mean_xi_plus(name) == pytest.approx(products[of_range].mean(), rel=1e-5)
    assert result.n_pairs.sum() == (separation >= 10.0**2 / 180.0).sum()
