"""Polynomials of two coordinates, and Zernike polynomials, as shapes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import PrescriptionError
from .polar_polynomial import PolarPolynomial, from_monomials, from_zernikes
from .shape import Pair, Shape, Triple, check_coefficients, with_coefficient


class _Polynomial(Shape):
    """Base of shapes that are a polynomial of x and y."""

    @property
    @abstractmethod
    def polynomial(self) -> PolarPolynomial:
        """The sag as a polynomial."""

    @property
    def curvature(self) -> float:
        terms = self.polynomial.terms
        return 2.0 * float(terms[0, 1].real) if terms.shape[1] > 1 else 0.0

    @property
    def fourth_order(self) -> float:
        terms = self.polynomial.terms
        return (float(terms[0, 2].real) if terms.shape[1] > 2 else 0.0) - self.curvature**3 / 8

    def _sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self.polynomial.value(x, y)

    def _gradient(self, x: np.ndarray, y: np.ndarray) -> Pair:
        return self.polynomial.gradient(x, y)

    def _hessian(self, x: np.ndarray, y: np.ndarray) -> Triple:
        return self.polynomial.hessian(x, y)


@check_arguments
@dataclass(frozen=True)
class XYPolynomial(_Polynomial):
    """Sum of ``a x^i y^j`` over terms (i, j, a), with a in m^(1 - i - j), each pair of powers once."""

    terms: tuple[tuple[int, int, float], ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "terms", tuple((int(i), int(j), float(a)) for i, j, a in self.terms))
        powers = [(i, j) for i, j, _ in self.terms]
        for i, j, a in self.terms:
            if i < 0 or j < 0 or not np.isfinite(a):
                raise PrescriptionError(f"xy term ({i}, {j}, {a!r}): expected powers from 0 and a finite coefficient")
            if powers.count((i, j)) > 1:
                raise PrescriptionError(f"xy term ({i}, {j}) occurs more than once: expected each power once")

    @cached_property
    def polynomial(self) -> PolarPolynomial:
        """The polynomial."""
        return from_monomials(self.terms)

    @property
    def parameters(self) -> dict[str, float]:  # noqa: D102
        return {f"x{i}y{j}": a for i, j, a in self.terms}

    def _derivative(self, name: str, x: np.ndarray, y: np.ndarray) -> Triple:
        i, j = (int(v) for v in name[1:].split("y"))
        zero = np.zeros_like(x)
        fx = i * x ** (i - 1) * y**j if i else zero
        fy = j * x**i * y ** (j - 1) if j else zero
        return x**i * y**j, fx, fy

    def _changed(self, name: str, value: float) -> Shape:
        return XYPolynomial(tuple((i, j, value if name == f"x{i}y{j}" else a) for i, j, a in self.terms))


@check_arguments
@dataclass(frozen=True)
class ZernikeSag(_Polynomial):
    """Sum of Zernike polynomials, orthonormal over the annulus between two radii, Noll order.

    Parameters
    ----------
    coefficients : tuple of float
        Coefficients of j = 1, 2, ... [m]; each is the rms of its term over the annulus.
    outer_radius, inner_radius : float
        Rims of the annulus [m].
    """

    coefficients: tuple[float, ...]
    outer_radius: float
    inner_radius: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", tuple(float(a) for a in self.coefficients))
        check_coefficients(self.coefficients)
        if not self.coefficients:
            raise PrescriptionError("zernikes = []: expected at least one coefficient")
        inner, outer = self.inner_radius, self.outer_radius
        if not 0 <= inner < outer < np.inf:
            raise PrescriptionError(f"zernike radii = [{inner!r}, {outer!r}] m: expected 0 <= inner < outer")

    @cached_property
    def polynomial(self) -> PolarPolynomial:
        """The polynomial."""
        return from_zernikes(self.coefficients, self.outer_radius, self.inner_radius)

    @property
    def parameters(self) -> dict[str, float]:  # noqa: D102
        return {f"Z{j}": a for j, a in enumerate(self.coefficients, start=1)}

    def with_parameters(self, values: Mapping[str, float]) -> Shape:  # noqa: D102
        coefficients = list(self.coefficients)
        for name, value in values.items():
            self._check_parameter(name)
            coefficients[int(name[1:]) - 1] = value
        return replace(self, coefficients=tuple(coefficients))

    def _derivative(self, name: str, x: np.ndarray, y: np.ndarray) -> Triple:
        unit_coefficients = (0.0,) * (int(name[1:]) - 1) + (1.0,)
        polynomial = from_zernikes(unit_coefficients, self.outer_radius, self.inner_radius)
        return polynomial.value(x, y), *polynomial.gradient(x, y)

    def _changed(self, name: str, value: float) -> Shape:
        return replace(self, coefficients=with_coefficient(self.coefficients, int(name[1:]) - 1, value))
