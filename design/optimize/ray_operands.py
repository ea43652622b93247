"""Operands of rays: angles at surfaces, rms spot and wavefront of a field point, modulation transfer."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, NamedTuple, Protocol, Self

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.units import field_label
from ...models.telescope import Telescope
from ...raytrace.launch import launch_bundles
from ...raytrace.rays import RayStatus
from ...raytrace.trace import trace
from ...wavefront.chief_rays import image_jacobians
from ...wavefront.opd import wavefront_opd
from .jacobian import ParameterColumns
from .merit import Beams, Merit, SpotMerit, WavefrontMerit
from .operand import GoalOperand, angles_of, direction_of, operand_kind, wavelength_of

#: Points across the pupil for the modulation transfer.
_ACROSS = 32
#: The same for the light that apertures take.
_FINE = 96


class RayAtSurface(NamedTuple):
    """A ray where it meets a surface: position [m] and unit directions, telescope frame, shape [3]."""

    position: np.ndarray
    direction_before: np.ndarray
    direction_behind: np.ndarray


class RayOperand(Protocol):
    """Operand of one ray: surface, field angles [rad], pupil point in units of its radius, wavelength [m]."""

    @property
    def label(self) -> str:
        """Name in messages."""

    @property
    def surface(self) -> str:
        """Name of the surface."""

    @property
    def field(self) -> tuple[float, float]:
        """Field angles [rad]."""

    @property
    def pupil(self) -> tuple[float, float]:
        """Pupil point."""

    @property
    def wavelength(self) -> float | None:
        """Vacuum wavelength [m]."""


def ray_at_surface(operand: RayOperand, telescope: Telescope) -> RayAtSurface:
    """Return the ray of an operand at its surface; DomainError where it does not get there."""
    place = telescope.surface_names.index(telescope.surface(operand.surface).name)
    point = 0.5 * telescope.pupil_diameter * np.array([operand.pupil], dtype=np.float64)
    light = direction_of(operand.field, telescope)
    rays = launch_bundles(telescope, light, wavelength_of(operand.wavelength, telescope), point)
    results = trace(telescope, rays, surfaces="all", threads=1)
    landed = results[place]
    if landed.status[0] > RayStatus.VIGNETTED:
        raise DomainError(f"operand {operand.label}: the ray does not reach the surface")
    before = results[place - 1].direction[0] if place else rays.direction[0]
    return RayAtSurface(landed.position[0], before, landed.direction[0])


@operand_kind("incidence_angle", "rad")
@check_arguments
@dataclass(frozen=True)
class IncidenceAngle(GoalOperand):
    """Angle [rad] between a ray and the normal of a surface, in front of the surface.

    Parameters
    ----------
    surface : str
        Name of the surface.
    field : tuple of float, shape (2,)
        Field angles [rad].
    pupil : tuple of float, shape (2,)
        Point of the entrance pupil, in units of its radius; the chief ray by default.
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [rad].
    """

    behind: ClassVar[bool] = False

    surface: str
    field: tuple[float, float]
    pupil: tuple[float, float] = (0.0, 0.0)
    wavelength: float | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        surface = telescope.surface(self.surface)
        landed = ray_at_surface(self, telescope)
        ray = landed.direction_behind if self.behind else landed.direction_before
        x, y, _ = surface.to_local(landed.position)
        slope_x, slope_y = surface.shape.gradient(x, y)
        normal = surface.matrix @ np.array([-float(slope_x), -float(slope_y), 1.0])
        # The arc tangent stays exact for small angles.
        return math.atan2(float(np.linalg.norm(np.cross(ray, normal))), abs(float(ray @ normal)))


@operand_kind("exit_angle", "rad")
@check_arguments
@dataclass(frozen=True)
class ExitAngle(IncidenceAngle):
    """Angle [rad] between a ray and the normal of a surface, behind the surface; see :class:`IncidenceAngle`."""

    behind: ClassVar[bool] = True


@operand_kind("ray_coordinate", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class RayCoordinate(GoalOperand):
    """Coordinate [m] at which a ray meets a surface, in the axes that the surface has in a lens file.

    These have z along the light that enters; they are the telescope's own ``(-x, y, -z)``, and a field ``(tx, ty)`` is
    ``(-tx, ty)`` there. "r" is the distance from the axis of the surface.

    Parameters
    ----------
    axis : {"x", "y", "z", "r"}
        The coordinate.
    surface, field, pupil, wavelength
        As of :class:`IncidenceAngle`.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [m].
    """

    axis: Literal["x", "y", "z", "r"]
    surface: str
    field: tuple[float, float] = (0.0, 0.0)
    pupil: tuple[float, float] = (0.0, 0.0)
    wavelength: float | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        x, y, z = telescope.surface(self.surface).to_local(ray_at_surface(self, telescope).position)
        return float({"x": -x, "y": y, "z": -z, "r": np.hypot(x, y)}[self.axis]) + 0.0


@operand_kind("ray_cosine", "1", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class RayCosine(GoalOperand):
    """Direction cosine of a ray behind a surface, in the axes of :class:`RayCoordinate`.

    Parameters
    ----------
    axis : {"x", "y", "z"}
        The axis.
    surface, field, pupil, wavelength
        As of :class:`IncidenceAngle`.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand`.
    """

    axis: Literal["x", "y", "z"]
    surface: str
    field: tuple[float, float] = (0.0, 0.0)
    pupil: tuple[float, float] = (0.0, 0.0)
    wavelength: float | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        direction = ray_at_surface(self, telescope).direction_behind
        x, y, z = telescope.surface(self.surface).along(direction)
        return float({"x": -x, "y": y, "z": -z}[self.axis]) + 0.0


@dataclass(frozen=True)
class _RmsOperand(GoalOperand):
    """Root mean square over the rays of one field point, with exact derivatives."""

    field: tuple[float, float]
    wavelengths: tuple[float, ...] | None = None
    n_pupil: int = 6
    merit: Merit | None = dataclasses.field(default=None, repr=False, compare=False, kw_only=True)

    _merits: ClassVar[type[SpotMerit] | type[WavefrontMerit]]

    @property
    def exact(self) -> bool:
        return True

    def bound(self, telescope: Telescope) -> Self:
        waves = None if self.wavelengths is None else list(self.wavelengths)
        rays = Beams.of(telescope, angles_of(self.field), waves, n_pupil=self.n_pupil)
        return replace(self, merit=type(self)._merits(telescope, rays))

    def _merit(self, telescope: Telescope) -> Merit:
        merit = self.merit or self.bound(telescope).merit
        assert merit is not None
        return merit

    def measure(self, telescope: Telescope) -> float:
        return float(np.linalg.norm(self._merit(telescope).residuals(telescope)))

    def gradient(self, columns: ParameterColumns) -> tuple[float, np.ndarray]:
        values, slopes = self._merit(columns.telescope).derivatives(columns)
        number = float(np.linalg.norm(values))
        return number, values @ slopes / max(number, np.finfo(float).tiny)


@operand_kind("rms_spot", "m")
@check_arguments
@dataclass(frozen=True)
class RmsSpot(_RmsOperand):
    """Rms radius [m] of the spot of one field point about its centroid, all wavelengths together.

    Parameters
    ----------
    field : tuple of float, shape (2,)
        Field angles [rad].
    wavelengths : tuple of float, optional
        Vacuum wavelengths [m]; the telescope's own by default.
    n_pupil : int
        Rings of pupil points.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [m].
    """

    _merits: ClassVar[type[SpotMerit] | type[WavefrontMerit]] = SpotMerit


@operand_kind("rms_wavefront", "m")
@check_arguments
@dataclass(frozen=True)
class RmsWavefront(_RmsOperand):
    """Rms wavefront [m] of one field point without piston and tilt.

    Parameters
    ----------
    field : tuple of float, shape (2,)
        Field angles [rad].
    wavelengths, n_pupil, value, minimum, maximum, weight
        As of :class:`RmsSpot`.
    """

    _merits: ClassVar[type[SpotMerit] | type[WavefrontMerit]] = WavefrontMerit


@operand_kind("mtf", "1")
@check_arguments
@dataclass(frozen=True)
class WavefrontMtf(GoalOperand):
    r"""Modulation transfer at one frequency, estimated from differences of the wavefront.

    The transfer function is the mean of ``exp(i k dW)`` over the overlap of the pupil with itself, shifted by the
    wavelength times the frequency, ``dW`` the difference of the wavefront between both. Here it is the overlap times
    ``exp(-k^2 var(dW) / 2)``, equal to second order in the wavefront. It falls steadily with the aberration, where the
    true one oscillates. The overlap is that of the light that arrives in the telescope at the start.

    Parameters
    ----------
    field : tuple of float, shape (2,)
        Field angles [rad].
    frequency : float
        Spatial frequency on the detector [cycles/m].
    angle : float
        Direction of the modulation on the detector [rad], from +x towards +y.
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand`.
    """

    field: tuple[float, float]
    frequency: float
    angle: float = 0.5 * math.pi
    wavelength: float | None = None
    shear: tuple[float, float] | None = dataclasses.field(default=None, repr=False, compare=False, kw_only=True)
    overlap: float | None = dataclasses.field(default=None, repr=False, compare=False, kw_only=True)

    def bound(self, telescope: Telescope) -> Self:  # noqa: D102
        wavelength = wavelength_of(self.wavelength, telescope)
        jacobian = image_jacobians(telescope, direction_of(self.field, telescope), wavelength)[0]
        # Exit direction cosines of pupil point p are those of the chief ray minus J^-T p.
        along = self.frequency * wavelength * np.array([math.cos(self.angle), math.sin(self.angle)])
        x, y = (float(v) for v in jacobian.T @ along)
        return replace(self, shear=(x, y), overlap=self._lit_overlap(telescope, np.array([x, y])))

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        if self.shear is None or self.overlap is None:
            return self.bound(telescope).measure(telescope)
        opd = self._wavefronts(telescope, _pupil_pairs(telescope, np.array(self.shear), _ACROSS))
        change = np.subtract(*opd)
        change = change[np.isfinite(change)]
        if not len(change):
            raise DomainError(f"operand {self.label}, {field_label(np.array(self.field))}: no light passes")
        wavelength = wavelength_of(self.wavelength, telescope)
        return self.overlap * math.exp(-0.5 * (2.0 * math.pi / wavelength) ** 2 * float(change.var()))

    def _wavefronts(self, telescope: Telescope, points: np.ndarray) -> np.ndarray:
        """Return the wavefronts [m] at points of two pupils [m], shape [2, 2, n] to [2, n]; NaN where not lit."""
        x, y = np.moveaxis(points, 1, 0).reshape(2, -1)
        wavelength = wavelength_of(self.wavelength, telescope)
        return wavefront_opd(telescope, self.field, wavelength, (x, y), threads=1).value.reshape(2, -1)

    def _lit_overlap(self, telescope: Telescope, shear: np.ndarray) -> float:
        """Return the overlap of the lit pupil with itself, shifted by `shear` [m], over its area."""
        outer = 0.5 * telescope.pupil_diameter
        inner, distance = outer * telescope.pupil_obscuration, float(np.hypot(*shear))
        annuli = _overlap(outer, outer, distance) - 2.0 * _overlap(outer, inner, distance)
        annuli = (annuli + _overlap(inner, inner, distance)) / (math.pi * (outer**2 - inner**2))
        if annuli <= 0.0:
            raise DomainError(f"operand {self.label}: expected a frequency below the cut-off of diffraction")
        # What apertures take from the annulus of the pupil, and from the overlap of two.
        lit, both_lit = (
            float(np.isfinite(self._wavefronts(telescope, _pupil_pairs(telescope, shift, _FINE))).all(axis=0).mean())
            for shift in (np.zeros(2), shear)
        )
        return annuli * both_lit / lit if lit else annuli


def _pupil_pairs(telescope: Telescope, shear: np.ndarray, across: int) -> np.ndarray:
    """Return points that lie in both of two pupils apart by `shear` [m], in the frame of each [m], shape [2, 2, n]."""
    outer = 0.5 * telescope.pupil_diameter
    inner = outer * telescope.pupil_obscuration
    line = outer * (2.0 * (np.arange(across) + 0.5) / across - 1.0)
    points = np.stack([v.ravel() for v in np.meshgrid(line, line)])
    pupils = np.stack([points + sign * 0.5 * shear[:, None] for sign in (1.0, -1.0)])
    radii = np.hypot(pupils[:, 0], pupils[:, 1])
    return pupils[:, :, ((inner <= radii) & (radii <= outer)).all(axis=0)]


def _overlap(first: float, second: float, distance: float) -> float:
    """Return the common area of two circles of given radii whose centres are apart by a distance."""
    if distance >= first + second:
        return 0.0
    if distance <= abs(first - second):
        return math.pi * min(first, second) ** 2
    cosines = [
        (distance**2 + sign * (first**2 - second**2)) / (2.0 * distance * r)
        for sign, r in ((1.0, first), (-1.0, second))
    ]
    angles = [math.acos(min(1.0, max(-1.0, c))) for c in cosines]
    return sum(r**2 * (a - 0.5 * math.sin(2.0 * a)) for r, a in zip((first, second), angles, strict=True))
