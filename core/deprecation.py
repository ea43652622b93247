"""Public names of packages, and old spellings: they go on working with one warning, or say what replaced them."""

from __future__ import annotations

import functools
import importlib
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from importlib.util import find_spec
from typing import Any, TypeVar, cast

import lazy_loader

from .errors import ConfigError

Target = TypeVar("Target", bound=Callable[..., Any])


def warn_deprecated(old: str, new: str, *, stacklevel: int = 2) -> None:
    """Warn that an old spelling will go, and name the new one.

    `stacklevel` is that of :func:`warnings.warn` as seen by the caller: 2 is the line that called it.
    """
    warnings.warn(f"{old} is deprecated; use {new}", DeprecationWarning, stacklevel=stacklevel + 1)


def renamed_arguments(**new_names: str) -> Callable[[Target], Target]:
    """Let a function take arguments by their old names too, each with a DeprecationWarning.

    Keywords are the old names, values the new ones. It stands above :func:`~pachon.core.arguments.check_arguments`.
    A call with both names is a ConfigError.
    """

    def decorate(function: Target) -> Target:
        @functools.wraps(function)
        def renaming(*args: Any, **options: Any) -> Any:
            for old, new in new_names.items():
                if old in options:
                    if new in options:
                        raise ConfigError(f"{old} and {new} are one argument: expected {new} alone", key=old)
                    warn_deprecated(f"{function.__qualname__}({old}=...)", f"{new}=...")
                    options[new] = options.pop(old)
            return function(*args, **options)

        return cast(Target, renaming)

    return decorate


def public_names(
    package: str, file: str, *, moved_to: Iterable[str] = (), removed: Mapping[str, str] | None = None
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package, whose stub lists its public names.

    Each name is imported from its module when it is first used. A name that is public in one of the sub-packages
    `moved_to` is returned with one DeprecationWarning. One of `removed` is an AttributeError that names its
    replacement.
    """
    load_name, list_names, names = lazy_loader.attach_stub(package, file)
    replacements = removed or {}

    def load_public(name: str) -> Any:
        if name in names:
            return load_name(name)
        if name.startswith("__"):
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if name in replacements:
            raise AttributeError(f"{package}.{name} was removed; use {replacements[name]}")
        owners = {owner: importlib.import_module(f"{package}.{owner}") for owner in moved_to}
        for owner, module in owners.items():
            if name in module.__all__:
                warn_deprecated(f"{package}.{name}", f"{package}.{owner}.{name}")
                value = getattr(module, name)
                # The next use finds it without a call, and without a warning.
                setattr(sys.modules[package], name, value)
                return value
        if name.isidentifier() and find_spec(f"{package}.{name}") is not None:
            # An import of this module looks for an attribute first; a search for near names takes longer than it.
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        spellings = {n.lower(): f"{package}.{n}" for n in names}
        for owner, module in owners.items():
            spellings |= {n.lower(): f"{package}.{owner}.{n}" for n in module.__all__}
        near = [spellings[key] for key in get_close_matches(name.lower(), spellings, n=2)]
        hint = f"; did you mean {' or '.join(near)}?" if near else ""
        raise AttributeError(f"module {package!r} has no attribute {name!r}{hint}")

    return load_public, list_names, names
