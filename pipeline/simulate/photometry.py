"""Photon rates, noise and magnitude limits of a camera, in electrons.

The signal-to-noise formula is that of SMTN-002 ("Calculating LSST limiting magnitudes and SNR"), whose conventions go
back to Ivezic et al. 2019 (ApJ 873, 111).

Arguments of the same name have the same meaning throughout. Magnitudes are AB above the atmosphere; `band` is a
:class:`~pachon.models.camera.photometry.Band`, or the name of one of the LSST; `exposure` is a time [s], `fwhm` the
effective FWHM of a star (that of the Gaussian with as many noise-equivalent pixels) and `pixel_scale` the side of a
pixel, by default the camera's, both [rad] or a Quantity; `sky` is a brightness [AB mag/arcsec^2], by default the dark
sky of the band. A value that is not positive and finite raises
:class:`~pachon.core.errors.DomainError`, an unknown band :class:`~pachon.core.errors.UnknownNameError`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import erf

from ...core.errors import DomainError, unknown_name
from ...core.statistics import FWHM_PER_RMS
from ...core.units import ARCSEC, positive_angle, require_positive
from ...models.camera.photometry import BANDS, Band

PROVISIONAL_FWHM = 0.6 * ARCSEC
"""Effective FWHM of stars [rad] for magnitude limits before any star is drawn."""
# Noise-equivalent pixels of a Gaussian whose FWHM is one pixel (SMTN-002).
_PIXELS_PER_SQUARE_FWHM = 2.266
# Least part of the sky's light that arrives.
_LEAST_LIGHT = 1e-3


def band_named(band: str | Band) -> Band:
    """Return the band of the LSST of a name; a band is returned as it is."""
    if isinstance(band, Band):
        return band
    if band not in BANDS:
        raise unknown_name("band", band, BANDS)
    return BANDS[band]


def electrons(magnitude: Any, band: str | Band, exposure: float) -> np.ndarray:
    """Return the electrons of a star in one exposure, at airmass 1."""
    band = band_named(band)
    exposure = require_positive(exposure, "exposure", "seconds")
    return exposure * 10.0 ** (0.4 * (band.zero_point - np.asarray(magnitude, dtype=np.float64)))


def magnitude_of(counts: Any, band: str | Band, exposure: float) -> np.ndarray:
    """Return the AB magnitude of a number of electrons: the inverse of :func:`electrons`."""
    band = band_named(band)
    exposure = require_positive(exposure, "exposure", "seconds")
    counts = np.asarray(counts, dtype=np.float64)
    if not np.all(counts > 0.0):
        raise DomainError(f"counts = {counts}: expected positive numbers of electrons")
    return band.zero_point - 2.5 * np.log10(counts / exposure)


def sky_electrons_per_pixel(
    band: str | Band, exposure: float, pixel_scale: Any = None, *, sky: float | None = None
) -> float:
    """Return the electrons of the sky in one pixel.

    Sky brightness is defined at the pupil of the telescope, so the atmosphere does not dim the sky as it does a star:
    the zero point without the atmosphere, ``zero_point + extinction``, applies (SMTN-002, "Sky Counts").
    """
    band = band_named(band)
    exposure = require_positive(exposure, "exposure", "seconds")
    area = (_pixel_side(band, pixel_scale) / ARCSEC) ** 2
    brightness = band.dark_sky if sky is None else float(sky)
    return float(exposure * area * 10.0 ** (0.4 * (band.zero_point + band.extinction - brightness)))


def light_of_sky(lit_fraction: np.ndarray) -> float:
    """Return the part of the sky's light that arrives at stars [n], in their mean; 1 without stars."""
    return _rounded_light(float(np.mean(lit_fraction))) if len(lit_fraction) else 1.0


def vignetted(band: Band, light: float) -> Band:
    """Return a band with the sky of a part of the field where so much of the light on the axis arrives."""
    return replace(band, dark_sky=band.dark_sky - 2.5 * float(np.log10(_rounded_light(light))))


def _rounded_light(light: float) -> float:
    """Return light to a thousandth, so that the noise of stars without vignetting is that on the axis."""
    return max(round(light, 3), _LEAST_LIGHT)


def instrument_noise(band: str | Band, exposure: float) -> float:
    """Return the rms of read noise and dark current in one pixel and exposure [e-] (SMTN-002)."""
    band = band_named(band)
    return float(np.sqrt(band.read_noise**2 + band.dark_current * require_positive(exposure, "exposure", "seconds")))


def effective_pixels(fwhm: Any, pixel_scale: Any) -> float:
    """Return the noise-equivalent number of pixels of a star, ``2.266 (FWHM/pixel)^2`` (SMTN-002)."""
    width, pixel = positive_angle(fwhm, "fwhm"), positive_angle(pixel_scale, "pixel_scale")
    return _PIXELS_PER_SQUARE_FWHM * (width / pixel) ** 2


def effective_fwhm(images: np.ndarray, pixel_scale: float) -> float:
    """Return the FWHM of the Gaussian with as many noise-equivalent pixels as the median star [rad].

    The noise-equivalent number of pixels is 1/sum(P^2) for an image P of unit sum.
    """
    pixels = 1.0 / np.median((images**2).sum(axis=(1, 2)))
    return float(np.sqrt(pixels / _PIXELS_PER_SQUARE_FWHM) * pixel_scale)


def signal_to_noise(
    magnitude: Any, band: str | Band, exposure: float, fwhm: Any, *, pixel_scale: Any = None, sky: float | None = None
) -> np.ndarray:
    """Return the S/N of PSF photometry, ``C / sqrt(C + n_eff (sky + noise^2))`` (SMTN-002)."""
    counts = electrons(magnitude, band, exposure)
    return counts / np.sqrt(counts + _footprint_variance(band, exposure, fwhm, pixel_scale, sky))


def limiting_magnitude(
    snr: float, band: str | Band, exposure: float, fwhm: Any, *, pixel_scale: Any = None, sky: float | None = None
) -> float:
    """Return the magnitude of a star of a signal-to-noise ratio: :func:`signal_to_noise` solved for C."""
    square = require_positive(snr, "snr") ** 2
    variance = _footprint_variance(band, exposure, fwhm, pixel_scale, sky)
    counts = 0.5 * (square + np.sqrt(square**2 + 4.0 * square * variance))
    return float(magnitude_of(counts, band, exposure))


def saturation_magnitude(
    band: str | Band,
    exposure: float,
    fwhm: Any,
    *,
    pixel_scale: Any = None,
    sky: float | None = None,
    full_well: float | None = None,
) -> float:
    """Return the magnitude at which the central pixel of a star reaches the full well [e-].

    The star is a Gaussian centred on the pixel. A turbulent PSF has more light in its wings and a lower peak, so the
    limit is a safe one. DomainError if the sky alone fills the well.
    """
    sigma = positive_angle(fwhm, "fwhm") / FWHM_PER_RMS
    band = band_named(band)
    pixel = _pixel_side(band, pixel_scale)
    background = sky_electrons_per_pixel(band, exposure, pixel, sky=sky)
    well = require_positive(band.full_well if full_well is None else full_well, "full_well", "electrons")
    room = well - background
    if room <= 0.0:
        raise DomainError(
            f"full_well = {well:g} (photometry.full_well_e of a configuration): expected more than the"
            f" {background:.0f} electrons of the sky, or a shorter exposure"
        )
    central = erf(0.5 * pixel / (np.sqrt(2.0) * sigma)) ** 2
    return float(magnitude_of(room / central, band, exposure))


def _footprint_variance(band: str | Band, exposure: float, fwhm: Any, pixel_scale: Any, sky: float | None) -> float:
    """Return the variance of sky and instrument under a star [e-^2]."""
    band = band_named(band)
    background = sky_electrons_per_pixel(band, exposure, pixel_scale, sky=sky)
    return effective_pixels(fwhm, _pixel_side(band, pixel_scale)) * (background + instrument_noise(band, exposure) ** 2)


def _pixel_side(band: Band, pixel_scale: Any) -> float:
    """Return the side of a pixel [rad], by default that of the camera."""
    return band.pixel_scale if pixel_scale is None else positive_angle(pixel_scale, "pixel_scale")
