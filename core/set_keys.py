"""Keys of configurations set by texts such as ``stars.truth=50``, the values of ``--set``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel

from .errors import ConfigError, PachonError, shown
from .schema import validated
from .yaml_reader import read_value

Model = TypeVar("Model", bound=BaseModel)
#: The option, in messages.
OPTION = "--set"


def with_set_keys(config: Model, texts: Sequence[str]) -> Model:
    """Return a configuration with other values of some keys, ``key=value`` each, dots between sections.

    Raises
    ------
    ConfigError
        If a text has another form, a key is unknown, or a value is not as expected: with option, key and value.
    """
    if not texts:
        return config
    content = set_keys(type(config), config.model_dump(by_alias=True), texts)
    return validated(type(config), content, OPTION)


def set_keys(model: type[BaseModel], content: dict[str, Any], texts: Iterable[str]) -> dict[str, Any]:
    """Return the content of a file of a model with other values of some keys, not yet validated; values are YAML."""
    content = deepcopy(content)
    for text in texts:
        key, value = key_and_value(text)
        *sections, last = key_path(model, key)
        target: Any = content
        for section in sections:
            target = _entry(target, section, text)
        if isinstance(target, list):
            target[_index(target, last, text)] = value
        else:
            target[last] = value
    return content


def key_and_value(text: str) -> tuple[str, Any]:
    """Return key and value of a text ``key=value``."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"{OPTION} {shown(text)}: expected KEY=VALUE, such as seed=7 or stars.truth=50")
    try:
        return key.strip(), read_value(value)
    except ValueError as reason:
        raise ConfigError(f"{OPTION} {shown(text)}: not valid YAML: {reason}") from None


def key_path(model: type[BaseModel], key: str) -> list[str]:
    """Return the parts of a dotted key; names in mappings have dots of their own, as M2.dz_um in changes.M2.dz_um."""
    first, dot, inner_key = key.partition(".")
    field = next((f for name, f in model.model_fields.items() if (f.alias or name) == first), None)
    if not dot or field is None:
        return key.split(".")
    for kind in (field.annotation, *get_args(field.annotation)):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return [first, *key_path(kind, inner_key)]
        if get_origin(kind) is dict:
            value_kind = get_args(kind)[1]
            if isinstance(value_kind, type) and issubclass(value_kind, BaseModel):
                name, _, leaf = inner_key.rpartition(".")
                return [first, name, leaf] if name else [first, leaf]
            return [first, *inner_key.split(".")] if value_kind is Any else [first, inner_key]
    return key.split(".")


@contextmanager
def set_key_errors(texts: Sequence[str]) -> Iterator[None]:
    """Raise the errors of keys that texts set again as those of the option, not of the file."""
    try:
        yield
    except PachonError as error:
        keys = [key_and_value(text)[0] for text in texts]
        if error.key and any(error.key == key or key.startswith(f"{error.key}.") for key in keys):
            raise type(error)(error.problem, file=OPTION, key=error.key) from None
        raise


def _entry(target: Any, section: str, text: str) -> Any:
    """Return the section of a mapping or list that a text sets a key in; an empty one where there is none."""
    if isinstance(target, list):
        entry = target[_index(target, section, text)]
    else:
        if target.get(section) is None:
            target[section] = {}
        if isinstance(target[section], tuple):
            target[section] = list(target[section])
        entry = target[section]
    if not isinstance(entry, dict | list):
        raise ConfigError(f"{OPTION} {shown(text)}: {section} = {shown(entry)} has no keys")
    return entry


def _index(entries: list[Any], text_of_index: str, text: str) -> int:
    """Return the place in a list, from 0, that a key names."""
    if not (text_of_index.isdigit() and int(text_of_index) < len(entries)):
        raise ConfigError(
            f"{OPTION} {shown(text)}: {text_of_index} in a list of {len(entries)}: expected a place, from 0"
        )
    return int(text_of_index)
