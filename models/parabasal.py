"""First-order properties of a telescope of any layout, from parabasal rays about its chief ray.

Rays beside a real ray follow it to first order. With the intersection Q = P + t d, the normal N = (-sx, -sy, 1) of the
sag, a = d.N and S = N.N in the frame of a surface, a change of position and direction of a ray is carried on by::

    intersection  dt = -N.(dP + t dd) / a,    dQ = dP + t dd + d dt
    normal        dN = -(H dQ)                H: second derivatives of the sag
    refraction    d' = mu d + g N,            g = (root - mu a) / S, root = sign(a) sqrt((1 - mu^2) S + mu^2 a^2)
    mirror        d' = d - 2 (a / S) N

Along the axis of a centred telescope these are the rays of a paraxial trace. Elsewhere focal length, focus and pupil
differ between two planes through the chief ray (Coddington; see Stone and Forbes 1992, J. Opt. Soc. Am. A 9, 478).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.result import Values
from ..core.units import ARCSEC, length
from .shapes.shape import Rotational
from .surface import Interaction, Surface
from .telescope import Telescope

#: Steps of Newton's method from the crossing of a conic to that of its surface.
_STEPS = 30
#: Step [m] at which they end: rounding of some metres.
_CONVERGED = 1e-14
#: Distance from a surface [m] at which the search has failed.
_FAILED = 1e-9
#: Power times the radius of the pupil below which light is parallel, as in :func:`~.first_order.first_order`.
_PARALLEL = 1e-9
#: Determinants below this, of matrices of unit size, are rounding.
_SINGULAR = 1e-12
#: Steps in which the chief ray is aimed at the middle of the stop, and the relative distance at which it is there.
_AIMING_STEPS = 20
_AIMED = 1e-14
#: A mirror whose axis is within this cosine of perpendicular to a ray may be crossed twice on one sheet.
_PERPENDICULAR = 0.1
#: Distance [m] and slope of the chief ray from the axis of a thin lens that rounding leaves.
_CENTRED = 1e-9
_ACTING = (Interaction.MIRROR, Interaction.REFRACT, Interaction.THIN_LENS)


@dataclass(frozen=True)
class ParabasalOptics(Values):
    """First-order properties about the chief ray of the axis, each in two planes through it.

    The planes are the principal ones of the power: of a telescope that is symmetric about the plane of y and z this
    plane comes first, and that across it second. Elsewhere the first is that closer to y.

    Parameters
    ----------
    wavelength : float
        Vacuum wavelength [m].
    focal_length : ndarray, shape (2,)
        Effective focal lengths [m], positive; infinite where light stays parallel.
    f_number : ndarray, shape (2,)
        Focal lengths over the diameter of the entrance pupil.
    plate_scale : ndarray, shape (2,)
        Angle on the sky over length across the chief ray at the foci [rad/m].
    back_focus : ndarray, shape (2,)
        From the last mirror or lens surface along the chief ray to the foci [m].
    exit_pupil_distance : ndarray, shape (2,)
        From the last mirror or lens surface along the chief ray to the exit pupil [m]; negative in front of it.
    exit_pupil_diameter : ndarray, shape (2,)
        Diameters of the exit pupil [m].
    detector_distance : float
        From the last mirror or lens surface along the chief ray to the detector [m].
    """

    wavelength: float
    focal_length: np.ndarray
    f_number: np.ndarray
    plate_scale: np.ndarray
    back_focus: np.ndarray
    exit_pupil_distance: np.ndarray
    exit_pupil_diameter: np.ndarray
    detector_distance: float

    @property
    def arcsec_per_um(self) -> np.ndarray:
        """Plate scales in arc seconds for each micrometre, shape (2,)."""
        return self.plate_scale / ARCSEC * 1e-6


@dataclass(frozen=True)
class _Ray:
    """A ray and changes of it: positions [m] and directions, shape [3] and [3, n]."""

    place: np.ndarray
    direction: np.ndarray
    moved: np.ndarray
    turned: np.ndarray

    def within(self, surface: Surface) -> _Ray:
        """Return the ray in the frame of a surface."""
        axes = surface.matrix.T
        return _Ray(axes @ (self.place - surface.vertex), axes @ self.direction, axes @ self.moved, axes @ self.turned)

    def out_of(self, surface: Surface) -> _Ray:
        """Return a ray of the frame of a surface in that of the telescope."""
        axes = surface.matrix
        place = axes @ self.place + surface.vertex
        return _Ray(place, axes @ self.direction, axes @ self.moved, axes @ self.turned)

    def advanced(self, distance: float) -> _Ray:
        """Return the ray a distance [m] farther; its neighbours as far."""
        place = self.place + distance * self.direction
        return _Ray(place, self.direction, self.moved + distance * self.turned, self.turned)


@check_arguments
def parabasal_optics(telescope: Telescope, wavelength: ArrayLike | None = None) -> ParabasalOptics:
    """Return first-order properties about the chief ray of any telescope.

    The chief ray is that of the axis, through the middle of the entrance pupil, or of the stop where rays are aimed.

    Parameters
    ----------
    telescope : Telescope
        Prescription; its surfaces may be decentred, tilted and of any shape. Phase screens count as planes.
    wavelength : float or Quantity, optional
        Vacuum wavelength [m]; the telescope's default where not given.

    Raises
    ------
    DomainError
        If no surface acts, the chief ray misses one or is totally reflected, or the wavelength is not covered.
    """
    w = length(telescope.default_wavelength if wavelength is None else wavelength, "wavelength")
    telescope.check_wavelength(w)
    acting = [i for i, s in enumerate(telescope.surfaces) if s.interaction in _ACTING]
    if not acting:
        raise DomainError(f"telescope {telescope.name}: expected at least one mirror or lens surface")
    rays = _traced(telescope, w, _chief_start(telescope, w))
    last = rays[acting[-1]]
    index = float(telescope.surfaces[acting[-1]].medium_after.index(w)) / float(telescope.medium_before.index(w))
    # Across the chief ray; any two axes do.
    across = np.linalg.svd(last.direction[None])[2][1:]
    height, by_field = (across @ last.moved)[:, :2], (across @ last.moved)[:, 2:]
    turn, turn_by_field = (across @ last.turned)[:, :2], (across @ last.turned)[:, 2:]
    image_axes, powers, pupil_axes = np.linalg.svd(turn)
    order = np.argsort(-np.abs(pupil_axes[:, 1]), kind="stable")
    image_axes, powers = image_axes[:, order], powers[order] * index
    powers = np.where(powers * 0.5 * telescope.pupil_diameter < _PARALLEL, 0.0, powers)
    with np.errstate(divide="ignore"):
        focal_length = 1.0 / powers
    to_focus = _distances(height, turn, image_axes) if powers.any() else np.full(2, math.inf)
    if telescope.design_data.telecentric:
        # Chief rays are parallel there, and light of the rim of the pupil comes from the point of the object.
        slope = 1.0 / (telescope.object_distance - telescope.stop_z)
        to_pupil, height, turn = to_focus, height + slope * by_field, turn + slope * turn_by_field
    else:
        to_pupil = _distances(by_field, turn_by_field, image_axes)
    diameters = [
        float(np.linalg.norm(axis @ (height + distance * turn))) if math.isfinite(distance) else math.inf
        for axis, distance in zip(image_axes.T, to_pupil, strict=True)
    ]
    return ParabasalOptics(
        wavelength=w,
        focal_length=focal_length,
        f_number=focal_length / telescope.pupil_diameter,
        plate_scale=powers,
        back_focus=to_focus,
        exit_pupil_distance=to_pupil,
        exit_pupil_diameter=telescope.pupil_diameter * np.array(diameters),
        detector_distance=float((rays[-1].place - last.place) @ last.direction),
    )


def _distances(height: np.ndarray, turn: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return how far ahead the neighbours of a ray cross it [m], in the order of axes; infinite where they do not.

    Rays that come from one point, or in parallel, meet in two planes at right angles: with heights A and slopes C, of
    which C A^-1 is symmetric, at the negative inverse eigenvalues of it; or where the image is at the surface, at the
    negative eigenvalues of A C^-1.
    """
    size = max(float(np.abs(height).max()), float(np.abs(turn).max()))
    from_height = abs(np.linalg.det(height)) > _SINGULAR * size**2
    if not from_height and not abs(np.linalg.det(turn)) > _SINGULAR * size**2:
        return np.full(2, math.inf)
    ratio = turn @ np.linalg.inv(height) if from_height else height @ np.linalg.inv(turn)
    values, vectors = np.linalg.eigh(0.5 * (ratio + ratio.T))
    first = int(np.argmax(np.abs(vectors.T @ axes[:, 0])))
    ordered = values[[first, 1 - first]]
    if not from_height:
        return 0.0 - ordered
    parallel = np.abs(ordered) < _SINGULAR * float(np.abs(ratio).max(initial=1e-30))
    return np.where(parallel, math.inf, -1.0 / np.where(parallel, 1.0, ordered)) + 0.0


def stop_center_point(telescope: Telescope, wavelength: float) -> np.ndarray:
    """Return where the ray along the axis through the middle of the stop crosses z = ``stop_z`` [m], shape [2].

    Of an object at a finite distance it comes from its point on the axis. DomainError where the design data name no
    stop, or no such ray reaches it.
    """
    stop = telescope.design_data.stop
    if stop is None:
        raise DomainError(f"{telescope.name}: expected a surface that is the stop (design data: stop)")
    count = telescope.surface_names.index(stop) + 1
    point = np.array(telescope.pupil_center, dtype=np.float64)
    # Far from the axis of the telescope rounding is that of the coordinates.
    size = max(telescope.pupil_diameter, *np.abs(telescope.surfaces[count - 1].vertex), *np.abs(point))
    for _ in range(_AIMING_STEPS):
        ray = _traced(telescope, wavelength, _axis_ray(telescope, point), count)[-1]
        at_stop = ray.within(telescope.surfaces[count - 1])
        missed = at_stop.place[:2]
        if np.linalg.norm(missed) <= _AIMED * size:
            return point
        by_point = at_stop.moved[:2, :2]
        if not np.linalg.det(by_point):
            break
        point = point - np.linalg.solve(by_point, missed)
    raise DomainError(f"{telescope.name}: no ray on the axis passes the middle of the stop {stop!r}")


def axis_ray_at(telescope: Telescope, place: int, radius: float) -> _Ray:
    """Return the ray of the axis that is `radius` [m] along y from the middle of the pupil, in the frame of a surface.

    Of an object at a finite distance it comes from its point on the axis. DomainError if it does not reach the surface.
    """
    x, y = telescope.pupil_center
    rays = _traced(telescope, telescope.default_wavelength, _axis_ray(telescope, np.array([x, y + radius])), place + 1)
    return rays[-1].within(telescope.surfaces[place])


def _axis_ray(telescope: Telescope, point: np.ndarray) -> _Ray:
    """Return the ray of the object on the axis through a point [2] at z = ``stop_z``, with neighbours beside it."""
    place, direction, turned = np.array([*point, telescope.stop_z]), np.array([0.0, 0.0, -1.0]), np.zeros((3, 2))
    sides = np.eye(3)[:, :2]
    if math.isfinite(telescope.object_distance):
        away = place - [0.0, 0.0, telescope.object_distance]
        distance = -math.copysign(float(np.linalg.norm(away)), away[2])
        direction = away / distance
        turned = (sides - np.outer(direction, direction @ sides)) / distance
    return _Ray(place, direction, sides, turned)


def _chief_start(telescope: Telescope, wavelength: float) -> _Ray:
    """Return the chief ray of the axis at the entrance pupil, with neighbours.

    They are parallel to it, displaced along x and y, and of other directions along x and y through the same point.
    """
    data, point = telescope.design_data, np.array(telescope.pupil_center, dtype=np.float64)
    if data.aiming != "off" and data.stop is not None and not data.telecentric:
        point = stop_center_point(telescope, wavelength)
    sides = np.eye(3)[:, :2]
    none = np.zeros((3, 2))
    place = np.array([*point, telescope.stop_z])
    return _Ray(place, np.array([0.0, 0.0, -1.0]), np.hstack([sides, none]), np.hstack([none, sides]))


def _traced(telescope: Telescope, wavelength: float, start: _Ray, count: int | None = None) -> list[_Ray]:
    """Return the ray behind each of the first surfaces, in the telescope frame."""
    ray, rays = start, []
    index = float(telescope.medium_before.index(wavelength))
    surfaces = telescope.surfaces[:count]
    for row, surface in enumerate(surfaces):
        index_after = float(surface.medium_after.index(wavelength))
        local = ray.within(surface)
        local = _landed(surface, local, telescope, row)
        if surface.interaction in (Interaction.MIRROR, Interaction.REFRACT):
            local = _deflected(surface, local, index, index_after, wavelength, telescope.name)
        elif surface.thin_lens is not None:
            # Off its axis the rays behind an ideal lens are no more those of a wavefront: no planes, no foci.
            if np.abs([local.place[:2], local.direction[:2]]).max() > _CENTRED:
                raise DomainError(f"thin lens {surface.name} of {telescope.name}: expected one about the chief ray")
            local = _through_thin_lens(surface.thin_lens.focal_length, local, index, index_after)
        elif surface.interaction not in (Interaction.DETECTOR, Interaction.PASS, Interaction.PHASE):
            raise DomainError(f"surface {surface.name} of {telescope.name}: expected a mirror or lens surface")
        ray, index = local.out_of(surface), index_after
        if not np.isfinite([*ray.direction, *ray.turned.ravel(), *ray.moved.ravel()]).all():
            raise DomainError(
                f"surface {surface.name} of {telescope.name}: expected one that is smooth at the chief ray"
            )
        rays.append(ray)
    return rays


def _landed(surface: Surface, ray: _Ray, telescope: Telescope, row: int) -> _Ray:
    """Return a ray at its intersection with a surface, in the frame of the surface."""
    candidates = [t for t in _crossings(surface, ray) if math.isfinite(t)]
    if not candidates:
        raise DomainError(f"the chief ray of {telescope.name} does not meet surface {surface.name}")
    points = np.array([ray.place + t * ray.direction for t in candidates])
    index = _meant(surface, ray, points, telescope, row) if len(candidates) > 1 else 0
    ahead = ray.advanced(candidates[index])
    normal = _normal(surface, ahead.place)
    # The neighbours meet the surface farther or nearer.
    steps = -(normal @ ahead.moved) / (normal @ ahead.direction)
    return _Ray(ahead.place, ahead.direction, ahead.moved + np.outer(ahead.direction, steps), ahead.turned)


def _crossings(surface: Surface, ray: _Ray) -> list[float]:
    """Return the distances [m] to the crossings of a ray with the sheet of a surface at its vertex."""
    shape, (x, y, z), (u, v, w) = surface.meeting_shape, ray.place, ray.direction
    k = shape.conic if isinstance(shape, Rotational) else 0.0
    c = shape.curvature
    a = c * (1.0 + k * w * w)
    b = w - c * (x * u + y * v + (1.0 + k) * z * w)
    e = c * (x * x + y * y + (1.0 + k) * z * z) - 2.0 * z
    square = b * b - a * e
    starts = [-z / w] if w else []
    if square >= 0.0:
        # The form of each root that does not cancel.
        larger = b + math.copysign(math.sqrt(square), b)
        starts = [e / larger] if larger else starts
        starts += [larger / a] if a else []
    distances: list[float] = []
    for start in starts:
        t, step = start, math.inf
        for _ in range(_STEPS):
            at = ray.place + t * ray.direction
            with np.errstate(all="ignore"):
                height = at[2] - float(shape.sag(at[0], at[1]))
                rate = float(_normal(surface, at) @ ray.direction)
                step = height / rate if rate else math.nan
            t -= step
            if not abs(step) > _CONVERGED * max(1.0, abs(t)):
                break
        at = ray.place + t * ray.direction
        on_sheet = abs(float(at[2] - shape.sag(at[0], at[1]))) < _FAILED if math.isfinite(t) else False
        if on_sheet and not any(abs(t - crossing) < _FAILED for crossing in distances):
            distances.append(t)
    return distances


def _meant(surface: Surface, ray: _Ray, points: np.ndarray, telescope: Telescope, row: int) -> int:
    """Return which of two crossings is meant, as in the trace: that within the aperture, or that by the sign of w."""
    if surface.aperture is not None:
        within = surface.aperture.contains(points[:, 0], points[:, 1])
        if within[0] != within[1]:
            return int(np.argmax(within))
    nearer = int(np.argmin(np.abs(points[:, 2])))
    if surface.interaction == Interaction.MIRROR and abs(ray.direction[2]) < _PERPENDICULAR:
        for following in telescope.surfaces[row + 1 :]:
            height = float((np.subtract(following.vertex, surface.vertex)) @ surface.matrix[:, 2])
            if abs(height) > _FAILED:
                # The light comes from the side that it leaves to.
                sides = [float(_normal(surface, point) @ ray.direction) * height < 0.0 for point in points]
                return int(np.argmax(sides)) if sides[0] != sides[1] else nearer
    return nearer


def _normal(surface: Surface, point: np.ndarray) -> np.ndarray:
    slope_x, slope_y = surface.meeting_shape.gradient(point[0], point[1])
    return np.array([-float(slope_x), -float(slope_y), 1.0])


def _deflected(surface: Surface, ray: _Ray, index: float, index_after: float, wavelength: float, name: str) -> _Ray:
    """Return a ray behind a mirror or lens surface, which may be a grating."""
    normal = _normal(surface, ray.place)
    xx, xy, yy = (float(v) for v in surface.meeting_shape.hessian(ray.place[0], ray.place[1]))
    normal_change = -np.vstack([np.array([[xx, xy], [xy, yy]]) @ ray.moved[:2], np.zeros(ray.moved.shape[1])])
    square, square_change = float(normal @ normal), 2.0 * normal @ normal_change
    mirror = surface.interaction == Interaction.MIRROR
    mu = 1.0 if mirror else index / index_after
    # Grooves add to the part of the direction along the surface; what is along the normal keeps it a unit vector.
    added = np.zeros(3)
    if surface.grating is not None:
        added[:2] = np.multiply(surface.grating.path_gradient, wavelength / index_after)
    incoming, incoming_change = mu * ray.direction + added, mu * ray.turned
    along, along_change = float(incoming @ normal), normal @ incoming_change + incoming @ normal_change
    spare, spare_change = 1.0 - float(incoming @ incoming), -2.0 * incoming @ incoming_change
    inside = spare * square + along**2
    if inside <= 0.0:
        loss = "is totally reflected at" if surface.grating is None else "has no such order of the grating"
        raise DomainError(f"the chief ray of {name} {loss} surface {surface.name}")
    root = math.copysign(math.sqrt(inside), (-1.0 if mirror else 1.0) * float(ray.direction @ normal))
    root_change = (spare_change * square + spare * square_change + 2.0 * along * along_change) / (2.0 * root)
    g = (root - along) / square
    g_change = (root_change - along_change) / square - g * square_change / square
    turned = incoming_change + np.outer(normal, g_change) + g * normal_change
    return _Ray(ray.place, incoming + g * normal, ray.moved, turned)


def _through_thin_lens(focal_length: float, ray: _Ray, index: float, index_after: float) -> _Ray:
    """Return the ray along the axis of an ideal thin lens behind it, ``n' t' = n t - P / focal_length`` of slopes t."""
    turned = index * ray.turned
    turned[:2] -= ray.moved[:2] / focal_length
    turned /= index_after
    return _Ray(ray.place, ray.direction, ray.moved, turned)
