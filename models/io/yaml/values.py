"""Values of prescription files: annotated types that check and convert to SI, and their text.

A prescription is validated with its :class:`Units` as context.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import AfterValidator, ValidationInfo

from ....core.schema import checked
from ....core.yaml_reader import as_number
from ...surface import Matrix

Convert = Callable[[float], float]


def _power_of_ten(exponent: int) -> Convert:
    """Return a conversion that moves the decimal point of the number as written: 0.545 um is the float 545e-9 m."""
    return lambda v: float(Decimal(repr(v)).scaleb(exponent))


LENGTHS: dict[str, Convert] = {"m": _power_of_ten(0), "mm": _power_of_ten(-3)}
ANGLES: dict[str, Convert] = {"rad": _power_of_ten(0), "deg": math.radians}
WAVELENGTHS: dict[str, Convert] = {"m": _power_of_ten(0), "um": _power_of_ten(-6), "nm": _power_of_ten(-9)}


@dataclass(frozen=True)
class Units:
    """Conversions of a prescription file to SI.

    Parameters
    ----------
    length, angle, wavelength : callable
        Conversions to m, rad and m.
    folder : Path
        Folder of the file, from which relative paths in it start.
    """

    length: Convert
    angle: Convert
    wavelength: Convert
    folder: Path

    @classmethod
    def of(cls, content: Any, folder: Path) -> Units:
        """Return the units that a section names; SI in place of a name that is none, which is an error by itself."""
        names: Mapping[str, Any] = content if isinstance(content, dict) else {}

        def conversion(key: str, known: dict[str, Convert]) -> Convert:
            name = names.get(key)
            return known.get(name, float) if isinstance(name, str) else float

        return cls(
            conversion("length", LENGTHS),
            conversion("angle", ANGLES),
            conversion("wavelength", WAVELENGTHS),
            folder,
        )


def _numbers(size: int | None) -> Callable[[Any], tuple[float, ...] | None]:
    def convert(value: Any) -> tuple[float, ...] | None:
        if not isinstance(value, list) or (size is not None and len(value) != size):
            return None
        found = tuple(n for n in map(as_number, value) if n is not None)
        return found if len(found) == len(value) else None

    return convert


def _matrix(value: Any) -> Matrix | None:
    rows = [_numbers(3)(row) for row in value] if isinstance(value, list) and len(value) == 3 else [None]
    return None if None in rows else tuple(rows)  # type: ignore[return-value]


def _positive(value: Any) -> float | None:
    number = as_number(value)
    return number if number is not None and number > 0 else None


def _radius(value: Any) -> float | None:
    return math.inf if value == "flat" else as_number(value)


def names(value: Any) -> tuple[str, ...] | None:
    """Return a list of names that is not empty as a tuple, and None for other values."""
    named = isinstance(value, list) and value and all(isinstance(v, str) for v in value)
    return tuple(value) if named else None


def rows(value: Any) -> list[Any] | None:
    """Return a list of mappings that is not empty, and None for other values."""
    return value if isinstance(value, list) and value and all(isinstance(v, dict) for v in value) else None


def array(kind: str, shape: tuple[int, ...]) -> Callable[[Any], np.ndarray | None]:
    """Return a function that decodes an array from base 64; None where the text is none."""

    def decode(value: Any) -> np.ndarray | None:
        try:
            return np.frombuffer(base64.b64decode(value, validate=True), dtype=kind).reshape(shape)
        except (binascii.Error, ValueError, TypeError):
            return None

    return decode


def units(info: ValidationInfo) -> Units:
    """Return the units of the file that is validated."""
    assert isinstance(info.context, Units)
    return info.context


def _converted(quantity: str) -> AfterValidator:
    def convert(value: Any, info: ValidationInfo) -> Any:
        to_si = getattr(units(info), quantity)
        return tuple(to_si(v) for v in value) if isinstance(value, tuple) else to_si(value)

    return AfterValidator(convert)


_TEXT = checked(lambda v: v if isinstance(v, str) and v.strip() else None, "a text")
_BESIDE = AfterValidator(lambda name, info: units(info).folder / name)
_NUMBER, _POSITIVE = checked(as_number, "a number"), checked(_positive, "a positive number")
_LIST, _PAIR, _TRIPLE = (
    checked(_numbers(size), f"a list of {size} numbers" if size else "a list of numbers") for size in (None, 2, 3)
)

Text = Annotated[str, _TEXT]
OptionalText = Annotated[str | None, _TEXT]
OptionalFile = Annotated[Any, _TEXT, _BESIDE]
Names = Annotated[tuple[str, ...], checked(names, "a list of names")]
OptionalNames = Annotated[tuple[str, ...] | None, checked(names, "a list of names")]
Flag = Annotated[bool, checked(lambda v: v if isinstance(v, bool) else None, "true or false")]
Number = Annotated[float, _NUMBER]
OptionalNumber = Annotated[float | None, _NUMBER]
PositiveNumber = Annotated[float, _POSITIVE]
Numbers = Annotated[tuple[float, ...], _LIST]
Rotation = Annotated[Matrix, checked(_matrix, "three rows of three numbers")]
Length = Annotated[float, _NUMBER, _converted("length")]
OptionalLength = Annotated[float | None, _NUMBER, _converted("length")]
PositiveLength = Annotated[float, _POSITIVE, _converted("length")]
Radius = Annotated[float, checked(_radius, "a number"), _converted("length")]
Lengths = Annotated[tuple[float, ...], _LIST, _converted("length")]
Point = Annotated[tuple[float, float], _PAIR, _converted("length")]
OptionalPoint = Annotated[tuple[float, float] | None, _PAIR, _converted("length")]
OptionalPlace = Annotated[tuple[float, float, float] | None, _TRIPLE, _converted("length")]
Angle = Annotated[float, _NUMBER, _converted("angle")]
PositiveAngle = Annotated[float, _POSITIVE, _converted("angle")]
OptionalAngles = Annotated[tuple[float, float, float] | None, _TRIPLE, _converted("angle")]
Wavelength = Annotated[float, _POSITIVE, _converted("wavelength")]
Wavelengths = Annotated[tuple[float, ...], _LIST, _converted("wavelength")]
Band = Annotated[tuple[float, float], _PAIR, _converted("wavelength")]
OptionalBand = Annotated[tuple[float, float] | None, _PAIR, _converted("wavelength")]


class Bare(str):
    """Text that stands in a file as it is."""


def encoded(values: np.ndarray, kind: str) -> Bare:
    """Return an array as numbers of a kind in base 64, quoted."""
    return Bare(json.dumps(base64.b64encode(values.astype(kind).tobytes()).decode()))


def number_text(value: float) -> str:
    """Return a float as the shortest text that loads back equal, a float in YAML too."""
    # YAML 1.1 takes 8e-07 for text: a number needs its point.
    return re.sub(r"^(-?\d+)e", r"\1.0e", repr(float(value) + 0.0))


def flow(value: Any, number: Callable[[float], str] = number_text) -> str:
    """Return a value in YAML's flow style, on one line; `number` gives the text of a float."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {flow(v, number)}" for key, v in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(flow(v, number) for v in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Bare):
        return value
    if isinstance(value, str):
        plain = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_.()/;+ -]*", value) and value == value.strip()
        return value if plain and yaml.safe_load(value) == value else json.dumps(value, ensure_ascii=False)
    return number(value)
