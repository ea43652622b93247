r"""Rho statistics: the effect of the errors of a PSF model on the correlation of galaxy shapes.

With e and T the ellipticity and the size of the true PSF (of the stars, or of a PSF known without noise), and with
``de = e - e_model`` and ``dT = T - T_model``, averaged over pairs at a separation theta:

.. math::

    \rho_1 &= \langle \delta e^* \, \delta e \rangle, \\
    \rho_2 &= \langle e^* \, \delta e \rangle, \\
    \rho_3 &= \langle (e^* \delta T/T) (e \, \delta T/T) \rangle, \\
    \rho_4 &= \langle \delta e^* (e \, \delta T/T) \rangle, \\
    \rho_5 &= \langle e^* (e \, \delta T/T) \rangle .

The first two are of Rowe (2010, MNRAS 404, 350), whose second one is the sum of both orders and so twice ours; all five
as Jarvis et al. (2016, MNRAS 460, 2245, sec. 3.4) write them. The statistics are of whatever e and T they are given.
Theirs are of moments under an elliptical weight that adapts to the image, e = (a - b)/(a + b) and T = Q11 + Q22: those
of :func:`~pachon.adaptive_moments`, its g1, g2 and sigma in place of e1, e2 and size. Of
:func:`~pachon.measure_shapes`, under a round weight of 0.7", e and dT/T of PSFs of 0.56" are about half as large, so
that rho1 and rho2 are about a quarter (1/3.86), rho4 and rho5 an eighth, rho3 a seventeenth
(docs/explanation/conventions.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.docstrings import Description
from ..core.errors import DomainError
from ..core.plotting import BLUE, GREY, ORANGE, PURPLE, RED, axes_at, styled
from ..core.result import Result
from ..core.units import real_array
from .correlation import Correlation, SeparationBins, draw_correlation_axes, shear_correlation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Largest ratio of the sizes of a star and its model.
_MOST_TIMES = 30.0


@dataclass(frozen=True)
class RhoStatistics(Result):
    """The five rho statistics, each as xi+ and xi- of a correlation; the statistic proper is xi+.

    Parameters
    ----------
    rho1, rho2, rho3, rho4, rho5 : Correlation
        As in the module docstring, all of the same stars in the same bins.
    """

    _table = ("r_arcmin", "rho1", "rho2", "rho3", "rho4", "rho5")

    rho1: Correlation
    rho2: Correlation
    rho3: Correlation
    rho4: Correlation
    rho5: Correlation

    @property
    def r_arcmin(self) -> np.ndarray:
        """Separation [arcmin], shape [n_bins]."""
        return self.rho1.r_arcmin

    def _columns(self) -> dict[str, Any]:
        pairs = {name: np.stack([rho.xi_plus, rho.error_plus], axis=1) for name, rho in self.items()}
        return {"r_arcmin": self.r_arcmin, **pairs}

    def _described(self, name: str) -> Description:
        base_description = super()._described(name)
        return base_description if name == "r_arcmin" else Description("", f"xi+ of {name}, and its standard error")

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the five statistics with their errors against separation."""
        with styled():
            figure, axes = axes_at(ax, 6.0, 4.2)
            for (name, rho), color in zip(self.items(), (GREY, BLUE, RED, ORANGE, PURPLE), strict=True):
                axes.errorbar(
                    rho.r_arcmin, rho.xi_plus, rho.error_plus, fmt="o-", color=color, markersize=3, label=name
                )
            draw_correlation_axes(axes)
            return figure

    def items(self) -> Iterator[tuple[str, Correlation]]:
        """Return the name of each statistic with its correlation, in order."""
        return iter((f"rho{k}", getattr(self, f"rho{k}")) for k in range(1, 6))


@check_arguments
def rho_statistics(
    x: ArrayLike,
    y: ArrayLike,
    e1: ArrayLike,
    e2: ArrayLike,
    size: ArrayLike,
    model_e1: ArrayLike,
    model_e2: ArrayLike,
    model_size: ArrayLike,
    *,
    bins: SeparationBins,
    patch: Any = None,
) -> RhoStatistics:
    """Compute the rho statistics 1 to 5 of a PSF model (Rowe 2010; Jarvis et al. 2016, sec. 3.4).

    Residuals at the fitted stars underestimate the error of the model; leave-one-out and holdout residuals do not.

    Parameters
    ----------
    x, y : array or Quantity
        Positions [rad], the axes to which ellipticities refer, as in
        :func:`~pachon.measure.correlation.shear_correlation`.
    e1, e2 : array
        Ellipticity (a - b)/(a + b) of the stars, or of the truth: g1, g2 of :class:`~.AdaptiveMoments` for the
        statistics of Jarvis et al., or e1, e2 of :class:`~.Shapes`.
    size : array
        Their size (Q11 Q22 - Q12^2)^(1/4), sigma or size of the same class, in any unit.
    model_e1, model_e2, model_size : array
        The same of the model at these positions. A star with NaN in any column is left out of all five.
    bins, patch
        As in :func:`~.shear_correlation`; with patches the errors are jackknife errors.

    Raises
    ------
    DomainError
        If shapes differ, a size is not positive, an ellipticity is not below 1, sizes of star and model differ by more
        than thirty times, or what :func:`~pachon.measure.correlation.shear_correlation` raises it for.
    """
    names = ("e1", "e2", "size", "model_e1", "model_e2", "model_size")
    expectation = f"{', '.join(names)}: expected arrays of real numbers"
    columns = [real_array(v, expectation) for v in (e1, e2, size, model_e1, model_e2, model_size)]
    if any(c.shape != columns[0].shape for c in columns):
        raise DomainError(f"{', '.join(names)} have shapes {[c.shape for c in columns]}: expected [n] six times")
    for name, values in (("size", columns[2]), ("model_size", columns[5])):
        if np.any(values <= 0.0):
            raise DomainError(f"{name}: expected positive sizes, the least is {np.nanmin(values):g}")
    # One NaN in one of them takes the star out of all: every statistic is of the same stars.
    good = np.all(np.isfinite(columns), axis=0)
    s1, s2, s, m1, m2, m = (np.where(good, c, np.nan) for c in columns)
    for name, pair in (("e1, e2", (s1, s2)), ("model_e1, model_e2", (m1, m2))):
        largest = np.hypot(*pair)[good].max(initial=0.0)
        if not largest < 1.0:
            raise DomainError(f"{name}: expected ellipticities below 1, the largest is {largest:g}")
    ratio = np.exp(np.abs(np.log(s / m)[good]).max(initial=0.0))
    if ratio > _MOST_TIMES:
        raise DomainError(f"size, model_size: expected a ratio of at most {_MOST_TIMES:g}, the largest is {ratio:g}")
    trace, model_trace = trace_of_moments(s, s1, s2), trace_of_moments(m, m1, m2)
    growth = (trace - model_trace) / trace
    e, de, w = (s1, s2), (s1 - m1, s2 - m2), (s1 * growth, s2 * growth)

    def correlate(f: tuple[np.ndarray, np.ndarray], g: tuple[np.ndarray, np.ndarray] | None = None) -> Correlation:
        return shear_correlation(x, y, *f, bins=bins, other=g, patch=patch)

    return RhoStatistics(correlate(de), correlate(e, de), correlate(w), correlate(de, w), correlate(e, w))


def trace_of_moments(size: ArrayLike, e1: ArrayLike, e2: ArrayLike) -> np.ndarray:
    """Return T = Q11 + Q22 = a^2 + b^2 of (Q11 Q22 - Q12^2)^(1/4) = sqrt(a b) and e = (a - b)/(a + b), |e| < 1.

    T = 2 size^2 (1 + |e|^2)/(1 - |e|^2), in the square of the unit of `size`.
    """
    square = np.asarray(e1, dtype=np.float64) ** 2 + np.asarray(e2, dtype=np.float64) ** 2
    return np.asarray(2.0 * np.asarray(size, dtype=np.float64) ** 2 * (1.0 + square) / (1.0 - square))
