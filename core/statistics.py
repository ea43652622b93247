"""Means and scatter of values of which some are not finite."""

from __future__ import annotations

import numpy as np

#: Standard deviation of a Gaussian over its median absolute deviation.
RMS_PER_MAD = 1.4826
#: FWHM of a Gaussian over its standard deviation.
FWHM_PER_RMS = float(np.sqrt(8.0 * np.log(2.0)))
# Standard deviations by which the mean square of noise may be above its variance.
_CHANCE = 2.0


def finite_mean(values: np.ndarray) -> float:
    """Return the mean of the finite values; NaN where there are none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else np.nan


def finite_median(values: np.ndarray) -> float:
    """Return the median of the finite values; NaN where there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else np.nan


def rms(values: np.ndarray) -> float:
    """Return the root of the mean square of the finite values; NaN where there are none."""
    return float(np.sqrt(finite_mean(values**2)))


def robust_rms(values: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Return the rms of Gaussian noise by the median absolute deviation from the median, NaN left out."""
    deviations = values - np.nanmedian(values, axis=axis, keepdims=True)
    return RMS_PER_MAD * np.asarray(np.nanmedian(np.abs(deviations), axis=axis))


def finite_row_medians(values: np.ndarray) -> np.ndarray:
    """Return the medians of the rows [n, m] without their NaN, [n]; NaN where there is nothing else.

    As :func:`numpy.nanmedian`, in a tenth of its time.
    """
    rising = np.sort(values, axis=1)  # NaN last
    count = values.shape[1] - np.isnan(values).sum(axis=1)
    rows = np.arange(len(values))
    low, high = (rising[rows, np.maximum(middle, 0)] for middle in ((count - 1) // 2, count // 2))
    return np.where(count > 0, 0.5 * (low + high), np.nan)


def row_medians(values: np.ndarray) -> np.ndarray:
    """Return the medians of the rows [n, m] of finite values, [n].

    As :func:`numpy.median`, which looks for NaN and selects three values a row, in half of its time.
    """
    count = values.shape[1]
    middle = count // 2
    rising = np.partition(values, middle, axis=1)
    if count % 2:
        return rising[:, middle]
    return np.asarray((rising[:, :middle].max(axis=1) + rising[:, middle]) / 2.0)


def sorted_columns(values: np.ndarray) -> np.ndarray:
    """Return the columns of values [n, k], each in rising order, [k, n]."""
    return np.sort(np.ascontiguousarray(values.T), axis=1)


def column_median(rising: np.ndarray) -> np.ndarray:
    """Return the medians [k] of :func:`sorted_columns`, as :func:`numpy.median` has them."""
    count = rising.shape[1]
    low, high = rising[:, (count - 1) // 2], rising[:, count // 2]
    return np.asarray(high if count % 2 else (low + high) / 2.0)


def median_image(images: np.ndarray) -> np.ndarray:
    """Return the median [ny, nx] of images [n, ny, nx] of finite values.

    As :func:`numpy.median`, in half of its time.
    """
    return column_median(sorted_columns(images.reshape(len(images), -1))).reshape(images.shape[1:])


def column_percentile(rising: np.ndarray, percent: float) -> np.ndarray:
    """Return a percentile [k] of :func:`sorted_columns`, interpolated as :func:`numpy.percentile` does."""
    place = (rising.shape[1] - 1) * (percent / 100.0)
    below = int(place)
    part, low, high = place - below, rising[:, below], rising[:, min(below + 1, rising.shape[1] - 1)]
    step = high - low
    return np.asarray(high - step * (1.0 - part) if part >= 0.5 else low + step * part)


def masked_median(values: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Return the median along the first axis of values that are neither masked nor NaN; NaN where there are none.

    As :func:`numpy.nanmedian`, in a fifth of its time.
    """
    bad = masks | np.isnan(values)
    rising = np.sort(np.moveaxis(np.where(bad, np.inf, values), 0, -1), axis=-1)
    count = len(values) - bad.sum(axis=0)
    low, high = (
        np.take_along_axis(rising, np.maximum(middle, 0)[..., None], axis=-1)[..., 0]
        for middle in ((count - 1) // 2, count // 2)
    )
    return np.where(count > 0, 0.5 * (low + high), np.nan)


def signal_share(square: np.ndarray, variance: np.ndarray | float, scatter: np.ndarray | float) -> np.ndarray:
    """Return the part of mean squares [n] that is not noise of a variance, and not chance; 1 where they are zero.

    `scatter` is the standard deviation of the mean square of the noise over its variance.
    """
    by_chance = variance * (1.0 + _CHANCE * scatter)
    ratio = np.divide(by_chance, square, out=np.zeros_like(square), where=square > 0.0)
    return np.asarray(np.maximum(1.0 - ratio, 0.0))
