"""Fit of one star: start from a template, coarse and fine pixels, neighbours, wrong side of focus, bad pixels."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from ..core.statistics import RMS_PER_MAD
from ..models.zernike_polynomials import noll_to_nm
from .bad_pixels import unused_regions, without_bad_pixels, without_outliers
from .donut_rays import ZernikeRays
from .flags import DonutFlag
from .image_model import BACKGROUND, FLUX, NUISANCES, RATIO, SLOPE_X, SLOPE_Y, STRENGTH, X, Y
from .light import Instrument, Sampling, StarLight
from .likelihood import Stamp, model_image, pulls
from .neighbours import NeighbourSearch, explains_more
from .noise import measured_noise
from .rim_search import RimFit, with_moved_rims
from .sides import BothSides, SideFit
from .solve import COARSE, FINE, STEPS, Group, Solution, solve
from .stamps import Match, Pixels, match_template, measured_variance, plane_basis

#: Images wider than this are donuts [pixels].
SMALLEST_DONUT = 24.0
#: Pixels across a donut in the coarse fit, about.
_COARSE_DIAMETER = 30.0
#: Signal over noise of a donut above a plane background of any level; the noise of a sky reaches 4 somewhere on a
#: stamp.
_FOUND = 6.0
#: Loss a coarse pixel from which on the other side of focus is tried; photons leave 0.1, since smoothed noise is small.
_MISFIT = 0.15
#: Fraction of the light beside the stamp or on unused regions from which on a donut is cut off.
_CUT_OFF = 0.05
#: Fraction of the light beside the stamp or on unused pixels from which on a donut is lost: a little more than half.
_LOST = 0.55
#: Steps of the fit on the other side of focus.
_MIRRORED_STEPS = 8
#: Least fraction of the variance of the image that the model explains.
_EXPLAINED = 0.5
#: Pulls of pixels that are clipped, over that of typical pixels.
_CLIP = 7.0
#: Loss a coarse pixel from which on what the model lacks may be a patch of the stamp that is no star, and something of
#: another size is no donut.
_POOR = 1.0
#: Sizes over that of the telescope's donut between which something that fits badly may still be one.
_LIKE_DONUTS = (0.7, 1.35)
#: Largest part of the misfit that a search without patches may leave.
_LEFT = 0.5
#: Fraction of the light that may be lost by such patches.
_MASKED = 0.4
#: Light over the brightest, below which a pixel of the model is none of the donut.
_DARK = 0.01
#: Light over the brightest, above which a pixel of the model is one of the donut.
_BRIGHT = 0.2
#: Sizes of donuts over that of the telescope's own between which nothing is said of them: by 120 um of 1500 of defocus.
_SIZES = (0.92, 1.08)
#: Rounds of clipping.
_ROUNDS = 3
#: Most scales of the last fits.
_SCALES = 3
#: Fraction of the seeing that a search starts from below which that of a first solution is taken in its place.
_MUCH_SHARPER = 0.5
#: Cells across the pupil beyond those of a first search from which on it has some of its own.
_SHARED = 2.0
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
    """Outcome of the fit of one star by itself.

    Attributes
    ----------
    flags : DonutFlag
        What is to be said of it.
    best : StarSolution, optional
        Its best model, unless it failed.
    unit, level : float
        The image is that of the solution, whose light has the noise of electrons, times a unit, above a level.
    sides : BothSides, optional
        Fits on both sides of focus.
    """

    flags: DonutFlag
    best: StarSolution | None = None
    unit: float = 1.0
    level: float = 0.0
    sides: BothSides | None = None

    @property
    def usable(self) -> StarSolution | None:
        """The best model where no flag says that there is no result."""
        return self.best if self.flags.usable else None


def fit_star(
    instrument: Instrument,
    light: StarLight,
    pixels: Pixels,
    strength: float,
    *,
    wavefront: bool,
    sky_level: float | None = None,
) -> StarFit:
    """Fit one star.

    Parameters
    ----------
    instrument, light, pixels
        Telescope and model of the images, light of the star and its stamp.
    strength : float
        Strength of the turbulence [1/m]: a start, or the value where the seeing is known.
    wavefront : bool
        Whether the wavefront is fitted; where not, it is zero.
    sky_level : float, optional
        Light of the sky that was taken off, where noise is not known: that of the result is what the fit leaves, in a
        unit in which light has the noise of electrons.
    """
    across = light.diameter / instrument.pixel
    donut = across > SMALLEST_DONUT
    fitter = _StarFitter(instrument, light, without_bad_pixels(pixels) if donut else pixels, strength, wavefront)
    start = fitter.start()
    flags = DonutFlag.OK
    if not start.match.significance >= _FOUND:
        flags |= DonutFlag.NO_DONUT
    if start.match.flux < len(NUISANCES) + (len(instrument.noll) if wavefront else 0):
        flags |= DonutFlag.TOO_FEW_PHOTONS
    if flags:
        return StarFit(flags)
    search = fitter.search(start)
    if donut and search.misfit > _POOR:
        search = search.fitter.masked_search(search)
    if donut and search.misfit > _POOR and not _is_between(_size(search.start.stamp, search.best), _LIKE_DONUTS):
        return StarFit(DonutFlag.NO_DONUT | DonutFlag.OTHER_SIZE)
    sides = search.fitter.both_sides(search.start, search.best) if donut and wavefront else None
    explained = _explained(search.start.stamp, search.best)
    # Before rims are free, with which the wrong side of focus fits much.
    if donut and explained and search.fitter.other_focus_is_better(search.start, search.best):
        return StarFit(DonutFlag.DEFOCUS_SIGN, sides=sides)
    if donut and wavefront and instrument.model.rims.search:
        search = search.fitter.search_of_rims(search)
    fitter, start, best = search.fitter, search.start, search.best
    if not _explained(start.stamp, best):
        return StarFit(DonutFlag.NO_DONUT)
    if fitter.lost_light(start.stamp, best).any_pixel > _LOST:
        return StarFit(DonutFlag.MOSTLY_LOST)
    finest = fitter.finest(best)
    if (finest.full.used != pixels.used).any():
        flags |= DonutFlag.CLIPPED
    if any(body.moved for body in finest.light.free_rims.bodies):
        flags |= DonutFlag.RIM_MOVED
    if len(finest.solution.stars[0]) > RATIO:
        flags |= DonutFlag.BLENDED
    if not (finest.solution.converged and np.isfinite(finest.model).all()):
        return StarFit(flags | DonutFlag.NOT_CONVERGED, finest)
    lost = fitter.lost_light(finest.full, finest.solution)
    if lost.any_pixel > _LOST:
        return StarFit(DonutFlag.MOSTLY_LOST)
    if lost.regions > _CUT_OFF:
        flags |= DonutFlag.CUT_OFF
    if not _is_between(_size(finest.stamp, finest.solution), _SIZES):
        flags |= DonutFlag.OTHER_SIZE
    if sides is not None and sides.ambiguous:
        flags |= DonutFlag.AMBIGUOUS_SIDE
    if sky_level is not None and flags.usable:
        return StarFit(flags, *fitter.with_measured_noise(finest, sky_level), sides=sides)
    return StarFit(flags, finest, sides=sides)


@dataclass(frozen=True)
class _Start:
    """Start of a search in coarse pixels: these, their stamp, the template on it, where it fits, and unknowns."""

    pixels: Pixels
    stamp: Stamp
    template: np.ndarray
    match: Match
    unknowns: np.ndarray


@dataclass(frozen=True)
class _Search:
    """Best coarse solution, from a start, on the pixels of a fitter, and that without neighbours."""

    fitter: _StarFitter
    start: _Start
    best: Solution
    single: Solution

    @property
    def misfit(self) -> float:
        """Loss a coarse pixel, beyond that of noise."""
        return _misfit(self.start.pixels, self.start.stamp, self.best)


@dataclass(frozen=True)
class _LostLight:
    """Fractions of a star's light beside the stamp and on unused pixels, and on regions of these alone."""

    any_pixel: float
    regions: float


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

    def with_used(self, used: np.ndarray) -> _StarFitter:
        """Return the same without some of the pixels."""
        fitter = copy(self)
        fitter._clean, fitter._binned = replace(self._clean, image=self._clean.image * used, used=used), {}
        return fitter

    def stamp(self, light: StarLight, pixels: Pixels, *, blended: bool = False) -> Stamp:
        """Return the stamp of a star's light in coarse pixels; neighbours need room beside it."""
        sampling = self._instrument.sampling(light, pixels, self._fwhm)
        # Neighbours may stand anywhere beside the stamp.
        reach = light.diameter * (1.0 if blended else 0.5) if pixels.side > 1 else 0.0
        shared = self._across if self._across < _SHARED * sampling.across else 0
        rays = self._of(light, max(sampling.across, shared))
        return self._instrument.stamp(light, pixels, rays, sampling.sharp, reach)

    def sampled_stamp(self, pixels: Pixels, sampling: Sampling, reach: float) -> Stamp:
        """Return the stamp of pixels that are sampled so, with room for light beside it [m]."""
        rays = self._of(self._light, sampling.across)
        return self._instrument.stamp(self._light, pixels, rays, sampling.sharp, reach)

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
            pull = pulls(full, model)
            used = without_outliers(pull, full.image, model, full.used, _CLIP * _typical(pull, model, full.used))
            if (used == full.used).all():
                break
            full = replace(full, used=used)
            stamp = replace(stamp, used=replace(self._clean, used=used).binned(fine.pixels.side).used)
            best = self.solve(stamp, best.stars[0], best.shared)
            model = model_image(full, best.stars[0], best.waves[0])
        return StarSolution(self._light, stamp, full, best, model)

    def with_measured_noise(self, star: StarSolution, sky_level: float) -> tuple[StarSolution, float]:
        """Return a solution in the unit in which what it leaves has the noise of electrons, and that unit."""
        if star.light is not self._light:
            return self.with_light(star.light).with_measured_noise(star, sky_level)
        unknowns, wave = star.solution.stars[0], star.solution.waves[0]
        level = model_image(star.full, np.where(np.arange(len(unknowns)) == FLUX, 0.0, unknowns), wave)
        noise = measured_noise(
            star.full.image - star.model, star.model - level, star.full.used, sky_level, correlated=True
        )
        unit, sky = noise.photon, noise.sky / noise.photon**2

        def rescaled(stamp: Stamp) -> Stamp:
            return replace(
                stamp,
                image=stamp.image / unit,
                variance=np.full(stamp.image.shape, sky * stamp.grid.scale**2),
            )

        unknowns = unknowns.copy()
        unknowns[[FLUX, BACKGROUND, SLOPE_X, SLOPE_Y]] /= unit
        stamp, full = rescaled(star.stamp), rescaled(star.full)
        best = self.solve(stamp, unknowns, star.solution.shared)
        return StarSolution(self._light, stamp, full, best, model_image(full, best.stars[0], best.waves[0])), unit

    def sampled(self, solution: Solution, blended: bool, last: _Fine | None) -> _Fine:
        """Return a stamp fine enough for the seeing of a solution: the last one if that is, nearly."""
        instrument, light = self._instrument, self._light
        if last is None:
            fwhm = self._fwhm
            if not instrument.known_seeing:
                # An image that is far sharper than the start of the search is not summed for that.
                sharper = float(instrument.seeing.fwhm(solution.stars[0][STRENGTH]))
                fwhm = sharper if sharper < _MUCH_SHARPER * fwhm else fwhm
            pixels, sampling = self._sampling(fwhm, self._side(fwhm))
            if sampling.sharp and not instrument.known_seeing and instrument.model.n_pupil is None:
                # Few large cells find the seeing, of which a sharp image says much.
                sampling = replace(sampling, across=sampling.across // 2)
        else:
            fwhm = float(instrument.seeing.fwhm(solution.stars[0][STRENGTH]))
            wave = slice(len(instrument.noll)) if len(solution.shared) else slice(0)
            # Pixels without noise, whatever variance is claimed for them, know the wavefront better than claimed.
            noise = min(solution.loss / last.stamp.used.sum(), 1.0)
            error = math.sqrt(noise * np.trace(solution.shared_covariance[wave, wave])) or math.inf
            if not self._sampling(_ENOUGH * fwhm, last.pixels.side, _ENOUGH * error)[1].finer_than(last.sampling):
                return last
            pixels, sampling = self._sampling(fwhm, min(self._side(fwhm), last.pixels.side), error)
        stamp = self.sampled_stamp(pixels, sampling, light.diameter if blended else self._overhang(solution))
        return _Fine(stamp, pixels, sampling)

    def _overhang(self, solution: Solution) -> float:
        """Return how far the light of a star reaches beyond the stamp [m]."""
        middle = 0.5 * self._instrument.pixel * np.array(self._clean.image.shape[::-1])
        place = self._instrument.pixel * np.abs(solution.stars[0][[X, Y]])
        return float(np.clip(place + 0.5 * self._light.diameter - middle, 0.0, self._light.diameter).max())

    def _sampling(self, fwhm: float, side: int, error: float = math.inf) -> tuple[Pixels, Sampling]:
        pixels = self._binned.get(side) or self._binned.setdefault(side, self._clean.binned(side))
        return pixels, self._instrument.sampling(self._light, pixels, fwhm, error)

    def every_pixel(self, fine: _Fine) -> Stamp:
        """Return the stamp with all pixels of the detector."""
        if fine.pixels.side == 1:
            return fine.stamp
        rays, grid = self._of(self._light, fine.sampling.across), fine.stamp.grid
        return self._instrument.stamp(self._light, self._clean, rays, False, grid.reach)

    def start(self) -> _Start:
        """Return where the template of a star without aberrations fits best, in coarse pixels."""
        across = self._light.diameter / self._instrument.pixel
        pixels = self._clean.smoothed(max(1, round(across / _COARSE_DIAMETER)) if self._donut else 1)
        stamp = self.stamp(self._light, pixels)
        return self.start_on(pixels, stamp)

    def start_on(self, pixels: Pixels, stamp: Stamp) -> _Start:
        """Return the start of a search on a stamp of coarse pixels."""
        grid = stamp.grid
        unknowns = np.zeros(len(NUISANCES))
        unknowns[[FLUX, STRENGTH]] = 1.0, self._strength
        unknowns[[X, Y]] = -grid.scale * grid.offset
        template = model_image(stamp, unknowns, np.zeros(len(self._precision)))
        measured = grid.scale**2 * measured_variance(self._clean)
        match = match_template(stamp.image, stamp.used, stamp.variance, template, measured)
        unknowns[FLUX] = max(match.flux, 1.0)
        unknowns[[X, Y]] += grid.scale * np.array([match.x, match.y])
        level, *slopes = match.plane / grid.scale**2
        unknowns[[SLOPE_X, SLOPE_Y]] = np.array(slopes) / grid.scale
        # The middle of the stamp is that of its coarse pixels but for those that are left over.
        unknowns[BACKGROUND] = level + grid.scale * (grid.offset @ unknowns[[SLOPE_X, SLOPE_Y]])
        return _Start(pixels, stamp, template, match, unknowns)

    def search(self, start: _Start) -> _Search:
        """Return the best coarse solution, with neighbours, and without lines of pixels far off a first one."""
        best = self.solve(start.stamp, start.unknowns, tolerance=COARSE if self._donut else FINE)
        search = _Search(self, start, best, best)
        if not self._donut:
            return search
        if search.misfit > _MISFIT:
            used = self._without_outliers(best.stars[0], best.waves[0], lines_only=True)
            if (used != self._clean.used).any():
                fitter = self.with_used(used)
                start = fitter.start()
                best = fitter.solve(start.stamp, start.unknowns, tolerance=COARSE)
                search = _Search(fitter, start, best, best)
        if self._instrument.model.neighbours:
            search = replace(search, best=search.fitter.with_neighbours(search.start, search.best))
        return search

    def search_of_rims(self, search: _Search) -> _Search:
        """Return a search with rims free that the residuals say stand elsewhere, if it explains more.

        Neighbours are quicker to find, so that they are searched for first; but light beside a rim looks like one, and
        like a cosmic ray, so that rims are searched for without those.
        """
        if search.misfit <= _MISFIT:
            return search
        start = search.start
        solved = self.rim_solver(COARSE, lambda moved: moved.stamp(moved.light, start.pixels))
        limit = _MISFIT + _noise(start.pixels)
        fitter, stamp, best = self.with_moved_rims(start.stamp, search.single, limit, solved, start.unknowns)
        if not best.loss < search.best.loss:
            return search
        trial = _Search(fitter, replace(start, stamp=stamp), best, best)
        if trial.misfit > _MISFIT and self._instrument.model.neighbours:
            trial = replace(trial, best=fitter.with_neighbours(trial.start, best))
        return trial

    def masked_search(self, search: _Search) -> _Search:
        """Return a search without patches of pixels far off the template, if these are what it does not explain."""
        template = self._robust_template(search.start)
        used = self._without_outliers(template, np.zeros(len(self._precision)))
        if (used == self._clean.used).all():
            return search
        fitter = self.with_used(used)
        start = fitter.start()
        trial = fitter.search(start)
        lost = trial.fitter.lost_light(start.stamp, trial.best).any_pixel
        return trial if trial.misfit < _LEFT * search.misfit and lost < _MASKED else search

    def _robust_template(self, start: _Start) -> np.ndarray:
        """Return unknowns of a star without aberrations by the typical pixels on the donut and beside it."""
        stamp, unknowns = start.stamp, start.unknowns.copy()
        model = model_image(stamp, unknowns, np.zeros(len(self._precision)))
        unknowns[[BACKGROUND, SLOPE_X, SLOPE_Y]] = 0.0
        light = model_image(stamp, unknowns, np.zeros(len(self._precision)))
        bright, dark = (stamp.used & side for side in (light > _BRIGHT * light.max(), light < _DARK * light.max()))
        unknowns[[BACKGROUND, SLOPE_X, SLOPE_Y]] = start.unknowns[[BACKGROUND, SLOPE_X, SLOPE_Y]]
        if dark.any():
            level = float(np.median((stamp.image - model + light)[dark]))
            unknowns[[BACKGROUND, SLOPE_X, SLOPE_Y]] = level / stamp.grid.scale**2, 0.0, 0.0
            if bright.any():
                unknowns[FLUX] *= max(float(np.median((stamp.image - level)[bright] / light[bright])), 1e-3)
        return unknowns

    def _without_outliers(self, star: np.ndarray, wave: np.ndarray, *, lines_only: bool = False) -> np.ndarray:
        """Return the used pixels without those far off a model."""
        full = self._instrument.stamp(self._light, self._clean, self._of(self._light, self._across), sharp=False)
        model = model_image(full, star, wave)
        pull = pulls(full, model)
        limit = _CLIP * _typical(pull, model, full.used)
        return without_outliers(pull, full.image, model, full.used, limit, lines_only=lines_only)

    def lost_light(self, stamp: Stamp, solution: Solution) -> _LostLight:
        """Return the fractions of the star's light that land beside the stamp and on unused pixels."""
        used, star, wave = self._clean.used, solution.stars[0], solution.waves[0]
        used = stamp.used if stamp.used.shape == used.shape else used
        landing, weights = stamp.rays.landing(wave), stamp.rays.weights(wave)
        middle = 0.5 * (np.array(used.shape[::-1]) - 1.0)
        place = np.rint(landing / self._instrument.pixel + star[[X, Y]] + middle)
        outside = ~((place >= 0) & (place < used.shape[::-1])).all(axis=1)
        column, row = np.where(outside[:, None], 0, place).astype(np.int64).T
        lost, cut = (outside | pixels[row, column] for pixels in (~used, unused_regions(used)))
        return _LostLight(float(weights @ lost), float(weights @ cut))

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

    def with_neighbours(self, start: _Start, single: Solution) -> Solution:
        """Return the solution with neighbours if there are any, else that without."""
        room = self.stamp(self._light, start.pixels, blended=True)
        diameter = self._light.diameter / self._instrument.pixel
        return NeighbourSearch(
            room, self.solve, start.unknowns, start.template, diameter, _noise(start.pixels)
        ).from_single(single)

    def both_sides(self, start: _Start, solution: Solution) -> BothSides | None:
        """Return the fits on the side of focus that is given and on the other one; None for blends.

        About the axis a wavefront W of one side of focus and -W turned by 180 degrees of the other make one image: the
        search starts there.
        """
        star = solution.stars[0]
        if len(star) > RATIO:
            return None
        noll = self._instrument.noll
        mirrored = self.stamp(self._instrument.mirrored(self._light), start.pixels)
        shared = np.zeros_like(solution.shared)
        even = np.array([noll_to_nm(int(j))[0] % 2 == 0 for j in noll])
        shared[: len(noll)] = np.where(even, -1.0, 1.0) * solution.shared[: len(noll)]
        other = self.solve(mirrored, star, shared, COARSE, _MIRRORED_STEPS)
        # What no side explains is in units of what is left.
        least = min(solution.loss, other.loss) / start.stamp.used.sum()
        scale = 1.0 / max(1.0, least / _MISFIT)
        n = len(self._instrument.terms.requested)
        given, turned = (
            SideFit(scale * side.loss, side.shared[:n], side.shared_covariance[:n, :n] / scale)
            for side in (solution, other)
        )
        return BothSides(given, turned, self._light.depth)

    def other_focus_is_better(self, start: _Start, solution: Solution) -> bool:
        """Return whether the image fits a detector on the other side of focus better."""
        if _misfit(start.pixels, start.stamp, solution) < _MISFIT:
            return False
        mirrored_light = self._instrument.mirrored(self._light)
        mirrored = self.start_on(start.pixels, self.stamp(mirrored_light, start.pixels))
        return explains_more(self.solve(mirrored.stamp, mirrored.unknowns, tolerance=COARSE), solution)


def _misfit(pixels: Pixels, stamp: Stamp, solution: Solution) -> float:
    """Return the loss a pixel, beyond that of the noise of pixels of small donuts, which are not smoothed."""
    return float(solution.loss) / max(int(stamp.used.sum()), 1) - _noise(pixels)


def _noise(pixels: Pixels) -> float:
    """Return the loss a pixel that noise makes: next to nothing where pixels are smoothed."""
    return 0.0 if pixels.blur else 1.0


def _typical(pull: np.ndarray, model: np.ndarray, used: np.ndarray) -> float:
    """Return the size of a typical pull, at least 1, on a donut or beside it: turbulence and noise make it larger."""
    low = float(model[used].min(initial=np.inf))
    bright = model - low > _BRIGHT * (model.max() - low)
    sides = [np.abs(pull[used & side]) for side in (bright, ~bright)]
    return max([1.0, *(float(RMS_PER_MAD * np.median(pulls)) for pulls in sides if pulls.size)])


def _is_between(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] < value < limits[1]


def _size(stamp: Stamp, solution: Solution) -> float:
    """Return the rms radius of a donut over that without the wavefront beside the telescope's."""
    wave = solution.waves[0]
    weights = stamp.rays.weights(wave)

    def radius(landing: np.ndarray) -> float:
        return float(np.sqrt(weights @ ((landing - weights @ landing) ** 2).sum(axis=1)))

    return radius(stamp.rays.landing(wave)) / max(radius(stamp.rays.landing(np.zeros_like(wave))), 1e-12)


def _explained(stamp: Stamp, solution: Solution) -> bool:
    """Return whether the model explains most of what stands out from a plane background."""
    used, image = stamp.used, stamp.image[stamp.used]
    root = 1.0 / np.sqrt(np.maximum(stamp.variance[used] + np.maximum(image, 0.0), 1.0))
    columns = np.stack([plane[used] for plane in plane_basis(used)], axis=-1) * root[:, None]
    residual = root * image - columns @ np.linalg.lstsq(columns, root * image, rcond=None)[0]
    count = len(image)
    return (solution.loss - count) < (1.0 - _EXPLAINED) * max(float(residual @ residual) - count, 0.0)
