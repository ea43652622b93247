"""Files of star stamps as the LSST pipelines write them: extensions IMAGE, MASK, VARIANCE of each star, by EXTVER."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits

from ...core.errors import ProductError
from .stamp_weights import without_weightless


def is_stamp_file(hdus: fits.HDUList) -> bool:
    """Return whether there is an image of two axes named IMAGE with a number EXTVER."""
    return any(_is_image(hdu) for hdu in hdus)


def read_stamp_file(hdus: fits.HDUList, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps [n, ny, nx], NaN in pixels without weight, and positions [n, 2] of their middles [pixel].

    The first pixel of a stamp on its image is (-LTV1, -LTV2). Stamps of different sizes are cut to the smallest. In
    ``deblended`` stamps neighbours are subtracted; where a mask calls pixels outside the footprint NO_DATA these have
    no weight.

    Raises
    ------
    ProductError
        If a stamp has no place, or its mask or variance has another shape.
    """
    parts = {(hdu.name, hdu.ver): hdu for hdu in hdus if hdu.is_image and hdu.data is not None}
    images = sorted((hdu for hdu in hdus if _is_image(hdu)), key=lambda hdu: int(hdu.ver))
    ny, nx = np.min([hdu.data.shape for hdu in images], axis=0)
    stamps, positions = [], []
    for image in images:
        place = [image.header.get(key) for key in ("LTV1", "LTV2")]
        if not all(isinstance(value, (int, float)) and np.isfinite(value) for value in place):
            raise ProductError(
                f"IMAGE {image.ver} has LTV1, LTV2 = {place[0]}, {place[1]}: expected numbers, minus the first pixel "
                "of the stamp on its image",
                file=path,
            )
        mask, variance = (parts.get((name, image.ver)) for name in ("MASK", "VARIANCE"))
        stamp = without_weightless(
            np.asarray(image.data, dtype=np.float64)[None],
            None,
            None if mask is None else np.asarray(mask.data)[None],
            {} if mask is None else mask.header,
            path,
            variances=None if variance is None else np.asarray(variance.data, dtype=np.float64)[None],
        )[0]
        first_row, first_column = (stamp.shape[0] - ny) // 2, (stamp.shape[1] - nx) // 2
        stamps.append(stamp[first_row : first_row + ny, first_column : first_column + nx])
        corner = np.array([first_column, first_row]) - np.array(place, dtype=np.float64)
        positions.append(corner + 0.5 * (np.array([nx, ny]) - 1.0))
    return np.stack(stamps), np.stack(positions)


def _is_image(hdu: fits.ImageHDU) -> bool:
    return bool(hdu.is_image and hdu.data is not None and hdu.data.ndim == 2 and hdu.name == "IMAGE" and hdu.ver)
