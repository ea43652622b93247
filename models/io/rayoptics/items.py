"""Objects of ray-optics files: attributes and class names, and arrays of numbers."""

from __future__ import annotations

from typing import Any

from ..json_items import JsonObject


def instance(module: str, kind: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return the items of an object of a class of ray-optics, to be written."""
    return {"__instance_type__": [module, kind], "attributes": values}


def array(values: list[float]) -> dict[str, Any]:
    """Return the items of an array of NumPy, to be written."""
    return {"__ndarray__": values, "dtype": "float64", "shape": [len(values)]}


def attributes(items: JsonObject, key: str | None = None) -> JsonObject:
    """Return the attributes of an object, or of one that stands within it under a key."""
    instance_items = items if key is None else items.child(key, items.place or key)
    return instance_items.child("attributes") if "attributes" in instance_items else instance_items


def class_name(items: JsonObject) -> str:
    """Return the name of the class of an object."""
    kind = items.get("__instance_type__")
    if not isinstance(kind, list) or not kind or not isinstance(kind[-1], str):
        items.refuse("__instance_type__", "the module and the name of a class")
    return kind[-1]


def module_name(items: JsonObject) -> str:
    """Return the last part of the name of the module of an object's class."""
    class_name(items)
    return str(items.get("__instance_type__")[0]).rsplit(".", 1)[-1]


def numbers(items: JsonObject, key: str, size: int | None = None) -> list[float]:
    """Return a list of numbers, which may stand as an array of NumPy; zeros where none is there and a size is given."""
    if key not in items:
        return [0.0] * size if size is not None else items.numbers(key)
    if isinstance(items.get(key), dict):
        return items.child(key).numbers("__ndarray__", size)
    return items.numbers(key, size)


def named(items: JsonObject, key: str) -> str:
    """Return a key as the file has it: attributes of some versions begin with an underscore."""
    return f"_{key}" if f"_{key}" in items else key
