"""Options and arguments whose values are words or names: help lists them, shells complete them, wrong ones are refused.

The modules that compute have the same words; they are slow to import, so they are stated once more where options are
declared, and a test compares them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from typer import Option

from ..core.errors import check_choice

#: Function that lists names for completion from the context of the command: the values of its other parameters.
Names = Callable[[Any], Iterable[str]]
#: Longest list of words that stands in the place of a value in help [characters].
_LONGEST = 38


def choice(
    words: Sequence[str], *declarations: str, help: str, kind: Callable[..., Any] = Option, **settings: Any
) -> Any:
    """Return an option, or argument by `kind`, whose value is one of some words.

    Help shows the words in the place of the value or, where they are many, behind its text.
    """
    words_text = "|".join(words)
    if len(words_text) > _LONGEST and kind is Option:
        help = f"{help} One of {', '.join(words)}."
        words_text = settings.pop("metavar", "WORD")

    def check(ctx: Any, param: Any, value: Any) -> Any:
        for word in () if value == param.default else [value] if isinstance(value, str) else value or ():
            check_choice(_option_name(param), word, words)
        return value

    settings = {"metavar": words_text, "callback": check, **settings}
    return kind(*declarations, help=help, autocompletion=completion(lambda ctx: words), **settings)


def names(
    source: Names,
    *declarations: str,
    help: str,
    metavar: str,
    kind: Callable[..., Any] = Option,
    listed: bool = False,
    **settings: Any,
) -> Any:
    """Return an option, or argument by `kind`, whose value is a name that shells complete, or text of another form.

    With `listed` the value is a list of names with commas between.
    """
    return kind(*declarations, help=help, metavar=metavar, autocompletion=completion(source, listed=listed), **settings)


def completion(source: Names, *, listed: bool = False) -> Callable[[Any, str], list[str]]:
    """Return the function of typer that completes a value by the names of a source."""

    def complete(ctx: Any, incomplete: str) -> list[str]:
        before, comma, word = incomplete.rpartition(",") if listed else ("", "", incomplete)
        used = set(before.split(","))
        return [f"{before}{comma}{name}" for name in source(ctx) if name.startswith(word) and name not in used]

    return complete


def _option_name(param: Any) -> str:
    """Return the longest name of an option, or the name of an argument."""
    return str(max(param.opts, key=len)) if param.param_type_name == "option" else str(param.name)
