"""Adjoint matrix: derivatives of outputs of rays, with columns per surface parameter.

All parameters of a telescope act through few quantities of each surface: a change of its sag and of the slopes of that
change, the refractive indices on both sides, and, for motions, force and torque of the ray on either side. A table
lists the column of each that is computed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from ...core.warp_arrays import warp_array
from ...models.telescope import Telescope
from .column_kernels import FORCE, GROOVE, INDEX, INTERSECTION, QUANTITIES, SAG

#: Quantities of a surface by name: the first and how many.
_QUANTITIES = {
    "sag": (int(SAG), 3),
    "index": (int(INDEX), 2),
    "intersection": (int(INTERSECTION), 2),
    "gap": (int(FORCE), 6),
    "grooves": (int(GROOVE), 2),
}
#: Quantities of every surface.
_GENERAL = ("sag", "index", "intersection", "gap")

#: Surfaces with polynomial sags: surface, length scale of x and y [m], degree, column of each term or -1.
Polynomials = Sequence[tuple[int, float, int, np.ndarray]]


@dataclass(frozen=True)
class AdjointMatrix:
    """Derivatives of each output of each ray, with columns per surface."""

    columns: np.ndarray  #: column of each quantity of each surface, -1 where not computed, [n_surface + 1, 15]
    values: np.ndarray  #: the columns, [n_output, n_column, n]
    #: Derivatives by position [1/m] and direction of the ray at its start, telescope frame, [n_output, 6, n].
    start: np.ndarray | None = None

    def _quantity(self, surface: int, name: str) -> np.ndarray:
        first, count = _QUANTITIES[name]
        columns = self.columns[surface, first : first + count]
        assert (columns >= 0).all(), f"{name!r} of surface {surface} is not among the columns"
        return self.values[:, columns[0] : columns[0] + count]

    def sag(self, surface: int) -> np.ndarray:
        """Return derivatives by a change of the sag [1/m] and by its slopes along x and y, [n_output, 3, n]."""
        return self._quantity(surface, "sag")

    def gap(self, gap: int) -> np.ndarray:
        """Return force and torque in the gap before a surface, [n_output, 6, n]; the last gap is behind the last."""
        return self._quantity(gap, "gap")

    def motion(self, surface: int) -> np.ndarray:
        """Return derivatives by a motion of the surface, shape [n_output, 6, n].

        A point r of it moves by ``v + w x r``, in the telescope frame: the first three are per unit of v [m], the
        others per unit of w [rad].
        """
        return self.gap(surface + 1) - self.gap(surface)

    def index(self, surface: int) -> np.ndarray:
        """Return derivatives by the refractive index before and after the surface, shape [n_output, 2, n]."""
        return self._quantity(surface, "index")

    def grooves(self, surface: int) -> np.ndarray:
        """Return derivatives by the path that grooves add along x and y for a metre of wavelength, [n_output, 2, n]."""
        return self._quantity(surface, "grooves")

    def intersection(self, surface: int) -> np.ndarray:
        """Return intersections of the rays with the surface, in its own x and y [m], shape [2, n]."""
        return self._quantity(surface, "intersection")[0]


def column_table(
    telescope: Telescope, quantities: Iterable[tuple[int, str]] | None = None, first: int = 0
) -> np.ndarray:
    """Return the table of columns for some quantities, shape [n_surface + 1, 15]; -1 stands for none.

    ``quantities`` are pairs (index of a surface, name), by default all but the last: "sag", "index", "intersection",
    "gap" for the gap in front of it, "grooves" of a grating; the gap behind the last surface belongs to the index after
    that. The first column has the number ``first``.
    """
    count = len(telescope.surfaces)
    if quantities is None:
        quantities = [*((s, name) for s in range(count) for name in _GENERAL), (count, "gap")]
    table = np.full((count + 1, QUANTITIES), -1, dtype=np.int32)
    column = first
    for surface, name in sorted(set(quantities)):
        start, width = _QUANTITIES[name]
        table[surface, start : start + width] = range(column, column + width)
        column += width
    return table


def polynomial_terms(degree: int) -> list[tuple[int, int, bool]]:
    """Return m, k and whether it is the imaginary part of the sags ``s^k (x + i y)^m``, ``m + 2 k <= degree``."""
    return [
        (m, k, imaginary)
        for m in range(degree + 1)
        for k in range((degree - m) // 2 + 1)
        for imaginary in (False, True)[: 1 + (m > 0)]
    ]


def column_count(columns: np.ndarray, polynomials: Polynomials) -> int:
    """Return the number of columns of a table and of polynomials."""
    return 1 + max([int(columns.max()), *(int(term_columns.max()) for *_, term_columns in polynomials)])


def polynomial_tables(columns: np.ndarray, polynomials: Polynomials) -> tuple[wp.array, wp.array]:
    """Return the tables of polynomials for the kernels: degree and columns, and the scales."""
    most_terms = max([0, *(len(term_columns) for *_, term_columns in polynomials)])
    table = np.full((max(len(polynomials), 1), 3 + most_terms), -1)
    for j, (surface, _, degree, term_columns) in enumerate(polynomials):
        table[j, :3] = degree, columns[surface, SAG], columns[surface, INTERSECTION]
        table[j, 3 : 3 + len(term_columns)] = term_columns
    return warp_array(table, wp.int32), warp_array([scale for _, scale, *_ in polynomials])
