"""Points of an annulus with weights: quadrature over the entrance pupil or over a field of view.

A mean over the pupil is a weighted sum over points. Gauss quadrature is exact for polynomials and is the default. Where
an edge vignettes the pupil, all samplings converge with the number of points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.number_text import counted
from ..core.units import MOST, require_count
from ..models.telescope import Telescope

SamplingName = Literal["gauss", "rings", "spiral", "square"]
#: Default ``n_pupil``: points along the radius (gauss, rings), in all (spiral) or along the diameter (square).
DEFAULT_N_PUPIL: dict[SamplingName, int] = {"gauss": 20, "rings": 24, "spiral": 2000, "square": 64}


@check_arguments
@dataclass(frozen=True)
class PupilSampling:
    """Points of an annulus and their weights in a mean.

    Attributes
    ----------
    points : ndarray, shape [n, 2]
        Coordinates [m]; of the entrance pupil, in the plane ``z = stop_z``.
    weights : ndarray, shape [n]
        Weights of a mean over the annulus; they sum to 1.
    """

    points: np.ndarray
    weights: np.ndarray

    def __repr__(self) -> str:
        return f"<PupilSampling: {counted(len(self), 'point')}>"

    def __post_init__(self) -> None:
        points, weights = (np.asarray(v, dtype=np.float64) for v in (self.points, self.weights))
        if points.ndim != 2 or points.shape[1] != 2 or weights.shape != points.shape[:1] or not len(weights):
            raise DomainError(
                f"sampling of points {points.shape} and weights {weights.shape}: expected shapes [n, 2] and [n]"
            )
        if not (np.isfinite(points).all() and np.isfinite(weights).all() and weights.sum() > 0):
            raise DomainError("sampling: expected finite points, and finite weights of positive sum")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "weights", weights / weights.sum())

    def __len__(self) -> int:
        return len(self.weights)


#: The centre of the pupil alone, for functions with pupil points of their own.
CHIEF_RAY = PupilSampling(np.zeros((1, 2)), np.ones(1))


def gauss_annulus(radius: float, obscuration: float, rings: int, spokes: int) -> PupilSampling:
    """Return Gauss quadrature on an annulus: Gauss-Legendre in the square of the radius, equal angles.

    The mean of ``x^a y^b`` comes out exactly for ``a + b < min(4 rings, spokes)``: 5 rings and 17 spokes integrate the
    square of a wavefront of degree 8 (Forbes 1988, J. Opt. Soc. Am. A 5, 1943). The outer radius has the unit of the
    points; the obscuration is inner over outer radius.
    """
    _check_counts(obscuration, rings=rings, spokes=spokes)
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    square = 0.5 * (1.0 - obscuration**2) * nodes + 0.5 * (1.0 + obscuration**2)
    # Half a step from the axes: no point lies on a spider vane along them, and both axes stay axes of symmetry.
    angle = (np.arange(spokes) + 0.5) * (2.0 * np.pi / spokes)
    return PupilSampling(_polar_points(radius * np.sqrt(square)[:, None], angle), np.repeat(weights, spokes))


def ring_annulus(radius: float, obscuration: float, rings: int) -> PupilSampling:
    """Return rings of equal width with about square cells, the hexapolar sampling of Zemax.

    Points lie at the root mean square radius of their ring, so quadratic functions are averaged exactly. For others
    the error falls as the inverse square of the number of rings.
    """
    _check_counts(obscuration, rings=rings)
    edges = np.linspace(obscuration, 1.0, rings + 1)
    areas = np.diff(edges**2)
    middle = np.sqrt(0.5 * (edges[1:] ** 2 + edges[:-1] ** 2))
    # Multiples of six keep the pattern symmetric about both axes.
    counts = np.maximum(6, 6 * np.rint(2.0 * np.pi * middle * rings / (1.0 - obscuration) / 6.0).astype(int))
    points = [
        _polar_points(np.array([[radius * r]]), (np.arange(n) + 0.5) * (2.0 * np.pi / n))
        for r, n in zip(middle, counts, strict=True)
    ]
    return PupilSampling(np.concatenate(points), np.repeat(areas / counts, counts))


def spiral_annulus(radius: float, obscuration: float, count: int) -> PupilSampling:
    """Return points of equal weight on a spiral of the golden angle, at equal areas.

    The pattern has no symmetry, so an edge across the pupil cuts off about the right number of points wherever it
    lies (Vogel 1979, Mathematical Biosciences 44, 179).
    """
    _check_counts(obscuration, count=count)
    k = np.arange(count)
    square = obscuration**2 + (1.0 - obscuration**2) * (k + 0.5) / count
    angle = k * np.pi * (3.0 - np.sqrt(5.0))
    return PupilSampling(_polar_points(radius * np.sqrt(square), angle), np.ones(count))


def annulus_contains(x: np.ndarray, y: np.ndarray, inner: float, outer: float = 1.0) -> np.ndarray:
    """Return whether points lie in an annulus, its rims included."""
    return np.asarray((x**2 + y**2 <= outer**2) & (x**2 + y**2 >= inner**2))


def square_annulus(radius: float, obscuration: float, across: int) -> PupilSampling:
    """Return points of equal weight: centres of the cells of a square lattice, where they lie in an annulus."""
    _check_counts(obscuration, across=across)
    u = (2.0 * np.arange(across) + 1.0) / across - 1.0
    x, y = np.meshgrid(u, u)
    inside = annulus_contains(x, y, obscuration)
    points = radius * np.stack([x[inside], y[inside]], axis=-1)
    if not len(points):
        raise DomainError(f"across = {across}: expected more points for an obscuration of {obscuration:g}")
    return PupilSampling(points, np.ones(len(points)))


@check_arguments
def pupil_sampling(
    telescope: Telescope, sampling: SamplingName | PupilSampling = "gauss", n_pupil: int | None = None
) -> PupilSampling:
    """Return points of a telescope's entrance pupil.

    Parameters
    ----------
    telescope, n_pupil
        As in :meth:`pachon.Request.of`.
    sampling : {"gauss", "rings", "spiral", "square"} or PupilSampling
        Gauss quadrature, exact for polynomials; rings of equal width, as hexapolar in Zemax; a golden-angle spiral; a
        square lattice. A :class:`PupilSampling` is returned unchanged.

    Raises
    ------
    ConfigError
        If the kind is unknown.
    DomainError
        If ``n_pupil`` is not a whole number of at least 1.
    """
    if isinstance(sampling, PupilSampling):
        return sampling
    radius, obscuration = 0.5 * telescope.pupil_diameter, telescope.pupil_obscuration
    default = DEFAULT_N_PUPIL[sampling]
    # On a spiral the number of points, else of those along a radius or side.
    limit = MOST if sampling == "spiral" else math.isqrt(MOST)
    n = require_count(default if n_pupil is None else n_pupil, "n_pupil", 1, limit)
    if sampling == "gauss":
        return gauss_annulus(radius, obscuration, n, 4 * n)
    return {"rings": ring_annulus, "spiral": spiral_annulus, "square": square_annulus}[sampling](radius, obscuration, n)


def _polar_points(radius: np.ndarray, angle: np.ndarray) -> np.ndarray:
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)


def _check_counts(obscuration: float, **counts: int) -> None:
    if not 0.0 <= obscuration < 1.0:
        raise DomainError(f"obscuration = {obscuration!r}: expected 0 <= obscuration < 1")
    for name, value in counts.items():
        require_count(value, name, 1)
