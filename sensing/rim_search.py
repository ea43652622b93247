"""Search for rims and spiders that stand elsewhere than the prescription has them, by the residuals of a fit."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ..core.statistics import RMS_PER_MAD
from .donut_rays import ZernikeRays
from .image_model import FLUX, STRENGTH, LandedLight
from .light import Instrument, StarLight
from .likelihood import Stamp, light_columns, linearized
from .moving_rims import PupilShadows, RimBody, line_cells, steps_of_bounding
from .solve import Solution

#: Least gain of twice the logarithm of the likelihood by a rim elsewhere: noise makes one in 1e5 of three motions.
_GAIN = 25.0
#: What the model of a pixel is off by, over its light: rims explain some of it where photons are so many.
_INEXACT = 1e-3
#: Side of the squares whose residuals say how far noise is correlated [pixels].
_SQUARE = 4
#: Least number of such squares beyond that of the unknowns.
_FEWEST_SQUARES = 50
#: Least part of the misfit beyond noise that a rim elsewhere explains: where the model lacks other things, or the noise
#: is larger than given, a rim explains a tenth or two by chance.
_MISFIT = 0.5
#: Part of the misfit that a score test gives a rim that is tried: one that stands far off gains more in the end.
_PROMISING = 0.4
#: Gain over the largest one from which on other rims are tried, too.
_LIKELY = 0.4
#: Loss by which fits with other rims are no worse: each of these may be the one that moved.
_ALIKE = 16.0
#: Most rims that are freed.
MOST_BODIES = 4
#: Rims that are tried in vain before the search ends.
_MOST_FAILURES = 2
#: Gain of a rim from afar over that which is needed, up to which it is not tried from where the fit has got to.
_SHORT = 0.8
#: Times that this is done for each rim in the search, and for the best of them.
_FIRST_STEPS = 2
_FINISHED = 2
#: Gain after these first times over that which is needed, from which on the best are finished.
_HALF_WAY = 0.5
#: Times that the shadows of a rim are computed again where it is found to stand.
_OUTER = 6
#: Loss over that of the best from which on they are not.
_CLOSE = 2.0
#: Fraction of a step that is not shortened further.
_SHORTEST = 0.2
#: Shift of a shadow over the side of a cell that is small enough to be linear.
_SMALL = 0.05


@dataclass(frozen=True)
class RimFit:
    """Light of a star with its rims, the pixels it is compared with, and the best unknowns.

    Rivals are fits with other rims free that are no worse but by chance.
    """

    light: StarLight
    stamp: Stamp
    solution: Solution
    rivals: tuple[RimFit, ...] = ()


class RimSolver(Protocol):
    """Fit of the light of a star with other rims."""

    def __call__(self, light: StarLight, start: Solution, hopeless: float = np.inf) -> RimFit:
        """Return the best fit from the unknowns of a solution, with zeros for shifts.

        A fit that cannot get below a `hopeless` loss ends after its first step.
        """


def with_another_rim(
    instrument: Instrument,
    best: RimFit,
    noise: float,
    solved: RimSolver,
    first: Solution | None = None,
    explained: Callable[[], bool] = lambda: False,
) -> RimFit:
    """Return the fit with one more rim free if the residuals say that it stands elsewhere, or the same fit.

    Parameters
    ----------
    instrument : Instrument
        Telescope and model of the images.
    best : RimFit
        Best fit with rims where they are believed to be.
    noise : float
        Loss a pixel that noise alone makes.
    solved : RimSolver
        Fit of light with other rims.
    first : Solution, optional
        Unknowns from which the best fit began: all rims are then tried from these, since the wavefront of a fit whose
        rims are held has taken up where they stand.
    explained : callable, optional
        Whether something else explains the residuals, which is computed before rims are tried.
    """
    failed: list[RimBody] = []
    free = [body for body in best.light.free_rims.bodies if body.moved]
    loss = best.solution.loss / best.stamp.used.sum()
    while len(free) < MOST_BODIES and len(failed) < _MOST_FAILURES and loss >= noise:
        misfit = _MISFIT * max(loss - (noise or 1.0), 0.0) * best.stamp.used.sum()
        least = _GAIN * _correlation(best) + _INEXACT**2 * float(best.solution.stars[0][FLUX])
        threshold = least + misfit
        bodies, gains = rim_gains(instrument, best)
        moved = {body.members for body in (*free, *failed)}
        gains = np.where([body.members in moved for body in bodies], 0.0, gains)
        if not gains.max(initial=0.0) > least + _PROMISING * misfit or explained():
            break
        likely = list(itertools.compress(bodies, gains > _LIKELY * gains.max()))
        tried, start = (likely, best.solution) if first is None else (bodies, first)
        trials = _each_freed(instrument, best, tried, start, solved, threshold)
        gain = best.solution.loss - trials[0].solution.loss
        if gain >= threshold:
            return _best_of(trials)
        if first is None:
            failed += likely
        elif gain < _SHORT * threshold:
            break
        first = None
    return best


def finished(instrument: Instrument, fit: RimFit, noise: float, solved: RimSolver) -> RimFit:
    """Return the fit with all shadows where its rims are found to stand, and all rims free that the residuals say.

    Arguments are those of :func:`with_another_rim`. Rivals are fitted as well, and the best of all is returned.
    """
    if fit.light.free_rims.bodies:
        fits = [fit, *(solved(rival.light, rival.solution) for rival in fit.rivals)]
        fit = _best_of([settled(instrument, trial, solved) for trial in fits])
    while (another := with_another_rim(instrument, fit, noise, solved)) is not fit:
        fit = another
    return fit


def _best_of(fits: Sequence[RimFit]) -> RimFit:
    """Return the best fit, with those that are no worse but by chance as its rivals."""
    best, *others = sorted(fits, key=lambda fit: fit.solution.loss)
    alike = [replace(fit, rivals=()) for fit in others if fit.solution.loss - best.solution.loss < _ALIKE]
    return replace(best, rivals=tuple(alike))


def _correlation(fit: RimFit) -> float:
    """Return by how many times gains are larger than by noise of single pixels, since it is correlated."""
    point = linearized(fit.stamp, fit.solution.stars[0], fit.solution.waves[0])
    if point is None or fit.stamp.grid.coarse:
        return 1.0
    return power_of_squares(point.pulls, point.used, point.columns.shape[1])


def power_of_squares(pulls: np.ndarray, used: np.ndarray, unknowns: int) -> float:
    """Return the power of residuals in typical squares over that of noise of single pixels, at least 1.

    `pulls` [n_pixel] are residuals of the used pixels over their noise, after a fit of so many unknowns. What a rim
    elsewhere leaves is in few of the squares.
    """
    image = np.full(used.shape, np.nan)
    image[used] = pulls
    ny, nx = used.shape[0] // _SQUARE, used.shape[1] // _SQUARE
    squares = image[: ny * _SQUARE, : nx * _SQUARE].reshape(ny, _SQUARE, nx, _SQUARE).sum(axis=(1, 3)) / _SQUARE
    sums = squares[np.isfinite(squares)]
    freedom = len(sums) - unknowns
    if freedom < _FEWEST_SQUARES:
        return 1.0
    typical = (RMS_PER_MAD * float(np.median(np.abs(sums)))) ** 2
    return max(typical * len(sums) / freedom, 1.0)


def _each_freed(
    instrument: Instrument,
    fit: RimFit,
    bodies: Sequence[RimBody],
    start: Solution,
    solved: RimSolver,
    needed: float,
) -> list[RimFit]:
    """Return fits with one more of some bodies free, best first: those that lead nowhere end after a few steps.

    So do those that gain nothing, and those whose gain is then far from what is needed.
    """
    trials = []
    for body in bodies:
        light = fit.light.with_free_rims(fit.light.free_rims.with_body(body), instrument.middle)
        # A rim that stands far off gains little before its shadow is computed where it is first found to stand.
        trials.append(settled(instrument, solved(light, start), solved, _FIRST_STEPS, fit.solution.loss))
    trials.sort(key=lambda trial: trial.solution.loss)
    best = trials[0].solution.loss
    if fit.solution.loss - best < _HALF_WAY * needed:
        return trials
    close = [trial for trial in trials if trial.solution.loss < _CLOSE * best]
    finished = [settled(instrument, trial, solved) for trial in close[:_FINISHED]]
    return sorted(finished, key=lambda trial: trial.solution.loss)


def rim_gains(instrument: Instrument, fit: RimFit) -> tuple[list[RimBody], np.ndarray]:
    """Return the rims that bound the light, and the gain of twice the logarithm of the likelihood by freeing each.

    It is that of a score test, with the wavefront and all else free.
    """
    light, (star, wave) = fit.light, (fit.solution.stars[0], fit.solution.waves[0])
    rays = fit.stamp.rays
    assert isinstance(rays, ZernikeRays)
    point = linearized(fit.stamp, star, wave)
    bodies, lines = PupilShadows(light.telescope, light.direction, instrument.middle, rays.cells).candidates()
    if not bodies or point is None:
        return [], np.zeros(0)
    free = np.array([body.free for body in bodies])
    spreads = np.array([body.spreads for body in bodies])[free]
    shadows = line_cells(rays.cells, lines, free)
    _, rates = shadows.at_wavelengths(instrument.wavelength_weights)
    landing, spread = rays.beside(shadows.points, shadows.moments, rays.landing(wave))
    shadow_columns, scales = light_columns(
        fit.stamp, star, point, LandedLight(landing, np.zeros(len(rates)), spread), rates
    )
    first = len(star) + len(wave)
    fitted = np.flatnonzero(np.arange(first) != (STRENGTH if instrument.known_seeing else -1))
    precision, deviation = instrument.prior(light, star, wave, fit.solution.prior_weight)
    inner = point.columns.T @ point.columns * np.outer(point.scales, point.scales) + np.diag(precision)
    inner = inner[np.ix_(fitted, fitted)]
    cross = (point.columns.T @ shadow_columns * np.outer(point.scales, scales))[fitted]
    slope = (point.columns.T @ point.pulls * point.scales - precision * deviation)[fitted]
    scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    projected = np.linalg.lstsq(inner / np.outer(scale, scale), cross / scale[:, None], rcond=1e-12)[0] / scale[:, None]
    gradient = shadow_columns.T @ point.pulls * scales - projected.T @ slope
    curvature = shadow_columns.T @ shadow_columns * np.outer(scales, scales) - cross.T @ projected
    curvature += np.diag(spreads**-2.0)
    number = np.nonzero(free)[0]
    gains = np.zeros(len(bodies))
    for k in range(len(bodies)):
        motions = number == k
        gains[k] = gradient[motions] @ np.linalg.solve(curvature[np.ix_(motions, motions)], gradient[motions])
    return bodies, gains


def settled(
    instrument: Instrument, best: RimFit, solved: RimSolver, steps: int = _OUTER, hopeless: float = np.inf
) -> RimFit:
    """Return the best fit with the same rims free, their shadows where they are found to stand, after so many steps.

    Steps end where the loss cannot get below a `hopeless` one.
    """
    factor = 1.0
    for _ in range(steps):
        rims, step = best.light.free_rims, _relative_step(instrument, best)
        if np.all(np.abs(factor * step) < _SMALL):
            break
        light = best.light.with_free_rims(rims.moved(factor * step * rims.spreads), instrument.middle)
        # Light that a shadow uncovers lies beside the line that stands for it: steps may be too long, and the loss
        # after one is not that of the rims there.
        alike = _ALIKE * max(1.0, best.solution.loss / best.stamp.used.sum())
        trial = solved(light, best.solution, min(hopeless, best.solution.loss + alike))
        if trial.solution.loss > hopeless:
            break
        worse = trial.solution.loss - best.solution.loss
        nearer = np.linalg.norm(_relative_step(instrument, trial)) < np.linalg.norm(step)
        if worse < 0.0 or (nearer and worse < alike):
            best, factor = replace(trial, rivals=best.rivals), 1.0
        else:
            factor *= 0.5
        if factor < _SHORTEST:
            break
    return best


def _relative_step(instrument: Instrument, fit: RimFit) -> np.ndarray:
    """Return how far the rims of a fit are from their shadows, over their standard deviations."""
    before = fit.light.before_free_rims
    steps = fit.solution.waves[0][len(instrument.noll) + before :]
    return steps_of_bounding(fit.stamp.rays.rates[:, before:], steps) / fit.light.free_rims.spreads
