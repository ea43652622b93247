"""Pupil optics: landing points and optical paths of many stars through given points of the entrance pupil.

This is the optical part of every PSF. The fast and the long-exposure engine use the landing points, the wave engine the
paths. The kernel keeps these few numbers alone, so memory does not hold the rays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.launch import launch
from ..core.units import metres, radians
from ..core.warp_arrays import warp_array
from ..models.camera.focal_plane import FocalPlane
from ..models.telescope import Telescope
from ..raytrace.kernels.packet import lane_flags, lanes, packet_count, ray_packets, to_packets
from ..raytrace.kernels.pupil import trace_pupils as trace_pupils_kernel
from ..raytrace.pack.surfaces import pack_surfaces, refractive_indices
from ..raytrace.rays import RayStatus, field_direction
from .aberration import ResidualWavefront
from .chief_rays import chief_rays, image_jacobians, reference_rays
from .reference_sphere import path_to_sphere


@dataclass(frozen=True)
class PupilOptics:
    """Landing points and optical paths through given points of the entrance pupil.

    Attributes
    ----------
    pupil : ndarray, shape [n_pupil, 2]
        Entrance-pupil coordinates [m].
    displacement : ndarray of float32, shape [n_star, n_wave, n_pupil, 2]
        Landing point on the CCD minus the star's reference point [m], x and y of the detector.
    path : ndarray, shape [n_star, n_wave, n_pupil]
        Optical path to the reference sphere minus the chief ray's [m]; the negative of the OPD.
    lit : ndarray of bool, shape [n_star, n_wave, n_pupil]
        Where light passes.
    jacobian : ndarray, shape [n_star, 2, 2]
        Change of position on the detector per change of the direction cosines of the incoming light [m/rad].
    reference_points : ndarray, shape [n_star, 3]
        Centres of the reference spheres: where the chief ray of the middle wavelength meets the CCD, telescope frame
        [m]. All wavelengths share it, so lateral colour stays in path and displacement.
    fields : ndarray, shape [n_star, 2]
        Field angles [rad].
    wavelengths : ndarray, shape [n_wave]
        Vacuum wavelengths [m].
    """

    pupil: np.ndarray
    displacement: np.ndarray
    path: np.ndarray
    lit: np.ndarray
    jacobian: np.ndarray
    reference_points: np.ndarray
    fields: np.ndarray
    wavelengths: np.ndarray


def trace_pupils(
    telescope: Telescope,
    fields: ArrayLike,
    wavelengths: ArrayLike,
    pupil: np.ndarray,
    *,
    focal_plane: FocalPlane | None = None,
    aberration: ResidualWavefront | None = None,
    projection: str = "zemax",
    threads: int | None = None,
) -> PupilOptics:
    """Trace the same pupil points for many stars at several wavelengths to the CCD of each star.

    Parameters
    ----------
    telescope, fields, wavelengths, projection, threads
        As in :meth:`pachon.Request.of`; the reference points belong to the middle wavelength.
    pupil : ndarray, shape [n_pupil, 2]
        Entrance-pupil coordinates [m].
    focal_plane : FocalPlane, optional
        CCD heights; each star's CCD is taken as its tangent plane at the reference point (over the blur of a star,
        some 50 um, a potato chip of two cycles deviates from it by less than 0.2 nm).
    aberration : ResidualWavefront, optional
        Added to the traced wavefront; reference points and zero of the path stay those of the telescope without it.

    Raises
    ------
    DomainError
        If a field or wavelength lies outside what the telescope covers, the object is at a finite distance, or a chief
        ray does not reach the image or lands between two CCDs.
    """
    stars = np.atleast_2d(radians(fields, "fields"))
    waves = np.atleast_1d(metres(wavelengths, "wavelengths"))
    pupil = np.asarray(pupil, dtype=np.float64)
    n_star, n_wave, n_pupil = len(stars), len(waves), len(pupil)
    telescope.check_field(stars[:, 0], stars[:, 1])
    direction = field_direction(stars[:, 0], stars[:, 1], projection)
    indices = np.array([refractive_indices(telescope, w) for w in waves])
    middle = float(waves[n_wave // 2])

    chief = reference_rays(telescope, stars, direction, middle, focal_plane, threads)
    reference_points = np.array(chief.position)
    normal = np.zeros((n_star, 3))
    normal[:, 2] = 1.0
    if focal_plane is not None and chief.ccd is not None:
        on_detector = telescope.surfaces[-1].to_local(reference_points)
        offset = on_detector[:, :2] - focal_plane.camera.centers[chief.ccd]
        normal[:, :2] = -focal_plane.surfaces.gradient(chief.ccd, offset[:, 0], offset[:, 1])
    rotation = telescope.surfaces[-1].matrix
    normal = normal @ rotation.T

    radius = telescope.reference_sphere_radius
    chief_path = np.empty((n_star, n_wave))
    for w in range(n_wave):
        end = chief_rays(telescope, direction, float(waves[w]), None, threads)
        index = indices[w, -2]
        chief_path[:, w] = path_to_sphere(end.path_length, index, end.position, end.direction, reference_points, radius)

    count, bundles = packet_count(n_pupil), n_star * n_wave
    kinds = (lanes, lanes, lanes, lane_flags)
    out_x, out_y, out_path, out_status = (wp.empty((bundles, count), dtype=kind, device="cpu") for kind in kinds)
    packed = pack_surfaces(telescope)
    launch(
        trace_pupils_kernel.suited(packed),
        bundles * count,
        [
            packed,
            count,
            warp_array(indices),
            warp_array(np.tile(np.arange(n_wave), n_star), wp.int32),
            warp_array(np.repeat(direction, n_wave, axis=0)),
            warp_array(to_packets(pupil.T), lanes),
            float(telescope.stop_z),
            float(telescope.launch_distance),
            warp_array(np.repeat(np.concatenate([reference_points, normal], axis=1), n_wave, axis=0)),
            float(radius),
            ray_packets(),
            *(out_x, out_y, out_path, out_status),
        ],
        threads=threads,
    )

    def trimmed(values: wp.array) -> np.ndarray:
        return values.numpy().reshape(n_star, n_wave, -1)[:, :, :n_pupil]

    offset = np.stack([trimmed(out_x), trimmed(out_y)], axis=-1)
    if not np.array_equal(rotation, np.eye(3)):
        # The detector's own x and y; the third component, along its normal, is the tilt of a CCD times micrometres.
        offset = offset @ rotation[:2, :2]
    path = trimmed(out_path) - chief_path[:, :, None]
    jacobian = image_jacobians(telescope, direction, middle, threads)
    if aberration is not None:
        # The path is minus the OPD; light is displaced by the Jacobian times the gradient of the path, as by a screen.
        slopes = direction[:, :2] / -direction[:, 2:]
        x, y = pupil.T
        path -= aberration.opd(x, y, slopes)[:, None]
        along_x, along_y = np.moveaxis(aberration.gradient(x, y, slopes), -1, 0)
        for axis in range(2):
            shift = jacobian[:, axis, 0, None] * along_x + jacobian[:, axis, 1, None] * along_y
            offset[..., axis] -= shift[:, None]
    return PupilOptics(
        pupil=pupil,
        displacement=offset.astype(np.float32),
        path=path,
        lit=trimmed(out_status) == RayStatus.OK,
        jacobian=jacobian,
        reference_points=reference_points,
        fields=stars,
        wavelengths=waves,
    )
