"""World coordinates of a Piff file, from those of its stars: the WCS itself is pickled there, and never read."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from ...core.errors import WcsWarning
from ..psf_model.polynomial import design_matrix, term_count
from .tables import PiffTables

#: Columns of a star: field position [arcsec], d(u, v)/d(x, y) [arcsec/pixel].
_COLUMNS = ("u", "v", "dudx", "dudy", "dvdx", "dvdy")
#: Largest order of the polynomials.
_MOST = 5
#: Stars needed beyond the number of terms.
_SPARE = 3
#: Relative error at which no higher order is tried.
_ENOUGH = 1e-10
#: Relative error from which on it is told: the Jacobian's is about that of the peak of a PSF.
_TOLD = 1e-3
#: Relative error from which on the coordinates are refused: ten times the structure that tree rings and edges of
#: detectors make in those of DES (pixmappy).
_TOO_MUCH = 0.05


@dataclass(frozen=True, eq=False)
class StarWorld:
    """Field positions and Jacobians as polynomials of x and y through those of the stars of a chip.

    Attributes
    ----------
    extent : tuple of float
        (xmin, xmax, ymin, ymax) of the stars [pixel].
    order : int
        Order of the polynomials.
    coefficients : ndarray, shape [n_term, 6]
        Of u, v [arcsec] and d(u, v)/d(x, y) [arcsec/pixel].
    error : float
        Largest error at a star left out of the fit: of the Jacobian, relative to it, and of u and v over the extent.
    """

    extent: tuple[float, float, float, float]
    order: int
    coefficients: np.ndarray
    error: float

    @classmethod
    def fit(cls, tables: PiffTables, chip: int | None) -> StarWorld:
        """Fit the stars of a file, on one chip of several, by the order with the smallest error."""
        stars = star_columns(tables, chip)
        if len(stars) < term_count(1) + _SPARE:
            raise tables.error(
                f"{len(stars)} stars, which have the world coordinates: expected at least {term_count(1) + _SPARE} "
                "(the WCS is pickled, and never read)"
            )
        places, values = stars[:, :2], stars[:, 2:]
        low = places.min(axis=0)
        high = np.maximum(places.max(axis=0), low + 1.0)
        extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
        scale = np.abs(values[:, 2:]).max()
        span = scale * max(np.ptp(places, axis=0).max(), 1.0)
        sizes = np.array([span, span, scale, scale, scale, scale])
        best = None
        for order in range(1, _MOST + 1):
            if term_count(order) + _SPARE > len(stars):
                break
            terms = design_matrix(places, extent, order)
            inverse = np.linalg.pinv(terms)
            residuals = (values - terms @ (inverse @ values)) / sizes
            leverage = np.einsum("ij,ji->i", terms, inverse)[:, None]
            error = float(np.abs(residuals / np.maximum(1.0 - leverage, 1e-6)).max())
            if best is None or error < best.error:
                best = cls(extent, order, inverse @ values, error)
            if error < _ENOUGH:
                break
        assert best is not None
        if best.error > _TOO_MUCH:
            raise tables.error(
                f"its {len(stars)} stars have the world coordinates with errors of {best.error:.1g}: expected more "
                f"stars, or wcs=, with errors below {_TOO_MUCH:g} (the WCS is pickled, and never read)"
            )
        if best.error > _TOLD:
            of_chip = "" if chip is None else f" of chip {chip}"
            percent = f"{100.0 * best.error:.1g} %"
            warnings.warn(
                f"{tables.path}: world coordinates{of_chip} with errors of {percent}, and so its PSFs. Polynomials "
                f"through {len(stars)} stars do not follow their small-scale structure; wcs= does",
                WcsWarning,
                stacklevel=2,
            )
        return best

    def at(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return u, v [arcsec], shape [n, 2], and Jacobians [arcsec/pixel], shape [n, 2, 2], at pixels [n, 2]."""
        values = design_matrix(positions, self.extent, self.order) @ self.coefficients
        return values[:, :2], values[:, 2:].reshape(-1, 2, 2)


def star_columns(tables: PiffTables, chip: int | None) -> np.ndarray:
    """Return x, y [pixel], u, v [arcsec] and d(u, v)/d(x, y) [arcsec/pixel] of the stars of a chip, [n, 8]."""
    stars = np.stack([tables.column("stars", name) for name in ("x", "y", *_COLUMNS)], axis=1)
    if chip is not None and "chipnum" in tables.table("stars").names:
        stars = stars[tables.column("stars", "chipnum") == chip]
    return np.asarray(stars[np.isfinite(stars).all(axis=1)])
