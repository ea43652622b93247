"""Files of optimisations, YAML.

::

    variables: [S1.radius, S2.radius, S2.thickness, zoom_2:S4.thickness]
    bounds: {S2.thickness_mm: [0.5, 6]}
    merit: spots
    fields_deg: [[0, 0], [0, 8.5], [0, 12]]
    wavelengths_nm: [486.1, 587.6, 656.3]
    operands:
      - {kind: EFFL, target: 25}
      - {kind: edge_thickness_mm, surface: S1, min: 0.5}
      - {kind: distortion_percent, field_deg: [0, 12], min: -1, max: 1}
    configurations:
      - {telescope: zoom_2.yaml, weight: 2}
    glasses: [N-SK16, N-SF2]
    glass_catalogue: schott
    restarts: 10

An operand has one of the kinds of :data:`~.operand.OPERANDS`, with the unit of its numbers at the end of the name; or a
name of Zemax or CODE V (:data:`~.operand_names.NAMES`), in mm, degrees, percent, waves.
Bounds have the unit at the end of the address. The telescope of the command is the first configuration;
`configurations` are further ones, which share the variables.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, error_context, unknown_name
from ...core.schema import Count, Positive, Real, Section, Whole, validated
from ...core.set_keys import set_key_errors, set_keys
from ...core.yaml_reader import as_number, read_mapping
from ...models.io.glass_catalogue import GlassCatalogue
from ...models.io.prescription import load_telescope
from ...models.parameters.changes import ANGLES, LENGTHS, parse_change
from ...models.telescope import Telescope
from ...raytrace.rays import Projection
from .configuration import DesignConfiguration
from .merit_function import SpotSize, WavefrontError
from .operand import OPERANDS, PERCENT, GoalOperand, Operand
from .operand_names import NAMES, OperandName, entry_fields, goal_of, unknown_operand
from .solver import LeastSquares

_DEGREE = ANGLES["deg"]
#: Keys of files for the fields of operands, and their units in SI; other fields have their own names.
_KEYS = {
    "field": ("field_deg", _DEGREE),
    "wavelength": ("wavelength_nm", 1e-9),
    "wavelengths": ("wavelengths_nm", 1e-9),
    "radius": ("radius_mm", 1e-3),
    "frequency": ("frequency_per_mm", 1e3),
    "angle": ("angle_deg", _DEGREE),
}
#: Units at the end of kinds, by the unit of the number.
_UNITS = {"m": LENGTHS, "rad": ANGLES, "1": {"": 1.0, **dict([PERCENT])}}

Pair = tuple[Real, Real]
Pairs = Annotated[tuple[Pair, ...], Field(min_length=1)]
Waves = Annotated[tuple[Positive, ...], Field(min_length=1)]


class OperandSection(Section):
    """An operand: kind with unit, target or limits, weight, and the fields of its kind."""

    kind: str = Field(description="name of the operand, such as EFFL, MNEG or focal_length: pachon operands lists them")
    target: Real | None = Field(None, description="value to reach, in place of min and max")
    min: Real | None = Field(None, description="lowest value allowed")
    max: Real | None = Field(None, description="highest value allowed")
    weight: Positive = Field(1.0, description="weight in the merit function")
    surface: str | None = Field(None, description="surface that is meant")
    first: str | None = Field(None, description="first surface of a range")
    last: str | None = Field(None, description="last surface of a range")
    axis: Literal["x", "y"] | None = Field(None, description="axis that is meant")
    pupil: Pair | None = Field(None, description="place in the pupil, x and y in its radii")
    n_pupil: Count | None = Field(None, description="pupil points along the radius")
    field_deg: Pair | None = Field(None, description="field angles x and y [deg]")
    wavelength_nm: Positive | None = Field(None, description="wavelength [nm]")
    wavelengths_nm: Waves | None = Field(None, description="wavelengths [nm]")
    radius_mm: Positive | None = Field(None, description="distance from the vertex of the surface [mm]")
    frequency_per_mm: Positive | None = Field(None, description="spatial frequency [1/mm]")
    angle_deg: Real | None = Field(None, description="angle [deg]")

    def operand(self) -> Operand:
        """Return the operand; ConfigError or DomainError where its numbers do not fit together."""
        entry, unit = named_operand(self.kind)
        cls, size = (entry.kind, entry.units[unit]) if entry is not None else _kind(self.kind)
        implied = {} if entry is None else entry.implied
        names = [f.name for f in dataclasses.fields(cls) if f.repr and f.name not in implied]
        key_units = {name: _KEYS.get(name, (name, None)) for name in names}
        key_units = {name: pair for name, pair in key_units.items() if pair[0] in _OPERAND_KEYS}
        keys = [key for key, _ in key_units.values()]
        for key in self.model_fields_set & _OPERAND_KEYS:
            if key not in keys:
                raise unknown_name(f"key of operand {self.kind}", key, keys)
        values: dict[str, Any] = {"weight": self.weight, **implied}
        for name, (key, key_unit) in key_units.items():
            if (value := getattr(self, key)) is not None:
                values[name] = value if key_unit is None else _scaled(value, key_unit)
        stated = {"value": self.target, "minimum": self.min, "maximum": self.max}
        if entry is not None:
            stated = goal_of(entry, self.target, self.min, self.max)
            values["stated"] = entry.stated(unit)
        values |= {name: number * size for name, number in stated.items() if number is not None}
        needed = [f for f in dataclasses.fields(cls) if f.default is dataclasses.MISSING]
        for required in needed:
            if required.name not in values:
                raise ConfigError(f"operand {self.kind}: {key_units[required.name][0]} is missing")
        return cls(**values)


#: Keys of operands that say which number it is.
_OPERAND_KEYS = set(OperandSection.model_fields) - {"kind", "target", "min", "max", "weight"}


def operand_of_text(text: str) -> Operand:
    """Return the operand of a text such as "REAY surface=S3 field_deg=0,9", with the keys of files; without a goal.

    Raises
    ------
    ConfigError, UnknownNameError
        If the kind or a key does not exist, a key is missing, or a value is not as expected.
    """
    kind, *pairs = text.split() or [""]
    content: dict[str, Any] = {"kind": kind, "target": 0.0}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or key in ("kind", "target", "min", "max", "weight"):
            raise ConfigError(f"{pair!r}: expected KEY=VALUE, such as surface=S3 or field_deg=0,9")
        numbers = [as_number(item) for item in value.split(",")]
        if None in numbers:
            content[key] = value
        else:
            content[key] = numbers if len(numbers) > 1 else numbers[0]
    return validated(OperandSection, content, f"operand {kind}").operand()


def file_keys(entry: OperandName) -> list[str]:
    """Return the keys of a named operand in files, with a star behind those that it needs."""
    required = entry_fields(entry)
    return [_KEYS.get(name, (name, None))[0] + ("*" if required[name] else "") for name in required]


def named_operand(text: str) -> tuple[OperandName | None, str]:
    """Return the name of Zemax or CODE V that a text begins with, and the unit behind it; None where there is none."""
    name, _, unit = text.partition("_")
    entry = NAMES.get(name)
    if entry is None:
        return None, ""
    if unit and unit not in entry.units:
        raise ConfigError(
            f"operand {text!r}: expected its unit at the end, one of {', '.join(filter(None, entry.units))}"
        )
    return entry, unit or entry.unit


def _kind(text: str) -> tuple[type[GoalOperand], float]:
    """Return the class of a kind with its unit, and the size of the unit in SI."""
    for kind, cls in OPERANDS.items():
        units = _UNITS[cls.unit]
        if text == kind or text.startswith(f"{kind}_"):
            unit = text[len(kind) + 1 :]
            if unit in units:
                return cls, units[unit]
            raise ConfigError(f"operand {text!r}: expected its unit at the end, one of {', '.join(units)}")
    raise unknown_operand(text)


def _scaled(value: Any, unit: float) -> Any:
    return tuple(unit * v for v in value) if isinstance(value, tuple) else unit * value


class StateSection(Section):
    """Fields, wavelengths and operands of a configuration."""

    fields_deg: Pairs | None = Field(None, description="field angles x and y [deg]; the telescope's own by default")
    field_weights: tuple[Real, ...] | None = Field(None, description="weights of the fields")
    wavelengths_nm: Waves | None = Field(None, description="wavelengths [nm]; the telescope's own by default")
    wavelength_weights: tuple[Real, ...] | None = Field(None, description="weights of the wavelengths")
    operands: tuple[OperandSection, ...] = Field((), description="values to hold or to reach besides the merit")

    def rays(self) -> dict[str, Any]:
        """Return fields, wavelengths and their weights as arguments."""
        return {
            "fields": None if self.fields_deg is None else [_scaled(pair, _DEGREE) for pair in self.fields_deg],
            "wavelengths": None if self.wavelengths_nm is None else list(_scaled(self.wavelengths_nm, 1e-9)),
            "field_weights": None if self.field_weights is None else list(self.field_weights),
            "wavelength_weights": None if self.wavelength_weights is None else list(self.wavelength_weights),
        }

    def operand_list(self) -> list[Operand]:
        """Return the operands; an error names the place."""
        operands = []
        for i, section in enumerate(self.operands):
            with error_context(key=f"operands.{i}"):
                operands.append(section.operand())
        return operands


class ConfigurationSection(StateSection):
    """A further telescope that shares the variables."""

    telescope: str = Field(description="name or file of the further telescope, whose variables are the same")
    configuration: Count | None = Field(None, description="number of the configuration of a Zemax file")
    weight: Positive = Field(1.0, description="weight in the merit function")


class OptimizeFile(StateSection):
    """Content of a file of an optimisation."""

    variables: Annotated[tuple[str, ...], Field(min_length=1)] = Field(
        description="addresses of what may change, such as M2.dz, L1.thickness, Camera.*"
    )
    bounds: dict[str, Pair] = Field(
        default_factory=dict, description="lowest and highest value of variables: {M1.conic: [-1.1, -0.9]}"
    )
    merit: Literal["spots", "wavefront"] = Field(
        "spots", description="what is minimised: size of spots, or error of the wavefront"
    )
    reference: Literal["centroid", "chief"] = Field("centroid", description="middle of the spots")
    configurations: tuple[ConfigurationSection, ...] = Field(
        (), description="further telescopes that share the variables"
    )
    glasses: tuple[str, ...] = Field((), description="media for which glasses of the catalogue are tried")
    nearest_glasses: Count = Field(4, description="glasses that are tried for each medium")
    glass_catalogue: str | None = Field(None, description="maker, or file of glasses (.agf)")
    n_pupil: Count | None = Field(None, description="pupil points along the radius")
    max_steps: Count = Field(200, description="most steps of a start")
    restarts: Whole = Field(0, description="random starts beside the first")
    spread: Positive = Field(0.3, description="random change of a variable at a start, a fraction of its value")
    seed: Whole = Field(0, description="seed of the random starts")


def catalogue_of(file: OptimizeFile, path: Path) -> GlassCatalogue | None:
    """Return the catalogue that a file names: that of a maker, or an AGF file from its folder on; None by default."""
    name = file.glass_catalogue
    if name is None or not file.glasses:
        if name is not None:
            raise ConfigError(f"glass_catalogue = {name!r}: expected glasses that are chosen from it", file=path)
        return None
    with error_context(file=path, key="glass_catalogue"):
        if Path(name).suffix.lower() == ".agf":
            return GlassCatalogue.read(path.parent / name)
        return GlassCatalogue.of_maker(name)


@check_arguments
def load_optimization(path: str | os.PathLike[str], settings: Sequence[str] = ()) -> OptimizeFile:
    """Read the file of an optimisation, with other values of some keys: ``key=value`` each.

    Raises
    ------
    ConfigError
        If the file cannot be read, or is malformed: one line with file, key, value and what was expected.
    """
    path = Path(path)
    content = set_keys(OptimizeFile, read_mapping(path, ConfigError), settings)
    with set_key_errors(settings):
        return validated(OptimizeFile, content, str(path))


def optimization_arguments(
    file: OptimizeFile, telescope: Telescope, path: Path, projection: Projection = "zemax"
) -> dict[str, Any]:
    """Return the arguments of :func:`~.optimize.optimize` for a file and the telescope of its command.

    Paths in the file start from its folder. Errors name the file and the key.
    """
    common: dict[str, Any] = file.rays()
    with error_context(file=path):
        operands = file.operand_list()
        states = [DesignConfiguration(telescope, **common, operands=operands, projection=projection)]
        for i, section in enumerate(file.configurations):
            with error_context(key=f"configurations.{i}"):
                beside = path.parent / section.telescope
                position = load_telescope(
                    beside if beside.is_file() else section.telescope, configuration=section.configuration
                )
                if position.name in [s.telescope.name for s in states] and beside.is_file():
                    # Positions of a zoom lens, saved from one telescope, have its name.
                    position = dataclasses.replace(position, name=beside.stem)
                rays = section.rays()
                for listed, weights in (("fields", "field_weights"), ("wavelengths", "wavelength_weights")):
                    if rays[listed] is None:
                        # Weights belong to the points that they are stated with.
                        rays[listed] = common[listed]
                        rays[weights] = common[weights] if rays[weights] is None else rays[weights]
                states.append(
                    DesignConfiguration(
                        position, **rays, weight=section.weight, operands=section.operand_list(), projection=projection
                    )
                )
        bounds = {}
        for text, pair in file.bounds.items():
            owner, colon, name = text.rpartition(":")
            telescopes = {s.telescope.name: s.telescope for s in states}
            if colon and owner not in telescopes:
                raise unknown_name("configuration of bounds", owner, telescopes)
            parameter, size = parse_change(telescopes[owner] if colon else telescope, name, "bounds")
            bounds[owner + colon + parameter.address] = (size * pair[0], size * pair[1])
    return {
        "telescope": states if file.configurations else states[0],
        "variables": file.variables,
        "merit": SpotSize(file.reference) if file.merit == "spots" else WavefrontError(),
        "bounds": bounds,
        "n_pupil": file.n_pupil,
        "solver": LeastSquares(max_steps=file.max_steps, restarts=file.restarts, spread=file.spread, seed=file.seed),
    }
