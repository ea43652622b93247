"""Cells of the entrance pupil: lit areas and centroids of the squares of a lattice.

A cell stands for its lit part by area, centroid and second moments. Its image is blurred by the image of a cell of mean
magnification, the footprint, which one transfer function holds; what its second moments have beyond that, on rims and
where the magnification is another, is its spread. Cells then cover the image of the lit pupil without gaps or overlap,
but for the third moments of cells on rims.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter
from scipy.sparse import csr_array

from ..models.telescope import Telescope
from ..raytrace.launch import aimed_points
from ..raytrace.rays import RayStatus, parallel_rays
from ..raytrace.trace import trace
from ..wavefront.pupil_polynomials import PupilPolynomials
from .rim_outlines import Simple, is_vane, simple_regions, vane_width, widened

#: Side of the lattice over the diameter of the pupil: light off the axis may cross the plane of the stop just outside.
_MARGIN = 1.02
#: Chords of a cell on a rim, and divisions of the piece between two nodes that has a rim: they find it to a 500th of a
#: cell. Of the small cells of a lattice with so many across the pupil, fewer are as fine.
_CHORDS = 8
_DIVISIONS = 3
_CHORDS_OF_SMALL = 4
_DIVISIONS_OF_SMALL = 2
_SMALL = 120
#: Nodes along each chord, and most of them where vanes are narrower than their distance.
_NODES = 5
_MOST_NODES = 33
#: Pieces that each division makes.
_PARTS = 4
#: Points along each side of the lattice whose light says where vanes stand on the pupil.
_SURVEY = 13
#: Least number of points that determine places on a surface as smooth functions of the pupil.
FEWEST = 90
#: Distance from where a smooth map of the lit rays has it, over the width of their light, of a ray that is astray.
_ASTRAY = 5e-3
#: Points of the rim that the width of an aimed beam is taken from.
_RIM = 48


@dataclass(frozen=True)
class PupilCells:
    """Lit cells of the entrance pupil for one direction of the light.

    Attributes
    ----------
    points : ndarray, shape [n, 2]
        Centroids of the lit parts [m], in the plane of the entrance pupil.
    weights : ndarray, shape [n]
        Fractions of the light; they sum to 1. Empty where no light passes.
    moments : ndarray, shape [n, 2, 2]
        Second moments of the lit parts about their centroids [m^2].
    side : float
        Side of a cell [m].
    center : ndarray, shape [2]
        Middle of the lattice [m].
    rates : ndarray, shape [n, n_shift], optional
        Derivatives of the weights by shifts of rims [1/m]; cells of zero weight may have them.
    area : float
        Lit area, in areas of a cell.
    """

    points: np.ndarray
    weights: np.ndarray
    moments: np.ndarray
    side: float
    center: np.ndarray
    rates: np.ndarray | None = None
    area: float = 1.0

    def __len__(self) -> int:
        return len(self.weights)

    def at_wavelengths(self, fractions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return weights [n_wave * n] and their rates [n_wave * n, n_shift] at wavelengths of fractions of the light.

        Wavelength by wavelength; without `rates` there are no shifts.
        """
        rates = np.zeros((len(self), 0)) if self.rates is None else self.rates
        return np.outer(fractions, self.weights).ravel(), np.kron(fractions[:, None], rates)

    def merging(self) -> csr_array:
        """Return the means over squares of two by two cells by their light, a sparse matrix [n_merged, n].

        Cells without light stay by themselves, after all others.
        """
        place = np.floor((self.points - self.center) / (2.0 * self.side)).astype(np.int64)
        place -= place.min(axis=0, initial=0)
        _, group = np.unique(place[:, 0] * (int(place[:, 1].max(initial=0)) + 1) + place[:, 1], return_inverse=True)
        dark = self.weights == 0.0
        group[dark] = int(group.max(initial=-1)) + 1 + np.arange(dark.sum())
        _, group = np.unique(group, return_inverse=True)
        light = np.bincount(group, weights=self.weights)
        parts = np.where(dark, 1.0, self.weights / np.where(dark, 1.0, light[group]))
        return csr_array((parts, (group, np.arange(len(group)))), shape=(len(light), len(group)))

    def merged(self, merging: csr_array) -> PupilCells:
        """Return the cells merged by a matrix of :meth:`merging`."""
        points, own_points = merging @ self.points, self.points
        squares = self.moments + own_points[:, :, None] * own_points[:, None, :]
        moments = (merging @ squares.reshape(-1, 4)).reshape(-1, 2, 2) - points[:, :, None] * points[:, None, :]
        sums = merging.copy()
        sums.data[:] = 1.0
        rates = None if self.rates is None else sums @ self.rates
        return PupilCells(
            points, sums @ self.weights, moments, 2.0 * self.side, self.center, rates, area=0.25 * self.area
        )

    @cached_property
    def smooth(self) -> PupilPolynomials:
        """Polynomials through values at the points."""
        return PupilPolynomials(self.points, self.center, self.side)

    def release(self) -> None:
        """Free the polynomials; they are made again when they are needed."""
        self.__dict__.pop("smooth", None)

    def magnification(self, landing: np.ndarray) -> np.ndarray:
        """Return the derivative of landing points [n, 2] along the pupil, shape [n, 2, 2], by smooth polynomials."""
        return self.smooth.derivatives(landing)

    def footprint(self, landing: np.ndarray) -> np.ndarray:
        """Return the sides of the mean image of a cell [m], columns of a matrix [2, 2], from landing points [n, 2]."""
        return self.side * np.tensordot(self.weights, self.magnification(landing), axes=1)

    def spread(self, landing: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Return second moments of the images of the cells minus those of a footprint [m^2], shape [n, 2, 2]."""
        return moments_beyond(footprint, self.magnification(landing), self.moments)


def moments_beyond(footprint: np.ndarray, magnification: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Return second moments [m^2] of images by those on the pupil, minus those of a footprint, all [n, 2, 2]."""
    # Component by component: products of many matrices of two by two take ten times as long.
    (xx, xy), (yx, yy) = np.moveaxis(magnification, 0, -1)
    (uu, uv), (_, vv) = np.moveaxis(moments, 0, -1)
    across = xx * (yx * uu + yy * uv) + xy * (yx * uv + yy * vv)
    along = xx * (xx * uu + 2.0 * xy * uv) + xy * xy * vv, yx * (yx * uu + 2.0 * yy * uv) + yy * yy * vv
    image = np.array([[along[0], across], [across, along[1]]])
    return np.asarray(np.moveaxis(image, -1, 0) - footprint @ footprint.T / 12.0)


def pupil_cells(telescope: Telescope, direction: np.ndarray, wavelength: float, across: int) -> PupilCells:
    """Return the lit cells of a lattice with so many cells across the beam, for light of one direction [3].

    They are cells of the plane of the entrance pupil, on which the light of a star is even; where rays are aimed at the
    stop the lattice covers the light that fills it.
    """
    center, width = _beam(telescope, direction, wavelength)
    side = _MARGIN * width / across
    middle = (np.arange(across) - 0.5 * (across - 1)) * side

    def lit(points: np.ndarray) -> np.ndarray:
        """Return which rays through points [..., 2] pass all apertures."""
        rays = parallel_rays(telescope, direction[None], wavelength, points.reshape(-1, 2))
        return (trace(telescope, rays, threads=1).status == RayStatus.OK).reshape(points.shape[:-1])

    centers = np.stack(np.meshgrid(middle, middle), axis=-1) + center
    # Four points of each cell; a rim passes cells where these or those next to them differ.
    along = (np.arange(2 * across) - 0.5 * (2 * across - 1)) * 0.5 * side
    lattice = np.stack(np.meshgrid(along, along), axis=-1) + center
    # Thin shadows may lie between the points of half a lattice, and those of vanes between all of them.
    regions = {i: list(filter(is_vane, simple_regions(s.aperture))) for i, s in enumerate(telescope.surfaces)}
    vanes = {surface: of_surface for surface, of_surface in regions.items() if of_surface}
    thin = bool(telescope.obstructions or vanes)
    status = lit(lattice) if thin else lit_lattice(lit, lattice)
    differ = maximum_filter(status, 3, mode="constant") != minimum_filter(status, 3, mode="constant")
    quarters = (across, 2, across, 2)
    area, rim = status.reshape(quarters).mean(axis=(1, 3)), differ.reshape(quarters).any(axis=(1, 3))
    crossed, narrowest = np.zeros_like(rim), math.inf
    if vanes:
        crossed, narrowest = _crossed(telescope, direction, wavelength, vanes, centers, side)
    moments = np.tile(side**2 / 12.0 * np.eye(2), (across, across, 1, 1))
    # Nodes no farther from each other than vanes are wide.
    nodes_of_vanes = int(np.clip(math.ceil(side / narrowest) + 1, _NODES, _MOST_NODES))
    smooth = uniform_filter(area, 3, mode="constant")
    down, across_rim = np.gradient(smooth)
    fineness = (_CHORDS_OF_SMALL, _DIVISIONS_OF_SMALL) if across > _SMALL else (_CHORDS, _DIVISIONS)
    for cells, nodes in ((rim & ~crossed, _NODES), (crossed, nodes_of_vanes)):
        if cells.any():
            upright = np.abs(down[cells]) > np.abs(across_rim[cells])
            area[cells], offset, moments[cells] = _lit_parts(lit, centers[cells], side, upright, nodes, *fineness)
            centers[cells] += offset
    lit_cells = area > 0.0
    total = max(float(area.sum()), 1e-300)
    weights = area[lit_cells] / total
    return PupilCells(centers[lit_cells], weights, moments[lit_cells], side, center, area=total)


def _crossed(
    telescope: Telescope,
    direction: np.ndarray,
    wavelength: float,
    vanes: Mapping[int, Sequence[Simple]],
    centers: np.ndarray,
    side: float,
) -> tuple[np.ndarray, float]:
    """Return which cells of a lattice the shadows of vanes cross [n, n], and the width of the narrowest one [m].

    Centres of the cells are of shape [n, n, 2]; vanes go by the numbers of their surfaces.
    """
    places = centers.reshape(-1, 2)
    along = np.linspace(places[0], places[-1], _SURVEY)
    survey = np.stack(np.meshgrid(*along.T), axis=-1).reshape(-1, 2)
    ends = trace(telescope, parallel_rays(telescope, direction[None], wavelength, survey), "all", threads=1)
    crossed, narrowest = np.zeros(len(places), dtype=bool), math.inf
    pupil = PupilSurvey(survey, ends[-1].status == RayStatus.OK, 0.5 * (places[0] + places[-1]), side)
    for surface, regions in vanes.items():
        landing = telescope.surfaces[surface].to_local(ends[surface].position)[:, :2]
        met = pupil.near_smooth_map(landing)
        if not met.any():
            continue
        smooth = pupil.smooth(met)
        x, y = smooth.at(places, landing[met])[0].T
        largest = float(np.linalg.svd(smooth.derivatives(landing[met]), compute_uv=False).max())
        for region in regions:
            crossed |= widened(region, math.sqrt(2.0) * side * largest).contains(x, y)
            narrowest = min(narrowest, vane_width(region) / largest)
    return crossed.reshape(centers.shape[:-1]), narrowest


class PupilSurvey:
    """Places on surfaces of rays through points of the pupil, as smooth functions of these.

    Parameters
    ----------
    points : ndarray, shape [n, 2]
        Points of the plane of the entrance pupil [m].
    lit : ndarray of bool, shape [n]
        Which of their rays pass all apertures.
    center, least
        Those of :class:`~pachon.wavefront.pupil_polynomials.PupilPolynomials`.
    """

    def __init__(self, points: np.ndarray, lit: np.ndarray, center: np.ndarray, least: float) -> None:
        self.points, self._lit = points, lit
        self._center, self._least = center, least
        self._polynomials: dict[bytes, PupilPolynomials] = {}

    def smooth(self, rays: np.ndarray) -> PupilPolynomials:
        """Return polynomials through values at the points of some rays, which are the same for many surfaces."""
        key = rays.tobytes()
        if key not in self._polynomials:
            self._polynomials[key] = PupilPolynomials(self.points[rays], self._center, self._least)
        return self._polynomials[key]

    def near_smooth_map(self, places: np.ndarray) -> np.ndarray:
        """Return which rays meet a surface where a smooth map of the lit ones has them, or nearly, [n].

        Rays that were stopped may pass later lenses far outside of what is ground. Places on the surface [n, 2] are NaN
        where rays miss it. All that meet it where few are lit.
        """
        met = np.isfinite(places).all(axis=1)
        lit = self._lit & met
        if (met.all() and lit.all()) or lit.sum() < FEWEST:
            return met
        expected = self.smooth(lit).at(self.points[met], places[lit])[0]
        met[met] = np.hypot(*(places[met] - expected).T) < _ASTRAY * float(np.ptp(places[lit], axis=0).max())
        return met


def _beam(telescope: Telescope, direction: np.ndarray, wavelength: float) -> tuple[np.ndarray, float]:
    """Return middle [2] and width [m] of the light of one direction in the plane of the entrance pupil."""
    angle = 2.0 * np.pi * np.arange(_RIM) / _RIM
    rim = 0.5 * telescope.pupil_diameter * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points = aimed_points(telescope, direction[None], wavelength, rim)
    if points.ndim == 2:
        return np.zeros(2), telescope.pupil_diameter
    low, high = np.nanmin(points[0], axis=0), np.nanmax(points[0], axis=0)
    return 0.5 * (low + high), float((high - low).max())


def lit_lattice(lit: Callable[[np.ndarray], np.ndarray], points: np.ndarray) -> np.ndarray:
    """Return which points of a lattice [n, n, 2] are lit; of a fine one a quarter, and those by rims, are traced."""
    if len(points) <= 2 * _SMALL:
        return lit(points)
    # Points have the status of those that are traced unless others near have another one.
    status = np.repeat(np.repeat(lit(points[::2, ::2]), 2, axis=0), 2, axis=1)
    near = maximum_filter(status, 7, mode="constant") != minimum_filter(status, 7, mode="constant")
    status[near] = lit(points[near])
    return status


def _lit_parts(
    lit: Callable[[np.ndarray], np.ndarray],
    centers: np.ndarray,
    side: float,
    upright: np.ndarray,
    nodes: int,
    chords: int,
    divisions: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return lit fractions [n], centroids from the centre [n, 2] and second moments [n, 2, 2], by chords.

    Chords run along x, or along y where ``upright``, across the rim. Rims on them are found between nodes of different
    status.
    """
    node = side * np.linspace(-0.5, 0.5, nodes)
    row = side * ((np.arange(chords) + 0.5) / chords - 0.5)

    def places(along: np.ndarray, across: np.ndarray, cell: np.ndarray) -> np.ndarray:
        offset = np.stack(np.broadcast_arrays(along, across), axis=-1)
        turned = upright[cell].reshape(-1, *[1] * (offset.ndim - 1))
        return centers[cell].reshape(-1, *[1] * (offset.ndim - 2), 2) + np.where(turned, offset[..., ::-1], offset)

    indices = np.arange(len(centers))
    across = np.broadcast_to(row[:, None], (len(centers), chords, nodes))
    status = lit(places(np.broadcast_to(node, across.shape), across, indices))
    start, end = np.broadcast_to(node[:-1], (len(centers), chords, nodes - 1)), node[1:]
    low, high = start * np.ones(1), end * np.ones(start.shape)
    cell, chord, piece = np.nonzero(status[:, :, 1:] != status[:, :, :-1])
    first, last, begins = node[piece], node[piece + 1], status[cell, chord, piece]
    for _ in range(divisions):
        step = (last - first) / _PARTS
        inner = first[:, None] + step[:, None] * np.arange(1, _PARTS)
        # Parts before the first change of status; of several rims, the first.
        same = lit(places(inner, row[chord][:, None], cell)) == begins[:, None]
        first = first + step * np.cumprod(same, axis=1).sum(axis=1)
        last = first + step
    rim = 0.5 * (first + last)
    low[cell, chord, piece] = np.where(begins, low[cell, chord, piece], rim)
    high[cell, chord, piece] = np.where(begins, rim, high[cell, chord, piece])
    length = np.where(status[:, :, 1:] | status[:, :, :-1], high - low, 0.0)
    middles, rows = 0.5 * (low + high), row[:, None]
    total = length.sum(axis=(1, 2))

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray((length * values).sum(axis=(1, 2)) / np.where(total > 0.0, total, 1.0))

    u, v = mean(middles), mean(rows)
    uu = mean(middles**2 + length**2 / 12.0) - u * u
    vv = mean(rows**2 + (side / chords) ** 2 / 12.0) - v * v
    uv = mean(middles * rows) - u * v
    moments = np.stack([np.stack([uu, uv], axis=-1), np.stack([uv, vv], axis=-1)], axis=-1)
    offset = np.stack([u, v], axis=-1)
    turned = upright[:, None]
    return (
        total / (side * chords),
        np.where(turned, offset[:, ::-1], offset),
        np.where(turned[:, :, None], moments[:, ::-1, ::-1], moments),
    )
