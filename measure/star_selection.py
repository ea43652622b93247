"""Selection of stars without neighbours, cosmic rays and saturated cores."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntFlag

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft, ndimage

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.number_text import counted
from ..core.statistics import median_image, row_medians
from ..core.units import pure_numbers, real_array
from .masked_moments import MOST_MASKED
from .pixel_masks import bad_pixels, fill_symmetric
from .star_flux import with_unit_flux

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
    core, or in :func:`~pachon.fit_own_stars` of the weighted light. ``FLAGGED_IN_CATALOGUE``: left out by ``pachon
    model`` for its FLAGS.
    """

    GOOD = 0
    NEIGHBOUR = 1
    COSMIC_RAY = 2
    SATURATED = 4
    UNUSABLE = 8
    MASKED = 16
    FLAGGED_IN_CATALOGUE = 32


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
        raise DomainError(f"{good_count} of {counted(len(good), 'star')} left{counts}: expected at least {least}")


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
    # The sum over a wide stamp of a faint star may be nothing.
    unit_stars, flux = with_unit_flux(images)
    usable = flux > 0.0
    flags[~usable] = StarFlag.UNUSABLE
    if usable.sum() < _FEWEST:
        stars = counted(count, "star is", "stars are")
        raise DomainError(f"{int(usable.sum())} of {stars} usable: expected at least {_FEWEST} to compare")
    star = _median_star(unit_stars[usable])
    peak = star.max()
    wings, core = (star > _WINGS[0] * peak) & (star < _WINGS[1] * peak), star > _CORE * peak
    if not wings.any():
        raise DomainError("stamps: the median star has no wings; expected stars that fade towards the edges of stamps")
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
    usable_indices = np.flatnonzero(usable)
    light = scales[usable, None, None] * star
    residuals = images[usable] - light
    fluxes, sky_variances, photons = scales[usable], rms[usable] ** 2, np.maximum(star, 0.0) / gain
    photon_variances = sky_variances[:, None, None] + fluxes[:, None, None] * photons
    variances = photon_variances + (fluxes[:, None, None] * allowance) ** 2
    sharp_pixels = _sharp_pixels(residuals, variances, fraction, threshold)
    matched_filter = MatchedFilter.of(star)
    core_error = np.sqrt(photon_variances[:, core].sum(axis=1)) / (fluxes * star[core].sum())
    unsure = np.hypot(core_error, _scale_errors(photon_variances[:, wings], star[wings]) / fluxes)
    saturated = lack[usable] > np.maximum(_LOSS, threshold * unsure)
    if saturation is not None:
        masks[usable] = images[usable] >= saturation
        saturated |= masks[usable].any(axis=(1, 2))
    flags[usable_indices[saturated]] |= StarFlag.SATURATED
    masks[usable_indices[saturated]] |= core
    # Whatever else the residual of a saturated star shows is the lost core.
    compared = np.flatnonzero(~saturated)
    hit = sharp_pixels[compared].any(axis=(1, 2))
    flags[usable_indices[compared[hit]]] |= StarFlag.COSMIC_RAY
    masks[usable_indices[compared]] = sharp_pixels[compared]
    residuals = np.where(sharp_pixels, 0.0, residuals)
    light = matched_filter.light(residuals[compared])
    # The variances are sums of three images.
    of_photons, of_allowance = matched_filter.squares(np.stack([photons, allowance**2]))
    flux = fluxes[compared, None, None]
    squares = sky_variances[compared, None, None] * matched_filter.norm + flux * of_photons + flux**2 * of_allowance
    significant = (light / np.sqrt(squares)).max(axis=(1, 2), initial=0.0) > threshold
    for place, of_variance in zip(compared[significant], squares[significant], strict=True):
        neighbours = _neighbour_pixels(
            residuals[place], variances[place], of_variance, photon_variances[place], matched_filter, threshold
        )
        if neighbours is not None:
            flags[usable_indices[place]] |= StarFlag.NEIGHBOUR
            masks[usable_indices[place]] |= neighbours
    return Selection(flags, masks)


def _median_star(images: np.ndarray) -> np.ndarray:
    """Return the median of stars of unit flux scaled to their own bright pixels, of unit sum."""
    star = median_image(images)
    bright = star > 0.2 * star.max()
    scale = row_medians(images[:, bright] / star[bright])
    good = scale > 0.0
    star = median_image(images[good] / scale[good, None, None])
    return star / star.sum()


def _scale_errors(variances: np.ndarray, star: np.ndarray) -> np.ndarray:
    """Return the errors [n] of medians of pixel over star [n_wings] in the wings: those of means times sqrt(pi/2).

    `variances` of the pixels are [n, n_wings].
    """
    return np.sqrt(0.5 * np.pi * (variances / star**2).mean(axis=1) / len(star))


def _sharp_pixels(residuals: np.ndarray, variances: np.ndarray, fraction: float, threshold: float) -> np.ndarray:
    """Return the pixels of cosmic rays, bool [n, ny, nx]: sharp ones, and bright ones beside them."""
    neighbourhood = np.ones((1, 3, 3))
    around, around_variance = (
        ndimage.convolve(values, neighbourhood, mode="nearest")  # extended beyond the edge, which is no sharp pixel
        for values in (residuals, variances)
    )
    excess = residuals - fraction * around
    error = np.sqrt((1.0 - 2.0 * fraction) * variances + fraction**2 * around_variance)
    sharp = excess > threshold * error
    for i in np.flatnonzero(sharp.any(axis=(1, 2))):
        bright = residuals[i] > 0.5 * threshold * np.sqrt(variances[i])
        sharp[i] |= ndimage.binary_dilation(sharp[i], neighbourhood[0], iterations=-1, mask=bright | sharp[i])
    return np.asarray(sharp)


def _scales(wings: np.ndarray, star: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return the median ratio of the stars' pixels [n, n_wings] to the median star's; NaN where all are bad."""
    ratios = wings / star
    if not bad.any():
        return row_medians(ratios)
    ratios[bad] = np.nan
    scales, some_good = np.full(len(wings), np.nan), ~bad.all(axis=1)
    scales[some_good] = np.nanmedian(ratios[some_good], axis=1)
    return scales


@dataclass(frozen=True, eq=False)
class MatchedFilter:
    """Sums over pixels of an image times a star of the same shape whose peak stands on each pixel."""

    star: np.ndarray  #: [ny, nx]
    peak: tuple[int, ...]  #: its brightest pixel
    padded: list[int]  #: shape of the transforms
    transforms: tuple[np.ndarray, np.ndarray]  #: of the star and of its square
    norm: np.ndarray  #: sums of the square of the star, as far as it lies on the stamp

    @classmethod
    def of(cls, star: np.ndarray) -> MatchedFilter:
        """Return the filter of a star."""
        peak = tuple(int(at) for at in np.unravel_index(star.argmax(), star.shape))
        padded = [fft.next_fast_len(2 * n - 1, real=True) for n in star.shape]
        star_transform, square_transform = (fft.rfft2(image[::-1, ::-1], padded) for image in (star, star**2))
        filter_without_norm = cls(star, peak, padded, (star_transform, square_transform), np.zeros(star.shape))
        return replace(filter_without_norm, norm=filter_without_norm.squares(np.ones(star.shape)))

    def light(self, images: np.ndarray) -> np.ndarray:
        """Return the sums with the star, of images [..., ny, nx]."""
        return self._correlate(images, self.transforms[0])

    def squares(self, images: np.ndarray) -> np.ndarray:
        """Return the sums with the square of the star, of images [..., ny, nx]."""
        return self._correlate(images, self.transforms[1])

    def _correlate(self, images: np.ndarray, transform: np.ndarray) -> np.ndarray:
        product = fft.irfft2(fft.rfft2(images, self.padded) * transform, self.padded)
        rows, columns = (slice(n - 1 - at, 2 * n - 1 - at) for n, at in zip(self.star.shape, self.peak, strict=True))
        return np.asarray(product[..., rows, columns])


def _neighbour_pixels(
    residual: np.ndarray,
    variance: np.ndarray,
    squares: np.ndarray,
    photons: np.ndarray,
    matched_filter: MatchedFilter,
    threshold: float,
) -> np.ndarray | None:
    """Return the pixels of neighbours [ny, nx] bool, one after the other by significance; None without any.

    `variance` has the allowance for the PSF's variation in it, `photons` noise alone; `squares` are its sums with the
    square of the star.
    """
    star, peak, norm = matched_filter.star, matched_filter.peak, matched_filter.norm
    rms, neighbours = np.sqrt(photons), np.zeros(star.shape, dtype=bool)
    remaining, scaled_again = residual, False
    for _ in range(_MOST_NEIGHBOURS):
        light = matched_filter.light(remaining)
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


def _stamp_cube(stamps: ArrayLike) -> np.ndarray:
    """Return the stamps as float64 [n, ny, nx]."""
    images = real_array(stamps, "stamps: expected real numbers [n, ny, nx]")
    if images.ndim != 3 or min(images.shape[1:]) < 5:
        raise DomainError(f"stamps have shape {images.shape}: expected [n, ny, nx], at least 5 x 5 pixels")
    return images
