"""Strict reading of lens files in JSON: typed values of objects, and what is left over."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn

from ...core.errors import PrescriptionError, shown
from ...core.files import read_bytes
from .lens.source import Findings, Source

#: Longest file [byte]: grids of sag take megabytes.
MAX_BYTES = 50_000_000
#: Most digits of a whole number that floats can hold.
_MOST_DIGITS = 300


class JsonObject:
    """An object of a JSON file: values by key, each of the expected type.

    `place` is the part of the file, for messages. Keys that were not read are reported by :meth:`report_rest`.
    """

    def __init__(self, content: dict[str, Any], source: str, place: str = "") -> None:
        self.content, self.source, self.place = content, source, place
        self.used: set[str] = set()

    @classmethod
    def read(cls, path: Path) -> JsonObject:
        """Return the object that a file holds; PrescriptionError if it is no JSON."""
        raw = read_bytes(path, PrescriptionError, max_bytes=MAX_BYTES)
        try:
            content = json.loads(raw, parse_int=_whole_number)
        except (ValueError, RecursionError) as error:
            raise PrescriptionError(f"not a JSON file ({error})", file=path) from None
        if not isinstance(content, dict):
            raise PrescriptionError("expected a JSON object ({...})", file=path)
        return cls(content, str(path))

    def __contains__(self, key: str) -> bool:
        """Return whether a key is there, with another value than null."""
        return self.get(key) is not None

    def get(self, key: str) -> Any:
        """Return a value as it stands in the file, None where there is none."""
        self.used.add(key)
        return self.content.get(key)

    def problem(self, text: str) -> PrescriptionError:
        """Return an error of this object."""
        return PrescriptionError(text, file=self.source, place=self.place or None)

    def at(self, key: str) -> Source:
        """Return the source of a value."""
        return Source(self.source, self.place, key, shown(self.content.get(key)))

    def part(self, text: str) -> Source:
        """Return the source of a part of this object, as messages name it."""
        return Source(self.source, self.place, text)

    def refuse(self, key: str, expected: str) -> NoReturn:
        """Raise the error of a value that is not the expected one."""
        if key not in self.content:
            raise self.problem(f"{key} is missing: expected {expected}")
        raise self.problem(f"{key} = {shown(self.content[key])}: expected {expected}")

    def number(self, key: str, default: float | None = None, *, infinite: bool = False) -> float:
        """Return a number; infinity only where `infinite` is set."""
        value = self.get(key)
        if value is None and default is not None:
            return default
        # Some writers put single numbers into lists.
        value = value[0] if isinstance(value, list) and len(value) == 1 else value
        if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
            self.refuse(key, "a number")
        if math.isinf(value) and not infinite:
            self.refuse(key, "a finite number")
        return float(value)

    def whole(self, key: str, default: int | None = None) -> int:
        """Return a whole number."""
        value = self.number(key, None if default is None else float(default))
        if value != int(value):
            self.refuse(key, "a whole number")
        return int(value)

    def text(self, key: str, default: str | None = None) -> str:
        """Return a text."""
        value = self.get(key)
        if value is None and default is not None:
            return default
        if not isinstance(value, str):
            self.refuse(key, "a text")
        return value

    def flag(self, key: str, default: bool = False) -> bool:
        """Return true or false."""
        value = self.get(key)
        value = default if value is None else value
        if not isinstance(value, bool):
            self.refuse(key, "true or false")
        return value

    def numbers(self, key: str, size: int | None = None) -> list[float]:
        """Return a list of numbers, empty where there is none, of a given size if one is stated."""
        value = self.get(key)
        value = [] if value is None else value
        good = isinstance(value, list) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
        if not good or not all(math.isfinite(v) for v in value) or (size is not None and len(value) != size):
            self.refuse(key, f"a list of {'' if size is None else f'{size} '}finite numbers")
        return [float(v) for v in value]

    def child(self, key: str, place: str | None = None) -> JsonObject:
        """Return an object within this one."""
        value = self.get(key)
        if not isinstance(value, dict):
            self.refuse(key, "an object ({...})")
        return JsonObject(value, self.source, self.place if place is None else place)

    def children(self, key: str, place: str) -> Iterator[JsonObject]:
        """Yield the objects of a list; `place` and their numbers are their places."""
        value = self.get(key)
        if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
            self.refuse(key, "a list of objects")
        for number, content in enumerate(value):
            yield JsonObject(content, self.source, f"{place} {number}" if place else self.place)

    def report_rest(self, findings: Findings, ignored: Iterable[str] = ()) -> None:
        """Report every key with a value that was neither read nor is among those to ignore."""
        understood_keys = self.used.union(ignored)
        for key, value in self.content.items():
            if key not in understood_keys and value not in (None, [], {}):
                text = f"{shown(key)} = {shown(value)}: this key is not understood"
                findings.report(self.problem(text))


def _whole_number(text: str) -> int | float:
    """Return a number without point or exponent, like others infinite where floats cannot hold it."""
    return int(text) if len(text) <= _MOST_DIGITS else float(text)
