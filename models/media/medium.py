"""Refractive media: the base class, constant and Sellmeier indices, indices relative to air or with an offset.

Further dispersion formulas stand in `dispersion`, tables in `tabulated`, air in `air`, glasses by name in
`models.io.glass_catalogue`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError, PrescriptionError
from ...core.units import metres

# Wavelengths [um] of the Fraunhofer lines at which glass makers state the index.
#: Helium, yellow; that of the index n_d and of the Abbe number.
LINE_D = 0.5875618
#: Hydrogen, blue; of the dispersion n_F - n_C.
LINE_F = 0.4861327
#: Hydrogen, red; of the dispersion n_F - n_C.
LINE_C = 0.6562725
#: Mercury, violet; of the partial dispersion.
LINE_G = 0.4358343


def check_wavelength_range(wavelength_range: tuple[float, float]) -> None:
    """Raise PrescriptionError unless a range of wavelengths [m] is two finite numbers, rising from above zero."""
    if len(wavelength_range) != 2 or not np.all(np.isfinite(wavelength_range)):
        raise PrescriptionError(f"wavelength_range = {wavelength_range!r}: expected 2 finite numbers")
    if not 0 < wavelength_range[0] < wavelength_range[1]:
        raise PrescriptionError(f"wavelength_range = {wavelength_range!r}: expected 0 < shortest < longest")


def wavelengths_within(wavelength: ArrayLike, wavelength_range: tuple[float, float], model: str) -> np.ndarray:
    """Return wavelengths [m] as a float64 array, or raise DomainError where one is out of the range of a model."""
    w = metres(wavelength, "wavelength")
    low, high = wavelength_range
    # One part in 1e12 is what conversions between units may add to a limit.
    outside = ~((w >= low * (1 - 1e-12)) & (w <= high * (1 + 1e-12)))
    if np.any(outside):
        raise DomainError(f"{_nanometres(w, outside)}: expected {low * 1e9:.6g} to {high * 1e9:.6g} nm for {model}")
    return w


def medium_label(name: str, kind: str) -> str:
    """Return what a medium of a kind is called in messages: by its name, where it has one."""
    return f"{kind} {name}" if name else f"this {kind}"


@check_arguments
class Medium(ABC):
    """A refractive medium: immutable and hashable.

    Attributes
    ----------
    name : str
        Name for messages and files; empty where there is none, and not part of equality.
    """

    name: str

    @abstractmethod
    def index(self, wavelength: ArrayLike) -> np.ndarray:
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
            If the medium does not cover a wavelength.
        """


def _nanometres(wavelength: np.ndarray, mask: np.ndarray) -> str:
    """Return the text for the first of the chosen wavelengths [m], in nm."""
    return f"wavelength = {np.atleast_1d(wavelength)[np.atleast_1d(mask)][0] * 1e9:.6g} nm"


def real_index(index: np.ndarray, wavelength: np.ndarray, *, squared: bool = False) -> np.ndarray:
    """Return the index that a dispersion formula gives, or raise DomainError where it is not positive and finite."""
    bad = ~(np.isfinite(index) & (index > 0))
    if np.any(bad):
        raise DomainError(f"{_nanometres(wavelength, bad)}: the dispersion formula gives no real index there")
    return np.sqrt(index) if squared else index


@check_arguments
@dataclass(frozen=True)
class ConstantIndex(Medium):
    """Medium with one refractive index at every wavelength.

    Parameters
    ----------
    n : float
        Refractive index, positive.
    name : str
        Name for messages and files; not part of equality.
    """

    n: float
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.n) and self.n > 0):
            raise PrescriptionError(f"n = {self.n!r}: expected a positive refractive index")

    def index(self, wavelength: ArrayLike) -> np.ndarray:  # noqa: D102
        return np.full_like(metres(wavelength, "wavelength"), self.n)


@check_arguments
@dataclass(frozen=True)
class Sellmeier(Medium):
    """Medium whose index follows the Sellmeier formula of any number of terms.

    ``n^2 = 1 + sum_i B_i w^2 / (w^2 - C_i)`` with ``w`` the vacuum wavelength in micrometres.

    Parameters
    ----------
    B : tuple of float, shape (n,)
        Oscillator strengths.
    C : tuple of float, shape (n,)
        Squares of the resonance wavelengths [um^2].
    wavelength_range : tuple of float, shape (2,)
        Shortest and longest vacuum wavelength [m] of validity.
    name : str
        Name for messages and files; not part of equality.
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
        check_wavelength_range(self.wavelength_range)

    def index(self, wavelength: ArrayLike) -> np.ndarray:  # noqa: D102
        w = wavelengths_within(wavelength, self.wavelength_range, medium_label(self.name, "glass"))
        squared = (w * 1e6) ** 2
        with np.errstate(all="ignore"):
            terms = (b * squared / (squared - c) for b, c in zip(self.B, self.C, strict=True))
            return real_index(np.asarray(1.0 + sum(terms)), w, squared=True)


@check_arguments
@dataclass(frozen=True)
class RelativeToAir(Medium):
    """Medium with an index relative to air by wavelength in air, as in glass catalogues.

    The index against vacuum is the relative index, at the wavelength in air, times that of the air.

    Parameters
    ----------
    relative : Medium
        Index relative to air, by wavelength in air.
    air : Medium
        Air of reference: 20 deg C and one standard atmosphere for most catalogues.
    name : str
        Name for messages and files; not part of equality.
    """

    relative: Medium
    air: Medium
    name: str = field(default="", compare=False)

    def index(self, wavelength: ArrayLike) -> np.ndarray:  # noqa: D102
        w = metres(wavelength, "wavelength")
        n_air = self.air.index(w)
        return n_air * self.relative.index(w / n_air)


@check_arguments
@dataclass(frozen=True)
class ChangedIndex(Medium):
    """Medium with the index of another plus a constant at every wavelength, and more or less dispersion.

    With a factor f, ``n(w) = n_d + change + f (n_0(w) - n_d)``, where ``n_d`` is the index of the other medium at the d
    line. The Abbe number of the other medium is divided by f, its relative partial dispersions stay.

    Parameters
    ----------
    medium : Medium
        The other medium.
    change : float
        Addition to its index.
    name : str
        Name for messages and files; not part of equality.
    dispersion : float
        Factor of its dispersion, positive.
    """

    medium: Medium
    change: float
    name: str = field(default="", compare=False)
    dispersion: float = 1.0

    def __post_init__(self) -> None:
        if not np.isfinite(self.change):
            raise PrescriptionError(f"change = {self.change!r}: expected a finite change of the refractive index")
        if not (np.isfinite(self.dispersion) and self.dispersion > 0):
            raise PrescriptionError(f"dispersion = {self.dispersion!r}: expected a positive factor of the dispersion")

    def index(self, wavelength: ArrayLike) -> np.ndarray:  # noqa: D102
        index = self.medium.index(wavelength)
        if self.dispersion != 1.0:
            at_d = self.medium.index(LINE_D * 1e-6)
            index = at_d + self.dispersion * (index - at_d)
        return index + self.change


def with_index_change(medium: Medium, change: float, dispersion: float = 1.0) -> Medium:
    """Return a medium with its index changed by a constant and its dispersion by a factor; changes accumulate."""
    if isinstance(medium, ChangedIndex):
        change, dispersion = medium.change + change, medium.dispersion * dispersion
        medium = medium.medium
    return ChangedIndex(medium, change, medium.name, dispersion) if change or dispersion != 1.0 else medium


def abbe_number(medium: Medium) -> float:
    """Return the Abbe number ``(n_d - 1) / (n_F - n_C)`` of a medium; infinite without dispersion.

    A DomainError where the medium does not cover the lines d, F and C.
    """
    d, blue, red = (float(medium.index(line * 1e-6)) for line in (LINE_D, LINE_F, LINE_C))
    return (d - 1.0) / (blue - red) if blue != red else np.inf
