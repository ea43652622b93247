"""Stars on images of CCDs: objects, selected stars, and the PSF models that are fitted to them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError, PachonError
from ..core.number_text import counted
from ..core.statistics import RMS_PER_MAD, finite_row_medians
from ..core.units import ARCSEC, positive_angle
from ..measure.catalogue.cutouts import cut_out
from ..measure.catalogue.detect import detect_objects
from ..measure.catalogue.few_stars import FEWEST_STARS, LEAST_FWHM, named_stars, smallest_stars
from ..measure.catalogue.objects import DetectedObjects
from ..measure.catalogue.star_locus import STAMP_SIDE, StarSelection, select_stars, stamp_side
from ..measure.shapes import fwhm, measure_shapes
from ..measure.star_flux import with_unit_flux
from ..measure.star_selection import flag_stars
from ..reconstruction.focal_plane_psf.stars import CcdStars, FocalPlaneStars
from ..reconstruction.own_stars.masked_stars import fill_by_median_star
from ..reconstruction.psf_model.model import PsfModel
from ..reconstruction.psf_model.pixels import Pixels
from ..reconstruction.psf_model.polynomial_fit import Polynomial
from ..reconstruction.psf_model.recipe import DEFAULT, Recipe
from .exposure import SATURATED
from .image_file import CcdImage

# What else makes a PSF.
_HINT = "or a lower min_snr, a catalogue of stars (stars), a PSF model (psf)"
#: Stars from which on the PSF may vary over the image: as many make a stellar locus.
MANY_STARS = 10
# Least distance of a star to its nearest neighbour on stamps of the usual side [pixel].
_ISOLATION = 12.0
# Part of the bright objects that is smaller than most stars, or than small galaxies.
_SMALL_OBJECTS = 0.25
#: FWHM of stars below which pixels are too wide for them [pixel]: shifted stars then hold aliases. Errors of galaxies
#: are 1.1 times those that are given at 2 pixels, 1.4 to 1.8 times at 1.9, 2.3 to 3.6 at 1.7, nine times at 1.5.
_SAMPLED_FWHM = 2.0
#: PSF of few stars: the mean, weighted by S/N.
CONSTANT = Recipe(Pixels(), Polynomial(0), weights="snr")
# Stars whose shape deviates from that of their neighbours by more of the usual deviations than this are left out.
_DEVIATIONS = 6.0
# A galaxy or a blend among fewer stars cannot be told from the change of the PSF.
_FEWEST = 12
# Most passes of leaving them out.
_PASSES = 5


def detected_objects(image: CcdImage) -> DetectedObjects:
    """Detect the objects of an image; DomainError where there are none."""
    try:
        return detect_objects(image.image, image.variance, image.mask, saturated=SATURATED)
    except PachonError as error:
        raise error.within(subject=f"CCD {image.name}") from None


def stars_among(image: CcdImage, objects: DetectedObjects, min_snr: float) -> StarSelection:
    """Select the stars of a locus of ten or more whose stamps show one star; DomainError where there are too few."""
    try:
        return _stars_of_locus(image, objects, min_snr)
    except PachonError as error:
        raise error.within(subject=f"CCD {image.name}") from None


def few_or_many_stars(
    image: CcdImage, objects: DetectedObjects, min_snr: float, positions: ArrayLike | None = None
) -> StarSelection:
    """Select the stars of a locus, of :data:`FEWEST_STARS` where there are not ten; or those at given pixels [k, 2].

    Raises
    ------
    DomainError
        If fewer are good.
    """
    try:
        if positions is not None:
            side = stamp_side(_usual_radius(objects, min_snr))
            stars = named_stars(objects, image.image, positions, mask=image.mask, min_snr=min_snr, size=side)
            if len(stars) >= MANY_STARS:
                stars = _single_stars(image, stars)
        else:
            stars = _stars_of_any_locus(image, objects, min_snr)
    except PachonError as error:
        raise error.within(subject=f"CCD {image.name}") from None
    if len(stars) < FEWEST_STARS:
        raise DomainError(
            f"{counted(len(stars), 'star is', 'stars are')} good: expected at least {FEWEST_STARS} for a PSF, {_HINT}",
            subject=f"CCD {image.name}",
        )
    return stars


def _stars_of_any_locus(image: CcdImage, objects: DetectedObjects, min_snr: float) -> StarSelection:
    """Return the stars of a locus of ten or more, or else of the fewest; all of them may make the locus then."""
    try:
        stars = _stars_of_locus(image, objects, min_snr)
    except DomainError:
        stars = None
    if stars is not None and len(stars) >= MANY_STARS:
        return stars
    side = stamp_side(_usual_radius(objects, min_snr))
    options: dict[str, Any] = {"isolation": _ISOLATION * side / STAMP_SIDE, "size": side, "mask": image.mask}
    try:
        # A median of few stars is no star, with which to compare their stamps.
        return smallest_stars(objects, image.image, min_snr=min_snr, **options)
    except DomainError as error:
        if stars is not None and len(stars) >= FEWEST_STARS:
            return stars
        raise error.followed_by(_HINT) from None


def _stars_of_locus(image: CcdImage, objects: DetectedObjects, min_snr: float) -> StarSelection:
    """Return the stars of a locus of ten or more whose stamps show one star."""
    return _single_stars(image, _locus(image, objects, min_snr))


def _locus(image: CcdImage, objects: DetectedObjects, min_snr: float) -> StarSelection:
    """Return the stars of a locus, on stamps as wide as stars of the image ask for."""
    side = stamp_side(_usual_radius(objects, min_snr))
    isolation = _ISOLATION * side / STAMP_SIDE
    return select_stars(objects, image.image, mask=image.mask, min_snr=min_snr, isolation=isolation, size=side)


def _usual_radius(objects: DetectedObjects, min_snr: float) -> float:
    """Return about the half-light radius of the stars of an image, which are among the smallest objects [pixel]."""
    measured = (objects.flags == 0) & np.isfinite(objects.half_light_radius) & (objects.snr > min_snr)
    measured &= objects.fwhm >= LEAST_FWHM
    if not measured.any():
        return np.nan
    return float(np.quantile(objects.half_light_radius[measured], _SMALL_OBJECTS))


def _single_stars(image: CcdImage, stars: StarSelection) -> StarSelection:
    """Return the selected stars whose stamps show no neighbour, cosmic ray or saturated core."""
    stamps = stars.stamps if stars.masks is None else np.where(stars.masks, np.nan, stars.stamps)
    return stars.without(flag_stars(stamps, _noise_about(image, stars), gain=image.gain).flags != 0)


def _noise_about(image: CcdImage, stars: StarSelection) -> np.ndarray:
    """Return the rms noise of a pixel without objects about each star [k]: stacks are not equally deep everywhere."""
    variance = np.where((image.mask == 0) & (image.variance > 0.0), image.variance, np.nan)
    x, y = stars.positions.T
    stamps = cut_out(variance, x, y, stars.stamps.shape[1], np.nan)
    medians = finite_row_medians(stamps.reshape(len(stamps), -1))
    return np.sqrt(np.where(np.isfinite(medians), medians, sky_variance(image)))


def sky_variance(image: CcdImage) -> float:
    """Return the variance of a pixel without objects, of sky and read noise [ADU^2]; NaN where none has a variance."""
    good = (image.mask == 0) & (image.variance > 0.0)
    # Half of the pixels have hardly any light of objects.
    return float(np.median(image.variance[good])) if good.any() else np.nan


def fit_image_psf(
    image: CcdImage, stars: StarSelection, recipe: Recipe | None = None, colour: np.ndarray | None = None
) -> PsfModel:
    """Fit a PSF model of one CCD to the selected stars of its image; positions are pixels of the image.

    The recipe is the default one where there are :data:`MANY_STARS`, else :data:`CONSTANT`. The stars may have colours
    [n].

    Raises
    ------
    PachonError
        If there are too few stars for the model.
    """
    height, width = image.image.shape
    if recipe is None:
        recipe = DEFAULT if len(stars) >= MANY_STARS else CONSTANT
    try:
        return PsfModel.fit(
            stars.stamps,
            stars.positions,
            masks=_masks_of(stars),
            recipe=recipe,
            weights=recipe.star_weights(stars.snr),
            gain=image.gain,
            extent=(-0.5, width - 0.5, -0.5, height - 0.5),
            colour=colour,
        )
    except PachonError as error:
        raise error.within(subject=f"CCD {image.name}") from None


def _masks_of(stars: StarSelection) -> np.ndarray | None:
    """Return the pixels of stars without weight, but those that none of them shows; None without any."""
    if stars.masks is None:
        return None
    masks = stars.masks & ~stars.masks.all(axis=0)
    return masks if masks.any() else None


def few_stars_warning(stars: StarSelection) -> str:
    """Return the words for a PSF of few stars: how many, and the standard error of its ellipticity."""
    # Ellipticities have no scale: a pixel counts as an arcsec.
    shapes = measure_shapes(stars.stamps, ARCSEC, 2.0 * stars.half_light_radius * ARCSEC)
    e = np.stack([shapes.e1, shapes.e2])[:, shapes.flags == 0]
    count = e.shape[1]
    error = float(np.sqrt((e.var(axis=1, ddof=1)).mean() / count)) if count > 1 else np.nan
    return (
        f"its PSF comes from {counted(len(stars), 'star')}: weighted e good to {error:.1g} a component; "
        "a catalogue of stars (stars) or a PSF model (psf) makes it better"
    )


def undersampled_warning(objects: DetectedObjects, stars: StarSelection) -> str | None:
    """Return the words for stars that are too sharp for the pixels of their image; None where they are not."""
    width = float(np.median(objects.fwhm[stars.index]))
    if not width < _SAMPLED_FWHM:
        return None
    return (
        f"its stars have a FWHM of {width:.3g} pixels: below {_SAMPLED_FWHM:g} a PSF of them is not sampled well, and "
        "ellipticities err by more than their errors; a PSF model (psf) makes them better"
    )


def undersampled_model_warning(psfs: np.ndarray) -> str | None:
    """Return the words for PSFs of a model [n, m, m] that are too sharp for their pixels; None where they are not."""
    width = float(np.nanmedian(fwhm(psfs, 1.0)))
    if not width < _SAMPLED_FWHM:
        return None
    return (
        f"its PSF model has a FWHM of {width:.3g} pixels: below {_SAMPLED_FWHM:g} it is not sampled well, and "
        "shears are too small, by 1 to 3 % at 1.5 pixels, by 2 to 30 % at one"
    )


@check_arguments
def focal_plane_stars(
    images: Iterable[CcdImage], *, weight_fwhm: ArrayLike = 0.7 * ARCSEC, min_snr: float = 30.0
) -> FocalPlaneStars:
    """Select the stars of the images of one exposure, for a PSF model of all its CCDs.

    Parameters
    ----------
    images : iterable of CcdImage
        Images, one at a time in memory where they come from a generator. Those without enough stars for a locus are
        left out.
    weight_fwhm : float or Quantity
        FWHM of the Gaussian weight of the moments [rad].
    min_snr : float
        Least S/N of stars.

    Returns
    -------
    FocalPlaneStars
        Positions in pixels of the CCDs, shapes, and noise of photons and pixels; for
        :meth:`~pachon.FocalPlanePsf.fit` with the camera.

    Raises
    ------
    DomainError
        If no image has stars.
    """
    weight = positive_angle(weight_fwhm, "weight_fwhm")
    ccd_stars, scale, reason = [], 0.0, "there are no images"
    for image in images:
        try:
            stars = stars_among(image, detected_objects(image), min_snr)
        except DomainError as error:
            reason = str(error)
            continue
        scale = image.pixel_scale
        ccd_stars.append(_ccd_stars(image, stars, weight))
    if not ccd_stars:
        raise DomainError(f"no stars on the images: {reason}")
    return FocalPlaneStars.of_ccds(ccd_stars, scale, weight, pixels=True)


def _ccd_stars(image: CcdImage, stars: StarSelection, weight_fwhm: float) -> CcdStars:
    """Return the selected stars of an image with the noise of its sky."""
    observed = stars.stamps
    if stars.masks is not None:
        observed = fill_by_median_star(observed, stars.masks, image.pixel_scale, weight_fwhm).images
    stamps, flux = with_unit_flux(observed)
    shapes = measure_shapes(stamps, image.pixel_scale, weight_fwhm)
    level = sky_variance(image) * image.gain**2
    x, y = image.pixels_of_ccd(stars.positions).T
    good = np.isfinite(flux) & (shapes.flags == 0)
    values = np.stack([shapes.e1, shapes.e2, np.log(np.where(good, shapes.size, 1.0))], axis=1)
    good[good] = regular_shapes(values[good], stars.snr[good], stars.positions[good])
    return CcdStars(image.name, x, y, shapes, flux * image.gain, (level, 0.0), stamps, good, stars.masks)


def regular_shapes(values: np.ndarray, snr: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return the stars whose shapes [n, 3] follow a linear polynomial of their positions, shape [n] bool.

    Deviations are in units of the median absolute one, each weighted by S/N: galaxies and blends within the stellar
    locus would otherwise count as much as stars of their brightness.
    """
    good = np.ones(len(values), dtype=bool)
    if len(values) < _FEWEST:
        return good
    terms = np.column_stack([np.ones(len(values)), positions - positions.mean(axis=0)])
    weight = np.minimum(snr, 100.0)[:, None]
    for _ in range(_PASSES):
        trend = np.linalg.lstsq((terms * weight)[good], (values * weight)[good], rcond=None)[0]
        deviation = np.abs(values - terms @ trend) * weight
        regular = (deviation <= _DEVIATIONS * RMS_PER_MAD * np.median(deviation[good], axis=0)).all(axis=1)
        if (regular == good).all():
            break
        good = regular
    return good
