"""A group of commands that prints its help where no command is named."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup

from ..core.terminal import print_line
from .plain_help import PlainHelp


class HelpGroup(PlainHelp, TyperGroup):
    """A group whose name alone prints its help, with status 2: no command was named.

    click does so since 8.2 by an error without a text, and before with status 0.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Print the help where there are no arguments."""
        if not args and not ctx.resilient_parsing:
            print_line(ctx.get_help())
            ctx.exit(2)
        return super().parse_args(ctx, args)
