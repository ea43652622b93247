"""Rings and spokes over an annular pupil, and the clear part of each spoke."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import warp as wp

from ...core.launch import launch
from ...core.units import require_count
from ...core.warp_arrays import warp_array
from ...models.telescope import Telescope
from ...raytrace.kernels.surface_table import STOPPED
from ...raytrace.launch import launch_bundles
from ...raytrace.pack.surfaces import clear_annulus, pack_surfaces
from ...raytrace.rays import RayStatus, field_direction
from ...raytrace.trace import trace, trace_packets
from ..pupil_sampling import spiral_annulus
from .clear_pupil_kernels import find_edges, square_distances

# Spokes per ring: the phase of a blur varies some three times faster around the pupil than across its ring.
_SPOKES_PER_RING = 3.2
#: Most rings; more, of polynomials of a higher degree, add nothing.
MOST_RINGS = 12
#: Rays on a spoke that determine the rims of apertures, by parabolas.
EDGE_RINGS = 3
# Spokes to the area of a pupil that only discs and rings cut; 16 are good to 3e-4 at the edge of the LSST's field.
_AREA_SPOKES = 32
# Rays to that of others: good to 3e-3 (rms) behind the vanes of DECam and at the edge of HSC's field. Rows of a lattice
# would lie along vanes.
_AREA_RAYS = 1000
# Most stars whose rays are traced together.
_STARS = 64


@dataclass(frozen=True)
class SpokePupil:
    """Points on rings and spokes, with the rule that integrates over the pupil.

    Along each spoke this is Gauss-Lobatto quadrature in the square of the radius, in which area is even; it has points
    on both rims. Around, it is the trapezoidal rule. The number of spokes is a multiple of four, and they are symmetric
    about both axes and the diagonals.
    """

    radius: np.ndarray  #: rising radii of the rings, [n_ring] m
    fraction: np.ndarray  #: of the pupil's area within each ring, [n_ring]
    quadrature: np.ndarray  #: weights of the rings, of sum 1, [n_ring]
    unit: np.ndarray  #: directions of the spokes, [n_spoke, 2]

    @classmethod
    def fill(cls, diameter: float, obscuration: float, count: int, rings: int | None = None) -> SpokePupil:
        """Return approximately ``count`` points of an annulus of given diameter [m] and linear obscuration.

        They stand on so many rings, by default as far apart as the spokes are.
        """
        if rings is None:
            require_count(count, "n_pupil", 10)
        n_ring = rings or min(math.ceil(math.sqrt(count / _SPOKES_PER_RING)), MOST_RINGS)
        n_spoke = 4 * max(1, round(count / (4 * n_ring)))
        legendre = np.polynomial.legendre.Legendre.basis(n_ring - 1)
        node = np.concatenate([[-1.0], np.sort(legendre.deriv().roots().real), [1.0]])
        fraction = 0.5 * (node + 1.0)
        angle = 2.0 * math.pi * (np.arange(n_spoke) + 0.5) / n_spoke
        return cls(
            radius=0.5 * diameter * np.sqrt(obscuration**2 + (1.0 - obscuration**2) * fraction),
            fraction=fraction,
            quadrature=1.0 / (n_ring * (n_ring - 1) * legendre(node) ** 2),
            unit=np.stack([np.cos(angle), np.sin(angle)], axis=-1),
        )

    @property
    def area(self) -> float:
        """Area of the annulus [m^2]."""
        return float(math.pi * (self.radius[-1] ** 2 - self.radius[0] ** 2))

    @property
    def n_spoke(self) -> int:
        """Number of spokes."""
        return len(self.unit)

    @property
    def points(self) -> np.ndarray:
        """Pupil coordinates [m], shape [n_ring * n_spoke, 2], ring by ring."""
        return (self.radius[:, None, None] * self.unit).reshape(-1, 2)

    @property
    def inverse(self) -> np.ndarray:
        """One over the differences of the radii [1/m], shape [n_ring, n_ring]; 0 on the diagonal."""
        difference = self.radius[:, None] - self.radius
        return np.divide(1.0, difference, out=np.zeros_like(difference), where=difference != 0.0)


def lit_fractions(
    telescope: Telescope,
    direction: np.ndarray,
    wavelength: float,
    threads: int | None = None,
    *,
    rays: int | None = None,
) -> np.ndarray:
    """Return the parts of the area of the entrance pupil whose light passes all apertures, shape [n_star].

    ``direction`` [n_star, 3] is that of the light's travel; the wavelength [m] is that in vacuum. Of a number of rays
    of each star those that pass are counted; by default there are as many as make the parts good to a thousandth.
    """
    radius, obscuration = 0.5 * telescope.pupil_diameter, telescope.pupil_obscuration
    if rays is None and has_only_annuli(telescope):
        pupil = SpokePupil.fill(2.0 * radius, obscuration, 3 * _AREA_SPOKES, 3)
        return clear_areas(clear_edges(telescope, direction, pupil.unit, wavelength, threads)) / pupil.area
    points = spiral_annulus(radius, obscuration, _AREA_RAYS if rays is None else rays).points
    batches = (direction[first : first + _STARS] for first in range(0, len(direction), _STARS))
    return np.concatenate([lit_points(telescope, batch, wavelength, points, threads).mean(axis=1) for batch in batches])


def lit_points(
    telescope: Telescope, direction: np.ndarray, wavelength: float, points: np.ndarray, threads: int | None = None
) -> np.ndarray:
    """Return at which points of the entrance pupil [n_point, 2] light passes all apertures, [n_star, n_point] bool.

    Other arguments are those of :func:`lit_fractions`.
    """
    bundles = launch_bundles(telescope, direction, wavelength, points)
    return np.asarray(trace(telescope, bundles, threads=threads).status == RayStatus.OK).reshape(len(direction), -1)


def clear_areas(edges: np.ndarray) -> np.ndarray:
    """Return the areas between the edges of :func:`clear_edges` [m^2], shape [n_star]."""
    return np.asarray(math.pi * (edges[..., 1] ** 2 - edges[..., 0] ** 2).mean(axis=1))


def clear_edges(
    telescope: Telescope, direction: np.ndarray, unit: np.ndarray, wavelength: float, threads: int | None = None
) -> np.ndarray:
    """Return the radii of the entrance pupil between which light passes all apertures [m], shape [n_star, n_spoke, 2].

    Inner and outer radius are equal where a spoke is dark. On each spoke of direction ``unit`` [n_spoke, 2] the clear
    part is taken to be one piece, as where apertures are discs and rings about the light (:func:`has_only_annuli`);
    all other apertures are ignored. ``direction`` [n_star, 3] is that of the light's travel; the wavelength [m] is that
    in vacuum.
    """
    return edges_of(telescope, aperture_distances(telescope, direction, unit, wavelength, threads), len(unit), threads)


def aperture_distances(
    telescope: Telescope, direction: np.ndarray, unit: np.ndarray, wavelength: float, threads: int | None = None
) -> np.ndarray:
    """Return squared distances of rays from the centres of clear apertures [m^2], [n_star, n_stop, 3 n_spoke].

    The rays are those of :func:`clear_edges`, ring by ring, the apertures those of :func:`stopping_surfaces`.
    """
    points = (_edge_radius(telescope)[:, None, None] * unit).reshape(-1, 2)
    n_surface = len(telescope.surfaces)
    rays = launch_bundles(telescope, direction, wavelength, points)
    places = trace_packets(telescope, rays, n_surface, threads=threads).end.position
    stops = stopping_surfaces(telescope)
    squares = np.empty((len(direction), len(stops), len(points)))
    launch(
        square_distances,
        len(direction),
        [
            pack_surfaces(telescope),
            warp_array(stops, wp.int32),
            warp_array(places.numpy().reshape(n_surface, 3, -1), wp.float64),
            warp_array(squares, wp.float64),
        ],
        threads=threads,
    )
    return squares


def edges_of(telescope: Telescope, squares: np.ndarray, n_spoke: int, threads: int | None = None) -> np.ndarray:
    """Return the edges of :func:`clear_edges` from squares of :func:`aperture_distances`."""
    edges = np.empty((len(squares), n_spoke, 2))
    launch(
        find_edges,
        len(squares) * n_spoke,
        [
            pack_surfaces(telescope),
            warp_array(stopping_surfaces(telescope), wp.int32),
            warp_array(squares, wp.float64),
            warp_array(_edge_radius(telescope), wp.float64),
            n_spoke,
            warp_array(edges, wp.float64),
        ],
        threads=threads,
    )
    return edges


def stopping_surfaces(telescope: Telescope) -> np.ndarray:
    """Return the indices of surfaces that stop light by a disc or ring."""
    return np.flatnonzero(pack_surfaces(telescope).kinds.numpy()[:, STOPPED] == 1)


def _edge_radius(telescope: Telescope) -> np.ndarray:
    """Return the radii in the pupil of rays that determine the rims [m]."""
    outer = 0.5 * telescope.pupil_diameter
    return np.linspace(telescope.pupil_obscuration * outer, outer, EDGE_RINGS)


@lru_cache(maxsize=64)
def has_only_annuli(telescope: Telescope) -> bool:
    """Return whether all apertures are discs and rings about the light, without obstructions.

    The chief ray on the axis passes within each disc, and within the hole of each ring.
    """
    rings = [clear_annulus(s.aperture) for s in telescope.surfaces]
    if telescope.obstructions or any(ring is None for ring in rings):
        return False
    axis = field_direction(np.zeros(1), np.zeros(1))
    chief = launch_bundles(telescope, axis, telescope.default_wavelength, np.zeros((1, 2)))
    ends = trace(telescope, chief, "all", threads=1)
    for surface, end, (x, y, inner, outer) in zip(telescope.surfaces, ends, filter(None, rings), strict=True):
        place = surface.to_local(end.position)[0]
        # A chief ray that misses a surface has no place there.
        if np.hypot(place[0] - x, place[1] - y) > (inner or outer):
            return False
    return True
