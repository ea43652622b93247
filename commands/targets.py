"""Targets of commands, checked before the work: what cannot be written, or is no table, is refused at once."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import typer

#: Parameters of commands that are files or folders to write, and whether they are always files.
TARGETS = {"out": False, "picture": True, "table": True}


def with_checked_targets(app: typer.Typer) -> typer.Typer:
    """Let all commands of an app, and of the apps in it, check their targets first; returns the app."""
    for command in app.registered_commands:
        if command.callback is not None:
            command.callback = _checked(command.callback)
    for group in app.registered_groups:
        if group.typer_instance is not None:
            with_checked_targets(group.typer_instance)
    return app


def _checked(command: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(command)
    def checked(*given: Any, **options: Any) -> Any:
        from ..core.files import require_writable
        from .options import check_table

        if isinstance(table := options.get("table"), Path):
            check_table(table)
        for name, file in TARGETS.items():
            if isinstance(target := options.get(name), Path):
                require_writable(target, file=file)
        return command(*given, **options)

    return checked
