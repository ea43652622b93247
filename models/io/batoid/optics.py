"""Optics of batoid files: sections of YAML.

An optic has its class under ``type``, and beside it ``name``, ``coordSys`` within that of the optic around it, and
``inMedium`` and ``outMedium``, by default those of the optic around it. ``CompoundOptic`` and ``Lens`` have ``items``;
``Mirror``, ``RefractiveInterface``, ``Baffle``, ``Detector``, ``Interface`` and ``OPDScreen`` a ``surface`` and an
``obscuration``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from ....core.schema import Section, Tagged, expected, unknown_key
from ....core.yaml_reader import as_number
from ...media.medium import Medium
from ...rotation import rotation_matrix
from ..yaml.coatings import CoatingSection
from ..yaml.design import DesignSection
from ..yaml.reader import FieldSection, GroupSection, WavelengthsSection
from ..yaml.values import ROWS, Length, Number, OptionalNameOrFile, OptionalText, PositiveNumber, Text
from . import ROOT
from .apertures import Obscuration
from .media import AnyMedium
from .shapes import AnySurface

#: Origin [m] and axes of a coordinate system in the global frame.
Frame = tuple[np.ndarray, np.ndarray]
_AXES = dict(zip("xyz", np.eye(3), strict=True))
_STEPS = [*_AXES, "shift", "rotX", "rotY", "rotZ"]


def _steps(value: Any) -> tuple[tuple[str, Any], ...]:
    """Return the shifts and rotations of a coordinate system in the order of the file, which matters."""
    if not isinstance(value, dict):
        raise expected(f"a mapping of {', '.join(_STEPS)}")
    steps = []
    for key, amount in value.items():
        if key not in _STEPS:
            raise unknown_key(key, _STEPS)
        size = 3 if key == "shift" else 1
        numbers = [as_number(v) for v in (amount if isinstance(amount, list) else [amount])]
        if None in numbers or len(numbers) != size or isinstance(amount, list) != (size == 3):
            raise expected("a list of 3 numbers" if size == 3 else "a number", key)
        steps.append((key, np.array(numbers, dtype=np.float64)))
    return tuple(steps)


class Optic(Section):
    """An optic: its name and class, its place in the optic around it, the media before and behind it."""

    type: str
    name: OptionalText = None
    steps: Annotated[Any, BeforeValidator(_steps)] = Field((), alias="coordSys")
    medium_before: AnyMedium | None = Field(None, alias="inMedium")
    medium_after: AnyMedium | None = Field(None, alias="outMedium")
    #: For batoid's pictures, without effect on rays.
    inner_radius: Any = Field(None, alias="R_inner")
    outer_radius: Any = Field(None, alias="R_outer")
    parent: Any = None

    def frame(self, outer: Frame) -> Frame:
        """Return the coordinate system of the optic from that of the optic around it."""
        origin, axes = outer
        for key, amount in self.steps:
            if key.startswith("rot"):
                axes = axes @ rotation_matrix(_AXES[key[-1].lower()] * amount)
            else:
                origin = origin + axes @ (amount if key == "shift" else _AXES[key] * amount)
        return origin, axes


class Interface(Optic):
    """A surface that rays meet."""

    shape: AnySurface = Field(alias="surface")
    obscuration: Obscuration = None


class Stop(Interface):
    """The surface of the stop; batoid takes its place from coordSys alone."""

    z: Any = None


class Screen(Interface):
    """A thin phase screen on a plane."""

    screen: AnySurface

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        if content.get("surface", {"type": "Plane"}) != {"type": "Plane"}:
            raise expected("a Plane", "surface")


#: Sections by the name of the class.
OPTICS: dict[str, type[Optic]] = {}


def _one_of(classes: dict[str, type[Optic]]) -> Tagged:
    return replace(Tagged.by_value("type", classes), built=False)


class Compound(Optic):
    """Several optics; in the outermost one stand the numbers of the whole system."""

    items: Annotated[tuple[Annotated[Optic, _one_of(OPTICS)], ...], ROWS]
    #: As in batoid, the plane that rays start from is at 40 m where no other distance is given.
    back_distance: PositiveNumber = Field(40.0, alias="backDist")
    sphere_radius: PositiveNumber | None = Field(None, alias="sphereRadius")
    pupil_size: PositiveNumber | None = Field(None, alias="pupilSize")
    pupil_obscuration: Number = Field(0.0, alias="pupilObscuration")
    stop: Annotated[Stop | None, _one_of({"Interface": Stop})] = Field(None, alias="stopSurface")
    #: Without effect on rays.
    exit_pupil: Any = Field(None, alias="XPSurface")
    distance: Any = Field(None, alias="dist")
    medium: Any = None

    def media(self, before: Medium, after: Medium) -> list[tuple[Medium, Medium]]:
        """Return the media before and behind each item by default."""
        return [(before, after)] * len(self.items)


class Lens(Compound):
    """Two surfaces with a medium between."""

    medium: AnyMedium

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        if isinstance(content.get("items"), list) and len(content["items"]) != 2:
            raise expected("two items, the faces of the lens", "items")

    def media(self, before: Medium, after: Medium) -> list[tuple[Medium, Medium]]:  # noqa: D102
        return [(before, self.medium), (self.medium, after)]


OPTICS |= {"CompoundOptic": Compound, "Lens": Lens, "OPDScreen": Screen}
OPTICS |= dict.fromkeys(("Mirror", "RefractiveInterface", "Detector", "Baffle", "Interface"), Interface)


class Extras(Section):
    """Parts of a telescope that batoid does not have, in SI."""

    description: Text = ""
    source: Text = ""
    version: Text = "1"
    field: FieldSection | None = None
    wavelengths: WavelengthsSection | None = None
    camera: OptionalNameOrFile = None
    site: OptionalNameOrFile = None
    dispersion_corrector: OptionalText = None
    groups: dict[str, GroupSection] = Field(default_factory=dict)
    design: DesignSection = DesignSection()
    semi_diameters: dict[str, Length] = Field(default_factory=dict)
    coatings: dict[str, CoatingSection] = Field(default_factory=dict)
    coated: dict[str, Text] = Field(default_factory=dict)


class BatoidFile(Section):
    """Keys of a file that are read; batoid ignores others beside them, such as lists of anchors."""

    system: Annotated[Compound, _one_of({"CompoundOptic": Compound})] = Field(alias=ROOT)
    pachon: Extras = Extras.model_construct()
