"""Photon rates, noise and magnitude limits of the LSST, in electrons.

Zero points, dark sky, extinction, instrument noise and the signal-to-noise formula are those of SMTN-002 ("Calculating
LSST limiting magnitudes and SNR", throughputs v1.9, airmass 1), whose conventions go back to Ivezic et al. 2019
(ApJ 873, 111).

Arguments of the same name have the same meaning throughout. Magnitudes are AB above the atmosphere; `band` is a
:class:`Band` or its name, `exposure` a time [s], `fwhm` the effective FWHM of a star (that of the Gaussian with as many
noise-equivalent pixels) and `pixel_scale` the side of a pixel, both [rad] or a Quantity; `sky` is a brightness
[AB mag/arcsec^2], by default the dark sky of the band. A value that is not positive and finite raises
:class:`~pachon.core.errors.DomainError`, an unknown band :class:`~pachon.core.errors.UnknownNameError`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import erf

from ...core.errors import DomainError, unknown_name
from ...core.units import ARCSEC, positive_angle, require_positive

PIXEL_SCALE = 0.2 * ARCSEC
"""Angle of one LSST pixel [rad]."""
READ_NOISE = 8.8
"""Read noise of one exposure [e-/pixel]: the upper limit that SMTN-002 takes from the camera requirements (LSE-59)."""
DARK_CURRENT = 0.2
"""Dark current [e-/s/pixel]: the upper limit that SMTN-002 takes from the camera requirements (LSE-59)."""
FULL_WELL = 1.0e5
"""Largest signal of an unsaturated pixel [e-]: just under the lower of the two measured turn-offs of the photon
transfer curve, 103 000 (e2v) and 129 000 (ITL) (SITCOMTN-148, Table 6)."""
PROVISIONAL_FWHM = 0.6 * ARCSEC
"""Effective FWHM of stars [rad] for magnitude limits before any star is drawn."""
# Noise-equivalent pixels of a Gaussian whose FWHM is one pixel (SMTN-002).
_PIXELS_PER_SQUARE_FWHM = 2.266


@dataclass(frozen=True)
class Band:
    """One LSST filter at the zenith under a dark sky; all but the range of wavelengths from SMTN-002."""

    name: str  #: ``u`` to ``y``
    zero_point: float  #: AB magnitude of one electron a second, atmosphere at airmass 1 included
    dark_sky: float  #: brightness [AB mag/arcsec^2]
    extinction: float  #: loss in the atmosphere, ``kAtm`` [mag/airmass]
    effective_wavelength: float  #: [m]
    wavelength_range: tuple[float, float]  #: [m] at half the maximum throughput (LSST throughputs v1.9, airmass 1.2)


BANDS = {
    band.name: band
    for band in (
        Band("u", 26.52, 23.05, 0.47, 366e-9, (349e-9, 396e-9)),
        Band("g", 28.51, 22.25, 0.21, 482e-9, (403e-9, 551e-9)),
        Band("r", 28.36, 21.20, 0.13, 622e-9, (550e-9, 690e-9)),
        Band("i", 28.17, 20.46, 0.10, 754e-9, (692e-9, 821e-9)),
        Band("z", 27.78, 19.61, 0.07, 869e-9, (818e-9, 922e-9)),
        Band("y", 26.82, 18.60, 0.17, 971e-9, (924e-9, 1015e-9)),
    )
}


def band_named(band: str | Band) -> Band:
    """Return the band of a name; a band is returned as it is."""
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
    band: str | Band, exposure: float, pixel_scale: Any = PIXEL_SCALE, *, sky: float | None = None
) -> float:
    """Return the electrons of the sky in one pixel.

    Sky brightness is defined at the pupil of the telescope, so the atmosphere does not dim the sky as it does a star:
    the zero point without the atmosphere, ``zero_point + extinction``, applies (SMTN-002, "Sky Counts").
    """
    band = band_named(band)
    exposure = require_positive(exposure, "exposure", "seconds")
    area = (positive_angle(pixel_scale, "pixel_scale") / ARCSEC) ** 2
    brightness = band.dark_sky if sky is None else float(sky)
    return float(exposure * area * 10.0 ** (0.4 * (band.zero_point + band.extinction - brightness)))


def instrument_noise(exposure: float) -> float:
    """Return the rms of read noise and dark current in one pixel and exposure [e-] (SMTN-002)."""
    return float(np.sqrt(READ_NOISE**2 + DARK_CURRENT * require_positive(exposure, "exposure", "seconds")))


def effective_pixels(fwhm: Any, pixel_scale: Any = PIXEL_SCALE) -> float:
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
    magnitude: Any,
    band: str | Band,
    exposure: float,
    fwhm: Any,
    *,
    pixel_scale: Any = PIXEL_SCALE,
    sky: float | None = None,
) -> np.ndarray:
    """Return the S/N of PSF photometry, ``C / sqrt(C + n_eff (sky + noise^2))`` (SMTN-002)."""
    counts = electrons(magnitude, band, exposure)
    return counts / np.sqrt(counts + _footprint_variance(band, exposure, fwhm, pixel_scale, sky))


def limiting_magnitude(
    snr: float,
    band: str | Band,
    exposure: float,
    fwhm: Any,
    *,
    pixel_scale: Any = PIXEL_SCALE,
    sky: float | None = None,
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
    pixel_scale: Any = PIXEL_SCALE,
    sky: float | None = None,
    full_well: float = FULL_WELL,
) -> float:
    """Return the magnitude at which the central pixel of a star reaches the full well [e-].

    The star is a Gaussian centred on the pixel. A turbulent PSF has more light in its wings and a lower peak, so the
    limit is a safe one. DomainError if the sky alone fills the well.
    """
    sigma = positive_angle(fwhm, "fwhm") / np.sqrt(8.0 * np.log(2.0))
    pixel = positive_angle(pixel_scale, "pixel_scale")
    background = sky_electrons_per_pixel(band, exposure, pixel, sky=sky)
    room = require_positive(full_well, "full_well", "electrons") - background
    if room <= 0.0:
        raise DomainError(f"full_well = {full_well}: expected more than the {background:.0f} electrons of the sky")
    central = erf(0.5 * pixel / (np.sqrt(2.0) * sigma)) ** 2
    return float(magnitude_of(room / central, band, exposure))


def _footprint_variance(band: str | Band, exposure: float, fwhm: Any, pixel_scale: Any, sky: float | None) -> float:
    """Return the variance of sky and instrument under a star [e-^2]."""
    background = sky_electrons_per_pixel(band, exposure, pixel_scale, sky=sky)
    return effective_pixels(fwhm, pixel_scale) * (background + instrument_noise(exposure) ** 2)
