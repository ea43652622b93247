"""The section ``design`` of prescription files: design data as the designer stated them.

::

    design:
      length: mm                                    # unit of tables: m, cm, mm or in
      aperture: {f_number: 8.0}                     # or entrance_pupil, working_f_number, object_na, stop
      stop: S6
      aiming: paraxial                              # off, paraxial, real
      fields: {angle: [[0, 0], [0, 14]], weights: [1, 1], vignetting: [[0, 0, 0, 0, 0], [0, 0, 0.1, 0.2, 0]]}
      wavelengths: {values: [0.486, 0.588], weights: [1, 2]}
      environment: {temperature_k: 293.15, pressure_pa: 101325}
      telecentric: false
      afocal: false
      remake_vignetting: false
      pickups:                                      # scale times the value of another surface, plus an offset
        - {surface: S7, radius: S1, scale: -1}       # or conic (with conic_offset), thickness, glass
      solves:
        - {surface: S7, marginal_height: 0}          # or chief_height, edge_thickness with a radius
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator

from ....core.schema import Section, checked, expected
from ....core.yaml_reader import as_number
from ...design_data import DesignData
from ...links import PICKED, SOLVED, Pickup, Solve
from .values import (
    ROWS,
    Flag,
    Info,
    Length,
    Metres,
    Number,
    Numbers,
    OptionalLength,
    OptionalNumber,
    OptionalText,
    Text,
    Turn,
    Wave,
    Wavelengths,
    to_si,
    unit_of,
)

Rows = tuple[tuple[float, ...], ...]


def _rows(size: int) -> Callable[[Any], Rows | None]:
    def convert(value: Any) -> Rows | None:
        if not isinstance(value, list):
            return None
        rows = [tuple(map(as_number, row)) if isinstance(row, list) else () for row in value]
        return None if any(len(row) != size or None in row for row in rows) else tuple(rows)  # type: ignore[arg-type]

    return convert


def _in_si(quantity: str, first: int = 0) -> BeforeValidator:
    """Return the conversion of the numbers of each row from the one of index `first` on."""

    def convert(rows: Rows, info: Info) -> Rows:
        unit = unit_of(quantity, info)
        return tuple((*row[:first], *(to_si(v, unit) for v in row[first:])) for row in rows)

    return BeforeValidator(convert)


_POINTS = checked(_rows(2), "a list of pairs of numbers")
Angles = Annotated[Rows, _in_si("angle"), _POINTS]
Heights = Annotated[Rows, _in_si("length"), _POINTS]
Vignetting = Annotated[Rows, _in_si("angle", 4), checked(_rows(5), "a list of rows of five numbers")]
#: Keys of design data that are true or false.
_FLAGS = ("telecentric", "afocal", "remake_vignetting")


class ApertureSection(Section):
    """One aperture."""

    entrance_pupil: OptionalLength = None
    f_number: OptionalNumber = None
    working_f_number: OptionalNumber = None
    object_na: OptionalNumber = None
    stop: OptionalLength = None

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        if len(content) != 1:
            raise expected(f"one of {', '.join(cls.keys())}")


class FieldsSection(Section):
    """Field points of one type, their weights and vignetting factors."""

    angle: Angles = ()
    object_height: Heights = ()
    paraxial_image_height: Heights = ()
    real_image_height: Heights = ()
    weights: Numbers = ()
    vignetting: Vignetting = ()

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        kinds = cls.keys()[:4]
        if sum(key in content for key in kinds) != 1:
            raise expected(f"one of {', '.join(kinds)}")


class WavelengthsSection(Section):
    """Wavelengths and their weights."""

    values: Wavelengths
    weights: Numbers = ()


class EnvironmentSection(Section):
    """Temperature and pressure."""

    temperature_k: OptionalNumber = None
    pressure_pa: OptionalNumber = None


class PickupSection(Section):
    """Value of a surface that follows that of another, whose name stands behind the quantity."""

    surface: Text
    radius: OptionalText = None
    conic: OptionalText = None
    thickness: OptionalText = None
    glass: OptionalText = None
    scale: Number = 1.0
    offset: Length = 0.0
    conic_offset: Number = 0.0

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        if sum(key in content for key in PICKED) != 1:
            raise expected(f"one of {', '.join(PICKED)}")
        if ("offset" if "conic" in content else "conic_offset") in content:
            raise expected("conic_offset for a conic, and offset for a length")

    def pickup(self) -> Pickup:
        """Return the pickup."""
        quantity = next(key for key in PICKED if getattr(self, key) is not None)
        return Pickup(self.surface, quantity, getattr(self, quantity), self.scale, self.offset + self.conic_offset)


class SolveSection(Section):
    """Thickness behind a surface that is solved for."""

    surface: Text
    marginal_height: OptionalLength = None
    chief_height: OptionalLength = None
    edge_thickness: OptionalLength = None
    radius: Length = 0.0

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        if sum(key in content for key in SOLVED) != 1:
            raise expected(f"one of {', '.join(SOLVED)}")

    def solve(self) -> Solve:
        """Return the solve."""
        kind = next(key for key in SOLVED if getattr(self, key) is not None)
        return Solve(self.surface, kind, getattr(self, kind), self.radius)


class DesignSection(Section):
    """Design data."""

    length: Literal["m", "cm", "mm", "in"] = "m"
    aperture: ApertureSection | None = None
    stop: OptionalText = None
    aiming: Literal["off", "paraxial", "real"] = "off"
    fields: FieldsSection | None = None
    wavelengths: WavelengthsSection | None = None
    environment: EnvironmentSection | None = None
    telecentric: Flag = False
    afocal: Flag = False
    remake_vignetting: Flag = False
    pickups: Annotated[tuple[PickupSection, ...], ROWS] = ()
    solves: Annotated[tuple[SolveSection, ...], ROWS] = ()

    def data(self) -> DesignData:
        """Return the design data."""
        stated: dict[str, Any] = {}
        if self.aperture is not None:
            stated["aperture"], stated["aperture_value"] = _only(self.aperture)
        if self.fields is not None:
            stated |= {"field_weights": self.fields.weights, "vignetting": self.fields.vignetting}
            stated["field_type"], stated["fields"] = _only(self.fields, but=("weights", "vignetting"))
        if self.wavelengths is not None:
            stated |= {"wavelengths": self.wavelengths.values, "wavelength_weights": self.wavelengths.weights}
        if self.environment is not None:
            stated |= {"temperature": self.environment.temperature_k, "pressure": self.environment.pressure_pa}
        stated |= {name: getattr(self, name) for name in _FLAGS}
        stated["pickups"] = tuple(section.pickup() for section in self.pickups)
        stated["solves"] = tuple(section.solve() for section in self.solves)
        return DesignData(length_unit=self.length, stop=self.stop, aiming=self.aiming, **stated)


def _only(section: Section, but: tuple[str, ...] = ()) -> tuple[str, Any]:
    """Return the one key of a section that its file has, but for some, and its value."""
    (key,) = section.model_fields_set - set(but)
    return key, getattr(section, key)


def design_items(data: DesignData) -> dict[str, Any]:
    """Return the section of design data, in metres; what has its default is left out."""
    default = DesignData()
    section: dict[str, Any] = {}
    if data.length_unit != default.length_unit:
        section["length"] = data.length_unit
    if data.aperture is not None:
        value = data.aperture_value
        lengths = value is not None and data.aperture in ("entrance_pupil", "stop")
        section["aperture"] = {data.aperture: Metres(value) if lengths and value is not None else value}
    section |= {key: getattr(data, key) for key in ("stop", "aiming") if getattr(data, key) != getattr(default, key)}
    if data.fields:
        turn = Turn if data.field_type == "angle" else Metres
        fields: dict[str, Any] = {data.field_type: [[turn(v) for v in row] for row in data.fields]}
        fields |= {"weights": data.field_weights} if data.field_weights else {}
        rows = [[*row[:4], Turn(row[4])] for row in data.vignetting]
        section["fields"] = fields | ({"vignetting": rows} if rows else {})
    if data.wavelengths:
        section["wavelengths"] = {"values": [Wave(w) for w in data.wavelengths]}
        section["wavelengths"] |= {"weights": data.wavelength_weights} if data.wavelength_weights else {}
    environment = {"temperature_k": data.temperature, "pressure_pa": data.pressure}
    if stated := {key: value for key, value in environment.items() if value is not None}:
        section["environment"] = stated
    section |= {key: True for key in _FLAGS if getattr(data, key)}
    if data.pickups:
        section["pickups"] = [_pickup_items(pickup) for pickup in data.pickups]
    if data.solves:
        section["solves"] = [
            {"surface": s.surface, s.kind: Metres(s.value)} | ({"radius": Metres(s.radius)} if s.radius else {})
            for s in data.solves
        ]
    return section


def _pickup_items(pickup: Pickup) -> dict[str, Any]:
    offset = "conic_offset" if pickup.quantity == "conic" else "offset"
    items: dict[str, Any] = {"surface": pickup.surface, pickup.quantity: pickup.source}
    items |= {"scale": pickup.scale} if pickup.scale != 1.0 else {}
    if not pickup.offset:
        return items
    return items | {offset: Metres(pickup.offset) if pickup.quantity != "conic" else pickup.offset}
