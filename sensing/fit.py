"""Fit donuts: maximum likelihood of the pixels of out-of-focus stars, with exact ray positions as the model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arguments import check_arguments, removed_arguments
from ..core.errors import ConfigError, DomainError
from ..core.threads import one_blas_thread, thread_count
from ..models.parameters.degrees_of_freedom import DegreesOfFreedom
from ..models.telescope import Telescope
from ..raytrace.rays import Projection
from ..wavefront.psf.light import Light
from .amplifier_steps import AmplifierStep, step_table
from .bad_pixels import SEVERAL, grown, saturated_pixels
from .diffraction_vote import DiffractionVote, vote_on_diffraction
from .fit_star import StarFit
from .flags import DonutFlag
from .freedom_fit import TelescopeFreedoms
from .hole import warn_of_other_hole
from .image_model import (
    BACKGROUND,
    FLUX,
    MOST_NEIGHBOURS,
    NEIGHBOUR,
    NUISANCES,
    RATIO,
    SLOPE_X,
    SLOPE_Y,
    STRENGTH,
    X,
    Y,
)
from .inputs import ObservedStar, ObservedStars
from .interrupted_fit import InterruptedFitError
from .light import Instrument
from .likelihood import pulls
from .model import DonutModel
from .noise_fit import fit_with_noise, light_level
from .result import DonutFit
from .rim_table import moved_rims, rim_table
from .shared_rims import contradicted
from .stamps import central_slices
from .star_errors import ErrorParts
from .star_fitter import StarSolution
from .step_search import fit_steps
from .wavefront_fits import NOLL, FittedStars, SingleDonuts, UsableStars, WavefrontFit

#: The same of pixels that are not finite.
_MOST = 0.5
#: Chi-square a pixel above which a fit is poor.
_POOR = 1.2
#: Standard deviations of the noise's own chi-square that a poor fit has beyond that.
_BY_CHANCE = 5.0
#: Most fits of a star with steps between amplifiers, and change of their amplitudes over their standard deviations
#: below which these hold.
_STEP_FITS = 4
_SETTLED = 0.3


@removed_arguments(
    left_out="fit=SingleDonuts(left_out=...)",
    higher_order="fit=SingleDonuts(higher_order=...) or FieldTerms(higher_order=...)",
    prior="fit=TelescopeFreedoms(freedoms, prior=...)",
    field_noll="fit=FieldTerms(field_noll)",
    turbulence="model=DonutModel(air=DonutAir(atmosphere=...))",
    fwhm="model=DonutModel(air=DonutAir(fwhm=...))",
    outer_scale="model=DonutModel(air=DonutAir(outer_scale=...))",
    defocus="model=DonutModel(detector=DonutDetector(defocus=...))",
    focal_plane="model=DonutModel(detector=DonutDetector(focal_plane=...))",
    diffusion="model=DonutModel(detector=DonutDetector(diffusion=...))",
    saturation="model=DonutModel(detector=DonutDetector(saturation=...))",
    wavelength_weights="wavelength=Light(wavelengths, weights=...)",
    diffraction="model=DonutModel(diffraction=...)",
    n_pupil="model=DonutModel(n_pupil=...)",
)
@check_arguments
def fit_donuts(
    telescope: Telescope,
    images: ArrayLike | Sequence[ArrayLike],
    fields: ArrayLike,
    wavelength: ArrayLike | Light | None = None,
    *,
    pixel_size: ArrayLike | None = None,
    moved: str | None = None,
    sky_variance: ArrayLike | None = None,
    noll: Iterable[int] | None = None,
    degrees_of_freedom: DegreesOfFreedom | None = None,
    model: DonutModel | None = None,
    fit: WavefrontFit | None = None,
    mask: NDArray[np.bool_] | Sequence[NDArray[np.bool_]] | None = None,
    projection: Projection = "zemax",
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> DonutFit:
    r"""Fit the wavefront of out-of-focus stars by maximum likelihood of their pixels.

    The model traces points of the entrance pupil, with all vignetting and spiders, to the detector; the unknown
    wavefront W turns the light at each point by :math:`-\nabla W`, and the rays are traced again with their own changed
    directions. Landing points are convolved with the pixel and the mean of turbulence, a long exposure (Roddier 1981,
    sec. 4). Unknown are also flux, place, plane of background and seeing of each star. Noise is that of the photons of
    the model and the sky; steps are those of Levenberg and Marquardt.

    Parameters
    ----------
    telescope : Telescope
        Telescope as it is believed to be, in focus where `model` has the defocus of each image, or defocus included:
        ``tel.perturbed("Detector", shift=(0, 0, 1.5e-3))`` is behind focus; ``"Camera"`` in its place where the camera
        moves, as in full-array mode.
    images : array_like, shape [n, ny, nx], or sequence of n arrays
        Stamps, ``[iy, ix]`` along +y and +x of the detector, each with its donut nearest to the centre: electrons where
        `sky_variance` is given, else of any unit. A plane of sky may be left in; pixels not finite are left out.
    fields : array_like or Quantity, shape [n, 2]
        Field angles [rad], of the light's own travel.
    wavelength : array_like, Quantity or Light, optional
        Vacuum wavelength [m], several of them, or :class:`~pachon.Light`, which has a spectrum too; that of the model,
        or the telescope's own by default.
    pixel_size : float or Quantity, optional
        Side of a pixel [m], in place of that of the model, which is 10 um by default.
    moved : str, optional
        Surface or group that the defocus of `model` moves, in place of that of the model, which is the detector by
        default; see :class:`~pachon.DonutDetector`.
    sky_variance : float or array, shapes [n] or [n, ny, nx], optional
        Variance of sky and readout [electron^2 a pixel]; light then has the noise of electrons. By default both are
        measured from each image and what its fit leaves, whatever the unit of the images; sky may be left in.
    noll : iterable of int, optional
        Noll indices of the wavefront, from 4; those up to 22 by default. Short for the ``noll`` of a `fit`.
    degrees_of_freedom : DegreesOfFreedom, optional
        Degrees of freedom of the telescope; short for ``fit=TelescopeFreedoms(degrees_of_freedom)``.
    model : DonutModel, optional
        What the images are made of: light, air, detector (defocus and heights among it), diffraction, second stars; by
        default light through air of unknown seeing, in one plane, with diffraction where that fits better.
    fit : SingleDonuts, ExposureDonuts, FieldTerms or TelescopeFreedoms, optional
        Unknowns of the wavefront, with the options of their fit: Zernikes of each donut (the default), the same
        with what donuts of an exposure have in common, double Zernikes over the field, or degrees of freedom of the
        telescope for all donuts together.
    mask : array_like of bool, as `images`, optional
        True, or 1, at pixels to leave out.
    projection : {"zemax", "gnomonic", "postel"}
        Meaning of the field angles.
    threads : int, optional
        Number of threads; all processors by default. Results do not depend on it.
    progress : callable, optional
        Called with 1 after each donut.

    Returns
    -------
    DonutFit

    Raises
    ------
    ConfigError
        If something is given twice, turbulence goes with a joint fit, or an option is malformed.
    DomainError
        If an array has the wrong shape, the wavelength is not covered, or a number is outside its range. A bad donut is
        no error: it is flagged, with NaN for results, and the others go on.
    KeyboardInterrupt
        At Ctrl-C; its ``fit`` has the results of the donuts that were finished, if any were.
    """
    model = (model or DonutModel()).with_light(wavelength).with_pixel_size(pixel_size).with_moved(moved)
    fit = _wavefront_fit(fit, noll, degrees_of_freedom)
    observed = ObservedStars.of(images, fields, sky_variance, mask, projection)
    instrument = Instrument.of(telescope, model, fit.terms(telescope, model.air.atmosphere))
    shifts = model.detector.shifts(len(observed))
    strengths = model.air.strengths(instrument.seeing, len(observed))

    finished: dict[int, StarFit] = {}
    fitted: _Fitted | None = None

    def alone(instrument: Instrument, i: int, begun: StarFit | None = None, *, preliminary: bool = False) -> StarFit:
        star, defocus, strength = observed.star(i), float(shifts[i]), float(strengths[i])
        return _fit_alone(instrument, star, defocus, strength, fit.joint, begun, preliminary)

    def fitted_stars(
        instrument: Instrument, star_fit: Callable[[int], StarFit], report: Callable[[int], None] | None = None
    ) -> _Fitted:
        def prepared(i: int) -> StarFit:
            star = fit.prepared(instrument, star_fit(i))
            finished.setdefault(i, star)
            if report is not None:
                report(1)
            return star

        return _solved(instrument, observed, list(pool.map(prepared, range(len(observed)))), fit, pool)

    def first(i: int) -> StarFit:
        return vote.fit_of(i, instrument, alone)

    def once_more(refined: Instrument, fitted: _Fitted) -> _Fitted:
        return fitted_stars(refined, lambda i: alone(refined, i, replace(fitted.stars[i], searched=True)))

    try:
        with one_blas_thread(), ThreadPoolExecutor(thread_count(threads)) as pool:
            vote = DiffractionVote(bool(model.diffraction))
            if model.diffraction is None:
                vote = vote_on_diffraction(instrument, alone, len(observed), pool)
                instrument = replace(instrument, model=replace(model, diffraction=vote.diffraction))
            fitted = fitted_stars(instrument, first, progress)
            refined = fit.refined(instrument, list(fitted.solutions.values()), fitted.results)
            if refined is not None:
                again = once_more(refined, fitted)
                if refined.free_rims.bodies and contradicted(fitted.solutions, again.solutions):
                    # Not the telescope's: each donut keeps the rims of its own fit.
                    refined = replace(refined, free_rims=instrument.free_rims)
                    again = fitted if refined.terms is instrument.terms else once_more(refined, fitted)
                # No donut is lost by a refinement.
                if not any(DonutFlag.NOT_CONVERGED in again.stars[i].flags for i in fitted.solutions):
                    instrument, fitted = refined, again
    except KeyboardInterrupt:
        if not finished:
            raise
        if fitted is None:
            fitted = _solved_in_part(instrument, observed, finished, fit)
        raise InterruptedFitError(_result(instrument, observed, fitted)) from None
    result = _result(instrument, observed, fitted)
    warn_of_other_hole(instrument, fitted.solutions, result)
    return result


class _Fitted(NamedTuple):
    """Outcomes of all stars, solutions of the usable ones by their numbers, and the results of these."""

    stars: list[StarFit]
    solutions: dict[int, StarSolution]
    results: FittedStars


def _solved(
    instrument: Instrument, observed: ObservedStars, stars: Sequence[StarFit], fit: WavefrontFit, pool: Executor
) -> _Fitted:
    """Return the results of stars that were fitted by themselves."""
    stars = fit.sided(instrument, stars, observed.fields)
    solutions = {i: star.usable for i, star in enumerate(stars) if star.usable is not None}
    if fit.joint and not solutions:
        raise DomainError(f"no usable donut: {stars[0].flags.reasons if stars else 'no images'}")
    index = np.array(list(solutions), dtype=np.int64)
    fields = observed.fields
    usable = UsableStars(instrument, list(solutions.values()), fields[index], observed.projection, fields, index)
    return _Fitted(stars, solutions, fit.solved(usable, pool))


def _solved_in_part(
    instrument: Instrument, observed: ObservedStars, finished: Mapping[int, StarFit], fit: WavefrontFit
) -> _Fitted:
    """Return the results of the stars that were finished when a fit was interrupted, flags for the others.

    A joint fit is one of all stars: these have the results of the fit of each by itself.
    """
    stars = [finished.get(i, StarFit(DonutFlag.INTERRUPTED)) for i in range(len(observed))]
    with one_blas_thread(), ThreadPoolExecutor(1) as pool:
        return _solved(instrument, observed, stars, SingleDonuts(fit.noll) if fit.joint else fit, pool)


def _wavefront_fit(
    fit: WavefrontFit | None, noll: Iterable[int] | None, freedoms: DegreesOfFreedom | None
) -> WavefrontFit:
    """Return the fit of the wavefront that the short arguments stand for, where none is given itself."""
    if fit is None:
        terms = NOLL if noll is None else noll
        return SingleDonuts(terms) if freedoms is None else TelescopeFreedoms(freedoms, noll=terms)
    for name, value in (("noll", noll), ("degrees_of_freedom", freedoms)):
        if value is not None:
            raise ConfigError(f"{name} and fit are both given: expected it in fit={type(fit).__name__}(...)", key=name)
    return fit


def _fit_alone(
    instrument: Instrument,
    star: ObservedStar,
    defocus: float,
    strength: float,
    joint: bool,
    begun: StarFit | None,
    preliminary: bool,
) -> StarFit:
    """Fit one star by itself, from a fit of a simpler model if there is one, or say why not."""
    if np.hypot(*star.field) > instrument.telescope.field_limit * (1.0 + 1e-12):
        return StarFit(DonutFlag.OUTSIDE_FIELD)
    try:
        light = (begun and begun.light) or instrument.light(star.direction, defocus)
    except DomainError:
        return StarFit(DonutFlag.NO_LIGHT)
    not_finite = ~np.isfinite(star.image) & ~star.masked
    masked = star.masked | not_finite
    saturated = saturated_pixels(np.where(masked, 0.0, star.image), masked, instrument.model.detector.saturation)
    masked = masked | grown(saturated, ~masked)
    donut = instrument.is_donut(light)
    wavefront = not joint or donut
    fitted_once = partial(
        fit_with_noise,
        instrument,
        light,
        used=~masked,
        strength=strength,
        wavefront=wavefront,
        preliminary=preliminary,
    )
    fitted = _fit_with_steps(fitted_once, star, begun, wavefront and donut)
    if fitted.flags.usable:
        return replace(fitted, flags=fitted.flags | DonutFlag.CLIPPED) if (saturated | not_finite).any() else fitted
    if saturated.sum() > max(SEVERAL * star.image.size, 1.0):
        return StarFit(DonutFlag.SATURATED)
    if not_finite.any() and (DonutFlag.MOSTLY_LOST in fitted.flags or not_finite.mean() > _MOST):
        return StarFit(DonutFlag.NOT_FINITE)
    return StarFit(DonutFlag.MOSTLY_LOST) if star.masked.all() else fitted


def _fit_with_steps(fit: Callable[..., StarFit], star: ObservedStar, begun: StarFit | None, searched: bool) -> StarFit:
    """Fit one star, and again without steps between amplifiers where its residuals have any."""
    steps = _steps_of(begun)
    # They are no part of the search that another begins from.
    first = before = None if begun is None else replace(begun, flags=begun.flags & ~DonutFlag.AMPLIFIER_STEP)
    for _ in range(_STEP_FITS):
        fitted = fit(_without_steps(star, steps, before), before)
        usable = fitted.usable
        if usable is None or not searched:
            break
        middle = central_slices(star.image.shape, usable.full.image.shape)
        found = fit_steps(usable, [step.within(middle, fitted.unit) for step in steps])
        if found is None:
            # What was taken off is no step after all.
            fitted = fit(star, first) if steps else fitted
            break
        steps = tuple(step.around(middle, fitted.unit) for step in found.steps)
        found, before = replace(found, steps=steps), fitted
        fitted = replace(fitted, flags=fitted.flags | DonutFlag.AMPLIFIER_STEP, best=replace(usable, steps=found))
        if found.change < _SETTLED:
            break
    return fitted


def _steps_of(fitted: StarFit | None) -> tuple[AmplifierStep, ...]:
    """Return the steps between amplifiers on the stamp of a fit."""
    usable = None if fitted is None else fitted.usable
    return () if usable is None or usable.steps is None else usable.steps.steps


def _without_steps(star: ObservedStar, steps: Sequence[AmplifierStep], fitted: StarFit | None) -> ObservedStar:
    """Return a star without steps between amplifiers, by a fit that has its level."""
    for step in steps:
        assert fitted is not None
        star = replace(star, image=step.taken_off(star.image, light_level(fitted)))
    return star


def _response_slopes(instrument: Instrument, star: StarSolution) -> np.ndarray:
    """Return slopes of the response along x and y and their errors, by the fit of a star alone, [2, 0] or [2, 2]."""
    last = len(instrument.noll) + star.light.before_free_rims
    slopes = slice(last - len(star.light.slope_spreads), last)
    if not len(star.solution.shared):
        return np.zeros((2, 0))
    errors = np.sqrt(np.diag(star.solution.shared_covariance)[slopes])
    return np.array([star.solution.shared[slopes], errors])


def _result(instrument: Instrument, observed: ObservedStars, fits: _Fitted) -> DonutFit:
    """Return the result of a fit: rows of the usable stars, and NaN for the others."""
    fitted, usable = fits.results, np.array(list(fits.solutions), dtype=np.int64)
    flags = np.array([int(star.flags) for star in fits.stars], dtype=np.int64)
    units, levels = np.array([(star.unit, star.level) for star in fits.stars]).T
    count, n_noll = len(observed), len(instrument.terms.requested)
    zernikes, covariance = np.full((count, n_noll), np.nan), np.full((count, n_noll, n_noll), np.nan)
    values, errors = np.full((2, count, len(NUISANCES) + MOST_NEIGHBOURS * len(NEIGHBOUR)), np.nan)
    parts = {name: np.full_like(covariance, np.nan) for name in ErrorParts.__dataclass_fields__}
    noise = np.full(count, np.nan)
    chi2, n_pixels = np.full(count, np.nan), np.zeros(count, dtype=np.int64)
    model, used = np.full(observed.images.shape, np.nan), np.zeros(observed.images.shape, dtype=bool)
    for i, star in zip(usable, fitted.stars, strict=True):
        n, middle = len(star.unknowns), central_slices(observed.shapes[i], star.model.shape)
        values[i, :n], errors[i, :n] = star.unknowns, np.sqrt(np.diag(star.covariance))
        # Fluxes of neighbours are relative ones.
        values[i, [FLUX, BACKGROUND, SLOPE_X, SLOPE_Y]] *= units[i]
        errors[i, [FLUX, BACKGROUND, SLOPE_X, SLOPE_Y]] *= units[i]
        values[i, BACKGROUND] += levels[i]
        zernikes[i], covariance[i] = star.zernikes, star.errors.total
        for cause, covariances in parts.items():
            covariances[i] = getattr(star.errors, cause)
        model[i][middle], used[i][middle] = units[i] * star.model + levels[i], star.pixels.used
        for step in reversed(_steps_of(fits.stars[i])):
            model[i][:] = step.put_on(model[i], light_level(fits.stars[i]))
        # That of the level of the background, whose light has it in a fit.
        measured = units[i] ** 2 * (np.median(star.pixels.variance) + star.unknowns[BACKGROUND])
        noise[i] = np.median(observed.star(i).variance[middle]) if observed.known_noise else measured
        chi2[i] = (pulls(star.pixels, star.model)[star.pixels.used] ** 2).sum()
        n_pixels[i] = star.pixels.used.sum()
    slopes = np.full((2, count, 2), np.nan)
    for i, star in zip(usable, fitted.stars, strict=True):
        slope = _response_slopes(instrument, fits.solutions[i]) if star.shared_slopes is None else star.shared_slopes
        if slope.size:
            slopes[:, i] = slope
    rims = {
        int(i): moved_rims(instrument, fits.solutions[i]) if star.shared_rims is None else list(star.shared_rims)
        for i, star in zip(usable, fitted.stars, strict=True)
    }
    for i, of_star in rims.items():
        flags[i] &= ~int(DonutFlag.RIM_MOVED)
        flags[i] |= int(DonutFlag.RIM_MOVED) * any(rim.moved for rim in of_star)
    poor = chi2 > _POOR * n_pixels + _BY_CHANCE * np.sqrt(2.0 * n_pixels)
    width, strength = instrument.seeing.fwhm(values[:, STRENGTH]), values[:, STRENGTH]
    return DonutFit(
        zernikes=zernikes,
        covariance=covariance,
        error_parts=ErrorParts(**parts),
        noll=instrument.terms.requested,
        flux=values[:, FLUX],
        flux_error=errors[:, FLUX],
        center=values[:, [X, Y]],
        center_error=errors[:, [X, Y]],
        background=values[:, BACKGROUND],
        background_slope=values[:, [SLOPE_X, SLOPE_Y]],
        response_slope=slopes[0],
        response_slope_error=slopes[1],
        fwhm=width,
        fwhm_error=instrument.seeing.fwhm_error(strength, errors[:, STRENGTH]),
        chi2=chi2,
        n_pixels=n_pixels,
        sky_variance=noise,
        photon_variance=np.where(np.isfinite(noise), units, np.nan),
        flags=flags | poor * int(DonutFlag.POOR_FIT),
        companions=values[:, RATIO:].reshape(count, MOST_NEIGHBOURS, len(NEIGHBOUR)),
        images=observed.images,
        model=model,
        used=used,
        fields=observed.fields,
        wavelengths=instrument.wavelengths,
        pixel_size=instrument.pixel,
        telescope=instrument.telescope.name,
        obscuration=instrument.telescope.pupil_obscuration,
        double_zernikes=fitted.double_zernikes,
        double_zernike_covariance=fitted.double_zernike_covariance,
        degrees_of_freedom=fitted.degrees_of_freedom,
        projection=observed.projection,
        diffraction=bool(instrument.model.diffraction),
        rims=rim_table(rims),
        amplifier_steps=step_table({int(i): _steps_of(fits.stars[i]) for i in usable}),
        exposure=None if fitted.exposure is None else fitted.exposure.at(usable, count),
    )
