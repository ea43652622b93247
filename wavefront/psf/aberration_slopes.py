"""Slopes that the aberrations of the optics have across the pupil, on the mean over the field of view."""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import numpy as np

from ...core.errors import DomainError
from .engine import PsfInputs

# Rings of equal area of the field and of the pupil, and points on each.
_FIELD_RINGS = 2
_FIELD_ANGLES = 5
_PUPIL_RINGS = 6
_PUPIL_ANGLES = 12
# Steps of the distance of two points of the pupil, up to its diameter.
_STEPS = 12


class AberrationSlopes(NamedTuple):
    """Mean squares of the slopes of the optics' aberrations, sums over both components about their mean."""

    #: Covariance at two points of the pupil, mean over the field, at steps of their distance from none to the diameter
    #: [rad^2].
    covariance: tuple[float, ...]
    #: Mean square over its mean over the field, as a polynomial over the field: factors of 1, x, y, x^2, xy, y^2.
    over_field: np.ndarray

    @classmethod
    def of(cls, inputs: PsfInputs) -> Self:
        """Return those of the light of the middle wavelength on a flat detector, by rays.

        Where light does not reach all of the field of view, they are those of its centre.
        """
        telescope = inputs.telescope
        pupil = 0.5 * telescope.pupil_diameter * _rings(_PUPIL_RINGS, _PUPIL_ANGLES, telescope.pupil_obscuration)
        center = np.zeros((1, 2))
        fields = np.concatenate([center, telescope.field_radius * _rings(_FIELD_RINGS, _FIELD_ANGLES, 0.0)])
        try:
            slopes, lit = _slopes(inputs, fields, pupil)
        except DomainError:
            fields = center
            slopes, lit = _slopes(inputs, fields, pupil)
        products = np.einsum("fpi,fqi->pq", slopes, slopes)
        step = np.hypot(*(pupil[:, None] - pupil).T) * (_STEPS / telescope.pupil_diameter)
        # A pair counts at the step before its distance and at that after it, the more the nearer.
        near = np.maximum(1.0 - np.abs(step.ravel() - np.arange(_STEPS + 1)[:, None]), 0.0)
        covariance = near @ products.ravel() / np.maximum(near @ (lit.T @ lit).ravel(), 1.0)
        square = (slopes**2).sum(axis=(1, 2)) / np.maximum(lit.sum(axis=1), 1.0)
        over_field = np.linalg.lstsq(_terms(fields), square / max(square.mean(), 1e-30), rcond=None)[0]
        return cls(tuple(covariance.tolist()), over_field)

    def relative(self, slopes: np.ndarray) -> np.ndarray:
        """Return the mean square at field slopes [n, 2] over its mean over the field, [n]."""
        return np.maximum(_terms(slopes) @ self.over_field, 0.0)


def _terms(field: np.ndarray) -> np.ndarray:
    x, y = field.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def _rings(rings: int, angles: int, inner: float) -> np.ndarray:
    """Return points on rings of equal area of an annulus of outer radius 1, [n, 2]."""
    area = (np.arange(rings) + 0.5) / rings
    radius = np.sqrt(inner**2 + (1.0 - inner**2) * area)[:, None]
    # Every other ring is turned by half a step.
    angle = 2.0 * math.pi / angles * (np.arange(angles) + 0.5 * (np.arange(rings)[:, None] % 2))
    return (radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).reshape(-1, 2)


def _slopes(inputs: PsfInputs, fields: np.ndarray, pupil: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return slopes about their mean [rad], zero where dark, [n_field, n_pupil, 2], and what is lit, as 0 and 1."""
    wavelengths = np.asarray(inputs.wavelengths, dtype=np.float64)
    optics = inputs.trace(
        inputs.telescope,
        fields,
        wavelengths[len(wavelengths) // 2 :][:1],
        pupil,
        projection=inputs.projection,
        threads=1,
        aberration=inputs.aberration,
    )
    lit = optics.lit[:, 0].astype(np.float64)
    slopes = np.where(optics.lit[:, 0, :, None], optics.displacement[:, 0], 0.0)
    slopes = slopes @ np.linalg.inv(optics.jacobian).swapaxes(1, 2)
    mean = slopes.sum(axis=1) / np.maximum(lit.sum(axis=1), 1.0)[:, None]
    return (slopes - mean[:, None]) * lit[..., None], lit
