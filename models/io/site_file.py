"""Sites that come with the package, and site files in YAML."""

from __future__ import annotations

import math
import os
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

from ...core.arguments import check_arguments
from ...core.errors import PrescriptionError, error_context, unknown_name
from ...core.schema import Section, validated
from ...core.yaml_reader import read_mapping
from ..site import Site, Weather
from .bundled import DATA
from .yaml.values import ROWS, Number, OptionalNumber, PositiveNumber, Text

#: Names of the sites that come with the package.
BUNDLED = ("cerro_pachon", "cerro_tololo", "maunakea")


class UnitsSection(Section):
    """Units of the file; stated so that it can be read on its own."""

    altitude: Literal["m"]
    wind_speed: Literal["m/s"]
    r0: Literal["m"]
    outer_scale: Literal["m"]


class LayerSection(Section):
    """Layer of turbulence."""

    altitude: Number
    weight: Number
    wind_speed: Number
    wind_direction_deg: OptionalNumber = None


class WeatherSection(Section):
    """Air at the telescope."""

    pressure_mmhg: Number
    temperature_c: Number
    water_vapour_mmhg: Number


class SiteFile(Section):
    """A site file."""

    name: Text
    description: Text = ""
    source: Text
    units: UnitsSection
    r0: PositiveNumber
    outer_scale: PositiveNumber
    layers: Annotated[tuple[LayerSection, ...], ROWS]
    weather: WeatherSection


@check_arguments
def load_site(name_or_path: str | os.PathLike[str]) -> Site:
    """Load a bundled site by name, or any site by the path of its ``.yaml`` file.

    Raises
    ------
    UnknownNameError
        If it is neither a bundled name nor a path.
    PrescriptionError
        If the file cannot be read, or is malformed: one line with file, key, value and expected value.
    """
    text = os.fspath(name_or_path)
    if text in BUNDLED:
        return _bundled(text)
    path = Path(text)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise unknown_name("site", text, BUNDLED)
    return _read_site(path)


@cache
def _bundled(name: str) -> Site:
    return _read_site(DATA / f"{name}.yaml")


def _read_site(path: Path) -> Site:
    file = validated(SiteFile, read_mapping(path), str(path), PrescriptionError)
    directions = [layer.wind_direction_deg for layer in file.layers]
    with error_context(file=path):
        return Site(
            name=file.name,
            description=file.description,
            source=file.source,
            altitudes=tuple(layer.altitude for layer in file.layers),
            weights=tuple(layer.weight for layer in file.layers),
            wind_speeds=tuple(layer.wind_speed for layer in file.layers),
            wind_directions=tuple(None if d is None else math.radians(d) for d in directions),
            r0=file.r0,
            outer_scale=file.outer_scale,
            weather=Weather(**file.weather.model_dump()),
        )
