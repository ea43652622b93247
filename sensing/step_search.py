r"""Steps across donuts along the column or row where two amplifiers of a CCD meet: of the sky, and of the gain.

Let :math:`e` be the residuals of a fit over their noise, A the derivatives of the model over it, C the covariance of
the unknowns, and s the pattern of a step over the noise: 1 beyond a column for one of the sky, the light of the star
for one of the gain. At the best unknowns without a step, its amplitude by least squares of all together is

.. math:: a = s^T e / m, \qquad m = s^T s - s^T A C A^T s,

with the variance 1 / m, for every column and row from sums over columns and rows. A step is taken for real where its
amplitude stands out of those of all other columns and rows without it, which residuals of air and rims have too. It is
then taken off the image, and the fit goes on. The unknowns have the further covariance :math:`C A^T s s^T A C / m`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .amplifier_steps import AmplifierStep, StepFit
from .likelihood import linearized
from .star_fitter import StarSolution

#: Amplitude of a step over its standard deviation from which on it is real: 180 donuts without any, with other defects,
#: reach 4.7 somewhere.
_SIGNIFICANT = 5.5
#: The same of a step of the gain where the sky has one, or the reverse.
_BESIDE = 4.0
#: Columns or rows with used pixels on each side of a step, at least.
_NARROWEST = 4
#: Part of a step that no unknown takes up, at least, for its amplitude to be known.
_LEFT_OVER = 1e-3
#: Largest standard deviation of the relative change of the gain: those of amplifiers are smaller.
_VAGUE = 0.03
#: Largest relative change of the gain: amplifiers of one CCD differ by less, and what differs by more is none.
_MOST_GAIN = 0.3
#: Most lines along which a stamp has steps, one across each axis: a corner of four amplifiers has two.
_MOST = 2


def fit_steps(star: StarSolution, known: Sequence[AmplifierStep]) -> StepFit | None:
    """Return the steps of a fitted star, None without any; those known were taken off its image."""
    scores = _Scores.of(star)
    if scores is None:
        return None
    kept = [step.without_chance(_BESIDE) for step in known]
    patterns = [_Pattern(step.axis, step.first, kind) for step in kept for kind in (0, 1) if step.errors[kind]]
    if len(known) < _MOST:
        patterns += scores.without(patterns).steps()
    if not patterns:
        return None
    amplitudes, variances, moved = scores.amplitudes(patterns)
    # Of patterns that are the same but for rounding nothing is known.
    deviations = np.sqrt(np.maximum(np.diag(variances), 1e-300))
    steps = {(step.axis, step.first): step for step in kept}
    for pattern, amplitude, deviation in zip(patterns, amplitudes, deviations, strict=True):
        place = pattern.axis, pattern.first
        steps[place] = steps.get(place, AmplifierStep(*place)).changed(pattern.kind, float(amplitude), float(deviation))
    if max(abs(step.sizes[1]) for step in steps.values()) > _MOST_GAIN:
        return None
    change = float(np.abs(amplitudes / deviations).max()) if kept == list(known) else math.inf
    return StepFit(tuple(steps.values()), change, moved @ variances @ moved.T)


@dataclass(frozen=True)
class _Pattern:
    """Unit step of the sky (kind 0) or the gain (1) from a row or column of the detector, and its significance."""

    axis: int
    first: int
    kind: int
    size: float = 0.0


@dataclass(frozen=True)
class _Scores:
    """Products of the patterns of all steps with residuals and derivatives of the model.

    Attributes
    ----------
    pulls : ndarray, shape [ny, nx]
        Residuals over the noise, zero where no pixel is used.
    columns : ndarray, shape [ny, nx, n]
        Derivatives of the model over the noise and their scales.
    scaled : ndarray, shape [n, n]
        Covariance of the unknowns times their scales.
    moved : ndarray, shape [n, n]
        Changes of the unknowns by products with the columns.
    weights : ndarray, shape [2, ny, nx]
        Changes of the image by unit steps of sky and gain everywhere, over the noise.
    curvatures : tuple of ndarray, shapes [ny, 2] and [nx, 2]
        Inverse variances of the amplitudes of each kind by first row and by first column; infinite where not known.
    side : int
        Side of the squares of the detector's pixels that these pixels are sums of.
    """

    pulls: np.ndarray
    columns: np.ndarray
    scaled: np.ndarray
    moved: np.ndarray
    weights: np.ndarray
    curvatures: tuple[np.ndarray, np.ndarray]
    side: int

    @classmethod
    def of(cls, star: StarSolution) -> _Scores | None:
        """Return the products at the solution of a star."""
        point = linearized(star.stamp, star.solution.stars[0], star.solution.waves[0])
        if point is None:
            return None
        over = np.where(point.used, 1.0 / np.sqrt(point.variance), 0.0)
        side = round(star.stamp.grid.scale)
        weights = np.stack([side**2 * over, point.brightness * over]).astype(np.float32)
        columns, pulls = (_on_stamp(values, point.used) for values in (point.columns, point.pulls[:, None]))
        scaled = star.solution.covariance * np.outer(point.scales, point.scales)
        moved = star.solution.covariance * point.scales
        curvatures = tuple(_curvatures(weights, columns, scaled, axis) for axis in (0, 1))
        return cls(pulls[..., 0], columns, scaled, moved, weights, (curvatures[0], curvatures[1]), side)

    def significance(self, axis: int) -> np.ndarray:
        """Return amplitudes over their standard deviations by first row (0) or column (1) and kind, shape [., 2]."""
        sums = _from_there(np.einsum("kyx,yx->yxk", self.weights, self.pulls).sum(axis=1 - axis))
        return np.asarray(sums / np.sqrt(self.curvatures[axis]))

    @property
    def scatter(self) -> np.ndarray:
        """Rms of the significance of steps of each kind over all rows or columns, at least 1, shape [2]."""
        mean_squares = []
        for axis, curvature in enumerate(self.curvatures):
            known = np.isfinite(curvature)
            squares = np.where(known, self.significance(axis), 0.0) ** 2
            mean_squares.append(squares.sum(axis=0) / np.maximum(known.sum(axis=0), 1))
        return np.sqrt(np.maximum(np.max(mean_squares, axis=0), 1.0))

    def steps(self) -> list[_Pattern]:
        """Return the steps that stand out of all others and of slopes of the response."""
        return self.beside_slopes().standing_out() if self.standing_out() else []

    def beside_slopes(self) -> _Scores:
        """Return the same of a model whose unknowns have a slope of the response along each axis, too."""
        ny, nx = self.pulls.shape
        places = np.stack(np.broadcast_arrays(np.linspace(-1.0, 1.0, ny)[:, None], np.linspace(-1.0, 1.0, nx)))
        slopes = np.asarray(self.weights[1] * places, dtype=np.float32)
        gradients, variances = self._least_squares(slopes)
        taken_up = self.scaled @ gradients
        change = np.concatenate([-taken_up, np.eye(len(slopes))])
        scaled = change @ variances @ change.T
        scaled[: len(taken_up), : len(taken_up)] += self.scaled
        moved = np.pad(self.moved, ((0, 0), (0, len(slopes)))) - self.moved @ gradients @ variances @ change.T
        columns = np.concatenate([self.columns, np.moveaxis(slopes, 0, -1)], axis=2)
        amplitudes = variances @ np.tensordot(slopes, self.pulls, 2)
        pulls = self.pulls - columns @ (change @ amplitudes).astype(np.float32)
        first, second = (_curvatures(self.weights, columns, scaled, axis) for axis in (0, 1))
        return replace(self, pulls=pulls, columns=columns, scaled=scaled, moved=moved, curvatures=(first, second))

    def standing_out(self) -> list[_Pattern]:
        """Return the steps between columns and between rows that stand out of all others."""
        best: list[_Pattern] = []
        for _ in range(_MOST):
            best.append(self.without(best).largest({pattern.axis for pattern in best}))
        scatter = self.without(best).scatter
        patterns = [
            self._placed(pattern, best[:number])
            for number, pattern in enumerate(best)
            if all(p.size > _SIGNIFICANT * scatter[p.kind] for p in best[: number + 1])
        ]
        for pattern in list(patterns):
            other = replace(pattern, kind=1 - pattern.kind)
            amplitudes, variances, _ = self.amplitudes([*patterns, other])
            if amplitudes[-1] ** 2 > _BESIDE**2 * variances[-1, -1]:
                patterns.append(other)
        return patterns

    def largest(self, but_across: set[int]) -> _Pattern:
        """Return the step of the largest amplitude over its standard deviation, but across some axes."""
        candidates = []
        for axis in {0, 1} - but_across:
            sizes = np.abs(self.significance(axis))
            first, kind = np.unravel_index(int(np.argmax(sizes)), sizes.shape)
            candidates.append(_Pattern(axis, self.side * int(first), int(kind), float(sizes[first, kind])))
        return max(candidates, key=lambda pattern: pattern.size)

    def _placed(self, pattern: _Pattern, beside: Sequence[_Pattern]) -> _Pattern:
        """Return a pattern at the pixel of the detector where it explains most beside others."""

        def explained(candidate: _Pattern) -> float:
            images = self._images([*beside, candidate])
            _, variances = self._least_squares(images)
            products = np.tensordot(images, self.pulls, 2)
            return float(products @ variances @ products)

        near = range(pattern.first - self.side + 1, pattern.first + self.side)
        return max((replace(pattern, first=first) for first in near), key=explained)

    def amplitudes(self, patterns: Sequence[_Pattern]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return amplitudes of steps [p] by least squares, their covariance, and changes of unknowns by them [n, p].

        What the model lacks makes the covariance larger by the scatter of all steps without these.
        """
        images = self._images(patterns)
        gradients, variances = self._least_squares(images)
        scatter = self.without(patterns).scatter[[pattern.kind for pattern in patterns]]
        amplitudes = variances @ np.tensordot(images, self.pulls, 2)
        return amplitudes, variances * np.outer(scatter, scatter), -self.moved @ gradients

    def _images(self, patterns: Sequence[_Pattern]) -> np.ndarray:
        """Return the changes of the image by unit steps over the noise, shape [p, ny, nx]."""
        return np.stack([self._image(pattern) for pattern in patterns])

    def _least_squares(self, images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return products of changes of the image [p, ny, nx] with columns [n, p], and variances of these [p, p]."""
        gradients = np.tensordot(self.columns, images, ((0, 1), (1, 2)))
        squares = np.tensordot(images, images, ((1, 2), (1, 2)))
        variances = np.linalg.pinv(squares - gradients.T @ self.scaled @ gradients, hermitian=True)
        return gradients, variances

    def without(self, patterns: Sequence[_Pattern]) -> _Scores:
        """Return the same for the residuals that a fit with these steps leaves."""
        if not patterns:
            return self
        images = self._images(patterns)
        gradients, variances = self._least_squares(images)
        amplitudes = variances @ np.tensordot(images, self.pulls, 2)
        taken_up = self.columns @ (self.scaled @ (gradients @ amplitudes)).astype(np.float32)
        return replace(self, pulls=self.pulls + taken_up - np.tensordot(amplitudes, images, 1))

    def _image(self, pattern: _Pattern) -> np.ndarray:
        """Return the change of the image by a unit step over the noise, shape [ny, nx]."""
        detector = self.side * self.pulls.shape[0], self.side * self.pulls.shape[1]
        beyond = AmplifierStep(pattern.axis, pattern.first).beyond(detector)
        part = beyond.ravel().reshape(-1, self.side).mean(axis=1)
        return self.weights[pattern.kind] * np.expand_dims(part, 1 - pattern.axis)


def _on_stamp(values: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return values of the pixels in use [n_pixel, n] on their stamp, [ny, nx, n], zero elsewhere."""
    if used.all():
        return values.reshape(*used.shape, -1)
    images = np.zeros((*used.shape, values.shape[1]), dtype=values.dtype)
    images[used] = values
    return images


def _from_there(sums: np.ndarray) -> np.ndarray:
    """Return sums over rows or columns [n, ...] from each one to the last."""
    return np.cumsum(sums[::-1], axis=0)[::-1]


def _curvatures(weights: np.ndarray, columns: np.ndarray, scaled: np.ndarray, axis: int) -> np.ndarray:
    """Return the inverse variances of the amplitudes of steps, [n_row or n_column, 2]; infinite where not known."""
    lines = (weights.transpose(1, 0, 2), columns) if axis == 0 else (weights.transpose(2, 0, 1), columns.swapaxes(0, 1))
    gradients = _from_there(np.matmul(*lines).astype(np.float64))
    squares = _from_there((weights.astype(np.float64) ** 2).sum(axis=2 - axis).T)
    curvature = squares - ((gradients @ scaled) * gradients).sum(axis=2)
    used = np.cumsum(weights[0].any(axis=1 - axis))
    inside = (used > _NARROWEST) & (used <= used[-1] - _NARROWEST + 1)
    known = inside[:, None] & (curvature > np.maximum(_LEFT_OVER * squares, (0.0, _VAGUE**-2)))
    return np.asarray(np.where(known, curvature, np.inf))
