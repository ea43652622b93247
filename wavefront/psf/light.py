"""Light of stars in front of the telescope: wavelengths, spectra and atmospheric dispersion."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from ...core.arguments import check_arguments


@check_arguments
@dataclass(frozen=True, eq=False)
class Light:
    """Light of stars, for :func:`~pachon.make_psfs` in place of plain wavelengths.

    Attributes
    ----------
    wavelengths : array_like or Quantity, shape [n_wave]
        Vacuum wavelengths [m].
    weights : array_like, shape [n_wave] or [n_star, n_wave], optional
        Relative numbers of photons of each wavelength before the telescope, equal by default: the spectrum of all
        stars, or of each, such as :func:`~pachon.blackbody_photons` gives.
    dispersion : array_like or Quantity, shape [n_wave, 2], optional
        Shift in field angle of each wavelength by the atmosphere [rad], such as
        :func:`~pachon.wavefront.atmosphere.refraction.dispersion_shift` gives.
    """

    wavelengths: ArrayLike
    weights: ArrayLike | None = None
    dispersion: ArrayLike | None = None
