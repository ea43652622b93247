"""Fit CCD height functions to measured points (x, y, z)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.errors import DomainError
from ...core.number_text import counted
from ...core.random_streams import stream
from ...core.units import metres
from .camera import Camera
from .ccd_surfaces import POWERS, CcdSurfaces, spline_weights

if TYPE_CHECKING:
    from scipy.sparse import csc_array

# Fewest points for a polynomial of each degree; about twice its number of coefficients from the quadratic on.
_DEGREES = ((20, 3, 10), (9, 2, 6), (3, 1, 3))
# Fewest points of a CCD for which a B-spline is added to its polynomial.
_SPLINE_POINTS = 48
# Fewest points for each coefficient of the B-spline.
_POINTS_PER_COEFFICIENT = 3
# Largest number of coefficients of the B-spline along a side of the CCD.
_LARGEST_GRID = 20
# Weights of the spline's second differences against the data, of which each CCD has the one that predicts its points
# best. With the first, ripples of two cycles a CCD lose less than 1e-4 of their height, while patches without points
# are bridged smoothly; but noise grows there, by 20 to 40 times in the last tenth of a CCD.
_SMOOTHINGS = (1e-4, 1e-3, 1e-2)
# Random vectors by which the number of coefficients is found that the data hold.
_PROBES = 8


def fit_heights(
    camera: Camera, x: np.ndarray, y: np.ndarray, z: np.ndarray, *, margin: float = 0.0
) -> tuple[CcdSurfaces, np.ndarray]:
    """Fit each CCD's height function to the points [m], shape [n], that lie on it or at most a margin [m] outside.

    A polynomial by least squares takes the large shape: a plane from 3 points, a quadratic from 9, a cubic from 20.
    Where there are at least 48 points, a uniform cubic B-spline takes what is left. CCDs without points are flat at
    zero. Returned with the functions: which CCDs have points, shape [n_ccd] bool. A DomainError is raised if no point
    lies on a CCD, or a CCD has points but too few or all on one line.
    """
    ccd = camera.ccd_at(x, y, margin=margin)
    order = np.argsort(ccd, kind="stable")
    order = order[ccd[order] >= 0]
    if not order.size:
        raise DomainError(
            f"heights: none of {counted(len(x), 'point')} lies on a CCD: expected x, y in m on the focal plane"
        )
    bounds = np.searchsorted(ccd[order], np.arange(len(camera) + 1))
    counts = np.diff(bounds)
    rich = counts[counts >= _SPLINE_POINTS]
    m = 0
    if rich.size:
        # One grid for all CCDs (kernels read one array), so that the poorest of them supports it.
        m = int(np.clip(np.sqrt(rich.min() / _POINTS_PER_COEFFICIENT), 4, _LARGEST_GRID))
    polynomial = np.zeros((len(camera), 10))
    grid = np.zeros((len(camera), m, m)) if m else None
    bending = _bending(m) if m else ()
    for i, (first, last) in enumerate(pairwise(bounds)):
        if first == last:
            continue
        ccd_points = order[first:last]
        u, v = camera.to_uv(i, np.stack([x[ccd_points], y[ccd_points]], axis=1)).T
        polynomial[i], residual = _fit_polynomial(u, v, z[ccd_points], camera.ccd_names[i])
        if grid is not None and last - first >= _SPLINE_POINTS:
            grid[i] = _fit_spline(u, v, residual, bending)
    return CcdSurfaces(camera.half_sizes, polynomial, np.zeros((len(camera), 2, 4)), grid), counts > 0


def table_column(table: Any, name: str) -> np.ndarray:
    """Return a column of a table, structured array or mapping in metres; DomainError if it is missing or not finite."""
    if isinstance(table, Mapping):
        columns: Iterable[str] = table.keys()
    elif hasattr(table, "colnames"):  # astropy's
        columns = table.colnames
    else:
        columns = getattr(getattr(table, "dtype", None), "names", None) or ()
    if name not in columns:
        raise DomainError(f"table of heights: column {name!r} is missing: expected columns x, y, z")
    column = table[name]
    if hasattr(table, "colnames") and getattr(column, "unit", None) is not None:
        column = getattr(column, "quantity", column)
    if np.ma.isMaskedArray(column) and np.ma.is_masked(column):
        raise DomainError(f"heights: column {name!r} has masked rows: expected finite numbers")
    values = metres(column, f"heights column {name!r}")
    if not np.all(np.isfinite(values)):
        row = int(np.flatnonzero(~np.isfinite(values))[0])
        raise DomainError(f"heights: column {name!r}, row {row} = {values.flat[row]}: expected finite numbers")
    return values


def _fit_polynomial(u: np.ndarray, v: np.ndarray, z: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    for points, _, size in _DEGREES:
        if len(z) < points:
            continue
        design = np.stack([u**p * v**q for p, q in POWERS[:size]])
        # Sums by einsum and not by BLAS, whose threads would change the last bits.
        normal = np.einsum("in,jn->ij", design, design)
        spread = np.linalg.eigvalsh(normal)
        # Points in a few rows cannot carry the higher terms: go down a degree.
        if spread[0] > 1e-10 * spread[-1]:
            solution = np.linalg.solve(normal, np.einsum("in,n->i", design, z))
            return np.concatenate([solution, np.zeros(10 - size)]), z - np.einsum("in,i->n", design, solution)
    raise DomainError(f"heights on {name}: {counted(len(z), 'point')}: expected at least 3 that are not on one line")


def _bending(m: int) -> tuple[csc_array, ...]:
    """Return the quadratic forms of second differences along both sides, plus a tiny ridge, each [m^2, m^2]."""
    from scipy.sparse import csc_array

    second = np.diff(np.eye(m), 2, axis=0)
    stiffness = second.T @ second
    stiffness = np.kron(np.eye(m), stiffness) + np.kron(stiffness, np.eye(m))
    # The ridge settles the plane that neither bending nor, in an empty corner, the data hold.
    return tuple(csc_array(weight * stiffness + 1e-9 * np.eye(m * m)) for weight in _SMOOTHINGS)


def _fit_spline(u: np.ndarray, v: np.ndarray, z: np.ndarray, bending: tuple[csc_array, ...]) -> np.ndarray:
    """Return the coefficients [m, m] of the smoothing of least generalised cross-validation (Golub et al. 1979)."""
    from scipy.sparse import csc_array, csr_array
    from scipy.sparse.linalg import splu

    m = math.isqrt(bending[0].shape[0])
    i, wu = spline_weights(u, m)
    j, wv = spline_weights(v, m)
    four = np.arange(4)
    columns = (j + four[:, None])[:, None] * m + (i + four[:, None])[None, :]
    weights = wv[:, None] * wu[None, :]
    rows = np.broadcast_to(np.arange(len(z)), weights.shape)
    design = csr_array((weights.ravel(), (rows.ravel(), columns.ravel())), shape=(len(z), m * m))
    normal = csc_array(design.T @ design)
    # The trace of the matrix that takes the data to the fit is the mean of a quadratic form over random signs.
    probes = 2.0 * stream(0, "height fit").integers(0, 2, (m * m, _PROBES)) - 1.0
    scores, fits = [], []
    for form in bending:
        solver = splu(csc_array(normal + form * (normal.trace() / m**2)))
        fits.append(solver.solve(design.T @ z))
        held = np.sum(probes * solver.solve(normal @ probes)) / _PROBES
        scores.append(np.sum((z - design @ fits[-1]) ** 2) / (len(z) - held) ** 2)
    return np.asarray(fits[int(np.argmin(scores))].reshape(m, m))
