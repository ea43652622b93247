"""Named degrees of freedom: the vector that active optics moves, applied to a telescope in one call.

A degree of freedom is a linear combination of parameters of the telescope (:mod:`~.parameters`) and of
figures that its mirrors take on, Zernike terms or maps on grids. So a vector of parameters is a matrix times the vector
of degrees of freedom, and derivatives by the latter are those by the former times the same matrix.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from astropy import units as u

from ...core.errors import ConfigError, DomainError, PachonError, unknown_name
from ...models.shapes.shape import Shape, Sum
from ...models.telescope import Telescope
from ..optimize.sensitivity import Sensitivity, sensitivity
from .parameters import Parameter, apply, parse_parameters

#: What a unit may measure; values are counted in these.
_SI = (u.m, u.rad, u.K, u.dimensionless_unscaled)


def unit_size(text: str) -> float:
    """Return one of a unit in m, rad, K or as a pure number.

    Raises
    ------
    ConfigError
        If it is no unit of these.
    """
    try:
        unit = u.Unit("" if text == "1" else text)
        return next(float(unit.to(base)) for base in _SI if unit.physical_type == base.physical_type)
    except (ValueError, TypeError, StopIteration):
        raise ConfigError(f"unit = {text!r}: expected one of length, angle or temperature, or 1") from None


@dataclass(frozen=True)
class Freedom:
    """One degree of freedom.

    Attributes
    ----------
    name : str
        Its name.
    unit : str
        Unit of its values: "um", "arcsec", "K", "1"...
    of : mapping of str to float
        Address of each thing that it moves, ``<surface or group>.<parameter>`` or ``<figure>.<term>``, and by how much:
        in the address's own SI unit per SI unit of the degree of freedom.
    """

    name: str
    unit: str
    of: Mapping[str, float] = field(hash=False)


@dataclass(frozen=True)
class Figure:
    """A figure that surfaces can take on: what is added to the sag of each of them.

    Attributes
    ----------
    name : str
        Its name, which addresses begin with.
    surfaces : tuple of str
        Surfaces that take it on. A figure of M1 and M3, cast in one piece, is the same function of x and y on both.
    shape : Shape
        The figure with all its terms zero: a ``ZernikeSag`` or ``GridModes``.
    """

    name: str
    surfaces: tuple[str, ...]
    shape: Shape


@dataclass(frozen=True)
class DegreesOfFreedom:
    """A vector of named degrees of freedom.

    Parameters
    ----------
    freedoms : tuple of Freedom
        In the order of the vector.
    figures : tuple of Figure
        Figures that they refer to.
    name, description, source : str
        What they are, and where they come from.

    Raises
    ------
    ConfigError
        If there are none, a name occurs twice, or a unit is none.
    """

    freedoms: tuple[Freedom, ...]
    figures: tuple[Figure, ...] = ()
    name: str = ""
    description: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        if not self.freedoms:
            raise ConfigError("degrees_of_freedom = []: expected at least one")
        for kind, names in (("degree of freedom", self.names), ("figure", tuple(f.name for f in self.figures))):
            for name in names:
                if names.count(name) > 1:
                    raise ConfigError(f"{kind} {name!r} occurs more than once: expected unique names")
        for freedom in self.freedoms:
            try:
                unit_size(freedom.unit)
            except ConfigError as error:
                raise ConfigError(f"degree of freedom {freedom.name!r}: {error}") from None

    @classmethod
    def of_parameters(cls, telescope: Telescope, addresses: Iterable[str | Parameter]) -> DegreesOfFreedom:
        """Return parameters as degrees of freedom, each by its address and in its own unit.

        Raises
        ------
        UnknownNameError, ConfigError
            As :func:`~pachon.design.parameters.parameters.parse_parameters`.
        """
        found = parse_parameters(addresses, telescope)
        return cls(
            tuple(Freedom(p.address, p.unit if p.unit in ("m", "rad") else "1", {p.address: 1.0}) for p in found)
        )

    def __len__(self) -> int:
        return len(self.freedoms)

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the vector."""
        return tuple(freedom.name for freedom in self.freedoms)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the vector's values."""
        return tuple(freedom.unit for freedom in self.freedoms)

    @cached_property
    def sizes(self) -> np.ndarray:
        """One of each unit in SI, shape [n]."""
        return np.array([unit_size(unit) for unit in self.units])

    def select(self, names: Iterable[str]) -> DegreesOfFreedom:
        """Return some of the degrees of freedom, in the order of the names.

        Raises
        ------
        UnknownNameError
            If there is none of a name.
        """
        return replace(self, freedoms=tuple(self.freedoms[self.place(name)] for name in names))

    def place(self, name: str) -> int:
        """Return the place of a degree of freedom in the vector."""
        if name not in self.names:
            raise unknown_name(f"degree of freedom{f' of {self.name}' if self.name else ''}", name, self.names)
        return self.names.index(name)

    def vector(self, values: Any) -> np.ndarray:
        """Return values as a vector, shape [n], each in its unit.

        Parameters
        ----------
        values : array_like, shape [n], or mapping of str to float or Quantity
            Numbers in the units of the degrees of freedom. In a mapping those that are not named are zero.

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
                place = self.place(name)
                if isinstance(value, u.Quantity):
                    try:
                        value = value.to_value("" if self.units[place] == "1" else self.units[place])
                    except u.UnitConversionError:
                        raise DomainError(f"{name} = {value}: expected a unit like {self.units[place]}") from None
                vector[place] = value
        else:
            vector = np.asarray(values, dtype=np.float64)
            if vector.shape != (len(self),):
                raise DomainError(
                    f"vector of shape {list(vector.shape)}: expected [{len(self)}], {self.names[0]} first"
                )
        for name, value in zip(self.names, vector, strict=True):
            if not np.isfinite(value):
                raise DomainError(f"{name} = {float(value)!r}: expected a finite number")
        return vector

    def apply(self, telescope: Telescope, values: Any) -> Telescope:
        """Return the telescope with a vector of degrees of freedom applied.

        All figures are added to the surfaces first, whose order does not matter; then other parameters change; then
        bodies move, groups before what they contain, each turned about its vertex (a group about its pivot) and then
        shifted. Contributions of several degrees of freedom to one parameter are summed before.

        Parameters
        ----------
        telescope : Telescope
            The telescope; it stays as it is.
        values : array_like, shape [n], or mapping of str to float or Quantity
            See :meth:`vector`.

        Raises
        ------
        UnknownNameError, ConfigError, DomainError
            If a value is wrong, or the telescope lacks what a degree of freedom moves.
        """
        vector = self.vector(values)
        used = (
            self.select([name for name, value in zip(self.names, vector, strict=True) if value])
            if any(vector)
            else None
        )
        if used is None:
            return telescope
        prepared, parameters, matrix = used.combination(telescope)
        return apply(prepared, dict(zip(parameters, matrix @ vector[vector != 0.0], strict=True)))

    def combination(self, telescope: Telescope) -> tuple[Telescope, tuple[Parameter, ...], np.ndarray]:
        """Return what the degrees of freedom are made of.

        Returns
        -------
        prepared : Telescope
            The same optics, with the figures that are referred to at zero.
        parameters : tuple of Parameter
            Parameters of that telescope.
        matrix : ndarray, shape [n_parameter, n]
            Change of each parameter in its own unit per unit of each degree of freedom.

        Raises
        ------
        UnknownNameError, ConfigError, DomainError
            If the telescope lacks what a degree of freedom moves.
        """
        homes = {figure.name: figure for figure in self.figures}
        places: dict[str, list[tuple[str, Shape]]] = {}
        prepared = telescope
        rows: dict[str, np.ndarray] = {}
        for column, (freedom, size) in enumerate(zip(self.freedoms, self.sizes, strict=True)):
            for address, weight in freedom.of.items():
                target, _, term = address.partition(".")
                try:
                    found = [address]
                    if target in homes:
                        figure = homes[target]
                        if target in (*telescope.surface_names, *telescope.groups):
                            raise ConfigError(f"figure {target!r} has the name of a surface: expected another name")
                        if term not in figure.shape.parameters:
                            raise unknown_name(f"term of figure {target}", term, figure.shape.parameters)
                        if target not in places:
                            # A figure of its own on each surface, whatever the surface has already.
                            places[target] = [(s, figure.shape) for s in figure.surfaces]
                            for surface in figure.surfaces:
                                prepared = prepared.with_deformation(surface, figure.shape)
                        found = [f"{s}.{_last(prepared.surface(s).shape, shape, term)}" for s, shape in places[target]]
                    parse_parameters(found, prepared)
                except PachonError as error:
                    raise error.within(subject=f"degree of freedom {freedom.name!r}") from None
                for one in found:
                    rows.setdefault(one, np.zeros(len(self)))[column] += weight * size
        return prepared, parse_parameters(rows, prepared), np.array(list(rows.values()))

    def sensitivity(
        self, telescope: Telescope, fields: Any = None, wavelength: Any = None, **options: Any
    ) -> Sensitivity:
        """Return how the wavefront's Zernike coefficients answer to the degrees of freedom.

        Parameters
        ----------
        telescope : Telescope
            The telescope.
        fields, wavelength, **options :
            As for :func:`~pachon.design.optimize.sensitivity.sensitivity`.

        Returns
        -------
        Sensitivity
            In metres of wavefront per unit of each degree of freedom, in the order of the vector.
        """
        prepared, parameters, matrix = self.combination(telescope)
        found = sensitivity(prepared, parameters, fields, wavelength, **options)
        names = tuple(
            Parameter(f.name, f.name, f.name, "motion", "" if f.unit == "1" else f.unit) for f in self.freedoms
        )
        return replace(found, parameters=names, matrix=found.matrix @ matrix)


def _last(shape: Shape, part: Shape, term: str) -> str:
    """Return the name, within a sum, of a term of a part: the last part that is the given one, at zero."""
    if not isinstance(shape, Sum):
        return term
    for name in (term, *(f"part{i}.{term}" for i in range(len(shape.parts), 0, -1))):
        if name in shape.parameters and shape.place(name)[0] is part:
            return name
    raise unknown_name("term", term, shape.parameters)
