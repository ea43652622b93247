"""Dispersion formulas of glass makers and handbooks, by name.

With ``w`` the wavelength in micrometres, ``x = w^2`` and coefficients ``a, b, c...`` in the order of a list:

=============== =====================================================================================================
schott          n^2 = a + b x + c x^-1 + d x^-2 + e x^-3 + f x^-4 (also: sumita)
extended        n^2 = a + b x + c x^-1 + d x^-2 + e x^-3 + f x^-4 + g x^-5 + h x^-6
extended_2      n^2 = a + b x + c x^-1 + d x^-2 + e x^-3 + f x^-4 + g x^2 + h x^3
extended_3      n^2 = a + b x + c x^2 + d x^-1 + e x^-2 + f x^-3 + g x^-4 + h x^-5 + i x^-6
sellmeier_2     n^2 = 1 + a + b x / (x - c^2) + d / (x - e^2)
sellmeier_4     n^2 = a + b x / (x - c) + d x / (x - e)
handbook_1      n^2 = a + b / (x - c) - d x
handbook_2      n^2 = a + b x / (x - c) - d x
herzberger      n = a + b L + c L^2 + d x + e x^2 + f x^3, L = 1 / (x - 0.028)
conrady         n = a + b / w + c / w^3.5
cauchy          n = a + b x^-1 + c x^-2 + d x^-3
buchdahl        n = a + b u + c u^2, u = (w - d) / (1 + 2.5 (w - d))
=============== =====================================================================================================

These are the formulas of the Zemax glass catalogue format (OpticStudio user guide, "The glass catalog"; its Sellmeier
1, 3 and 5 are :class:`~pachon.models.media.medium.Sellmeier` of three, four and five terms), Cauchy's and Buchdahl's
(1954, Optical Aberration Coefficients) of second order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import PrescriptionError
from .medium import (
    LINE_C,
    LINE_D,
    LINE_F,
    LINE_G,
    ConstantIndex,
    Medium,
    check_wavelength_range,
    medium_label,
    real_index,
    wavelengths_within,
)


@dataclass(frozen=True)
class _Formula:
    """Number of coefficients, whether the value is the square of the index, and the formula of ``x``."""

    size: int
    square: bool
    value: Callable[[np.ndarray, Sequence[float]], np.ndarray]


def _powers(*exponents: float) -> Callable[[np.ndarray, Sequence[float]], np.ndarray]:
    def series(x: np.ndarray, a: Sequence[float]) -> np.ndarray:
        return sum((k * x**p for k, p in zip(a, exponents, strict=True)), np.zeros_like(x))

    return series


def _herzberger(x: np.ndarray, a: Sequence[float]) -> np.ndarray:
    pole = 1.0 / (x - 0.028)
    return a[0] + a[1] * pole + a[2] * pole**2 + a[3] * x + a[4] * x**2 + a[5] * x**3


def _buchdahl(x: np.ndarray, a: Sequence[float]) -> np.ndarray:
    shift = np.sqrt(x) - a[3]
    u = shift / (1.0 + 2.5 * shift)
    return a[0] + a[1] * u + a[2] * u**2


FORMULAS = {
    "schott": _Formula(6, True, _powers(0, 1, -1, -2, -3, -4)),
    "sumita": _Formula(6, True, _powers(0, 1, -1, -2, -3, -4)),
    "extended": _Formula(8, True, _powers(0, 1, -1, -2, -3, -4, -5, -6)),
    "extended_2": _Formula(8, True, _powers(0, 1, -1, -2, -3, -4, 2, 3)),
    "extended_3": _Formula(9, True, _powers(0, 1, 2, -1, -2, -3, -4, -5, -6)),
    "sellmeier_2": _Formula(5, True, lambda x, a: 1.0 + a[0] + a[1] * x / (x - a[2] ** 2) + a[3] / (x - a[4] ** 2)),
    "sellmeier_4": _Formula(5, True, lambda x, a: a[0] + a[1] * x / (x - a[2]) + a[3] * x / (x - a[4])),
    "handbook_1": _Formula(4, True, lambda x, a: a[0] + a[1] / (x - a[2]) - a[3] * x),
    "handbook_2": _Formula(4, True, lambda x, a: a[0] + a[1] * x / (x - a[2]) - a[3] * x),
    "herzberger": _Formula(6, False, _herzberger),
    "conrady": _Formula(3, False, _powers(0, -0.5, -1.75)),
    "cauchy": _Formula(4, False, _powers(0, -1, -2, -3)),
    "buchdahl": _Formula(4, False, _buchdahl),
}


@check_arguments
@dataclass(frozen=True)
class Dispersion(Medium):
    """Medium whose index follows a named dispersion formula.

    Parameters
    ----------
    formula : str
        Name of the formula, one of the table at the top of this module.
    coefficients : tuple of float
        Its coefficients, wavelengths in micrometres; those left out at the end are zero.
    wavelength_range : tuple of float, shape (2,)
        Shortest and longest wavelength [m] of validity.
    name : str
        Name for messages and files; not part of equality.
    """

    formula: str
    coefficients: tuple[float, ...]
    wavelength_range: tuple[float, float]
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if self.formula not in FORMULAS:
            raise PrescriptionError(f"formula = {self.formula!r}: expected one of {', '.join(FORMULAS)}")
        size = FORMULAS[self.formula].size
        if not (0 < len(self.coefficients) <= size and np.all(np.isfinite(self.coefficients))):
            raise PrescriptionError(
                f"coefficients = {self.coefficients!r}: expected 1 to {size} finite numbers for {self.formula}"
            )
        check_wavelength_range(self.wavelength_range)

    def index(self, wavelength: ArrayLike) -> np.ndarray:  # noqa: D102
        w = wavelengths_within(wavelength, self.wavelength_range, medium_label(self.name, "glass"))
        formula = FORMULAS[self.formula]
        padded = (*self.coefficients, *[0.0] * (formula.size - len(self.coefficients)))
        with np.errstate(all="ignore"):
            value = np.asarray(formula.value((w * 1e6) ** 2, padded))
            return real_index(value, w, squared=formula.square)


#: Coefficient of w^2 [um^-2] in Schott's formula, about the mean of common glasses: their infrared absorption.
INFRARED_TERM = -0.0128
#: Index below which a model glass is a gas: no glass or liquid has less.
_LEAST_SOLID = 1.2
#: Wavelengths [m] of the formula of gases, which have no strong absorption near the visible.
GAS_RANGE = (0.15e-6, 20e-6)


@check_arguments
def model_glass(nd: float, vd: float, partial_dispersion: float = 0.0) -> Dispersion | ConstantIndex:
    """Return a glass of given index and dispersion at the d line.

    Schott's formula with a typical infrared term and the three others (in 1, w^-2, w^-4) from three conditions:
    ``n_d``, ``n_F - n_C = (n_d - 1) / V_d`` and ``n_g - n_F = P_gF (n_F - n_C)``, with ``P_gF`` on Schott's normal
    line ``0.6438 - 0.001682 V_d`` (Schott, technical information TIE-29) plus its deviation. This is an
    approximation, and not the unpublished one of Zemax: against eight catalogue glasses of common kinds it is good to
    5e-4 at 0.40 um, 4e-6 at 0.55 um, 3e-4 at 0.71 um, 8e-4 at 1 um and 2e-3 at 1.55 um.

    Below an index of 1.2, of gases, which may be below 1 where it is relative to air, there is no absorption near the
    visible: ``n = a + c / w^3.5`` (Conrady's formula without its middle term) of ``n_d`` and ``n_F - n_C``.

    Parameters
    ----------
    nd : float
        Index at the d line, 587.5618 nm; positive.
    vd : float
        Abbe number; positive. Zero stands for a glass without dispersion.
    partial_dispersion : float
        Deviation of ``P_gF`` from the normal line.

    Raises
    ------
    PrescriptionError
        If the numbers are not those of a glass.
    """
    wrong = PrescriptionError(f"nd, vd, dPgF = {nd!r}, {vd!r}, {partial_dispersion!r}: expected the numbers of a glass")
    if not (0 < nd < 10 and 0 <= vd < 1e4 and abs(partial_dispersion) < 1):
        raise wrong
    if vd == 0:
        return ConstantIndex(nd)
    spread = (nd - 1.0) / vd
    if nd < _LEAST_SOLID:
        c = spread / (LINE_F**-3.5 - LINE_C**-3.5)
        return Dispersion("conrady", (nd - c * LINE_D**-3.5, 0.0, c), GAS_RANGE)
    target = np.array([nd, spread, (0.6438 - 0.001682 * vd + partial_dispersion) * spread])
    w = np.array([LINE_D, LINE_F, LINE_C, LINE_G])
    terms = np.stack([np.ones(4), w**-2, w**-4], axis=1)
    conditions = np.array([[1.0, 0, 0, 0], [0, 1, -1, 0], [0, -1, 0, 1]])
    solution = np.array([nd**2, 0.01, 0.0])
    # Newton's method in the square of the index; eight steps leave rounding.
    for _ in range(8):
        square = terms @ solution + INFRARED_TERM * w**2
        if not np.all(square > 0):
            raise wrong
        n = np.sqrt(square)
        solution = solution - np.linalg.solve(conditions @ (terms / (2 * n[:, None])), conditions @ n - target)
    if not np.all(np.isfinite(solution)):
        raise wrong
    a, c, d = (float(v) for v in solution)
    return Dispersion("schott", (a, INFRARED_TERM, c, d), (0.32e-6, 2.4e-6))
