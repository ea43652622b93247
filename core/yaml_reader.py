"""Read YAML model files strictly: a problem is one line that names file, key, value and what was expected.

The loader is YAML's safe one; a repeated key, which YAML lets the last win, is an error.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml

from .errors import PachonError, PrescriptionError


class _StrictLoader(yaml.SafeLoader):
    pass


def _mapping_without_repeats(loader: _StrictLoader, node: yaml.MappingNode) -> dict[Hashable, Any]:
    seen: set[Hashable] = set()
    for key_node, _ in node.value:
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, str):
            raise yaml.constructor.ConstructorError(None, None, f"key {key!r}: expected a name", key_node.start_mark)
        if key in seen:
            raise yaml.constructor.ConstructorError(None, None, f"key {key!r} occurs twice", key_node.start_mark)
        seen.add(key)
    return loader.construct_mapping(node, deep=True)


_StrictLoader.add_constructor("tag:yaml.org,2002:map", _mapping_without_repeats)


def read_mapping(path: Path, error: type[PachonError] = PrescriptionError) -> dict[str, Any]:
    """Return the top level of a YAML file.

    Parameters
    ----------
    path : Path
        File to read, UTF-8.
    error : type
        Class of the error.

    Raises
    ------
    PachonError
        If the file cannot be read, is not YAML, or is not a mapping.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise error("no such file", file=path) from None
    except UnicodeDecodeError:
        raise error("not a UTF-8 text file", file=path) from None
    except OSError as problem:
        raise error(f"cannot be read ({problem.strerror})", file=path) from None
    try:
        content = yaml.load(text, Loader=_StrictLoader)
    except yaml.MarkedYAMLError as problem:
        mark = problem.problem_mark or problem.context_mark
        place = f"line {mark.line + 1}" if mark else None
        raise error(f"not valid YAML: {problem.problem or problem.context}", file=path, place=place) from None
    except (yaml.YAMLError, ValueError) as problem:
        raise error(f"not valid YAML: {' '.join(str(problem).split())}", file=path) from None
    if not isinstance(content, dict):
        raise error(f"expected a mapping of keys to values, not {_shown(content)}", file=path)
    return content


def read_yaml(path: Path) -> Section:
    """Return the top level of a YAML file."""
    return Section(read_mapping(path), str(path), "")


def as_number(value: Any) -> float | None:
    """Return a finite float, or None where the value is not one."""
    if isinstance(value, bool):
        return None
    if isinstance(value, str):
        # YAML 1.1 reads 1e-9 (no point) as text; an optician means a number.
        try:
            value = float(value) if value.strip()[:1] in set("+-.0123456789") else None
        except ValueError:
            return None
    if not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


class Section:
    """One mapping of a file: hands out checked values and knows where each stands.

    Parameters
    ----------
    content : mapping
        Keys and values.
    source : str
        File that it comes from.
    place : str
        Path of keys that leads here, empty at the top.
    """

    def __init__(self, content: Mapping[str, Any], source: str, place: str) -> None:
        self._content = content
        self.source = source
        self.place = place

    def __contains__(self, key: str) -> bool:
        return key in self._content

    def keys(self) -> tuple[str, ...]:
        """Return the keys in the order of the file."""
        return tuple(self._content)

    def value(self, key: str) -> Any:
        """Return the unchecked value of a key."""
        return self._required(key)

    def error(self, key: str, expected: str) -> PrescriptionError:
        """Return the error for the value of a key."""
        path = self._path(key)
        problem = f"{path} = {_shown(self._content.get(key))}: expected {expected}"
        return PrescriptionError(problem, file=self.source, key=path)

    def placed(self, error: PrescriptionError) -> PrescriptionError:
        """Return an error of the model as one of this section, unless it names the file already."""
        return error.within(file=self.source, key=self.place)

    def allow(self, *keys: str) -> None:
        """Refuse every key that is not among these.

        Raises
        ------
        PrescriptionError
            Naming the first unknown key and the nearest known ones.
        """
        for key in self._content:
            if key not in keys:
                near = get_close_matches(key, keys, n=2, cutoff=0.6)
                hint = f"did you mean {' or '.join(near)}?" if near else f"expected one of {', '.join(keys)}"
                path = self._path(key)
                problem = f"unknown key {path} = {_shown(self._content[key])}: {hint}"
                raise PrescriptionError(problem, file=self.source, key=path)

    def number(self, key: str, default: float | None = None, *, positive: bool = False) -> float:
        """Return a finite number."""
        if key not in self._content and default is not None:
            return default
        number = as_number(self._required(key))
        if number is None or (positive and number <= 0):
            raise self.error(key, "a positive number" if positive else "a number")
        return number

    def numbers(self, key: str, size: int | None = None, default: Sequence[float] | None = None) -> tuple[float, ...]:
        """Return a list of finite numbers, of a given size if one is given."""
        if key not in self._content and default is not None:
            return tuple(default)
        value = self._required(key)
        numbers = [as_number(v) for v in value] if isinstance(value, list) else [None]
        if any(n is None for n in numbers) or (size is not None and len(numbers) != size):
            raise self.error(key, f"a list of {size} numbers" if size is not None else "a list of numbers")
        return tuple(n for n in numbers if n is not None)

    def text(self, key: str, default: str | None = None) -> str:
        """Return a text that is not empty."""
        if key not in self._content and default is not None:
            return default
        value = self._required(key)
        if not isinstance(value, str) or not value.strip():
            raise self.error(key, "a text")
        return value

    def choice(self, key: str, allowed: Sequence[str], default: str | None = None) -> str:
        """Return one of the allowed words."""
        if key not in self._content and default is not None:
            return default
        value = self._required(key)
        if value not in allowed:
            near = get_close_matches(str(value), allowed, n=1)
            hint = f" (did you mean {near[0]}?)" if near else ""
            raise self.error(key, f"one of {', '.join(allowed)}{hint}")
        return value

    def names(self, key: str) -> tuple[str, ...]:
        """Return a list of names."""
        value = self._required(key)
        if not isinstance(value, list) or not value or not all(isinstance(v, str) for v in value):
            raise self.error(key, "a list of names")
        return tuple(value)

    def section(self, key: str, *, optional: bool = False) -> Section:
        """Return the mapping under a key; an empty one where it is optional and missing."""
        if optional and key not in self._content:
            return Section({}, self.source, self._path(key))
        value = self._required(key)
        if not isinstance(value, dict):
            raise self.error(key, "a mapping of keys to values")
        return Section(value, self.source, self._path(key))

    def sections(self, key: str, label: str) -> list[Section]:
        """Return the list of mappings under a key; `label` is the key that tells them apart in messages."""
        value = self._required(key)
        if not isinstance(value, list) or not value or not all(isinstance(v, dict) for v in value):
            raise self.error(key, "a list of mappings, one a line")
        places = [f"{self._path(key)}[{v.get(label, i)}]" for i, v in enumerate(value)]
        return [Section(v, self.source, place) for v, place in zip(value, places, strict=True)]

    def _required(self, key: str) -> Any:
        if key not in self._content:
            raise PrescriptionError(f"{self._path(key)} is missing", file=self.source, key=self._path(key))
        return self._content[key]

    def _path(self, key: str) -> str:
        return f"{self.place}.{key}" if self.place else key
