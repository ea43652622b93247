r"""Calibration of shears from ellipticities of galaxies in rings.

The ellipticity (a - b)/(a + b) of a galaxy with elliptical isophotes is sheared as a point of the unit disc,
(e + g)/(1 + g* e) (Seitz & Schneider 1997), so its mean over all orientations is the reduced shear g itself: the
responsivity is 1, and what a measurement makes of it is (1 + m) g + c. Over k evenly rotated galaxies, a ring, the mean
is g up to terms of order g^(k/2 - 1) e^(k/2): pairs at 90 degrees leave -g* e^2, four orientations already less than
1e-5 of g.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.point_plots import draw_bars
from ...core.result import Values
from ...core.units import real_array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class ShearCalibration(Values):
    """Measured shear as a function of the true one, (1 + m) g + c, of both components.

    Parameters
    ----------
    m, m_error : array
        Multiplicative bias of g1 and g2 and its standard error, [2].
    c, c_error : array
        Additive bias of g1 and g2 and its standard error, [2].
    n_rings : int
        Rings of galaxies used.
    """

    m: np.ndarray
    m_error: np.ndarray
    c: np.ndarray
    c_error: np.ndarray
    n_rings: int

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw multiplicative and additive bias of both components with their standard errors."""
        values, errors = (1e3 * np.concatenate(v) for v in ((self.m, self.c), (self.m_error, self.c_error)))
        return draw_bars(ax, ["m of g1", "m of g2", "c of g1", "c of g2"], values, "bias [1e-3]", errors=errors)


@check_arguments
def shear_calibration(e1: ArrayLike, e2: ArrayLike, shear1: ArrayLike, shear2: ArrayLike) -> ShearCalibration:
    """Fit straight lines to the mean ellipticities of rings of galaxies against their shear.

    Parameters
    ----------
    e1, e2 : array
        Measured ellipticities (a - b)/(a + b), [n, k]: n rings of k galaxies that are rotated evenly over 180 degrees
        before the shear. A ring with a NaN is left out.
    shear1, shear2 : array
        True reduced shear of each ring, [n], of at least two values.

    Returns
    -------
    ShearCalibration
        Biases, with errors from the scatter of the rings about the lines.

    Raises
    ------
    DomainError
        If shapes differ, fewer than three rings are left, or all of them have the same shear.
    """
    shapes = [real_array(e, f"{name}: expected real numbers [n, k]") for e, name in ((e1, "e1"), (e2, "e2"))]
    shears = [
        real_array(g, f"{name}: expected real numbers [n]") for g, name in ((shear1, "shear1"), (shear2, "shear2"))
    ]
    sizes = [a.shape for a in (*shapes, *shears)]
    if shapes[0].ndim != 2 or shapes[1].shape != shapes[0].shape or any(g.shape != sizes[0][:1] for g in shears):
        raise DomainError(f"e1, e2, shear1, shear2 have shapes {sizes}: expected [n, k] twice and [n] twice")
    complete = np.isfinite(np.concatenate(shapes, axis=1)).all(axis=1)
    count = int(complete.sum())
    if count < 3:
        raise DomainError(f"{count} of {len(complete)} rings are complete: expected at least 3")
    lines = []
    for e, g, name in zip(shapes, shears, ("shear1", "shear2"), strict=True):
        mean, true = e[complete].mean(axis=1), g[complete]
        if not np.ptp(true) > 0.0:
            raise DomainError(f"{name} = {true[0]:g} of all rings: expected at least two values")
        spread = ((true - true.mean()) ** 2).sum()
        slope = ((true - true.mean()) * mean).sum() / spread
        level = mean.mean() - slope * true.mean()
        scatter = ((mean - level - slope * true) ** 2).sum() / (count - 2)
        errors = scatter / spread, scatter * (1.0 / count + true.mean() ** 2 / spread)
        lines.append((slope - 1.0, np.sqrt(errors[0]), level, np.sqrt(errors[1])))
    m, m_error, c, c_error = np.array(lines).T
    return ShearCalibration(m, m_error, c, c_error, count)
