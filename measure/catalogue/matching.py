"""Matching of a catalogue to the truth: completeness and purity against magnitude."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE, ORANGE, axes_at, styled
from ...core.result import Result
from ...core.units import real_array, require_positive

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@check_arguments
def match_positions(x: ArrayLike, y: ArrayLike, true_x: ArrayLike, true_y: ArrayLike, radius: float) -> np.ndarray:
    """Match positions to true ones that are mutually nearest.

    Parameters
    ----------
    x, y : array
        Positions, [n].
    true_x, true_y : array
        True positions, [m], in the same unit.
    radius : float
        Largest distance of a pair.

    Returns
    -------
    array of int
        Index of the true position of each one, -1 where there is none, [n]. No true one occurs twice.

    Raises
    ------
    DomainError
        If shapes differ, a position is not finite or the radius not positive.
    """
    positions, true_positions = (
        np.stack([real_array(v, f"{name}: expected real numbers [n]").ravel() for v in pair], axis=1)
        if np.shape(pair[0]) == np.shape(pair[1]) and np.ndim(pair[0]) == 1
        else _require_equal_shapes(name, pair)
        for name, pair in (("x, y", (x, y)), ("true_x, true_y", (true_x, true_y)))
    )
    for name, places in (("x, y", positions), ("true_x, true_y", true_positions)):
        if not np.isfinite(places).all():
            raise DomainError(f"{name}: expected finite positions")
    radius = require_positive(radius, "radius")
    if not len(positions) or not len(true_positions):
        return np.full(len(positions), -1)
    distance, nearest = KDTree(true_positions).query(positions, distance_upper_bound=radius)
    _, back = KDTree(positions).query(true_positions)
    near = np.isfinite(distance)
    mutual = near.copy()
    mutual[near] = back[nearest[near]] == np.flatnonzero(near)
    return np.where(mutual, nearest, -1)


def _require_equal_shapes(name: str, pair: tuple[ArrayLike, ArrayLike]) -> np.ndarray:
    raise DomainError(f"{name} have shapes {np.shape(pair[0])} and {np.shape(pair[1])}: expected one length")


@dataclass(frozen=True)
class DetectionRates(Result):
    """Completeness and purity of a catalogue in bins of magnitude.

    Parameters
    ----------
    edges : array
        Of the bins [mag], [n_bins + 1].
    n_true, n_found : array of int
        True objects of each bin of true magnitude, and those of them that have a match, [n_bins].
    n_detected, n_real : array of int
        Detected objects of each bin of measured magnitude, and those of them that have a match, [n_bins].
    """

    _table = ("faintest", "n_true", "n_found", "completeness", "n_detected", "n_real", "purity")

    edges: np.ndarray
    n_true: np.ndarray
    n_found: np.ndarray
    n_detected: np.ndarray
    n_real: np.ndarray

    @property
    def faintest(self) -> np.ndarray:
        """Faint edge of each bin [mag], shape [n_bins]."""
        return self.edges[1:]

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw completeness and purity against magnitude."""
        with styled():
            figure, axes = axes_at(ax, 5.6, 3.6)
            middle = 0.5 * (self.edges[1:] + self.edges[:-1])
            axes.plot(middle, self.completeness, "o-", color=BLUE, label="completeness, by true magnitude")
            axes.plot(middle, self.purity, "s-", color=ORANGE, label="purity, by measured magnitude")
            axes.set(xlabel="magnitude", ylabel="fraction", ylim=(0.0, 1.05))
            axes.legend(loc="lower left")
            return figure

    @property
    def completeness(self) -> np.ndarray:
        """Fraction of the true objects that were detected; NaN where there are none."""
        return _ratio_or_nan(self.n_found, self.n_true)

    @property
    def purity(self) -> np.ndarray:
        """Fraction of the detected objects that are true ones; NaN where there are none."""
        return _ratio_or_nan(self.n_real, self.n_detected)


@check_arguments
def detection_rates(
    magnitude: ArrayLike, match: ArrayLike, true_magnitude: ArrayLike, edges: ArrayLike
) -> DetectionRates:
    """Count matched objects in bins of magnitude.

    Parameters
    ----------
    magnitude : array
        Measured [mag], [n]; NaN belongs to no bin.
    match : array of int
        As of :func:`match_positions`, [n].
    true_magnitude : array
        [m].
    edges : array
        Rising edges of the bins [mag].

    Returns
    -------
    DetectionRates
        Counts, from which completeness and purity follow.

    Raises
    ------
    DomainError
        If shapes differ, edges do not rise, or a match is no true object.
    """
    measured = real_array(magnitude, "magnitude: expected real numbers [n]")
    true = real_array(true_magnitude, "true_magnitude: expected real numbers [m]")
    bins = real_array(edges, "edges: expected real numbers")
    index = np.asarray(match)
    if index.shape != measured.shape or measured.ndim != 1 or true.ndim != 1:
        raise DomainError(f"magnitude has shape {measured.shape} and match {index.shape}: expected [n] twice")
    if bins.ndim != 1 or len(bins) < 2 or not (np.diff(bins) > 0.0).all():
        raise DomainError("edges: expected at least two rising magnitudes")
    if index.size and (index.dtype.kind not in "iu" or index.max() >= len(true)):
        raise DomainError(f"match: expected integers below {len(true)}, the number of true objects")
    real = index >= 0
    counts = [np.histogram(v, bins)[0] for v in (true, true[index[real]], measured, measured[real])]
    return DetectionRates(bins, *counts)


def _ratio_or_nan(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    return np.where(denominator > 0, numerator / np.maximum(denominator, 1), np.nan)
