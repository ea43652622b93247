"""Refractive media: what every medium offers, constant and Sellmeier indices, and figures that are relative to air.

Other media stand in files of their own: further dispersion formulas in `dispersion`, tables in `tabulated`, air in
`air`, glasses by name in `glass_catalogue`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from ...core.errors import DomainError, PrescriptionError
from ...core.units import metres


class Medium(Protocol):
    """Any refractive medium: immutable, hashable, with a name and an index at a vacuum wavelength."""

    @property
    def name(self) -> str:
        """Name for messages and files; empty where there is none."""
        ...

    def index(self, wavelength: Any) -> np.ndarray:
        """Return the refractive index at vacuum wavelengths [m], in their shape."""
        ...

    def __hash__(self) -> int: ...


def check_range(wavelength_range: tuple[float, float]) -> None:
    """Raise PrescriptionError unless a range of wavelengths [m] is two finite numbers, rising from above zero."""
    if len(wavelength_range) != 2 or not np.all(np.isfinite(wavelength_range)):
        raise PrescriptionError(f"wavelength_range = {wavelength_range!r}: expected 2 finite numbers")
    if not 0 < wavelength_range[0] < wavelength_range[1]:
        raise PrescriptionError(f"wavelength_range = {wavelength_range!r}: expected 0 < shortest < longest")


def wavelength_within(wavelength: Any, wavelength_range: tuple[float, float], what: str = "this glass") -> np.ndarray:
    """Return wavelengths [m] as a float64 array, or raise DomainError where one is out of range."""
    w = metres(wavelength, "wavelength")
    low, high = wavelength_range
    # One part in 1e12 is what conversions between units may add to a limit.
    inside = (w >= low * (1 - 1e-12)) & (w <= high * (1 + 1e-12))
    if not np.all(inside):
        bad = w[~inside].flat[0] if w.ndim else float(w)
        raise DomainError(
            f"wavelength = {bad * 1e9:.6g} nm: expected {low * 1e9:.6g} to {high * 1e9:.6g} nm for {what}"
        )
    return w


def check_real(value: np.ndarray, wavelength: np.ndarray) -> None:
    """Raise DomainError unless what a dispersion formula gives, an index or its square, is positive and finite."""
    good = np.isfinite(value) & (value > 0)
    if not np.all(good):
        bad = wavelength[~good].flat[0] if wavelength.ndim else float(wavelength)
        raise DomainError(f"wavelength = {bad * 1e9:.6g} nm: the dispersion formula gives no real index there")


@dataclass(frozen=True)
class ConstantIndex:
    """Medium with one refractive index at every wavelength.

    Parameters
    ----------
    n : float
        Refractive index, positive.
    name : str
        Name for messages and files; not part of what the medium is.
    """

    n: float
    name: str = field(default="", compare=False)

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
    """Medium whose index follows the Sellmeier formula of any number of terms.

    ``n^2 = 1 + sum_i B_i w^2 / (w^2 - C_i)`` with ``w`` the vacuum wavelength in micrometres.

    Parameters
    ----------
    B : tuple of float, shape (n,)
        Oscillator strengths.
    C : tuple of float, shape (n,)
        Squares of the resonance wavelengths [um^2].
    wavelength_range : tuple of float, shape (2,)
        Shortest and longest vacuum wavelength [m] that the coefficients hold for.
    name : str
        Name for messages and files; not part of what the medium is.
    """

    B: tuple[float, ...]
    C: tuple[float, ...]
    wavelength_range: tuple[float, float] = (0.21e-6, 3.71e-6)
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        size = max(len(self.B), len(self.C), 1)
        for name, value in (("B", self.B), ("C", self.C)):
            if len(value) != size or not np.all(np.isfinite(value)):
                raise PrescriptionError(f"{name} = {value!r}: expected {size} finite numbers, as many in B as in C")
        check_range(self.wavelength_range)

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
        w = wavelength_within(wavelength, self.wavelength_range)
        squared = (w * 1e6) ** 2
        with np.errstate(all="ignore"):
            terms = (b * squared / (squared - c) for b, c in zip(self.B, self.C, strict=True))
            square = np.asarray(1.0 + sum(terms))
        check_real(square, w)
        return np.sqrt(square)


@dataclass(frozen=True)
class RelativeToAir:
    """Medium whose figures are relative to air, with wavelengths measured in air: what glass catalogues tabulate.

    The index against vacuum is that of the figures, taken at the wavelength in air, times that of the air.

    Parameters
    ----------
    figures : Medium
        Index relative to air, by wavelength in air.
    air : Medium
        The air that the figures are relative to: 20 deg C and one standard atmosphere for most catalogues.
    name : str
        Name for messages and files; not part of what the medium is.
    """

    figures: Medium
    air: Medium
    name: str = field(default="", compare=False)

    def index(self, wavelength: Any) -> np.ndarray:
        """Return the refractive index against vacuum.

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
            If the figures or the air do not cover a wavelength.
        """
        w = metres(wavelength, "wavelength")
        n_air = self.air.index(w)
        return n_air * self.figures.index(w / n_air)
