"""Stars that a catalogue names, among detected objects."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.errors import DomainError
from ...core.units import real_array
from .cutouts import cut_out
from .matching import match_positions
from .objects import DetectedObjects, ObjectFlag
from .pixel_checks import flagged
from .star_locus import STAMP_SIDE, StarCut, StarSelection, centered_stamps, median_and_sigma

#: Largest distance of an object from a named star [pixel].
MATCH = 3.0


def named_stars(
    objects: DetectedObjects,
    image: ArrayLike,
    positions: ArrayLike,
    *,
    min_snr: float = 30.0,
    mask: ArrayLike | NDArray[np.bool_] | None = None,
) -> StarSelection:
    """Select the objects at the positions of a catalogue of stars, and cut out their stamps.

    Those that are saturated, at the edge or with masked pixels are left out, and faint ones; sizes and shapes are not
    compared.

    Parameters
    ----------
    objects : DetectedObjects
        As of :func:`~pachon.detect_objects`.
    image : array
        The image on which they were detected, [ny, nx].
    positions : array
        Pixels (x, y) of stars, the first one's centre at (0, 0), [k, 2].
    min_snr : float
        Least S/N of stars.
    mask : array, optional
        [ny, nx], not zero for pixels that no stamp may hold.

    Raises
    ------
    DomainError
        If positions are not finite, or no object is at any of them.
    """
    places = real_array(positions, "stars: expected positions [k, 2]")
    if places.ndim != 2 or places.shape[1] != 2 or not len(places) or not np.isfinite(places).all():
        raise DomainError(f"stars have shape {places.shape}: expected finite positions [k, 2]")
    pixels = real_array(image, "image: expected real numbers [ny, nx]")
    bad = ~np.isfinite(pixels) | flagged(mask, pixels.shape)
    named = match_positions(objects.x, objects.y, places[:, 0], places[:, 1], MATCH) >= 0
    if not named.any():
        raise DomainError(f"stars: none of {len(places)} is within {MATCH:g} pixels of an object")
    cuts = np.where(named, 0, StarCut.SHAPE).astype(np.int32)
    measured = np.isfinite(objects.half_light_radius) & np.isfinite(objects.fwhm)
    spoilt = cut_out(bad, objects.x, objects.y, STAMP_SIDE, True).any(axis=(1, 2))
    cuts[((objects.flags & ~ObjectFlag.BLENDED) != 0) | spoilt | ~measured] |= StarCut.FLAGGED
    cuts[~(objects.snr >= min_snr)] |= StarCut.FAINT
    index = np.flatnonzero(cuts == 0)
    x, y = objects.x[index], objects.y[index]
    radius = objects.half_light_radius[index]
    center, width = median_and_sigma(radius) if len(radius) else (np.nan, np.nan)
    return StarSelection(
        index=index,
        cuts=cuts,
        half_light_radius=center,
        width=width,
        positions=np.stack([x, y], axis=1),
        snr=objects.snr[index],
        stamps=centered_stamps(np.where(bad, 0.0, pixels - objects.background), x, y, STAMP_SIDE),
    )
