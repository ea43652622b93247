"""Strict reading of YAML files; each problem is an error of one line.

The loader is YAML's safe one; a repeated key, of which YAML takes the last, is an error.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from .errors import PachonError, PrescriptionError
from .files import read_bytes


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
    """Return the top level of a YAML file in UTF-8.

    Raises `error` if the file cannot be read, is not YAML, or is not a mapping.
    """
    try:
        content = yaml.load(read_bytes(path, error).decode(), Loader=_StrictLoader)
    except UnicodeDecodeError:
        raise error("not a UTF-8 text file", file=path) from None
    except yaml.MarkedYAMLError as problem:
        mark = problem.problem_mark or problem.context_mark
        place = f"line {mark.line + 1}" if mark else None
        raise error(f"not valid YAML: {problem.problem or problem.context}", file=path, place=place) from None
    except (yaml.YAMLError, ValueError) as problem:
        raise error(f"not valid YAML: {' '.join(str(problem).split())}", file=path) from None
    if not isinstance(content, dict):
        raise error(f"expected a mapping of keys to values, not {cut_short(repr(content))}", file=path)
    return content


def as_number(value: Any) -> float | None:
    """Return a finite float, or None where the value is not one."""
    # YAML 1.1 reads 1e-9 (no point) as text; an optician means a number.
    text_of_number = isinstance(value, str) and value.strip()[:1] in set("+-.0123456789")
    if isinstance(value, bool) or not (text_of_number or isinstance(value, (int, float))):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def cut_short(text: str) -> str:
    """Return a text of at most 60 characters."""
    return text if len(text) <= 60 else text[:57] + "..."
