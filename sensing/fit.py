"""Fit donuts: maximum likelihood of the pixels of out-of-focus stars, with exact ray positions as the model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, DomainError, shown
from ..core.threads import one_blas_thread, thread_count
from ..core.units import ARCSEC, metres, radians, require_count, require_positive
from ..models.camera.focal_plane import FocalPlane
from ..models.parameters.degrees_of_freedom import DegreesOfFreedom
from ..models.parameters.tolerances import Tolerance
from ..models.telescope import Telescope
from ..raytrace.rays import field_direction
from ..wavefront.atmosphere.atmosphere import Atmosphere
from ..wavefront.request import relative_weights, wavelength_points
from .degrees import FreedomEstimate, prior_spreads
from .fit_star import SMALLEST_DONUT, StarFit, fit_star
from .flags import DonutFlag
from .image_model import BACKGROUND, FLUX, RATIO, STRENGTH, X, Y
from .inputs import (
    noll_indices,
    one_for_each,
    outer_scale_of,
    padded,
    sky_variances,
    small_length,
)
from .joint import JointFit, field_terms, fit_field, fit_freedoms, with_freedoms
from .light import Instrument
from .likelihood import model_image, pulls
from .result import DonutFit
from .seeing import Seeing
from .stamps import Pixels
from .terms import WavefrontTerms

#: Seeing that the search starts from [rad].
_START_FWHM = 0.8 * ARCSEC
# Largest seeing [rad], defocus of an image [m], and number of cells across the pupil.
_MOST_FWHM, _MOST_DEFOCUS, _MOST_CELLS = 60.0 * ARCSEC, 0.1, 2000
#: Saturated pixels from which on a donut is flagged, as a fraction of the stamp; fewer are left out.
_SATURATED = 0.002
#: Electrons up to which pixels of equal value are no sign of saturation.
_FAINT = 100.0
#: Chi-square a pixel above which a fit is poor, beside so many standard deviations of the noise's own.
_POOR, _BY_CHANCE = 1.2, 5.0


@check_arguments
def fit_donuts(
    telescope: Telescope,
    images: ArrayLike | Sequence[ArrayLike],
    fields: ArrayLike,
    wavelength: ArrayLike | None = None,
    *,
    pixel_size: ArrayLike = 10e-6,
    sky_variance: ArrayLike = 0.0,
    noll: Iterable[int] = range(4, 23),
    left_out: ArrayLike = 200e-9,
    higher_order: ArrayLike = 0.0,
    turbulence: Atmosphere | None = None,
    degrees_of_freedom: DegreesOfFreedom | None = None,
    prior: ArrayLike | Mapping[str, Any] | Sequence[Tolerance] | None = None,
    field_noll: Iterable[int] | None = None,
    defocus: ArrayLike = 0.0,
    focal_plane: FocalPlane | None = None,
    wavelength_weights: ArrayLike | None = None,
    fwhm: ArrayLike | None = None,
    outer_scale: float = 25.0,
    diffusion: ArrayLike = 0.0,
    diffraction: bool = False,
    mask: NDArray[np.bool_] | Sequence[NDArray[np.bool_]] | None = None,
    saturation: float | None = None,
    n_pupil: int | None = None,
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
    wavelength : array_like or Quantity, optional
        Vacuum wavelength [m], or several of them; the telescope's own by default.
    pixel_size : float or Quantity
        Side of a pixel [m].
    sky_variance : float or array, shapes [n] or [n, ny, nx]
        Variance of sky and readout [electron^2 a pixel].
    noll : iterable of int
        Noll indices of the wavefront, from 4.
    left_out : float or Quantity
        Rms of each term from Z4 to Z22 that `noll` leaves out [m]. These are fitted too, with that prior, those up to
        Z28 with a tenth of it, and not returned: errors of `zernikes` have what is not known of them. 0 is none, and so
        are joint fits.
    higher_order : float or Quantity
        Rms of each further Zernike, of the next radial degree at every azimuthal order of `noll` [m]: 10 nm, say, for
        what turbulence leaves in 15 s. They are fitted too, with that prior, and not returned. Without them (0, the
        default) light that they move is taken for low orders, which is worst on an annulus.
    turbulence : Atmosphere, optional
        Turbulence of the exposure, its winds and length. The terms up to Z78 that its mean wavefront has beside `noll`
        are fitted too, with the prior of the closed form, and not returned; its own terms of `noll`, which no single
        donut tells from the telescope's, are added to `covariance`. Three times the time; no joint fits.
    degrees_of_freedom : DegreesOfFreedom, optional
        Fit these degrees of freedom of the telescope to all donuts together, in place of Zernikes of each.
    prior : array_like, mapping or tolerances, optional
        Standard deviations of the degrees of freedom, each in its unit; by default each makes 1 um rms of wavefront
        over the field.
    field_noll : iterable of int, optional
        Fit double Zernikes to all donuts together: Noll indices of terms over the field, from 1.
    defocus : float or array, shape [n]
        Shift of the detector, not of the camera, of each image along its z, beside that of the telescope [m]: 0 for all
        in one plane, or 1.5 mm and 0 for donuts and in-focus stars, which then share one likelihood.
    focal_plane : FocalPlane, optional
        Heights of the CCDs.
    wavelength_weights : array_like, shape [n_wave], optional
        Relative amounts of light.
    fwhm : float, array [n] or Quantity, optional
        Seeing [rad], if it is known; fitted by default. 0 is no atmosphere.
    outer_scale : float
        Outer scale of the turbulence [m]; infinite for Kolmogorov's.
    diffusion : float or Quantity
        Rms of the charge diffusion along each axis [m], which the seeing takes up by default.
    diffraction : bool
        Whether light is diffracted at the rims of the pupil, as that of real stars is: it takes light from strips along
        the rims of the image. A fit of rays takes their lack for 35 to 45 nm of wavefront, most of it Z11 (LSST, 1.5
        mm, 620 nm, 0.8"), and a wider seeing. Images made of rays alone, without diffraction, have none (the default).
    mask : array_like of bool, as `images`, optional
        True at pixels to leave out.
    saturation : float, optional
        Level from which on pixels are saturated [electrons]. Many pixels of the same greatest value are taken to be
        saturated without it.
    n_pupil : int, optional
        Cells across the pupil; by default as many as an image needs.
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
        If both kinds of joint fits are asked for, a prior has no degrees of freedom, or an option is malformed.
    DomainError
        If an array has the wrong shape, the wavelength is not covered, or a number is outside its range. A bad donut is
        no error: it is flagged, with NaN for results, and the others go on.
    """
    if degrees_of_freedom is not None and field_noll is not None:
        raise ConfigError("degrees_of_freedom and field_noll are both given: expected one of them")
    if prior is not None and degrees_of_freedom is None:
        raise ConfigError("prior: expected degrees_of_freedom with it")
    if turbulence is not None and not (degrees_of_freedom is None and field_noll is None):
        raise ConfigError("turbulence: expected fits of single donuts, no degrees_of_freedom or field_noll with it")
    stack, shapes = padded(images, "images", np.float64, np.nan)
    count = len(stack)
    angles = np.atleast_2d(radians(fields, "fields"))
    if angles.shape != (count, 2) or not np.isfinite(angles).all():
        raise DomainError(
            f"fields of shape {angles.shape}: expected finite angles of {count} images, shape [{count}, 2]"
        )
    directions = field_direction(angles[:, 0], angles[:, 1], projection)
    waves = wavelength_points(telescope, wavelength)
    terms = noll_indices(noll, "noll", 4)
    left, size = (small_length(v, n) for v, n in ((left_out, "left_out"), (higher_order, "higher_order")))
    # Joint fits share their terms: those of single donuts would have a prior of their own at every field term.
    spare = left if field_noll is None else 0.0
    others = (spare, size) if degrees_of_freedom is None else (0.0, 0.0)
    wavefront = WavefrontTerms.of(terms, *others, telescope, turbulence)
    field_indices = None if field_noll is None else noll_indices(field_noll, "field_noll", 1)
    shifts = one_for_each(metres(defocus, "defocus"), count, "defocus")
    if (np.abs(shifts) > _MOST_DEFOCUS).any():
        raise DomainError(f"defocus: expected at most {_MOST_DEFOCUS:g} m on either side")
    known = None if fwhm is None else one_for_each(radians(fwhm, "fwhm"), count, "fwhm")
    if known is not None and not ((known >= 0.0) & (known < _MOST_FWHM)).all():
        raise DomainError(f"fwhm = {shown(fwhm)}: expected angles from 0 to {_MOST_FWHM:g} rad")
    spread = small_length(diffusion, "diffusion")
    cells = None if n_pupil is None else require_count(n_pupil, "n_pupil", 8, _MOST_CELLS)
    if saturation is not None:
        saturation = require_positive(saturation, "saturation", "electrons")
    variance = sky_variances(sky_variance, stack.shape)
    masked = np.zeros(stack.shape, dtype=bool)
    if mask is not None:
        masked, mask_shapes = padded(mask, "mask", bool, True)
        if mask_shapes != shapes:
            raise DomainError(f"mask of shape {masked.shape}: expected those of the images, {stack.shape}", key="mask")
    light = relative_weights(wavelength_weights, len(waves))
    instrument = Instrument(
        telescope,
        waves,
        light,
        require_positive(metres(pixel_size, "pixel_size"), "pixel_size", "metres"),
        Seeing(float(waves[len(waves) // 2]), outer_scale_of(outer_scale)),
        spread,
        wavefront.every,
        wavefront.precision,
        focal_plane,
        cells,
        diffraction,
    )
    joint = degrees_of_freedom is not None or field_indices is not None
    start = instrument.seeing.strength(_START_FWHM)
    strengths = np.full(count, start) if known is None else [instrument.seeing.strength(float(v)) for v in known]

    def one(i: int) -> StarFit:
        found = _fit_one(
            instrument,
            stack[i, : shapes[i][0], : shapes[i][1]],
            variance[i, : shapes[i][0], : shapes[i][1]],
            masked[i, : shapes[i][0], : shapes[i][1]],
            angles[i],
            directions[i],
            float(shifts[i]),
            float(strengths[i]),
            known is not None,
            joint,
            saturation,
        )
        if progress is not None:
            progress(1)
        return found if degrees_of_freedom is None else with_freedoms(instrument, found, degrees_of_freedom)

    with one_blas_thread(), ThreadPoolExecutor(thread_count(threads)) as pool:
        stars = list(pool.map(one, range(count)))
        usable = [i for i, star in enumerate(stars) if star.solution is not None and star.flags.usable]
        result: JointFit | None = None
        estimate: FreedomEstimate | None = None
        if joint and not usable:
            raise DomainError(f"no usable donut: {stars[0].flags.reasons if stars else 'no images'}")
        if field_indices is not None:
            basis = field_terms(field_indices, angles[usable], telescope.field_radius)
            result = fit_field(instrument, [stars[i] for i in usable], basis, known is not None, pool)
        if degrees_of_freedom is not None:
            spreads = prior_spreads(degrees_of_freedom, prior, telescope, instrument.middle)
            result = fit_freedoms(
                instrument,
                [stars[i] for i in usable],
                degrees_of_freedom,
                spreads,
                angles[usable],
                projection,
                known is not None,
                pool,
            )
            solution = result.solution
            estimate = FreedomEstimate(degrees_of_freedom, solution.shared, solution.shared_covariance, spreads)
    return _collected(instrument, wavefront, stack, angles, stars, usable, result, estimate, field_indices)


def _fit_one(
    instrument: Instrument,
    image: np.ndarray,
    variance: np.ndarray,
    masked: np.ndarray,
    angles: np.ndarray,
    direction: np.ndarray,
    defocus: float,
    strength: float,
    fixed_strength: bool,
    joint: bool,
    saturation: float | None,
) -> StarFit:
    """Fit one star, or say why not."""
    if not np.isfinite(image[~masked]).all():
        return StarFit(DonutFlag.NOT_FINITE)
    if np.hypot(*angles) > instrument.telescope.field_limit * (1.0 + 1e-12):
        return StarFit(DonutFlag.OUTSIDE_FIELD)
    most = max(_SATURATED * image.size, 1.0)
    if saturation is not None:
        high = (image >= saturation) & ~masked
        if high.sum() > most:
            return StarFit(DonutFlag.SATURATED)
        masked = masked | high
    if _plateau(image[~masked]) > most:
        return StarFit(DonutFlag.SATURATED)
    try:
        light = instrument.light(direction, defocus)
    except DomainError:
        return StarFit(DonutFlag.NO_LIGHT)
    pixels = Pixels(np.where(masked, 0.0, image), variance, ~masked)
    wavefront = not joint or light.diameter > SMALLEST_DONUT * instrument.pixel
    return fit_star(instrument, light, pixels, strength=strength, fixed_strength=fixed_strength, wavefront=wavefront)


def _plateau(values: np.ndarray) -> int:
    """Return how many pixels have the greatest value, where that is far above the noise of single electrons.

    Pixels with noise hardly agree unless they are saturated.
    """
    top = values.max(initial=0.0)
    return int((values == top).sum()) if top > _FAINT else 0


def _collected(
    instrument: Instrument,
    wavefront: WavefrontTerms,
    stack: np.ndarray,
    angles: np.ndarray,
    stars: list[StarFit],
    usable: list[int],
    joint: JointFit | None,
    estimate: FreedomEstimate | None,
    field_noll: np.ndarray | None,
) -> DonutFit:
    """Return the result of single fits, or of a joint one."""
    count, noll, n_noll = len(stars), wavefront.asked, len(wavefront.asked)
    zernikes, covariance = np.full((count, n_noll), np.nan), np.full((count, n_noll, n_noll), np.nan)
    values, errors = np.full((2, count, 8), np.nan)
    chi2, n_pixels = np.full(count, np.nan), np.zeros(count, dtype=np.int64)
    model, used = np.full(stack.shape, np.nan), np.zeros(stack.shape, dtype=bool)
    for k, i in enumerate(usable):
        star = stars[i] if joint is None else joint.stars[k]
        solution, place = (star.solution, 0) if joint is None else (joint.solution, k)
        stamp = star.stamp
        if solution is None or stamp is None or star.full is None:
            continue
        full = replace(star.full, rays=stamp.rays)
        found = solution.stars[place]
        values[i, : len(found)] = found
        errors[i, : len(found)] = np.sqrt(np.diag(solution.star_covariance(place)))
        ny, nx = full.image.shape
        best = star.model if joint is None else None
        best = model_image(full, found, solution.waves[place]) if best is None else best
        if joint is not None:
            full.release()
        model[i, :ny, :nx] = best
        used[i, :ny, :nx] = full.used
        chi2[i], n_pixels[i] = (pulls(full, best)[full.used] ** 2).sum(), full.used.sum()
        if joint is None:
            zernikes[i] = solution.shared[:n_noll]
            covariance[i] = solution.shared_covariance[:n_noll, :n_noll] + wavefront.air
        else:
            along = joint.zernike_map[k, :n_noll]
            zernikes[i], covariance[i] = joint.zernikes[k, :n_noll], along @ solution.shared_covariance @ along.T
    double, double_covariance = None, None
    if joint is not None and field_noll is not None:
        n_all = len(instrument.noll)
        kept = (n_all * np.arange(len(field_noll))[:, None] + np.arange(n_noll)).ravel()
        double = joint.solution.shared[kept].reshape(-1, n_noll)
        double_covariance = joint.solution.shared_covariance[np.ix_(kept, kept)]
    poor = chi2 > _POOR * n_pixels + _BY_CHANCE * np.sqrt(2.0 * n_pixels)
    width = instrument.seeing.fwhm(values[:, STRENGTH])
    return DonutFit(
        zernikes=zernikes,
        covariance=covariance,
        noll=noll,
        flux=values[:, FLUX],
        flux_error=errors[:, FLUX],
        center=values[:, [X, Y]],
        center_error=errors[:, [X, Y]],
        background=values[:, BACKGROUND],
        fwhm=width,
        fwhm_error=width * errors[:, STRENGTH] / np.where(values[:, STRENGTH] > 0.0, values[:, STRENGTH], 1.0),
        chi2=chi2,
        n_pixels=n_pixels,
        flags=np.array([int(star.flags) for star in stars], dtype=np.int64) | poor * int(DonutFlag.POOR_FIT),
        companion=values[:, RATIO:],
        images=stack,
        model=model,
        used=used,
        fields=angles,
        wavelengths=instrument.wavelengths,
        pixel_size=instrument.pixel,
        telescope=instrument.telescope.name,
        obscuration=instrument.telescope.pupil_obscuration,
        double_zernikes=double,
        double_zernike_covariance=double_covariance,
        degrees_of_freedom=estimate,
    )
