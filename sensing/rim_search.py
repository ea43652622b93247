"""Search for rims and spiders that stand elsewhere than the prescription has them, by the residuals of a fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .image_model import STRENGTH
from .light import Instrument, StarLight
from .likelihood import Stamp, normal_equations
from .moving_rims import FreeRims, PupilShadows, RimBody, cells_with_lines
from .solve import Solution

#: Least gain of twice the logarithm of the likelihood by a rim elsewhere, over the loss a pixel where that is above 1.
_GAIN = 50.0
#: Most rims that are freed.
_MOST_BODIES = 4
#: Rims that are tried in vain before the search ends.
_MOST_FAILURES = 2
#: Times that this is done for each rim in the search, and for the best of them.
_FIRST_STEPS = 2
_FINISHED = 2
#: Times that the shadows of a rim are computed again where it is found to stand.
_OUTER = 8
#: Shift of a shadow over the side of a cell that is small enough to be linear.
_SMALL = 0.05


@dataclass(frozen=True)
class RimFit:
    """Light of a star with its rims, the pixels it is compared with, and the best unknowns."""

    light: StarLight
    stamp: Stamp
    solution: Solution


def with_moved_rims(
    instrument: Instrument,
    best: RimFit,
    noise: float,
    solved: Callable[[StarLight, Solution], RimFit],
    first: Solution | None = None,
) -> RimFit:
    """Return the fit with rims free that the residuals say stand elsewhere.

    Parameters
    ----------
    instrument : Instrument
        Telescope and model of the images.
    best : RimFit
        Best fit with rims where they are believed to be.
    noise : float
        Loss a pixel that noise alone makes.
    solved : callable
        Returns the best fit of light with other rims from the unknowns of a solution, with zeros for shifts.
    first : Solution, optional
        Unknowns from which the best fit began: all rims are then tried from these, since the wavefront of a fit whose
        rims are held has taken up where they stand.
    """
    failed: list[RimBody] = []
    while len(best.light.free_rims.bodies) < _MOST_BODIES and len(failed) < _MOST_FAILURES:
        loss = best.solution.loss / best.stamp.used.sum()
        if loss < noise:
            break
        threshold = _GAIN * max(1.0, loss)
        bodies, gains = rim_gains(instrument, best)
        moved = {body.members for body in (*best.light.free_rims.bodies, *failed)}
        gains = np.where([body.members in moved for body in bodies], 0.0, gains)
        if not gains.max(initial=0.0) > threshold:
            break
        if first is not None:
            trial = _best_single(instrument, best, bodies, first, solved)
            first = None
            if best.solution.loss - trial.solution.loss > threshold:
                best = trial
            continue
        body = bodies[int(np.argmax(gains))]
        rims = best.light.free_rims.with_body(body)
        trial = _settled(instrument, solved(best.light.with_free_rims(rims, instrument.middle), best.solution), solved)
        if best.solution.loss - trial.solution.loss > threshold:
            best, failed = trial, []
        else:
            failed.append(body)
    return best


def _best_single(
    instrument: Instrument,
    fit: RimFit,
    bodies: Sequence[RimBody],
    first: Solution,
    solved: Callable[[StarLight, Solution], RimFit],
) -> RimFit:
    """Return the best of the fits with one of some bodies free: after a few steps, those that lead nowhere are known."""
    trials = []
    for body in bodies:
        light = fit.light.with_free_rims(FreeRims().with_body(body), instrument.middle)
        trials.append(_settled(instrument, solved(light, first), solved, _FIRST_STEPS))
    trials.sort(key=lambda trial: trial.solution.loss)
    finished = [_settled(instrument, trial, solved) for trial in trials[:_FINISHED]]
    return min(finished, key=lambda trial: trial.solution.loss)


def rim_gains(instrument: Instrument, fit: RimFit) -> tuple[list[RimBody], np.ndarray]:
    """Return the rims that bound the light, and the gain of twice the logarithm of the likelihood by freeing each.

    It is that of a score test, with the wavefront and all else free.
    """
    light, star = fit.light, fit.solution.stars[0]
    cells = fit.stamp.rays.cells
    bodies, lines = PupilShadows(light.telescope, light.direction, instrument.middle, cells).candidates()
    if not bodies:
        return [], np.zeros(0)
    free = np.array([body.free for body in bodies])
    rays = instrument.rays_of(light, cells_with_lines(cells, lines, free))
    spreads = np.array([body.spreads for body in bodies])[free]
    wave = np.concatenate([fit.solution.waves[0], np.zeros(len(spreads))])
    equations = normal_equations(replace(fit.stamp, rays=rays), star, wave)
    # Unknowns of a fit without wavefront, or with known seeing, are held.
    n_wave = len(fit.solution.waves[0])
    precision = np.concatenate([instrument.terms.precision, light.shift_precision])
    held = np.zeros(len(star) + n_wave, dtype=bool)
    held[STRENGTH] = instrument.known_seeing
    held[len(star) :] = len(fit.solution.shared) == 0
    first = np.flatnonzero(~held)
    last = len(star) + n_wave + np.arange(len(spreads))
    inner = equations.curvature[np.ix_(first, first)]
    prior = np.concatenate([np.zeros(len(star)), precision])[first]
    inner = inner + np.diag(prior)
    cross = equations.curvature[np.ix_(first, last)]
    deviation = np.concatenate([np.zeros(len(star) + n_wave - len(light.shift_mean)), light.shift_mean])
    values = np.concatenate([np.zeros(len(star)), fit.solution.waves[0]])
    slope = equations.gradient[first] - prior * (values - deviation)[first]
    scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    projected = np.linalg.lstsq(inner / np.outer(scale, scale), cross / scale[:, None], rcond=1e-12)[0] / scale[:, None]
    gradient = equations.gradient[last] - projected.T @ slope
    curvature = equations.curvature[np.ix_(last, last)] - cross.T @ projected + np.diag(spreads**-2.0)
    number = np.nonzero(free)[0]
    gains = np.zeros(len(bodies))
    for k in range(len(bodies)):
        own = number == k
        gains[k] = gradient[own] @ np.linalg.solve(curvature[np.ix_(own, own)], gradient[own])
    return bodies, gains


def _settled(
    instrument: Instrument, best: RimFit, solved: Callable[[StarLight, Solution], RimFit], steps: int = _OUTER
) -> RimFit:
    """Return the best fit with the same rims free, their shadows where they are found to stand, after so many steps."""
    first = len(instrument.noll) + 2 * len(best.light.rims)
    factor = 1.0
    for _ in range(steps):
        rims, shift = best.light.free_rims, factor * best.solution.waves[0][first:]
        if np.all(np.abs(shift) < _SMALL * rims.spreads):
            break
        light = best.light.with_free_rims(rims.moved(shift), instrument.middle)
        trial = solved(light, best.solution)
        # Light that a shadow uncovers lies beside the line that stands for it, so that steps may be too long.
        better = trial.solution.loss < best.solution.loss
        best, factor = (trial, 1.0) if better else (best, 0.5 * factor)
    return best
