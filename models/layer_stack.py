r"""Coatings that depend on the angle of incidence: tables, and stacks of thin films.

A stack of films without absorption between two media, by characteristic matrices (Macleod, "Thin-Film Optical
Filters", chapter 2): with the phase :math:`\delta_j = 2 \pi n_j d_j \cos\theta_j / \lambda` and the admittance
:math:`\eta = n \cos\theta` of s or :math:`n / \cos\theta` of p light,

.. math:: \binom{B}{C} = \prod_j \begin{pmatrix} \cos\delta_j & i \sin\delta_j / \eta_j \\
          i \eta_j \sin\delta_j & \cos\delta_j \end{pmatrix} \binom{1}{\eta_s}, \quad
          T = \frac{4 \eta_0 \operatorname{Re} \eta_s}{\lvert \eta_0 B + C \rvert^2}.

Without films this is Fresnel's transmission. Both polarisations are averaged.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, DomainError, shown
from ..core.units import pure_numbers, require_within
from .media.medium import wavelengths_within

#: Largest refractive index that is taken for one.
_HIGHEST_INDEX = 100.0
#: Lowest refractive index that is taken for one: X-rays and plasmas are close to 1, metals above a hundredth.
_LOWEST_INDEX = 1e-3
#: Vacuum wavelengths of stacks of films [m]: X-rays to radio waves.
_WAVELENGTHS = (1e-12, 1.0)
#: Cosine of the angle of incidence below which nothing is transmitted.
_GRAZING = 1e-100
#: Rounding of the cosines of rays beyond 1.
_ROUNDING = 1e-9


def checked_cosines(cosine: ArrayLike) -> np.ndarray:
    """Return cosines of angles of incidence as an array; DomainError if one is beyond 1."""
    cosines = pure_numbers(cosine, "cosine")
    if np.any(np.abs(cosines) > 1.0 + _ROUNDING):
        raise DomainError(f"cosine = {shown(cosine)}: expected -1 to 1, or NaN", key="cosine")
    return cosines


def cosines_at(cosine: ArrayLike, n1: float, n2: float) -> np.ndarray:
    """Return cosines of angles of incidence as an array; DomainError if one is beyond 1, or an index is none."""
    for name, index in (("n1", n1), ("n2", n2)):
        if not _LOWEST_INDEX <= index <= _HIGHEST_INDEX:
            limits = f"{_LOWEST_INDEX:g} to {_HIGHEST_INDEX:g}"
            raise DomainError(f"{name} = {index!r}: expected a refractive index of {limits}")
    return checked_cosines(cosine)


def check_wavelengths(wavelengths: tuple[float, ...], name: str) -> None:
    """Raise a ConfigError unless the wavelengths [m] of a coating's table are two or more, positive and ascending."""
    waves = np.array(wavelengths)
    if len(waves) < 2 or not (np.isfinite(waves).all() and (waves > 0).all() and (np.diff(waves) > 0).all()):
        raise ConfigError(f"wavelengths of {name or 'a coating'}: expected two or more, positive, ascending")


def within_table(wavelength: ArrayLike, wavelengths: tuple[float, ...], name: str) -> np.ndarray:
    """Return wavelengths [m] as an array, or raise a DomainError where one is outside a coating's table."""
    ends = (wavelengths[0], wavelengths[-1])
    return wavelengths_within(wavelength, ends, f"coating {name}" if name else "the coating")


@check_arguments
@dataclass(frozen=True)
class CoatingTable:
    """Efficiency of a surface against wavelength and angle of incidence, for unpolarised light.

    Parameters
    ----------
    wavelengths : tuple of float, shape (n,)
        Vacuum wavelengths [m], ascending.
    angles : tuple of float, shape (m,)
        Angles of incidence from the normal [rad], on the side of lower index, from 0 and ascending.
    efficiencies : tuple of tuple of float, shape (n, m)
        Reflectivity or transmission, 0 to 1; interpolated linearly along both.
    name : str
        Name for messages and files; not part of equality.
    """

    wavelengths: tuple[float, ...]
    angles: tuple[float, ...]
    efficiencies: tuple[tuple[float, ...], ...]
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        name = self.name or "a coating"
        check_wavelengths(self.wavelengths, self.name)
        angles = np.array(self.angles)
        if len(angles) < 2 or angles[0] != 0 or not ((np.diff(angles) > 0).all() and angles[-1] < 0.5 * np.pi):
            raise ConfigError(f"angles of {name}: expected two or more, from 0, ascending, below 90 degrees")
        rows = [np.array(row) for row in self.efficiencies]
        count = len(self.wavelengths)
        shapes = len(rows) == count and all(row.shape == angles.shape for row in rows)
        if not (shapes and all(((row >= 0) & (row <= 1)).all() for row in rows)):
            text = f"expected {count} rows, one a wavelength, of {len(angles)} numbers from 0 to 1, one an angle"
            raise ConfigError(f"efficiency of {name}: {text}")

    @check_arguments
    def efficiency(self, wavelength: float, cosine: ArrayLike, n1: float, n2: float) -> np.ndarray:
        """Return the efficiency at cosines of the angle of incidence, NaN beyond the table.

        Parameters
        ----------
        wavelength : float
            Vacuum wavelength [m]; a DomainError outside the table.
        cosine : array_like
            Cosine of the angle of incidence.
        n1, n2 : float
            Refractive indices before and behind.
        """
        cosines = cosines_at(cosine, n1, n2)
        w = within_table(wavelength, self.wavelengths, self.name)
        table = np.array(self.efficiencies)
        row = np.array([np.interp(w, self.wavelengths, column) for column in table.T])
        # The angle on the side of lower index.
        sine = np.sqrt(np.maximum(1.0 - cosines**2, 0.0)) * max(n1 / n2, 1.0)
        with np.errstate(invalid="ignore"):
            return np.interp(np.arcsin(sine), self.angles, row, right=np.nan)


@check_arguments
@dataclass(frozen=True)
class LayerStack:
    """Thin films without absorption on a lens surface.

    Parameters
    ----------
    indices : tuple of float
        Refractive indices of the films, from the side of the medium of lower index to the glass.
    thicknesses : tuple of float
        Their thicknesses [m].
    name : str
        Name for messages and files; not part of equality.

    Raises
    ------
    ConfigError
        If there are not as many indices as thicknesses, or one is not positive.
    """

    indices: tuple[float, ...]
    thicknesses: tuple[float, ...]
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        values = np.array([*self.indices, *self.thicknesses])
        if len(self.indices) != len(self.thicknesses) or not (np.isfinite(values).all() and (values > 0).all()):
            raise ConfigError(f"layers of {self.name or 'a coating'}: expected a positive index and thickness of each")

    @check_arguments
    def efficiency(self, wavelength: float, cosine: ArrayLike, n1: float, n2: float) -> np.ndarray:
        """Return the transmission of unpolarised light, 0 where reflection is total, NaN where the cosine is.

        Parameters
        ----------
        wavelength : float
            Vacuum wavelength [m].
        cosine : array_like
            Cosine of the angle of incidence.
        n1, n2 : float
            Refractive indices before and behind.

        Raises
        ------
        DomainError
            If an index or the wavelength is not positive.
        """
        require_within(wavelength, "wavelength", *_WAVELENGTHS, "metres")
        first = cosines_at(cosine, n1, n2).astype(np.complex128)
        order = 1 if n1 <= n2 else -1
        grazing = np.abs(first) < _GRAZING
        first[grazing] = 1.0
        films = list(zip(self.indices, self.thicknesses, strict=True))[::order]
        # Beyond the angle of total reflection cosines are imaginary.
        behind, *inside = (np.sqrt(1.0 - (n1 / n) ** 2 * (1.0 - first**2)) for n in (n2, *(n for n, _ in films)))
        transmission = np.zeros(first.shape)
        for power in (1, -1):
            entry, end = n1 * first**power, n2 * behind**power
            b: Any = 1.0
            c: Any = end
            for (n, thickness), cos in reversed(list(zip(films, inside, strict=True))):
                phase, admittance = 2.0 * np.pi / wavelength * n * thickness * cos, n * cos**power
                b, c = (
                    np.cos(phase) * b + 1j * np.sin(phase) / admittance * c,
                    1j * admittance * np.sin(phase) * b + np.cos(phase) * c,
                )
            transmission += 0.5 * 4.0 * entry.real * end.real / np.abs(entry * b + c) ** 2
        return np.where(grazing, 0.0, transmission)
