"""Stars of images that have few: those that a catalogue names, or the smallest objects of one size."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.errors import DomainError
from ...core.number_text import counted
from ...core.units import real_array
from ..pixel_masks import bad_pixels
from .matching import match_positions
from .objects import DetectedObjects, ObjectFlag
from .pixel_checks import flagged
from .star_locus import ALIKE, STAMP_SIDE, StarCut, StarSelection, median_and_sigma, spoilt_stars

#: Largest distance of an object from a named star [pixel].
MATCH = 3.0
#: Fewest stars of a PSF: two have no majority against a galaxy or a blend.
FEWEST_STARS = 3
#: Largest ratio of half-light radii and of FWHM of stars of one image, but for noise.
_EQUAL = 1.04
#: Largest deviation by noise [standard deviations]: a galaxy would count for much among few stars.
_SIGMA = 2.0
#: Largest deviation of the isophotal ellipticity, but for noise.
_ELLIPTICITY = 0.03
#: Least FWHM [pixel]: hot pixels and cosmic rays are alike, too.
LEAST_FWHM = 1.5
#: Most objects, such as cosmic rays, that are smaller than stars.
_MOST_SMALLER = 2


def named_stars(
    objects: DetectedObjects,
    image: ArrayLike,
    positions: ArrayLike,
    *,
    min_snr: float = 30.0,
    size: int = STAMP_SIDE,
    mask: ArrayLike | NDArray[np.bool_] | None = None,
) -> StarSelection:
    """Select the objects at the positions of a catalogue of stars, and cut out their stamps.

    Those that are saturated, at the edge or mostly masked are left out, and faint ones; sizes and shapes are not
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
    size : int
        Side of the stamps, odd [pixel].
    mask : array, optional
        [ny, nx], not zero for pixels without weight.

    Raises
    ------
    DomainError
        If positions are not finite, or no object is at any of them.
    """
    places = real_array(positions, "stars: expected positions [k, 2]")
    if places.ndim != 2 or places.shape[1] != 2 or not len(places) or not np.isfinite(places).all():
        raise DomainError(f"stars have shape {places.shape}: expected finite positions [k, 2]")
    named = match_positions(objects.x, objects.y, places[:, 0], places[:, 1], MATCH) >= 0
    if not named.any():
        raise DomainError(f"stars: none of {len(places)} is within {MATCH:g} pixels of an object")
    cuts = _cuts_of_single_objects(objects, image, min_snr, size, mask, ObjectFlag.BLENDED)
    cuts[~named] |= StarCut.SHAPE
    return _selection(objects, image, cuts, size, mask)


def smallest_stars(
    objects: DetectedObjects,
    image: ArrayLike,
    *,
    min_snr: float = 30.0,
    isolation: float = 12.0,
    size: int = STAMP_SIDE,
    mask: ArrayLike | NDArray[np.bool_] | None = None,
) -> StarSelection:
    """Select the smallest objects of one size, of which there are three or more, and cut out their stamps.

    Stars are the smallest objects, but for a cosmic ray here and there, and of one ellipticity; a few make no mode
    among galaxies, as :func:`~pachon.select_stars` looks for.

    Parameters
    ----------
    objects, image, min_snr, size, mask
        As of :func:`named_stars`.
    isolation : float
        Least distance to the nearest other object [pixel].

    Raises
    ------
    DomainError
        If there are no three.
    """
    cuts = _cuts_of_single_objects(objects, image, min_snr, size, mask, ObjectFlag.GOOD)
    cuts[objects.neighbour_distance < isolation] |= StarCut.NEIGHBOUR
    cuts[~(objects.fwhm >= LEAST_FWHM)] |= StarCut.WIDTH
    candidates = np.flatnonzero(cuts == 0)
    if len(candidates) < FEWEST_STARS:
        raise DomainError(f"no stars: {_left_out_text(cuts, min_snr)}")
    order = candidates[np.argsort(objects.half_light_radius[candidates], kind="stable")]
    radii = objects.half_light_radius[order]
    reason = f"the smallest ones are of different sizes, expected {FEWEST_STARS} of one"
    for first in range(min(1 + _MOST_SMALLER, len(radii))):
        group = order[first : np.searchsorted(radii, _EQUAL * radii[first], side="right")]
        if len(group) < FEWEST_STARS:
            continue
        noise = _SIGMA / np.maximum(objects.snr, 1.0)
        for values, cut in ((objects.half_light_radius, StarCut.SIZE), (objects.fwhm, StarCut.WIDTH)):
            cuts[~(np.abs(values / np.median(values[group]) - 1.0) < _EQUAL - 1.0 + noise)] |= cut
        e1, e2 = (e - np.median(e[group]) for e in (objects.e1, objects.e2))
        cuts[~(np.hypot(e1, e2) < _ELLIPTICITY + noise)] |= StarCut.SHAPE
        count, least = int((cuts == 0).sum()), max(FEWEST_STARS, int(np.ceil(ALIKE * len(group))))
        if count >= least:
            return _selection(objects, image, cuts, size, mask)
        reason = f"{count} of the {len(group)} smallest ones have one width and ellipticity, expected at least {least}"
        break
    raise DomainError(f"no stars: of {len(order)} isolated objects of S/N above {min_snr:g} {reason}")


def _left_out_text(cuts: np.ndarray, min_snr: float) -> str:
    """Return the words for objects among which there are too few candidates, and for the reasons."""
    reasons = {
        StarCut.FAINT: f"of S/N below {min_snr:g}",
        StarCut.FLAGGED: "saturated, blended, masked in most of their core, or at an edge",
        StarCut.NEIGHBOUR: "with a neighbour",
        StarCut.WIDTH: f"of a FWHM below {LEAST_FWHM:g} pixels",
    }
    counts = {text: int(((cuts & cut) != 0).sum()) for cut, text in reasons.items()}
    of_reasons = ", ".join(f"{count} {text}" for text, count in counts.items() if count)
    return (
        f"{int((cuts == 0).sum())} of {counted(len(cuts), 'object')} may be stars, expected at least {FEWEST_STARS}"
        + f" (left out: {of_reasons})" * bool(of_reasons)
    )


def _cuts_of_single_objects(
    objects: DetectedObjects,
    image: ArrayLike,
    min_snr: float,
    size: int,
    mask: ArrayLike | NDArray[np.bool_] | None,
    harmless: ObjectFlag,
) -> np.ndarray:
    """Return the cuts of objects by their flags, but for harmless ones, by bad pixels on their stamps, and by S/N."""
    bad = _bad_pixels(image, mask)
    measured = np.isfinite(objects.half_light_radius) & np.isfinite(objects.fwhm)
    spoilt = spoilt_stars(bad, objects, size)
    cuts = np.zeros(len(objects), dtype=np.int32)
    cuts[((objects.flags & ~harmless) != 0) | spoilt | ~measured] |= StarCut.FLAGGED
    cuts[~(objects.snr >= min_snr)] |= StarCut.FAINT
    return cuts


def _bad_pixels(image: ArrayLike, mask: ArrayLike | NDArray[np.bool_] | None) -> np.ndarray:
    pixels = real_array(image, "image: expected real numbers [ny, nx]")
    return bad_pixels(pixels) | flagged(mask, pixels.shape)


def _selection(
    objects: DetectedObjects,
    image: ArrayLike,
    cuts: np.ndarray,
    size: int,
    mask: ArrayLike | NDArray[np.bool_] | None,
) -> StarSelection:
    """Return the objects without cuts as stars."""
    radii = objects.half_light_radius[cuts == 0]
    light = np.where(_bad_pixels(image, mask), np.nan, np.asarray(image) - objects.background)
    return StarSelection.of_objects(
        objects, cuts, median_and_sigma(radii) if len(radii) else (np.nan, np.nan), light, size
    )
