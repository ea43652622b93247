"""Part of the light on the optical axis that arrives at the pixels of a CCD, of sources and of the sky."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..reconstruction.psf_model.polynomial import Extent, degrees, design_matrix, mapped


@dataclass(frozen=True, eq=False)
class LitFraction:
    """Polynomial of the part of the light that vignetting leaves, cut at 0 and 1."""

    coefficients: np.ndarray  #: of the terms of :func:`.design_matrix`
    order: int
    extent: Extent  #: of the CCD [pixel]

    @classmethod
    def fit(cls, positions: np.ndarray, light: np.ndarray, extent: Extent, order: int) -> LitFraction:
        """Fit the light [n] at pixels (x, y) of a CCD [n, 2]."""
        terms = design_matrix(positions, extent, order)
        return cls(np.linalg.lstsq(terms, light, rcond=None)[0], order, extent)

    def at(self, positions: np.ndarray) -> np.ndarray:
        """Return the light at pixels [n, 2], shape [n]."""
        terms = design_matrix(positions, self.extent, self.order)
        return np.clip((terms * self.coefficients).sum(axis=1), 0.0, 1.0)

    def on_rows(self, corner: tuple[int, int], shape: tuple[int, int], rows: slice) -> np.ndarray:
        """Return the light at the pixels of some rows of an image of a shape, from a corner (x, y), [n_row, width]."""
        first, last, _ = rows.indices(shape[0])
        (x, y), width = corner, shape[1]
        (left, low), (right, high) = mapped([[x, y + first], [x + width - 1, y + last - 1]], self.extent)
        along_x = np.polynomial.legendre.legvander(np.linspace(left, right, width), self.order)
        along_y = np.polynomial.legendre.legvander(np.linspace(low, high, last - first), self.order)
        products = np.zeros((self.order + 1, self.order + 1))
        for coefficient, (i, j) in zip(self.coefficients, degrees(self.order), strict=True):
            products[i, j] = coefficient
        return np.clip(along_y @ products.T @ along_x.T, 0.0, 1.0)
