"""Strict reading of YAML files; each problem is an error of one line.

The loader is YAML's safe one; a repeated key, of which YAML takes the last, is an error. So is content too large to be
a configuration: files of many bytes, deep nesting, aliases that multiply, integers of hundreds of digits. Mappings may
be merged into others (``<<: *anchor``); they count as the aliases that they are.
"""

from __future__ import annotations

import math
import re
from collections.abc import Hashable
from decimal import Decimal
from pathlib import Path
from typing import Any

import yaml

from .errors import PachonError, PrescriptionError, cut_short
from .files import read_bytes

#: Longest file [byte] of a configuration; files with numbers of their own, such as prescriptions, may be longer.
MAX_BYTES = 1_000_000
#: Most characters that aliases stand for.
MAX_ALIASED = 1_000_000
#: Characters that each value, list and mapping counts more, for the time it takes.
_NODE = 20
#: Most levels of lists and mappings, far below Python's limit of recursion.
MAX_DEPTH = 50
_TOO_DEEP = f"more than {MAX_DEPTH} levels of nesting"
#: Longest text of an integer: YAML's base 60 takes a time that grows with its square.
MAX_DIGITS = 100
#: Longest reason of a problem in an error message: some hold a name of the file's.
_MAX_REASON = 200
_MERGE = "tag:yaml.org,2002:merge"
# What libyaml says of nesting beyond a limit of its own, which it meets before ours where brackets stand in a row.
_LIBYAML_NESTING = "exceeded maximum nesting depth"


def _parser() -> Any:
    """Return the class of the parser; libyaml's, where PyYAML has it, takes a tenth of the time."""
    if yaml.__with_libyaml__:
        return yaml._yaml.CParser

    class PythonParser(yaml.reader.Reader, yaml.scanner.Scanner, yaml.parser.Parser):
        def __init__(self, text: str) -> None:
            yaml.reader.Reader.__init__(self, text)
            yaml.scanner.Scanner.__init__(self)
            yaml.parser.Parser.__init__(self)

    return PythonParser


_Parser: Any = _parser()


class _StrictLoader(yaml.composer.Composer, _Parser, yaml.constructor.SafeConstructor, yaml.resolver.Resolver):
    """Safe loader of bounded content, checked before any value is made."""

    def __init__(self, text: str, max_size: int, *, exact: bool = False) -> None:
        _Parser.__init__(self, text)
        self.exact = exact
        yaml.composer.Composer.__init__(self)
        yaml.constructor.SafeConstructor.__init__(self)
        yaml.resolver.Resolver.__init__(self)
        self._max_size = max_size
        self._depth = 0
        self._size = 0
        self._aliased = 0
        # Size with every alias written out, by the identity of the node.
        self._sizes: dict[int, int] = {}
        # Identities of the mappings without repeated keys.
        self._checked: set[int] = set()

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Return the next node; a ComposerError where depth or size exceed their limits."""
        event = self.peek_event()
        is_alias, mark = isinstance(event, yaml.AliasEvent), event.start_mark
        if self._depth == MAX_DEPTH:
            raise yaml.composer.ComposerError(None, None, _TOO_DEEP, mark)
        before = self._size
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        if is_alias:
            # A node within itself has no size yet.
            if id(node) not in self._sizes:
                raise yaml.composer.ComposerError(None, None, f"alias *{cut_short(event.anchor)} within itself", mark)
            self._size += self._sizes[id(node)]
            self._aliased += self._sizes[id(node)]
        else:
            self._size += _NODE + (len(node.value) if isinstance(node, yaml.ScalarNode) else 0)
            self._sizes[id(node)] = self._size - before
        if self._aliased > MAX_ALIASED:
            text = f"aliases for more than {MAX_ALIASED} characters, {_NODE} of them for each value"
            raise yaml.composer.ComposerError(None, None, text, mark)
        if self._size > self._max_size:
            text = f"more than {self._max_size} characters, {_NODE} of them for each value"
            raise yaml.composer.ComposerError(None, None, text, mark)
        return node

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Write merged keys into a mapping: its own override them, and those of earlier mappings those of later ones.

        PyYAML 6.0.4 lets the keys of a mapping that is merged into override its own, where that is merged in turn.
        """
        direct_pairs: list[tuple[yaml.Node, yaml.Node]] = []
        merged: dict[Hashable, tuple[yaml.Node, yaml.Node]] = {}
        for key, value in node.value:
            if key.tag != _MERGE:
                direct_pairs.append((key, value))
                continue
            for merged_node in value.value if isinstance(value, yaml.SequenceNode) else [value]:
                if not isinstance(merged_node, yaml.MappingNode):
                    text = f"expected a mapping or list of mappings for merging, but found {merged_node.id}"
                    raise yaml.constructor.ConstructorError(None, None, text, merged_node.start_mark)
                self.flatten_mapping(merged_node)
                # Of equal keys the last one counts, which is the merged mapping's own.
                for name, pair in {pair[0].value: pair for pair in merged_node.value}.items():
                    merged.setdefault(name, pair)
        node.value = [*merged.values(), *direct_pairs]

    def check_keys(self, node: yaml.MappingNode) -> None:
        """Raise a ConstructorError for a key that is no name or occurs twice in a mapping or one merged into it."""
        # Merging writes the merged keys into the node, so each is checked once, before.
        if id(node) in self._checked:
            return
        self._checked.add(id(node))
        unique_keys: set[Hashable] = set()
        for key_node, value_node in node.value:
            if key_node.tag == _MERGE:
                key: Any = "<<"
                parts = value_node.value if isinstance(value_node, yaml.SequenceNode) else [value_node]
                for merged_node in parts:
                    if isinstance(merged_node, yaml.MappingNode):
                        self.check_keys(merged_node)
            else:
                key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                text = f"key {cut_short(repr(key))}: expected a name"
                raise yaml.constructor.ConstructorError(None, None, text, key_node.start_mark)
            if key in unique_keys:
                text = f"key {cut_short(repr(key))} occurs twice"
                raise yaml.constructor.ConstructorError(None, None, text, key_node.start_mark)
            unique_keys.add(key)


class WrittenFloat(float):
    """A float of a file with more digits than a float has: the number as it is written, for an exact change of unit."""

    decimal: Decimal

    def __new__(cls, text: str) -> WrittenFloat:
        """Return the float of a text."""
        number = super().__new__(cls, text)
        number.decimal = Decimal(text)
        return number


def _written_float(loader: _StrictLoader, node: yaml.ScalarNode) -> float:
    value = float(loader.construct_yaml_float(node))
    if not loader.exact:
        return value
    text = node.value.replace("_", "")
    try:
        more_digits = math.isfinite(value) and Decimal(text) != Decimal(repr(value))
    except ArithmeticError:
        # Base 60 of YAML 1.1.
        return value
    return WrittenFloat(text) if more_digits else value


def _short_integer(loader: _StrictLoader, node: yaml.ScalarNode) -> int:
    if len(node.value) > MAX_DIGITS:
        text = f"integer of {len(node.value)} characters: expected at most {MAX_DIGITS}"
        raise yaml.constructor.ConstructorError(None, None, text, node.start_mark)
    return int(loader.construct_yaml_int(node))


def _mapping_without_repeats(loader: _StrictLoader, node: yaml.MappingNode) -> dict[Hashable, Any]:
    loader.check_keys(node)
    return loader.construct_mapping(node, deep=True)


_StrictLoader.add_constructor("tag:yaml.org,2002:map", _mapping_without_repeats)
_StrictLoader.add_constructor("tag:yaml.org,2002:int", _short_integer)
_StrictLoader.add_constructor("tag:yaml.org,2002:float", _written_float)


def read_mapping(
    path: Path, error: type[PachonError] = PrescriptionError, *, max_bytes: int = MAX_BYTES, exact: bool = False
) -> dict[str, Any]:
    """Return the top level of a YAML file in UTF-8 of at most `max_bytes` [byte].

    With `exact`, numbers with more digits than a float has are :class:`WrittenFloat`.

    Raises `error` if the file cannot be read, is longer, deeper (:data:`MAX_DEPTH`) or has more values and aliases than
    a file of that length, is not YAML, or is not a mapping.
    """
    raw = read_bytes(path, error, max_bytes=max_bytes)
    try:
        content = _StrictLoader(raw.decode(), max_bytes, exact=exact).get_single_data()
    except UnicodeDecodeError:
        raise error("not a UTF-8 text file", file=path) from None
    except yaml.MarkedYAMLError as problem:
        mark = problem.problem_mark or problem.context_mark
        place = f"line {mark.line + 1}" if mark else None
        reason = problem.problem or problem.context
        text = _TOO_DEEP if reason == _LIBYAML_NESTING else _short_reason(reason)
        raise error(f"not valid YAML: {text}", file=path, place=place) from None
    except (yaml.YAMLError, ValueError, ArithmeticError, LookupError, AttributeError) as problem:
        # PyYAML raises the others for values that do not fit their tags.
        raise error(f"not valid YAML: {_short_reason(problem)}", file=path) from None
    if not isinstance(content, dict):
        raise error(f"expected a mapping of keys to values, not {cut_short(repr(content))}", file=path)
    return content


def read_value(text: str) -> Any:
    """Return the value that a YAML text stands for, such as that of an option; ValueError with the reason if none."""
    try:
        return _StrictLoader(text, MAX_BYTES).get_single_data()
    except yaml.MarkedYAMLError as problem:
        raise ValueError(_short_reason(problem.problem or problem.context)) from None
    except (yaml.YAMLError, ValueError, ArithmeticError, LookupError, AttributeError) as problem:
        raise ValueError(_short_reason(problem)) from None


def loaded(text: str, *, max_bytes: int = MAX_BYTES) -> Any:
    """Return the content of a YAML text that this program has written, with :class:`WrittenFloat`."""
    return _StrictLoader(text, max_bytes, exact=True).get_single_data()


def line_of(path: Path, key: str) -> int | None:
    """Return the line of a YAML file, from 1, at which a key stands, such as ``surfaces[M1].radius``.

    Brackets hold the place in a list, or the value of some key of the entry. Where the rest of a path is not in the
    file, it is the line of what is. None if nothing of it is there, or the file is not YAML.
    """
    try:
        node: Any = yaml.compose(path.read_text("utf-8"), Loader=yaml.SafeLoader)
    except (OSError, ValueError, yaml.YAMLError):
        return None
    line = None
    for component in re.findall(r"[^.\[\]]+|\[[^\]]*\]", key):
        child = _child_node(node, component)
        if child is None:
            break
        node, line = child[1], child[0].start_mark.line + 1
    return line


def _child_node(node: Any, component: str) -> tuple[Any, Any] | None:
    """Return the node of a key or entry, for its place, and that of its value; None where there is none."""
    if component.startswith("[") and isinstance(node, yaml.SequenceNode):
        label = component[1:-1]
        if label.isdigit() and int(label) < len(node.value):
            return (node.value[int(label)],) * 2
        for entry in node.value:
            if isinstance(entry, yaml.MappingNode) and any(value.value == label for _, value in entry.value):
                return entry, entry
    if isinstance(node, yaml.MappingNode):
        return next((pair for pair in node.value if pair[0].value == component), None)
    return None


def as_number(value: Any) -> float | None:
    """Return a finite float, or None where the value is not one."""
    # YAML 1.1 reads 1e-9 (no point) as text; an optician means a number.
    text_of_number = isinstance(value, str) and value.strip()[:1] in set("+-.0123456789")
    if isinstance(value, bool) or not (text_of_number or isinstance(value, (int, float))):
        return None
    try:
        number = value if isinstance(value, float) else float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _short_reason(problem: object) -> str:
    return cut_short(" ".join(str(problem).split()), _MAX_REASON)
