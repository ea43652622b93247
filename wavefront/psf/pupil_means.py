"""Light in the pupil, and slopes of the aberrations across it, on the mean over the field of view."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np

from ...core.errors import DomainError
from ..pupil_sampling import spiral_annulus
from .engine import PsfInputs

# Points of the field and of the pupil.
_FIELDS = 12
_POINTS = 72
# Steps of the distance of two points of the pupil, up to its diameter.
_STEPS = 12
# Least lit fraction over its mean.
_LEAST_LIT = 0.2


class PupilMeans(NamedTuple):
    """Light and slopes of aberrations, sums over both components about their mean, on the mean over field and pupil."""

    #: Covariance of slopes at two points of the pupil, at steps of their distance from none to the diameter [rad^2].
    aberration: tuple[float, ...]
    #: Part of the pairs of points at these distances that are both lit, of those in the annulus.
    lit: tuple[float, ...]
    #: Mean square of the slopes, and lit fraction, over their means over the field, as polynomials over the field:
    #: factors of 1, x, y, x^2, xy, y^2, [6, 2].
    over_field: np.ndarray

    @classmethod
    def of(cls, inputs: PsfInputs) -> Self:
        """Return those of the light of the middle wavelength on a flat detector, by rays.

        Where light does not reach all of the field of view, they are those of its centre.
        """
        telescope = inputs.telescope
        pupil = spiral_annulus(0.5 * telescope.pupil_diameter, telescope.pupil_obscuration, _POINTS).points
        fields = spiral_annulus(telescope.field_radius, 0.0, _FIELDS).points
        try:
            slopes, lit = _slopes(inputs, fields, pupil)
        except DomainError:
            fields = np.zeros((1, 2))
            slopes, lit = _slopes(inputs, fields, pupil)
        step = np.hypot(*(pupil[:, None] - pupil).T) * (_STEPS / telescope.pupil_diameter)
        # A pair counts at the step before its distance and at that after it, the more the nearer.
        near = np.maximum(1.0 - np.abs(step.ravel() - np.arange(_STEPS + 1)[:, None]), 0.0)
        pairs = near @ (lit.T @ lit).ravel()
        aberration = near @ np.einsum("fpi,fqi->pq", slopes, slopes).ravel() / np.maximum(pairs, 1.0)
        both_lit = np.maximum(pairs / (len(fields) * np.maximum(near.sum(axis=1), 1e-9)), 1e-3)
        means = np.stack([(slopes**2).sum(axis=(1, 2)) / np.maximum(lit.sum(axis=1), 1.0), lit.mean(axis=1)], axis=1)
        over_field = np.linalg.lstsq(_terms(fields), means / np.maximum(means.mean(axis=0), 1e-30), rcond=None)[0]
        return cls(tuple(aberration.tolist()), tuple(both_lit.tolist()), over_field)

    def relative(self, slopes: np.ndarray) -> np.ndarray:
        """Return mean square and lit fraction at field slopes [n, 2] over their means over the field, [n, 2]."""
        return np.maximum(_terms(slopes) @ self.over_field, [0.0, _LEAST_LIT])


def _terms(field: np.ndarray) -> np.ndarray:
    x, y = field.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


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
