"""Tolerances of a file as degrees of freedom of a telescope."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...core.errors import ConfigError, error_context, unknown_name
from ...design.optimize.geometry_operands import clear_radius
from ...models.element_groups import element_groups
from ...models.media.medium import abbe_number
from ...models.parameters.changes import ANGLES, LENGTHS, parse_change
from ...models.parameters.degrees_of_freedom import DegreeOfFreedom, DegreesOfFreedom, SurfaceDeformation
from ...models.parameters.degrees_of_freedom_file import load_degrees_of_freedom
from ...models.parameters.links import followers
from ...models.parameters.parameters import Parameter, resolved
from ...models.parameters.tolerances import Tolerance
from ...models.shapes.polynomial import ZernikeSag
from ...models.surface import Interaction, Surface
from ...models.telescope import Telescope
from ...models.zernike_polynomials import noll_to_nm
from .file import ToleranceFile, ToleranceSection

#: Radii of shapes; biconics and toroids have two.
_RADII = ("radius", "radius_x", "radius_y")
#: Compound tolerances: two motions of one body each.
_PAIRS = {"tilt": ("rx", "ry"), "decentre": ("dx", "dy")}
#: Units of compound tolerances, for messages.
_USUAL_UNITS = {"tilt": "arcmin", "decentre": "um", "wedge": "arcmin", "irregularity": "nm"}
#: End of the names of the deformations of irregularities.
_IRREGULAR = "_irregularity"


@dataclass(frozen=True)
class TolerancePlan:
    """Tolerances and compensators of a telescope.

    Attributes
    ----------
    telescope : Telescope
        The telescope, its elements among its groups.
    tolerances : tuple of Tolerance
        Tolerances of degrees of freedom by name.
    compensators : tuple of str
        Names of degrees of freedom.
    degrees_of_freedom : DegreesOfFreedom
        All of them, tolerances first.
    """

    telescope: Telescope
    tolerances: tuple[Tolerance, ...]
    compensators: tuple[str, ...]
    degrees_of_freedom: DegreesOfFreedom


def tolerance_plan(file: ToleranceFile, telescope: Telescope) -> TolerancePlan:
    """Return the tolerances of a file for a telescope.

    Raises
    ------
    UnknownNameError, ConfigError, DomainError
        If a name does not exist, one is tolerance and compensator, or there is no tolerance.
    """
    telescope, elements = with_elements(resolved(telescope))
    maker = _Maker(telescope, file)
    quantities: dict[str, tuple[DegreeOfFreedom, Tolerance]] = {}
    listed: set[str] = set()
    for section in _common(file, telescope, elements):
        quantities |= maker.of(section)
    for i, section in enumerate(file.tolerances):
        with error_context(key=f"tolerances.{i}"):
            section_quantities = maker.of(section)
            replaced = _same_quantity(section_quantities, quantities)
            if twice := replaced & listed:
                raise ConfigError(f"{section.name} is {min(twice)} once more: expected each quantity once")
            # In another unit, or as a percentage, a quantity replaces that of all surfaces.
            quantities = {name: quantity for name, quantity in quantities.items() if name not in replaced}
            listed |= set(section_quantities)
            if section.name.rpartition(".")[2].startswith("irregularity"):
                # Another range of terms replaces all of those before.
                begin = next(iter(section_quantities)).rpartition(" ")[0]
                quantities = {
                    name: quantity for name, quantity in quantities.items() if not name.startswith(f"{begin} ")
                }
            quantities |= section_quantities
    if not quantities:
        raise ConfigError("tolerances = []: expected at least one, or some of surfaces, elements and gaps")
    free = {}
    for name in file.compensators:
        with error_context(key="compensators"):
            if name in quantities:
                raise ConfigError(f"{name!r} is a tolerance too: expected either a tolerance or a compensator")
            free[name] = maker.freedom(name)
    members = (*(freedom for freedom, _ in quantities.values()), *free.values())
    dof = DegreesOfFreedom(members, tuple(maker.deformations.values()))
    return TolerancePlan(telescope, tuple(t for _, t in quantities.values()), tuple(free), dof)


def _same_quantity(
    section_quantities: Mapping[str, tuple[DegreeOfFreedom, Tolerance]],
    quantities: Mapping[str, tuple[DegreeOfFreedom, Tolerance]],
) -> set[str]:
    """Return the names of tolerances that are of the one parameter of a tolerance of a section."""
    parameters = {tuple(freedom.of) for freedom, _ in section_quantities.values() if len(freedom.of) == 1}
    return {name for name, (freedom, _) in quantities.items() if tuple(freedom.of) in parameters}


def _common(file: ToleranceFile, telescope: Telescope, elements: tuple[str, ...]) -> Iterator[ToleranceSection]:
    """Yield the tolerances of all surfaces, elements and gaps; what follows other values has those of its sources."""
    following = followers(telescope)

    def sections(body: str, of: Any, keys: dict[str, str]) -> Iterator[ToleranceSection]:
        for key, name in keys.items():
            if (size := getattr(of, key)) is not None:
                quantity = {"n": "glass", "abbe_percent": "glass"}.get(name, name.partition("_")[0])
                if (body, quantity) not in following:
                    yield ToleranceSection(name=f"{body}.{name}", size=size)

    acting = [s for s in telescope.surfaces if s.interaction in (Interaction.MIRROR, Interaction.REFRACT)]
    inner = {member for element in elements for member in telescope.groups[element]}
    for surface in acting:
        if surface.interaction == Interaction.REFRACT and surface.name not in inner:
            continue
        plain = {k: k for k in type(file.surfaces).model_fields if k != "radius_percent" or _radii(surface)}
        yield from sections(surface.name, file.surfaces, plain)
    glasses: list[str] = []
    for element in elements:
        plain = {k: k for k in ("decentre_um", "tilt_arcmin", "wedge_arcmin")}
        yield from sections(element, file.elements, plain)
        glasses += [s.name for s in acting if s.name in telescope.groups[element][:-1]]
    for name in glasses:
        yield from sections(name, file.elements, {"thickness_um": "thickness_um"})
        # Behind a mirror within the glass, as of a Mangin mirror, the index is that of the surface where light entered.
        if telescope.surface(name).interaction == Interaction.MIRROR:
            continue
        yield from sections(name, file.elements, {"index": "n"})
        if np.isfinite(abbe_number(telescope.surface(name).medium_after)):
            yield from sections(name, file.elements, {"abbe_percent": "abbe_percent"})
    for surface in acting[:-1]:
        if surface.name not in glasses:
            yield from sections(surface.name, file.gaps, {"thickness_um": "thickness_um"})


class _Maker:
    """Degrees of freedom and tolerances of sections of a file; deformations gather as they are needed."""

    def __init__(self, telescope: Telescope, file: ToleranceFile) -> None:
        self.telescope, self._file = telescope, file
        name = file.degrees_of_freedom
        self._named = None if name is None else load_degrees_of_freedom(name)
        self.deformations = {d.name: d for d in (self._named.deformations if self._named else ())}

    def of(self, section: ToleranceSection) -> dict[str, tuple[DegreeOfFreedom, Tolerance]]:
        """Return the degrees of freedom of a tolerance by name, and the tolerance of each."""
        body, _, quantity = section.name.rpartition(".")
        kind, _, unit = quantity.rpartition("_")
        if kind in _PAIRS and unit in (ANGLES if kind == "tilt" else LENGTHS):
            return self._alike(section, [self.freedom(f"{body}.{motion}_{unit}") for motion in _PAIRS[kind]])
        if kind == "wedge" and unit in ANGLES:
            last = self._last(body)
            members = [DegreeOfFreedom(f"{body}.wedge_{m[1]}_{unit}", unit, {f"{last}.{m}": 1.0}) for m in ("rx", "ry")]
            return self._alike(section, members)
        if kind in ("abbe", *_RADII) and unit == "percent":
            return self._alike(section, [self._percentage(body, name) for name in self._percent_names(body, kind)])
        if kind == "irregularity" and unit in LENGTHS:
            return self._irregularity(section, body, unit)
        without_unit = quantity if quantity in _USUAL_UNITS else kind
        if without_unit in _USUAL_UNITS:
            expected = f"{body}.{without_unit}_{_USUAL_UNITS[without_unit]}"
            raise ConfigError(f"{section.name}: expected its unit at the end, such as {expected}")
        return self._alike(section, [self.freedom(section.name)])

    def _percent_names(self, body: str, kind: str) -> tuple[str, ...]:
        """Return the parameters of a body that a percentage is of: both radii of a biconic or a toroid."""
        surface = {s.name: s for s in self.telescope.surfaces}.get(body)
        if kind != "radius" or surface is None or "radius" in surface.shape.parameters:
            return (kind,)
        return _radii(surface) or (kind,)

    def _percentage(self, body: str, name: str) -> DegreeOfFreedom:
        address = f"{body}.{name}"
        percent = 0.01 * Parameter.parse(address, self.telescope).value(self.telescope)
        return DegreeOfFreedom(f"{address}_percent", "1", {address: percent})

    def freedom(self, name: str) -> DegreeOfFreedom:
        """Return the degree of freedom of a name: a named one, or a parameter with its unit."""
        if self._named is not None and name in self._named.names:
            return self._named.members[self._named.index(name)]
        parameter, _ = parse_change(self.telescope, name, "")
        unit = name.rpartition("_")[2] if parameter.unit in ("m", "rad") else "1"
        return DegreeOfFreedom(name, unit, {parameter.address: 1.0})

    def _alike(
        self, section: ToleranceSection, members: list[DegreeOfFreedom]
    ) -> dict[str, tuple[DegreeOfFreedom, Tolerance]]:
        distribution = section.distribution or self._file.distribution
        return {m.name: (m, Tolerance(m.name, section.size, distribution, section.limit)) for m in members}

    def _last(self, body: str) -> str:
        """Return the last surface of an element."""
        groups = self.telescope.groups
        if body not in groups or len(groups[body]) < 2:
            raise unknown_name("element with a wedge", body, [g for g, members in groups.items() if len(members) > 1])
        return groups[body][-1]

    def _irregularity(
        self, section: ToleranceSection, body: str, unit: str
    ) -> dict[str, tuple[DegreeOfFreedom, Tolerance]]:
        """Return Zernike terms of the sag, normal deviates whose variances fall with the radial order and add up."""
        first, last = section.zernikes
        if not 4 <= first <= last:
            raise ConfigError(f"zernikes = [{first}, {last}]: expected Noll indices that rise, from 4")
        surface = self.telescope.surface(body)
        radius = clear_radius(self.telescope, body)
        if not np.isfinite(radius):
            raise ConfigError(f"{section.name}: expected a surface with a clear aperture")
        name = body.replace(".", "_") + _IRREGULAR
        terms = range(first, last + 1)
        deformation = self.deformations.get(name)
        count = max(last, len(deformation.shape.parameters) if deformation else 0)
        self.deformations[name] = SurfaceDeformation(name, (surface.name,), ZernikeSag((0.0,) * count, radius))
        variance = np.array([float(noll_to_nm(j)[0]) ** -section.power for j in terms])
        sizes = section.size * np.sqrt(variance / variance.sum())
        zernike_terms = {}
        for j, size in zip(terms, sizes, strict=True):
            member = DegreeOfFreedom(f"{section.name} Z{j}", unit, {f"{name}.Z{j}": 1.0})
            zernike_terms[member.name] = (member, Tolerance(member.name, float(size), "normal"))
        return zernike_terms


def _radii(surface: Surface) -> tuple[str, ...]:
    """Return the names of the radii of a surface, those of flat sections left out."""
    values = surface.shape.parameters
    return tuple(name for name in _RADII if np.isfinite(values.get(name, np.inf)))


def with_elements(telescope: Telescope) -> tuple[Telescope, tuple[str, ...]]:
    """Return the telescope with a group for each element, and the names of these groups.

    Elements are those of :func:`~pachon.models.element_groups.element_groups`. The group of one is that which the
    telescope has, or a new one: L1, L2...
    """
    groups = dict(telescope.groups)
    group_names = {members: name for name, members in groups.items()}
    names = []
    for members in element_groups(telescope.surfaces, telescope.medium_before).values():
        if members not in group_names:
            used_names = {*groups, *telescope.surface_names}
            group_names[members] = next(
                name for i in range(1, len(used_names) + 2) if (name := f"L{i}") not in used_names
            )
            groups[group_names[members]] = members
        names.append(group_names[members])
    return replace(telescope, groups=groups), tuple(names)
