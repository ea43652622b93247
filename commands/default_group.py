"""A group of commands of which one needs no name."""

from __future__ import annotations

from copy import copy
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from typer.core import TyperGroup

from .plain_help import PlainHelp


class DefaultGroup(PlainHelp, TyperGroup):
    """A group whose first command may be left out: ``pachon sweep FILE`` is ``pachon sweep run FILE``.

    The help of the group shows the options of that command too, and options may stand before the name of a command.
    """

    @property
    def default(self) -> str:
        """Name of the command that may be left out."""
        return next(iter(self.commands))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the name of the command first: the one behind the options, or the default where there is none."""
        if args and args[0].startswith("-") and args[0] != "--help":
            _, positionals, _ = self._with_default("option").make_parser(ctx).parse_args(args=list(args))
            if positionals and positionals[0] in self.commands:
                args = [positionals[0], *args[: len(args) - len(positionals)], *positionals[1:]]
        first = args[0] if args else ""
        if first not in (*self.commands, "--help") and not self._is_mistyped(first):
            args = [self.default, *args]
        return super().parse_args(ctx, args)

    def _is_mistyped(self, word: str) -> bool:
        path = Path(word)
        may_be_file = word.startswith("-") or bool(path.suffix) or path.exists()
        return not may_be_file and bool(get_close_matches(word, list(self.commands)))

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help of the group, with the options of the default command."""
        super(DefaultGroup, self._with_default("option", "argument")).format_help(ctx, formatter)

    def _with_default(self, *kinds: str) -> DefaultGroup:
        """Return a copy of the group with parameters of the default command, which the group itself does not parse."""
        group = copy(self)
        group.params = [p for p in self.commands[self.default].params if p.param_type_name in kinds]
        return group
