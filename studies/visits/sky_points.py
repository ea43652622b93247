"""Stars and places between them on the sky, the same in every visit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.random_streams import stream


@dataclass(frozen=True, eq=False)
class SkyPoints:
    """Stars and places of the sky."""

    sky: np.ndarray  #: xi, eta, [n, 2]
    star: np.ndarray  #: whether a point is a star, [n] bool
    quantile: np.ndarray  #: of the star counts, from the brightest, [n]; NaN of places

    def __len__(self) -> int:
        return len(self.sky)


def draw_points(seed: int, radius: float, cell: float, stars: int, places: int) -> SkyPoints:
    """Draw stars and places, evenly over cells of the sky.

    The points of a cell depend on the seed and the cell alone, and the first stars of it not on how many follow.

    Parameters
    ----------
    radius : float
        Points farther from the common pointing are left out (tangent of an angle).
    cell : float
        Side of a cell.
    stars, places : int
        Number in each cell.
    """
    reach = int(np.ceil(radius / cell + 0.5))
    sky, star, quantile = [], [], []
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            for kind, count in (("stars", stars), ("places", places)):
                rng = stream(seed, "sky", kind, _stream_number(i), _stream_number(j))
                draw = rng.random((count, 3))
                sky.append(cell * (np.array([i, j]) - 0.5 + draw[:, :2]))
                star.append(np.full(count, kind == "stars"))
                quantile.append(draw[:, 2] if kind == "stars" else np.full(count, np.nan))
    points, is_star, counts = (np.concatenate(arrays) for arrays in (sky, star, quantile))
    inside = np.hypot(*points.T) <= radius
    return SkyPoints(points[inside], is_star[inside], counts[inside])


def _stream_number(number: int) -> int:
    """Return an own natural number for each integer: keys of random streams are not negative."""
    return 2 * number if number >= 0 else -2 * number - 1
