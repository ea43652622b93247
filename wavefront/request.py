"""Rays of a calculation: field points, wavelengths and pupil points, validated once for all functions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments, removed_arguments
from ..core.errors import ConfigError, DomainError, shown
from ..core.number_text import counted
from ..core.units import metres, pure_numbers, radians
from ..models.camera.focal_plane import FocalPlane
from ..models.design_data import unvignetted, vignetted
from ..models.telescope import Telescope
from ..raytrace.aiming import AimedPoints, pupil_coordinates
from ..raytrace.ideal_lens import require_image
from ..raytrace.launch import aimed_points
from ..raytrace.pack.surfaces import refractive_indices
from ..raytrace.rays import Projection, Rays, RayStatus, field_direction, straight_bundles
from ..raytrace.trace import trace
from .bundles import Bundles
from .design_fields import design_fields
from .pupil_sampling import PupilSampling, SamplingName, pupil_sampling
from .vignetting_factors import made_factors

#: Rays in one part of a request: 15 float64 numbers each, so some 60 MB.
RAYS_AT_ONCE = 1 << 19
#: Radii of the default field points over the radius of the field; for the LSST 0, 0.5, 1, 1.5 and 1.75 degrees.
_RADII = np.array([0.0, 2.0, 4.0, 6.0, 7.0]) / 7.0

#: Statuses of chief rays that have an image point: apertures do not stop them, nor do gaps between the CCDs.
_CHIEF = (RayStatus.OK, RayStatus.VIGNETTED, RayStatus.GAP)


@dataclass(frozen=True, eq=False)
class Request:
    """Rays of a calculation: all field points at all wavelengths through all pupil points.

    :meth:`of` makes one from the arguments that many functions share; they are documented there.

    Attributes
    ----------
    telescope, projection, threads
        As in :meth:`of`.
    fields : ndarray, shape [n_field, 2]
        Field angles [rad].
    wavelengths : ndarray, shape [n_wave]
        Vacuum wavelengths [m].
    weights : ndarray, shape [n_wave]
        Relative amounts of light of the wavelengths; they sum to 1.
    pupil : PupilSampling
        Points of the entrance pupil.
    primary : float, optional
        Wavelength that reference points belong to [m], where it is one of `wavelengths`; else the one in their middle.
    vignetting : ndarray, shape [n_field, 5], optional
        Vignetting factors of the fields, which change their pupil points, see :class:`~pachon.models.DesignData`.
    stated_weights : ndarray, shape [n_field], optional
        Weights of the fields that the design data state.
    focal_plane : FocalPlane, optional
        CCD surfaces on which rays land (:meth:`on`); the nominal detector surface without it.
    """

    telescope: Telescope
    fields: np.ndarray
    wavelengths: np.ndarray
    weights: np.ndarray
    pupil: PupilSampling
    projection: Projection
    threads: int | None
    primary: float | None = None
    vignetting: np.ndarray | None = None
    stated_weights: np.ndarray | None = None
    focal_plane: FocalPlane | None = None

    def __repr__(self) -> str:
        waves = ", ".join(f"{1e9 * w:.5g}" for w in self.wavelengths[:3]) + ", ..." * (len(self.wavelengths) > 3)
        fields, points = counted(len(self.fields), "field"), counted(len(self.pupil), "pupil point")
        return f"<Request: {self.telescope.name}, {fields}, {waves} nm, {points}>"

    @classmethod
    @removed_arguments(aiming="telescope=telescope.with_design(aiming=...)")
    @check_arguments
    def of(
        cls,
        telescope: Telescope | Request,
        fields: ArrayLike | None = None,
        wavelengths: ArrayLike | None = None,
        *,
        wavelength_weights: ArrayLike | None = None,
        sampling: SamplingName | PupilSampling | None = None,
        n_pupil: int | None = None,
        projection: Projection | None = None,
        threads: int | None = None,
        one_wavelength: bool = False,
        default_fields: Callable[[Telescope], ArrayLike] | None = None,
    ) -> Request:
        """Validate a request and fill in its defaults.

        Parameters
        ----------
        telescope : Telescope or Request
            The telescope; or a request in place of it and of all that it holds. Beside a request, only pupil points and
            threads may be given, and stand in place of its own.
        fields : array_like or Quantity, shape [n_field, 2] or [2], optional
            Field angles [rad]: slopes of the light's own travel, in the stated projection. By default those that the
            design data of the telescope state, with their vignetting factors and weights; where they state none, five
            points from the axis to the edge of the field along +y.
        wavelengths : array_like or Quantity, shape [n_wave] or scalar, optional
            Vacuum wavelengths [m]. By default those that the design data state, with their weights; where they state
            none, the telescope's default.
        wavelength_weights : array_like, shape [n_wave], optional
            Relative amounts of light in front of the telescope; equal by default, but for wavelengths of the design
            data.
        sampling : {"gauss", "rings", "spiral", "square"} or PupilSampling
            Points of the entrance pupil, see :func:`~pachon.pupil_sampling`; "gauss" by default.
        n_pupil : int, optional
            Points along the radius (gauss, rings), in all (spiral) or along the diameter (square).
        projection : {"zemax", "gnomonic", "postel"}
            Meaning of the field angles, see :func:`~pachon.raytrace.rays.field_direction`; "zemax" by default.
        threads : int, optional
            Number of threads; all processors by default. Results do not depend on it.
        one_wavelength : bool
            Whether no wavelength means the telescope's default alone, and a request may have one only.
        default_fields : callable, optional
            Field angles [rad] of a telescope, in place of the defaults above.

        Raises
        ------
        ConfigError
            If the sampling or the projection is unknown, or fields, wavelengths, weights or projection are given
            beside a request.
        DomainError
            If an array has another shape, a field point or wavelength lies outside what the telescope covers, or a
            weight is negative.
        """
        if isinstance(telescope, Request):
            held = {"fields": fields, "wavelengths": wavelengths, "wavelength_weights": wavelength_weights}
            for name, value in (held | {"projection": projection}).items():
                if value is not None:
                    raise ConfigError(f"{name} = {shown(value)}: given beside a Request, which has its own", key=name)
            if one_wavelength:
                _ = telescope.wavelength
            return telescope._with(sampling, n_pupil, threads)
        projection = "zemax" if projection is None else projection
        if fields is None and default_fields is not None:
            fields = default_fields(telescope)
        data = telescope.design_data
        points = field_points(telescope, fields, projection)
        own_waves = wavelengths is None and not one_wavelength and bool(data.wavelengths)
        waves = wavelength_points(telescope, data.wavelengths if own_waves else wavelengths)
        if own_waves and wavelength_weights is None:
            wavelength_weights = data.wavelength_weights or None
        weights = relative_weights(wavelength_weights, len(waves))
        pupil = pupil_sampling(telescope, "gauss" if sampling is None else sampling, n_pupil)
        primary = telescope.default_wavelength if own_waves else None
        vignetting = np.array(data.vignetting) if fields is None and data.vignetting else None
        if fields is None and data.fields and data.remake_vignetting:
            vignetting = made_factors(telescope, design_fields(telescope))
        stated = np.array(data.field_weights) if fields is None and data.field_weights else None
        request = cls(telescope, points, waves, weights, pupil, projection, threads, primary, vignetting, stated)
        _ = request.directions  # an unknown projection is an error of the request, not of its first use
        return request

    def _with(self, sampling: SamplingName | PupilSampling | None, n_pupil: int | None, threads: int | None) -> Request:
        """Return the request with other pupil points and threads, where given."""
        changes: dict[str, Any] = {} if threads is None else {"threads": threads}
        if sampling is not None or n_pupil is not None:
            changes["pupil"] = pupil_sampling(self.telescope, "gauss" if sampling is None else sampling, n_pupil)
        return replace(self, **changes) if changes else self

    @check_arguments
    def on(self, focal_plane: FocalPlane | None) -> Request:
        """Return the request whose rays land on the CCDs.

        Every analysis that lands rays on the detector takes it in place of a telescope. Light that falls between the
        CCDs is lost; a chief ray there stays on the nominal surface.

        Parameters
        ----------
        focal_plane : FocalPlane or None
            CCD surfaces; None leaves the request as it is.

        Raises
        ------
        ConfigError
            If the request has a focal plane already.
        DomainError
            If light is parallel behind the telescope.
        """
        if focal_plane is None:
            return self
        if self.focal_plane is not None:
            raise ConfigError("focal_plane: given beside a Request, which has its own", key="focal_plane")
        require_image(self.telescope, "a focal plane")
        return replace(self, focal_plane=focal_plane)

    def require_nominal_detector(self, purpose: str) -> None:
        """Refuse a focal plane for a purpose that knows the nominal detector surface only."""
        if self.focal_plane is not None:
            raise ConfigError(f"focal_plane: expected none for {purpose}, on the nominal detector", key="focal_plane")

    def require_one_field(self) -> None:
        """Refuse several fields for what is of one alone."""
        if len(self.fields) != 1:
            raise DomainError(f"field: {len(self.fields)} fields are given; expected one")

    def at_fields(self, fields: np.ndarray | slice) -> Request:
        """Return the request for a part of its fields, or for other field angles [rad], without vignetting factors."""
        if not isinstance(fields, slice):
            return replace(self, fields=fields, vignetting=None, stated_weights=None)
        factors, stated = (None if v is None else v[fields] for v in (self.vignetting, self.stated_weights))
        return replace(self, fields=self.fields[fields], vignetting=factors, stated_weights=stated)

    @cached_property
    def directions(self) -> np.ndarray:
        """Unit vectors in which the light of each field point travels, telescope frame, shape [n_field, 3]."""
        return field_direction(self.fields[:, 0], self.fields[:, 1], self.projection)

    @property
    def slopes(self) -> np.ndarray:
        """Slopes (vx, vy) / abs(vz) of the light of each field point, shape [n_field, 2]."""
        return self.directions[:, :2] / -self.directions[:, 2:]

    @property
    def field_weights(self) -> np.ndarray:
        """Weights of a mean over the fields, shape [n_field]: those that the design data state, or equal ones."""
        return relative_weights(self.stated_weights, len(self.fields), "field_weights")

    @property
    def pupil_areas(self) -> np.ndarray:
        """Area of the pupil of each field over that of one without vignetting factors, shape [n_field]."""
        if self.vignetting is None:
            return np.ones(len(self.fields))
        return np.asarray(np.abs((1.0 - self.vignetting[:, 2:4]).prod(axis=1)))

    @property
    def middle(self) -> float:
        """Wavelength to which reference points belong [m]: the primary one, or that in the middle of the list."""
        return float(self.wavelengths[self.middle_index])

    @property
    def middle_index(self) -> int:
        """Index of :attr:`middle` among the wavelengths."""
        primary = np.flatnonzero(self.wavelengths == self.primary)
        return int(primary[0]) if len(primary) else len(self.wavelengths) // 2

    @property
    def wavelength(self) -> float:
        """The only wavelength [m]; several of them are a :class:`~pachon.errors.DomainError`."""
        if len(self.wavelengths) != 1:
            raise DomainError(f"wavelength: {len(self.wavelengths)} wavelengths are given; expected one")
        return float(self.wavelengths[0])

    @property
    def unit_pupil(self) -> np.ndarray:
        """Pupil points in units of the radius of the entrance pupil, shape [n_pupil, 2]."""
        return self.pupil.points / (0.5 * self.telescope.pupil_diameter)

    @check_arguments
    def launch(self, wavelength: float, pupil: np.ndarray | None = None) -> Rays:
        """Return the rays of one wavelength [m], field by field, through other pupil points [m] where given.

        Pupil points are [n_pupil, 2], the same for all fields, or [n_field, n_pupil, 2].
        """
        points = self.entrance_points(wavelength, self.pupil.points if pupil is None else pupil)
        return straight_bundles(self.telescope, self.directions, wavelength, points)

    def entrance_points(self, wavelength: float, pupil: np.ndarray) -> np.ndarray:
        """Return where rays of pupil points [n_pupil, 2] [m] cross the plane of the entrance pupil [m].

        Their shape is [n_pupil, 2], or [n_field, n_pupil, 2] where each field has its own. DomainError if the chief ray
        of a field cannot be aimed.
        """
        return aimed_points(self.telescope, self.directions, wavelength, self.vignetted(pupil))

    def entrance_points_of(self, telescope: Telescope, wavelength: float, pupil: np.ndarray) -> np.ndarray:
        """Return :meth:`entrance_points` of a telescope like that of the request, such as a perturbed one.

        Those of the request's own telescope are found once; they are where the search for others starts.
        """
        start = self.aimed_start.at(wavelength, self.vignetted(pupil))
        if telescope is self.telescope:
            return start.points
        points = replace(self, telescope=telescope).vignetted(pupil)
        moved = start.moved(telescope, self.directions, wavelength, points)
        return aimed_points(telescope, self.directions, wavelength, points) if moved is None else moved

    @cached_property
    def aimed_start(self) -> AimedStart:
        """Aimed points of the request's own telescope, where the search for those of a telescope like it starts."""
        return AimedStart(self.telescope, self.directions)

    def vignetted(self, pupil: np.ndarray) -> np.ndarray:
        """Return pupil points [m] with the vignetting factors of each field, [n_field, n_pupil, 2].

        They are [n_pupil, 2], or differ by field. Without vignetting factors they are returned as they are.
        """
        if self.vignetting is None:
            return pupil
        radius = 0.5 * self.telescope.pupil_diameter
        return radius * vignetted(pupil / radius, self.vignetting)

    def pupil_coordinates(self, wavelength: float, entrance: np.ndarray) -> np.ndarray:
        """Return the pupil points [m] of the only field for points [n, 2] [m] of the plane of the entrance pupil.

        The inverse of :meth:`entrance_points`; NaN where a ray does not reach the stop.
        """
        points = pupil_coordinates(self.telescope, self.directions[0], wavelength, entrance)
        if self.vignetting is None:
            return points
        radius = 0.5 * self.telescope.pupil_diameter
        return radius * unvignetted(points / radius, self.vignetting[0])

    @check_arguments
    def bundles(
        self, wavelength: float, pupil: np.ndarray | None = None, *, entrance: np.ndarray | None = None
    ) -> Bundles:
        """Trace the rays of :meth:`launch` to the detector.

        Or those of the only field through points `entrance` [n, 2] [m] of the plane of the entrance pupil, not aimed.
        """
        # The chief ray is traced as one more point of the pupil.
        if entrance is None:
            points = self.pupil.points if pupil is None else pupil
            rays = self.launch(wavelength, np.concatenate([points, np.zeros((*points.shape[:-2], 1, 2))], axis=-2))
        else:
            chief = self.entrance_points_of(self.telescope, wavelength, np.zeros((1, 2))).reshape(1, 2)
            through = np.concatenate([entrance, chief])
            rays = straight_bundles(self.telescope, self.directions, wavelength, through)
        end = trace(self.telescope, rays, focal_plane=self.focal_plane, threads=self.threads)
        n, detector = len(self.fields), self.telescope.surfaces[-1]
        position = detector.to_local(end.position).reshape(n, -1, 3)
        direction = detector.along(end.direction).reshape(n, -1, 3)
        path, status = end.path_length.reshape(n, -1), end.status.reshape(n, -1)
        return Bundles(
            position=position[:, :-1],
            direction=direction[:, :-1],
            path=path[:, :-1],
            status=status[:, :-1],
            chief_position=np.where(np.isin(status[:, -1:], _CHIEF), position[:, -1], np.nan),
            chief_direction=direction[:, -1],
            chief_path=path[:, -1],
            index=float(refractive_indices(self.telescope, wavelength)[-2]),
            wavelength=wavelength,
            afocal=self.telescope.design_data.afocal,
        )

    def parts(self) -> Iterator[tuple[slice, Request]]:
        """Yield slices of the field points and their requests, which bound the memory for many field points."""
        step = max(1, RAYS_AT_ONCE // (len(self.pupil) + 1))
        for first in range(0, len(self.fields), step):
            field_slice = slice(first, min(first + step, len(self.fields)))
            yield field_slice, self.at_fields(field_slice)


@check_arguments
def field_points(telescope: Telescope, fields: ArrayLike | None = None, projection: Projection = "zemax") -> np.ndarray:
    """Return field angles [rad], shape [n, 2], that the telescope covers.

    Parameters
    ----------
    telescope, fields, projection
        As in :meth:`Request.of`.

    Raises
    ------
    DomainError
        If the shape is another, or a point lies outside what the telescope covers.
    """
    if fields is None and telescope.design_data.fields:
        fields = design_fields(telescope, projection)
    elif fields is None:
        fields = np.stack([np.zeros(len(_RADII)), _RADII * telescope.field_radius], axis=-1)
    points = np.atleast_2d(radians(fields, "fields"))
    if points.ndim != 2 or points.shape[1] != 2 or not len(points):
        raise DomainError(f"fields of shape {points.shape}: expected field angles x, y, shape [n, 2]")
    telescope.check_field(points[:, 0], points[:, 1])
    return points


def wavelength_points(telescope: Telescope, wavelengths: ArrayLike | None = None) -> np.ndarray:
    """Return wavelengths [m], shape [n], that the telescope covers; its default where none is given."""
    values = np.atleast_1d(metres(telescope.default_wavelength if wavelengths is None else wavelengths, "wavelengths"))
    if values.ndim != 1 or not len(values):
        raise DomainError(f"wavelengths of shape {values.shape}: expected one wavelength or a list")
    telescope.check_wavelength(values)
    return values


def relative_weights(weights: ArrayLike | None, count: int, name: str = "wavelength_weights") -> np.ndarray:
    """Return so many weights of sum 1, equal where none are given; negative or all zero they are a DomainError."""
    values = np.ones(count) if weights is None else pure_numbers(weights, name)
    if values.shape != (count,) or not (np.isfinite(values).all() and (values >= 0).all() and values.sum() > 0):
        raise DomainError(f"{name} = {shown(weights)}: expected {count} numbers, none negative, not all zero")
    return values / values.sum()


class AimedStart:
    """Points of the entrance pupil that aimed rays of some directions cross, each set computed at its first use."""

    def __init__(self, telescope: Telescope, directions: np.ndarray) -> None:
        self._telescope, self._directions = telescope, directions
        self._computed: dict[tuple[float, bytes], AimedPoints] = {}

    def at(self, wavelength: float, pupil: np.ndarray) -> AimedPoints:
        """Return those of pupil points [m], [n_pupil, 2] or [n_field, n_pupil, 2]; DomainError as `aimed_points`."""
        key = (wavelength, pupil.tobytes())
        if key not in self._computed:
            points = aimed_points(self._telescope, self._directions, wavelength, pupil)
            self._computed[key] = AimedPoints.of(self._telescope, self._directions, wavelength, pupil, points)
        return self._computed[key]
