"""Ray aiming: points of the entrance pupil through which rays reach given points of the stop.

The pupil that the front of a lens makes of its stop moves and deforms with the field. A ray of the pupil coordinates p,
in units of the radius of the entrance pupil, is aimed where it meets the stop at p times the radius of the stop. The
two coordinates in the plane of the entrance pupil are found for all rays together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from ..core.errors import DomainError
from ..core.units import field_label
from ..models.surface import Interaction, Surface
from ..models.telescope import Telescope
from .landing import Landing, derivatives, determinants, find_points, solve_2x2
from .rays import Rays, field_angles, field_direction, object_points, straight_bundles
from .repeated_trace import RepeatedTrace
from .smooth_pupil import FEWEST, pupil_nodes, smooth_pupil
from .trace import trace

#: Step of the differences that the first derivatives come from, in units of the radius of the entrance pupil.
_DIFFERENCE = 1e-4
#: Steps in the field angle [rad] by which chief rays are followed from the axis; the second where the first fail.
_FIELD_STEPS = np.deg2rad((10.0, 1.0))
#: Fields whose rays are aimed at once, which bounds the memory.
_FIELDS = 64
#: Steps by which rays that are not found at once are followed from the chief ray outwards.
_PUPIL_STEPS = 12


def entrance_points(telescope: Telescope, directions: np.ndarray, wavelength: float, pupil: np.ndarray) -> np.ndarray:
    """Return where rays of pupil points [m] cross the plane of the entrance pupil, [n_pupil, 2] or by direction.

    The arguments are those of :func:`~pachon.raytrace.rays.straight_bundles`. Without aiming the points are returned as
    they are, about the centre of the pupil; else their shape is [n_direction, n_pupil, 2], NaN where no ray reaches the
    point of the stop, and where none does so through its middle.
    """
    data = telescope.design_data
    if data.telecentric:
        return object_points(telescope, directions)[:, None, :2] + pupil
    if data.aiming == "off":
        return pupil + telescope.pupil_center if any(telescope.pupil_center) else pupil
    stop = stop_of(telescope)
    relative = pupil / (0.5 * telescope.pupil_diameter)
    relative = np.broadcast_to(relative, (len(directions), *pupil.shape[-2:]))
    if relative.shape[1] < FEWEST:
        return _search_points(telescope, stop, directions, wavelength, relative)
    crossings = np.empty(relative.shape)
    # Rays of all fields together: with few rays the launch of the kernel takes most of the time.
    at_nodes = [
        _search_points(telescope, stop, directions[batch], wavelength, pupil_nodes(relative[batch]))
        for batch in (slice(i, i + _FIELDS) for i in range(0, len(directions), _FIELDS))
    ]
    for i, (target, node_crossings) in enumerate(zip(relative, np.concatenate(at_nodes), strict=True)):
        light = directions[i : i + 1]

        def at_stop(points: np.ndarray, light: np.ndarray = light) -> np.ndarray:
            return stop.relative(straight_bundles(telescope, light, wavelength, points))

        def search(relative_points: np.ndarray, light: np.ndarray = light) -> np.ndarray:
            return _search_points(telescope, stop, light, wavelength, relative_points[None])[0]

        crossings[i] = smooth_pupil(target, node_crossings, at_stop, search)
    return crossings


@dataclass(frozen=True, eq=False)
class AimedPoints:
    """Points of the entrance pupil that aimed rays cross, a start for those of a telescope like it."""

    points: np.ndarray  #: as :func:`entrance_points` returns them [m]
    slopes: np.ndarray | None  #: [n_direction * n_pupil, 2, 2] derivatives at the stop; None without search

    @classmethod
    def of(
        cls, telescope: Telescope, directions: np.ndarray, wavelength: float, pupil: np.ndarray, points: np.ndarray
    ) -> AimedPoints:
        """Return the points that :func:`entrance_points` found for pupil points [m]."""
        if telescope.design_data.aiming == "off" or pupil.shape[-2] >= FEWEST:
            return cls(points, None)
        landing = stop_of(telescope).landing(np.repeat(directions, pupil.shape[-2], axis=0), wavelength)
        return cls(points, derivatives(landing, points.reshape(-1, 2), _central_difference_step(telescope)))

    def moved(
        self, telescope: Telescope, directions: np.ndarray, wavelength: float, pupil: np.ndarray
    ) -> np.ndarray | None:
        """Return :func:`entrance_points` of another telescope, a little different; None where it is too different."""
        if self.slopes is None or telescope.design_data.aiming == "off":
            return None
        stop, difference = stop_of(telescope), _central_difference_step(telescope)
        target = np.broadcast_to(_stop_coordinates(telescope, stop, pupil), self.points.shape).reshape(-1, 2)
        landing = stop.landing(np.repeat(directions, pupil.shape[-2], axis=0), wavelength)
        crossings = find_points(landing, self.points.reshape(-1, 2), target, stop.radius, difference, self.slopes)
        sense = determinants(derivatives(landing, crossings, difference, target)) * determinants(self.slopes)
        return crossings.reshape(self.points.shape) if (sense > 0.0).all() else None


def _search_points(
    telescope: Telescope, stop: Stop, directions: np.ndarray, wavelength: float, relative: np.ndarray
) -> np.ndarray:
    """Return :func:`entrance_points` of pupil points in units of the radius, [n_direction, n_pupil, 2]."""
    n, difference = len(directions), _central_difference_step(telescope)
    chief = _chief_ray_points(telescope, stop, directions, wavelength)
    target = _rotated(stop.radius * relative, stop.axes.T).reshape(-1, 2)
    rays = np.repeat(directions, relative.shape[1], axis=0)
    landing = stop.landing(rays, wavelength)
    start = np.repeat(chief, relative.shape[1], axis=0)
    # All rays of a field begin with the derivatives at its chief ray.
    slopes = derivatives(stop.landing(directions, wavelength), chief, difference)
    first = start + solve_2x2(np.repeat(slopes, relative.shape[1], axis=0), target)
    crossings = find_points(landing, first, target, stop.radius, difference)
    # The sense of the map from the entrance pupil to the stop is that at the chief ray; where it is the other one, the
    # search came beyond a fold of the pupil, to a second ray through the same point.
    sense = np.repeat(determinants(slopes), relative.shape[1], axis=0)
    lost = np.flatnonzero(~(determinants(derivatives(landing, crossings, difference, target)) * sense > 0.0))
    if len(lost):

        def of_lost(points: np.ndarray, indices: np.ndarray) -> np.ndarray:
            return landing(points, lost[indices])

        # They are followed from the chief ray outwards.
        points = start[lost]
        for k in range(1, _PUPIL_STEPS + 1):
            points = find_points(of_lost, points, target[lost] * (k / _PUPIL_STEPS), stop.radius, difference)
        turned = ~(determinants(derivatives(of_lost, points, difference, target[lost])) * sense[lost] > 0.0)
        points[turned] = np.nan
        crossings[lost] = points
    return crossings.reshape(n, -1, 2)


def pupil_coordinates(telescope: Telescope, direction: np.ndarray, wavelength: float, points: np.ndarray) -> np.ndarray:
    """Return the pupil points [m] whose rays cross the plane of the entrance pupil in given points [n, 2] [m].

    The inverse of :func:`entrance_points` for one direction [3]; NaN where a ray does not reach the stop.
    """
    if telescope.design_data.telecentric:
        return points - object_points(telescope, direction[None])[:, :2]
    if telescope.design_data.aiming == "off":
        return points - telescope.pupil_center if any(telescope.pupil_center) else points
    stop = stop_of(telescope)
    rays = straight_bundles(telescope, direction[None], wavelength, points)
    return stop.relative(rays) * (0.5 * telescope.pupil_diameter)


def require_aimed(telescope: Telescope, directions: np.ndarray, points: np.ndarray) -> None:
    """Raise a DomainError that names the first of the fields, by their directions, of which no ray was aimed."""
    lost = np.isnan(points).all(axis=(-2, -1)) if points.ndim == 3 else np.zeros(len(directions), dtype=bool)
    if lost.any():
        first = directions[lost][:1]
        label = field_label(field_angles(first[:, :2] / -first[:, 2:])[0])
        name = telescope.design_data.stop
        raise DomainError(f"{label}: no ray from this field reaches its point of the stop {name!r} of {telescope.name}")


@dataclass(frozen=True, eq=False)
class Stop:
    """The stop of a telescope.

    Attributes
    ----------
    telescope : Telescope
        The telescope.
    radius : float
        Radius of the stop that pupil coordinates of 1 belong to [m].
    axes : ndarray, shape [2, 2]
        Axes x and y of the entrance pupil, in those of the stop, as columns.
    """

    telescope: Telescope
    radius: float
    axes: np.ndarray

    @cached_property
    def index(self) -> int:
        """Index of the surface."""
        return self.telescope.surface_names.index(str(self.telescope.design_data.stop))

    @cached_property
    def surface(self) -> Surface:
        """The surface."""
        return self.telescope.surfaces[self.index]

    @cached_property
    def front(self) -> Telescope:
        """The surfaces up to the stop, none of which stops light."""
        return _front_group(self.telescope, self.index)

    def relative(self, rays: Rays) -> np.ndarray:
        """Return where rays meet the stop [n, 2], along the axes of the entrance pupil, in units of the radius."""
        landing = self.surface.to_local(trace(self.front, rays).position)[:, :2]
        return _rotated(landing, self.axes) / self.radius

    def landing(self, directions: np.ndarray, wavelength: float) -> Landing:
        """Return the function from points of the entrance pupil to the stop for rays of given chief directions."""
        traced = RepeatedTrace(self.telescope, wavelength, self.index)

        def land(points: np.ndarray, indices: np.ndarray) -> np.ndarray:
            rays = straight_bundles(self.telescope, directions[indices], wavelength, points[:, None])
            return self.surface.to_local(traced.positions(rays))[:, :2]

        return land


@lru_cache(maxsize=64)
def stop_of(telescope: Telescope) -> Stop:
    """Return the stop of a telescope whose design data name one; DomainError if no light on the axis reaches it.

    Its radius is that of the paraxial or of the real marginal ray at the default wavelength, as `aiming` says; or that
    which the design data state.
    """
    data = telescope.design_data
    if data.stop is None:
        raise DomainError(f"{telescope.name}: expected a surface that is the stop (design data: stop)")
    axis, light = field_direction(0.0, 0.0)[None], telescope.default_wavelength
    unscaled = Stop(telescope, 1.0, np.eye(2))
    landing = unscaled.landing(axis, light)
    rim = 0.5 * telescope.pupil_diameter
    chief = find_points(landing, np.zeros((1, 2)), np.zeros((1, 2)), rim, _central_difference_step(telescope))
    # The error of central differences is one of third order, which two steps remove.
    steps = rim * np.array([1e-3, 2e-3])
    away = np.concatenate([step * side for step in steps for side in (np.eye(2), -np.eye(2))])
    sides = landing(chief + away, np.zeros(8, dtype=int)).reshape(2, 2, 2, 2)
    near, far = ((plus - minus).T / (2.0 * step) for step, (plus, minus) in zip(steps, sides, strict=True))
    scale = (4.0 * near - far) / 3.0
    if not np.isfinite(scale).all() or determinants(scale[None])[0] == 0.0:
        raise DomainError(f"{telescope.name}: no ray on the axis passes the middle of the stop {data.stop!r}")
    u, _, v = np.linalg.svd(scale)
    marginal = np.array([[0.0, rim]])
    if data.aperture == "stop" and data.aperture_value is not None:
        radius = data.aperture_value
    elif data.aiming == "real":
        radius = float(np.linalg.norm(landing(chief + marginal, np.zeros(1, dtype=int))))
    else:
        radius = float(np.linalg.norm(scale @ marginal[0]))
    if not np.isfinite(radius):
        raise DomainError(f"{telescope.name}: the marginal ray on the axis does not reach the stop {data.stop!r}")
    return Stop(telescope, radius, u @ v)


def _front_group(telescope: Telescope, stop: int) -> Telescope:
    """Return a telescope with the surfaces up to its stop, without apertures and obstructions."""
    surfaces = telescope.surfaces[: stop + 1]
    before = surfaces[-2].medium_after if len(surfaces) > 1 else telescope.medium_before
    last = replace(surfaces[-1], interaction=Interaction.PASS, medium_after=before)
    clear = tuple(replace(s, aperture=None) for s in (*surfaces[:-1], last))
    return telescope.with_other_surfaces(clear, telescope.medium_before)


def _stop_coordinates(telescope: Telescope, stop: Stop, pupil: np.ndarray) -> np.ndarray:
    """Return the points of the stop [m], along its own axes, that pupil points [m] mean."""
    return _rotated(pupil * (stop.radius / (0.5 * telescope.pupil_diameter)), stop.axes.T)


def _rotated(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return the product of points [..., 2] and a small matrix, without the threads of a matrix product."""
    return points[..., :1] * matrix[0] + points[..., 1:] * matrix[1]


def _central_difference_step(telescope: Telescope) -> float:
    return _DIFFERENCE * 0.5 * telescope.pupil_diameter


def _chief_ray_points(telescope: Telescope, stop: Stop, directions: np.ndarray, wavelength: float) -> np.ndarray:
    """Return the points of the entrance pupil [n, 2] of rays through the middle of the stop, from the axis outwards."""
    slopes = directions[:, :2] / -directions[:, 2:]
    size = np.hypot(*slopes.T)
    angle, along = np.arctan(size), slopes / np.where(size > 0, size, 1.0)[:, None]
    chief_points = np.full_like(slopes, np.nan)
    for step in _FIELD_STEPS:
        unsolved = np.flatnonzero(np.isnan(chief_points).any(axis=1))
        points = before = np.zeros((len(unsolved), 2))
        for k in range(int(np.ceil(angle[unsolved].max(initial=0.0) / step)) + 1):
            at = np.minimum(k * step, angle[unsolved])
            going = (k - 1) * step < angle[unsolved]
            tx, ty = (np.tan(at)[:, None] * along[unsolved])[going].T
            light = field_direction(tx, ty, "gnomonic")
            landing = stop.landing(light, wavelength)
            # Across the beam the pupil moves steadily with the field: go on as in the step before.
            ahead = [np.cos(np.minimum((k - i) * step, angle[unsolved]))[:, None] for i in range(3)]
            guess = ((2.0 * points * ahead[1] - before * ahead[2]) / ahead[0])[going] if k > 1 else points[going]
            moved = points.copy()
            moved[going] = find_points(
                landing, guess, np.zeros_like(guess), stop.radius, _central_difference_step(telescope)
            )
            points, before = moved, np.where(going[:, None], points, moved)
        chief_points[unsolved] = points
    return chief_points
