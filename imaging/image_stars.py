"""Stars on images of CCDs: objects, selected stars, and the PSF models that are fitted to them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError, PachonError
from ..core.statistics import RMS_PER_MAD
from ..core.units import ARCSEC, positive_angle
from ..measure.catalogue.detect import detect_objects
from ..measure.catalogue.objects import DetectedObjects
from ..measure.catalogue.star_locus import StarSelection, select_stars
from ..measure.shapes import measure_shapes
from ..measure.star_selection import flag_stars
from ..reconstruction.focal_plane_psf.stars import CcdStars, FocalPlaneStars
from ..reconstruction.psf_model.model import PsfModel
from ..reconstruction.psf_model.recipe import DEFAULT, Recipe
from .exposure import SATURATED
from .image_file import CcdImage

# Stars whose shape deviates from that of their neighbours by more of the usual deviations than this are left out.
_DEVIATIONS = 6.0
# A galaxy or a blend among fewer stars cannot be told from the change of the PSF.
_FEWEST = 12
# Most passes of leaving them out.
_PASSES = 5


def objects_and_stars(image: CcdImage, min_snr: float) -> tuple[DetectedObjects, StarSelection]:
    """Detect the objects of an image, and select its stars: those of the stellar locus whose stamps show one star.

    Raises
    ------
    DomainError
        If nothing is detected, or there are too few stars for a locus.
    """
    try:
        objects = detect_objects(image.image, image.variance, image.mask, saturated=SATURATED)
        stars = select_stars(objects, image.image, mask=image.mask, min_snr=min_snr)
        noise = float(np.sqrt(sky_variance(image)))
        return objects, stars.without(flag_stars(stars.stamps, noise, gain=image.gain).flags != 0)
    except PachonError as error:
        raise error.within(subject=f"CCD {image.name}") from None


def sky_variance(image: CcdImage) -> float:
    """Return the variance of a pixel without objects, of sky and read noise [ADU^2]."""
    return float(np.median(image.variance[image.mask == 0]))


def fit_image_psf(image: CcdImage, stars: StarSelection, recipe: Recipe = DEFAULT) -> PsfModel:
    """Fit a PSF model of one CCD to the selected stars of its image; positions are pixels of the image.

    Raises
    ------
    PachonError
        If there are too few stars for the model.
    """
    height, width = image.image.shape
    try:
        return PsfModel.fit(
            stars.stamps,
            stars.positions,
            masks=_masks_of(stars),
            recipe=recipe,
            weights=recipe.star_weights(stars.snr),
            gain=image.gain,
            extent=(-0.5, width - 0.5, -0.5, height - 0.5),
        )
    except PachonError as error:
        raise error.within(subject=f"CCD {image.name}") from None


def _masks_of(stars: StarSelection) -> np.ndarray | None:
    """Return the pixels of stars without weight, but those that none of them shows; None without any."""
    if stars.masks is None:
        return None
    masks = stars.masks & ~stars.masks.all(axis=0)
    return masks if masks.any() else None


def pixels_of_ccd(image: CcdImage, positions: np.ndarray) -> np.ndarray:
    """Convert pixels of an image, which may be a part of the CCD, to pixels of the CCD, both [n, 2]."""
    return np.asarray(positions + np.array([image.header.get("CCDX0", 0), image.header.get("CCDY0", 0)]))


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
            _, stars = objects_and_stars(image, min_snr)
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
    flux = stars.stamps.sum(axis=(1, 2))
    stamps = stars.stamps / flux[:, None, None]
    shapes = measure_shapes(stamps, image.pixel_scale, weight_fwhm)
    level = sky_variance(image) * image.gain**2
    x, y = pixels_of_ccd(image, stars.positions).T
    good = (flux > 0.0) & (shapes.flags == 0)
    values = np.stack([shapes.e1, shapes.e2, np.log(np.where(good, shapes.size, 1.0))], axis=1)
    good[good] = regular_shapes(values[good], stars.snr[good], stars.positions[good])
    return CcdStars(image.name, x, y, shapes, flux * image.gain, (level, 0.0), stamps, good)


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
