import numpy as np
import pytest

from pachon.core.statistics import (
    column_median,
    column_percentile,
    finite_mean,
    finite_median,
    finite_row_medians,
    masked_median,
    rms,
    robust_rms,
    row_medians,
    sorted_columns,
)


def test_values_that_are_not_finite_are_left_out():
    values = np.array([1.0, np.nan, 3.0, np.inf, 8.0])
    assert finite_mean(values) == 4.0
    assert finite_median(values) == 3.0
    assert rms(values) == pytest.approx(np.sqrt((1.0 + 9.0 + 64.0) / 3.0), rel=1e-15)
    for statistic in (finite_mean, finite_median, rms):
        assert np.isnan(statistic(np.array([np.nan])))


def test_robust_rms_is_that_of_the_noise_below_outliers():
    noise = np.random.default_rng(1).normal(5.0, 2.0, 40_000)
    values = np.where(np.arange(len(noise)) % 100 == 0, 1e6, noise)
    # The standard error is 1.17 / sqrt(2 n) = 0.4 %; one outlier in a hundred adds 1.6 %.
    assert robust_rms(values) == pytest.approx(2.0, rel=0.03)
    table = np.stack([noise[:101], np.where(np.arange(101) < 50, np.nan, noise[:101])])
    middles = [np.median(row[np.isfinite(row)]) for row in table]
    restated = [1.4826 * np.median(np.abs(r[np.isfinite(r)] - m)) for r, m in zip(table, middles, strict=True)]
    assert robust_rms(table, axis=1) == pytest.approx(restated, rel=1e-15)


@pytest.mark.parametrize("count", [1, 6, 7])
def test_masked_median_is_that_of_the_other_values(count):
    rng = np.random.default_rng(count)
    values, masks = rng.normal(size=(count, 4, 5)), rng.random((count, 4, 5)) < 0.3
    values[0, 1, 1], masks[:, 2, 2] = np.nan, True
    medians = masked_median(values, masks)
    for at in np.ndindex(4, 5):
        good = values[:, *at][~masks[:, *at] & ~np.isnan(values[:, *at])]
        assert np.array_equal(medians[at], np.median(good) if len(good) else np.nan, equal_nan=True)


@pytest.mark.parametrize("count", [1, 2, 5, 12, 40, 41])
def test_medians_and_percentiles_of_rows_and_columns_have_numpys_bits(count):
    values = np.round(np.random.default_rng(count).normal(size=(count, 9)), 1)  # with ties
    rising = sorted_columns(values)
    assert np.array_equal(column_median(rising), np.median(values, axis=0))
    assert np.array_equal(row_medians(values.T), np.median(values, axis=0))
    for percent in (0.0, 13.0, 50.0, 80.0, 100.0):
        assert np.array_equal(column_percentile(rising, percent), np.percentile(values, percent, axis=0))


def test_medians_of_the_finite_values_of_rows():
    rng = np.random.default_rng(5)
    values = rng.normal(size=(9, 20))
    values[rng.random(values.shape) < np.linspace(0.0, 1.0, 9)[:, None]] = np.nan
    assert np.array_equal(finite_row_medians(values[:8]), np.nanmedian(values[:8], axis=1))
    assert np.isnan(values[8]).all()
    assert np.isnan(finite_row_medians(values)[8])
