"""Solutions for one star on stamps of several scales."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from ..core.statistics import RMS_PER_MAD
from .amplifier_steps import StepFit
from .bad_pixels import unused_regions, without_outliers
from .donut_rays import ZernikeRays
from .image_model import BACKGROUND, FLUX, NUISANCES, RATIO, SLOPE_X, SLOPE_Y, STRENGTH, X, Y
from .light import Instrument, Sampling, StarLight
from .likelihood import Stamp, model_image, pulls
from .moving_rims import FreeRims
from .noise import AssumedElectron, measured_noise
from .rim_search import RimFit, RimSolver, finished
from .solve import FINE, STEPS, Group, Solution, solve
from .stamps import Match, Pixels, match_template, measured_variance, moved

#: Pixels across a donut in the coarse fit, about.
_COARSE_DIAMETER = 30.0
#: Diameters of a donut from its middle, and pixels beyond, within which a stamp is fitted: farther away, stars
#: hardly overlap with it, and the sky tells nothing of its wavefront.
_ROOM_DIAMETERS = 0.8
_ROOM_PIXELS = 12.0
#: Pulls of pixels that are clipped, over that of typical pixels.
_CLIP = 7.0
#: Light over the brightest, above which a pixel of the model is one of the donut.
BRIGHT = 0.2
#: Rounds of clipping.
_ROUNDS = 3
#: Most scales of the last fits.
_SCALES = 3
#: Most steps of a fit with few cells that finds the seeing.
_SEEING_STEPS = 8
#: Cells across the pupil beyond which the seeing is found with fewer.
_MANY = 250
#: Fraction of the seeing that a search starts from below which that of a first solution is taken in its place.
_MUCH_SHARPER = 0.5
#: Cells across the pupil beyond those of a first search from which on it has some of its own.
_SHARED = 2.0
#: Cells across the pupil over those that are needed.
_ENOUGH = 1.25
#: Cells across the pupil from which on those on rims leave less chi-square than rims that explain an image alike.
_FOR_RIVALS = 120
#: Error of the wavefront by photons [m] beyond which pixels become no smaller for a seeing.
_FAINT = 1e-7
#: Noll indices without which rims are not searched for.
_TERMS_FOR_RIMS = np.arange(4, 23)


@dataclass(frozen=True)
class Rival:
    """Rims of another fit of a star, its unknowns of the wavefront, and its loss beyond that of the best one."""

    rims: FreeRims
    wave: np.ndarray
    worse: float


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
    sampling : Sampling, optional
        How finely that of the last fit is sampled.
    errors : StarErrors, optional
        Errors of the fit by itself, of :mod:`.star_errors`, where they are at hand.
    rivals : tuple of Rival
        Fits with other rims free that are no worse but by chance.
    steps : StepFit, optional
        Steps between amplifiers that were taken off the image, of :mod:`.step_search`, where there are any.
    """

    light: StarLight
    stamp: Stamp
    full: Stamp
    solution: Solution
    model: np.ndarray
    sampling: Sampling | None = None
    errors: object = None
    rivals: tuple[Rival, ...] = ()
    steps: StepFit | None = None


@dataclass(frozen=True)
class Start:
    """Start of a search in coarse pixels: these, their stamp, the template on it, where it fits, and unknowns."""

    pixels: Pixels
    stamp: Stamp
    template: np.ndarray
    match: Match
    unknowns: np.ndarray


@dataclass(frozen=True)
class LostLight:
    """Fractions of a star's light beside the stamp and on unused pixels, and on regions of these alone."""

    any_pixel: float
    regions: float


@dataclass(frozen=True)
class _Fine:
    """A stamp for the last fits, how it is sampled, and whether by few cells that find the seeing alone."""

    stamp: Stamp
    pixels: Pixels
    sampling: Sampling
    few_cells: bool = False

    def of(self, fitter: StarFitter) -> Stamp:
        """Return the stamp sampled alike for the light of a fitter."""
        return fitter.sampled_stamp(self.pixels, self.sampling, self.stamp.grid.reach)


class StarFitter:
    """Solutions for one star on stamps of several scales."""

    def __init__(
        self, instrument: Instrument, light: StarLight, clean: Pixels, strength: float, wavefront: bool
    ) -> None:
        self.instrument, self.clean, self._wavefront = instrument, clean, wavefront
        self.donut = instrument.is_donut(light)
        self._strength = strength
        self._strength_prior = instrument.strength_prior
        self._fwhm = float(instrument.seeing.fwhm(np.asarray(strength)))
        self._set_light(light)
        self._binned: dict[int, Pixels] = {}
        #: Cells across the pupil that the last fits are expected to need, so that the first ones share them.
        self._across = self._sampling(self._fwhm, self._side(self._fwhm))[1].across

    def near(self, match: Match, side: int) -> tuple[int, int]:
        """Return the sides [pixels] of the middle of the stamp that has all light of a match on pixels of a side."""
        room = _ROOM_DIAMETERS * self._light.diameter / self.instrument.pixel + _ROOM_PIXELS
        ny, nx = (
            n - 2 * max(math.floor(0.5 * n - room - side * abs(place)), 0)
            for n, place in zip(self.clean.image.shape, (match.y, match.x), strict=True)
        )
        return ny, nx

    @property
    def fits_wavefront(self) -> bool:
        """Whether the wavefront is unknown."""
        return self._wavefront

    @property
    def light(self) -> StarLight:
        """Light of the star."""
        return self._light

    def _set_light(self, light: StarLight) -> None:
        terms = self.instrument.terms
        self._light = light
        self.precision = np.concatenate([terms.precision, light.shift_precision])
        self._mean = np.concatenate([np.zeros(len(terms.precision)), light.shift_mean])
        self._limits = np.concatenate([np.full(len(terms.precision), np.inf), light.shift_limit])
        n = len(self.precision)
        self._map = np.eye(n)[None] if self._wavefront else np.zeros((1, n, 0))
        self._rays: dict[int, ZernikeRays] = {}
        self._begun: StarSolution | None = None

    def beginning_from(self, star: StarSolution) -> StarFitter:
        """Return the same with the sampling of a fit of the star, if light of the same terms was traced for that."""
        rays = star.stamp.rays
        assert isinstance(rays, ZernikeRays)
        same_light = star.light.telescope is self._light.telescope
        if star.sampling is None or not (same_light and np.array_equal(rays.noll, self.instrument.noll)):
            return self
        fitter = copy(self)
        fitter._rays, fitter._begun = {star.sampling.across: rays}, star
        return fitter

    @property
    def searches_rims(self) -> bool:
        """Whether rims may be free: light of terms that are not fitted would be taken for that of rims."""
        all_terms = bool(np.isin(_TERMS_FOR_RIMS, self.instrument.terms.every).all())
        return bool(self.donut and self._wavefront and self.instrument.model.rims.search and all_terms)

    def with_light(self, light: StarLight) -> StarFitter:
        """Return the same for the light of the star with its rims elsewhere; light that is the same was traced."""
        if light is self._light:
            return self
        fitter = copy(self)
        fitter._set_light(light)
        return fitter

    def with_free_rims(self, rims: FreeRims) -> StarFitter:
        """Return the same with rims free where these stand."""
        return self.with_light(self._light.with_free_rims(rims, self.instrument.middle)) if rims.bodies else self

    def rim_solver(self, tolerance: float, stamp_of: Callable[[StarFitter], Stamp]) -> RimSolver:
        """Return the function that fits light with its rims elsewhere, from the unknowns of a solution."""

        def solved(light: StarLight, start: Solution, hopeless: float = math.inf) -> RimFit:
            fitter = self.with_light(light)
            moved_stamp = stamp_of(fitter)
            held = light.before_free_rims + len(self.instrument.noll)
            shared = np.concatenate([start.shared[:held], np.zeros(len(light.free_rims))])
            best = fitter.solve(moved_stamp, start.stars[0], shared, tolerance, hopeless=hopeless)
            return RimFit(light, moved_stamp, best)

        return solved

    def _of(self, light: StarLight, across: int) -> ZernikeRays:
        """Return the light through at least so many cells across the pupil, and at most a quarter more."""
        if light is not self._light:
            return self.instrument.rays(light, across)
        for cells, rays in self._rays.items():
            if across <= cells <= _ENOUGH * across:
                return rays
        return self._rays.setdefault(across, self.instrument.rays(light, across))

    def of_first_terms(self, count: int) -> StarFitter:
        """Return the same with so many of the first unknowns of the wavefront; the others are zero."""
        fitter = copy(self)
        fitter._map = self._map[:, :, :count]
        return fitter

    def central(self, shape: tuple[int, int]) -> StarFitter:
        """Return the same for the pixels [ny, nx] about the middle of the stamp."""
        fitter = copy(self)
        fitter.clean, fitter._binned = self.clean.central(shape), {}
        return fitter

    def with_used(self, used: np.ndarray) -> StarFitter:
        """Return the same without some of the pixels."""
        fitter = copy(self)
        fitter.clean, fitter._binned = replace(self.clean, image=self.clean.image * used, used=used), {}
        return fitter

    def stamp(self, light: StarLight, pixels: Pixels, *, blended: bool = False) -> Stamp:
        """Return the stamp of a star's light in coarse pixels; neighbours need room beside it."""
        sampling = self.instrument.sampling(light, pixels, self._fwhm)
        # Neighbours may stand anywhere beside the stamp.
        reach = light.diameter * (1.0 if blended else 0.5) if pixels.side > 1 else 0.0
        shared = self._across if self._across < _SHARED * sampling.across else 0
        rays = self._of(light, max(sampling.across, shared))
        if self.instrument.may_merge(light, pixels, rays):
            rays = rays.merged()
        return self.instrument.stamp(light, pixels, rays, sampling.sharp, reach)

    def mirrored_stamp(self, light: StarLight, start: Start) -> Stamp:
        """Return the stamp of a star's light on the other side of focus, through the cells of the pupil of a start."""
        rays, grid = start.stamp.rays, start.stamp.grid
        assert isinstance(rays, ZernikeRays)
        return self.instrument.stamp(light, start.pixels, rays.through(light.telescope), grid.sharp, grid.reach)

    def sampled_stamp(self, pixels: Pixels, sampling: Sampling, reach: float) -> Stamp:
        """Return the stamp of pixels that are sampled so, with room for light beside it [m]."""
        rays = self._of(self._light, sampling.across)
        return self.instrument.stamp(self._light, pixels, rays, sampling.sharp, reach)

    def _side(self, fwhm: float) -> int:
        """Return how many pixels are summed along each axis for the last fits in a seeing [rad]."""
        return self.instrument.binning(self._light, self.clean, fwhm) if self.donut else 1

    def finest(self, coarse: Solution, rivals: tuple[RimFit, ...] = (), *, preliminary: bool = False) -> StarSolution:
        """Return the best model in pixels as fine as the seeing needs, without those far off it.

        Rivals are coarse fits of other rims that are as good. A preliminary model has no rims elsewhere.
        """
        best, blended, fine = coarse, len(coarse.stars[0]) > RATIO, self._fine_begun()
        if fine is not None:
            best = self.solve(fine.stamp, best.stars[0], best.shared)
        # The seeing of a solution decides how finely the next one is sampled.
        for _ in range(_SCALES):
            finer = self.sampled(best, blended, fine)
            if finer is fine:
                break
            steps = _SEEING_STEPS if finer.few_cells else STEPS
            fine, best = finer, self.solve(finer.stamp, best.stars[0], best.shared, steps=steps)
        assert fine is not None
        if self.searches_rims and not preliminary:
            fit = RimFit(self._light, fine.stamp, best, rivals)
            fit = finished(self.instrument, fit, 0.0, self.rim_solver(FINE, fine.of))
            if fit.rivals and fine.sampling.across < _FOR_RIVALS:
                fine = replace(fine, sampling=replace(fine.sampling, across=_FOR_RIVALS))
                solved = self.rim_solver(FINE, fine.of)
                finer_fit = replace(solved(fit.light, fit.solution), rivals=fit.rivals)
                fit = finished(self.instrument, finer_fit, 0.0, solved)
            if fit.solution.converged or not best.converged:
                star = self.with_light(fit.light)._clipped(replace(fine, stamp=fit.stamp), fit.solution)
                return replace(star, rivals=tuple(self._rival(rival, fit.solution.loss) for rival in fit.rivals))
        return self._clipped(fine, best)

    def _rival(self, fit: RimFit, loss: float) -> Rival:
        """Return a fit as a rival of one of another loss."""
        noise = max(1.0, loss / fit.stamp.used.sum())
        wave = fit.solution.waves[0][: len(self.instrument.noll)]
        return Rival(fit.light.free_rims, wave, (fit.solution.loss - loss) / noise)

    def _clipped(self, fine: _Fine, best: Solution) -> StarSolution:
        """Return the best model without pixels far off it."""
        stamp, full = fine.stamp, self.every_pixel(fine)
        model = model_image(full, best.stars[0], best.waves[0])
        for _ in range(_ROUNDS):
            pull = pulls(full, model)
            limit = _CLIP * _typical(pull, model, full.used)
            used = without_outliers(pull, full.image, model, full.used, limit, folds=True)
            if (used == full.used).all():
                break
            full = replace(full, used=used)
            stamp = replace(stamp, used=replace(self.clean, used=used).binned(fine.pixels.side).used)
            best = self.solve(stamp, best.stars[0], best.shared)
            model = model_image(full, best.stars[0], best.waves[0])
        return StarSolution(self._light, stamp, full, best, model, fine.sampling)

    def with_measured_noise(self, star: StarSolution, electron: AssumedElectron) -> tuple[StarSolution, float]:
        """Return a solution in the unit in which what it leaves has the noise of electrons, and that unit."""
        if star.light is not self._light:
            return self.with_light(star.light).with_measured_noise(star, electron)
        unknowns, wave = star.solution.stars[0], star.solution.waves[0]
        level = model_image(star.full, np.where(np.arange(len(unknowns)) == FLUX, 0.0, unknowns), wave)
        residual, light = star.full.image - star.model, star.model - level
        noise = measured_noise(residual, light, star.full.used, electron.sky_level, correlated=True, unit=electron.size)
        unit = noise.photon
        unknowns = unknowns.copy()
        unknowns[[FLUX, BACKGROUND, SLOPE_X, SLOPE_Y]] /= unit
        # The noise is that at the level of the background, and an image without light has less, or more.
        sky = max(noise.sky / unit**2 - float(unknowns[BACKGROUND]), 0.0)

        def rescaled(stamp: Stamp) -> Stamp:
            return replace(
                stamp,
                image=stamp.image / unit,
                variance=np.full(stamp.image.shape, sky * stamp.grid.scale**2),
            )

        stamp, full = rescaled(star.stamp), rescaled(star.full)
        best = self.solve(stamp, unknowns, star.solution.shared)
        model = model_image(full, best.stars[0], best.waves[0])
        return replace(star, stamp=stamp, full=full, solution=best, model=model), unit

    def sampled(self, solution: Solution, blended: bool, last: _Fine | None) -> _Fine:
        """Return a stamp fine enough for the seeing of a solution: the last one if that is, nearly."""
        instrument, light, few_cells = self.instrument, self._light, False
        if last is None:
            fwhm = self._fwhm
            if not instrument.known_seeing:
                # An image that is far sharper than the start of the search is not summed for that.
                sharper = float(instrument.seeing.fwhm(solution.stars[0][STRENGTH]))
                fwhm = sharper if sharper < _MUCH_SHARPER * fwhm else fwhm
            pixels, sampling = self._sampling(fwhm, self._side(fwhm), self._error(solution))
            seeing_is_free = not instrument.known_seeing and instrument.model.n_pupil is None
            if sampling.sharp and seeing_is_free and sampling.across > _MANY:
                # Few large cells find the seeing, of which a sharp image says much.
                sampling, few_cells = replace(sampling, across=sampling.across // 2), True
        else:
            fwhm = float(instrument.seeing.fwhm(solution.stars[0][STRENGTH]))
            # Pixels without noise, whatever variance is claimed for them, know the wavefront better than claimed.
            error = math.sqrt(min(solution.loss / last.stamp.used.sum(), 1.0)) * self._error(solution)
            if not self._sampling(_ENOUGH * fwhm, last.pixels.side, _ENOUGH * error)[1].finer_than(last.sampling):
                return last
            side = last.pixels.side if _FAINT < error < math.inf else min(self._side(fwhm), last.pixels.side)
            pixels, sampling = self._sampling(fwhm, side, error)
        stamp = self.sampled_stamp(pixels, sampling, light.diameter if blended else self._overhang(solution))
        return _Fine(stamp, pixels, sampling, few_cells)

    def _fine_begun(self) -> _Fine | None:
        """Return the stamp sampled as that of the fit that this one begins from, if it has its light."""
        if self._begun is None or self._begun.sampling is None:
            return None
        grid, sampling = self._begun.stamp.grid, self._begun.sampling
        pixels = self._binned_pixels(round(grid.scale))
        return _Fine(self.sampled_stamp(pixels, sampling, grid.reach), pixels, sampling)

    def _error(self, solution: Solution) -> float:
        """Return the error of the wavefront by photons [m], infinite without one."""
        wave = slice(len(self.instrument.noll)) if len(solution.shared) else slice(0)
        variance = float(np.trace(solution.shared_covariance[wave, wave]))
        # Rounding may leave a negative one of donuts far brighter than detectors have.
        return math.sqrt(variance) if variance > 0.0 else math.inf

    def _overhang(self, solution: Solution) -> float:
        """Return how far the light of a star reaches beyond the stamp [m]."""
        middle = 0.5 * self.instrument.pixel * np.array(self.clean.image.shape[::-1])
        place = self.instrument.pixel * np.abs(solution.stars[0][[X, Y]])
        return float(np.clip(place + 0.5 * self._light.diameter - middle, 0.0, self._light.diameter).max())

    def _sampling(self, fwhm: float, side: int, error: float = math.inf) -> tuple[Pixels, Sampling]:
        pixels = self._binned_pixels(side)
        return pixels, self.instrument.sampling(self._light, pixels, fwhm, error)

    def _binned_pixels(self, side: int) -> Pixels:
        return self._binned.get(side) or self._binned.setdefault(side, self.clean.binned(side))

    def every_pixel(self, fine: _Fine) -> Stamp:
        """Return the stamp with all pixels of the detector."""
        if fine.pixels.side == 1:
            return fine.stamp
        rays, grid = self._of(self._light, fine.sampling.across), fine.stamp.grid
        return self.instrument.stamp(self._light, self.clean, rays, False, grid.reach)

    def start(self) -> Start:
        """Return where the template of a star without aberrations fits best, in coarse pixels."""
        across = self._light.diameter / self.instrument.pixel
        pixels = self.clean.smoothed(max(1, round(across / _COARSE_DIAMETER))) if self.donut else self.clean
        stamp = self.stamp(self._light, pixels)
        return self.start_on(pixels, stamp)

    def start_on(self, pixels: Pixels, stamp: Stamp) -> Start:
        """Return the start of a search on a stamp of coarse pixels."""
        grid = stamp.grid
        unknowns = np.zeros(len(NUISANCES))
        unknowns[[FLUX, STRENGTH]] = 1.0, self._strength
        unknowns[[X, Y]] = -grid.scale * grid.offset
        template = model_image(stamp, unknowns, np.zeros(len(self.precision)))
        measured = grid.scale**2 * measured_variance(self.clean)
        match = match_template(stamp.image, stamp.used, stamp.variance, template, measured)
        if pixels.side == 1 and self.donut:
            # Light of a small donut is as steep as noise, and on a tight stamp there is nothing else.
            light = match.flux * moved(template, int(match.y), int(match.x))
            beside = replace(self.clean, image=self.clean.image - light)
            measured = min(measured, measured_variance(beside))
            match = match_template(stamp.image, stamp.used, stamp.variance, template, measured)
        unknowns[FLUX] = max(match.flux, 1.0)
        unknowns[[X, Y]] += grid.scale * np.array([match.x, match.y])
        level, *slopes = match.plane / grid.scale**2
        unknowns[[SLOPE_X, SLOPE_Y]] = np.array(slopes) / grid.scale
        # The middle of the stamp is that of its coarse pixels but for those that are left over.
        unknowns[BACKGROUND] = level + grid.scale * (grid.offset @ unknowns[[SLOPE_X, SLOPE_Y]])
        return Start(pixels, stamp, template, match, unknowns)

    def without_outliers(self, star: np.ndarray, wave: np.ndarray, *, lines_only: bool = False) -> np.ndarray:
        """Return the used pixels without those far off a model."""
        full = self.instrument.stamp(self._light, self.clean, self._of(self._light, self._across), sharp=False)
        model = model_image(full, star, wave)
        pull = pulls(full, model)
        limit = _CLIP * _typical(pull, model, full.used)
        return without_outliers(pull, full.image, model, full.used, limit, lines_only=lines_only)

    def lost_light(self, stamp: Stamp, solution: Solution) -> LostLight:
        """Return the fractions of the star's light that land beside the stamp and on unused pixels."""
        used, star, wave = self.clean.used, solution.stars[0], solution.waves[0]
        used = stamp.used if stamp.used.shape == used.shape else used
        landing, weights = stamp.rays.landing(wave), stamp.rays.weights(wave)
        regions = np.zeros_like(used) if used.all() else unused_regions(used)
        middle = 0.5 * (np.array(used.shape[::-1]) - 1.0)
        place = np.rint(landing / self.instrument.pixel + star[[X, Y]] + middle)
        outside = ~((place >= 0) & (place < used.shape[::-1])).all(axis=1)
        column, row = np.where(outside[:, None], 0, place).astype(np.int64).T
        lost, cut = (outside | pixels[row, column] for pixels in (~used, regions))
        return LostLight(float(weights @ lost), float(weights @ cut))

    def lost_at_best(self, stamp: Stamp) -> float:
        """Return the fraction of the light of a star without aberrations beside the stamp when it is in the middle."""
        wave = np.zeros(len(self.precision))
        landing, weights = stamp.rays.landing(wave), stamp.rays.weights(wave)
        half = 0.5 * self.instrument.pixel * np.array(self.clean.used.shape[::-1])
        return float(weights @ (np.abs(landing - weights @ landing) > half).any(axis=1))

    def solve(
        self,
        stamp: Stamp,
        star: np.ndarray,
        shared: np.ndarray | None = None,
        tolerance: float = FINE,
        steps: int = STEPS,
        hopeless: float = math.inf,
    ) -> Solution:
        """Return the best unknowns from a start; see :func:`~pachon.sensing.solve.solve`."""
        n = self._map.shape[2]
        known = self.instrument.known_seeing
        mean, limits = self._mean[:n], self._limits[:n]
        # In smoothed pixels residuals are no noise of these.
        count = 0 if stamp.grid.coarse else min(n, len(self.instrument.noll))
        group = Group((stamp,), self._map, self.precision[:n], known, False, mean, limits, self._strength_prior, count)
        start = np.zeros(n) if shared is None else shared
        return solve(group, [star], start, tolerance=tolerance, steps=steps, hopeless=hopeless)


def _typical(pull: np.ndarray, model: np.ndarray, used: np.ndarray) -> float:
    """Return the size of a typical pull, at least 1, on a donut or beside it: turbulence and noise make it larger."""
    low = float(model[used].min(initial=np.inf))
    bright = model - low > BRIGHT * (model.max() - low)
    sides = [np.abs(pull[used & side]) for side in (bright, ~bright)]
    return max([1.0, *(float(RMS_PER_MAD * np.median(pulls)) for pulls in sides if pulls.size)])
