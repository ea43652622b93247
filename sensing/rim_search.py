"""Search for rims and spiders that stand elsewhere than the prescription has them, by the residuals of a fit."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .image_model import STRENGTH
from .light import Instrument, StarLight
from .likelihood import Stamp, normal_equations
from .moving_rims import FreeRims, PupilShadows, RimBody, cells_with_lines
from .rim_outlines import MOTIONS
from .solve import Solution

#: Least gain of twice the logarithm of the likelihood by a rim elsewhere, over the loss a pixel where that is above 1.
_GAIN = 50.0
#: Most rims that are freed.
_MOST_BODIES = 4
#: Rims that are tried in vain before the search ends.
_MOST_FAILURES = 2
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


def with_all_rims(
    instrument: Instrument,
    best: RimFit,
    first: Solution,
    noise: float,
    solved: Callable[[StarLight, Solution], RimFit],
) -> RimFit:
    """Return the fit with the rims free that matter, of coarse pixels, if that is much better.

    All rims are free first: the wavefront of a fit whose rims are held has taken up where they stand.

    Parameters
    ----------
    instrument : Instrument
        Telescope and model of the images.
    best : RimFit
        Best fit with rims where they are believed to be.
    first : Solution
        Unknowns from which that fit began.
    noise : float
        Loss a pixel that noise alone makes.
    solved : callable
        Returns the best fit of light with other rims from the unknowns of a solution, with zeros for shifts.
    """
    loss = best.solution.loss / best.stamp.used.sum()
    if loss < noise:
        return best
    threshold = _GAIN * max(1.0, loss)
    bodies, gains = rim_gains(instrument, best)
    if not bodies:
        return best
    rims = FreeRims(tuple(bodies), np.zeros((len(bodies), MOTIONS)))
    trial = _settled(instrument, best.light, rims, first, solved)
    if best.solution.loss - trial.solution.loss < threshold:
        return best
    return _pruned(instrument, trial, solved)


def _pruned(instrument: Instrument, fit: RimFit, solved: Callable[[StarLight, Solution], RimFit]) -> RimFit:
    """Return the fit without the free rims that gain little, one after the other."""
    needed: set[tuple[tuple[int, int], ...]] = set()
    while True:
        threshold = _GAIN * max(1.0, fit.solution.loss / fit.stamp.used.sum())
        rims = fit.light.free_rims
        gains = _wald(instrument, fit)
        gains = np.where([body.members in needed for body in rims.bodies], np.inf, gains)
        k = int(np.argmin(gains)) if len(gains) else -1
        if k < 0 or gains[k] > 4.0 * threshold:
            return fit
        trial = _settled(instrument, fit.light, rims.without(k), fit.solution, solved)
        if trial.solution.loss - fit.solution.loss < threshold:
            fit = trial
        else:
            needed.add(rims.bodies[k].members)


def _wald(instrument: Instrument, fit: RimFit) -> np.ndarray:
    """Return about what twice the logarithm of the likelihood loses without each free rim."""
    rims = fit.light.free_rims
    narrow = len(instrument.noll) + 2 * len(fit.light.rims)
    values = rims.values[rims.free] + fit.solution.waves[0][narrow:]
    covariance = fit.solution.shared_covariance[narrow:, narrow:]
    number = np.nonzero(rims.free)[0]
    gains = np.zeros(len(rims.bodies))
    for k in range(len(gains)):
        motions = number == k
        gains[k] = values[motions] @ np.linalg.solve(covariance[np.ix_(motions, motions)], values[motions])
    return gains


def with_moved_rims(
    instrument: Instrument,
    best: RimFit,
    noise: float,
    solved: Callable[[StarLight, Solution], RimFit],
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
    """
    failed: list[RimBody] = []
    count = int(best.stamp.used.sum())
    while len(best.light.free_rims.bodies) < _MOST_BODIES and len(failed) < _MOST_FAILURES:
        loss = best.solution.loss / count
        if loss < noise:
            break
        threshold = _GAIN * max(1.0, loss)
        bodies, gains = rim_gains(instrument, best)
        moved = {body.members for body in (*best.light.free_rims.bodies, *failed)}
        gains = np.where([body.members in moved for body in bodies], 0.0, gains)
        if not gains.max(initial=0.0) > threshold:
            break
        body = bodies[int(np.argmax(gains))]
        trial = _settled(instrument, best.light, best.light.free_rims.with_body(body), best.solution, solved)
        if best.solution.loss - trial.solution.loss > threshold:
            best, failed = trial, []
        else:
            failed.append(body)
    return best


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
    instrument: Instrument,
    light: StarLight,
    rims: FreeRims,
    start: Solution,
    solved: Callable[[StarLight, Solution], RimFit],
) -> RimFit:
    """Return the best fit with rims free, their shadows where they are found to stand."""
    narrow = len(instrument.noll) + 2 * len(light.rims)
    best, solution = None, start
    for _ in range(_OUTER):
        light = light.with_free_rims(rims, instrument.middle)
        fit = solved(light, solution)
        if best is not None and not fit.solution.loss < math.inf:
            break
        steps = fit.solution.waves[0][narrow:]
        rims, best, solution = rims.moved(steps), fit, fit.solution
        if np.all(np.abs(steps) < _SMALL * rims.spreads):
            break
    assert best is not None
    return best
