"""Values of prescription files: annotated types that check them, convert them to SI and write them.

A prescription is validated with its folder and, once they are read, its units (:class:`UnitsSection`) as context.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import re
from collections.abc import Callable, Mapping
from decimal import Decimal
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import AfterValidator, BeforeValidator, ValidationInfo

from ....core.schema import Section, WrittenAs, checked
from ....core.yaml_reader import WrittenFloat, as_number
from ...surface import Matrix

#: Context of the validators: the folder of the file, and its units.
Info = ValidationInfo[dict[str, Any]]
#: Powers of ten, the last excluded, of numbers that are written without an exponent, as Python's own.
_PLAIN_EXPONENTS = (-4, 16)
#: Units but for degrees, as powers of ten of the SI unit.
_POWERS = {"m": 0, "rad": 0, "mm": -3, "um": -6, "nm": -9}


def to_si(value: float, unit: str) -> float:
    """Return a value in SI; the decimal point of the number as written is moved: 0.545 um is the float 545e-9 m."""
    return math.radians(value) if unit == "deg" else scaled(value, _POWERS[unit])


def scaled(value: float, power: int) -> float:
    """Return a number times a power of ten, its decimal point moved, with all digits of a file."""
    return float(written_decimal(value).scaleb(power))


def written_decimal(value: float) -> Decimal:
    """Return a number as a file has it, or as the shortest decimal that is equal to the float."""
    return value.decimal if isinstance(value, WrittenFloat) else Decimal(repr(float(value)))


def power_of_length(power: int, info: Info) -> int:
    """Return the power of ten from a power of the file's unit of length to that of the metre."""
    return power * _POWERS[unit_of("length", info)]


class UnitsSection(Section):
    """Units of the numbers in the file."""

    length: Literal["m", "mm"]
    angle: Literal["rad", "deg"]
    wavelength: Literal["m", "um", "nm"]


def _keep_units(section: UnitsSection, info: Info) -> UnitsSection:
    info.context["units"] = section
    return section


#: Section of the units, which those after it are converted with.
FileUnits = Annotated[UnitsSection, AfterValidator(_keep_units)]


def unit_of(quantity: str, info: Info) -> str:
    """Return the file's unit of a quantity; SI where the units are malformed, which is an error by itself."""
    return getattr(info.context.get("units"), quantity, "m")


class Turn(float):
    """Angle [rad] to be written in the file's unit."""


class Wave(float):
    """Wavelength [m] to be written in the file's unit."""


class Metres(float):
    """Length [m], or a power of it, to be written in the file's unit."""

    power: int

    def __new__(cls, value: float, power: int = 1) -> Metres:
        """Return the length to a power."""
        number = super().__new__(cls, value)
        number.power = power
        return number


class Bare(str):
    """Text that stands in a file as it is."""


def _numbers(size: int | None) -> Callable[[Any], tuple[float, ...] | None]:
    def convert(value: Any) -> tuple[float, ...] | None:
        if not isinstance(value, list) or (size is not None and len(value) != size):
            return None
        finite_numbers = tuple(n for n in map(as_number, value) if n is not None)
        return finite_numbers if len(finite_numbers) == len(value) else None

    return convert


def _matrix(value: Any) -> Matrix | None:
    rows = [_numbers(3)(row) for row in value] if isinstance(value, list) and len(value) == 3 else [None]
    return None if None in rows else tuple(rows)  # type: ignore[return-value]


def _positive(value: Any) -> float | None:
    number = as_number(value)
    return number if number is not None and number > 0 else None


def _whole(value: Any) -> int | None:
    number = as_number(value)
    return int(number) if number is not None and number == int(number) else None


def names(value: Any) -> tuple[str, ...] | None:
    """Return a list of names that is not empty as a tuple, and None for other values."""
    named = isinstance(value, list) and value and all(isinstance(v, str) for v in value)
    return tuple(value) if named else None


def encoded(kind: str) -> WrittenAs:
    """Return the serializer of an array as numbers of a kind in base 64, quoted."""
    return WrittenAs(lambda a: Bare(json.dumps(base64.b64encode(a.astype(kind).tobytes()).decode())))


def decoded(kind: str, shape: tuple[int, ...], text: str) -> BeforeValidator:
    """Return the validator of an array of numbers of a kind in base 64; `text` is the expected value."""

    def decode(value: Any) -> np.ndarray | None:
        try:
            return np.frombuffer(base64.b64decode(value, validate=True), dtype=kind).reshape(shape)
        except (binascii.Error, ValueError, TypeError):
            return None

    return checked(decode, text)


def _converted(quantity: str) -> BeforeValidator:
    """Return the conversion to SI; it stands in front of the validator of the numbers, and is applied after that.

    The numbers have all digits of the file then.
    """

    def convert(value: Any, info: Info) -> Any:
        unit = unit_of(quantity, info)
        return tuple(to_si(v, unit) for v in value) if isinstance(value, tuple) else to_si(value, unit)

    return BeforeValidator(convert)


def in_metres(value: Any) -> Any:
    """Return lengths within lists as :class:`Metres`; None stays."""
    if isinstance(value, (list, tuple, np.ndarray)):
        return tuple(in_metres(v) for v in value)
    return Metres(value) if isinstance(value, (float, int)) else value


ROWS = checked(
    lambda v: v if isinstance(v, list) and v and all(isinstance(row, dict) for row in v) else None,
    "a list of mappings, one a line",
)
_TEXT = checked(lambda v: v if isinstance(v, str) and v.strip() else None, "a text")
_BESIDE = AfterValidator(lambda name, info: info.context["folder"] / name)
_BESIDE_IF_FILE = AfterValidator(
    lambda name, info: (
        str((info.context["folder"] / name).resolve()) if name.lower().endswith((".yaml", ".yml")) else name
    )
)
_NAMES = checked(names, "a list of names")
_NUMBER, _POSITIVE = checked(as_number, "a number"), checked(_positive, "a positive number")
LIST, _PAIR, _TRIPLE = (
    checked(_numbers(size), f"a list of {size} numbers" if size else "a list of numbers") for size in (None, 2, 3)
)
_LENGTH, _ANGLE, _WAVELENGTH = (_converted(quantity) for quantity in ("length", "angle", "wavelength"))
_METRES = WrittenAs(in_metres)
_WAVES = WrittenAs(lambda waves: [Wave(w) for w in waves])

Text = Annotated[str, _TEXT]
OptionalText = Annotated[str | None, _TEXT]
OptionalFile = Annotated[Any, _TEXT, _BESIDE]
#: Bundled name, or a file beside the one that names it.
OptionalNameOrFile = Annotated[str | None, _TEXT, _BESIDE_IF_FILE]
Names = Annotated[tuple[str, ...], _NAMES]
OptionalNames = Annotated[tuple[str, ...] | None, _NAMES]
Flag = Annotated[bool, checked(lambda v: v if isinstance(v, bool) else None, "true or false")]
Number = Annotated[float, _NUMBER]
OptionalNumber = Annotated[float | None, _NUMBER]
PositiveNumber = Annotated[float, _POSITIVE]
WholeNumber = Annotated[int, checked(_whole, "a whole number")]
Numbers = Annotated[tuple[float, ...], LIST]
Rotation = Annotated[Matrix, checked(_matrix, "three rows of three numbers")]
Length = Annotated[float, _LENGTH, _NUMBER, _METRES]
OptionalLength = Annotated[float | None, _LENGTH, _NUMBER, _METRES]
PositiveLength = Annotated[float, _LENGTH, _POSITIVE, _METRES]
Radius = Annotated[float, _LENGTH, checked(lambda v: math.inf if v == "flat" else as_number(v), "a number"), _METRES]
Lengths = Annotated[tuple[float, ...], _LENGTH, LIST, _METRES]
Point = Annotated[tuple[float, float], _LENGTH, _PAIR, _METRES]
OptionalPoint = Annotated[tuple[float, float] | None, _LENGTH, _PAIR, _METRES]
OptionalPlace = Annotated[tuple[float, float, float] | None, _LENGTH, _TRIPLE, _METRES]
Angle = Annotated[float, _ANGLE, _NUMBER, WrittenAs(Turn)]
PositiveAngle = Annotated[float, _ANGLE, _POSITIVE, WrittenAs(Turn)]
OptionalAngles = Annotated[tuple[float, float, float] | None, _ANGLE, _TRIPLE]
Wavelength = Annotated[float, _WAVELENGTH, _POSITIVE, WrittenAs(Wave)]
Wavelengths = Annotated[tuple[float, ...], _WAVELENGTH, LIST, _WAVES]
Band = Annotated[tuple[float, float], _WAVELENGTH, _PAIR, _WAVES]
OptionalBand = Annotated[tuple[float, float] | None, _WAVELENGTH, _PAIR, _WAVES]


def length_text(value: float, unit: str) -> str:
    """Return a length [m], or a power of it, in a unit as the decimal that converts back equal."""
    power = value.power if isinstance(value, Metres) else 1
    if math.isinf(value) or _POWERS[unit] == 0:
        return number_text(value)
    number = Decimal(repr(float(value) + 0.0)).scaleb(-power * _POWERS[unit])
    if Decimal(repr(float(number))) == number:
        return number_text(float(number))
    return f"{number:f}" if _PLAIN_EXPONENTS[0] <= number.adjusted() < _PLAIN_EXPONENTS[1] else f"{number:E}"


def number_text(value: float) -> str:
    """Return a float as the shortest text that loads back equal, a float in YAML too; a radius may be flat."""
    # YAML 1.1 takes 8e-07 for text: a number needs its point.
    return "flat" if math.isinf(value) else re.sub(r"^(-?\d+)e", r"\1.0e", repr(float(value) + 0.0))


def _quoted(text: str) -> str:
    """Return a text in quotation marks, with escapes for what YAML refuses or takes for the end of a line."""
    quoted = json.dumps(text.encode("utf-8", "replace").decode(), ensure_ascii=False)
    if quoted.isprintable():
        return quoted
    # Unlike JSON's, escapes of YAML have eight digits beyond the first plane.
    return "".join(
        c if c.isprintable() else f"\\u{ord(c):04x}" if c <= "\uffff" else f"\\U{ord(c):08x}" for c in quoted
    )


def flow(value: Any, number: Callable[[float], str] = number_text) -> str:
    """Return a value in YAML's flow style, on one line; `number` gives the text of a float."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {flow(v, number)}" for key, v in value.items()) + "}"
    if isinstance(value, (list, tuple, np.ndarray)):
        return "[" + ", ".join(flow(v, number) for v in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Bare):
        return value
    if isinstance(value, str):
        plain = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_.()/;+ -]*", value) and value == value.strip()
        return value if plain and yaml.safe_load(value) == value else _quoted(value)
    return number(value)
