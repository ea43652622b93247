"""Ellipticities, sizes and widths of star images from weighted moments.

Images are ``[y, x]`` with y up and pixel centres at integers; positions are counted from the centre of the stamp,
``((ny - 1)/2, (nx - 1)/2)``, x to the right. An ellipticity with e1 > 0 points along x, with e2 > 0 along the diagonal
x = y.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntFlag
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.launch import launch
from ..core.point_plots import draw_shapes
from ..core.result import Result
from ..core.threads import one_blas_thread
from ..core.units import ARCSEC, positive_angle, pure_numbers, real_numbers, require_positive
from .masked_moments import MaskedMoments, fill_by_moments
from .packet_kernels import LANES
from .pixel_masks import bad_pixels, weightless_pixels
from .shape_kernels import SHAPE, WEIGHT_ROWS, add_areas, measure_shape

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Most images of one call: more would take days.
_MOST_IMAGES = 10**8
# Rows and columns on which the spans of bright pixels begin and end.
_SPAN_STEP = 2
# Pixels of the finer grid that are worked on at once, as fit the cache.
_FINE_PIXELS = 1 << 17
_BATCH_PIXELS = 1 << 20  # 8 MB a work array: the memory used does not grow with the number of stars


class ShapeFlag(IntFlag):
    """Failures of a shape measurement; zero for a good one.

    ``CENTROID_LEFT_STAMP``: the centroid came nearer to an edge than the rms width of the weight (or half-way to it,
    where the weight is wider than that). ``NO_FLUX``: the weighted sum is not positive. ``MASKED``: pixels without
    weight hold more than half of the light under the weight of the moments, or above half of the maximum.
    ``NO_SOURCE``: the light does not fall off under the weight (a constant), or before the edge of the stamp (a slope).
    """

    OK = 0
    NOT_CONVERGED = 1
    NEGATIVE_MOMENTS = 2
    CENTROID_LEFT_STAMP = 4
    NO_FLUX = 8
    MASKED = 16
    NO_SOURCE = 32


@dataclass(frozen=True)
class Shapes(Result):
    """Shapes of n images, one array element each.

    Parameters
    ----------
    e1, e2 : array
        Ellipticity (a - b)/(a + b), along x and along the diagonal. NaN where flagged.
    size : array
        ``(Q11 Q22 - Q12^2)^(1/4)`` of the weighted moments [rad]: for a round Gaussian image of rms width s under a
        weight of rms width w it is s w / sqrt(s^2 + w^2), not s. NaN where flagged.
    flux : array
        Plain sum of the pixels, background subtracted and not weighted, in the units of the image.
    x, y : array
        Centroid from the centre of the stamp [pixel]. NaN where the iteration failed.
    flags : array of int
        :class:`ShapeFlag` bits.
    """

    _table = ("e1", "e2", "size", "flux", "x", "y", "flags")

    e1: np.ndarray
    e2: np.ndarray
    size: np.ndarray
    flux: np.ndarray
    x: np.ndarray
    y: np.ndarray
    flags: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the ellipticities in their plane, coloured by the size."""
        return draw_shapes(ax, self.e1, self.e2, self.size / ARCSEC, "weighted rms size [arcsec]")

    @property
    def usable(self) -> np.ndarray:
        """Images without a flag, [n] bool."""
        return self.flags == 0

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.flags)


@check_arguments
def measure_shapes(
    images: ArrayLike,
    pixel_scale: ArrayLike,
    weight_fwhm: ArrayLike,
    *,
    weights: ArrayLike | NDArray[np.bool_] | None = None,
    background: ArrayLike = 0.0,
    max_iterations: int = 50,
    tolerance: float = 1e-6,
    centers: ArrayLike | None = None,
) -> Shapes:
    r"""Measure ellipticities from weighted quadrupole moments (Jee & Tyson 2011, eq. 5).

    .. math:: Q_{ij} = \frac{\sum W I (\theta_i - \bar\theta_i)(\theta_j - \bar\theta_j)}{\sum W I},\qquad
              e = \frac{Q_{11} - Q_{22} + 2 i Q_{12}}{Q_{11} + Q_{22} + 2 \sqrt{Q_{11} Q_{22} - Q_{12}^2}}

    with a round Gaussian W centred on the centroid, which is iterated until the weighted first moment vanishes. The
    paper's eq. 6 prints Q12 where 2 Q12 belongs: its own orientation angle, and the (a - b)/(a + b) that it states,
    need the 2.

    The sums run over pixel centres. They stand for integrals as long as image times weight is well sampled: for a round
    Gaussian product of rms width s pixels the relative error is about 2 exp(-2 pi^2 s^2), 1e-4 at s = 0.7 and 1e-7 at
    s = 0.9. A 0.3" weight belongs on images with pixels of 0.1" or less, a 0.7" weight works on 0.2" pixels.

    Pixels without weight (not finite, -1e29 or less, or of weight zero) hold what the elliptical Gaussian of the same
    moments has there, and what the image exceeds it by at the opposite pixel; both are iterated
    (:func:`~pachon.measure.masked_moments.fill_by_moments`).

    Every image is measured on its own: splitting a batch changes no byte.

    Parameters
    ----------
    images : array
        [n, ny, nx], or one image [ny, nx].
    pixel_scale : float or Quantity
        Side of a pixel [rad].
    weight_fwhm : float or Quantity
        FWHM of the Gaussian weight [rad]: 0.3" for the optics alone, 0.7" with the atmosphere (Jee & Tyson 2011, sec.
        3).
    weights : array, optional
        Of the pixels, inverse variances or bool, [n, ny, nx], or [ny, nx] for all: zero and NaN for pixels to ignore.
        Positive ones are all alike.
    background : float or array
        Level to subtract, one for all or one per image.
    max_iterations : int
        Most centroid steps.
    tolerance : float
        The centroid has converged once a step is shorter than this [pixel]. Steps are Newton's, so the error after
        the last one is far smaller.
    centers : array, optional
        Where the steps start, x and y from the centres of the stamps [pixel], [n, 2]; there by default, and for NaN.
        Near the centroids this saves half of the steps; images with weightless pixels take no notice.

    Returns
    -------
    Shapes
        Arrays of length n, also for one image (n = 1).

    Raises
    ------
    DomainError
        If an argument has the wrong shape or is not positive, or weights are negative or zero everywhere.
    """
    stack = stamp_cube(images)
    scale = positive_angle(pixel_scale, "pixel_scale")
    sigma = positive_angle(weight_fwhm, "weight_fwhm") / np.sqrt(8.0 * np.log(2.0)) / scale
    if max_iterations < 1:
        raise DomainError(f"max_iterations = {max_iterations}: expected at least 1")
    tolerance = require_positive(tolerance, "tolerance", "pixels")
    count = len(stack)
    levels = pure_numbers(background, "background")
    try:
        level = np.broadcast_to(levels, (count,))
    except ValueError as error:
        raise DomainError(f"background has shape {np.shape(background)}: expected one value or {count}") from error
    starts = np.zeros((count, 2)) if centers is None else np.nan_to_num(pure_numbers(centers, "centers"))
    if starts.shape != (count, 2):
        raise DomainError(f"centers have shape {starts.shape}: expected ({count}, 2), x and y of each image")
    weightless = None if weights is None else weightless_pixels(stack, weights)
    batch = max(1, _BATCH_PIXELS // (stack.shape[1] * stack.shape[2]))
    parts = []
    for i in range(0, count, batch):
        pixels = np.array(stack[i : i + batch], dtype=np.float64, order="C")
        bad = bad_pixels(pixels) if weightless is None else weightless[i : i + batch]
        pixels -= level[i : i + batch, None, None]
        if bad.any():
            parts.append(_measure_masked(pixels, bad, scale, sigma, max_iterations, tolerance, starts[i : i + batch]))
        else:
            parts.append(_measure_batch(pixels, scale, sigma, max_iterations, tolerance, starts[i : i + batch]))
    if not parts:
        no_values = np.empty(0)
        return Shapes(no_values, no_values, no_values, no_values, no_values, no_values, np.empty(0, dtype=np.int32))
    if len(parts) == 1:
        return parts[0]
    return Shapes(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Shapes)})


def fwhm(images: ArrayLike, pixel_scale: ArrayLike, *, upsampling: int = 8) -> np.ndarray:
    """Measure the full width at half maximum of star images [rad], [n], pixel included.

    NaN without a positive maximum, and where a pixel has no weight (not finite, or -1e29 or less).
    Defined as the diameter of the circle with the area over which the image exceeds half its maximum. Image and maximum
    are those of the band-limited function through the pixels: Fourier interpolation on a grid finer by `upsampling`, a
    paraboloid through the highest node and its neighbours, and borders that count with the part of a fine pixel above
    half maximum. In a noisy image the maximum is biased upwards.

    Parameters
    ----------
    images : array
        [n, ny, nx], or one image [ny, nx]; background subtracted, nearly zero at the edges.
    pixel_scale : float or Quantity
        Side of a pixel [rad].
    """
    stack = stamp_cube(images)
    scale = positive_angle(pixel_scale, "pixel_scale")
    if upsampling < 2:
        raise DomainError(f"upsampling = {upsampling}: expected at least 2")
    result = np.full(len(stack), np.nan)
    measured = np.flatnonzero(~bad_pixels(stack).any(axis=(1, 2)))
    spans = _bright_spans(stack, measured)
    with one_blas_thread():
        for span in np.unique(spans, axis=0):
            of_span = measured[(spans == span).all(axis=1)]
            batch = max(1, _FINE_PIXELS // (upsampling**2 * int(np.prod(span[1::2] - span[::2]))))
            for i in range(0, len(of_span), batch):
                indices = of_span[i : i + batch]
                fine = _upsampled(stack[indices].astype(np.float64), span, upsampling)
                peak = _interpolated_peaks(fine)
                area = _areas_above(fine, 0.5 * peak)
                width = 2.0 * np.sqrt(area / np.pi) / upsampling * scale
                result[indices] = np.where(peak > 0.0, width, np.nan)
    return result


def half_light_radii(psfs: np.ndarray) -> np.ndarray:
    """Return half-light radii of images [n, m, m] about their middle pixel, from their growth curves [pixel]."""
    half = psfs.shape[1] // 2
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    order = np.argsort(np.hypot(x, y), axis=None, kind="stable")
    # A pixel more of area, a little more of radius: the radius of the disc that n pixels fill.
    radius = np.sqrt(np.arange(1, order.size + 1) / np.pi)
    growth = np.cumsum(psfs.reshape(len(psfs), -1)[:, order], axis=1, dtype=np.float64)
    rising = np.maximum.accumulate(growth / growth[:, -1:], axis=1)
    return np.array([np.interp(0.5, curve, radius) for curve in rising])


def _measure_batch(
    images: np.ndarray,
    scale: float,
    sigma: float,
    max_iterations: int,
    tolerance: float,
    starts: np.ndarray | None = None,
) -> Shapes:
    """Measure a batch of background-subtracted float64 images; sigma is the rms width of the weight in pixels.

    `starts` are where centroids are looked for first, [n, 2].
    """
    count, ny, nx = images.shape
    flags = np.zeros(count, dtype=np.int32)
    with np.errstate(invalid="ignore"):  # infinities of both signs
        flux = images.reshape(count, -1).sum(axis=1)
    flags[~np.isfinite(flux)] |= ShapeFlag.NO_FLUX
    results = np.full((count, SHAPE), np.nan)
    results[:, :2] = 0.0 if starts is None else starts
    pixels = np.zeros((count, ny, -(-nx // LANES) * LANES))
    pixels[:, :, :nx] = images
    pixels = pixels.reshape(count, ny, -1, LANES)
    options = [(nx - 1) / 2.0, (ny - 1) / 2.0, sigma, max_iterations, tolerance]
    work_space = np.empty((count, WEIGHT_ROWS, *pixels.shape[2:]))
    launch(measure_shape, count, [pixels, *options, work_space, results, flags], threads=1)
    centered = (flags & ~(ShapeFlag.NEGATIVE_MOMENTS | ShapeFlag.NO_SOURCE)) == 0
    results[~centered, :2] = np.nan
    endless = _rises_to_an_edge(images, np.flatnonzero(flags == 0), results[:, :2], sigma)
    flags[endless] = ShapeFlag.NO_SOURCE
    results[endless, 2:] = np.nan
    x, y, e1, e2, size = results.T.copy()
    return Shapes(e1, e2, size * scale, flux, x, y, flags)


def _measure_masked(
    images: np.ndarray,
    bad: np.ndarray,
    scale: float,
    sigma: float,
    max_iterations: int,
    tolerance: float,
    starts: np.ndarray,
) -> Shapes:
    """Measure a batch whose bad pixels, bool [n, ny, nx], have no weight; `starts` are those of the other images."""
    masked = np.flatnonzero(bad.any(axis=(1, 2)))
    starts = starts.copy()
    starts[masked] = 0.0

    def moments(filled: np.ndarray) -> MaskedMoments:
        shapes = _measure_batch(filled, scale, sigma, max_iterations, tolerance)
        return MaskedMoments(shapes.x, shapes.y, shapes.e1, shapes.e2, shapes.size / scale)

    images[masked], lost = fill_by_moments(images[masked], bad[masked], moments, sigma)
    shapes = _measure_batch(images, scale, sigma, max_iterations, tolerance, starts)
    lost_stars = masked[lost]
    shapes.flags[lost_stars] |= ShapeFlag.MASKED
    for values in (shapes.e1, shapes.e2, shapes.size, shapes.x, shapes.y):
        values[lost_stars] = np.nan
    return shapes


def _rises_to_an_edge(images: np.ndarray, measured: np.ndarray, centers: np.ndarray, sigma: float) -> np.ndarray:
    """Return the measured images that are brighter at an edge within two rms widths of the weight than under it."""
    reach = 2.0 * sigma
    half = 0.5 * np.array([images.shape[2] - 1.0, images.shape[1] - 1.0])
    near_edges = measured[(np.abs(centers[measured]) > half - reach).any(axis=1)]
    rises = np.zeros(len(near_edges), dtype=bool)
    for i, image_index in enumerate(near_edges):
        offsets = [np.arange(2.0 * h + 1.0) - h - c for h, c in zip(half, centers[image_index], strict=True)]
        weights = [np.exp(-0.5 * (offset / sigma) ** 2) for offset in offsets]
        weight_x, weight_y = (weight / weight.sum() for weight in weights)
        image = images[image_index]
        columns, rows = weight_y @ image, image @ weight_x
        mean = columns @ weight_x
        for line, offset in ((columns, offsets[0]), (rows, offsets[1])):
            rises[i] |= any(abs(offset[end]) < reach and line[end] > mean for end in (0, -1))
    return np.asarray(near_edges[rises])


@lru_cache(maxsize=8)
def _sinc_matrix(count: int, factor: int) -> np.ndarray:
    """Return the matrix of the band-limited function through `count` pixels at steps of 1/factor, from pixel 0 on.

    Shape [count factor, count]: the periodic sinc, whose highest frequency stands for both its signs if count is even.
    """
    turn = np.pi * (np.arange(count * factor)[:, None] / factor - np.arange(count)) / count
    below = np.tan(turn) if count % 2 == 0 else np.sin(turn)
    on_pixel = np.abs(np.sin(turn)) < 1e-12
    return np.where(on_pixel, 1.0, np.sin(count * turn) / (count * np.where(on_pixel, 1.0, below)))


def _bright_spans(images: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return first and end row, first and end column about the pixels above a quarter of the maximum, [n_chosen, 4].

    They begin and end on multiples of :data:`_SPAN_STEP`, or at the edges, so that many images have the same.
    """
    bounds = []
    bright = images[chosen] > 0.25 * images[chosen].max(axis=(1, 2), keepdims=True)
    bright |= ~bright.any(axis=(1, 2), keepdims=True)  # all pixels are negative
    for axis in (2, 1):
        lit, count = bright.any(axis=axis), images.shape[3 - axis]
        first, last = lit.argmax(axis=1), count - 1 - lit[:, ::-1].argmax(axis=1)
        bounds.append(np.maximum((first - 1) // _SPAN_STEP * _SPAN_STEP, 0))
        bounds.append(np.minimum(-(-(last + 2) // _SPAN_STEP) * _SPAN_STEP, count))
    return np.stack(bounds, axis=1)


def _upsampled(images: np.ndarray, span: np.ndarray, factor: int) -> np.ndarray:
    """Return the band-limited images [n, ny, nx] on a grid `factor` times finer, on a span of rows and columns."""
    rows, columns = (slice(first * factor, end * factor) for first, end in span.reshape(2, 2).tolist())
    ny, nx = images.shape[1:]
    return np.asarray(_sinc_matrix(ny, factor)[rows] @ images @ _sinc_matrix(nx, factor)[columns].T)


def _interpolated_peaks(fine: np.ndarray) -> np.ndarray:
    """Return the maxima [n] of the paraboloids through the highest pixel of images and its neighbours."""
    n, ny, nx = fine.shape
    each = np.arange(n)
    j, i = np.divmod(fine.reshape(n, -1).argmax(axis=1), nx)
    value = fine[each, j, i]
    peak = value.copy()
    for before, after in (
        (fine[each, j, i - 1], fine[each, j, (i + 1) % nx]),
        (fine[each, j - 1, i], fine[each, (j + 1) % ny, i]),
    ):
        curvature = before + after - 2.0 * value
        curved = curvature < 0.0
        peak -= np.where(curved, (after - before) ** 2 / (8.0 * np.where(curved, curvature, 1.0)), 0.0)
    return peak


def _areas_above(fine: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Return the areas of images above levels [n], in pixels; border pixels count in part, as if planes there."""
    areas = np.empty(len(fine))
    launch(add_areas, len(fine), [fine, levels, areas], threads=1)
    return areas


def stamp_cube(images: ArrayLike) -> np.ndarray:
    """Return the images as an array [n, ny, nx]."""
    numbers = real_numbers(images)
    array = np.empty(0) if numbers is None or hasattr(numbers, "unit") else np.asarray(numbers)
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or min(array.shape[1:]) < 3 or array.dtype.kind not in "iufb":
        raise DomainError(
            f"images have shape {np.shape(images)} and type {array.dtype}: "
            "expected real numbers [n, ny, nx] or [ny, nx], at least 3 x 3"
        )
    if len(array) > _MOST_IMAGES:
        raise DomainError(f"images have shape {array.shape}: expected at most {_MOST_IMAGES} of them")
    return array
