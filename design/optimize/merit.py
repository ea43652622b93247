"""Merit functions: residuals in metres, and their exact derivatives with respect to all variables.

The rays of a merit are those that are lit at the start; otherwise a merit could improve by vignetting.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ...core.errors import ConfigError, DomainError, shown
from ...core.units import field_label
from ...models.paraxial import following_stop
from ...models.telescope import Telescope
from ...raytrace.adjoint.backward_pass import image_gradient
from ...raytrace.adjoint.forward_pass import forward_pass
from ...raytrace.ideal_lens import image_points, require_image
from ...raytrace.rays import Rays, RayStatus, straight_bundles
from ...raytrace.trace import trace
from ...wavefront.pupil_sampling import PupilSampling, SamplingName
from ...wavefront.request import Request, relative_weights
from .aimed_rays import AimedRays
from .jacobian import ParameterColumns
from .wavefront_derivatives import FieldWavefronts, WavefrontBlock

#: Default points along the radius of the pupil.
_RINGS = 6
#: Factor from a reference sphere to a far one, and its largest radius [m]: paths to it are rounded to 2e-12 m.
_FARTHER = 1e3
_FARTHEST = 1e4


@dataclass(frozen=True)
class Beams:
    """Rays of a merit, and weights of a mean square over fields, shape [n_field]; they sum to 1."""

    request: Request
    field_weights: np.ndarray

    @classmethod
    def of(
        cls,
        telescope: Telescope | Request,
        fields: ArrayLike | None = None,
        wavelengths: ArrayLike | None = None,
        *,
        field_weights: ArrayLike | None = None,
        sampling: SamplingName | PupilSampling = "gauss",
        n_pupil: int | None = None,
        **options: Any,
    ) -> Beams:
        """Return the rays of a request, by default in 6 rings; further options are those of :meth:`Request.of`.

        Weights of the fields are those that the design data state, where neither fields nor weights are given. In place
        of a telescope stands a request with all of these but the weights.
        """
        if isinstance(telescope, Request):
            stated = {"fields": fields, "wavelengths": wavelengths, "n_pupil": n_pupil, **options}
            for name, value in stated.items():
                if value is not None:
                    raise ConfigError(f"{name} = {shown(value)}: given beside a Request, which has its own", key=name)
            telescope.require_nominal_detector("merit functions")
            request = telescope
        else:
            count = _RINGS if n_pupil is None and sampling == "gauss" else n_pupil
            request = Request.of(telescope, fields, wavelengths, sampling=sampling, n_pupil=count, **options)
        weights = request.stated_weights if field_weights is None else field_weights
        return cls(request, relative_weights(weights, len(request.fields), "field_weights"))

    def rays(self, telescope: Telescope, wavelength: float, pupil: np.ndarray | None = None) -> Rays:
        """Return the rays of one wavelength, field by field, through other pupil points [m] if these are given.

        Where rays are aimed, they are aimed at the stop of that telescope.
        """
        at = self.request.pupil.points if pupil is None else pupil
        points = self.request.entrance_points_of(telescope, wavelength, at)
        return straight_bundles(telescope, self.request.directions, wavelength, points)

    def weights(self, telescope: Telescope) -> np.ndarray:
        """Return the weight of each ray in the mean square, [n_wave, n_field, n_pupil]; zero where it is not lit."""
        fields, pupil, ray_weights = self.request.fields, self.request.pupil, []
        for wavelength in self.request.wavelengths:
            status = trace(telescope, self.rays(telescope, wavelength), threads=self.request.threads).status
            lit = (status == RayStatus.OK).reshape(len(fields), -1) * np.maximum(pupil.weights, 0.0)
            total = lit.sum(axis=1, keepdims=True)
            if not total.all():
                dark = fields[~total[:, 0].astype(bool)][0]
                raise DomainError(f"{field_label(dark)}: no ray reaches the image of {telescope.name}")
            ray_weights.append(lit / total * self.field_weights[:, None])
        return np.array(ray_weights) * self.request.weights[:, None, None]


def filling_stop(telescope: Telescope | Request) -> Telescope | Request:
    """Return a telescope, or a request, whose rays follow the stop when it changes."""
    if isinstance(telescope, Request):
        return replace(telescope, telescope=following_stop(telescope.telescope))
    return following_stop(telescope)


class Merit(Protocol):
    """Merit function: residuals whose sum of squares is minimised."""

    def residuals(self, telescope: Telescope) -> np.ndarray:
        """Return the residuals of a telescope [m], shape [n]; NaN where rays are lost."""

    def derivatives(self, columns: ParameterColumns) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals [m], shape [n], and their derivatives, shape [n, n_parameter]."""

    def size_of_terms(self, columns: ParameterColumns) -> np.ndarray:
        """Return the size of the terms that cancel where a variable has no effect [m], shape [n_parameter]."""


class SpotMerit:
    """Landing points relative to the centroid of each field point, all wavelengths together.

    The sum of squares is the mean square radius of the spots. The rays are those that are lit in `telescope`. With
    `reference` "chief", landing points refer to the chief ray of the first wavelength. `heights` [m], shape [n_field],
    are those of the image surface, such as a CCD, above the detector: rays continue straight to it, and derivatives
    leave out the change of their slopes, 1e-6 of them for 10 um.
    """

    def __init__(self, telescope: Telescope, beams: Beams, reference: str = "centroid", heights: Any = None) -> None:
        self._beams = beams
        self._weights = beams.weights(telescope)
        self._reference = reference
        n_field = len(beams.request.fields)
        field_heights = np.zeros(n_field) if heights is None else np.asarray(heights, dtype=np.float64)
        if field_heights.any():
            require_image(telescope, "a height of the image surface")
        if field_heights.shape != (n_field,):
            raise DomainError(
                f"heights of shape {list(field_heights.shape)}: expected one for each of {n_field} fields"
            )
        # One for each ray, field by field.
        self._heights = np.repeat(field_heights, len(beams.request.pupil))

    def residuals(self, telescope: Telescope) -> np.ndarray:  # noqa: D102
        landing = []
        for wavelength in self._beams.request.wavelengths:
            end = trace(telescope, self._beams.rays(telescope, wavelength), threads=self._beams.request.threads)
            position = telescope.surfaces[-1].to_local(image_points(telescope, end))[:, :2].T
            landing.append(position + self._beyond(telescope, end.direction))
        chief = None
        if self._reference == "chief":
            end = trace(telescope, self._chief_rays(telescope), threads=self._beams.request.threads)
            chief = telescope.surfaces[-1].to_local(image_points(telescope, end))[:, :2].T[..., None]
        return self._reduced(np.array(landing)[..., None], chief).ravel()

    def derivatives(self, columns: ParameterColumns) -> tuple[np.ndarray, np.ndarray]:  # noqa: D102
        stacked = []
        for wavelength in self._beams.request.wavelengths:
            aimed = AimedRays(columns, self._beams.request, float(wavelength), self._beams.request.pupil.points)
            stacked.append(self._landing(aimed))
            if self._heights.any():
                end = trace(columns.telescope, aimed.rays, threads=self._beams.request.threads)
                stacked[-1][..., 0] += self._beyond(columns.telescope, end.direction)
        chief = None
        if self._reference == "chief":
            first = float(self._beams.request.wavelengths[0])
            chief = self._landing(AimedRays(columns, self._beams.request, first, np.zeros((1, 2))))
        reduced = self._reduced(np.array(stacked), chief)
        return reduced[..., 0].ravel(), reduced[..., 1:].reshape(-1, reduced.shape[-1] - 1)

    def size_of_terms(self, columns: ParameterColumns) -> np.ndarray:  # noqa: D102
        forward = forward_pass(
            columns.telescope, self._beams.rays(columns.telescope, float(self._beams.request.wavelengths[0]))
        )
        return columns.size_of_terms(forward, image_gradient(forward), threads=self._beams.request.threads)

    def _chief_rays(self, telescope: Telescope) -> Rays:
        return self._beams.rays(telescope, float(self._beams.request.wavelengths[0]), np.zeros((1, 2)))

    def _beyond(self, telescope: Telescope, direction: np.ndarray) -> np.ndarray:
        """Return the shift of the landing points of rays [n, 3] from the detector to the heights [m], [2, n]."""
        along = telescope.surfaces[-1].along(direction)
        return (along[:, :2] / along[:, 2:]).T * self._heights

    def _landing(self, aimed: AimedRays) -> np.ndarray:
        """Return landing points and, behind them, their derivatives, shape [2, n, 1 + n_parameter]."""
        forward = aimed.forward(self._beams.request.threads)
        change = aimed.derivatives(forward, image_gradient(forward), self._beams.request.threads)
        return np.concatenate([forward.image[..., None], change], axis=2)

    def _reduced(self, landing: np.ndarray, chief: np.ndarray | None) -> np.ndarray:
        """Return weighted deviations of [n_wave, 2, n_field * n_pupil, k] from the centroid or the chief ray's."""
        weights = self._weights
        values = landing.reshape(len(weights), 2, *weights.shape[1:], -1)
        # Rays that are not lit have no weight and may be NaN.
        values = np.where((weights > 0)[:, None, ..., None], values, 0.0)
        if chief is None:
            total = weights.sum(axis=(0, 2))
            # Fields of no weight have no centroid, and count for nothing.
            mean = np.einsum("wfp,wxfpk->xfk", weights, values) / np.where(total > 0.0, total, 1.0)[:, None]
        else:
            mean = chief
        return np.sqrt(weights)[:, None, ..., None] * (values - mean[:, :, None])


class WavefrontMerit:
    """Wavefront without piston and tilt, minus a goal [m], shape [n_field, n_wave, n_pupil], whose NaN do not count.

    The sum of squares is the mean square of the wavefront. The rays are those that are lit in `telescope`.
    """

    def __init__(self, telescope: Telescope, beams: Beams, goal: Any = None) -> None:
        self._beams, self._far = beams, False
        self._has_goal = goal is not None
        weights = beams.weights(telescope)
        self._goal = np.zeros(weights.shape)
        if goal is not None:
            target = np.asarray(goal, dtype=np.float64)
            expected = (*weights.shape[1::-1], weights.shape[2])
            if target.shape != expected:
                raise DomainError(
                    f"goal of shape {list(target.shape)}: expected {list(expected)}, field by wave by ray"
                )
            target = target.transpose(1, 0, 2)
            finite = np.isfinite(target)
            total = weights.sum(axis=2, keepdims=True)
            weights = np.where(finite, weights, 0.0)
            self._goal = np.where(finite, target, 0.0)
            weights *= total / np.maximum(weights.sum(axis=2, keepdims=True), np.finfo(float).tiny)
        self._roots = np.sqrt(weights)
        # Orthonormal basis of piston and tilts, to be removed from each wavefront.
        x, y = beams.request.pupil.points.T / (0.5 * telescope.pupil_diameter)
        tilts = self._roots[..., None] * np.stack([np.ones_like(x), x, y], axis=-1)
        self._basis = np.linalg.qr(tilts)[0]

    def on_far_spheres(self) -> WavefrontMerit:
        """Return the merit on reference spheres far away; itself with a goal, which is that on the nearer ones.

        On the telescope's own sphere it is perfect where its focus lies on that sphere, however large its spots are.
        """
        if self._has_goal:
            return self
        far = copy(self)
        far._far = True
        return far

    def residuals(self, telescope: Telescope) -> np.ndarray:  # noqa: D102
        return self.derivatives(ParameterColumns.at(telescope, ()))[0]

    def derivatives(self, columns: ParameterColumns) -> tuple[np.ndarray, np.ndarray]:  # noqa: D102
        beams, parts = self._beams, []
        if self._far:
            columns = replace(columns, telescope=_with_far_sphere(columns.telescope))
        for i, wavelength in enumerate(beams.request.wavelengths):
            weights = columns.weights_at(float(wavelength))

            def reduced(block: WavefrontBlock, i: int = i, weights: np.ndarray = weights) -> np.ndarray:
                roots, basis = self._roots[i, block.fields], self._basis[i, block.fields]
                value = block.value - self._goal[i, block.fields]
                # NaN for a lost ray makes the solver take a shorter step.
                value = np.where((block.status > RayStatus.VIGNETTED) & (roots > 0), np.nan, value)
                rows = roots[..., None] * np.concatenate([value[..., None], block.change(weights)], axis=2)
                return (rows - basis @ (basis.transpose(0, 2, 1) @ rows)).reshape(-1, rows.shape[-1])

            parts += FieldWavefronts(columns, beams.request, float(wavelength)).map(reduced)
        stacked = np.concatenate(parts)
        return stacked[:, 0], stacked[:, 1:]

    def size_of_terms(self, columns: ParameterColumns) -> np.ndarray:  # noqa: D102
        request = self._beams.request
        weights = np.abs(columns.weights_at(float(request.wavelengths[0])))

        def squares(block: WavefrontBlock) -> np.ndarray:
            size = np.abs(block.by_center) @ np.abs(block.moved) + np.abs(block.columns) @ weights
            return (size**2).sum(axis=(0, 1))

        total = sum(FieldWavefronts(columns, request, float(request.wavelengths[0])).map(squares))
        return np.sqrt(total / (len(request.fields) * len(request.pupil)))


def _with_far_sphere(telescope: Telescope) -> Telescope:
    radius = telescope.reference_sphere_radius
    return replace(telescope, reference_sphere_radius=max(radius, min(_FARTHER * radius, _FARTHEST)))
