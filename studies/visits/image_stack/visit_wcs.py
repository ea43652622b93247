"""Pixels of a CCD in a visit, and the tangent plane that all visits have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ....imaging.wcs import CcdWcs
from ..plan import Visit


@dataclass(frozen=True, eq=False)
class VisitWcs:
    """World coordinates of a CCD in a visit: (xi, eta) are those about the pointing that all visits have in common.

    Attributes
    ----------
    ccd : CcdWcs
        World coordinates about the visit's own pointing, at a position angle of 0: its xi and eta are the X and Y of
        the telescope.
    visit : Visit
        Roll and pointing.
    """

    ccd: CcdWcs
    visit: Visit

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the CCD."""
        return self.ccd.shape

    def to_sky(self, pixels: ArrayLike) -> np.ndarray:
        """Return (xi, eta), shape [n, 2], of pixels (x, y), shape [n, 2]."""
        offsets = self.ccd.to_sky(pixels)
        source = np.column_stack([offsets, np.ones(len(offsets))]) @ self.visit.matrix
        return np.asarray(source[:, :2] / source[:, 2:])

    def to_pixel(self, sky: ArrayLike) -> np.ndarray:
        """Return pixels (x, y), shape [n, 2], of (xi, eta), shape [n, 2]."""
        return self.ccd.to_pixel(self._to_visit_plane(sky)[0])

    def jacobians(self, pixels: ArrayLike) -> np.ndarray:
        """Return d(x, y)/d(xi, eta) at pixels, shape [n, 2, 2]."""
        own, ahead = self._to_visit_plane(self.to_sky(pixels))
        matrix = self.visit.matrix
        # Derivative of (X, Y) / Z, both linear in xi and eta.
        change = (matrix[None, :2, :2] - own[:, :, None] * matrix[None, 2:, :2]) / ahead[:, :, None]
        return self.ccd.jacobians(pixels) @ change

    def _to_visit_plane(self, sky: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return positions about the visit's own pointing, and the component towards it before the division by it."""
        place = np.atleast_2d(np.asarray(sky, dtype=np.float64))
        source = np.column_stack([place, np.ones(len(place))]) @ self.visit.matrix.T
        return source[:, :2] / source[:, 2:], source[:, 2:]
