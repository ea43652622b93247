"""Detection and photometry of objects by SEP (Barbary 2016), the library of SExtractor (Bertin & Arnouts 1996)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import sep
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.quantization import dithered
from ...core.units import real_array, require_count, require_positive
from ..shapes import fwhm
from .cutouts import cut_out
from .objects import DetectedObjects, ObjectFlag
from .pixel_checks import check_pixels
from .scattered_pixels import fill_objects, fill_scattered

# Radius over which the Kron radius is averaged, as in SExtractor [rms axes].
_KRON_LIMIT = 6.0
#: Largest value of a pixel: the squares of sums of larger ones are no numbers of SEP, which has single precision.
_BRIGHTEST = 1e15
# Radius of the aperture over the Kron radius, as in SExtractor.
_KRON_FACTOR = 2.5
# Least radius of the aperture, as in SExtractor [rms axes].
_KRON_LEAST = 3.5
# The window of centroids has the half-light radius of the object as its HWHM.
_WINDOW = 2.0 / 2.35
# Sides of the stamps on which widths at half maximum are measured [pixel]: the first that is three half-light radii.
_FWHM_SIDES = (25, 51, 101, 201, 401)
_FWHM_RADII = 3.0
# Pixels of the stamps that are measured at a time, which bounds their memory.
_FWHM_PIXELS = 2048 * 25**2
# Room of SEP for pixels above the threshold, as a fraction of the image: its own does not grow with one.
_PIXEL_ROOM = 0.2
#: Most levels of brightness by which blends are taken apart: SEP goes through all of them for every object.
_MOST_LEVELS = 1024
# Room of SEP for pieces of one blend.
_PIECES = 8192


@check_arguments
def detect_objects(
    image: ArrayLike,
    variance: ArrayLike,
    mask: ArrayLike | NDArray[np.bool_] | None = None,
    *,
    saturated: int = 0,
    threshold: float = 3.0,
    min_area: int = 5,
    kernel: ArrayLike | None = None,
    deblend_levels: int = 32,
    deblend_contrast: float = 0.005,
    background_size: int | None = 64,
) -> DetectedObjects:
    """Detect objects and measure positions, fluxes, sizes and isophotal shapes.

    Parameters
    ----------
    image : array
        [ny, nx], in any unit.
    variance : array
        Of the pixels, in the square of that unit, [ny, nx].
    mask : array of int, optional
        [ny, nx] bits. Pixels with any bit other than those of `saturated` are left out; among mostly good ones, as
        scattered bad pixels and columns are, they are filled by the light of their object or the mean of neighbours.
    saturated : int
        Bits of saturated pixels, which belong to their object and flag it.
    threshold : float
        Of pixels of the filtered image [standard deviations].
    min_area : int
        Fewest connected pixels above the threshold.
    kernel : array, optional
        Filter, such as an image of the PSF; that of SExtractor by default, 3 x 3 pixels.
    deblend_levels : int
        Thresholds between that of detection and the peak at which an object may split.
    deblend_contrast : float
        Least fraction of the flux in a piece; 1 for no deblending.
    background_size : int, optional
        Side of the cells of which the background is made [pixel]; None for an image without background.

    Returns
    -------
    DetectedObjects
        In the order of SEP: by rows, roughly.

    Raises
    ------
    DomainError
        If shapes differ, a pixel that is not masked has no positive variance, an option is out of range, or nothing is
        detected.
    """
    bits = np.zeros(np.shape(image), dtype=np.int64) if mask is None else np.asarray(mask)
    if bits.dtype.kind not in "iub" or hasattr(mask, "unit"):
        raise DomainError(f"mask has type {bits.dtype}: expected integers, the bits of each pixel")
    bits = bits.astype(np.int64)
    require_count(saturated, "saturated", 0, 2**63 - 1)
    pixels, variances, ignored = check_pixels(image, variance, bits & ~np.int64(saturated))
    options = _sep_options(threshold, min_area, kernel, deblend_levels, deblend_contrast)
    if background_size is not None:
        require_count(background_size, "background_size", 1, 2**31 - 1)
    if ignored.all():
        raise DomainError("mask: expected at least one pixel that is not masked, and finite")
    data = np.where(ignored, 0.0, pixels)
    if max(float(np.abs(data).max()), float(np.where(ignored, 0.0, variances).max())) > _BRIGHTEST:
        raise DomainError(f"image, variance: expected numbers of at most {_BRIGHTEST:g}")
    # SEP reads C arrays; masked pixels have any positive variance.
    variances = np.ascontiguousarray(np.where(ignored, 1.0, variances))
    with _sep_memory(data.size):
        try:
            level = np.zeros_like(data)
            if background_size is not None:
                sky = np.ascontiguousarray(dithered(data, ignored).values)
                level = sep.Background(sky, mask=ignored, bw=background_size, bh=background_size).back()
                data = np.where(ignored, 0.0, data - level)
            scattered = without_core = None
            if ignored.any():
                data, variances, scattered = fill_scattered(data, variances, ignored)
                ignored = ignored & ~scattered
            options |= {"var": variances, "mask": ignored, "segmentation_map": True}
            sep_objects, segmentation = sep.extract(data, **options)
            if scattered is not None and segmentation[scattered].any():
                bad = scattered | ignored
                data, unsure, lost = fill_objects(data, bad, segmentation, sep_objects["x"], sep_objects["y"])
                variances += unsure
                without_core = np.append(False, lost)[segmentation]
                sep_objects, segmentation = sep.extract(data, **options)
        except Exception as error:  # SEP raises Exception itself
            raise DomainError(f"SEP: {' '.join(str(error).split())}") from None
    if not len(sep_objects):
        raise DomainError(
            f"no objects: expected {min_area} connected pixels above {threshold:g} standard deviations of the noise"
        )
    objects = _measure_objects(data, variances, ignored, (bits & saturated) != 0, sep_objects, segmentation, level)
    if without_core is not None:
        rows, columns = (np.rint(at).astype(np.int64) for at in (objects.y, objects.x))
        objects.flags[without_core[rows, columns]] |= ObjectFlag.MASKED
    return objects


def _sep_options(
    threshold: float, min_area: int, kernel: ArrayLike | None, deblend_levels: int, deblend_contrast: float
) -> dict[str, Any]:
    """Return the arguments of SEP's extraction."""
    options: dict[str, Any] = {"thresh": require_positive(threshold, "threshold", "standard deviations")}
    require_count(min_area, "min_area", 1, 2**31 - 1)
    require_count(deblend_levels, "deblend_levels", 1, _MOST_LEVELS)
    if not 0.0 <= deblend_contrast <= 1.0:
        raise DomainError(f"deblend_contrast = {deblend_contrast}: expected a number from 0 to 1")
    if kernel is not None:
        weights = real_array(kernel, "kernel: expected real numbers [ny, nx]")
        if weights.ndim != 2 or not np.isfinite(weights).all() or not weights.sum() > 0.0:
            raise DomainError(f"kernel of shape {weights.shape}: expected [ny, nx] with a positive sum")
        options["filter_kernel"] = np.ascontiguousarray(weights)
    return options | {"minarea": min_area, "deblend_nthresh": deblend_levels, "deblend_cont": deblend_contrast}


@contextmanager
def _sep_memory(size: int) -> Iterator[None]:
    """Give SEP room for the objects of an image inside a with block."""
    before = sep.get_extract_pixstack(), sep.get_sub_object_limit()
    sep.set_extract_pixstack(max(before[0], int(_PIXEL_ROOM * size)))
    sep.set_sub_object_limit(max(before[1], _PIECES))
    try:
        yield
    finally:
        sep.set_extract_pixstack(before[0])
        sep.set_sub_object_limit(before[1])


def _measure_objects(
    data: np.ndarray,
    variance: np.ndarray,
    ignored: np.ndarray,
    saturated: np.ndarray,
    sep_objects: np.ndarray,
    segmentation: np.ndarray,
    background: np.ndarray,
) -> DetectedObjects:
    """Measure the objects that SEP found, without the pixels of their neighbours."""
    count = len(sep_objects)
    neighbour_mask = {"mask": ignored, "segmap": segmentation, "seg_id": np.arange(1, count + 1, dtype=np.int32)}
    a, b = np.maximum(sep_objects["a"], 1e-3), np.maximum(sep_objects["b"], 1e-3)
    # SEP refuses an angle that rounding puts beyond a right one.
    theta = np.clip(sep_objects["theta"], -0.5 * np.pi, 0.5 * np.pi)
    ellipse = sep_objects["x"], sep_objects["y"], a, b, theta
    kron, _ = sep.kron_radius(data, *ellipse, _KRON_LIMIT, **neighbour_mask)
    aperture = np.fmax(_KRON_FACTOR * kron, _KRON_LEAST)
    flux, flux_error, aperture_flags = sep.sum_ellipse(
        data, *ellipse, aperture, var=variance, subpix=1, **neighbour_mask
    )
    radius, _ = sep.flux_radius(
        data, sep_objects["x"], sep_objects["y"], _KRON_LIMIT * a, 0.5, normflux=flux, **neighbour_mask
    )
    radius = np.where((flux > 0.0) & (radius > 0.0), radius, np.nan)
    window = np.where(np.isfinite(radius), radius, a) * _WINDOW
    wx, wy, failed = sep.winpos(data, sep_objects["x"], sep_objects["y"], window, mask=ignored)
    moved = np.hypot(wx - sep_objects["x"], wy - sep_objects["y"])
    # SEP's windows take in the light of neighbours, and may leave the image.
    windowed = (failed == 0) & (moved < window) & ((sep_objects["flag"] & sep.OBJ_MERGED) == 0)
    for at, pixels in ((wx, data.shape[1]), (wy, data.shape[0])):
        windowed &= (at >= 0.0) & (at <= pixels - 1)
    x, y = np.where(windowed, wx, sep_objects["x"]), np.where(windowed, wy, sep_objects["y"])
    flags = np.zeros(count, dtype=np.int32)
    flags[((sep_objects["flag"] & sep.OBJ_TRUNC) | (aperture_flags & sep.APER_TRUNC)) != 0] |= ObjectFlag.EDGE
    flags[(sep_objects["flag"] & sep.OBJ_MERGED) != 0] |= ObjectFlag.BLENDED
    flags[np.bincount(segmentation[saturated], minlength=count + 1)[1:] > 0] |= ObjectFlag.SATURATED
    # Neighbours are masked as well: masked pixels of the image alone count here.
    _, _, masked = sep.sum_ellipse(data, *ellipse, aperture, mask=ignored, subpix=1)
    flags[(masked & sep.APER_HASMASKED) != 0] |= ObjectFlag.MASKED
    return DetectedObjects(
        x=x,
        y=y,
        flux=flux,
        flux_error=flux_error,
        half_light_radius=radius,
        fwhm=_measure_fwhm(data, segmentation, x, y, radius),
        a=a,
        b=b,
        theta=theta,
        peak=sep_objects["peak"].astype(np.float64),
        neighbour_distance=_neighbour_distance(x, y),
        flags=flags,
        segmentation=segmentation,
        background=background,
    )


def _measure_fwhm(
    data: np.ndarray, segmentation: np.ndarray, x: np.ndarray, y: np.ndarray, radius: np.ndarray
) -> np.ndarray:
    """Return the full widths at half maximum [pixel] of objects, with neighbours set to zero.

    `radius` are their half-light radii [pixel], NaN where unknown. NaN without a positive peak, and of an object that
    is wider than the largest stamp.
    """
    result = np.full(len(x), np.nan)
    choice = np.searchsorted(_FWHM_SIDES, _FWHM_RADII * np.nan_to_num(radius))
    for k, side in enumerate(_FWHM_SIDES):
        members = np.flatnonzero(choice == k)
        size = max(1, _FWHM_PIXELS // side**2)
        for i in range(0, len(members), size):
            batch = members[i : i + size]
            stamps = cut_out(data, x[batch], y[batch], side, 0.0)
            labels = cut_out(segmentation, x[batch], y[batch], side, 0)
            stamps[(labels != 0) & (labels != batch[:, None, None] + 1)] = 0.0
            result[batch] = fwhm(stamps, 1.0)
    return result


def _neighbour_distance(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the distance of each object to the nearest other one, infinite for a single one."""
    places = np.stack([x, y], axis=1)
    return KDTree(places).query(places, k=[2])[0][:, 0]
