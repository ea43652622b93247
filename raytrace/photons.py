"""Trace photons, each of its own direction, pupil point and wavelength, to the CCDs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from ..core.launch import launch
from ..core.warp_arrays import warp_array
from ..models.camera.focal_plane import FocalPlane
from ..models.media.medium import ConstantIndex
from ..models.telescope import Telescope
from .detector import land_bundle
from .ideal_lens import require_image
from .kernels.packet import from_packets, lane_flags, lanes, packet_count, ray_packets, to_packets
from .kernels.photons import trace_photons
from .launch import aimed_points
from .pack.surfaces import distinct_media, pack_surfaces
from .rays import RayStatus, require_distant_object


@dataclass(frozen=True)
class PhotonBeam:
    """Photons at the entrance pupil, from about one point of the sky.

    Attributes
    ----------
    offset : tuple of ndarray, shape [n] each
        Coordinates of each photon's direction about that point, in any unit.
    source : ndarray, shape [3, 3]
        Direction to the point, and its changes per unit along both coordinates, telescope frame; their sum need not be
        of unit length.
    pupil : tuple of ndarray, shape [n] each
        Entrance-pupil coordinates [m].
    wavelength : ndarray, shape [n]
        Vacuum wavelengths [m].
    """

    offset: tuple[np.ndarray, np.ndarray]
    source: np.ndarray
    pupil: tuple[np.ndarray, np.ndarray]
    wavelength: np.ndarray


@dataclass(frozen=True)
class LandedPhotons:
    """Photons at the detector, in its own frame.

    Attributes
    ----------
    x, y : ndarray, shape [n]
        Positions [m]; NaN where a ray has missed a surface.
    slope_x, slope_y : ndarray, shape [n]
        Slopes dx/dz, dy/dz along the travel, z into the detector.
    lit : ndarray of bool, shape [n]
        Photons that arrive, on a CCD where there are CCDs.
    """

    x: np.ndarray
    y: np.ndarray
    slope_x: np.ndarray
    slope_y: np.ndarray
    lit: np.ndarray


def land_photons(
    telescope: Telescope, beam: PhotonBeam, *, focal_plane: FocalPlane | None = None, threads: int | None = None
) -> LandedPhotons:
    """Trace photons to the last surface of a telescope, or to the CCDs of a focal plane.

    Where the design data ask for ray aiming, pupil coordinates are those of the stop: photons cross the plane of the
    entrance pupil where rays from the point of the sky do so at the default wavelength, to the same points of the stop.
    The result does not depend on the number of threads, all processors by default.

    Raises
    ------
    DomainError
        If the telescope does not cover a wavelength, or its object is at a finite distance.
    """
    require_distant_object(telescope)
    require_image(telescope, "a trace of photons")
    n = len(beam.wavelength)
    packed, count = pack_surfaces(telescope), packet_count(n)
    landing = wp.empty((6, count), dtype=lanes, device="cpu")
    statuses = wp.empty(count, dtype=lane_flags, device="cpu")
    light = -beam.source[:1] / np.linalg.norm(beam.source[0])
    points = aimed_points(telescope, light, telescope.default_wavelength, np.stack(beam.pupil, axis=-1))
    packets = [warp_array(to_packets(a), lanes) for a in (*beam.offset, *points.reshape(n, 2).T)]
    start = [warp_array(beam.source.ravel()), telescope.stop_z, telescope.launch_distance]
    indices = warp_array(to_packets(_media_indices(telescope, beam.wavelength)), lanes)
    inputs = [packed, indices, *packets, *start, ray_packets(), landing, statuses]
    launch(trace_photons.variant_for(packed), count, inputs, threads=threads)
    x, y, z, u, v, w = from_packets(landing, n)
    lit = from_packets(statuses, n) == RayStatus.OK
    if focal_plane is not None:
        detector = telescope.surfaces[-1]
        x, y, on_ccd = land_bundle(detector, focal_plane, (x, y, z), (u, v, w), threads=threads)
        lit &= on_ccd
    depth = np.abs(w)
    return LandedPhotons(x, y, u / depth, v / depth, lit)


def _media_indices(telescope: Telescope, wavelength: np.ndarray) -> np.ndarray:
    """Return the refractive index of each distinct medium at each wavelength [m], and these, [medium + 1, n]."""
    telescope.check_wavelength(wavelength)
    media = distinct_media(telescope)
    indices = np.empty((len(media) + 1, len(wavelength)))
    for row, medium in zip(indices, media, strict=False):
        row[:] = medium.n if isinstance(medium, ConstantIndex) else medium.index(wavelength)
    indices[-1] = wavelength
    return indices
