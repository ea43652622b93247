"""What an optimisation makes small: residuals in metres, and their exact derivatives with respect to all variables.

The rays of a merit are chosen once, those that are lit at the start; a merit that lost rays on the way would improve by
vignetting itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ...core.errors import DomainError
from ...models.telescope import Telescope
from ...raytrace.adjoint.backward_pass import landing_gradient
from ...raytrace.adjoint.forward_pass import forward_pass
from ...raytrace.rays import Rays, RayStatus, field_direction, parallel_rays
from ...raytrace.trace import trace
from ...wavefront.pupil_sampling import PupilSampling, pupil_sampling
from ...wavefront.request import field_points, wavelength_points
from .jacobian import ParameterColumns
from .wavefront_derivatives import FieldWavefronts, WavefrontBlock

#: Points along the radius of the pupil by default.
_RINGS = 6


@dataclass(frozen=True)
class Beams:
    """The rays of a merit: field points, wavelengths, points of the pupil, and what each weighs.

    Attributes
    ----------
    fields : ndarray, shape [n_field, 2]
        Field angles [rad].
    wavelengths : ndarray, shape [n_wave]
        Vacuum wavelengths [m].
    pupil : PupilSampling
        Points of the pupil.
    field_weights, wavelength_weights : ndarray
        Weights of a mean square over fields and over wavelengths; each sums to 1.
    projection : str
        Meaning of the field angles.
    threads : int, optional
        Number of threads.
    """

    fields: np.ndarray
    wavelengths: np.ndarray
    pupil: PupilSampling
    field_weights: np.ndarray
    wavelength_weights: np.ndarray
    projection: str = "zemax"
    threads: int | None = None

    def rays(self, telescope: Telescope, wavelength: float) -> Rays:
        """Return the rays of one wavelength, field by field."""
        light = field_direction(self.fields[:, 0], self.fields[:, 1], self.projection)
        return parallel_rays(telescope, light, wavelength, self.pupil.points)

    def wavefronts(self, columns: ParameterColumns, wavelength: float) -> FieldWavefronts:
        """Return the wavefronts of one wavelength."""
        return FieldWavefronts(columns, self.fields, wavelength, self.pupil.points, self.projection, self.threads)

    def weights(self, telescope: Telescope) -> np.ndarray:
        """Return the weight of each ray in the mean square, [n_wave, n_field, n_pupil]; zero where it is not lit.

        Raises
        ------
        DomainError
            If no ray of a field point is lit.
        """
        found = []
        for wavelength in self.wavelengths:
            status = trace(telescope, self.rays(telescope, wavelength), threads=self.threads).status
            lit = (status == RayStatus.OK).reshape(len(self.fields), -1) * np.maximum(self.pupil.weights, 0.0)
            total = lit.sum(axis=1, keepdims=True)
            if not total.all():
                x, y = np.rad2deg(self.fields[~total[:, 0].astype(bool)][0])
                raise DomainError(f"field = ({x:.6g}, {y:.6g}) deg: no ray reaches the image of {telescope.name}")
            found.append(lit / total * self.field_weights[:, None])
        return np.array(found) * self.wavelength_weights[:, None, None]


def beams(
    telescope: Telescope,
    fields: Any = None,
    wavelengths: Any = None,
    field_weights: Any = None,
    wavelength_weights: Any = None,
    sampling: Any = "gauss",
    count: int | None = None,
    projection: str = "zemax",
    threads: int | None = None,
) -> Beams:
    """Return the rays of a merit; parameters are those of :func:`~.optimize.optimize`."""
    points, waves = field_points(telescope, fields), wavelength_points(telescope, wavelengths)
    pupil = pupil_sampling(telescope, sampling, _RINGS if count is None and sampling == "gauss" else count)
    by_field = _weights(field_weights, len(points), "field")
    by_wavelength = _weights(wavelength_weights, len(waves), "wavelength")
    return Beams(points, waves, pupil, by_field, by_wavelength, projection, threads)


def _weights(given: Any, count: int, name: str) -> np.ndarray:
    weights = np.ones(count) if given is None else np.asarray(given, dtype=np.float64)
    if weights.shape != (count,) or not np.isfinite(weights).all() or (weights < 0).any() or not weights.any():
        raise DomainError(f"{name}_weights: expected {count} numbers, none negative and not all zero")
    return weights / weights.sum()


class Merit(Protocol):
    """Residuals whose sum of squares is to be small."""

    def residuals(self, telescope: Telescope) -> np.ndarray:
        """Return the residuals of a telescope [m], shape [n]; NaN where rays got lost."""
        ...

    def derivatives(self, columns: ParameterColumns) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals [m], shape [n], and their derivatives, shape [n, n_parameter]."""
        ...

    def size_of_terms(self, columns: ParameterColumns) -> np.ndarray:
        """Return how large the terms are that cancel where a variable has no effect [m], shape [n_parameter]."""
        ...


class SpotMerit:
    """Landing points less the centroid of each field point's light, all wavelengths together.

    The sum of squares is the mean square radius of the spots.

    Parameters
    ----------
    telescope : Telescope
        The telescope at the start: its lit rays are the merit's.
    beams : Beams
        The rays.
    reference : {"centroid", "chief"}
        What spots are measured from; "chief" is the chief ray of the first wavelength.
    heights : array_like, shape [n_field], optional
        Height of the image surface at each field point above the detector, along its own z [m]: that of a CCD. Rays
        go on straight to it; derivatives leave out how the slopes of rays change there, 1e-6 of them for 10 um.
    """

    def __init__(self, telescope: Telescope, beams: Beams, reference: str = "centroid", heights: Any = None) -> None:
        self._beams = beams
        self._weights = beams.weights(telescope)
        self._reference = reference
        given = np.zeros(len(beams.fields)) if heights is None else np.asarray(heights, dtype=np.float64)
        if given.shape != (len(beams.fields),):
            raise DomainError(
                f"heights of shape {list(given.shape)}: expected one for each of {len(beams.fields)} fields"
            )
        # One for each ray, field by field.
        self._heights = np.repeat(given, len(beams.pupil))

    def residuals(self, telescope: Telescope) -> np.ndarray:  # noqa: D102
        landing = []
        for wavelength in self._beams.wavelengths:
            end = trace(telescope, self._beams.rays(telescope, wavelength), threads=self._beams.threads)
            position = telescope.surfaces[-1].to_local(end.position)[:, :2].T
            landing.append(position + self._beyond(telescope, end.direction))
        chief = None
        if self._reference == "chief":
            end = trace(telescope, self._chief_rays(telescope), threads=self._beams.threads)
            chief = telescope.surfaces[-1].to_local(end.position)[:, :2].T[..., None]
        return self._reduced(np.array(landing)[..., None], chief).ravel()

    def derivatives(self, columns: ParameterColumns) -> tuple[np.ndarray, np.ndarray]:  # noqa: D102
        stacked = []
        for wavelength in self._beams.wavelengths:
            rays = self._beams.rays(columns.telescope, wavelength)
            stacked.append(self._landing(columns, rays))
            if self._heights.any():
                end = trace(columns.telescope, rays, threads=self._beams.threads)
                stacked[-1][..., 0] += self._beyond(columns.telescope, end.direction)
        chief = None
        if self._reference == "chief":
            chief = self._landing(columns, self._chief_rays(columns.telescope))
        reduced = self._reduced(np.array(stacked), chief)
        return reduced[..., 0].ravel(), reduced[..., 1:].reshape(-1, reduced.shape[-1] - 1)

    def size_of_terms(self, columns: ParameterColumns) -> np.ndarray:  # noqa: D102
        forward = forward_pass(
            columns.telescope, self._beams.rays(columns.telescope, float(self._beams.wavelengths[0]))
        )
        return columns.size_of_terms(forward, landing_gradient(forward), threads=self._beams.threads)

    def _chief_rays(self, telescope: Telescope) -> Rays:
        light = field_direction(self._beams.fields[:, 0], self._beams.fields[:, 1], self._beams.projection)
        return parallel_rays(telescope, light, float(self._beams.wavelengths[0]), np.zeros((1, 2)))

    def _beyond(self, telescope: Telescope, direction: np.ndarray) -> np.ndarray:
        """Return how much farther rays [n, 3] land at the heights than on the detector [m], [2, n]."""
        along = direction @ telescope.surfaces[-1].matrix
        return (along[:, :2] / along[:, 2:]).T * self._heights

    def _landing(self, columns: ParameterColumns, rays: Rays) -> np.ndarray:
        """Return landing points and, behind them, their derivatives, shape [2, n, 1 + n_parameter]."""
        forward = forward_pass(columns.telescope, rays, threads=self._beams.threads)
        change = columns.derivatives(forward, landing_gradient(forward), threads=self._beams.threads)
        return np.concatenate([forward.landing[:2, :, None], change], axis=2)

    def _reduced(self, landing: np.ndarray, chief: np.ndarray | None) -> np.ndarray:
        """Return weighted deviations of [n_wave, 2, n_field * n_pupil, k] from the centroid or the chief ray's."""
        weights = self._weights
        values = landing.reshape(len(weights), 2, *weights.shape[1:], -1)
        # What is not lit has no weight, and may be NaN.
        values = np.where((weights > 0)[:, None, ..., None], values, 0.0)
        if chief is None:
            mean = np.einsum("wfp,wxfpk->xfk", weights, values) / weights.sum(axis=(0, 2))[:, None]
        else:
            mean = chief
        return np.sqrt(weights)[:, None, ..., None] * (values - mean[:, :, None])


class WavefrontMerit:
    """The wavefront without piston and tilt, or what is left of it when a goal is subtracted.

    The sum of squares is the mean square of the wavefront.

    Parameters
    ----------
    telescope : Telescope
        The telescope at the start: its lit rays are the merit's.
    beams : Beams
        The rays.
    goal : array_like, shape [n_field, n_wave, n_pupil], optional
        Wavefronts to be reached [m]; points that are NaN do not count.
    """

    def __init__(self, telescope: Telescope, beams: Beams, goal: Any = None) -> None:
        self._beams = beams
        weights = beams.weights(telescope)
        self._goal = np.zeros(weights.shape)
        if goal is not None:
            given = np.asarray(goal, dtype=np.float64)
            expected = (len(beams.fields), len(beams.wavelengths), len(beams.pupil))
            if given.shape != expected:
                raise DomainError(f"goal of shape {list(given.shape)}: expected {list(expected)}, field by wave by ray")
            given = given.transpose(1, 0, 2)
            known = np.isfinite(given)
            total = weights.sum(axis=2, keepdims=True)
            weights = np.where(known, weights, 0.0)
            self._goal = np.where(known, given, 0.0)
            weights *= total / np.maximum(weights.sum(axis=2, keepdims=True), np.finfo(float).tiny)
        self._roots = np.sqrt(weights)
        # Piston and the two tilts, as an orthonormal basis of what is taken off each wavefront.
        x, y = beams.pupil.points.T / (0.5 * telescope.pupil_diameter)
        tilts = self._roots[..., None] * np.stack([np.ones_like(x), x, y], axis=-1)
        self._basis = np.linalg.qr(tilts)[0]

    def residuals(self, telescope: Telescope) -> np.ndarray:  # noqa: D102
        return self.derivatives(ParameterColumns.at(telescope, ()))[0]

    def derivatives(self, columns: ParameterColumns) -> tuple[np.ndarray, np.ndarray]:  # noqa: D102
        beams, parts = self._beams, []
        for i, wavelength in enumerate(beams.wavelengths):

            def reduced(block: WavefrontBlock, i: int = i) -> np.ndarray:
                roots, basis = self._roots[i, block.fields], self._basis[i, block.fields]
                value = block.value - self._goal[i, block.fields]
                # A ray of the merit that got lost shows as NaN, which makes the solver take a shorter step.
                value = np.where((block.status > RayStatus.VIGNETTED) & (roots > 0), np.nan, value)
                change = block.by_center @ block.moved - block.rows @ columns.weights
                both = roots[..., None] * np.concatenate([value[..., None], change], axis=2)
                return (both - basis @ (basis.transpose(0, 2, 1) @ both)).reshape(-1, both.shape[-1])

            parts += beams.wavefronts(columns, float(wavelength)).map(reduced)
        whole = np.concatenate(parts)
        return whole[:, 0], whole[:, 1:]

    def size_of_terms(self, columns: ParameterColumns) -> np.ndarray:  # noqa: D102
        def squares(block: WavefrontBlock) -> np.ndarray:
            size = np.abs(block.by_center) @ np.abs(block.moved) + np.abs(block.rows) @ np.abs(columns.weights)
            return (size**2).sum(axis=(0, 1))

        beams = self._beams
        total = sum(beams.wavefronts(columns, float(beams.wavelengths[0])).map(squares))
        return np.sqrt(total / (len(beams.fields) * len(beams.pupil)))
