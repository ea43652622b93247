"""Width of the weight under which galaxies are measured, for PSFs of any width."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...core.units import ARCSEC, positive_angle, require_within
from ..shapes import half_light_radii

#: Least rms width of the weight before the PSF [rad]: in seeing of 0.7" narrower ones amplify noise, wider ones lose
#: signal.
WEIGHT_SIGMA = 0.52 * ARCSEC
# Least width of the weight over the half-light radius of the widest PSF: narrower ones amplify noise.
_WEIGHT_OVER_PSF = 1.2
#: Least and largest rms width of the weight [pixels].
_WIDTHS = (0.1, 100.0)


def weight_sigma(sigma: ArrayLike | None, psf_images: np.ndarray, pixel_scale: float) -> float:
    """Return the rms width of the weight [rad]: the given one, or one that is wide enough for PSFs [n, m, m]."""
    if sigma is not None:
        return positive_angle(sigma, "sigma")
    return max(WEIGHT_SIGMA, _WEIGHT_OVER_PSF * pixel_scale * float(np.max(half_light_radii(psf_images))))


def weight_width(sigma: ArrayLike | None, psf_images: np.ndarray, pixel_scale: float) -> float:
    """Return the rms width of the weight [pixels]; DomainError for one that no image shows."""
    width = weight_sigma(sigma, psf_images, pixel_scale) / pixel_scale
    return require_within(width, "sigma / pixel_scale", *_WIDTHS, "pixels")
