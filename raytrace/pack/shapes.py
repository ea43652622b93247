"""The shapes of a telescope's surfaces for the trace kernels: a conic with even powers, and parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ...core.errors import PrescriptionError
from ...core.warp_arrays import warp_array
from ...models.shapes.freeform import Biconic, OddAsphere, Toroid
from ...models.shapes.grid import GridSag
from ...models.shapes.mesh import MeshSurface
from ...models.shapes.polar_polynomial import PolarPolynomial, from_even_powers
from ...models.shapes.polynomial import XYPolynomial, ZernikeSag
from ...models.shapes.qbfs import QbfsAsphere
from ...models.shapes.shape import Plane, Rotational, Shape
from ...models.shapes.sum import Sum
from ..kernels.shape import BICONIC, GRID, ODD, PART_COLUMNS, POLAR, QBFS, TOROID, PackedDeformations


@dataclass(frozen=True)
class SplitShape:
    """A shape as a conic with even powers of the radius, and added parts."""

    base: Rotational  #: conic with even powers; a plane where the shape has none of its own
    parts: tuple[Shape, ...]  #: shapes added to it; of an odd or a Q-type asphere only its terms
    #: Curvature [1/m] of the surface that the search for a ray's landing starts from: that of the base, or of the
    #: sphere that a shape without a base resembles.
    first_curvature: float


def split_shape(shape: Shape, *, screen: bool = False) -> SplitShape:
    """Return a shape as its base and parts; of a phase screen, which is a map, all of it becomes parts."""
    if isinstance(shape, Rotational) and not screen:
        return SplitShape(shape, (), shape.curvature)
    if isinstance(shape, MeshSurface) and not screen:
        return SplitShape(Plane(), (), 0.0)
    parts = list(_flattened_terms(shape))
    base: Rotational = Plane()
    if not screen:
        for i, term in enumerate(parts):
            if isinstance(term, Rotational) and not isinstance(term, Plane):
                base = term
                del parts[i]
                break
    added_shapes = tuple(p for p in parts if not isinstance(p, Plane))
    first = shape.curvature if isinstance(base, Plane) and not screen else base.curvature
    return SplitShape(base, added_shapes, first)


def _flattened_terms(shape: Shape) -> Sequence[Shape]:
    """Return the terms of a sum, of sums within it too; an odd or a Q-type asphere comes after its own conic."""
    if isinstance(shape, Sum):
        return [term for summand in shape.parts for term in _flattened_terms(summand)]
    return [shape.base, shape] if isinstance(shape, OddAsphere | QbfsAsphere) else [shape]


def pack_deformations(shapes: Sequence[SplitShape], device: str = "cpu") -> Any:
    """Return the parts of all surfaces as a :class:`PackedDeformations` struct on a device.

    A shape that cannot be a part of a sum is a PrescriptionError.
    """
    span = np.zeros((len(shapes), 2), dtype=np.int32)
    rows: list[list[int]] = []
    numbers: list[np.ndarray] = []
    offset = 0
    for row, shape in enumerate(shapes):
        span[row, 0] = len(rows)
        for kind, sizes, part_numbers in _encoded_parts(shape.parts):
            rows.append([kind, offset, *sizes])
            numbers.append(part_numbers)
            offset += len(part_numbers)
        span[row, 1] = len(rows)
    packed = PackedDeformations()
    table = np.array(rows, dtype=np.int32).reshape(-1, PART_COLUMNS)
    packed.span = warp_array(span, wp.int32, device=device)
    packed.parts = warp_array(table, wp.int32, device=device)
    packed.numbers = warp_array(np.concatenate([np.zeros(0), *numbers]), device=device)
    return packed


def _encoded_parts(shapes: Sequence[Shape]) -> list[tuple[int, tuple[int, int], np.ndarray]]:
    """Return the kind, two whole numbers and the numbers of each part; all polynomials make one part."""
    encoded: list[tuple[int, tuple[int, int], np.ndarray]] = []
    polynomial: PolarPolynomial | None = None

    def add(term: PolarPolynomial) -> None:
        nonlocal polynomial
        polynomial = term if polynomial is None else polynomial + term

    for shape in shapes:
        if isinstance(shape, (XYPolynomial, ZernikeSag)):
            add(shape.polynomial)
        elif isinstance(shape, OddAsphere):
            if shape.coefficients[0::2]:
                odd = np.array(shape.coefficients[0::2])
                encoded.append((int(ODD), (len(odd), 0), odd))
            add(from_even_powers(shape.coefficients[1::2], first=2))
        elif isinstance(shape, Rotational):
            add(from_even_powers(shape.coefficients))
            encoded.append(_encoded_conic(shape))
        elif isinstance(shape, Biconic):
            c = np.array([1.0 / shape.radius_x, 1.0 / shape.radius_y])
            k = np.array([1.0 + shape.conic_x, 1.0 + shape.conic_y])
            encoded.append((int(BICONIC), (0, 0), np.concatenate([c, k * c**2])))
        elif isinstance(shape, Toroid):
            cx, cy = 1.0 / shape.radius_x, 1.0 / shape.radius_y
            numbers = np.array([cx, cy, (1.0 + shape.conic_y) * cy**2, *shape.coefficients])
            encoded.append((int(TOROID), (len(shape.coefficients), 0), numbers))
        elif isinstance(shape, QbfsAsphere):
            square, series = 1.0 / shape.radius**2, shape.series
            numbers = np.array(
                [shape.conic * square, (1.0 + shape.conic) * square, 1.0 / shape.norm_radius**2, *series]
            )
            encoded.append((int(QBFS), (len(series), 0), numbers))
        elif isinstance(shape, GridSag):
            head = [shape.x[0], shape.y[0], *(1.0 / step for step in shape.step)]
            numbers = np.concatenate([head, shape.nodes.ravel()])
            encoded.append((int(GRID), (len(shape.x), len(shape.y)), numbers))
        else:
            raise PrescriptionError(f"shape {type(shape).__name__}: expected one that can be part of a sum or a map")
    if polynomial is not None and np.any(polynomial.terms):
        encoded.insert(0, _encoded_polynomial(polynomial))
    return encoded


def _encoded_conic(shape: Rotational) -> tuple[int, tuple[int, int], np.ndarray]:
    c, p = shape.curvature, (1.0 + shape.conic) * shape.curvature**2
    return int(BICONIC), (0, 0), np.array([c, c, p, p])


def _encoded_polynomial(polynomial: PolarPolynomial) -> tuple[int, tuple[int, int], np.ndarray]:
    degree, order = polynomial.degree, polynomial.order
    numbers: list[float] = []
    terms = np.zeros((degree + 1, degree // 2 + 1), dtype=np.complex128)
    m_max, k_max = (min(a, b) for a, b in zip(terms.shape, polynomial.terms.shape, strict=True))
    terms[:m_max, :k_max] = polynomial.terms[:m_max, :k_max]
    for m in range(order, -1, -1):
        for k in range((degree - m) // 2, -1, -1):
            numbers += [terms[m, k].real, terms[m, k].imag]
    return int(POLAR), (degree, order), np.array(numbers)
