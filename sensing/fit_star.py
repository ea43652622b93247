"""Fit of one star: start from a template, coarse and fine pixels, neighbours, wrong side of focus, bad pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from .bad_pixels import without_bad_pixels
from .donut_rays import ZernikeRays
from .first_search import first_solution
from .flags import DonutFlag
from .image_model import BACKGROUND, FLUX, NUISANCES, RATIO, SLOPE_X, SLOPE_Y
from .light import Instrument, StarLight
from .likelihood import Stamp, model_image, pixel_variance
from .neighbours import NeighbourSearch
from .noise import AssumedElectron
from .other_side import MISFIT, POOR, OtherSide, misfit_of
from .rim_search import MOST_BODIES, RimFit, RimSolver, settled, with_another_rim
from .sides import BothSides
from .solve import COARSE, Solution
from .stamps import Pixels, plane_basis
from .star_fitter import BRIGHT, StarFitter, StarSolution, Start
from .undetermined import is_faint, is_hidden, is_hopeless

#: Signal over noise of a donut above a plane background of any level; the noise of a sky reaches 4 somewhere on a
#: stamp.
_FOUND = 6.0
#: Fraction of the light beside the stamp or on unused regions from which on a donut is cut off.
_CUT_OFF = 0.05
#: Fraction of the light beside the stamp or on unused pixels from which on a donut is lost: a little more than half.
_LOST = 0.55
#: Flags of a fit whose search need not be done again for a model with diffraction.
_BESIDE_THE_SEARCH = DonutFlag.AMBIGUOUS_SIDE | DonutFlag.OTHER_SIZE
#: Least fraction of the variance of the image that the model explains.
_EXPLAINED = 0.5
#: Sizes over that of the telescope's donut between which something that fits badly may still be one.
_LIKE_DONUTS = (0.7, 1.35)
#: Largest part of the misfit that a search without patches may leave.
_LEFT = 0.5
#: Fraction of the light that may be lost by such patches.
_MASKED = 0.4
#: Light over the brightest, below which a pixel of the model is none of the donut.
_DARK = 0.01
#: Sizes of donuts over that of the telescope's own between which nothing is said of them: by 120 um of 1500 of defocus.
_SIZES = (0.92, 1.08)
#: Motion of the light by the wavefront over the size of the donut, both rms, from which on something is no donut: stars
#: in focus have 0.8 to 1.1.
_MOVED = 0.7
#: The same of something that fits badly, and its loss a pixel: a donut half as large has 0.5.
_MOVED_BADLY = 0.5
_BADLY = 1.2
#: Largest part of the light that rims which have run away make less than none: a star in focus, for which the fit moved
#: the rim of M2 by 3 m, has 0.07.
_NEGATIVE = 0.03


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
    searched : bool
        Whether its search holds for a fit that begins from it, which has further Zernikes, or the rims of all stars.
    preliminary : bool
        Whether a fit that begins from it has to look for rims elsewhere in fine pixels.
    light : StarLight, optional
        Light of the star for a fit that begins from it, which is traced by default.
    """

    flags: DonutFlag
    best: StarSolution | None = None
    unit: float = 1.0
    level: float = 0.0
    sides: BothSides | None = None
    searched: bool = False
    preliminary: bool = False
    light: StarLight | None = None

    @property
    def usable(self) -> StarSolution | None:
        """The best model where no flag says that there is no result."""
        return self.best if self.flags.usable else None

    def with_light(self, instrument: Instrument) -> StarFit:
        """Return the same with the star's light for a fit with diffraction or without, if its rims are as believed."""
        if self.best is None or self.best.light.free_rims.bodies:
            return self
        light = self.best.light
        return replace(self, light=instrument.diffracted(light) if instrument.model.diffraction else light)


def fit_star(
    instrument: Instrument,
    light: StarLight,
    pixels: Pixels,
    strength: float,
    *,
    wavefront: bool,
    electron: AssumedElectron | None = None,
    begun: StarFit | None = None,
    preliminary: bool = False,
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
    electron : AssumedElectron, optional
        What is taken for an electron where noise is not known: that of the result is what the fit leaves, in a unit in
        which light has the noise of electrons.
    begun : StarFit, optional
        Fit of a model without diffraction, or without some of the Zernikes, in the same unit, from which this one
        begins if its search left no question.
    preliminary : bool
        Whether rims elsewhere are left to a fit that begins from this one, unless coarse pixels tell them.
    """
    donut = instrument.is_donut(light)
    fitter = StarFitter(instrument, light, without_bad_pixels(pixels) if donut else pixels, strength, wavefront)
    if begun is not None and begun.usable is not None and _holds(begun, light):
        return _continued(fitter, pixels, begun, begun.usable, electron, preliminary)
    fitter, start = _started(fitter)
    pixels = pixels.central(fitter.clean.image.shape)
    flags = DonutFlag.OK
    if not start.match.significance >= _FOUND:
        flags |= DonutFlag.NO_DONUT
    n_term = len(instrument.terms.requested) if wavefront else 0
    if start.match.flux < len(NUISANCES) + n_term or (not flags and is_faint(start, n_term)):
        flags |= DonutFlag.TOO_FEW_PHOTONS
    if flags:
        # On a stamp that is much smaller than its donut nothing stands out.
        return StarFit(DonutFlag.MOSTLY_LOST if donut and fitter.lost_at_best(start.stamp) > _LOST else flags)
    search = _search(fitter, start)
    if donut and search.misfit > POOR:
        search = _masked_search(search.fitter, search)
    if donut and search.misfit > POOR and not _is_between(_size(search.start.stamp, search.best), _LIKE_DONUTS):
        return StarFit(DonutFlag.NO_DONUT | DonutFlag.OTHER_SIZE)
    if donut and is_hopeless(instrument.terms, search.best):
        lost = search.fitter.lost_light(search.start.stamp, search.best).any_pixel > _LOST
        return StarFit(DonutFlag.MOSTLY_LOST if lost else DonutFlag.UNDETERMINED)
    sides, mirrored, other_side = None, None, OtherSide(search.fitter, search.start)
    if donut and wavefront:
        sides, mirrored = other_side.compared(search.best)
    explained = _explained(search.start.stamp, search.best)
    # Before rims are free, with which the wrong side of focus fits much.
    if donut and explained and other_side.is_better(search.best, mirrored):
        return StarFit(DonutFlag.DEFOCUS_SIGN, sides=sides)
    if fitter.searches_rims:
        search = _search_of_rims(fitter, search)
    fitter, start, best = search.fitter, search.start, search.best
    if not _explained(start.stamp, best):
        return StarFit(DonutFlag.NO_DONUT)
    if fitter.lost_light(start.stamp, best).any_pixel > _LOST:
        return StarFit(DonutFlag.MOSTLY_LOST)
    return _finished(fitter, pixels, best, sides, electron, search.rivals, preliminary)


def _holds(begun: StarFit, light: StarLight) -> bool:
    """Return whether the search of a fit holds for one of other light that begins from it."""
    if not begun.searched:
        return not begun.flags & ~_BESIDE_THE_SEARCH
    # Light beside a rim looks like a neighbour.
    return not (light.free_rims.bodies and DonutFlag.BLENDED in begun.flags)


def _continued(
    fitter: StarFitter,
    pixels: Pixels,
    begun: StarFit,
    best: StarSolution,
    electron: AssumedElectron | None,
    preliminary: bool,
) -> StarFit:
    """Return the outcome of a fit from the best model of one that has begun, with its rims if none are those of all."""
    shape, solution, own_rims = best.full.used.shape, best.solution, best.light.free_rims
    fitter, of_all = fitter.central(shape), fitter.light.free_rims
    fitter = fitter if of_all.bodies else fitter.with_free_rims(own_rims)
    last = len(solution.shared) - len(own_rims)
    known = last - best.light.before_free_rims
    further = np.zeros(len(fitter.instrument.noll) - known if len(solution.shared) else 0)
    steps = np.zeros(len(of_all)) if of_all.bodies else solution.shared[last:]

    def begin(wave: np.ndarray) -> Solution:
        return replace(solution, shared=np.concatenate([wave, further, solution.shared[known:last], steps]))

    own_rivals = () if of_all.bodies else best.rivals
    rivals = tuple(
        RimFit(fitter.with_free_rims(rival.rims).light, best.stamp, begin(rival.wave)) for rival in own_rivals
    )
    best_begun, fitter = begin(solution.shared[:known]), fitter.beginning_from(best)
    return _finished(fitter, pixels.central(shape), best_begun, begun.sides, electron, rivals, preliminary)


class CoarseFit(NamedTuple):
    """Loss of a fit in coarse pixels, and how many of these are independent of each other."""

    loss: float
    n_independent: float


def coarse_fit(instrument: Instrument, light: StarLight, pixels: Pixels, strength: float) -> CoarseFit | None:
    """Return the fit of a star alone in coarse pixels, None without one; arguments as those of :func:`fit_star`."""
    fitter, start = _started(StarFitter(instrument, light, without_bad_pixels(pixels), strength, wavefront=True))
    if not start.match.significance >= _FOUND:
        return None
    search = _search(fitter, start)
    return CoarseFit(search.best.loss, search.start.pixels.independent * search.start.stamp.used.sum())


def _started(fitter: StarFitter) -> tuple[StarFitter, Start]:
    """Return the start of a search, and the fitter for the part of the stamp about the donut."""
    start = fitter.start()
    shape = fitter.near(start.match, start.pixels.side) if fitter.donut else fitter.clean.image.shape
    if shape == fitter.clean.image.shape:
        return fitter, start
    fitter = fitter.central(shape)
    return fitter, fitter.start()


def _finished(
    fitter: StarFitter,
    pixels: Pixels,
    best: Solution,
    sides: BothSides | None,
    electron: AssumedElectron | None,
    rivals: tuple[RimFit, ...] = (),
    preliminary: bool = False,
) -> StarFit:
    """Return the outcome of a fit of all pixels from the solution of a search and its rivals."""
    flags, unit = DonutFlag.OK, 1.0
    preliminary = preliminary and fitter.searches_rims and not fitter.light.free_rims.bodies
    finest = fitter.finest(best, rivals, preliminary=preliminary)
    if (finest.full.used != pixels.used).any():
        flags |= DonutFlag.CLIPPED
    if any(body.moved for body in finest.light.free_rims.bodies):
        flags |= DonutFlag.RIM_MOVED
    if len(finest.solution.stars[0]) > RATIO:
        flags |= DonutFlag.BLENDED
    if np.isfinite(finest.model).all() and _negative_light(finest.stamp, finest.solution) > _NEGATIVE:
        return StarFit(DonutFlag.NO_DONUT)
    if not (finest.solution.converged and np.isfinite(finest.model).all()):
        return StarFit(flags | DonutFlag.NOT_CONVERGED, finest)
    lost = fitter.lost_light(finest.full, finest.solution)
    if lost.any_pixel > _LOST:
        return StarFit(DonutFlag.MOSTLY_LOST)
    if lost.regions > _CUT_OFF:
        flags |= DonutFlag.CUT_OFF
    size = _size(finest.stamp, finest.solution)
    if not _is_between(size, _SIZES):
        flags |= DonutFlag.OTHER_SIZE
    if sides is not None and sides.ambiguous:
        flags |= DonutFlag.AMBIGUOUS_SIDE
    if electron is not None and flags.usable:
        finest, unit = fitter.with_measured_noise(finest, electron)
    if fitter.donut and (_is_no_donut(finest, size) or (flags & DonutFlag.CLIPPED and _is_clipped(fitter, finest))):
        return StarFit(DonutFlag.NO_DONUT | (flags & DonutFlag.OTHER_SIZE))
    return StarFit(flags, finest, unit, sides=sides, preliminary=preliminary)


@dataclass(frozen=True)
class _Search:
    """Best coarse solution, from a start, on the pixels of a fitter, that without neighbours, and fits as good."""

    fitter: StarFitter
    start: Start
    best: Solution
    single: Solution
    rivals: tuple[RimFit, ...] = ()

    @property
    def misfit(self) -> float:
        """Loss a coarse pixel, of which smoothed noise has next to nothing."""
        return misfit_of(self.start.stamp, self.best)


def _search(fitter: StarFitter, start: Start) -> _Search:
    """Return the best coarse solution, with neighbours, and without lines of pixels far off a first one."""
    best = first_solution(fitter, start)
    search = _Search(fitter, start, best, best)
    if not fitter.donut:
        return search
    if search.misfit > MISFIT:
        used = fitter.without_outliers(best.stars[0], best.waves[0], lines_only=True)
        if (used != fitter.clean.used).any():
            fitter = fitter.with_used(used)
            start = fitter.start()
            best = first_solution(fitter, start)
            search = _Search(fitter, start, best, best)
    if fitter.instrument.model.neighbours:
        search = replace(search, best=_with_neighbours(search.fitter, search.start, search.best))
    return search


def _search_of_rims(begun: StarFitter, search: _Search) -> _Search:
    """Return a search with rims free that the residuals say stand elsewhere, if it explains more.

    Neighbours are quicker to find, so that they are searched for first; but light beside a rim looks like one, and
    like a cosmic ray, so that rims are searched for without those. Pixels of the fitter that has begun are used again
    where the model with these rims explains them.
    """
    if search.misfit <= MISFIT:
        return search
    found, first = replace(search, best=search.single), search.start.unknowns
    begin: Solution | None = replace(search.single, stars=(first,), shared=np.zeros_like(search.single.shared))
    for _ in range(MOST_BODIES):
        another = _with_another_rim(found, begin)
        if another is found:
            break
        found, begin = _with_explained_pixels(begun, another), None
    if not found.misfit < search.misfit:
        return search
    if found.misfit > MISFIT and begun.instrument.model.neighbours:
        return replace(found, best=_with_neighbours(found.fitter, found.start, found.best))
    return found


def _diffraction_explains(search: _Search) -> bool:
    """Return whether diffraction, where it is not yet known to matter, leaves no more misfit than noise does."""
    fitter, start, best = search.fitter, search.start.stamp, search.best
    if fitter.instrument.model.diffraction is not None:
        return False
    light, rays = fitter.instrument.diffracted(fitter.light), start.rays
    assert isinstance(rays, ZernikeRays)
    stamp = fitter.instrument.stamp(light, search.start.pixels, rays, start.grid.sharp, start.grid.reach)
    return misfit_of(stamp, fitter.solve(stamp, best.stars[0], best.shared, COARSE)) <= MISFIT


def _with_another_rim(search: _Search, first: Solution | None) -> _Search:
    """Return a search with one more rim free, from the unknowns where the search began; the same without one."""
    fitter, start = search.fitter, search.start
    fit = RimFit(fitter.light, start.stamp, search.best, search.rivals)
    explained = partial(_diffraction_explains, search)
    found = with_another_rim(fitter.instrument, fit, MISFIT, _coarse_solver(fitter, start), first, explained)
    return search if found is fit else _of_rims(fitter, start, found)


def _with_explained_pixels(begun: StarFitter, search: _Search) -> _Search:
    """Return a search with those pixels that were left out before its rims were free, and are not far off its model."""
    fitter, best = search.fitter, search.best
    every_pixel = begun.with_light(fitter.light)
    used = fitter.clean.used | every_pixel.without_outliers(best.stars[0], best.waves[0])
    if (used == fitter.clean.used).all():
        return search
    fitter = every_pixel.with_used(used)
    start = fitter.start()
    best = fitter.solve(start.stamp, best.stars[0], best.shared, COARSE)
    fit = RimFit(fitter.light, start.stamp, best, search.rivals)
    return _of_rims(fitter, start, settled(fitter.instrument, fit, _coarse_solver(fitter, start)))


def _coarse_solver(fitter: StarFitter, start: Start) -> RimSolver:
    """Return the function that fits light with its rims elsewhere to the pixels of a start."""
    return fitter.rim_solver(COARSE, lambda moved: moved.stamp(moved.light, start.pixels))


def _of_rims(fitter: StarFitter, start: Start, fit: RimFit) -> _Search:
    """Return the search of a fit of other rims to the pixels of a start."""
    return _Search(
        fitter.with_light(fit.light), replace(start, stamp=fit.stamp), fit.solution, fit.solution, fit.rivals
    )


def _masked_search(fitter: StarFitter, search: _Search) -> _Search:
    """Return a search without patches of pixels far off the template, if these are what it does not explain."""
    template = _robust_template(fitter, search.start)
    used = fitter.without_outliers(template, np.zeros(len(fitter.precision)))
    if (used == fitter.clean.used).all():
        return search
    fitter = fitter.with_used(used)
    start = fitter.start()
    trial = _search(fitter, start)
    lost = trial.fitter.lost_light(start.stamp, trial.best).any_pixel
    return trial if trial.misfit < _LEFT * search.misfit and lost < _MASKED else search


def _robust_template(fitter: StarFitter, start: Start) -> np.ndarray:
    """Return unknowns of a star without aberrations by the typical pixels on the donut and beside it."""
    stamp, unknowns = start.stamp, start.unknowns.copy()
    model = model_image(stamp, unknowns, np.zeros(len(fitter.precision)))
    unknowns[[BACKGROUND, SLOPE_X, SLOPE_Y]] = 0.0
    light = model_image(stamp, unknowns, np.zeros(len(fitter.precision)))
    bright, dark = (stamp.used & side for side in (light > BRIGHT * light.max(), light < _DARK * light.max()))
    unknowns[[BACKGROUND, SLOPE_X, SLOPE_Y]] = start.unknowns[[BACKGROUND, SLOPE_X, SLOPE_Y]]
    if dark.any():
        level = float(np.median((stamp.image - model + light)[dark]))
        unknowns[[BACKGROUND, SLOPE_X, SLOPE_Y]] = level / stamp.grid.scale**2, 0.0, 0.0
        if bright.any():
            unknowns[FLUX] *= max(float(np.median((stamp.image - level)[bright] / light[bright])), 1e-3)
    return unknowns


def _with_neighbours(fitter: StarFitter, start: Start, single: Solution) -> Solution:
    """Return the solution with neighbours if there are any, else that without."""
    room = fitter.stamp(fitter.light, start.pixels, blended=True)
    diameter = fitter.light.diameter / fitter.instrument.pixel
    return NeighbourSearch(room, fitter.solve, start.unknowns, start.template, diameter).from_single(single)


def _is_between(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] < value < limits[1]


def _negative_light(stamp: Stamp, solution: Solution) -> float:
    """Return the light that points have less than none, where rims have run away: light is linear in their places."""
    return -float(np.minimum(stamp.rays.weights(solution.waves[0]), 0.0).sum())


def _size(stamp: Stamp, solution: Solution) -> float:
    """Return the rms radius of a donut over that without the wavefront beside the telescope's."""
    wave = solution.waves[0]
    weights = stamp.rays.weights(wave)

    def radius(landing: np.ndarray) -> float:
        return float(np.sqrt(weights @ ((landing - weights @ landing) ** 2).sum(axis=1)))

    return radius(stamp.rays.landing(wave)) / max(radius(stamp.rays.landing(np.zeros_like(wave))), 1e-12)


def _is_no_donut(star: StarSolution, size: float) -> bool:
    """Return whether a fit of a relative size is of something else, of which it explains a part."""
    motion, badly = _motion(star.stamp, star.solution), misfit_of(star.stamp, star.solution) > _BADLY
    return motion > _MOVED or (badly and (motion > _MOVED_BADLY or not _is_between(size, _LIKE_DONUTS)))


def _is_clipped(fitter: StarFitter, star: StarSolution) -> bool:
    """Return whether all that stood out at the start was left out as no part of a donut, and noise is fitted."""
    unknowns = star.solution.stars[0].copy()
    unknowns[FLUX] = 0.0
    light = star.model - model_image(star.full, unknowns, star.solution.waves[0])
    squares = light**2 / pixel_variance(star.full, star.model)
    significance = float(np.sqrt(squares[star.full.used].sum()))
    return is_hidden(significance, len(fitter.instrument.terms.requested))


def _motion(stamp: Stamp, solution: Solution) -> float:
    """Return how far a wavefront moves the light of a donut, over its size without, both rms."""
    wave = solution.waves[0]
    weights, straight = stamp.rays.weights(wave), stamp.rays.landing(np.zeros_like(wave))

    def mean_square(landing: np.ndarray) -> float:
        return float(weights @ ((landing - weights @ landing) ** 2).sum(axis=1))

    moved, size = mean_square(stamp.rays.landing(wave) - straight), mean_square(straight)
    return float(np.sqrt(max(moved, 0.0) / max(size, 1e-24)))


def _explained(stamp: Stamp, solution: Solution) -> bool:
    """Return whether the model explains most of what stands out from a plane background."""
    used, image = stamp.used, stamp.image[stamp.used]
    root = 1.0 / np.sqrt(np.maximum(stamp.variance[used] + np.maximum(image, 0.0), 1.0))
    columns = np.stack([plane[used] for plane in plane_basis(used)], axis=-1) * root[:, None]
    residual = root * image - columns @ np.linalg.lstsq(columns, root * image, rcond=None)[0]
    count = len(image)
    return (solution.loss - count) < (1.0 - _EXPLAINED) * max(float(residual @ residual) - count, 0.0)
