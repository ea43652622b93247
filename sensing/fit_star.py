"""Fit of one star: start from a template, coarse and fine pixels, second star, wrong side of focus, cosmic rays."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter

from .donut_rays import ZernikeRays
from .flags import DonutFlag
from .image_model import FLUX, NUISANCES, RATIO, STRENGTH, X, Y
from .light import Instrument, Sampling, StarLight
from .likelihood import Stamp, model_image, pulls
from .rim_search import RimFit, with_moved_rims
from .solve import COARSE, FINE, STEPS, Group, Solution, solve
from .stamps import (
    Match,
    Pixels,
    match_template,
    measured_variance,
    significance_above_sky,
    without_cosmic_rays,
)

#: Images wider than this are donuts [pixels].
SMALLEST_DONUT = 24.0
#: Pixels across a donut in the coarse fit, about.
_COARSE_DIAMETER = 30.0
#: Signal over noise of a template that is found.
_FOUND = 8.0
#: The same above a uniform sky of any level, which is less; the noise of a sky reaches 4 somewhere on a stamp.
_ABOVE_SKY = 6.0
#: Least gain of twice the logarithm of the likelihood by a second star or another focus.
_GAIN = 100.0
#: Largest fraction of the misfit that they may leave: what turbulence and missing terms do to an image, neither
#: explains.
_LEFT = 0.5
#: Loss a coarse pixel from which on the other side of focus is tried; photons leave 0.1, since smoothed noise is small.
_MISFIT = 0.15
#: Loss a coarse pixel from which on second stars are searched for around the first.
_POOR = 1.0
#: Distances of such second stars over the diameter of the donut.
_NEAR_RADII = (0.08, 0.2)
#: Directions from the first star in which they are searched for.
_NEAR_ANGLES = 6
#: Steps from each of these places.
_FIRST_STEPS = 4
#: Number of the best of these solutions that are finished.
_FINISHED = 2
#: Loss a coarse pixel from which on a second star is searched for without the wavefront of the first, too.
_MISTAKEN = 3.0
#: Least flux of a second star over that of the first.
_LEAST_RATIO = 0.01
#: Fraction of the light that may fall beside the stamp.
_BESIDE = 0.05
#: Least fraction of the variance of the image that the model explains.
_EXPLAINED = 0.5
#: Pulls of pixels that are clipped, over that of typical pixels.
_CLIP = 7.0
#: Rounds of clipping.
_ROUNDS = 3
#: Most scales of the last fits.
_SCALES = 3
#: Cells across the pupil over those that are needed.
_ENOUGH = 1.25


@dataclass(frozen=True)
class StarSolution:
    """Best model of one star by itself.

    Attributes
    ----------
    light : StarLight
        Light of the star.
    stamp : Stamp
        Pixels and model of the last fit.
    full : Stamp
        All pixels of the detector, of which those of the fit may be sums.
    solution : Solution
        Its unknowns.
    model : ndarray
        Best image of all pixels [electrons].
    """

    light: StarLight
    stamp: Stamp
    full: Stamp
    solution: Solution
    model: np.ndarray


@dataclass(frozen=True)
class StarFit:
    """Outcome of the fit of one star by itself: flags, and its best model unless it failed."""

    flags: DonutFlag
    best: StarSolution | None = None

    @property
    def usable(self) -> StarSolution | None:
        """The best model where no flag says that there is no result."""
        return self.best if self.flags.usable else None


def fit_star(instrument: Instrument, light: StarLight, pixels: Pixels, strength: float, *, wavefront: bool) -> StarFit:
    """Fit one star.

    Parameters
    ----------
    instrument, light, pixels
        Telescope and model of the images, light of the star and its stamp.
    strength : float
        Strength of the turbulence [1/m]: a start, or the value where the seeing is known.
    wavefront : bool
        Whether the wavefront is fitted; where not, it is zero.
    """
    across = light.diameter / instrument.pixel
    donut = across > SMALLEST_DONUT
    clean = without_cosmic_rays(pixels) if donut else pixels
    fitter = _StarFitter(instrument, light, clean, strength, wavefront)
    small = clean.smoothed(max(1, round(across / _COARSE_DIAMETER)) if donut else 1)
    coarse = fitter.stamp(light, small)
    template = fitter.template(coarse)
    start, match = fitter.start(coarse, template)
    flags = DonutFlag.OK
    if not match.significance >= _FOUND or not fitter.significance(coarse, template) >= _ABOVE_SKY:
        flags |= DonutFlag.NO_DONUT
    if match.flux < len(NUISANCES) + (len(instrument.noll) if wavefront else 0):
        flags |= DonutFlag.TOO_FEW_PHOTONS
    if flags:
        return StarFit(flags)
    best = fitter.solve(coarse, start, tolerance=COARSE if donut else FINE)
    single, neighbours = best, donut and instrument.model.neighbours
    if neighbours:
        best = fitter.with_companion(small, coarse, best, start, template)
    if donut and fitter.other_focus_is_better(small, coarse, best):
        return StarFit(DonutFlag.DEFOCUS_SIGN)
    if donut and wavefront and instrument.model.rims.search and best.loss > _MISFIT * coarse.used.sum():
        # Light beside a rim looks like a second star, and later like a cosmic ray.
        solved = fitter.rim_solver(COARSE, lambda moved: moved.stamp(moved.light, small))
        moved, moved_stamp, trial = fitter.with_moved_rims(coarse, single, _MISFIT, solved, start)
        if trial.loss < best.loss:
            fitter, coarse, best = moved, moved_stamp, trial
            if neighbours:
                best = fitter.with_companion(small, coarse, best, start, template)
    if not _explained(coarse, best):
        return StarFit(DonutFlag.NO_DONUT)
    if _beside(coarse, best) > _BESIDE:
        return StarFit(DonutFlag.CUT_OFF)
    finest = fitter.finest(best)
    if (finest.full.used != pixels.used).any():
        flags |= DonutFlag.CLIPPED
    if any(body.moved for body in finest.light.free_rims.bodies):
        flags |= DonutFlag.RIM_MOVED
    if len(finest.solution.stars[0]) > RATIO:
        flags |= DonutFlag.BLENDED
    if not (finest.solution.converged and np.isfinite(finest.model).all()):
        flags |= DonutFlag.NOT_CONVERGED
    return StarFit(flags, finest)


@dataclass(frozen=True)
class _Fine:
    """A stamp for the last fits, and how it is sampled."""

    stamp: Stamp
    pixels: Pixels
    sampling: Sampling

    def of(self, fitter: _StarFitter) -> Stamp:
        """Return the stamp sampled alike for the light of a fitter."""
        return fitter.sampled_stamp(self.pixels, self.sampling, self.stamp.grid.reach)


class _StarFitter:
    """Solutions for one star on stamps of several scales."""

    def __init__(
        self, instrument: Instrument, light: StarLight, clean: Pixels, strength: float, wavefront: bool
    ) -> None:
        self._instrument, self._clean, self._wavefront = instrument, clean, wavefront
        self._donut = light.diameter > SMALLEST_DONUT * instrument.pixel
        self._strength = strength
        self._fwhm = float(instrument.seeing.fwhm(np.asarray(strength)))
        self._set_light(light)
        self._binned: dict[int, Pixels] = {}
        #: Cells across the pupil that the last fits are expected to need, so that the first ones share them.
        self._across = self._sampling(self._fwhm, self._side(self._fwhm))[1].across

    @property
    def light(self) -> StarLight:
        """Light of the star."""
        return self._light

    def _set_light(self, light: StarLight) -> None:
        terms = self._instrument.terms
        self._light = light
        self._precision = np.concatenate([terms.precision, light.shift_precision])
        self._mean = np.concatenate([np.zeros(len(terms.precision)), light.shift_mean])
        n = len(self._precision)
        self._map = np.eye(n)[None] if self._wavefront else np.zeros((1, n, 0))
        self._rays: dict[int, ZernikeRays] = {}

    def with_light(self, light: StarLight) -> _StarFitter:
        """Return the same for the light of the star with its rims elsewhere."""
        fitter = copy(self)
        fitter._set_light(light)
        return fitter

    def with_moved_rims(
        self,
        stamp: Stamp,
        best: Solution,
        noise: float,
        solved: Callable[[StarLight, Solution], RimFit],
        first: np.ndarray | None = None,
    ) -> tuple[_StarFitter, Stamp, Solution]:
        """Return the fit with rims free that the residuals say stand elsewhere, with the stamp of its light."""
        begun = None if first is None else replace(best, stars=(first,), shared=np.zeros_like(best.shared))
        fit = with_moved_rims(self._instrument, RimFit(self._light, stamp, best), noise, solved, begun)
        return self if fit.light is self._light else self.with_light(fit.light), fit.stamp, fit.solution

    def rim_solver(
        self, tolerance: float, stamp_of: Callable[[_StarFitter], Stamp]
    ) -> Callable[[StarLight, Solution], RimFit]:
        """Return the function that fits light with its rims elsewhere, from the unknowns of a solution."""

        def solved(light: StarLight, start: Solution) -> RimFit:
            fitter = self.with_light(light)
            moved_stamp = stamp_of(fitter)
            held = len(light.rims) * 2 + len(self._instrument.noll)
            shared = np.concatenate([start.shared[:held], np.zeros(len(light.free_rims))])
            return RimFit(light, moved_stamp, fitter.solve(moved_stamp, start.stars[0], shared, tolerance))

        return solved

    def _of(self, light: StarLight, across: int) -> ZernikeRays:
        """Return the light through at least so many cells across the pupil, and at most a quarter more."""
        if light is not self._light:
            return self._instrument.rays(light, across)
        for cells, rays in self._rays.items():
            if across <= cells <= _ENOUGH * across:
                return rays
        return self._rays.setdefault(across, self._instrument.rays(light, across))

    def stamp(self, light: StarLight, pixels: Pixels, *, blended: bool = False) -> Stamp:
        """Return the stamp of a star's light in coarse pixels; a second star needs room beside it."""
        sampling = self._instrument.sampling(light, pixels, self._fwhm)
        # Second stars may stand anywhere beside the stamp.
        reach = light.diameter * (1.0 if blended else 0.5) if pixels.side > 1 else 0.0
        rays = self._of(light, max(sampling.across, self._across))
        return self._instrument.stamp(light, pixels, rays, sampling.oversampling, reach)

    def sampled_stamp(self, pixels: Pixels, sampling: Sampling, reach: float) -> Stamp:
        """Return the stamp of pixels that are sampled so, with room for light beside it [m]."""
        rays = self._of(self._light, sampling.across)
        return self._instrument.stamp(self._light, pixels, rays, sampling.oversampling, reach)

    def _side(self, fwhm: float) -> int:
        """Return how many pixels are summed along each axis for the last fits in a seeing [rad]."""
        return self._instrument.binning(self._light, self._clean, fwhm) if self._donut else 1

    def finest(self, coarse: Solution) -> StarSolution:
        """Return the best model in pixels as fine as the seeing needs, without those far off it."""
        best, blended, fine = coarse, len(coarse.stars[0]) > RATIO, None
        # The seeing of a solution decides how finely the next one is sampled.
        for _ in range(_SCALES):
            finer = self.sampled(best, blended, fine)
            if finer is fine:
                break
            fine, best = finer, self.solve(finer.stamp, best.stars[0], best.shared)
        assert fine is not None
        if self._donut and self._wavefront and self._instrument.model.rims.search:
            solved = self.rim_solver(FINE, fine.of)
            fitter, stamp, best = self.with_moved_rims(fine.stamp, best, 0.0, solved)
            return fitter._clipped(replace(fine, stamp=stamp), best)
        return self._clipped(fine, best)

    def _clipped(self, fine: _Fine, best: Solution) -> StarSolution:
        """Return the best model without pixels far off it."""
        stamp, full = fine.stamp, self.every_pixel(fine)
        model = model_image(full, best.stars[0], best.waves[0])
        for _ in range(_ROUNDS):
            used = _clipped(full, model, best.loss / stamp.used.sum())
            if (used == full.used).all():
                break
            full = replace(full, used=used)
            stamp = replace(stamp, used=replace(self._clean, used=used).binned(fine.pixels.side).used)
            best = self.solve(stamp, best.stars[0], best.shared)
            model = model_image(full, best.stars[0], best.waves[0])
        return StarSolution(self._light, stamp, full, best, model)

    def sampled(self, solution: Solution, blended: bool, last: _Fine | None) -> _Fine:
        """Return a stamp fine enough for the seeing of a solution: the last one if that is, nearly."""
        instrument, light = self._instrument, self._light
        if last is None:
            pixels, sampling = self._sampling(self._fwhm, self._side(self._fwhm))
        else:
            fwhm = float(instrument.seeing.fwhm(solution.stars[0][STRENGTH]))
            wave = slice(len(instrument.noll)) if len(solution.shared) else slice(0)
            # Pixels without noise, whatever variance is claimed for them, know the wavefront better than claimed.
            noise = min(solution.loss / last.stamp.used.sum(), 1.0)
            error = math.sqrt(noise * np.trace(solution.shared_covariance[wave, wave])) or math.inf
            if not self._sampling(_ENOUGH * fwhm, last.pixels.side, _ENOUGH * error)[1].finer_than(last.sampling):
                return last
            pixels, sampling = self._sampling(fwhm, min(self._side(fwhm), last.pixels.side), error)
        stamp = self.sampled_stamp(pixels, sampling, light.diameter if blended else 0.0)
        return _Fine(stamp, pixels, sampling)

    def _sampling(self, fwhm: float, side: int, error: float = math.inf) -> tuple[Pixels, Sampling]:
        pixels = self._binned.get(side) or self._binned.setdefault(side, self._clean.binned(side))
        return pixels, self._instrument.sampling(self._light, pixels, fwhm, error)

    def every_pixel(self, fine: _Fine) -> Stamp:
        """Return the stamp with all pixels of the detector."""
        if fine.pixels.side == 1:
            return fine.stamp
        rays, grid = self._of(self._light, fine.sampling.across), fine.stamp.grid
        return self._instrument.stamp(self._light, self._clean, rays, 1, grid.reach)

    def template(self, stamp: Stamp) -> np.ndarray:
        """Return the image of a star of unit flux at the centre of the stamp."""
        unknowns = np.zeros(len(NUISANCES))
        unknowns[[FLUX, STRENGTH]] = 1.0, self._strength
        unknowns[[X, Y]] = -stamp.grid.scale * stamp.grid.offset
        return model_image(stamp, unknowns, np.zeros(len(self._precision)))

    def significance(self, stamp: Stamp, template: np.ndarray) -> float:
        """Return the signal over noise of a star anywhere on the stamp, above a uniform sky."""
        measured = stamp.grid.scale**2 * measured_variance(self._clean)
        return significance_above_sky(stamp.image, stamp.used, stamp.variance, template, measured)

    def start(self, stamp: Stamp, template: np.ndarray) -> tuple[np.ndarray, Match]:
        """Return unknowns of the star where its template fits best."""
        match = match_template(stamp.image, stamp.used, stamp.variance, template)
        unknowns = np.zeros(len(NUISANCES))
        unknowns[[FLUX, STRENGTH]] = max(match.flux, 1.0), self._strength
        unknowns[[X, Y]] = ([match.x, match.y] - stamp.grid.offset) * stamp.grid.scale
        return unknowns, match

    def solve(
        self,
        stamp: Stamp,
        star: np.ndarray,
        shared: np.ndarray | None = None,
        tolerance: float = FINE,
        steps: int = STEPS,
    ) -> Solution:
        """Return the best unknowns from a start."""
        n = self._map.shape[2]
        group = Group(
            (stamp,), self._map, self._precision[:n], self._instrument.known_seeing, prior_mean=self._mean[:n]
        )
        return solve(group, [star], np.zeros(n) if shared is None else shared, tolerance=tolerance, steps=steps)

    def with_companion(
        self, pixels: Pixels, stamp: Stamp, single: Solution, first: np.ndarray, template: np.ndarray
    ) -> Solution:
        """Return the solution with a second star if there is one, else that without."""
        wave = single.waves[0]
        best, misfit = single, single.loss / stamp.used.sum()
        roomy = None
        starts = [(single.stars[0], wave, single.shared)]
        if misfit > _MISTAKEN:
            starts.append((first, np.zeros_like(wave), np.zeros_like(single.shared)))
        for star, aberration, shared in starts:
            residual_image = stamp.image - model_image(stamp, star, aberration)
            second = match_template(residual_image, stamp.used, stamp.variance, template)
            if not second.significance >= _FOUND:
                continue
            place = ([second.x, second.y] - stamp.grid.offset) * stamp.grid.scale
            if roomy is None:
                roomy = self.stamp(self._light, pixels, blended=True)
            trial = self.solve(
                roomy, np.array([*star, second.flux / star[FLUX], *(place - star[[X, Y]])]), shared, COARSE
            )
            if _explains_more(trial, best) and trial.stars[0][RATIO] > _LEAST_RATIO:
                best = trial
        if best.loss / stamp.used.sum() > _POOR:
            best = self._with_near_companion(roomy or self.stamp(self._light, pixels, blended=True), best, first)
        return _central_first(best)

    def _with_near_companion(self, stamp: Stamp, best: Solution, first: np.ndarray) -> Solution:
        """Return the best solution with a second star that overlaps most of the first, if that explains much more.

        A fit of one star takes two for one that is larger and oddly shaped, so that the residuals do not show where
        the second stands: places around the first are tried, without aberrations.
        """
        diameter = self._light.diameter / self._instrument.pixel
        nothing, trials = np.zeros_like(best.shared), []
        for radius in _NEAR_RADII:
            for angle in np.arange(_NEAR_ANGLES) * 2.0 * np.pi / _NEAR_ANGLES:
                offset = radius * diameter * np.array([np.cos(angle), np.sin(angle)])
                star = np.array([*first, 1.0, *offset])
                star[FLUX] *= 0.5
                # The template stands in the middle of the two.
                star[[X, Y]] -= 0.5 * offset
                trials.append(self.solve(stamp, star, nothing, COARSE, _FIRST_STEPS))
        # After a few steps the places that lead nowhere are known.
        for begun in sorted(trials, key=lambda trial: trial.loss)[:_FINISHED]:
            trial = self.solve(stamp, begun.stars[0], begun.shared, COARSE)
            if _explains_more(trial, best) and trial.stars[0][RATIO] > _LEAST_RATIO:
                best = trial
        return best

    def other_focus_is_better(self, pixels: Pixels, stamp: Stamp, solution: Solution) -> bool:
        """Return whether the image fits a detector on the other side of focus better."""
        if solution.loss / stamp.used.sum() < _MISFIT:
            return False
        mirrored = self.stamp(self._light.mirrored(), pixels)
        start, _ = self.start(mirrored, self.template(mirrored))
        return _explains_more(self.solve(mirrored, start, tolerance=COARSE), solution)


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
    place = stamp.grid.places(star, stamp.rays.landing(wave))
    outside = np.abs(place) > 0.5 * np.array(stamp.grid.shape[::-1])
    return float(stamp.rays.weights(wave) @ outside.any(axis=1))


def _clipped(full: Stamp, model: np.ndarray, misfit: float) -> np.ndarray:
    """Return the pixels without those far off the model, cosmic rays and dead ones, and their neighbours."""
    pull = np.where(full.used, pulls(full, model), 0.0)
    far = np.abs(pull) > _CLIP * max(1.0, float(np.sqrt(misfit)))
    return full.used & ~maximum_filter(far, 3) if far.any() else full.used
