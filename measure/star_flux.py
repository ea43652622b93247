"""Flux of stars on stamps that are wide beside the star."""

from __future__ import annotations

import numpy as np

from ..core.statistics import (
    RMS_PER_MAD,
    column_median,
    finite_row_medians,
    masked_median,
    row_medians,
    sorted_columns,
)

# Relative error of the fit of a profile as the PSF changes within a CCD: a sum that is known better stands.
_PROFILE_ERROR = 0.2
# Pixels of less than this fraction of the peak tell the noise: in brighter ones stars differ.
_FAINT = 0.1
# Least noise of a sum, over the flux: that of a star without noise is its sum, whatever the PSF does.
_LEAST_NOISE = 1e-6
# A stamp whose sum is negative has a star if the fit is above its noise by so many standard deviations.
_SIGNIFICANT = 3.0
# Standard deviations from the middle star's beyond which a sum is not noise alone.
_OUTLYING = 3.0


def star_fluxes(
    pixels: np.ndarray,
    used: np.ndarray | None = None,
    profile: np.ndarray | None = None,
    noise: np.ndarray | None = None,
) -> np.ndarray:
    """Return the flux of each star [n]; that of a stamp without light is zero or negative.

    A flux is the sum over the stamp unless noise has changed that. The sum over the thousands of pixels of a wide stamp
    has ten times the noise of a fit of the mean star: a star of S/N 30 may sum to nothing. The fit is off by what the
    PSF changes within a CCD. So the sum may differ from the fit, the less the noisier it is.

    Parameters
    ----------
    pixels : array
        Stars [n, n_pixels] without background, centred alike, of any unit.
    used : array, optional
        Pixels to use, bool [n, n_pixels]; the flux is that of the whole star.
    profile : array, optional
        Mean of these stars, of unit sum, [n_pixels]; by default :func:`median_star`.
    noise : array, optional
        Of a pixel of each star, [n]; by default :func:`pixel_noise`.
    """
    profile = median_star(pixels, used) if profile is None else profile
    fitted, square = fitted_fluxes(pixels, used, profile)
    noise = _noise_beside(pixels, used, fitted, profile) if noise is None else noise
    dark = fitted * np.sqrt(square) <= _SIGNIFICANT * noise
    if used is None:
        total, noise = pixels.sum(axis=1), noise * np.sqrt(pixels.shape[1])
    else:
        lit = np.where(used, profile, 0.0).sum(axis=1)
        lit = np.where(lit > 0.0, lit, 1.0)
        total, noise = np.where(used, pixels, 0.0).sum(axis=1) / lit, noise * np.sqrt(used.sum(axis=1)) / lit
    least = np.maximum(_LEAST_NOISE * np.abs(fitted), np.finfo(float).tiny)
    reach = fitted * (_PROFILE_ERROR**2 * fitted / np.maximum(noise, least))
    flux = np.where(fitted > 0.0, np.clip(total, fitted - reach, fitted + reach), fitted)
    flux = flux * _common_factor(total, flux, fitted, np.maximum(noise, least))
    return np.where(dark & (total <= 0.0), np.minimum(flux, 0.0), flux)


def _common_factor(total: np.ndarray, flux: np.ndarray, fitted: np.ndarray, noise: np.ndarray) -> float:
    """Return the factor of fluxes that the sums over the stamps, with their noise, show in common; arrays [n].

    The profile of a few faint stars has its own light only as far as noise lets it: the sums of all know it better.
    """
    lit = (flux > 0.0) & (fitted > 0.0)
    if not lit.any():
        return 1.0
    total, flux, fitted, noise = total[lit], flux[lit], fitted[lit], noise[lit]
    ratio, error = total / flux, noise / flux
    order = np.argsort(ratio, kind="stable")
    weight = np.cumsum(1.0 / error[order])
    middle = ratio[order][np.searchsorted(weight, 0.5 * weight[-1])]
    # By fitted fluxes, whose noise is not that of the sums.
    weight = np.where(np.abs(ratio - middle) <= _OUTLYING * error, fitted / noise**2, 0.0)
    factor = float((weight * total).sum() / (weight * flux).sum())
    return factor if factor > 0.0 else 1.0


def pixel_noise(pixels: np.ndarray, used: np.ndarray | None, profile: np.ndarray) -> np.ndarray:
    """Return the rms noise of the faint pixels of each star, [n], with arguments of :func:`star_fluxes`."""
    return _noise_beside(pixels, used, fitted_fluxes(pixels, used, profile)[0], profile)


def _noise_beside(pixels: np.ndarray, used: np.ndarray | None, fluxes: np.ndarray, profile: np.ndarray) -> np.ndarray:
    """Return the rms noise of the faint pixels beside stars of given fluxes, [n]."""
    faint = profile < _FAINT * profile.max()
    if not faint.any():
        return np.zeros(len(pixels))
    deviations = np.abs(pixels[:, faint] - fluxes[:, None] * profile[faint])
    if used is None:
        return RMS_PER_MAD * row_medians(deviations)
    return RMS_PER_MAD * np.nan_to_num(finite_row_medians(np.where(used[:, faint], deviations, np.nan)))


def fitted_fluxes(pixels: np.ndarray, used: np.ndarray | None, profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the fluxes of stars by least squares, and the sums of squares of the profile in their used pixels, [n].

    Under a profile without light fluxes are sums.
    """
    if used is None:
        values, square = pixels, np.full(len(pixels), (profile**2).sum())
    else:
        values, square = np.where(used, pixels, 0.0), np.where(used, profile**2, 0.0).sum(axis=1)
    if not profile.any():
        return np.asarray(values.sum(axis=1)), square
    return np.asarray((values * profile).sum(axis=1) / np.where(square > 0.0, square, 1.0)), square


def with_unit_flux(stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return stars [n, ny, nx] over their :func:`star_fluxes`, and these, [n]; NaN where that is not possible.

    That is where a pixel is not finite, or there is no light.
    """
    pixels = stamps.reshape(len(stamps), stamps.shape[1] * stamps.shape[2])
    finite = np.isfinite(pixels).all(axis=1)
    flux = np.full(len(stamps), np.nan)
    if finite.any():
        flux[finite] = star_fluxes(pixels[finite])
        flux[~(flux > 0.0)] = np.nan
    return stamps / flux[:, None, None], flux


def median_star(pixels: np.ndarray, used: np.ndarray | None = None) -> np.ndarray:
    """Return the median of stars [n, n_pixels], each over its sum, [n_pixels], of unit sum; zero if no sum is positive.

    Stars of a sum near zero, and pixels that are not the star's, do not move it. Stars of negative sum, which would
    count upside down, are left out. Pixels that are not `used` count in no star.
    """
    images = pixels if used is None else np.where(used, pixels, 0.0)
    sums = images.sum(axis=1)
    lit = sums > 0.0
    if not lit.any():
        return np.zeros(pixels.shape[1])
    if not lit.all():
        images, sums, used = images[lit], sums[lit], None if used is None else used[lit]
    unit = images / sums[:, None]
    median = column_median(sorted_columns(unit)) if used is None else np.nan_to_num(masked_median(unit, ~used))
    total = median.sum()
    return np.asarray(median / (total if total > 0.0 else 1.0))
