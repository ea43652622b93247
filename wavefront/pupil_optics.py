"""Landing points and optical paths of many stars through given points of the entrance pupil.

This is the optical part of every PSF: the fast and the long-exposure engine use the landing points, the wave engine the
paths. The kernel returns these few numbers, so that memory does not hold the rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.launch import launch
from ..core.warp_arrays import warp_array
from ..models.camera.focal_plane import FocalPlane
from ..models.telescope import Telescope
from ..raytrace.ideal_lens import require_image
from ..raytrace.kernels.packet import LANES, lane_flags, lanes, packet_count, ray_packets, to_packets
from ..raytrace.kernels.pupil import trace_pupils as trace_pupils_kernel
from ..raytrace.pack.surfaces import indices_and_wavelength, pack_surfaces
from ..raytrace.rays import Projection, RayStatus, require_distant_object
from ..raytrace.trace import trace
from .aberration import ResidualWavefront
from .chief_rays import image_jacobians, reference_rays
from .exit_pupil_path import ExitPupil
from .pupil_sampling import CHIEF_RAY
from .reference_sphere import path_to_sphere
from .request import Request

# Attributes of each star.
_OF_STARS = (
    "displacement",
    "path",
    "lit",
    "exit_pupil_path",
    "jacobian",
    "reference_points",
    "reference_cosines",
    "fields",
)


@dataclass(frozen=True)
class PupilOptics:
    """Landing points and optical paths through given points of the entrance pupil.

    The reference points are the centres of the reference spheres, where the chief rays of the middle wavelength meet
    the CCDs. All wavelengths share them, so lateral colour stays in path and displacement.
    """

    pupil: np.ndarray  #: [n_pupil, 2] m, entrance-pupil coordinates
    #: [n_star, n_wave, n_pupil, 2] m, float32: landing point on the CCD minus reference point, x and y of the detector
    displacement: np.ndarray
    #: [n_star, n_wave, n_pupil] m: path to the reference sphere minus that of the chief ray, the negative of the OPD
    path: np.ndarray
    lit: np.ndarray  #: [n_star, n_wave, n_pupil] bool
    jacobian: np.ndarray  #: [n_star, 2, 2] m/rad: detector position by direction cosines of the incoming light
    reference_points: np.ndarray  #: [n_star, 3] m, telescope frame
    reference_cosines: np.ndarray  #: [n_star, 2] direction cosines of the chief rays along x and y of the detector
    fields: np.ndarray  #: [n_star, 2] rad
    wavelengths: np.ndarray  #: [n_wave] m, in vacuum
    #: [n_star, n_wave, n_pupil] m: path to spheres through the exit pupil minus that of the chief ray, if it is wanted.
    #: Its gradient along the pupil is the inverse of the Jacobian times the displacement, out of focus too: waves of
    #: this phase land where rays do.
    exit_pupil_path: np.ndarray | None = None

    def star(self, index: int) -> PupilOptics:
        """Return the optics of one of the stars."""
        return self.stars(slice(index, index + 1))

    def stars(self, index: slice | np.ndarray) -> PupilOptics:
        """Return the optics of some of the stars."""
        arrays: dict[str, Any] = {name: getattr(self, name)[index] for name in self._of_stars}
        return replace(self, **arrays)

    @classmethod
    def together(cls, parts: Sequence[PupilOptics]) -> PupilOptics:
        """Return the optics of the stars of all parts, of one pupil and the same wavelengths."""
        names = parts[0]._of_stars
        arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return replace(parts[0], **arrays)

    @property
    def _of_stars(self) -> list[str]:
        return [name for name in _OF_STARS if getattr(self, name) is not None]

    @property
    def exit_cosines(self) -> np.ndarray:
        """Direction cosines of the light at the image along x and y of the detector, shape [n_star, n_pupil, 2].

        From pupil coordinates and Jacobians, good to 1e-4 under the sine condition (:doc:`conventions`).
        """
        return self.reference_cosines[:, None] - self.pupil @ np.linalg.inv(self.jacobian)


def trace_pupils(
    telescope: Telescope,
    fields: ArrayLike,
    wavelengths: ArrayLike,
    pupil: np.ndarray,
    *,
    focal_plane: FocalPlane | None = None,
    aberration: ResidualWavefront | None = None,
    vignetting: np.ndarray | None = None,
    projection: Projection = "zemax",
    threads: int | None = None,
    exit_pupil: bool = False,
) -> PupilOptics:
    """Trace the same pupil points for many stars at several wavelengths to the CCD of each star.

    Other arguments than the pupil points [n_pupil, 2] [m] and the vignetting factors of the stars [n_star, 5] are those
    of :meth:`pachon.Request.of`.
    Each CCD, or the nominal surface, is taken as its tangent plane at the reference point: over the blur of a star,
    some 50 um, a potato chip of two cycles deviates from it by less than 0.2 nm. An aberration is added to the traced
    wavefront; reference points and zero of the path stay those of the telescope without it.

    Raises
    ------
    DomainError
        If a field or wavelength lies outside what the telescope covers, the object is at a finite distance, or a chief
        ray does not reach the image or lands between two CCDs.
    """
    request = Request.of(telescope, fields, wavelengths, sampling=CHIEF_RAY, projection=projection, threads=threads)
    request = replace(request, vignetting=vignetting)
    require_distant_object(telescope)
    require_image(telescope, "a PSF")
    direction, waves = request.directions, request.wavelengths
    pupil = np.asarray(pupil, dtype=np.float64)
    n_star, n_wave, n_pupil = len(direction), len(waves), len(pupil)
    light = np.array([indices_and_wavelength(telescope, w) for w in waves])

    chief = reference_rays(request, request.middle, focal_plane)
    reference_points = np.array(chief.position)
    on_detector = telescope.surfaces[-1].to_local(reference_points)
    slopes = np.stack(telescope.surfaces[-1].shape.gradient(*on_detector[:, :2].T), axis=-1)
    if focal_plane is not None and chief.ccd is not None:
        place = focal_plane.camera.to_local(chief.ccd, on_detector[:, 0], on_detector[:, 1])
        slopes = slopes + focal_plane.slopes_on(chief.ccd, *place)
    normal = np.column_stack([-slopes, np.ones(n_star)])
    rotation = telescope.surfaces[-1].matrix
    normal = normal @ rotation.T

    radius = telescope.reference_sphere_radius
    chief_path = np.empty((n_star, n_wave))
    for w, index in enumerate(light[:, -3]):
        end = trace(telescope, request.launch(float(waves[w]), np.zeros((1, 2))), threads=threads)
        chief_path[:, w] = path_to_sphere(end.path_length, index, end.position, end.direction, reference_points, radius)

    packed, count = pack_surfaces(telescope), packet_count(n_pupil)
    axes = np.tile(rotation[:, :2].T.ravel(), (n_star, 1))
    planes = np.concatenate([reference_points, normal, axes], axis=1)

    def traced(stars: slice, waves: np.ndarray, points: np.ndarray) -> list[np.ndarray]:
        """Trace the same points [m] for some stars and wavelengths, by index: x, y, path and status."""
        bundles = len(direction[stars]) * len(waves)
        kinds = (lanes, lanes, lanes, lane_flags)
        out = [wp.empty((bundles, count), dtype=kind, device="cpu") for kind in kinds]
        launch(
            trace_pupils_kernel.variant_for(packed),
            bundles * count,
            [
                packed,
                count,
                warp_array(light),
                warp_array(np.tile(waves, len(direction[stars])), wp.int32),
                warp_array(np.repeat(direction[stars], len(waves), axis=0)),
                warp_array(to_packets(points.T), lanes),
                float(telescope.stop_z),
                float(telescope.launch_distance),
                warp_array(np.repeat(planes[stars], len(waves), axis=0)),
                float(radius),
                ray_packets(),
                *out,
            ],
            threads=threads,
        )
        return [values.numpy().reshape(-1, len(waves), count * LANES)[:, :, :n_pupil] for values in out]

    aimed = [request.entrance_points(float(w), pupil) for w in waves]
    if aimed[0].ndim == 2:
        x, y, traced_path, status = traced(slice(None), np.arange(n_wave), aimed[0])
    else:
        # Every star has pupil points of its own.
        pieces = [
            [traced(slice(s, s + 1), np.array([w]), points[s]) for w, points in enumerate(aimed)] for s in range(n_star)
        ]
        x, y, traced_path, status = (
            np.concatenate([np.concatenate([outputs[k] for outputs in star], axis=1) for star in pieces])
            for k in range(4)
        )
    offset = np.stack([x, y], axis=-1)
    path = traced_path - chief_path[:, :, None]
    index = float(light[request.middle_index, -3])
    jacobian = image_jacobians(telescope, direction, request.middle, threads)
    exit_pupil_path = None
    if exit_pupil:
        exit_pupil_path = ExitPupil(request, index, chief, slopes, jacobian).path(pupil, path, offset)
    if aberration is not None:
        # The path is minus the OPD; light is displaced by the Jacobian times the gradient of the path, as by a screen.
        x, y = pupil.T
        opd = aberration.opd(x, y, request.slopes)[:, None]
        path -= opd
        if exit_pupil_path is not None:
            exit_pupil_path -= opd
        gradient = aberration.gradient(x, y, request.slopes)
        offset -= np.einsum("sij,spj->spi", jacobian, gradient)[:, None]
    return PupilOptics(
        pupil=pupil,
        displacement=offset.astype(np.float32),
        path=path,
        lit=status == RayStatus.OK,
        jacobian=jacobian,
        reference_points=reference_points,
        reference_cosines=(chief.direction @ rotation)[:, :2],
        fields=request.fields,
        wavelengths=waves,
        exit_pupil_path=exit_pupil_path,
    )
