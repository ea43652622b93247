"""Light in the pupil, and slopes of the aberrations across it, on the mean over the field of view."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np

from ...core.errors import DomainError
from ...models.telescope import Telescope
from ...raytrace.rays import Projection, field_direction
from ..atmosphere.field_pupils import FieldPupils
from ..pupil_sampling import spiral_annulus
from .clear_pupil import lit_points
from .engine import PsfInputs

# Points of the field and of the pupil.
_FIELDS = 12
_POINTS = 72
# Steps of the distance of two points of the pupil, up to its diameter.
_STEPS = 12
# Fields at which light is looked at, to where corners of cameras reach beyond the field of view: radii over its own,
# the largest one [rad], directions, and points of the pupil.
_RADII = np.linspace(0.0, 1.2, 25)
_LARGEST_RADIUS = 1.4
_DIRECTIONS = 4
_LIGHT_POINTS = 200
# Largest step between the lit fractions about which fields are taken together.
_LIT_STEP = 0.08
# Pupils of less light are left out.
_LEAST_LIT = 0.05
# Cells across the pupils of stars, and rays across a cell.
_CELLS = 12
_CELL_POINTS = 4
# Stars on a ring, and light of the full pupil by which pupils of successive rings differ at most, but for single steps.
_NODE_DIRECTIONS = 8
_DIFFERENT = 0.06


class PupilMeans(NamedTuple):
    """Light and slopes of aberrations, sums over both components about their mean, on the mean over field and pupil."""

    #: Covariance of slopes at two points of the pupil, at steps of their distance from none to the diameter [rad^2].
    aberration: tuple[float, ...]
    #: Part of the pairs of points at these distances that are both lit, of those in the annulus.
    lit: tuple[float, ...]
    #: The same of fields of about as much light, from the darkest on.
    lit_levels: tuple[tuple[float, ...], ...]
    pupils: FieldPupils | None  #: over the field; None where they are alike
    #: Mean square of the slopes over its mean over the field, as a polynomial over the field: factors of 1, x, y, x^2,
    #: xy, y^2, [6].
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
        near = _steps_of_pairs(pupil, telescope.pupil_diameter)
        pairs = near @ (lit.T @ lit).ravel()
        aberration = near @ np.einsum("fpi,fqi->pq", slopes, slopes).ravel() / np.maximum(pairs, 1.0)
        squares = (slopes**2).sum(axis=(1, 2)) / np.maximum(lit.sum(axis=1), 1.0)
        over_field = np.linalg.lstsq(_terms(fields), squares / max(squares.mean(), 1e-30), rcond=None)[0]
        of_light = telescope, inputs.projection, _middle_wavelength(inputs)
        return cls(
            tuple(aberration.tolist()),
            _both_lit(lit, near),
            _lit_levels(*of_light),
            _field_pupils(*of_light),
            over_field,
        )

    def relative_square(self, slopes: np.ndarray) -> np.ndarray:
        """Return the mean square of the slopes at field slopes [n, 2] over its mean over the field, [n]."""
        return np.maximum(_terms(slopes) @ self.over_field, 0.0)


def _steps_of_pairs(pupil: np.ndarray, diameter: float) -> np.ndarray:
    """Return how much pairs of points count at each step of distance, [n_step, n_pair]: the more the nearer to it."""
    step = np.hypot(*(pupil[:, None] - pupil).T) * (_STEPS / diameter)
    return np.maximum(1.0 - np.abs(step.ravel() - np.arange(_STEPS + 1)[:, None]), 0.0)


def _both_lit(lit: np.ndarray, near: np.ndarray) -> tuple[float, ...]:
    """Return the parts of pairs at each step that are both lit, mean over fields, of what is lit [n_field, n_point]."""
    fractions = near @ (lit.T @ lit).ravel() / (len(lit) * np.maximum(near.sum(axis=1), 1e-9))
    return tuple(np.maximum(fractions, 1e-3).tolist())


@lru_cache(maxsize=16)
def _lit_levels(telescope: Telescope, projection: Projection, wavelength: float) -> tuple[tuple[float, ...], ...]:
    """Return :attr:`PupilMeans.lit_levels` at a wavelength [m]."""
    pupil = spiral_annulus(0.5 * telescope.pupil_diameter, telescope.pupil_obscuration, _LIGHT_POINTS).points
    near = _steps_of_pairs(pupil, telescope.pupil_diameter)
    lit = _lit_on_rings(telescope, projection, wavelength, _radii(telescope), _DIRECTIONS, pupil)
    fraction = lit.mean(axis=1)
    lit = lit[fraction > _LEAST_LIT]
    if not len(lit):
        return ()
    fraction = lit.mean(axis=1)
    darkest, brightest = fraction.min(), fraction.max()
    steps = math.ceil((brightest - darkest) / _LIT_STEP)
    level = np.rint((fraction - darkest) * (steps / max(brightest - darkest, 1e-9)))
    levels = [_both_lit(lit[level == k].astype(np.float64), near) for k in np.unique(level)]
    return tuple(sorted(levels))


def _radii(telescope: Telescope) -> np.ndarray:
    """Return the radii of the fields at which light is looked at [rad], from zero."""
    return np.unique(np.minimum(telescope.field_radius * _RADII, _LARGEST_RADIUS))


def _lit_on_rings(
    telescope: Telescope,
    projection: Projection,
    wavelength: float,
    radius: np.ndarray,
    directions: int,
    points: np.ndarray,
) -> np.ndarray:
    """Return at which points of the pupil [n_point, 2] light of stars on rings passes, [n_star, n_point] bool.

    Stars stand on rings of radii [rad], ring by ring, evenly in so many directions from +x.
    """
    angle = 2.0 * np.pi * np.arange(directions) / directions
    x, y = (radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)).reshape(-1, 2).T
    return lit_points(telescope, field_direction(x, y, projection), wavelength, points, 1)


@lru_cache(maxsize=16)
def _field_pupils(telescope: Telescope, projection: Projection, wavelength: float) -> FieldPupils | None:
    """Return :attr:`PupilMeans.pupils` at a wavelength [m]."""
    diameter, side = telescope.pupil_diameter, _CELLS * _CELL_POINTS
    line = diameter * ((np.arange(side) + 0.5) / side - 0.5)
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    distance = np.hypot(*points.T) / (0.5 * diameter)
    inside = np.flatnonzero((distance < 1.0) & (distance > telescope.pupil_obscuration))

    def light(radius: np.ndarray, directions: int) -> np.ndarray:
        """Return the light of cells of stars at radii, in each direction, [n_radius, n_direction, side, side]."""
        points_lit = np.zeros((len(radius) * directions, len(points)))
        points_lit[:, inside] = _lit_on_rings(telescope, projection, wavelength, radius, directions, points[inside])
        cells = points_lit.reshape(-1, _CELLS, _CELL_POINTS, _CELLS, _CELL_POINTS).mean(axis=(2, 4))
        return cells.reshape(len(radius), directions, _CELLS, _CELLS)

    radius = _radii(telescope)
    samples = light(radius, _DIRECTIONS)
    area = samples.sum(axis=(2, 3))
    full = np.zeros(len(points))
    full[inside] = 1.0
    full = full.reshape(_CELLS, _CELL_POINTS, _CELLS, _CELL_POINTS).mean(axis=(1, 3))
    bright = _lit_rings(area, full)
    rings = [0]
    for ring in range(1, bright):
        between = np.abs(samples[rings[-1] : ring + 1] - samples[rings[-1]]).sum(axis=(2, 3)).max()
        if between > _DIFFERENT * full.sum():
            # The ring before is the last that is like the one chosen, but for a step as long as this.
            rings.append(ring - 1 if ring - 1 > rings[-1] else ring)
    if len(rings) == 1:
        return None
    radius = radius[np.unique([*rings, bright - 1])]
    of_rings = light(radius[1:], _NODE_DIRECTIONS)
    # Between the directions of the samples it may be dark.
    bright = _lit_rings(of_rings.sum(axis=(2, 3)), full)
    if not bright:
        return None
    radius, nodes = radius[: bright + 1], of_rings[:bright].reshape(-1, _CELLS, _CELLS)
    direction = field_direction(radius, 0.0 * radius, projection)
    slope = direction[:, 0] / -direction[:, 2]
    return FieldPupils(np.abs(slope), _NODE_DIRECTIONS, diameter, np.concatenate([samples[0, :1], nodes]), full)


def _lit_rings(area: np.ndarray, full: np.ndarray) -> int:
    """Return how many rings of stars, whose light is [n_ring, n_direction], lie within the first with a dark pupil."""
    lit = (area > _LEAST_LIT * full.sum()).all(axis=1)
    return len(lit) if lit.all() else int(lit.argmin())


def _middle_wavelength(inputs: PsfInputs) -> float:
    return float(inputs.wavelengths[len(inputs.wavelengths) // 2])


def _terms(field: np.ndarray) -> np.ndarray:
    x, y = field.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def _slopes(inputs: PsfInputs, fields: np.ndarray, pupil: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return slopes about their mean [rad], zero where dark, [n_field, n_pupil, 2], and what is lit, as 0 and 1."""
    optics = inputs.trace(
        inputs.telescope,
        fields,
        np.array([_middle_wavelength(inputs)]),
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
