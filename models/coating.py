"""Coating of a surface: efficiency against the wavelength."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import ConfigError
from .layer_stack import CoatingTable, LayerStack, check_wavelengths, cosines_at, within_table


@check_arguments
@dataclass(frozen=True)
class Coating:
    """Efficiency of a surface against the wavelength, for unpolarised light at any angle.

    Parameters
    ----------
    wavelengths : tuple of float, shape (n,)
        Vacuum wavelengths [m], ascending.
    efficiencies : tuple of float, shape (n,)
        Reflectivity or transmission, 0 to 1.
    name : str
        Name for messages and files; not part of equality.
    """

    wavelengths: tuple[float, ...]
    efficiencies: tuple[float, ...]
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        check_wavelengths(self.wavelengths, self.name)
        values, count = np.array(self.efficiencies), len(self.wavelengths)
        if values.shape != (count,) or not ((values >= 0) & (values <= 1)).all():
            text = f"expected {count} numbers from 0 to 1, as many as wavelengths"
            raise ConfigError(f"efficiency of {self.name or 'a coating'}: {text}")

    @check_arguments
    def efficiency(self, wavelength: float, cosine: ArrayLike, n1: float, n2: float) -> np.ndarray:
        """Return the efficiency at a wavelength, the same at all angles of incidence.

        Parameters
        ----------
        wavelength : float
            Vacuum wavelength [m]; a DomainError outside the table.
        cosine : array_like
            Cosine of the angle of incidence.
        n1, n2 : float
            Refractive indices before and behind.
        """
        return np.full(cosines_at(cosine, n1, n2).shape, self.at(wavelength))

    def at(self, wavelength: ArrayLike) -> np.ndarray:
        """Return the efficiency at wavelengths [m]; a DomainError outside the table."""
        return np.interp(within_table(wavelength, self.wavelengths, self.name), self.wavelengths, self.efficiencies)


#: Coatings that a surface may have.
AnyCoating = Coating | CoatingTable | LayerStack
