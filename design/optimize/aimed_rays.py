"""Rays that are aimed at the stop of a telescope, and their derivatives while the stop and what is before it change.

A ray meets the stop at a given point of it, in units of its radius. Where it crosses the plane of the entrance pupil
therefore moves with the parameters by ``dq = S_q^-1 (dt - S_p)``: ``S_q`` and ``S_p`` are the derivatives of the point
at which a ray meets the stop by the crossing point and by the parameters, ``dt`` the motion of the point aimed at.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cached_property

import numpy as np

from ...models.paraxial import stop_is_inside, with_moved_pupil
from ...models.telescope import Telescope
from ...raytrace.adjoint.adjoint_matrix import column_table
from ...raytrace.adjoint.backward_pass import OutputGradient, backward_pass, landing_gradient
from ...raytrace.adjoint.forward_pass import ForwardPass, forward_pass
from ...raytrace.aiming import Stop, entrance_points, stop_of
from ...raytrace.landing import determinants
from ...raytrace.rays import Rays, field_direction, straight_bundles
from ...wavefront.request import Request
from .jacobian import ParameterColumns

#: Height of rays near the axis, in units of the radius of the entrance pupil.
_PARAXIAL = 1e-3


class AimedRays:
    """Rays of a request through pupil points, of the telescope of some columns, and their derivatives.

    The pupil points [m] are [n_pupil, 2]; the request gives the field points with their vignetting factors.
    """

    def __init__(self, columns: ParameterColumns, request: Request, wavelength: float, pupil: np.ndarray) -> None:
        telescope = columns.telescope
        moved_request = request if telescope is request.telescope else replace(request, telescope=telescope)
        #: Points of the plane of the entrance pupil [m], [n_pupil, 2] or [n_field, n_pupil, 2].
        self.points = request.entrance_points_of(telescope, wavelength, pupil)
        self._columns, self._directions, self._wavelength = columns, request.directions, wavelength
        #: [n, 2, n_parameter] motion of the points with the parameters; None where they stay.
        self.motion = None
        if telescope.design_data.aiming != "off" and columns.parameters:
            relative = moved_request.vignetted(pupil) / (0.5 * telescope.pupil_diameter)
            relative = np.broadcast_to(relative, (len(request.fields), *pupil.shape)).reshape(-1, 2)
            self.motion = _motion(columns, self.rays, relative)

    @cached_property
    def rays(self) -> Rays:
        """The rays, field by field."""
        return straight_bundles(self._columns.telescope, self._directions, self._wavelength, self.points)

    def part(self, rays: slice) -> AimedRays:
        """Return some of the rays."""
        subset, all_rays = copy(self), self.rays
        subset.rays = Rays(
            all_rays.position[rays], all_rays.direction[rays], all_rays.path_length[rays], all_rays.wavelength
        )
        subset.motion = None if self.motion is None else self.motion[rays]
        return subset

    def forward(self, threads: int | None = None) -> ForwardPass:
        """Trace the rays to every surface."""
        return forward_pass(self._columns.telescope, self.rays, threads=threads)

    def derivatives(self, forward: ForwardPass, gradient: OutputGradient, threads: int | None = None) -> np.ndarray:
        """Return the derivatives of outputs by the parameters, [n_output, n, n_parameter]."""
        change = self._columns.derivatives(forward, gradient, threads=threads)
        if self.motion is None:
            return change
        return change + np.einsum("ona,nap->onp", self.by_points(forward, gradient, threads), self.motion)

    def by_points(self, forward: ForwardPass, gradient: OutputGradient, threads: int | None = None) -> np.ndarray:
        """Return the derivatives of outputs by the points of the entrance pupil [1/m], [n_output, n, 2]."""
        return _by_points(forward, gradient, self.rays, threads)


def _motion(columns: ParameterColumns, rays: Rays, relative: np.ndarray) -> np.ndarray:
    """Return the motion [n, 2, n_parameter] of the crossing points of rays to points of the stop, over its radius."""
    stop = stop_of(columns.telescope)
    radius, axes = _stop_motion(columns, stop)
    target = np.einsum("ijp,nj->nip", stop.axes[..., None] * radius + stop.radius * axes, relative)
    by_point, by_parameter = _at_stop(columns, stop, rays)
    # By Cramer's rule: NaN or infinite for rays that are lost.
    (a, b), (c, d) = by_point.transpose(1, 2, 0)
    adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(adjugate @ (target - by_parameter) / determinants(by_point)[:, None, None])


def pupil_diameter(columns: ParameterColumns) -> tuple[float, np.ndarray]:
    """Return the diameter of the entrance pupil [m] and its derivatives [n_parameter].

    Of an object at infinity it changes where the size of a stop inside the telescope is stated.
    """
    telescope = columns.telescope
    floats = telescope.design_data.aperture == "stop" and np.isinf(telescope.object_distance)
    if not (floats and stop_is_inside(telescope)):
        return telescope.pupil_diameter, np.zeros(1)
    diameter = with_moved_pupil(telescope).pupil_diameter
    scale, change, *_ = _scale_motion(columns, stop_of(telescope))
    along = scale[:, 1]
    return diameter, -diameter / (along @ along) * (along @ change[:, 1])


def _stop_motion(columns: ParameterColumns, stop: Stop) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of the radius [n_parameter] and of the axes [2, 2, n_parameter] of the stop."""
    data, rim = columns.telescope.design_data, 0.5 * columns.telescope.pupil_diameter
    scale, change, rays, moved = _scale_motion(columns, stop)
    # Derivative of the orthogonal factor of scale: it turns by an angle.
    turned = np.einsum("ki,kjp->ijp", stop.axes, change)
    angle = (turned[1, 0] - turned[0, 1]) / np.trace(stop.axes.T @ scale)
    axes = np.einsum("ik,kj,p->ijp", stop.axes, np.array([[0.0, -1.0], [1.0, 0.0]]), angle)
    if data.aperture == "stop" and data.aperture_value is not None:
        return np.zeros_like(angle), axes
    if data.aiming == "real":
        landing = stop.front.surfaces[-1].to_local(forward_pass(stop.front, rays).position.T)[1, :2]
        return landing @ moved[1] / np.linalg.norm(landing), axes
    marginal = scale @ [0.0, rim]
    return marginal @ (change[:, 1] * rim) / np.linalg.norm(marginal), axes


def _scale_motion(columns: ParameterColumns, stop: Stop) -> tuple[np.ndarray, np.ndarray, Rays, np.ndarray]:
    """Return the scale from the entrance pupil to the stop near the axis [2, 2], and its derivatives.

    These are [2, 2, n_parameter]. Behind them the rays through the middle, the rim and near the axis, and the motion of
    their points of the stop beside that of the chief ray, [n, 2, n_parameter].
    """
    telescope = columns.telescope
    light, rim, axis = telescope.default_wavelength, 0.5 * telescope.pupil_diameter, field_direction(0.0, 0.0)[None]
    chief = np.reshape(entrance_points(telescope, axis, light, np.zeros((1, 2))), 2)
    near = _PARAXIAL * np.eye(2)
    away = np.array([[0.0, 0.0], [0.0, 1.0], *near, *-near, *2.0 * near, *-2.0 * near])
    rays = straight_bundles(telescope, axis, light, chief + rim * away)
    by_point, by_parameter = _at_stop(columns, stop, rays)
    # All of them move with the chief ray, which stays in the middle of the stop.
    moved = by_parameter - by_point @ np.linalg.solve(by_point[0], by_parameter[0])
    # The error of central differences is one of third order, which two steps remove.
    sides = (4.0 * (moved[2:4] - moved[4:6]) - 0.5 * (moved[6:8] - moved[8:])) / 3.0
    return by_point[0], sides.transpose(1, 0, 2) / (2.0 * _PARAXIAL * rim), rays, moved


def _at_stop(columns: ParameterColumns, stop: Stop, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Return derivatives of where rays meet the stop: by their points [n, 2, 2], by parameters [n, 2, n_parameter]."""
    front = columns.leading(stop.front, rays.wavelength)
    forward = forward_pass(stop.front, rays)
    gradient = landing_gradient(forward)
    by_parameter = front.derivatives(forward, gradient)
    return _by_points(forward, gradient, rays).transpose(1, 0, 2), by_parameter.transpose(1, 0, 2)


def _by_points(forward: ForwardPass, gradient: OutputGradient, rays: Rays, threads: int | None = None) -> np.ndarray:
    telescope = forward.telescope
    table = column_table(telescope, {(0, "gap")})
    start = backward_pass(forward, gradient, table, start=True, threads=threads).start
    assert start is not None
    return np.einsum("oin,nia->ona", start, _launch_derivatives(telescope, rays))


def _launch_derivatives(telescope: Telescope, rays: Rays) -> np.ndarray:
    """Return the derivatives of position and direction of rays by their points of the entrance pupil, [n, 6, 2]."""
    across = (np.eye(3) - rays.direction[:, :, None] * rays.direction[:, None, :])[:, :, :2]
    if not np.isfinite(telescope.object_distance):
        # Rays of a star stay parallel, and start on one plane across them.
        return np.concatenate([across, np.zeros_like(across)], axis=1)
    reach = (telescope.stop_z - rays.position[:, 2]) / rays.direction[:, 2]
    return np.concatenate([np.zeros_like(across), across / reach[:, None, None]], axis=1)
