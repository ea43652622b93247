"""Adaptive moments of PSFs of given weighted e1, e2 and size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...measure.adaptive_moments import adaptive_moments
from .images import with_shapes
from .mosaic import PsfShapes

#: Nodes along each of e1, e2 and ln size, in standard deviations of the shapes: parabolas are good to 1e-6.
_NODES = (-2.0, 0.0, 2.0)
#: Least spread of nodes: that of shapes which are all alike.
_LEAST_SPREAD = 1e-4


@dataclass(frozen=True, eq=False)
class AdaptiveShapes:
    """Adaptive moments at places, one array element each.

    Attributes
    ----------
    g1, g2 : ndarray
        Ellipticity (a - b)/(a + b), along x and along the diagonal.
    sigma : ndarray
        Size (Mxx Myy - Mxy^2)^(1/4) [rad].
    """

    g1: np.ndarray
    g2: np.ndarray
    sigma: np.ndarray


def adaptive_of_star(star: np.ndarray, shapes: PsfShapes, pixel_scale: float, weight_fwhm: float) -> AdaptiveShapes:
    """Return the adaptive moments of a star [ny, nx] convolved to given shapes, as :meth:`FocalPlanePsf.draw` does.

    It is drawn at 27 shapes about their mean; between these g and ln sigma are polynomials of the second order.
    """
    values = np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=1)
    finite = np.isfinite(values).all(axis=1)
    result = np.full(values.shape, np.nan)
    if finite.any():
        middle = values[finite].mean(axis=0)
        spread = np.maximum(values[finite].std(axis=0), _LEAST_SPREAD)
        nodes = np.stack(np.meshgrid(_NODES, _NODES, _NODES), axis=-1).reshape(-1, 3)
        stars = np.broadcast_to(star, (len(nodes), *star.shape))
        moments = adaptive_moments(with_shapes(stars, middle + nodes * spread, pixel_scale, weight_fwhm), pixel_scale)
        at_nodes = np.stack([moments.g1, moments.g2, np.log(moments.sigma)], axis=1)
        good = moments.usable
        coefficients = np.linalg.lstsq(_terms(nodes[good]), at_nodes[good], rcond=None)[0]
        result[finite] = _terms((values[finite] - middle) / spread) @ coefficients
    return AdaptiveShapes(result[:, 0], result[:, 1], np.exp(result[:, 2]))


def _terms(u: np.ndarray) -> np.ndarray:
    """Return the monomials of three variables [n, 3] up to the second order, [n, 10]."""
    products = [u[:, i] * u[:, j] for i in range(3) for j in range(i, 3)]
    return np.stack([np.ones(len(u)), *u.T, *products], axis=1)
