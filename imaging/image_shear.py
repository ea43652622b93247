"""Shear of the objects of an image from its peaks, under a PSF that varies over it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..core.random_streams import stream
from ..measure.catalogue.objects import DetectedObjects
from ..measure.shear.detection import cell_middles, detect_shear
from ..measure.shear.shear_shapes import ShearShapes
from .image_file import CcdImage
from .image_stars import sky_variance

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
        If no pixel has a variance, or a PSF is too wide.
    """
    places = cell_middles(image.image.shape)
    good = (image.mask == 0) & (image.variance > 0.0)
    noise = float(np.sqrt(sky_variance(image)))
    peaks = detect_shear(
        image.image - objects.background,
        psfs_at(places),
        image.pixel_scale,
        noise,
        psf_positions=places,
        mask=~good,
        seed=int(stream(0, "measure", image.name).integers(2**32)),
        threads=threads,
    )
    return peaks.at_objects(objects.x, objects.y)
