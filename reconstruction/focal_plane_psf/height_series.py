"""Quantities at places of the focal plane as Chebyshev series of the height of the CCD."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from ...models.camera.ccd_surfaces import CcdSurfaces
from ...models.camera.focal_plane import FocalPlane


@dataclass(frozen=True, eq=False)
class HeightSeries:
    """Quantities at n places, each a Chebyshev series of the height within `reach` of `center`.

    Attributes
    ----------
    coefficients : ndarray, shape [n_node, n, n_quantity]
        Coefficients of the Chebyshev terms.
    reach : float
        Half the range of heights [m].
    center : float
        Middle of the range [m].
    """

    coefficients: np.ndarray
    reach: float
    center: float = 0.0

    @classmethod
    def of(
        cls,
        evaluate: Callable[[FocalPlane], np.ndarray],
        plane: FocalPlane,
        reach: float,
        n_nodes: int,
        *,
        center: float = 0.0,
    ) -> HeightSeries:
        """Return the series that meets a function at its Chebyshev nodes.

        `evaluate` returns the quantities [n, n_quantity] on a focal plane whose CCDs lie at one height, of the camera
        of `plane`.
        """
        nodes = np.cos(np.pi * (np.arange(n_nodes) + 0.5) / n_nodes)
        values = np.stack([evaluate(level_plane(plane, center + reach * node)) for node in nodes])
        inverse = np.linalg.inv(chebyshev.chebvander(nodes, n_nodes - 1))
        return cls(np.einsum("kn,nsf->ksf", inverse, values), reach, center)

    def chosen(self, rows: np.ndarray) -> HeightSeries:
        """Return the series of some places."""
        return HeightSeries(self.coefficients[:, rows], self.reach, self.center)

    def at(self, heights: np.ndarray) -> np.ndarray:
        """Return the quantities at heights [m], shape [n, n_quantity]."""
        return self._sum(heights, self.coefficients)

    def slope(self, heights: np.ndarray) -> np.ndarray:
        """Return the derivatives with respect to the height [1/m], shape [n, n_quantity]."""
        return self._sum(heights, chebyshev.chebder(self.coefficients, axis=0) / self.reach)

    def _sum(self, heights: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        terms = chebyshev.chebvander((heights - self.center) / self.reach, len(coefficients) - 1)
        return np.einsum("sk,ksf->sf", terms, coefficients)


def level_plane(plane: FocalPlane, height: float) -> FocalPlane:
    """Return a focal plane of the same camera, all of whose CCDs lie at one height [m]."""
    surfaces = CcdSurfaces.level(plane.camera.half_sizes, height)
    return FocalPlane(plane.camera, surfaces, np.zeros(len(plane.camera), dtype=bool))
