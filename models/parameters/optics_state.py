"""A state of hexapods and bending modes: values by name, and the telescope that has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from astropy import units as u

from ...core.arguments import check_arguments
from ..telescope import Telescope
from .degrees_of_freedom import DegreesOfFreedom
from .degrees_of_freedom_file import load_degrees_of_freedom


@check_arguments
@dataclass(frozen=True)
class OpticsState:
    """Values of hexapods and bending modes, in um and arcsec.

    Parameters
    ----------
    values : mapping of str to float or Quantity
        Values by the names of the degrees of freedom, in their units; zero for those left out.
    freedoms : DegreesOfFreedom
        The degrees of freedom: those of the LSST by default.

    Raises
    ------
    UnknownNameError
        If a name does not exist.
    DomainError
        If a value is not finite, or has a unit that does not convert.
    """

    values: Mapping[str, Any] = field(default_factory=dict, hash=False)
    freedoms: DegreesOfFreedom = field(default_factory=lambda: load_degrees_of_freedom("lsst"))

    def __post_init__(self) -> None:
        vector = self.freedoms.vector(self.values)
        used = {name: float(v) for name, v in zip(self.freedoms.names, vector, strict=True) if v}
        object.__setattr__(self, "values", used)

    @property
    def vector(self) -> np.ndarray:
        """Values of all degrees of freedom in their order and units, shape [n]."""
        return self.freedoms.vector(self.values)

    def quantity(self, name: str) -> u.Quantity:
        """Return a value with its unit."""
        unit = self.freedoms.units[self.freedoms.index(name)]
        return u.Quantity(self.values.get(name, 0.0), "" if unit == "1" else unit)

    @check_arguments
    def with_values(self, values: Mapping[str, Any]) -> OpticsState:
        """Return the state with other values of some degrees of freedom."""
        return replace(self, values={**self.values, **values})

    @check_arguments
    def telescope(self, nominal: Telescope) -> Telescope:
        """Return a telescope in this state.

        Parameters
        ----------
        nominal : Telescope
            The telescope at zero, which stays as it is.

        Raises
        ------
        UnknownNameError, ConfigError, DomainError
            If the telescope lacks a surface or term, or the result is not a valid telescope.
        """
        return self.freedoms.apply(nominal, self.values)
