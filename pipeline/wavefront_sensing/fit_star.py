"""Fit of one star: start from a template, coarse and fine pixels, second star, wrong side of focus, cosmic rays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter

from .flags import DonutFlag
from .image_model import BACKGROUND, FLUX, NUISANCES, RATIO, STRENGTH, X, Y
from .light import Instrument, Light
from .likelihood import Stamp, model_image, pulls
from .solve import COARSE, FINE, Group, Solution, solve
from .stamps import Match, Pixels, match_template, without_cosmic_rays

#: Images wider than this are donuts [pixels].
SMALLEST_DONUT = 24.0
#: Pixels across a donut in the coarse fit, about.
_COARSE_DIAMETER = 30.0
#: Signal over noise of a template that is found.
_FOUND = 8.0
#: Least gain of twice the logarithm of the likelihood by a second star or another focus, and the largest part of the
#: misfit that may be left: what turbulence and missing terms of the wavefront do to an image, neither explains.
_GAIN, _LEFT = 100.0, 0.5
#: Least flux of a second star over that of the first.
_LEAST_RATIO = 0.01
#: Fraction of the light that may fall beside the stamp.
_BESIDE = 0.05
#: Least fraction of the variance of the image that the model explains.
_EXPLAINED = 0.5
#: Pulls of pixels that are clipped, over that of typical pixels, and rounds of clipping.
_CLIP, _ROUNDS = 7.0, 3


@dataclass(frozen=True)
class StarFit:
    """Fit of one star by itself.

    Attributes
    ----------
    flags : DonutFlag
        Outcome.
    light : Light or None
        Light of the star.
    stamp : Stamp or None
        Pixels and model of the last fit.
    solution : Solution or None
        Its unknowns.
    """

    flags: DonutFlag
    light: Light | None = None
    stamp: Stamp | None = None
    solution: Solution | None = None


def fit_star(
    instrument: Instrument, light: Light, pixels: Pixels, *, strength: float, fixed_strength: bool, wavefront: bool
) -> StarFit:
    """Fit one star.

    Parameters
    ----------
    instrument, light, pixels
        Telescope and detector, light of the star and its stamp.
    strength : float
        Strength of the turbulence [1/m]: a start, or the value where it is fixed.
    fixed_strength : bool
        Whether it is fixed.
    wavefront : bool
        Whether the wavefront is fitted; where not, it is zero.
    """
    fitter = _StarFitter(instrument, light, strength, fixed_strength, wavefront)
    across = light.diameter / instrument.pixel
    donut = across > SMALLEST_DONUT
    clean = without_cosmic_rays(pixels) if donut else pixels
    flags = DonutFlag.OK
    coarse = fitter.stamp(light, clean.smoothed(max(1, round(across / _COARSE_DIAMETER)) if donut else 1))
    start, found = fitter.start(coarse)
    if found.significance < _FOUND:
        flags |= DonutFlag.NO_DONUT
    if found.flux < len(NUISANCES) + (len(instrument.noll) if wavefront else 0):
        flags |= DonutFlag.TOO_FEW_PHOTONS
    if flags:
        return StarFit(flags, light)
    best = fitter.solve(coarse, start)
    if donut:
        best = fitter.with_companion(coarse, best, found)
        if fitter.other_focus_is_better(coarse, best):
            return StarFit(DonutFlag.DEFOCUS_SIGN, light)
    if not _explained(coarse.stamp, best):
        return StarFit(DonutFlag.NO_DONUT, light)
    if _beside(coarse.stamp, best) > _BESIDE:
        return StarFit(DonutFlag.CUT_OFF, light)
    fine = fitter.stamp(light, clean, companion=len(best.stars[0]) > RATIO)
    start = fitter.transferred(best.stars[0], coarse.pixels, fine.pixels)
    solution = fitter.solve(fine, start, best.shared)
    sharper = fitter.sharper(light, fine, solution)
    if sharper is not None:
        fine, solution = sharper, fitter.solve(sharper, solution.stars[0], solution.shared)
    stamp = fine.stamp
    for _ in range(_ROUNDS):
        kept = _clipped(stamp, solution)
        if (kept == stamp.used).all():
            break
        stamp = replace(stamp, used=kept)
        solution = fitter.solve(replace(fine, stamp=stamp), solution.stars[0], solution.shared)
    if (stamp.used != pixels.used).any():
        flags |= DonutFlag.CLIPPED
    if len(solution.stars[0]) > RATIO:
        flags |= DonutFlag.BLENDED
    if not solution.converged:
        flags |= DonutFlag.NOT_CONVERGED
    return StarFit(flags, light, stamp, solution)


@dataclass(frozen=True)
class _Scaled:
    """A stamp in pixels of some size."""

    stamp: Stamp
    pixels: Pixels


class _StarFitter:
    """Solutions for one star on stamps of several scales."""

    def __init__(
        self, instrument: Instrument, light: Light, strength: float, fixed_strength: bool, wavefront: bool
    ) -> None:
        self._instrument, self._light = instrument, light
        self._strength, self._fixed = strength, fixed_strength
        self._fwhm = float(instrument.seeing.fwhm(np.asarray(strength)))
        n = len(instrument.noll)
        self._map = np.eye(n)[None] if wavefront else np.zeros((1, n, 0))

    def stamp(self, light: Light, pixels: Pixels, *, companion: bool = False) -> _Scaled:
        """Return the stamp of a star's light in given pixels; a second star needs room beside it."""
        # Second stars may stand anywhere beside the stamp.
        reach = light.diameter if companion or pixels.side > 1 else 0.0
        return _Scaled(self._instrument.stamp(light, pixels, self._fwhm, reach), pixels)

    def sharper(self, light: Light, scaled: _Scaled, found: Solution) -> _Scaled | None:
        """Return the stamp with a finer grid where the seeing that was found needs one."""
        fwhm = float(self._instrument.seeing.fwhm(found.stars[0][STRENGTH]))
        sampling, grid = self._instrument.sampling(light, scaled.pixels, fwhm), scaled.stamp.grid
        if sampling.oversampling <= grid.oversampling:
            return None
        return _Scaled(self._instrument.stamp(light, scaled.pixels, fwhm, grid.reach), scaled.pixels)

    def template(self, scaled: _Scaled) -> np.ndarray:
        """Return the image of a star of unit flux at the centre of the stamp."""
        unknowns = np.zeros(len(NUISANCES))
        unknowns[FLUX], unknowns[STRENGTH] = 1.0, self._strength
        return model_image(scaled.stamp, unknowns, np.zeros(len(self._instrument.noll)))

    def start(self, scaled: _Scaled) -> tuple[np.ndarray, Match]:
        """Return unknowns of the star where its template fits best."""
        stamp = scaled.stamp
        found = match_template(stamp.image, stamp.used, stamp.variance, self.template(scaled))
        unknowns = np.zeros(len(NUISANCES))
        unknowns[[FLUX, X, Y, STRENGTH]] = max(found.flux, 1.0), found.x, found.y, self._strength
        return unknowns, found

    def solve(self, scaled: _Scaled, star: np.ndarray, shared: np.ndarray | None = None) -> Solution:
        """Return the best unknowns from a start."""
        n = self._map.shape[2]
        group = Group((scaled.stamp,), self._map, self._instrument.precision[:n], self._fixed)
        tolerance = FINE if scaled.pixels.side == 1 else COARSE
        return solve(group, [star], np.zeros(n) if shared is None else shared, tolerance=tolerance)

    def transferred(self, star: np.ndarray, coarse: Pixels, fine: Pixels) -> np.ndarray:
        """Return the unknowns of a star in other pixels."""
        scale = coarse.side / fine.side
        star = star.copy()
        star[[X, Y]] = (star[[X, Y]] - coarse.offset) * scale + fine.offset
        star[BACKGROUND] /= scale**2
        star[RATIO + 1 :] *= scale
        return star

    def with_companion(self, scaled: _Scaled, single: Solution, first: Match) -> Solution:
        """Return the solution with a second star if there is one, else that without."""
        stamp, wave = scaled.stamp, single.waves[0]
        best, misfit = single, single.loss / stamp.used.sum()
        template = self.template(scaled)
        starts = [(single.stars[0], wave, single.shared)]
        if misfit > 3.0:
            plain = np.zeros(len(NUISANCES))
            plain[[FLUX, X, Y, STRENGTH]] = first.flux, first.x, first.y, self._strength
            starts.append((plain, np.zeros_like(wave), np.zeros_like(single.shared)))
        for star, aberration, shared in starts:
            rest = stamp.image - model_image(stamp, star, aberration)
            second = match_template(rest, stamp.used, stamp.variance, template)
            if second.significance < _FOUND:
                continue
            ratio, offset = second.flux / star[FLUX], (second.x - star[X], second.y - star[Y])
            trial = self.solve(scaled, np.array([*star, ratio, *offset]), shared)
            if _explains_more(trial, best) and trial.stars[0][RATIO] > _LEAST_RATIO:
                best = trial
        return _central_first(best)

    def other_focus_is_better(self, scaled: _Scaled, here: Solution) -> bool:
        """Return whether the image fits a detector on the other side of focus better."""
        count = scaled.stamp.used.sum()
        if here.loss / count < 1.5:
            return False
        other = self.stamp(self._light.mirrored(), scaled.pixels)
        start, _ = self.start(other)
        return _explains_more(self.solve(other, start), here)


def _explains_more(trial: Solution, other: Solution) -> bool:
    """Return whether a solution is better than another beyond what could be chance or a wavefront without its terms."""
    return other.loss - trial.loss > _GAIN and trial.loss < _LEFT * other.loss


def _central_first(solution: Solution) -> Solution:
    """Return a solution whose first star is the one nearer to the centre of the stamp."""
    star = solution.stars[0]
    if len(star) <= RATIO or np.hypot(*star[[X, Y]]) <= np.hypot(*(star[[X, Y]] + star[RATIO + 1 :])):
        return solution
    star = star.copy()
    star[FLUX] *= star[RATIO]
    star[[X, Y]] += star[RATIO + 1 :]
    star[RATIO], star[RATIO + 1 :] = 1.0 / star[RATIO], -star[RATIO + 1 :]
    return replace(solution, stars=(star,))


def _explained(stamp: Stamp, solution: Solution) -> bool:
    """Return whether the model explains most of what stands out from a uniform background."""
    image = stamp.image[stamp.used]
    variance = stamp.variance[stamp.used] + np.maximum(image, 0.0)
    weight = 1.0 / np.maximum(variance, 1.0)
    uniform = float(weight @ (image - (weight @ image) / weight.sum()) ** 2)
    count = len(image)
    return (solution.loss - count) < (1.0 - _EXPLAINED) * max(uniform - count, 0.0)


def _beside(stamp: Stamp, solution: Solution) -> float:
    """Return the fraction of the star's light that lands beside the stamp."""
    star, wave = solution.stars[0], solution.waves[0]
    place = stamp.rays.landing(wave) / stamp.grid.pixel + star[[X, Y]]
    outside = np.abs(place) > 0.5 * np.array(stamp.grid.shape[::-1])
    return float(stamp.rays.weights @ outside.any(axis=1))


def _clipped(stamp: Stamp, solution: Solution) -> np.ndarray:
    """Return the pixels without those far off the model, cosmic rays and dead ones, and their neighbours."""
    pull = np.where(stamp.used, pulls(stamp, model_image(stamp, solution.stars[0], solution.waves[0])), 0.0)
    far = np.abs(pull) > _CLIP * max(1.0, float(np.sqrt(solution.loss / stamp.used.sum())))
    return stamp.used & ~maximum_filter(far, 3) if far.any() else stamp.used
