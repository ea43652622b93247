"""Interpolants of Piff: the parameters of a PSF as functions of its place and of properties of a star."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev, hermite, laguerre, legendre, polynomial

from ...core.errors import shown
from .tables import PiffTables

#: Functions of ``poly_type``.
_KINDS: dict[str, Callable[..., np.ndarray]] = {
    "poly": polynomial.polyvander2d,
    "chebyshev": chebyshev.chebvander2d,
    "legendre": legendre.legvander2d,
    "laguerre": laguerre.lagvander2d,
    "hermite": hermite.hermvander2d,
}
#: Highest power of a property.
_MOST_ORDER = 20
#: Most properties.
_MOST_KEYS = 4


@dataclass(frozen=True, eq=False)
class Interpolant:
    """Sums of basis functions, coefficients [n_parameter, n_function]."""

    keys: tuple[str, ...]  #: properties that the functions depend on
    coefficients: np.ndarray
    functions: Callable[[np.ndarray], np.ndarray]  #: from properties [n, n_key] to values [n, n_function]

    def parameters(self, properties: np.ndarray) -> np.ndarray:
        """Return parameters [n, n_parameter] at properties [n, n_key]."""
        values: np.ndarray = self.functions(properties) @ self.coefficients.T
        return values


def read_interpolant(tables: PiffTables) -> Interpolant:
    """Read the interpolant of a model; ProductError names one that is unknown."""
    settings = tables.settings("interp")
    kind = settings.get("type")
    readers = {"BasisPolynomial": _basis_polynomial, "Polynomial": _polynomial, "Mean": _mean}
    if kind not in readers:
        raise tables.error(f"interp = {kind}: expected one of {', '.join(readers)}")
    return readers[str(kind)](tables)


def _mean(tables: PiffTables) -> Interpolant:
    mean = tables.column("interp_solution", "mean")
    return Interpolant((), mean[:, None], lambda p: np.ones((len(p), 1)))


def _basis_polynomial(tables: PiffTables) -> Interpolant:
    """Return products of powers of the keys, those up to a total order."""
    settings = tables.settings("interp")
    keys = tuple(settings.get("keys", ["u", "v"]))
    order = settings.get("order")
    key_orders = order if isinstance(order, list) else [order] * len(keys)
    if not 0 < len(keys) == len(key_orders) <= _MOST_KEYS:
        raise tables.error(f"interp keys = {shown(keys)}, order = {shown(order)}: expected an order of each key")
    orders = [tables.whole("interp", "order", value, 0, _MOST_ORDER) for value in key_orders]
    total_order = tables.whole("interp", "max_order", settings.get("max_order", max(orders)), 0, _MOST_ORDER)
    exponents = np.stack(np.meshgrid(*(np.arange(n + 1) for n in orders), indexing="ij"), axis=-1).reshape(
        -1, len(keys)
    )
    exponents = exponents[exponents.sum(axis=1) <= total_order]

    def products(properties: np.ndarray) -> np.ndarray:
        return np.prod(properties[:, None, :] ** exponents, axis=2)

    return _checked(tables, Interpolant(keys, tables.column("interp_solution", "q")[0], products), len(exponents))


def _polynomial(tables: PiffTables) -> Interpolant:
    """Return polynomials of u and v, one for each parameter, whose coefficients stand in rows."""
    kind = tables.settings("interp").get("poly_type", "poly")
    if kind not in _KINDS:
        raise tables.error(f"interp poly_type = {kind}: expected one of {', '.join(_KINDS)}")
    rows = [tables.column("interp_solution", name) for name in ("PARAM", "U_EXPONENT", "V_EXPONENT", "COEFF")]
    parameter, i, j = (values.astype(int) for values in rows[:3])
    order = tables.whole("interp", "exponent", int(max(i.max(initial=0), j.max(initial=0))), 0, _MOST_ORDER)
    count = tables.whole("interp", "PARAM", int(parameter.max(initial=0)), 0, len(parameter)) + 1
    if min(parameter.min(initial=0), i.min(initial=0), j.min(initial=0)) < 0:
        raise tables.error("interp solution: expected parameters and exponents from 0")
    table = np.zeros((count, order + 1, order + 1))
    table[parameter, i, j] = rows[3]

    def functions(properties: np.ndarray) -> np.ndarray:
        return _KINDS[kind](properties[:, 0], properties[:, 1], [order, order])

    return Interpolant(("u", "v"), table.reshape(len(table), -1), functions)


def _checked(tables: PiffTables, interpolant: Interpolant, terms: int) -> Interpolant:
    """Return an interpolant whose number of coefficients is that of its functions, or raise ProductError."""
    shape = interpolant.coefficients.shape
    if len(shape) != 2 or shape[1] != terms:
        raise tables.error(f"interp solution of shape {shape}: expected {terms} coefficients of each parameter")
    return interpolant
