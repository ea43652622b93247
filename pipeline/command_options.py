"""What the commands share: options that mean the same in each, and how tables are printed."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console

from ..models.errors import ConfigError

Json = Annotated[bool, typer.Option("--json", help="Print figures as JSON on standard output, and nothing else there.")]
Threads = Annotated[int | None, typer.Option(min=1, help="Threads; all processors by default. No byte depends on it.")]


def name_list(text: str, option: str) -> tuple[str, ...]:
    """Return the names in a text with commas.

    Raises
    ------
    ConfigError
        If there is none.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise ConfigError(f"{option} = {text!r}: expected names separated by commas, such as R22_S11,R22_S12")
    return names


def wide_console() -> Console:
    """Return a console that cuts no table short: a narrow terminal wraps its lines itself."""
    return Console(width=max(Console().width, 132))
