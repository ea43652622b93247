"""Options of a command in groups: dataclasses, whose fields are the options with their defaults."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields
from functools import wraps
from typing import Any, get_type_hints

from typer.models import OptionInfo

from ..core.errors import ConfigError


def with_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command whose options are the fields of the dataclasses that its parameters are."""
    groups = {name: kind for name, kind in get_type_hints(command).items() if name != "return"}
    parameters = [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if field.default is MISSING else field.default,
            annotation=_annotations(kind)[field.name],
        )
        for kind in groups.values()
        for field in fields(kind)
    ]

    @wraps(command)
    def grouped(**values: Any) -> None:
        command(**{name: kind(**{f.name: values[f.name] for f in fields(kind)}) for name, kind in groups.items()})

    # Typer builds the command by these.
    grouped.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    grouped.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return grouped


def require_defaults(expected: str, *groups: Any) -> None:
    """Raise a ConfigError that names the options of groups whose values are not their defaults."""
    options = [
        _option_name(field.name, _annotations(type(group))[field.name])
        for group in groups
        for field in fields(group)
        # Of options that may be repeated, none is an empty list.
        if getattr(group, field.name) not in (field.default, [])
    ]
    if options:
        raise ConfigError(f"{', '.join(options)}: {expected}")


def _annotations(group: type) -> dict[str, Any]:
    """Return the types of the fields of a group with their options."""
    return get_type_hints(group, include_extras=True)


def _option_name(field: str, annotation: Any) -> str:
    """Return the first name of the option of a field."""
    declared = [info.default for info in annotation.__metadata__ if isinstance(info, OptionInfo)]
    return next((name for name in declared if isinstance(name, str)), f"--{field.replace('_', '-')}")
