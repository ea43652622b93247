"""Keys of configuration files with type, default, choices and description, as their schemas have them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import BaseModel

from .json_schema import json_schema

_TYPES = {
    "integer": "whole number",
    "number": "number",
    "string": "text",
    "boolean": "true or false",
    "object": "mapping",
    "null": "null",
}
#: Kinds of entries of lists and mappings.
_PLURALS = {
    "whole number": "whole numbers",
    "number": "numbers",
    "text": "texts",
    "section": "sections",
    "one of the choices": "words",
}
#: Limits of numbers by their keys in schemas, those of ours too.
_LIMITS = (("minimum", "from"), ("gt", "above"), ("exclusiveMinimum", "above"), ("ge", "from"))
_UPPER_LIMITS = (("maximum", "up to"), ("le", "up to"), ("exclusiveMaximum", "below"))


@dataclass(frozen=True)
class KeyDescription:
    """A key of a configuration file.

    Attributes
    ----------
    key : str
        The key, with dots between sections; NAME stands for a name of the file's own, [] for each entry of a list.
    type : str
        Kind of its values, with limits.
    default : object
        Value where the file leaves it out; None where it is open, or has to be given.
    required : bool
        Whether the file must have it.
    choices : tuple of str
        The words that it takes; empty where it takes other values.
    description : str
        What it stands for, with the unit in brackets.
    """

    key: str
    type: str
    default: Any
    required: bool
    choices: tuple[str, ...]
    description: str

    def summary(self) -> dict[str, Any]:
        """Return the description as JSON has it."""
        return asdict(self)


def describe_keys(model: type[BaseModel]) -> list[KeyDescription]:
    """Return the keys of a file in its order, those of sections behind one another."""
    schema = json_schema(model, "")
    return [*_keys(schema, schema, "")]


def _keys(schema: dict[str, Any], root: dict[str, Any], prefix: str) -> Iterator[KeyDescription]:
    for name, entry in schema.get("properties", {}).items():
        arms = list(_arms(entry, root))
        section_keys = [
            key for arm in arms for suffix, section in _sections(arm, root) for key in _keys(section, root, suffix)
        ]
        # An open or a listed section is a key itself: it may be given as a whole.
        whole = not section_keys or not any("properties" in arm for arm in arms) or len(arms) > 1
        if whole:
            choices = tuple(str(word) for arm in arms for word in arm.get("enum", _constant(arm)))
            yield KeyDescription(
                prefix + name,
                " or ".join(dict.fromkeys(_type(arm, root) for arm in arms)),
                entry.get("default"),
                name in schema.get("required", ()),
                choices,
                entry.get("description", ""),
            )
        for key in section_keys:
            yield KeyDescription(**{**asdict(key), "key": f"{prefix}{name}{key.key}"})


def _arms(entry: dict[str, Any], root: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the alternatives of a value, without null and the texts that stand for numbers."""
    entry = _resolved(entry, root)
    if "anyOf" not in entry:
        yield entry
        return
    limits = {key: entry[key] for key, _ in (*_LIMITS, *_UPPER_LIMITS) if key in entry}
    for arm in entry["anyOf"]:
        if arm.get("type") not in ("null", ["string", "array"]):
            yield from ({**inner, **limits} for inner in _arms(arm, root))


def _resolved(entry: dict[str, Any], root: dict[str, Any]) -> dict[str, Any]:
    while "$ref" in entry or len(entry.get("allOf", ())) == 1:
        target = entry["allOf"][0] if "allOf" in entry else root["$defs"][entry["$ref"].rpartition("/")[2]]
        entry = {**target, **{key: value for key, value in entry.items() if key not in ("$ref", "allOf")}}
    return entry


def _sections(arm: dict[str, Any], root: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the sections in a value, with what stands between its key and theirs."""
    if "properties" in arm:
        yield ".", arm
    for key, between in (("additionalProperties", ".NAME."), ("items", "[].")):
        inner = arm.get(key)
        if isinstance(inner, dict):
            yield from ((between, section) for section in _arms(inner, root) if "properties" in section)


def _constant(arm: dict[str, Any]) -> list[Any]:
    return [arm["const"]] if "const" in arm else []


def _type(arm: dict[str, Any], root: dict[str, Any]) -> str:
    """Return the kind of a value in words, with limits."""
    if "enum" in arm or "const" in arm:
        return "one of the choices"
    if arm.get("type") == "array":
        if "prefixItems" in arm:
            return f"list of {len(arm['prefixItems'])} {_inner(arm['prefixItems'][0], root)}"
        return f"list of {_inner(arm.get('items', {}), root)}"
    if arm.get("type") == "object" and isinstance(arm.get("additionalProperties"), dict):
        return f"mapping of names to {_inner(arm['additionalProperties'], root)}"
    if arm.get("type") == "object":
        return "section"
    text = _TYPES.get(str(arm.get("type")), "value")
    limits = [f"{word} {arm[key]:g}" for group in (_LIMITS, _UPPER_LIMITS) for key, word in group if key in arm]
    return " ".join([text, *limits])


def _inner(entry: dict[str, Any], root: dict[str, Any]) -> str:
    """Return the kind of the entries of a list or mapping in the plural, without limits."""
    types = [_type(arm, root).partition(" from ")[0].partition(" above ")[0] for arm in _arms(entry, root)]
    return " or ".join(dict.fromkeys(_PLURALS.get(kind, kind.replace("list of", "lists of")) for kind in types))
