"""Named degrees of freedom of active optics: a vector of motions and bending modes.

A degree of freedom is a linear combination of parameters of the telescope (:mod:`~.parameters`) and of surface
deformations, Zernike terms or maps on grids. So a vector of parameters is a matrix times the vector of degrees of
freedom, and derivatives with respect to the latter are those with respect to the former times the same matrix.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from astropy import units as u
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError, PachonError, check_unique, unknown_name
from ...core.units import pure_numbers
from ..paraxial import following_pupil
from ..shapes.shape import Shape
from ..shapes.sum import Sum
from ..telescope import Telescope
from .parameters import Parameter, apply, parse_parameters

#: Base units of values.
_SI = (u.m, u.rad, u.K, u.dimensionless_unscaled)


def unit_size(text: str) -> float:
    """Return the size of a unit of length, angle or temperature in m, rad, K or as a pure number ("1")."""
    try:
        unit = u.Unit("" if text == "1" else text)
        return next(float(unit.to(base)) for base in _SI if unit.physical_type == base.physical_type)
    except (ValueError, TypeError, StopIteration):
        raise ConfigError(f"unit = {text!r}: expected one of length, angle or temperature, or 1") from None


@check_arguments
@dataclass(frozen=True)
class DegreeOfFreedom:
    """One degree of freedom.

    Attributes
    ----------
    name, unit : str
        Name, and unit of the values: "um", "arcsec", "K", "1"...
    of : mapping of str to float
        Coefficients by address, ``<surface or group>.<parameter>`` or ``<deformation>.<mode>``: SI unit of the address
        per SI unit of the degree of freedom.
    """

    name: str
    unit: str
    of: Mapping[str, float] = field(hash=False)


@check_arguments
@dataclass(frozen=True)
class SurfaceDeformation:
    """Bending modes of surfaces, which add to their sag.

    Attributes
    ----------
    name : str
        Name, the first part of addresses.
    surfaces : tuple of str
        Deformed surfaces. A deformation of M1 and M3, cast in one piece, is the same function of x and y on both.
    shape : Shape
        Modes with zero amplitude: a ``ZernikeSag`` or ``GridModes``.
    """

    name: str
    surfaces: tuple[str, ...]
    shape: Shape


@check_arguments
@dataclass(frozen=True)
class DegreesOfFreedom:
    """A vector of named degrees of freedom.

    Parameters
    ----------
    members : tuple of DegreeOfFreedom
        Degrees of freedom in the order of the vector.
    deformations : tuple of SurfaceDeformation
        Surface deformations in their addresses.
    name, description, source : str
        Name, description and origin of the set.

    Raises
    ------
    ConfigError
        If there are no members, a name occurs twice, or a unit is unknown.
    """

    members: tuple[DegreeOfFreedom, ...]
    deformations: tuple[SurfaceDeformation, ...] = ()
    name: str = ""
    description: str = ""
    source: str = ""

    def __repr__(self) -> str:
        first_names = ", ".join(self.names[:4]) + ", ..." * (len(self) > 4)
        return f"<DegreesOfFreedom{' ' * bool(self.name)}{self.name}: {len(self)}: {first_names}>"

    def __post_init__(self) -> None:
        if not self.members:
            raise ConfigError("degrees_of_freedom = []: expected at least one")
        check_unique("degree of freedom", self.names)
        check_unique("deformation", [d.name for d in self.deformations])
        for member in self.members:
            try:
                unit_size(member.unit)
            except ConfigError as error:
                raise ConfigError(f"degree of freedom {member.name!r}: {error}") from None

    @classmethod
    def of_parameters(cls, telescope: Telescope, addresses: Iterable[str | Parameter]) -> DegreesOfFreedom:
        """Return parameters as degrees of freedom, each by its address and in its own unit.

        Raises
        ------
        UnknownNameError, ConfigError
            As :func:`~pachon.models.parameters.parameters.parse_parameters`.
        """
        parameters = parse_parameters(addresses, telescope)
        units = [p.unit if p.unit in ("m", "rad") else "1" for p in parameters]
        return cls(
            tuple(DegreeOfFreedom(p.address, unit, {p.address: 1.0}) for p, unit in zip(parameters, units, strict=True))
        )

    def __len__(self) -> int:
        return len(self.members)

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the vector."""
        return tuple(member.name for member in self.members)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the values."""
        return tuple(member.unit for member in self.members)

    @cached_property
    def unit_sizes(self) -> np.ndarray:
        """Sizes of the units in SI, shape [n]."""
        return np.array([unit_size(unit) for unit in self.units])

    def select(self, names: Iterable[str]) -> DegreesOfFreedom:
        """Return some of the degrees of freedom, in the order of the names.

        Raises
        ------
        UnknownNameError
            If a name does not exist.
        """
        return replace(self, members=tuple(self.members[self.index(name)] for name in names))

    def index(self, name: str) -> int:
        """Return the index of a degree of freedom in the vector."""
        if name not in self.names:
            raise unknown_name(f"degree of freedom{f' of {self.name}' if self.name else ''}", name, self.names)
        return self.names.index(name)

    def vector(self, values: ArrayLike | Mapping[str, Any]) -> np.ndarray:
        """Return values as a vector, shape [n], each in its unit.

        Parameters
        ----------
        values : array_like, shape [n], or mapping of str to float or Quantity
            Numbers in the units of the degrees of freedom; zero for those that a mapping leaves out.

        Raises
        ------
        UnknownNameError
            If a name does not exist.
        DomainError
            If the number of values is another, or one is not finite or has a unit that does not convert.
        """
        if isinstance(values, Mapping):
            vector = np.zeros(len(self))
            for name, value in values.items():
                i = self.index(name)
                if isinstance(value, u.Quantity):
                    try:
                        value = value.to_value("" if self.units[i] == "1" else self.units[i])
                    except u.UnitConversionError:
                        raise DomainError(f"{name} = {value}: expected a unit like {self.units[i]}") from None
                vector[i] = value
        else:
            vector = pure_numbers(values, "values")
            if vector.shape != (len(self),):
                raise DomainError(
                    f"values of shape {list(vector.shape)}: expected [{len(self)}], {self.names[0]} first"
                )
        for name, value in zip(self.names, vector, strict=True):
            if not np.isfinite(value):
                raise DomainError(f"{name} = {float(value)!r}: expected a finite number")
        return vector

    def apply(self, telescope: Telescope, values: ArrayLike | Mapping[str, Any]) -> Telescope:
        """Return the telescope with a vector of degrees of freedom applied.

        Deformations are added to the surfaces first, then other parameters change, then bodies move, groups before
        their members: each rotates about its vertex (a group about its pivot) and then shifts. Contributions of several
        degrees of freedom to one parameter are summed before. The entrance pupil follows a stop inside.

        Parameters
        ----------
        telescope, values
            The telescope, which stays as it is, and the vector as in :meth:`vector`.

        Raises
        ------
        UnknownNameError, ConfigError, DomainError
            If a value is wrong, or the telescope lacks a surface or term of a degree of freedom.
        """
        vector = self.vector(values)
        if not vector.any():
            return telescope
        used = self.select(name for name, value in zip(self.names, vector, strict=True) if value)
        prepared, parameters, matrix = used.parameter_matrix(telescope)
        changed = apply(prepared, dict(zip(parameters, matrix @ vector[vector != 0.0], strict=True)))
        return following_pupil(changed, telescope)

    def parameter_matrix(self, telescope: Telescope) -> tuple[Telescope, tuple[Parameter, ...], np.ndarray]:
        """Return the matrix from degrees of freedom to parameters.

        Returns
        -------
        prepared : Telescope
            The same optics, with the deformations at zero amplitude.
        parameters : tuple of Parameter
            Parameters of that telescope.
        matrix : ndarray, shape [n_parameter, n]
            Change of each parameter in its own unit per unit of each degree of freedom.

        Raises
        ------
        UnknownNameError, ConfigError, DomainError
            If the telescope lacks a surface or term of a degree of freedom.
        """
        bending = _Bending({d.name: d for d in self.deformations}, telescope)
        rows: dict[str, np.ndarray] = {}
        for column, (member, size) in enumerate(zip(self.members, self.unit_sizes, strict=True)):
            for address, weight in member.of.items():
                try:
                    parameter_addresses = bending.addresses(address)
                    parse_parameters(parameter_addresses, bending.telescope)
                except PachonError as error:
                    raise error.within(subject=f"degree of freedom {member.name!r}") from None
                for parameter_address in parameter_addresses:
                    rows.setdefault(parameter_address, np.zeros(len(self)))[column] += weight * size
        return bending.telescope, parse_parameters(rows, bending.telescope), np.array(list(rows.values()))


class _Bending:
    """A telescope whose surfaces get deformations, at zero amplitude, when an address refers to them."""

    def __init__(self, deformations: dict[str, SurfaceDeformation], telescope: Telescope) -> None:
        self.telescope, self._deformations = telescope, deformations
        self._added: set[str] = set()

    def addresses(self, address: str) -> list[str]:
        """Return the addresses of parameters for one that may refer to a deformation."""
        target, _, mode = address.partition(".")
        if target not in self._deformations:
            return [address]
        surfaces, shape = self._deformations[target].surfaces, self._deformations[target].shape
        if target in (*self.telescope.surface_names, *self.telescope.groups):
            raise ConfigError(f"deformation {target!r} has the name of a surface: expected another name")
        if mode not in shape.parameters:
            raise unknown_name(f"mode of deformation {target}", mode, shape.parameters)
        if target not in self._added:
            self._added.add(target)
            for surface in surfaces:
                self.telescope = self.telescope.with_deformation(surface, shape)
        return [f"{name}.{_term(self.telescope.surface(name).shape, shape, mode)}" for name in surfaces]


def _term(shape: Shape, component: Shape, mode: str) -> str:
    """Return the name of a mode of a part within a sum; of equal parts the last."""
    if not isinstance(shape, Sum):
        return mode
    for name in (mode, *(f"part{i}.{mode}" for i in range(len(shape.parts), 0, -1))):
        if name in shape.parameters and shape.place(name)[0] is component:
            return name
    raise unknown_name("term", mode, shape.parameters)
