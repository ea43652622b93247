"""Star stamps: photon and read noise on PSF images, and sub-pixel centring."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.threads import one_blas_thread
from ..core.units import pure_numbers, real_array
from .pixel_masks import fill_symmetric, weightless_pixels


def observe_stamps(
    psf_images: ArrayLike,
    electrons: float | np.ndarray,
    sky: float,
    read_noise: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Expose noise-free PSF images: Poisson noise of star and sky, Gaussian read noise, expected sky subtracted.

    Stars are drawn one after the other from the same stream, so the first n stay as they are when more follow. Pixels
    below zero, from Fourier ringing, count as zero in the Poisson mean of star and sky if they outweigh the sky.

    Parameters
    ----------
    psf_images : array
        [n, ny, nx] images of unit sum.
    electrons : float or array
        Electrons of each star, one for all or [n].
    sky, read_noise : float
        Expected electrons of the sky, and rms noise without light [e-], in one pixel.
    rng : numpy.random.Generator
        Random stream.

    Returns
    -------
    array
        [n, ny, nx] electrons.

    Raises
    ------
    DomainError
        If an argument is negative, not finite or of the wrong shape.
    """
    images = _stamp_cube(psf_images, "psf_images")
    finite = np.isfinite(images).all(axis=(1, 2))
    if not finite.all():
        raise DomainError(f"psf_images[{finite.argmin()}] has pixels that are not finite")
    try:
        counts = np.broadcast_to(np.asarray(electrons, dtype=np.float64), (len(images),))
    except ValueError as error:
        raise DomainError(f"electrons has shape {np.shape(electrons)}: expected one value or {len(images)}") from error
    if not (np.all(np.isfinite(counts)) and np.all(counts >= 0.0)):
        raise DomainError(f"electrons = {electrons}: expected numbers that are not negative")
    for name, value in (("sky", sky), ("read_noise", read_noise)):
        if not (np.isfinite(value) and value >= 0.0):
            raise DomainError(f"{name} = {value}: expected a number of electrons that is not negative")
    result = np.empty(images.shape)
    for i, image in enumerate(images):
        light = rng.poisson(np.maximum(counts[i] * image + sky, 0.0))
        result[i] = light - sky + rng.normal(0.0, read_noise, image.shape)
    return result


# Area of a masked pixel that must fall on another one to mask it, too: it holds a tenth of the value filled in.
_OVERLAP = 0.1
# Images that are shifted at once: the memory used does not grow with their number.
_SHIFTED_TOGETHER = 128


@check_arguments
def center_stamps(
    images: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    size: int = 31,
    *,
    normalize: bool = True,
    weights: ArrayLike | NDArray[np.bool_] | None = None,
) -> np.ndarray:
    """Shift stars so that their centroid falls on the centre of a pixel, and cut stamps around it.

    The shift multiplies the Fourier transform by a phase: exact for a band-limited image, and it leaves white noise
    white. Light that crosses an edge comes in at the opposite one, so images should be larger than the stamps by a few
    pixels, or dark at their edges.

    Pixels without weight (not finite, -1e29 or less, or of weight zero) are shifted with the value of the pixel
    opposite the centroid, or the mean of good neighbours; pixels of the stamp that they overlap by a tenth or more are
    NaN, which :func:`~.shapes.measure_shapes`, :func:`~.star_selection.flag_stars` and :meth:`pachon.PsfModel.fit`
    ignore.

    Parameters
    ----------
    images : array
        [n, ny, nx], or one image [ny, nx].
    x, y : float or array
        Centroids from the centre of the image, ``((ny - 1)/2, (nx - 1)/2)``, in pixels, as
        :func:`~pachon.measure.shapes.measure_shapes` gives them.
    size : int
        Pixels along one side of the stamp, odd.
    normalize : bool
        Whether to divide every stamp by its sum, that of stand-ins for weightless pixels included.
    weights : array, optional
        Of the pixels, inverse variances or bool, [n, ny, nx], or [ny, nx] for all: zero and NaN for pixels to ignore.

    Returns
    -------
    array
        [n, size, size]. NaN in pixels without weight. All NaN for an image whose centroid is NaN or whose stamp has no
        positive sum.

    Raises
    ------
    DomainError
        If the size is not odd, the image is smaller than the stamp, or weights are negative or zero everywhere.
    """
    stack = _stamp_cube(images, "images")
    count, ny, nx = stack.shape
    if size < 1 or size % 2 == 0:
        raise DomainError(f"size = {size}: expected an odd number of pixels")
    if size > min(ny, nx):
        raise DomainError(f"size = {size}: expected at most {min(ny, nx)}, the size of the images")
    centroids = [pure_numbers(v, name) for v, name in ((x, "x"), (y, "y"))]
    try:
        offsets = np.stack([np.broadcast_to(values, (count,)) for values in centroids], axis=1)
    except ValueError as error:
        raise DomainError(f"x and y have shapes {np.shape(x)} and {np.shape(y)}: expected {count} centroids") from error
    bad = weightless_pixels(stack, weights)
    masked = bad.any(axis=(1, 2))
    if masked.any():
        stack = fill_symmetric(stack, bad, offsets[:, 0], offsets[:, 1])
    result = shift_to_middle(stack, offsets, size)
    if normalize:
        result = with_unit_sum(result)
    if masked.any():
        result[masked] = np.where(
            center_masks(bad[masked], offsets[masked, 0], offsets[masked, 1], size), np.nan, result[masked]
        )
    return result


def with_unit_sum(stamps: np.ndarray) -> np.ndarray:
    """Return stamps [n, ny, nx] over their sums; all NaN where that is not positive."""
    total = stamps.reshape(len(stamps), stamps.shape[1] * stamps.shape[2]).sum(axis=1)
    return np.asarray(stamps / np.where(total > 0.0, total, np.nan)[:, None, None])


def shift_to_middle(images: np.ndarray, offsets: np.ndarray, size: int) -> np.ndarray:
    """Return stamps of finite images as of :func:`center_stamps`, [n, size, size]; NaN where the offset is.

    `offsets` [n, 2] are x and y from the centre of the image.
    """
    ny, nx = images.shape[1:]
    rows, columns = _middle_pixels(size, (ny, nx))
    middle = np.array([nx // 2 - (nx - 1) / 2.0, ny // 2 - (ny - 1) / 2.0])
    stamps = np.full((len(images), size, size), np.nan)
    placed = np.flatnonzero(np.isfinite(offsets).all(axis=1))
    for first in range(0, len(placed), _SHIFTED_TOGETHER):
        indices = placed[first : first + _SHIFTED_TOGETHER]
        dx, dy = (middle - offsets[indices]).T
        stamps[indices] = fourier_shifts(images[indices], dx, dy, rows, columns)
    return stamps


def center_masks(masks: np.ndarray, x: np.ndarray, y: np.ndarray, size: int) -> np.ndarray:
    """Return masks [n, ny, nx] as :func:`center_stamps` moves and cuts their stamps, bool [n, size, size].

    A centroid that is NaN counts as the centre.
    """
    ny, nx = masks.shape[1:]
    rows, columns = _middle_pixels(size, (ny, nx))
    shifts = np.array([nx // 2 - (nx - 1) / 2.0, ny // 2 - (ny - 1) / 2.0]) - np.nan_to_num(np.stack([x, y], axis=1))
    return shift_masks(masks, *shifts.T)[:, rows, columns]


def decenter_masks(masks: np.ndarray, x: np.ndarray, y: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return masks of centred stamps [n, size, size] on the images of a shape (ny, nx) they were cut from.

    The inverse of :func:`center_masks`: bool [n, ny, nx]. Beyond the stamps masks are those at their edge: a neighbour
    whose peak is there would ring through the whole stamp when it is shifted.
    """
    middle = _middle_pixels(masks.shape[1], shape)
    shifts = np.nan_to_num(np.stack([x, y], axis=1)) - np.array([n // 2 - (n - 1) / 2.0 for n in shape[::-1]])
    reach = int(np.ceil(np.abs(shifts).max(initial=0.0))) + 1  # from beyond the images
    rims = [(reach + lines.start, reach + count - lines.stop) for lines, count in zip(middle, shape, strict=True)]
    moved = shift_masks(np.pad(masks, [(0, 0), *rims], mode="edge"), *shifts.T)
    return moved[:, reach:-reach, reach:-reach]


def shift_masks(masks: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
    """Return the pixels that masks [n, ny, nx] overlap by a tenth of a pixel or more, moved by dx and dy [n].

    Pixels into which a part of the outside moves are not masked.
    """
    pixels = np.flatnonzero(masks)
    star, place = np.divmod(pixels, masks[0].size)
    row, column = np.divmod(place, masks.shape[2])
    (rows, row_parts), (columns, column_parts) = (
        _overlaps(pixel, shift[star], count)
        for pixel, shift, count in zip((row, column), (dy, dx), masks.shape[1:], strict=True)
    )
    overlapped = ((star * masks.shape[1] + rows[:, None]) * masks.shape[2] + columns).ravel()
    overlap = np.bincount(overlapped, (row_parts[:, None] * column_parts).ravel(), masks.size)
    return np.asarray(overlap > _OVERLAP).reshape(masks.shape)


def _overlaps(pixels: np.ndarray, shifts: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the two pixels of a line of `count` that each of pixels [n] overlaps, moved by shifts [n], and how far.

    Both are [2, n]. Pixels beyond the line are its first with a part of zero.
    """
    low = np.floor(pixels + shifts).astype(int)
    part = pixels + shifts - low
    places = np.stack([low, low + 1])
    inside = (places - shifts >= 0.0) & (places - shifts <= count - 1) & (places >= 0) & (places < count)
    return places * inside, np.stack([1.0 - part, part]) * inside


def _middle_pixels(size: int, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Return rows and columns of a stamp of odd size in an image of a shape (ny, nx).

    Its middle is pixel (ny // 2, nx // 2): the central one, or the one after the centre of an even image.
    """
    first = [n // 2 - size // 2 for n in shape]
    return slice(first[0], first[0] + size), slice(first[1], first[1] + size)


def fourier_shift(image: np.ndarray, dx: float, dy: float) -> np.ndarray:
    """Return the band-limited image moved by (dx, dy) pixels.

    The highest frequency of an even grid stands for both its signs, so its phase is the mean of the two, a cosine.
    """
    ny, nx = image.shape
    phase_x = np.exp(-2j * np.pi * fft.rfftfreq(nx) * dx)
    phase_y = np.exp(-2j * np.pi * fft.fftfreq(ny) * dy)
    if nx % 2 == 0:
        phase_x[-1] = np.cos(np.pi * dx)
    if ny % 2 == 0:
        phase_y[ny // 2] = np.cos(np.pi * dy)
    return fft.irfft2(fft.rfft2(image) * phase_y[:, None] * phase_x, s=(ny, nx))


def fourier_shifts(
    images: np.ndarray,
    dx: np.ndarray,
    dy: np.ndarray,
    rows: slice = slice(None),
    columns: slice = slice(None),
) -> np.ndarray:
    """Return rows and columns of images each moved as by :func:`fourier_shift`, dx and dy [n].

    `images` are [n, ny, nx], or one [ny, nx] that is moved to n places. The sums with periodic sincs along both axes
    are a fraction of the work of a transform of a small image.
    """
    (ny, nx), count = images.shape[-2:], len(dx)
    if (ny, rows) == (nx, columns):
        along_both = _shift_matrices(ny, np.concatenate([dy, dx]), rows)
        along_y, along_x = along_both[:count], along_both[count:]
    else:
        along_y, along_x = _shift_matrices(ny, dy, rows), _shift_matrices(nx, dx, columns)
    with one_blas_thread():
        return np.asarray(along_y @ images @ along_x.transpose(0, 2, 1))


def _shift_matrices(count: int, shifts: np.ndarray, lines: slice) -> np.ndarray:
    """Return matrices that move a line of pixels by each of shifts [n], with the rows of some lines of the result.

    [n, n_lines, count]. The highest frequency of an even number of pixels stands for both its signs.
    """
    whole = np.rint(shifts)
    part = (shifts - whole)[:, None]
    steps, signs, differences = _line_steps(count)
    turn = np.pi * (steps - part) / count
    sine = np.sin(turn)
    below = count * (sine if count % 2 else np.tan(turn))
    sinc = np.divide(np.sin(np.pi * part) * signs, below, out=np.ones(turn.shape), where=np.abs(sine) >= 1e-12)
    # The pixel at `to` gets that at `of` times the periodic sinc of to - of less the shift.
    around = (differences - (whole % count).astype(int)[:, None]) % count
    line = sinc[np.arange(len(shifts))[:, None], around][:, count - 1 :]
    strides = (*line.strides, -line.strides[1])
    to_of = np.lib.stride_tricks.as_strided(line, (len(shifts), count, count), strides, writeable=False)
    return np.ascontiguousarray(to_of[:, lines])


@lru_cache(maxsize=8)
def _line_steps(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return periodic steps along a line of pixels [count], the signs of the sinc there, and differences of pixels."""
    steps = np.arange(count)
    steps[steps > count // 2] -= count
    return steps, 2.0 * (steps % 2) - 1.0, np.arange(1 - count, count)


def _stamp_cube(images: ArrayLike, name: str) -> np.ndarray:
    """Return the images as a float64 array [n, ny, nx]."""
    array = real_array(images, f"{name}: expected real numbers [n, ny, nx]")
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3:
        raise DomainError(f"{name} has shape {array.shape}: expected [n, ny, nx] or [ny, nx]")
    return array
