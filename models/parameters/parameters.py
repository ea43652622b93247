"""Parameters of a telescope, with addresses such as "M2.dx", "M1.conic" or "L1_entrance.n".

========================== ============================================ ======
address                    meaning                                      unit
========================== ============================================ ======
``M2.dx`` ``dy`` ``dz``    shift along the axes of the telescope        m
``M2.rx`` ``ry`` ``rz``    tilt about the axes of the body              rad
``M1.radius`` ``conic``    a term of the shape                          its own
``M1.a6`` ``M1.Z5``        a power or Zernike term, added if absent     m^-5, m
``silica.n``               refractive index of a medium, wherever it is
``L1_entrance.n``          refractive index behind one surface
``silica.abbe``            Abbe number, the index at the d line stays
``G.lines_per_mm``         grooves of a grating                         1/mm
``G.groove_angle``         direction of its grooves                     rad
``L1_entrance.thickness``  distance to the next surface, along the light m
``L1.thickness``           the same of an element, a group of two         m
========================== ============================================ ======

Shift and tilt are those of :meth:`Telescope.perturbed`, of a surface or a group. *Values are changes*: zero leaves the
telescope as it is. Where several bodies move, groups go before their members. A thickness moves all surfaces behind it
along the axis of the surface in front of it; that comes last. The entrance pupil stays; see :mod:`.changes`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError, check_unique, error_context, unknown_name
from ..grating import Grating
from ..media.medium import Medium, abbe_number, with_index_change
from ..paraxial import following_pupil
from ..rotation import rotation_matrix
from ..shapes.shape import Shape
from ..surface import Interaction
from ..telescope import Telescope
from ..thickness import front_surface, light_axis, thickness, with_thicknesses
from .links import Followers, has_links, with_followers
from .shape_terms import shape_with_term, term_unit, with_changes

_OF_MEDIA = ("n", "abbe")
MOTIONS = ("dx", "dy", "dz", "rx", "ry", "rz")
#: Units of the parameters of a grating.
GROOVES = {"lines_per_mm": "1/mm", "groove_angle": "rad"}


@check_arguments
@dataclass(frozen=True)
class Parameter:
    """One parameter.

    Attributes
    ----------
    address, target : str
        Address, and the surface, group or medium in it.
    name : str
        A motion, a term of the shape, "n", "abbe", "thickness", "lines_per_mm" or "groove_angle".
    kind : {"motion", "shape", "index", "abbe", "thickness", "grating"}
        Kind of the parameter.
    unit : str
        Unit of its values; empty for a pure number.
    """

    address: str
    target: str
    name: str
    kind: Literal["motion", "shape", "index", "abbe", "thickness", "grating"]
    unit: str

    @classmethod
    def parse(cls, text: str, telescope: Telescope) -> Parameter:
        """Return the parameter of a telescope at an address.

        Raises
        ------
        UnknownNameError
            If there is no such surface, group, medium or term.
        ConfigError
            If the text is not an address.
        DomainError
            If a term cannot be added: a Zernike term on a surface without rims; or for the radius of a flat surface.
        """
        media = _media(telescope)
        bodies = (*telescope.surface_names, *telescope.groups, *media)
        # Names may hold dots themselves.
        targets = [b for b in bodies if text.startswith(f"{b}.")]
        if not targets:
            target, dot, name = text.partition(".")
            if not (target and dot and name):
                raise ConfigError(f"parameter {text!r}: expected <surface or group>.<what>, such as M2.dz or M1.conic")
            raise unknown_name("surface, group or medium", target, bodies)
        target = max(targets, key=len)
        name = text[len(target) + 1 :]
        if target in media and target not in telescope.surface_names and target not in telescope.groups:
            if name not in _OF_MEDIA:
                raise unknown_name(f"parameter of medium {target}", name, _OF_MEDIA)
            return cls._of_medium(text, target, name, telescope)
        if name == "thickness":
            front_surface(telescope, target)
            return cls(text, target, name, "thickness", "m")
        if name in MOTIONS:
            return cls(text, target, name, "motion", "m" if name[0] == "d" else "rad")
        if target in telescope.groups:
            raise unknown_name(f"motion of group {target}", name, (*MOTIONS, "thickness"))
        surface = telescope.surface(target)
        if name in _OF_MEDIA:
            if surface.interaction != Interaction.REFRACT:
                raise DomainError(f"parameter {text!r}: expected a refracting surface")
            return cls._of_medium(text, target, name, telescope)
        if name in GROOVES:
            if surface.grating is None:
                raise DomainError(f"parameter {text!r}: expected a surface with a grating")
            return cls(text, target, name, "grating", GROOVES[name])
        shape = shape_with_term(surface, name)
        if np.isinf(shape.parameters[name]):
            curvature = f"{target}.{name.replace('radius', 'curvature')}"
            raise DomainError(f"{text}: expected {curvature}, for {target} is flat")
        return cls(text, target, name, "shape", term_unit(shape, name))

    @classmethod
    def _of_medium(cls, text: str, target: str, name: str, telescope: Telescope) -> Parameter:
        parameter = cls(text, target, name, "index" if name == "n" else "abbe", "")
        if name == "abbe":
            with error_context(subject=f"parameter {text!r}"):
                if not np.isfinite(parameter.value(telescope)):
                    raise DomainError("expected a medium with dispersion")
        return parameter

    def value(self, telescope: Telescope) -> float:
        """Return the present value: of a term, thickness or Abbe number, or the index at the default wavelength.

        It is 0 for a motion.
        """
        if self.kind == "motion":
            return 0.0
        if self.kind == "thickness":
            return thickness(telescope, front_surface(telescope, self.target))
        if self.kind in ("index", "abbe"):
            medium = telescope.surfaces[index_surfaces(telescope, self.target)[0]].medium_after
            return abbe_number(medium) if self.kind == "abbe" else float(medium.index(telescope.default_wavelength))
        if self.kind == "grating":
            return float(getattr(grating_of(telescope, self), self.name))
        return float(telescope.surface(self.target).shape.parameters.get(self.name, 0.0))


class Variables(Protocol):
    """Named changes of a telescope in a fixed order: parameters or degrees of freedom."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the vector."""

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the values; "1" for a pure number."""

    def apply(self, telescope: Telescope, values: ArrayLike) -> Telescope:
        """Return the telescope with a vector of changes applied, each in its unit."""


@dataclass(frozen=True)
class ParameterVector:
    """Parameters in a fixed order, with their addresses for names."""

    parameters: tuple[Parameter, ...]

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Addresses in the order of the vector."""
        return tuple(p.address for p in self.parameters)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the values; "1" for a pure number."""
        return tuple(p.unit or "1" for p in self.parameters)

    def apply(self, telescope: Telescope, values: ArrayLike) -> Telescope:
        """Return the telescope with a vector of changes applied, each in the unit of its parameter.

        The entrance pupil follows a stop inside.
        """
        changes = dict(zip(self.parameters, np.asarray(values, dtype=np.float64), strict=True))
        return following_pupil(apply(telescope, changes), telescope)


def parse_parameters(texts: Iterable[str | Parameter], telescope: Telescope) -> tuple[Parameter, ...]:
    """Return the parameters at addresses; ``M1.Z4-22`` stands for Z4, Z5 ... Z22, ``M2.*`` for six motions."""
    parameters: list[Parameter] = []
    for text in texts:
        if isinstance(text, Parameter):
            parameters.append(text)
            continue
        span = re.fullmatch(r"(.*\.Z)(\d+)-(\d+)", text)
        if span:
            first, last = int(span[2]), int(span[3])
            if not 1 <= first <= last:
                raise ConfigError(f"parameter {text!r}: expected Noll indices that rise, from 1, such as Z4-22")
            highest = Parameter.parse(f"{span[1]}{last}", telescope)
            parameters += [replace(highest, address=f"{span[1]}{j}", name=f"Z{j}") for j in range(first, last + 1)]
        elif text.endswith(".*"):
            parameters += [Parameter.parse(f"{text[:-1]}{motion}", telescope) for motion in MOTIONS]
        else:
            parameters.append(Parameter.parse(text, telescope))
    if not parameters:
        raise ConfigError("parameters = []: expected at least one, such as M2.dz")
    check_unique("parameter", [p.address for p in parameters])
    return tuple(parameters)


def usual_parameters(telescope: Telescope) -> tuple[Parameter, ...]:
    """Return five motions (without rotation about the axis) of every body: outermost groups and mirrors in no group.

    The first mirror is left out: the others are aligned to it. Alone it moves against the detector, as does the first
    surface that bends the light where neither mirrors nor groups are.
    """
    groups = {name: set(members) for name, members in telescope.groups.items()}
    outer = [g for g, members in groups.items() if not any(members < larger for larger in groups.values())]
    inside = set().union(*groups.values()) if groups else set()
    mirrors = [s.name for s in telescope.surfaces if s.interaction == Interaction.MIRROR]
    bodies = [m for m in mirrors[1:] if m not in inside] + outer
    bending = [s.name for s in telescope.surfaces if s.interaction in (Interaction.REFRACT, Interaction.THIN_LENS)]
    single = (*mirrors, *bending, *telescope.surface_names)[:1]
    return parse_parameters([f"{b}.{m}" for b in bodies or single for m in MOTIONS[:5]], telescope)


def with_shape_terms(telescope: Telescope, parameters: Iterable[Parameter]) -> Telescope:
    """Return the same optics with all shape terms of the parameters, zero where they are new."""
    for target, shape in shapes_with_terms(telescope, parameters).items():
        if shape is not telescope.surface(target).shape:
            telescope = telescope.with_shape(target, shape)
    return telescope


def shapes_with_terms(telescope: Telescope, parameters: Iterable[Parameter]) -> dict[str, Shape]:
    """Return the shapes of the surfaces with shape parameters, all of their terms included, by surface."""
    shapes: dict[str, Shape] = {}
    names: dict[str, list[str]] = {}
    for parameter in parameters:
        if parameter.kind == "shape":
            names.setdefault(parameter.target, []).append(parameter.name)
    for target, terms in names.items():
        surface = telescope.surface(target)
        term_names = set(surface.shape.parameters)
        # The highest Zernike term, or power, makes room for those below it.
        for name in sorted(terms, key=lambda name: (len(name), name), reverse=True):
            if name not in term_names:
                surface = replace(surface, shape=shape_with_term(surface, name))
                term_names = set(surface.shape.parameters)
        shapes[target] = surface.shape
    return shapes


def apply(telescope: Telescope, values: Mapping[str, float] | Mapping[Parameter, float]) -> Telescope:
    """Return the telescope with changes applied, each in the unit of its parameter; the argument stays as it is.

    What follows by pickups and solves of the design data changes too (:mod:`.links`). Errors are those of
    :meth:`Parameter.parse`, and a DomainError if a value is not finite or the result is not a valid telescope.
    """
    parameters = [p if isinstance(p, Parameter) else Parameter.parse(p, telescope) for p in values]
    changes = [float(v) for v in values.values()]
    if wrong := [f"{p.address} = {c!r}" for p, c in zip(parameters, changes, strict=True) if not np.isfinite(c)]:
        raise DomainError(f"{wrong[0]}: expected a finite change")
    if has_links(telescope):
        followers = linked(telescope, parameters, changes)
        parameters, changes = list(followers.parameters), followers.values.tolist()
    return _apply_alone(telescope, dict(zip(parameters, changes, strict=True)))


def resolved(telescope: Telescope) -> Telescope:
    """Return a telescope whose solved thicknesses meet their solves; DomainError where one cannot be met."""
    return apply(telescope, {}) if has_links(telescope) else telescope


def linked(telescope: Telescope, parameters: Iterable[Parameter], changes: Iterable[float]) -> Followers:
    """Return parameters and changes with those of all that follows them, and the derivatives."""
    parse = partial(Parameter.parse, telescope=telescope)
    return with_followers(telescope, tuple(parameters), tuple(changes), parse, _apply_alone)


def _apply_alone(telescope: Telescope, values: Mapping[Parameter, float]) -> Telescope:
    """Return the telescope with changes of parameters applied, and nothing that follows them."""
    parameters, changes = tuple(values), tuple(values.values())
    start = telescope
    telescope = with_shape_terms(telescope, [p for p, v in zip(parameters, changes, strict=True) if v])
    shapes: dict[str, Shape] = {}
    media: dict[int, Medium] = {}
    gratings: dict[str, Grating] = {}
    changed_terms: dict[str, list[tuple[str, float]]] = {}
    for parameter, change in zip(parameters, changes, strict=True):
        if not change:
            continue
        if parameter.kind == "shape":
            changed_terms.setdefault(parameter.target, []).append((parameter.name, change))
        elif parameter.kind == "grating":
            ruled = gratings.get(parameter.target) or grating_of(telescope, parameter)
            changed_value = getattr(ruled, parameter.name) + change
            gratings[parameter.target] = replace(ruled, **{parameter.name: changed_value})
        elif parameter.kind in ("index", "abbe"):
            addition, factor = change, 1.0
            if parameter.kind == "abbe":
                number = parameter.value(start)
                if not number + change > 0:
                    raise DomainError(f"{parameter.address} = {number + change:.6g}: expected a positive Abbe number")
                addition, factor = 0.0, number / (number + change)
            for i in index_surfaces(telescope, parameter.target):
                media[i] = with_index_change(media.get(i, telescope.surfaces[i].medium_after), addition, factor)
    for target, terms in changed_terms.items():
        shapes[target] = with_changes(telescope.surface(target).shape, terms)
    if shapes or media or gratings:
        changed = tuple(
            replace(
                s,
                shape=shapes.get(s.name, s.shape),
                medium_after=media.get(i, s.medium_after),
                grating=gratings.get(s.name, s.grating),
            )
            if s.name in shapes or i in media or s.name in gratings
            else s
            for i, s in enumerate(telescope.surfaces)
        )
        telescope = replace(telescope, surfaces=changed)
    for body, motion in _body_motions(telescope, parameters, changes):
        if motion.any():
            telescope = telescope.perturbed(body, shift=motion[:3], tilt=motion[3:])
    moves = zip(parameters, changes, strict=True)
    thicknesses = [(front_surface(start, p.target), v) for p, v in moves if p.kind == "thickness" and v]
    return with_thicknesses(telescope, start, thicknesses) if thicknesses else telescope


def grating_of(telescope: Telescope, parameter: Parameter) -> Grating:
    """Return the grating that a parameter is of."""
    grating = telescope.surface(parameter.target).grating
    if grating is None:
        raise DomainError(f"parameter {parameter.address!r}: expected a surface with a grating")
    return grating


def _media(telescope: Telescope) -> set[str]:
    """Return the names of the media behind refracting surfaces."""
    refracting = (s for s in telescope.surfaces if s.interaction == Interaction.REFRACT)
    return {s.medium_after.name for s in refracting if s.medium_after.name}


def index_surfaces(telescope: Telescope, target: str) -> list[int]:
    """Return the indices of the surfaces with the medium of an index parameter behind them.

    One refracting surface, and those after it up to the next that refracts, or a thin lens with another medium behind
    it; for a medium, all such runs.
    """
    indices: list[int] = []
    inside = False
    for i, surface in enumerate(telescope.surfaces):
        if surface.interaction == Interaction.REFRACT:
            name = surface.name if target in telescope.surface_names else surface.medium_after.name
            inside = name == target
        elif surface.interaction == Interaction.THIN_LENS and inside:
            inside = surface.medium_after == telescope.surfaces[i - 1].medium_after
        if inside:
            indices.append(i)
    return indices


def _body_motions(
    telescope: Telescope, parameters: Iterable[Parameter], values: Iterable[float]
) -> list[tuple[str, np.ndarray]]:
    """Return each body with its shift [m] and tilt [rad], in the order of application."""
    motions: dict[str, np.ndarray] = {}
    for parameter, value in zip(parameters, values, strict=True):
        if parameter.kind == "motion":
            motions.setdefault(parameter.target, np.zeros(6))[MOTIONS.index(parameter.name)] = value
    # A stable sort: bodies of one size stay in their order.
    return sorted(motions.items(), key=lambda item: -len(_members(telescope, item[0])))


def _members(telescope: Telescope, body: str) -> tuple[str, ...]:
    return telescope.groups.get(body, (body,))


def twists(telescope: Telescope, parameters: tuple[Parameter, ...], values: np.ndarray) -> np.ndarray:
    """Return the twist of each surface per unit of each parameter, shape [n_parameter, n_surface, 6].

    A twist is the velocity of the point of the surface's frame at the telescope's origin, and the angular velocity: a
    point ``x`` of the surface moves by ``v + w x x``. It is zero for shapes and indices. The telescope is that before
    the changes `values` of all parameters.
    """
    result = np.zeros((len(parameters), len(telescope.surfaces), 6))
    start, names = telescope, telescope.surface_names
    for body, motion in _body_motions(telescope, parameters, values):
        shift, tilt = motion[:3], motion[3:]
        members = _members(telescope, body)
        places = [names.index(m) for m in members]
        surface = telescope.surface(members[0])
        pivot, axes = (np.array(v) for v in telescope.group_frames.get(body, (surface.vertex, surface.rotation)))
        rotation = axes @ rotation_matrix(tilt) @ axes.T
        # Matrix of the vector product from the left: rotation about the shifted pivot.
        x, y, z = pivot + shift
        about = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        # Bodies that moved before: a member of a moved group rotates about its moved pivot, with it.
        for row, parameter in enumerate(parameters):
            if parameter.kind == "motion" and result[row, places].any():
                larger = telescope.groups.get(parameter.target, ())
                along = body not in telescope.groups or set(members) <= set(larger)
                for place in places:
                    v, w = result[row, place, :3], result[row, place, 3:]
                    if along:
                        result[row, place, :3] = v - np.cross(w, shift)
                    else:
                        w = rotation @ w
                        result[row, place, :3] = rotation @ v + np.cross(w, rotation @ pivot - pivot - shift)
                        result[row, place, 3:] = w
        for row, parameter in enumerate(parameters):
            if parameter.kind != "motion" or parameter.target != body:
                continue
            axis = MOTIONS.index(parameter.name)
            if axis < 3:
                result[row, places, axis] = 1.0
                continue
            # R = Rx Ry Rz: the axis of each factor is rotated by those before it.
            earlier = np.where(np.arange(3) < axis - 3, tilt, 0.0)
            w = axes @ rotation_matrix(earlier)[:, axis - 3]
            result[row, places, :3] = about @ w
            result[row, places, 3:] = w
        if motion.any():
            telescope = telescope.perturbed(body, shift=shift, tilt=tilt)
    for row, parameter in enumerate(parameters):
        if parameter.kind == "thickness":
            first = front_surface(telescope, parameter.target)
            shift = light_axis(start, first)
            behind = result[:, first + 1 :]
            # Points about which bodies rotate are shifted along.
            behind[..., :3] -= np.cross(behind[..., 3:], values[row] * shift)
            result[row, first + 1 :, :3] += shift
    return result
