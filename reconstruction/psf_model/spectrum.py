r"""PSF of a spectrum that no star has, light that the air spreads included.

A model that is linear in the mean wavelength of a spectrum leaves what is of second order. By far the largest part is
dispersion: the air spreads the light of a spectrum S along a line, by the covariance

.. math:: C_S = \langle R R^T \rangle_S - \langle R \rangle_S \langle R \rangle_S^T

of the shifts R of its wavelengths, each by its photons. That of the stars, taken as blackbodies, is in the model as far
as it is linear in their mean wavelengths and the model depends on these. The excess of a spectrum is known, and is
convolved with the model's PSF (where it is negative the inverse, which is small against the pixel).
"""

from __future__ import annotations

import numpy as np
from astropy.units import Quantity
from numpy.typing import ArrayLike
from scipy import fft

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.units import metres, positive_angle, pure_numbers, radians
from ...models.star_spectrum import COOLEST, HOTTEST, blackbody_photons, effective_colour
from ...wavefront.psf.light import Light
from .model import PsfModel
from .polynomial import as_positions

# Temperatures between which spreads are interpolated.
_TEMPERATURES = 200


@check_arguments
def psf_of_spectrum(model: PsfModel, positions: ArrayLike, light: Light, pixel_scale: float | Quantity) -> np.ndarray:
    """Evaluate the PSF at positions for spectra, such as galaxies'.

    Parameters
    ----------
    model : PsfModel
        With mean wavelengths of stars [m], :func:`~pachon.effective_colour`, as their colours.
    positions : array
        [m, 2], or one position [2], in the unit of the model.
    light : Light
        Wavelengths in steps of equal size within the band, photons of the spectrum of all positions, or of each, and
        the dispersion: shifts along the axes of the stamps, their sign apart.
    pixel_scale : float or Quantity
        Side of a pixel [rad].

    Returns
    -------
    ndarray
        PSFs of unit sum, [m, ny, nx].

    Raises
    ------
    DomainError
        If shapes do not fit together, or the colours of the stars are no wavelengths of the band.
    """
    points, scale = as_positions(positions), positive_angle(pixel_scale, "pixel_scale")
    waves = np.atleast_1d(metres(light.wavelengths, "wavelengths"))
    photons = np.ones(len(waves)) if light.weights is None else pure_numbers(light.weights, "weights")
    colours = effective_colour(waves, photons)
    if len(colours) not in (1, len(points)):
        raise DomainError(f"weights: {len(colours)} spectra, expected one, or one for each of {len(points)} positions")
    if model.colour is None:
        raise DomainError("model has no dependence on the colour: expected stars whose mean wavelengths differ")
    star_waves = model.colour.stars.values[np.isfinite(model.colour.stars.values)]
    if not waves.min() <= star_waves.min() <= star_waves.max() <= waves.max():
        raise DomainError(
            f"colours of the model's stars are {star_waves.min():.3g} to {star_waves.max():.3g}: expected mean "
            f"wavelengths [m] within {waves.min():.4g} to {waves.max():.4g}, as of effective_colour"
        )
    images = model.at(points, colour=np.broadcast_to(colours, (len(points),)))
    if light.dispersion is None:
        return images
    shifts = radians(light.dispersion, "dispersion") / scale
    if shifts.shape != (len(waves), 2):
        raise DomainError(f"dispersion has shape {shifts.shape}: expected [{len(waves)}, 2]")
    kelvin = np.geomspace(HOTTEST, COOLEST, _TEMPERATURES)
    blackbodies = blackbody_photons(kelvin, waves)
    of_stars = [np.interp(star_waves, effective_colour(waves, blackbodies), c) for c in _spread(blackbodies, shifts).T]
    lines = [np.polyfit(star_waves - model.colour.mean, spread, 1) for spread in of_stars]
    # The less the stars ask for a dependence, the less of it is in the model.
    deviation = model.colour.probability * (colours - model.colour.mean)
    linear = np.stack([np.polyval(line, deviation) for line in lines], axis=1)
    return _convolved(images, _spread(np.atleast_2d(photons), shifts) - linear)


def _spread(photons: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Return variances along x and y, and the covariance, of shifts [n_wave, 2] by photons [n, n_wave]: [n, 3]."""
    weights = photons / photons.sum(axis=1, keepdims=True)
    products = np.stack([shifts[:, 0] ** 2, shifts[:, 1] ** 2, shifts[:, 0] * shifts[:, 1]], axis=1)
    x, y = (weights @ shifts).T
    return np.asarray(weights @ products - np.stack([x * x, y * y, x * y], axis=1))


def _convolved(images: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return images [n, ny, nx] convolved with Gaussians of covariances [n, 3] or [1, 3] [pixel^2], of any sign."""
    ny, nx = images.shape[1:]
    ky, kx = 2.0 * np.pi * fft.fftfreq(ny)[:, None], 2.0 * np.pi * fft.rfftfreq(nx)
    along_x, along_y, cross = (values[:, None, None] for values in covariance.T)
    transfer = np.exp(-0.5 * (along_x * kx**2 + along_y * ky**2) - cross * kx * ky)
    return np.asarray(fft.irfft2(fft.rfft2(images) * transfer, s=(ny, nx)))
