"""Shear of the objects of an image from its peaks, under a PSF that varies over it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..core.errors import DomainError
from ..core.random_streams import stream
from ..measure.catalogue.objects import DetectedObjects
from ..measure.shear.detection import cell_middles, detect_shear
from ..measure.shear.noise import CorrelatedNoise
from ..measure.shear.shear_shapes import ShearShapes
from .image_file import CcdImage
from .image_stars import sky_variance

#: Correlation of neighbouring pixels above which noise is not white: galaxies that are too faint to be detected have
#: 0.05 at the depth of 100 visits, resampled images 0.2 and more.
_CORRELATED = 0.1
#: PSFs [n, m, m] at pixels (x, y) of an image, [n, 2].
PsfsAt = Callable[[np.ndarray], np.ndarray]


def object_shears(
    image: CcdImage, objects: DetectedObjects, psfs_at: PsfsAt, *, threads: int | None = None
) -> ShearShapes:
    """Return the sums of ellipticities and responses over the peaks nearest to each object.

    Detection, blends and noise are in the response: the sum of the ellipticities over all objects is that of the
    responses times the shear. Along the pixels of the image.

    Parameters
    ----------
    image : CcdImage
        The image.
    objects : DetectedObjects
        Its objects.
    psfs_at : callable
        PSFs of unit sum.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.

    Raises
    ------
    DomainError
        If no pixel has a variance, a PSF is too wide, or all peaks are near masked pixels.
    """
    places = cell_middles(image.image.shape)
    peaks = detect_shear(
        image.image - objects.background,
        psfs_at(places),
        image.pixel_scale,
        image_noise(image, objects),
        psf_positions=places,
        mask=~_measured_pixels(image),
        seed=int(stream(0, "measure", image.name).integers(2**32)),
        threads=threads,
    )
    return peaks.at_objects(objects.x, objects.y)


def image_noise(image: CcdImage, objects: DetectedObjects) -> float | CorrelatedNoise:
    """Return the noise of the sky: white with the variance of the image, or as it is where neighbours are correlated.

    Correlations are measured on pixels outside all objects.
    """
    white = float(np.sqrt(sky_variance(image)))
    outside = _measured_pixels(image) & (objects.segmentation == 0)
    try:
        noise = CorrelatedNoise.of_image(image.image - objects.background, mask=~outside)
    except DomainError:
        # Too few pixels of sky to say.
        return white
    return noise if noise.neighbour_correlation > _CORRELATED else white


def _measured_pixels(image: CcdImage) -> np.ndarray:
    return np.asarray((image.mask == 0) & (image.variance > 0.0))
