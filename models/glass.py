"""Refractive media: constant and Sellmeier indices.

The Sellmeier formula is ``n^2 = 1 + sum_i B_i w^2 / (w^2 - C_i)`` with ``w`` the vacuum wavelength in micrometres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .errors import DomainError, PrescriptionError
from .units import metres


@dataclass(frozen=True)
class ConstantIndex:
    """Medium with one refractive index at every wavelength.

    Parameters
    ----------
    n : float
        Refractive index, positive.
    """

    n: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.n) and self.n > 0):
            raise PrescriptionError(f"n = {self.n!r}: expected a positive refractive index")

    def index(self, wavelength: Any) -> np.ndarray:
        """Return the refractive index.

        Parameters
        ----------
        wavelength : float, array or Quantity
            Vacuum wavelength [m].

        Returns
        -------
        ndarray
            Refractive index, shape of `wavelength`.
        """
        return np.full_like(metres(wavelength, "wavelength"), self.n)


@dataclass(frozen=True)
class Sellmeier:
    """Medium whose index follows the three-term Sellmeier formula.

    Parameters
    ----------
    B : tuple of float, shape (3,)
        Oscillator strengths.
    C : tuple of float, shape (3,)
        Squares of the resonance wavelengths [um^2].
    wavelength_range : tuple of float, shape (2,)
        Shortest and longest vacuum wavelength [m] that the coefficients hold for.
    """

    B: tuple[float, float, float]
    C: tuple[float, float, float]
    wavelength_range: tuple[float, float] = (0.21e-6, 3.71e-6)

    def __post_init__(self) -> None:
        for name, value, size in (("B", self.B, 3), ("C", self.C, 3), ("wavelength_range", self.wavelength_range, 2)):
            if len(value) != size or not np.all(np.isfinite(value)):
                raise PrescriptionError(f"{name} = {value!r}: expected {size} finite numbers")
        if not 0 < self.wavelength_range[0] < self.wavelength_range[1]:
            raise PrescriptionError(f"wavelength_range = {self.wavelength_range!r}: expected 0 < shortest < longest")

    def index(self, wavelength: Any) -> np.ndarray:
        """Return the refractive index.

        Parameters
        ----------
        wavelength : float, array or Quantity
            Vacuum wavelength [m].

        Returns
        -------
        ndarray
            Refractive index, shape of `wavelength`.

        Raises
        ------
        DomainError
            If a wavelength lies outside `wavelength_range`.
        """
        w = metres(wavelength, "wavelength")
        low, high = self.wavelength_range
        if not np.all((w >= low) & (w <= high)):
            bad = w[~((w >= low) & (w <= high))].flat[0] if w.ndim else float(w)
            raise DomainError(
                f"wavelength = {bad * 1e9:.6g} nm: expected {low * 1e9:.6g} to {high * 1e9:.6g} nm for this glass"
            )
        squared = (w * 1e6) ** 2
        terms = (b * squared / (squared - c) for b, c in zip(self.B, self.C, strict=True))
        return np.sqrt(1.0 + sum(terms))


Medium = ConstantIndex | Sellmeier
"""Any refractive medium."""
