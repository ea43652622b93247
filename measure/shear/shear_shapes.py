"""Ellipticities of galaxies with their responses to shear, and the mean shear of many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.point_plots import draw_bars, draw_shapes
from ...core.result import Result, Values
from ...core.units import one_number
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
    labels = _patches(len(shapes), patch)
    sums = patch_sums(shapes.sums, labels)
    shear, shear_without_patch = shear_of_sums(sums.sum(axis=0)), shear_of_sums(sums.sum(axis=0) - sums)
    if not np.isfinite(shear).all():
        raise DomainError("shapes: their mean response is not positive; expected more galaxies, or brighter ones")
    error = jackknife_error(shear_without_patch)
    mean = sums.sum(axis=0) / max(float(shapes.weight.sum()), np.finfo(float).tiny)
    response = np.array([[mean[2], mean[3]], [mean[3], mean[4]]])
    return MeanShear(*map(float, (*shear, *error)), response, float(shapes.weight.sum()))


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
    shear: float,
    *,
    component: ArrayLike = 0,
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
    shear : float
        The shear.
    component : int or array of int
        0 where the shear is along x, 1 where it is along x = y: of all galaxies, or of each patch.
    patch, minus_patch : array of int, optional
        Patch of each galaxy under the shear and under its opposite (by default the same), with the same labels. By
        default a hundred runs of consecutive galaxies.

    Raises
    ------
    DomainError
        If a component has no galaxies, or the number of galaxies differs without patches.
    """
    if minus_patch is None and len(plus) != len(minus):
        raise DomainError(f"plus, minus: {len(plus)} and {len(minus)} galaxies, expected as many, or patches of both")
    shear = one_number(shear, "shear")
    labels = _patches(len(plus), patch)
    minus_labels = labels if minus_patch is None else _patches(len(minus), minus_patch)
    names = np.union1d(labels, minus_labels)
    sums = [
        patch_sums(shapes.sums, np.searchsorted(names, rows), len(names))
        for shapes, rows in ((plus, labels), (minus, minus_labels))
    ]
    along = np.broadcast_to(np.asarray(component, dtype=np.int64), (len(names),))
    estimates = []
    for k in range(2):
        slope_rows = along == k
        difference = _pair_shears(sums[0][slope_rows], sums[1][slope_rows], k, -1.0)
        level = _pair_shears(*sums, k, 1.0)
        estimates.append((difference[0] / shear - 1.0, difference[1] / abs(shear), *level))
    m, m_error, c, c_error = np.array(estimates).T
    return ShearBias(m, m_error, c, c_error)


def _pair_shears(plus: np.ndarray, minus: np.ndarray, component: int, sign: float) -> tuple[float, float]:
    """Return half the sum or difference of the shears of two sums by patch [p, 5], and its jackknife error."""
    if not len(plus):
        return float("nan"), float("nan")
    half = [
        0.5 * (shear_of_sums(a)[..., component] + sign * shear_of_sums(b)[..., component])
        for a, b in (
            (plus.sum(axis=0), minus.sum(axis=0)),
            (plus.sum(axis=0) - plus, minus.sum(axis=0) - minus),
        )
    ]
    return float(half[0]), float(jackknife_error(half[1]))


def shear_of_sums(sums: np.ndarray) -> np.ndarray:
    """Return the shear g1, g2 [..., 2] of sums of e1, e2, r11, r12, r22 [..., 5]; NaN without a positive response."""
    e1, e2, r11, r12, r22 = np.moveaxis(np.asarray(sums), -1, 0)
    determinant = r11 * r22 - r12**2
    determinant = np.where((determinant > 0.0) & (r11 > 0.0), determinant, np.nan)
    return np.stack([(r22 * e1 - r12 * e2) / determinant, (r11 * e2 - r12 * e1) / determinant], axis=-1)


def patch_sums(values: np.ndarray, labels: np.ndarray, count: int | None = None) -> np.ndarray:
    """Return the sums of values [n, k] over patches numbered by labels [n], [patches, k]."""
    count = int(labels.max()) + 1 if count is None else count
    return np.stack([np.bincount(labels, column, count) for column in values.T], axis=1)


def _patches(count: int, patch: ArrayLike | None) -> np.ndarray:
    """Return the numbers of the patches of galaxies, from 0 without gaps where they are not given."""
    if patch is None:
        if count < 2:
            raise DomainError(f"shapes: {count} galaxies, expected at least two")
        return np.arange(count) * min(_PATCHES, count) // count
    labels = np.asarray(patch)
    if labels.shape != (count,) or labels.dtype.kind not in "iuf":
        raise DomainError(f"patch: shape {labels.shape}, expected the patch of each of {count} galaxies")
    names, numbers = np.unique(labels, return_inverse=True)
    if len(names) < 2:
        raise DomainError(f"patch: {len(names)} different, expected at least two")
    return numbers
