"""Fit donuts: maximum likelihood of the pixels of out-of-focus stars, with exact ray positions as the model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arguments import check_arguments, removed_arguments
from ..core.errors import ConfigError, DomainError
from ..core.threads import one_blas_thread, thread_count
from ..models.parameters.degrees_of_freedom import DegreesOfFreedom
from ..models.telescope import Telescope
from ..wavefront.psf.light import Light
from .fit_star import SMALLEST_DONUT, StarFit, fit_star
from .flags import DonutFlag
from .freedom_fit import TelescopeFreedoms
from .image_model import BACKGROUND, COMPANION, FLUX, NUISANCES, RATIO, STRENGTH, X, Y
from .inputs import ObservedStar, ObservedStars
from .light import Instrument
from .likelihood import pulls
from .model import DonutModel
from .result import DonutFit
from .stamps import Pixels
from .wavefront_fits import NOLL, FittedStars, SingleDonuts, UsableStars, WavefrontFit

#: Saturated pixels from which on a donut is flagged, as a fraction of the stamp; fewer are left out.
_SATURATED = 0.002
#: Electrons up to which pixels of equal value are no sign of saturation.
_FAINT = 100.0
#: Chi-square a pixel above which a fit is poor.
_POOR = 1.2
#: Standard deviations of the noise's own chi-square that a poor fit has beyond that.
_BY_CHANCE = 5.0


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
    sky_variance: ArrayLike = 0.0,
    noll: Iterable[int] | None = None,
    degrees_of_freedom: DegreesOfFreedom | None = None,
    model: DonutModel | None = None,
    fit: WavefrontFit | None = None,
    mask: NDArray[np.bool_] | Sequence[NDArray[np.bool_]] | None = None,
    projection: str = "zemax",
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> DonutFit:
    r"""Fit the wavefront of out-of-focus stars by maximum likelihood of their pixels.

    The model traces points of the entrance pupil, with all vignetting and spiders, to the detector; the unknown
    wavefront W turns the light at each point by :math:`-\nabla W`, and the rays are traced again with their own changed
    directions. Landing points are convolved with the pixel and the mean of turbulence, a long exposure (Roddier 1981,
    sec. 4). Unknown are also flux, place, background and seeing of each star. Noise is that of the photons of the model
    and the sky; steps are those of Levenberg and Marquardt.

    Parameters
    ----------
    telescope : Telescope
        Telescope as it is believed to be, defocus included: ``tel.perturbed("Detector", shift=(0, 0, 1.5e-3))`` is
        behind focus; ``"Camera"`` in its place where the camera moves, as in full-array mode.
    images : array_like, shape [n, ny, nx], or sequence of n arrays
        Stamps [electrons], sky subtracted, ``[iy, ix]`` along +y and +x of the detector, each centred on its donut
        within a few pixels.
    fields : array_like or Quantity, shape [n, 2]
        Field angles [rad], of the light's own travel.
    wavelength : array_like, Quantity or Light, optional
        Vacuum wavelength [m], several of them, or :class:`~pachon.Light`, which has a spectrum too; that of the model,
        or the telescope's own by default.
    pixel_size : float or Quantity, optional
        Side of a pixel [m], in place of that of the model, which is 10 um by default.
    sky_variance : float or array, shapes [n] or [n, ny, nx]
        Variance of sky and readout [electron^2 a pixel].
    noll : iterable of int, optional
        Noll indices of the wavefront, from 4; those up to 22 by default. Short for the ``noll`` of a `fit`.
    degrees_of_freedom : DegreesOfFreedom, optional
        Degrees of freedom of the telescope; short for ``fit=TelescopeFreedoms(degrees_of_freedom)``.
    model : DonutModel, optional
        What the images are made of: light, air, detector (defocus and heights among it), diffraction, second stars; by
        default rays through air of unknown seeing, in one plane.
    fit : SingleDonuts, ExposureDonuts, FieldTerms or TelescopeFreedoms, optional
        Unknowns of the wavefront, with the options of their fit: Zernikes of each donut (the default), the same
        with what donuts of an exposure have in common, double Zernikes over the field, or degrees of freedom of the
        telescope for all donuts together.
    mask : array_like of bool, as `images`, optional
        True at pixels to leave out.
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
    """
    model = (model or DonutModel()).with_light(wavelength).with_pixel_size(pixel_size)
    fit = _wavefront_fit(fit, noll, degrees_of_freedom)
    observed = ObservedStars.of(images, fields, sky_variance, mask, projection)
    instrument = Instrument.of(telescope, model, fit.terms(telescope, model.air.atmosphere))
    shifts = model.detector.shifts(len(observed))
    strengths = model.air.strengths(instrument.seeing, len(observed))

    with one_blas_thread(), ThreadPoolExecutor(thread_count(threads)) as pool:

        def fitted_stars(instrument: Instrument, report: Callable[[int], None] | None) -> _Fitted:
            def fitted_alone(i: int) -> StarFit:
                star = _fit_alone(instrument, observed.star(i), float(shifts[i]), float(strengths[i]), fit.joint)
                if report is not None:
                    report(1)
                return fit.prepared(instrument, star)

            stars = fit.sided(instrument, list(pool.map(fitted_alone, range(len(observed)))), observed.fields)
            solutions = {i: star.usable for i, star in enumerate(stars) if star.usable is not None}
            if fit.joint and not solutions:
                raise DomainError(f"no usable donut: {stars[0].flags.reasons if stars else 'no images'}")
            index = np.array(list(solutions), dtype=np.int64)
            usable = UsableStars(
                instrument, list(solutions.values()), observed.fields[index], projection, observed.fields, index
            )
            flags = np.array([int(star.flags) for star in stars], dtype=np.int64)
            return _Fitted(flags, index, fit.solved(usable, pool))

        fitted = fitted_stars(instrument, progress)
        terms = fit.refined(instrument, fitted.stars)
        if terms is not None:
            instrument = Instrument.of(telescope, model, terms)
            fitted = fitted_stars(instrument, None)
    return _result(instrument, observed, fitted.flags, fitted.usable, fitted.stars)


class _Fitted(NamedTuple):
    """Flags of all stars [n], numbers of the usable ones, and their results."""

    flags: np.ndarray
    usable: np.ndarray
    stars: FittedStars


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


def _fit_alone(instrument: Instrument, star: ObservedStar, defocus: float, strength: float, joint: bool) -> StarFit:
    """Fit one star by itself, or say why not."""
    masked = star.masked
    if not np.isfinite(star.image[~masked]).all():
        return StarFit(DonutFlag.NOT_FINITE)
    if np.hypot(*star.field) > instrument.telescope.field_limit * (1.0 + 1e-12):
        return StarFit(DonutFlag.OUTSIDE_FIELD)
    saturation, allowed = instrument.model.detector.saturation, max(_SATURATED * star.image.size, 1.0)
    if saturation is not None:
        high = (star.image >= saturation) & ~masked
        if high.sum() > allowed:
            return StarFit(DonutFlag.SATURATED)
        masked = masked | high
    if _plateau(star.image[~masked]) > allowed:
        return StarFit(DonutFlag.SATURATED)
    try:
        light = instrument.light(star.direction, defocus)
    except DomainError:
        return StarFit(DonutFlag.NO_LIGHT)
    pixels = Pixels(np.where(masked, 0.0, star.image), star.variance, ~masked)
    wavefront = not joint or light.diameter > SMALLEST_DONUT * instrument.pixel
    return fit_star(instrument, light, pixels, strength, wavefront=wavefront)


def _plateau(values: np.ndarray) -> int:
    """Return how many pixels have the greatest value, where that is far above the noise of single electrons.

    Pixels with noise hardly agree unless they are saturated.
    """
    top = values.max(initial=0.0)
    return int((values == top).sum()) if top > _FAINT else 0


def _result(
    instrument: Instrument, observed: ObservedStars, flags: np.ndarray, usable: np.ndarray, fitted: FittedStars
) -> DonutFit:
    """Return the result of a fit: rows of the usable stars, and NaN for the others."""
    count, n_noll = len(observed), len(instrument.terms.requested)
    zernikes, covariance = np.full((count, n_noll), np.nan), np.full((count, n_noll, n_noll), np.nan)
    values, errors = np.full((2, count, len(NUISANCES) + len(COMPANION)), np.nan)
    chi2, n_pixels = np.full(count, np.nan), np.zeros(count, dtype=np.int64)
    model, used = np.full(observed.images.shape, np.nan), np.zeros(observed.images.shape, dtype=bool)
    for i, star in zip(usable, fitted.stars, strict=True):
        n, (ny, nx) = len(star.unknowns), star.model.shape
        values[i, :n], errors[i, :n] = star.unknowns, np.sqrt(np.diag(star.covariance))
        zernikes[i], covariance[i] = star.zernikes, star.zernike_covariance
        model[i, :ny, :nx], used[i, :ny, :nx] = star.model, star.pixels.used
        chi2[i] = (pulls(star.pixels, star.model)[star.pixels.used] ** 2).sum()
        n_pixels[i] = star.pixels.used.sum()
    poor = chi2 > _POOR * n_pixels + _BY_CHANCE * np.sqrt(2.0 * n_pixels)
    width, strength = instrument.seeing.fwhm(values[:, STRENGTH]), values[:, STRENGTH]
    return DonutFit(
        zernikes=zernikes,
        covariance=covariance,
        noll=instrument.terms.requested,
        flux=values[:, FLUX],
        flux_error=errors[:, FLUX],
        center=values[:, [X, Y]],
        center_error=errors[:, [X, Y]],
        background=values[:, BACKGROUND],
        fwhm=width,
        fwhm_error=width * errors[:, STRENGTH] / np.where(strength > 0.0, strength, 1.0),
        chi2=chi2,
        n_pixels=n_pixels,
        flags=flags | poor * int(DonutFlag.POOR_FIT),
        companion=values[:, RATIO:],
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
        exposure=None if fitted.exposure is None else fitted.exposure.at(usable, count),
    )
