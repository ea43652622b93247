"""Levenberg-Marquardt steps on the joint likelihood of stars that share the unknowns of their wavefront."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from .image_model import EXPONENT_GROWTH, FLUX, STRENGTH, neighbours_of
from .likelihood import NormalEquations, Stamp, normal_equations
from .seeing import StrengthPrior

#: A step that is to lower twice the negative logarithm of the likelihood by less, per unit of chi-square a pixel, is
#: the last: a fifth of a standard deviation, of which the step leaves a hundredth.
FINE = 5e-2
#: The same for a first search in coarse pixels: half a standard deviation.
COARSE = 0.3
#: Most steps.
STEPS = 25
#: The same for a search that ran out of steps and is near enough to its end.
_NEAR = 1.0
#: Part of what the model leaves beyond noise, or of noise itself if that is less, that a step is to explain: where it
#: lacks much, its derivatives are not good enough for the last hundredth, and errors have what is left.
_EXPLAINED = 1e-2
#: Power of what a model lacks at the low frequencies of a wavefront, over its mean square: residuals are as wide as the
#: seeing. Real donuts of DECam repeat alike for 4 and for 12.
_SMOOTH = 4.0
#: Largest weight of priors: those of real donuts are some hundreds.
_MOST_WEIGHT = 1e3
#: Change of the weight of priors below which a search keeps it.
_SAME_WEIGHT = 1.2
#: Damping of the first step, in units of the curvature.
DAMPING = 1e-3
#: Damping after a step whose gain is as predicted, over that before: where derivatives are not exact, that of the last
#: step is nearly what the next one needs.
_LESS = 1.0 / 3.0
#: Least strength of the turbulence [1/m].
_LEAST_STRENGTH = 1e-3
#: Least exponent of the air's transfer function after a step over that before: images are then a fifth as wide.
_LEAST_EXPONENT = 0.07
#: Damping beyond which no step is tried: none gains anything.
_LARGEST_DAMPING = 1e6


@dataclass(frozen=True)
class Group:
    """Stars whose wavefronts depend on the same unknowns.

    Attributes
    ----------
    stamps : tuple of Stamp
        The stars.
    maps : sequence of n_star ndarray, each of shape [n_wave, n_shared]
        Unknowns of each star's wavefront, and shifts of its rims, by the shared ones.
    precision : ndarray, shape [n_shared]
        Inverse variances of Gaussian priors; 0 for none.
    fixed_strength : bool
        Whether the strengths of the turbulence are held.
    transient : bool
        Whether what the model of a star can compute again is freed after each of its normal equations: memory then
        hardly grows with the number of stars.
    prior_mean : ndarray, shape [n_shared], optional
        Means of the priors; zero by default.
    limits : ndarray, shape [n_shared], optional
        Largest distances of the shared unknowns from these means; infinite by default.
    strength_prior : StrengthPrior, optional
        Prior of the strengths of the turbulence, where these are not held; none by default.
    weighted : int
        Number of the first shared unknowns, against whose priors what the model leaves beyond noise counts as noise.
    """

    stamps: tuple[Stamp, ...]
    maps: Sequence[np.ndarray] | np.ndarray
    precision: np.ndarray
    fixed_strength: bool = False
    transient: bool = False
    prior_mean: np.ndarray | None = None
    limits: np.ndarray | None = None
    strength_prior: StrengthPrior | None = None
    weighted: int = 0

    def prior_weight(self, loss: float) -> float:
        """Return the factor of these priors where the stamps have a loss: the power of residuals over that of noise."""
        if not (self.weighted and np.isfinite(loss)):
            return 1.0
        return min(1.0 + _SMOOTH * max(loss / self.pixels - 1.0, 0.0), _MOST_WEIGHT)

    @cached_property
    def pixels(self) -> int:
        """Number of pixels in use."""
        return sum(int(stamp.used.sum()) for stamp in self.stamps)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest values of the shared unknowns, each of shape [n_shared]."""
        mean = np.zeros(len(self.precision)) if self.prior_mean is None else self.prior_mean
        limits = np.inf if self.limits is None else self.limits
        return mean - limits, mean + limits


@dataclass(frozen=True)
class Solution:
    """Best unknowns of a group.

    Attributes
    ----------
    stars : tuple of ndarray
        Unknowns of each star.
    shared : ndarray, shape [n_shared]
        Shared unknowns of the wavefronts.
    waves : tuple of ndarray
        Unknowns of the wavefront of each star.
    covariance : ndarray
        Covariance of all, star by star and the shared ones last.
    chi2 : ndarray, shape [n_star]
        Sums of squares of the residuals over their variance.
    loss : float
        Twice the negative logarithm of likelihood and prior.
    converged : bool
        Whether the last step was small enough.
    damping : float
        Damping of the first step of a search that goes on from here.
    prior_weight : float
        Factor of priors of the wavefront, by what the model lacks; the covariance is that of noise with these.
    """

    stars: tuple[np.ndarray, ...]
    shared: np.ndarray
    waves: tuple[np.ndarray, ...]
    covariance: np.ndarray
    chi2: np.ndarray
    loss: float
    converged: bool
    damping: float = DAMPING
    prior_weight: float = 1.0

    def star_covariance(self, star: int) -> np.ndarray:
        """Return the covariance of the unknowns of one star."""
        first = sum(len(s) for s in self.stars[:star])
        unknowns = slice(first, first + len(self.stars[star]))
        return self.covariance[unknowns, unknowns]

    @property
    def shared_covariance(self) -> np.ndarray:
        """Covariance of the shared unknowns, shape [n_shared, n_shared]."""
        first = sum(len(s) for s in self.stars)
        return self.covariance[first:, first:]


def solve(
    group: Group,
    stars: Sequence[np.ndarray],
    shared: np.ndarray,
    *,
    tolerance: float = FINE,
    steps: int = STEPS,
    hopeless: float = np.inf,
    damping: float = DAMPING,
    pool: Executor | None = None,
) -> Solution:
    """Maximise the likelihood from a starting point, by so many steps or until one is to gain less than a tolerance.

    A search that goes on where another ended starts with its damping: along what the stars hardly tell, no step gets
    anywhere with more.
    A start without a likelihood is returned as it is, with an infinite loss. A search that after its first step
    predicts no loss below a `hopeless` one ends there, with the loss that it predicts.
    """
    joined = np.concatenate([*stars, shared])
    sizes = [len(s) for s in stars]
    pixels = group.pixels
    held = _held(group, sizes)
    likelihood = _linearize(group, joined, sizes, pool)
    weight = group.prior_weight(likelihood.loss)
    state = _with_priors(group, joined, sizes, likelihood, weight)
    converged, predicted = False, np.inf
    for count in range(steps if np.isfinite(state.loss) else 0):
        step = np.zeros_like(joined)
        free = ~held & ~_pressed(group, joined, state.gradient, sizes)
        curvature = state.curvature[np.ix_(free, free)]
        scale = np.sqrt(np.maximum(np.diag(curvature), 1e-300))
        normalized = curvature / np.outer(scale, scale)
        normalized[np.diag_indices_from(normalized)] = 1.0 + damping
        step[free] = _solved(normalized, state.gradient[free] / scale) / scale
        predicted = float(state.gradient @ step)
        trial = _bounded(group, after_step(joined, step, sizes), sizes, held)
        if predicted < tolerance * max(1.0, state.loss / pixels):
            joined, converged = trial, True
            break
        if count and state.loss - predicted > hopeless:
            joined, state = trial, replace(state, loss=state.loss - predicted)
            break
        trial_likelihood = _linearize(group, trial, sizes, pool)
        trial_state = _with_priors(group, trial, sizes, trial_likelihood, weight)
        if trial_state.loss < state.loss:
            gain = (state.loss - trial_state.loss) / predicted
            # Nielsen (1999): less where the gain is as predicted, more where it is less than half of that.
            damping *= max(_LESS, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
            joined, state = trial, trial_state
            new_weight = group.prior_weight(trial_likelihood.loss)
            if not weight / _SAME_WEIGHT < new_weight < weight * _SAME_WEIGHT:
                state, weight = _with_priors(group, joined, sizes, trial_likelihood, new_weight), new_weight
        else:
            damping = 10.0 * max(damping, DAMPING)
            if damping > _LARGEST_DAMPING or predicted < _worth(state.loss, pixels):
                break
    converged = converged or predicted < max(_NEAR, _NEAR * state.loss / pixels, _worth(state.loss, pixels))
    covariance = np.zeros_like(state.curvature)
    free = np.ix_(~held, ~held)
    scale = np.sqrt(np.maximum(np.diag(state.curvature)[~held], 1e-300))
    covariance[free] = _inverse(state.curvature[free] / np.outer(scale, scale)) / np.outer(scale, scale)
    bounds = np.cumsum([0, *sizes])
    star_unknowns = tuple(joined[a:b] for a, b in itertools.pairwise(bounds))
    best = joined[bounds[-1] :]
    waves = tuple(m @ best for m in group.maps)
    damping = min(damping, DAMPING)
    return Solution(star_unknowns, best, waves, covariance, state.chi2, state.loss, converged, damping, weight)


def _worth(loss: float, pixels: int) -> float:
    """Return the gain of a step that is worth while where the model leaves more than noise."""
    return _EXPLAINED * min(loss - pixels, pixels)


@dataclass(frozen=True)
class _Linearized:
    curvature: np.ndarray
    gradient: np.ndarray
    chi2: np.ndarray
    loss: float


def _held(group: Group, sizes: list[int]) -> np.ndarray:
    """Return which unknowns are held, shape [n]."""
    held = np.zeros(sum(sizes) + len(group.precision), dtype=bool)
    if group.fixed_strength:
        held[np.cumsum([0, *sizes[:-1]]) + STRENGTH] = True
    return held


def _linearize(group: Group, joined: np.ndarray, sizes: list[int], pool: Executor | None) -> _Linearized:
    """Accumulate the normal equations of all stars."""
    bounds, n_star = np.cumsum([0, *sizes]), sum(sizes)
    shared = joined[n_star:]

    def one(i: int) -> NormalEquations:
        stamp = group.stamps[i]
        equations = normal_equations(stamp, joined[bounds[i] : bounds[i + 1]], group.maps[i] @ shared)
        if group.transient:
            stamp.release()
        elif len(group.stamps) > 1:
            stamp.forget()
        return equations

    apply: Callable[..., object] = map if pool is None else pool.map
    star_equations: list[NormalEquations] = list(apply(one, range(len(group.stamps))))  # type: ignore[call-overload]
    curvature, gradient = np.zeros((len(joined), len(joined))), np.zeros(len(joined))
    for i, equations in enumerate(star_equations):
        star, size = slice(bounds[i], bounds[i + 1]), sizes[i]
        inner, cross, outer = (
            equations.curvature[:size, :size],
            equations.curvature[:size, size:] @ group.maps[i],
            group.maps[i].T @ equations.curvature[size:, size:] @ group.maps[i],
        )
        curvature[star, star] = inner
        curvature[star, n_star:] = cross
        curvature[n_star:, star] = cross.T
        curvature[n_star:, n_star:] += outer
        gradient[star] = equations.gradient[:size]
        gradient[n_star:] += group.maps[i].T @ equations.gradient[size:]
    return _Linearized(
        curvature, gradient, np.array([e.chi2 for e in star_equations]), sum(e.loss for e in star_equations)
    )


def _with_priors(
    group: Group, joined: np.ndarray, sizes: list[int], likelihood: _Linearized, weight: float
) -> _Linearized:
    """Return normal equations with those of the priors, of which some have a factor."""
    bounds, n_star = np.cumsum([0, *sizes]), sum(sizes)
    curvature, gradient, loss = likelihood.curvature.copy(), likelihood.gradient.copy(), likelihood.loss
    shared, unknowns = joined[n_star:], range(n_star, len(joined))
    precision = group.precision.copy()
    precision[: group.weighted] *= weight
    curvature[unknowns, unknowns] += precision
    deviation = shared if group.prior_mean is None else shared - group.prior_mean
    gradient[n_star:] -= precision * deviation
    loss += float(precision @ deviation**2)
    if group.strength_prior is not None:
        for at in bounds[:-1] + STRENGTH:
            of_strength = group.strength_prior.precision(joined[at])
            curvature[at, at] += of_strength
            gradient[at] -= of_strength * group.strength_prior.deviation(joined[at])
            loss += group.strength_prior.loss(joined[at])
    if not (np.isfinite(loss) and np.isfinite(curvature).all() and np.isfinite(gradient).all()):
        # No step starts there, and none leads there.
        curvature, gradient, loss = np.zeros_like(curvature), np.zeros_like(gradient), np.inf
    return replace(likelihood, curvature=curvature, gradient=gradient, loss=loss)


def _pressed(group: Group, joined: np.ndarray, gradient: np.ndarray, sizes: list[int]) -> np.ndarray:
    """Return which unknowns stand at a bound and would pass it, turbulence of images without any among them, [n]."""
    pressed = np.zeros(len(joined), dtype=bool)
    for first in np.cumsum([0, *sizes[:-1]]):
        at = first + STRENGTH
        pressed[at] = joined[at] <= _LEAST_STRENGTH and gradient[at] < 0.0
    shared, (least, most) = slice(sum(sizes), None), group.bounds
    pressed[shared] = ((joined[shared] <= least) & (gradient[shared] < 0.0)) | (
        (joined[shared] >= most) & (gradient[shared] > 0.0)
    )
    return pressed


def after_step(joined: np.ndarray, step: np.ndarray, sizes: list[int]) -> np.ndarray:
    """Return unknowns after a step, which is one of the exponent of the air's transfer function.

    An image that the air hardly blurs changes in proportion to that, and not at all with a strength near zero.
    """
    moved = joined + step
    for first in np.cumsum([0, *sizes[:-1]]):
        before, change = joined[first + STRENGTH], step[first + STRENGTH]
        if before > 0.0:
            exponent = max(1.0 + EXPONENT_GROWTH * change / before, _LEAST_EXPONENT)
            moved[first + STRENGTH] = before * exponent ** (1.0 / EXPONENT_GROWTH)
    return moved


def _bounded(group: Group, joined: np.ndarray, sizes: list[int], held: np.ndarray) -> np.ndarray:
    """Return unknowns with positive fluxes and turbulence, and shared ones within their bounds."""
    joined[sum(sizes) :] = np.clip(joined[sum(sizes) :], *group.bounds)
    starts = np.cumsum([0, *sizes[:-1]])
    for first, size in zip(starts, sizes, strict=True):
        joined[first + FLUX] = max(joined[first + FLUX], 1e-3)
        if not held[first + STRENGTH]:
            joined[first + STRENGTH] = np.clip(joined[first + STRENGTH], _LEAST_STRENGTH, 100.0)
        ratios = neighbours_of(joined[first : first + size])[:, 0]
        np.maximum(ratios, 0.0, out=ratios)
    return joined


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a positive definite system; a singular one by least squares."""
    try:
        return np.asarray(cho_solve(cho_factor(matrix), right))
    except np.linalg.LinAlgError:
        return np.linalg.lstsq(matrix, right, rcond=1e-12)[0]


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse of a positive matrix; eigenvalues that rounding made negative count by their size."""
    values, vectors = np.linalg.eigh(matrix)
    sizes = np.abs(values)
    determined = sizes > 1e-15 * sizes.max(initial=0.0)
    return np.asarray((vectors[:, determined] / sizes[determined]) @ vectors[:, determined].T)
