"""Selection of stars without neighbours, cosmic rays and saturated cores."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft, ndimage

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.units import pure_numbers, real_array
from .masked_moments import MOST_MASKED
from .pixel_masks import bad_pixels, fill_symmetric

# Standard deviation of the PSF within a CCD, as a fraction of the geometric mean of the pixel's value and the peak's.
_PSF_CHANGE = 0.05
# A pixel is sharper than a star can be if it holds so many times more of the light around it than a star's peak does.
_SHARPER = 1.5
# Pixels between these fractions of the median star's peak give a star's scale whether or not its core is saturated.
_WINGS = (0.05, 0.35)
# Fraction of the median star's peak above which pixels are the core of a star.
_CORE = 0.6
# Least fraction of its light that a saturated core lacks: a width that differs by 2.5 % takes 0.08 from it.
_LOSS = 0.2
# Fewest usable stars, for a median to compare with.
_FEWEST = 3
# Light of a neighbour over the noise of a pixel from which on the pixel is masked.
_FAINT = 0.2
# Standard deviations of the mean of 3 x 3 pixels above which they belong to the neighbour that they are connected with.
_CONNECTED = 2.0
# Most neighbours of a star.
_MOST_NEIGHBOURS = 30


class StarFlag(IntFlag):
    """Defects of a star; zero for a good one.

    ``UNUSABLE``: there is no light to scale the median star to. ``MASKED``: masked pixels hold more than half of the
    core, or in :func:`~pachon.fit_own_stars` of the weighted light.
    """

    GOOD = 0
    NEIGHBOUR = 1
    COSMIC_RAY = 2
    SATURATED = 4
    UNUSABLE = 8
    MASKED = 16


@dataclass(frozen=True, eq=False)
class Selection:
    """Defects detected in n stars."""

    flags: np.ndarray  #: :class:`StarFlag` bits, [n]
    #: Pixels of cosmic rays, of neighbours and saturated ones, [n, ny, nx] bool: a star may stay, masked, where they
    #: leave enough of its core.
    masks: np.ndarray

    @property
    def good(self) -> np.ndarray:
        """Stars without defects, [n] bool."""
        return self.flags == 0

    def keep(self, least: int = 1) -> np.ndarray:
        """Return :attr:`good`, if that leaves enough stars.

        Raises
        ------
        DomainError
            If fewer than `least` are good, with the number of stars of each defect.
        """
        require_stars(self.good, self.flags, least)
        return self.good


def require_stars(good: np.ndarray, flags: np.ndarray, least: int, reason: str = "") -> None:
    """Raise DomainError, with the number of stars of each defect and a further reason, if fewer are good."""
    good_count = int(good.sum())
    if good_count < least:
        defect_text = ", ".join(text for text in (_defect_counts(flags), reason) if text)
        counts = f" ({defect_text})" if defect_text else ""
        raise DomainError(f"{good_count} of {len(good)} stars left{counts}: expected at least {least}")


def _defect_counts(flags: np.ndarray) -> str:
    """Return how many stars have each flag, in words: ``3 neighbour, 1 cosmic ray``."""
    return ", ".join(
        f"{int(((flags & flag) > 0).sum())} {str(flag.name).lower().replace('_', ' ')}"
        for flag in StarFlag
        if flag and (flags & flag).any()
    )


@check_arguments
def flag_stars(
    stamps: ArrayLike, noise: ArrayLike, *, gain: float = 1.0, saturation: float | None = None, threshold: float = 6.0
) -> Selection:
    """Flag stars with neighbours, cosmic rays and saturated cores by comparison with the median star.

    The residual of a star is its stamp less the median star scaled to its wings. It is compared with the noise, the
    photon noise of the star and an allowance for the variation of the PSF over a CCD. A *cosmic ray* is a pixel that
    holds more of the residual in the 3 x 3 pixels around it than the peak of a star could. A *neighbour* is a place
    where the residual, without cosmic rays, matches a star (matched filter); in the core of a bright star the allowance
    hides those that only stretch it. A *saturated* core lacks a fifth of the light that the wings promise, or reaches
    the given level, which finds far more of them. The masks of neighbours hold the pixels in which their light, by the
    median star at their place and by what is connected above the noise, exceeds a fifth of the noise. Pixels without
    weight (NaN, -1e29 or less) are left out.

    Parameters
    ----------
    stamps : array
        [n, ny, nx] background-subtracted stars centred to a pixel or better, of any flux; most of them good. NaN for
        pixels without weight, as of :func:`~.stamps.center_stamps`.
    noise : float or array
        rms noise of a pixel without light, one for all or [n], in the unit of the stamps.
    gain : float
        Electrons per unit of the stamps.
    saturation : float, optional
        Level from which on a pixel is saturated.
    threshold : float
        Least significance of a defect [standard deviations].

    Returns
    -------
    Selection
        Flags and masks.

    Raises
    ------
    DomainError
        If an argument has the wrong shape or is not positive, or fewer than three stars can be compared.
    """
    images = _stamp_cube(stamps)
    count = len(images)
    noises = pure_numbers(noise, "noise")
    try:
        rms = np.broadcast_to(noises, (count,))
    except (TypeError, ValueError) as error:
        raise DomainError(f"noise = {noise!r}: expected one number or {count}") from error
    for name, value in (("noise", rms), ("gain", gain), ("threshold", threshold), ("saturation", saturation)):
        if value is not None and not (np.all(np.isfinite(value)) and np.all(np.asarray(value) > 0.0)):
            raise DomainError(f"{name} = {value}: expected positive finite numbers")
    flags = np.zeros(count, dtype=np.int32)
    masks = np.zeros(images.shape, dtype=bool)
    bad = bad_pixels(images)
    if bad.any():
        images = fill_symmetric(images, bad)
    total = images.sum(axis=(1, 2))
    usable = np.isfinite(total) & (total > 0.0)
    flags[~usable] = StarFlag.UNUSABLE
    if usable.sum() < _FEWEST:
        raise DomainError(f"{int(usable.sum())} of {count} stars are usable: expected at least {_FEWEST} to compare")
    star = _median_star(images[usable])
    peak = star.max()
    wings, core = (star > _WINGS[0] * peak) & (star < _WINGS[1] * peak), star > _CORE * peak
    block = ndimage.uniform_filter(star, 3, mode="constant") * 9.0
    fraction = min(_SHARPER * peak / block[np.unravel_index(star.argmax(), star.shape)], 0.9)
    allowance = _PSF_CHANGE * np.sqrt(np.maximum(star, 0.0) * peak)
    scales = _scales(images[:, wings], star[wings], bad[:, wings])
    if bad.any():
        flags[usable & (bad[:, core].mean(axis=1) > MOST_MASKED)] = StarFlag.MASKED
        usable &= flags == 0
        images = np.where(bad, np.nan_to_num(scales)[:, None, None] * star, images)
    flags[usable & ~(scales > 0.0)] = StarFlag.UNUSABLE
    usable &= scales > 0.0
    lack = 1.0 - images[:, core].sum(axis=1) / (scales * star[core].sum())
    for i in np.flatnonzero(usable):
        flux = scales[i]
        residual = images[i] - flux * star
        photons = rms[i] ** 2 + np.maximum(flux * star, 0.0) / gain
        variance = photons + (flux * allowance) ** 2
        if saturation is not None:
            masks[i] = images[i] >= saturation
        unsure = np.hypot(
            np.sqrt(photons[core].sum()) / (flux * star[core].sum()), _scale_error(photons, star, wings) / flux
        )
        if masks[i].any() or lack[i] > max(_LOSS, threshold * unsure):
            flags[i] |= StarFlag.SATURATED
            masks[i] |= core
            continue  # whatever else its residual shows is the lost core
        struck = _sharp_pixels(residual, variance, fraction, threshold)
        if struck.any():
            flags[i] |= StarFlag.COSMIC_RAY
            masks[i] = struck
            residual = np.where(struck, 0.0, residual)
        neighbours = _neighbour_pixels(residual, variance, photons, star, threshold)
        if neighbours is not None:
            flags[i] |= StarFlag.NEIGHBOUR
            masks[i] |= neighbours
    return Selection(flags, masks)


def _median_star(images: np.ndarray) -> np.ndarray:
    """Return the median of the stars scaled to their own bright pixels, of unit sum."""
    star = np.median(images / images.sum(axis=(1, 2), keepdims=True), axis=0)
    bright = star > 0.2 * star.max()
    scale = np.median(images[:, bright] / star[bright], axis=1)
    good = scale > 0.0
    star = np.median(images[good] / scale[good, None, None], axis=0)
    return star / star.sum()


def _scale_error(variance: np.ndarray, star: np.ndarray, wings: np.ndarray) -> float:
    """Return the error of the median of pixel over star in the wings: that of the mean times sqrt(pi/2)."""
    return float(np.sqrt(0.5 * np.pi * (variance[wings] / star[wings] ** 2).mean() / wings.sum()))


def _sharp_pixels(residual: np.ndarray, variance: np.ndarray, fraction: float, threshold: float) -> np.ndarray:
    """Return the pixels of cosmic rays: sharp ones, and bright ones beside them."""
    neighbourhood = np.ones((3, 3))
    around = ndimage.convolve(
        residual, neighbourhood, mode="nearest"
    )  # extended beyond the edge, which is no sharp pixel
    around_variance = ndimage.convolve(variance, neighbourhood, mode="nearest")
    excess = residual - fraction * around
    error = np.sqrt((1.0 - 2.0 * fraction) * variance + fraction**2 * around_variance)
    sharp = excess > threshold * error
    if not sharp.any():
        return sharp
    bright = residual > 0.5 * threshold * np.sqrt(variance)
    return sharp | ndimage.binary_dilation(sharp, neighbourhood, iterations=-1, mask=bright | sharp)


def _scales(wings: np.ndarray, star: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return the median ratio of the stars' pixels [n, n_wings] to the median star's; NaN where all are bad."""
    ratios = wings / star
    if not bad.any():
        return np.asarray(np.median(ratios, axis=1))
    ratios[bad] = np.nan
    scales, some_good = np.full(len(wings), np.nan), ~bad.all(axis=1)
    scales[some_good] = np.nanmedian(ratios[some_good], axis=1)
    return scales


def _neighbour_pixels(
    residual: np.ndarray, variance: np.ndarray, photons: np.ndarray, star: np.ndarray, threshold: float
) -> np.ndarray | None:
    """Return the pixels of neighbours [ny, nx] bool, one after the other by significance; None without any.

    `variance` has the allowance for the PSF's variation in it, `photons` noise alone.
    """
    peak = np.unravel_index(star.argmax(), star.shape)
    squares, norm = _correlate(variance, star**2, peak), _correlate(np.ones(star.shape), star**2, peak)
    rms, neighbours = np.sqrt(photons), np.zeros(star.shape, dtype=bool)
    remaining, scaled_again = residual, False
    for _ in range(_MOST_NEIGHBOURS):
        light = _correlate(remaining, star, peak)
        significance = light / np.sqrt(squares)
        place = np.unravel_index(significance.argmax(), star.shape)
        if not significance[place] > threshold:
            break
        if star[place] > _CORE * star.max() and not scaled_again:
            # Light in the star's own place may be its own: the scale by the wings of a faint star has an error.
            residual = residual - star * (residual * star / photons).sum() / (star**2 / photons).sum()
            remaining, scaled_again = np.where(neighbours, 0.0, residual), True
            continue
        step = tuple(int(at - middle) for at, middle in zip(place, peak, strict=True))
        profile = ndimage.shift(star, step, order=0, mode="constant", prefilter=False)
        pixels = light[place] / norm[place] * profile > _FAINT * rms
        # What is wider than a star: pixels above the noise, smoothed, that are connected with it.
        above = ndimage.uniform_filter(remaining, 3, mode="constant") > _CONNECTED / 3.0 * np.sqrt(variance)
        labels, _ = ndimage.label(above)
        if labels[place]:
            pixels |= labels == labels[place]
        pixels[place] = True
        neighbours |= pixels
        remaining = np.where(neighbours, 0.0, residual)
    return neighbours if neighbours.any() else None


def _correlate(image: np.ndarray, star: np.ndarray, peak: tuple[np.intp, ...]) -> np.ndarray:
    """Return sums over pixels of image times a star of the same shape whose peak stands on each pixel."""
    full = tuple(fft.next_fast_len(2 * n - 1, real=True) for n in image.shape)
    product = fft.irfft2(fft.rfft2(image, full) * fft.rfft2(star[::-1, ::-1], full), full)
    rows, columns = (slice(n - 1 - int(at), 2 * n - 1 - int(at)) for n, at in zip(image.shape, peak, strict=True))
    return np.asarray(product[rows, columns])


def _stamp_cube(stamps: ArrayLike) -> np.ndarray:
    """Return the stamps as float64 [n, ny, nx]."""
    images = real_array(stamps, "stamps: expected real numbers [n, ny, nx]")
    if images.ndim != 3 or min(images.shape[1:]) < 5:
        raise DomainError(f"stamps have shape {images.shape}: expected [n, ny, nx], at least 5 x 5 pixels")
    return images
