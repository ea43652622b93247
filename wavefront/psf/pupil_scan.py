"""Rims and vanes of a clear pupil of any shape, found by rays: along spokes, and around on rings.

On a spoke light passes from the innermost lit point to the outermost one; what is dark between them, and narrow, is
the shadow of a vane.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...models.telescope import Telescope
from ...raytrace.launch import aimed_points, launch_bundles
from ...raytrace.rays import RayStatus
from ...raytrace.trace import trace

#: Points along a spoke.
_ALONG = 64
#: Rings of points, and points on each: vanes of a 600th of the diameter of the pupil are found.
_RINGS = 24
_AROUND = 2048
#: Width of a shadow over the diameter of the pupil up to which it is that of a vane.
_WIDEST_VANE = 0.05
#: Distance of shadows on neighbouring rings over that of the rings, up to which they are of one vane.
_SLANTED = 2.0
#: Times that the way between two points is divided to find where light ends, and parts of each division.
_DIVISIONS = 3
_PARTS = 10


@dataclass(frozen=True)
class Vanes:
    """Pieces of the shadows of vanes in the plane of the entrance pupil.

    Attributes
    ----------
    points, normals : ndarray, shape [n, 2]
        Middles of the pieces [m], and unit vectors across them.
    lengths, widths : ndarray, shape [n]
        Their lengths and widths [m].
    """

    points: np.ndarray
    normals: np.ndarray
    lengths: np.ndarray
    widths: np.ndarray


def no_vanes() -> Vanes:
    """Return no vanes."""
    return Vanes(*np.zeros((2, 0, 2)), *np.zeros((2, 0)))


def points_of_plane(telescope: Telescope, direction: np.ndarray, wavelength: float, pupil: np.ndarray) -> np.ndarray:
    """Return points of the plane of the entrance pupil [n, 2] by their pupil coordinates, for light of a direction."""
    aimed = aimed_points(telescope, direction[None], wavelength, pupil)
    return aimed[0] if aimed.ndim == 3 else pupil


def scanned_edges(telescope: Telescope, direction: np.ndarray, unit: np.ndarray, wavelength: float) -> np.ndarray:
    """Return the radii of the pupil between which light passes on spokes [m], as :func:`.clear_edges`, [n_spoke, 2].

    A spoke along a vane has the radii of those beside it.
    """
    lit = _Lit(telescope, direction, wavelength)
    reach = 0.5 * telescope.pupil_diameter * (1.0 + 1.0 / _ALONG)
    radii = reach * (np.arange(_ALONG) + 0.5) / _ALONG
    status = lit(radii[:, None, None] * unit)
    shining = status.any(axis=0)
    edges = np.zeros((len(unit), 2))
    if not shining.any():
        return edges
    first, last = status.argmax(axis=0), _ALONG - 1 - status[::-1].argmax(axis=0)
    clear = radii[np.stack([first, last])]
    outward = reach / _ALONG * np.array([[-1.0], [1.0]])
    edges[:] = _divided(lambda radius: lit(radius[..., None] * unit), clear, clear + outward).T
    edges[:, 0] = np.where(first == 0, 0.0, np.maximum(edges[:, 0], 0.0))
    spokes = np.arange(len(unit))
    inner, outer = (np.interp(spokes, spokes[shining], edges[shining, side], period=len(unit)) for side in (0, 1))
    # A spoke along a vane is dark for some or all of its length: its neighbours are not.
    inner = np.minimum(inner, np.maximum(np.roll(inner, 1), np.roll(inner, -1)))
    outer = np.maximum(outer, np.minimum(np.roll(outer, 1), np.roll(outer, -1)))
    return np.stack([inner, outer], axis=1)


def scanned_vanes(telescope: Telescope, direction: np.ndarray, edges: np.ndarray, wavelength: float) -> Vanes:
    """Return the vanes between the radii of the pupil where light passes on evenly spaced spokes [m], [n_spoke, 2]."""
    lit = _Lit(telescope, direction, wavelength)
    inner, outer = float(edges[:, 0].min()), float(edges[:, 1].max())
    spacing = (outer - inner) / _RINGS
    radii = inner + spacing * (np.arange(_RINGS) + 0.5)
    angles = 2.0 * math.pi * np.arange(_AROUND) / _AROUND

    def at(radius: np.ndarray, angle: np.ndarray) -> np.ndarray:
        return np.asarray(np.expand_dims(radius, -1) * np.stack([np.cos(angle), np.sin(angle)], axis=-1))

    status = lit(at(radii[:, None], angles))
    ring, begin, end = _dark_runs(status)
    spoke = np.rint(0.5 * (begin + end) / _AROUND * len(edges) - 0.5).astype(np.int64) % len(edges)
    radius = radii[ring]
    step = 2.0 * math.pi / _AROUND
    vane = (radius > edges[spoke, 0]) & (radius < edges[spoke, 1])
    vane &= (end - begin) * step * radius < _WIDEST_VANE * telescope.pupil_diameter
    ring, begin, end, radius = (v[vane] for v in (ring, begin, end, radius))
    # From the last lit point before the shadow, and from the first one after it, into it.
    clear, dark = step * np.stack([begin - 1.0, end + 1.0]), step * np.stack([begin, end])
    low, high = _divided(lambda angle: lit(at(radius, angle)), clear, dark)
    middle = points_of_plane(telescope, direction, wavelength, at(radius, 0.5 * (low + high)))
    chord = points_of_plane(telescope, direction, wavelength, at(radius, high)) - points_of_plane(
        telescope, direction, wavelength, at(radius, low)
    )
    along = np.zeros_like(middle)
    for side in (-1, 1):
        distance = np.hypot(*(middle[:, None] - middle[None]).transpose(2, 0, 1))
        distance[ring[:, None] + side != ring[None]] = np.inf
        nearest = distance.argmin(axis=1) if len(ring) else np.zeros(0, dtype=np.int64)
        near = distance[np.arange(len(ring)), nearest] < _SLANTED * spacing
        along[near] += side * (middle[nearest] - middle)[near]
    length = np.hypot(*along.T)
    known = length > 0.0
    middle, chord, along = middle[known], chord[known], along[known] / length[known, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    # A ring's share of the vane: the distance of the rings along the radius, on its slant.
    radial = np.abs((middle * along).sum(axis=1)) / np.hypot(*middle.T)
    return Vanes(middle, normal, spacing / np.maximum(radial, 1.0 / _SLANTED), np.abs((chord * normal).sum(axis=1)))


class _Lit:
    """Whether light of one direction [3] and wavelength [m] passes all apertures, by pupil coordinates [..., 2] [m]."""

    def __init__(self, telescope: Telescope, direction: np.ndarray, wavelength: float) -> None:
        self._telescope, self._direction, self._wavelength = telescope, direction[None], wavelength

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return which points are lit, shape [...]."""
        rays = launch_bundles(self._telescope, self._direction, self._wavelength, points.reshape(-1, 2))
        return np.asarray(trace(self._telescope, rays, threads=1).status == RayStatus.OK).reshape(points.shape[:-1])


def _divided(lit: Callable[[np.ndarray], np.ndarray], clear: np.ndarray, dark: np.ndarray) -> np.ndarray:
    """Return where light first ends between coordinates that are clear and dark [...]; ``lit`` takes such ones."""
    for _ in range(_DIVISIONS if clear.size else 0):
        part = (dark - clear) / _PARTS
        inner = clear + part * np.arange(1, _PARTS).reshape(-1, *[1] * clear.ndim)
        clear = clear + part * np.cumprod(lit(inner), axis=0).sum(axis=0)
        dark = clear + part
    return 0.5 * (clear + dark)


def _dark_runs(status: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ring, first and last number of the runs of dark points on rings [n_ring, n]; the last may pass n."""
    following = np.roll(status, -1, axis=1)
    ring, begin = np.nonzero(status & ~following)
    begin, last = begin + 1, np.nonzero(~status & following)[1]
    # A ring has as many first points as last ones; its first last point may be that of its last run.
    count = np.bincount(ring, minlength=len(status))
    first = (np.cumsum(count) - count)[ring]
    number = np.arange(len(ring)) - first + (last[first] < begin[first])
    return ring, begin, last[first + number % count[ring]] + status.shape[1] * (number // count[ring])
