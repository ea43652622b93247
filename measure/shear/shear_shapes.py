"""Ellipticities of galaxies with their responses to shear, and the mean shear of many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.number_text import counted
from ...core.point_plots import draw_bars, draw_shapes
from ...core.result import Result, Values
from ...core.units import for_each, pure_numbers, real_array
from ..correlation import jackknife_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Patches of the jackknife where none are given: consecutive galaxies.
_PATCHES = 100


@dataclass(frozen=True, eq=False)
class ShearShapes(Result):
    """Ellipticities whose mean over galaxies is the shear times their mean response.

    Ellipticities and responses hold the weight of the selection, and the responses its change by shear: galaxies below
    the limit are zeros, and any sum over galaxies is one over the selected ones.

    Attributes
    ----------
    e1, e2 : ndarray, shape [n]
        Weight times ellipticity M1/(M0 + C), M2/(M0 + C), along x and along x = y. No (a - b)/(a + b): it has a
        meaning only over its response.
    r11, r12, r22 : ndarray, shape [n]
        Responses de1/dg1, the mean of de1/dg2 and de2/dg1, and de2/dg2, of the weight too.
    weight : ndarray, shape [n]
        Of the selection, 0 to 1.
    snr : ndarray, shape [n]
        M0 over its standard error.
    """

    _table = ("e1", "e2", "r11", "r12", "r22", "weight", "snr")

    e1: np.ndarray
    e2: np.ndarray
    r11: np.ndarray
    r12: np.ndarray
    r22: np.ndarray
    weight: np.ndarray
    snr: np.ndarray

    def __len__(self) -> int:
        return len(self.e1)

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the ellipticities in their plane, coloured by S/N."""
        return draw_shapes(ax, self.e1, self.e2, self.snr, "S/N of M0")

    def take(self, rows: Any) -> ShearShapes:
        """Return some of the galaxies: indices, a mask or a slice."""
        return ShearShapes(*(getattr(self, f.name)[rows] for f in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[ShearShapes]) -> ShearShapes:
        """Join shapes in order; none at all give an empty object."""
        return cls(*(np.concatenate([np.zeros(0), *(getattr(p, f.name) for p in parts)]) for f in fields(cls)))

    @property
    def sums(self) -> np.ndarray:
        """The columns e1, e2, r11, r12, r22 of which shears are made, [n, 5]."""
        return np.stack([self.e1, self.e2, self.r11, self.r12, self.r22], axis=1)


@dataclass(frozen=True, eq=False)
class MeanShear(Values):
    """Mean shear of galaxies.

    Attributes
    ----------
    g1, g2 : float
        Reduced shear along x and along x = y.
    g1_error, g2_error : float
        Standard errors of a jackknife over patches.
    response : ndarray, shape [2, 2]
        Mean response of the ellipticities.
    galaxies : float
        Sum of the weights.
    """

    g1: float
    g2: float
    g1_error: float
    g2_error: float
    response: np.ndarray
    galaxies: float

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw both components with their standard errors."""
        values, errors = np.array([self.g1, self.g2]), np.array([self.g1_error, self.g2_error])
        return draw_bars(ax, ["g1", "g2"], values, "shear", errors=errors)


@check_arguments
def mean_shear(shapes: ShearShapes, *, patch: ArrayLike | None = None) -> MeanShear:
    """Return the mean shear of galaxies, with errors of a jackknife.

    The sum of the ellipticities over the sum of the responses; each without the galaxies of a patch in turn.

    Parameters
    ----------
    shapes : ShearShapes
        Galaxies, of :meth:`~pachon.ShearEstimator.ellipticity_and_response` or :func:`~pachon.detect_shear`.
    patch : array of int, optional
        Patch of each galaxy, [n]: at least two. By default a hundred runs of consecutive galaxies.

    Raises
    ------
    DomainError
        If there are fewer than two galaxies or patches, or the response is not positive.
    """
    names, labels = np.unique(_patch_labels(len(shapes), patch), return_inverse=True)
    sums = patch_sums(shapes.sums, labels, len(names))
    shear, shear_without_patch = shear_of_sums(sums.sum(axis=0)), shear_of_sums(sums.sum(axis=0) - sums)
    if not np.isfinite(shear).all():
        raise DomainError("shapes: their mean response is not positive; expected more galaxies, or brighter ones")
    error = jackknife_error(shear_without_patch)
    mean = sums.sum(axis=0) / max(float(shapes.weight.sum()), np.finfo(float).tiny)
    response = np.array([[mean[2], mean[3]], [mean[3], mean[4]]])
    (g1, g2), (g1_error, g2_error) = shear.tolist(), error.tolist()
    return MeanShear(g1, g2, g1_error, g2_error, response, float(shapes.weight.sum()))


@dataclass(frozen=True)
class ShearBias(Values):
    """Bias of a shear from galaxies under it and under its opposite: (1 + m) g + c.

    Attributes
    ----------
    m, m_error : ndarray, shape [2]
        Multiplicative bias of both components, and its standard error.
    c, c_error : ndarray, shape [2]
        Additive bias of both components, and its standard error.
    """

    m: np.ndarray
    m_error: np.ndarray
    c: np.ndarray
    c_error: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw multiplicative and additive bias of both components with their standard errors."""
        values, errors = (1e3 * np.concatenate(v) for v in ((self.m, self.c), (self.m_error, self.c_error)))
        return draw_bars(ax, ["m of g1", "m of g2", "c of g1", "c of g2"], values, "bias [1e-3]", errors=errors)


@check_arguments
def shear_bias(
    plus: ShearShapes,
    minus: ShearShapes,
    shear1: ArrayLike,
    shear2: ArrayLike,
    *,
    patch: ArrayLike | None = None,
    minus_patch: ArrayLike | None = None,
) -> ShearBias:
    """Return the bias of the shear of galaxies under a shear and its opposite.

    Where both have the same noise and the same places, shapes and noise nearly cancel in m (Pujol et al. 2019), and
    with each galaxy rotated by 90 degrees beside it, in c.

    Parameters
    ----------
    plus, minus : ShearShapes
        Galaxies under the shear and under its opposite.
    shear1, shear2 : float or array
        The shear along x and along x = y, one for all or one of each patch, in the order of their labels. A patch
        gives the bias of the component along which its shear is.
    patch, minus_patch : array of int, optional
        Patch of each galaxy under the shear and under its opposite (by default the same), with the same labels. By
        default a hundred runs of consecutive galaxies.

    Returns
    -------
    ShearBias
        NaN for a component along which there is no shear.

    Raises
    ------
    DomainError
        If the number of galaxies differs without patches, or shears are not one for each patch.
    """
    if minus_patch is None and len(plus) != len(minus):
        raise DomainError(f"plus, minus: {len(plus)} and {len(minus)} galaxies, expected as many, or patches of both")
    labels = minus_labels = _patch_labels(len(plus), patch)
    if minus_patch is not None:
        minus_labels = _patch_labels(len(minus), minus_patch, "minus_patch")
    names = np.union1d(labels, minus_labels)
    count, labels, minus_labels = len(names), np.searchsorted(names, labels), np.searchsorted(names, minus_labels)
    plus_sums, minus_sums = patch_sums(plus.sums, labels, count), patch_sums(minus.sums, minus_labels, count)
    shears = [for_each(pure_numbers(g, name), count, name) for g, name in ((shear1, "shear1"), (shear2, "shear2"))]
    modulus = np.hypot(*shears)
    estimates = []
    for k, g in enumerate(shears):
        rows = np.abs(g) > 0.5 * modulus
        # Under a negative shear the other one of the pair is under the positive one.
        positive = (g > 0.0)[:, None]
        upper, lower = np.where(positive, plus_sums, minus_sums), np.where(positive, minus_sums, plus_sums)
        response, error = _pair_shears(upper[rows], lower[rows], k, -1.0, np.abs(g[rows]))
        estimates.append((response - 1.0, error, *_pair_shears(plus_sums, minus_sums, k, 1.0, np.ones(count))))
    m, m_error, c, c_error = np.array(estimates).T
    return ShearBias(m, m_error, c, c_error)


def _pair_shears(
    plus: np.ndarray, minus: np.ndarray, component: int, sign: float, unit: np.ndarray
) -> tuple[float, float]:
    """Return half the sum or difference of the shears of two sums by patch [p, 5], and its jackknife error.

    They are in units of `unit` of each patch [p], whose means count patches by their responses as the shears do.
    """
    if not len(plus):
        return float("nan"), float("nan")
    of_units = [side[:, 2 + 2 * component] * unit for side in (plus, minus)]

    def ratio(sums: Sequence[np.ndarray], unit_sums: Sequence[np.ndarray]) -> np.ndarray:
        first, second = (shear_of_sums(side)[..., component] for side in sums)
        with np.errstate(divide="ignore", invalid="ignore"):
            units = [of_side / side[..., 2 + 2 * component] for of_side, side in zip(unit_sums, sums, strict=True)]
            return np.asarray((first + sign * second) / (units[0] + units[1]))

    totals, unit_totals = [plus.sum(axis=0), minus.sum(axis=0)], [values.sum() for values in of_units]
    without_patch = ratio(
        [total - side for total, side in zip(totals, (plus, minus), strict=True)],
        [total - values for total, values in zip(unit_totals, of_units, strict=True)],
    )
    return float(ratio(totals, unit_totals)), float(jackknife_error(without_patch))


def shear_of_sums(sums: np.ndarray) -> np.ndarray:
    """Return the shear g1, g2 [..., 2] of sums of e1, e2, r11, r12, r22 [..., 5]; NaN without a positive response."""
    e1, e2, r11, r12, r22 = np.moveaxis(np.asarray(sums), -1, 0)
    determinant = r11 * r22 - r12**2
    determinant = np.where((determinant > 0.0) & (r11 > 0.0), determinant, np.nan)
    return np.stack([(r22 * e1 - r12 * e2) / determinant, (r11 * e2 - r12 * e1) / determinant], axis=-1)


def patch_sums(values: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """Return the sums of values [n, k] over patches numbered by labels [n], [count, k]."""
    return np.stack([np.bincount(labels, column, count) for column in values.T], axis=1)


def _patch_labels(count: int, patch: ArrayLike | None, name: str = "patch") -> np.ndarray:
    """Return the patch of each galaxy, [count]: runs of consecutive galaxies where none are given."""
    if patch is None:
        if count < 2:
            raise DomainError(f"shapes: {counted(count, 'galaxy', 'galaxies')}, expected at least two")
        return np.arange(count) * min(_PATCHES, count) // count
    labels = real_array(patch, f"{name}: expected the patch of each of {count} galaxies, a number")
    if labels.shape != (count,):
        raise DomainError(f"{name}: shape {labels.shape}, expected the patch of each of {count} galaxies")
    if len(np.unique(labels)) < 2:
        raise DomainError(f"{name}: {len(np.unique(labels))} different, expected at least two")
    return labels
