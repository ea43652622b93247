"""Figures of a surface by name: made where they are not there yet, and as polynomials where they are polynomials."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ...core.errors import DomainError, unknown_name
from ...models.aperture import Annulus, Circle
from ...models.shapes.freeform import XYPolynomial, ZernikeSag
from ...models.shapes.polar_polynomial import PolarPolynomial, from_even_powers, from_monomials, from_zernikes
from ...models.shapes.shape import EvenAsphere, Rotational, Shape, Sum
from ...models.surface import Surface


def with_figure(surface: Surface, name: str) -> Shape:
    """Return the shape of a surface as one that has a figure, which is zero where it was not there before.

    A Zernike term goes to the Zernike sag of the surface; where there is none, it is added, over the rims of the
    surface's aperture. Even powers of a conic of revolution are added too.

    Parameters
    ----------
    surface : Surface
        The surface.
    name : str
        Name of the figure: "radius", "conic", "a6", "Z5"...

    Raises
    ------
    UnknownNameError
        If there is no such figure.
    DomainError
        If a Zernike term is asked for on a surface without rims, or a number is out of range.
    """
    shape = surface.shape
    if name in shape.parameters:
        return shape
    zernike = re.fullmatch(r"Z([1-9]\d{0,2})", name)
    parts = shape.parts if isinstance(shape, Sum) else (shape,)
    if zernike:
        missing = int(zernike[1])
        for i, part in enumerate(parts):
            if isinstance(part, ZernikeSag):
                longer = replace(part, coefficients=part.coefficients + (0.0,) * (missing - len(part.coefficients)))
                return _sum((*parts[:i], longer, *parts[i + 1 :]))
        return _sum((*parts, ZernikeSag((0.0,) * missing, *_rims(surface))))
    power = re.fullmatch(r"a([468]|[1-9]\d)", name)
    if power and int(power[1]) % 2 == 0:
        for i, part in enumerate(parts):
            if isinstance(part, Rotational) and part.curvature:
                terms = part.coefficients + (0.0,) * (int(power[1]) // 2 - 1 - len(part.coefficients))
                asphere = EvenAsphere(1.0 / part.curvature, part.conic, terms)
                return _sum((*parts[:i], asphere, *parts[i + 1 :]))
    raise unknown_name(f"figure of {surface.name}", name, [*shape.parameters, "Z4"])


def figure_polynomial(shape: Shape, name: str) -> PolarPolynomial | None:
    """Return what a unit of a figure adds to the sag, if that is a polynomial of x and y [m]; None if it is not."""
    if isinstance(shape, Sum):
        part, inner = shape.place(name)
        return figure_polynomial(part, inner)
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


def figure_unit(shape: Shape, name: str) -> str:
    """Return the unit of a figure; empty for a pure number."""
    if isinstance(shape, Sum):
        part, inner = shape.place(name)
        return figure_unit(part, inner)
    powers = [int(n) for n in re.findall(r"\d+", name)] if re.fullmatch(r"a\d+|x\d+y\d+", name) else []
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
        f"surface {surface.name}: expected a round aperture, or a Zernike sag, to say over which rims a Zernike term is"
    )
