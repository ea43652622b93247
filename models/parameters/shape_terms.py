"""Terms of the shape of a surface by name: added where absent, and as polynomials where they are."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ...core.errors import DomainError, unknown_name
from ..aperture import Annulus, Circle
from ..shapes.polar_polynomial import PolarPolynomial, from_even_powers, from_monomials, from_zernikes
from ..shapes.polynomial import XYPolynomial, ZernikeSag
from ..shapes.shape import EvenAsphere, Rotational, Shape
from ..shapes.sum import Sum
from ..surface import Surface


def shape_with_term(surface: Surface, name: str) -> Shape:
    """Return the shape of a surface with a term such as "radius", "conic", "a6" or "Z5", which is zero if it is new.

    A Zernike term extends the Zernike sag of the surface; without one, it is added over the rims of the aperture, which
    must be round. Even powers are added to a conic of revolution or a plane, such as the front of a Schmidt plate, also
    below polynomials.
    """
    shape = surface.shape
    if name in shape.parameters:
        return shape
    zernike = re.fullmatch(r"Z([1-9]\d{0,2})", name)
    parts = shape.parts if isinstance(shape, Sum) else (shape,)
    if zernike:
        noll_index = int(zernike[1])
        for i, component in enumerate(parts):
            if isinstance(component, ZernikeSag):
                zeros = (0.0,) * (noll_index - len(component.coefficients))
                longer = replace(component, coefficients=component.coefficients + zeros)
                return _sum((*parts[:i], longer, *parts[i + 1 :]))
        return _sum((*parts, ZernikeSag((0.0,) * noll_index, *_rims(surface))))
    power = re.fullmatch(r"a([468]|[1-9]\d)", name)
    if power and int(power[1]) % 2 == 0:
        count = int(power[1]) // 2 - 1
        for i, component in enumerate(parts):
            if isinstance(component, Rotational):
                terms = component.coefficients + (0.0,) * (count - len(component.coefficients))
                asphere = EvenAsphere(component.radius, component.conic, terms)
                return _sum((*parts[:i], asphere, *parts[i + 1 :]))
        if all(isinstance(component, XYPolynomial | ZernikeSag) for component in parts):
            return _sum((EvenAsphere(np.inf, 0.0, (0.0,) * count), *parts))
    raise unknown_name(f"shape term of {surface.name}", name, [*shape.parameters, "Z4"])


def term_polynomial(shape: Shape, name: str) -> PolarPolynomial | None:
    """Return the change of sag [m] per unit of a term, if it is a polynomial of x and y; else None."""
    if isinstance(shape, Sum):
        component, inner = shape.place(name)
        return term_polynomial(component, inner)
    if isinstance(shape, ZernikeSag):
        return _zernike_term(int(name[1:]), shape.outer_radius, shape.inner_radius)
    if isinstance(shape, XYPolynomial):
        i, j = (int(power) for power in name[1:].split("y"))
        return from_monomials([(i, j, 1.0)])
    if isinstance(shape, Rotational) and name.startswith("a"):
        return from_even_powers((1.0,), int(name[1:]))
    return None


@lru_cache(maxsize=1024)
def _zernike_term(j: int, outer_radius: float, inner_radius: float) -> PolarPolynomial:
    return from_zernikes((0.0,) * (j - 1) + (1.0,), outer_radius, inner_radius)


def term_unit(shape: Shape, name: str) -> str:
    """Return the unit of a term; empty for a pure number."""
    if isinstance(shape, Sum):
        component, inner = shape.place(name)
        return term_unit(component, inner)
    powers = [int(n) for n in re.findall(r"\d+", name)] if re.fullmatch(r"[ay]\d+|x\d+y\d+", name) else []
    if powers:
        return {0: "", 1: "m"}.get(1 - sum(powers), f"m^{1 - sum(powers)}")
    return {"conic": "", "curvature": "1/m"}.get(name.partition("_")[0], "m")


def _sum(parts: tuple[Shape, ...]) -> Shape:
    return parts[0] if len(parts) == 1 else Sum(parts)


def _rims(surface: Surface) -> tuple[float, float]:
    """Return outer and inner radius [m] of the clear region, about the vertex."""
    aperture = surface.aperture
    if isinstance(aperture, Circle):
        return aperture.radius + float(np.hypot(aperture.x, aperture.y)), 0.0
    if isinstance(aperture, Annulus) and not (aperture.x or aperture.y):
        return aperture.outer, aperture.inner
    raise DomainError(
        f"surface {surface.name}: expected a round aperture, or a Zernike sag, for the rims of a Zernike term"
    )


def with_changes(shape: Shape, changes: Sequence[tuple[str, float]]) -> Shape:
    """Return a shape with changes of parameters, by name."""
    new_values = {}
    before = shape.parameters
    for name, change in changes:
        if name.endswith(("radius", "curvature")):
            # Two names of one parameter: one change follows the other.
            shape = shape.with_parameter(name, shape.parameters[name] + change)
        else:
            new_values[name] = before[name] + change
    return shape.with_parameters(new_values) if new_values else shape
