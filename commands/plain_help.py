"""Commands whose help has words for values in place of Python's types, and that know options of earlier versions."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand

from ..core.errors import ConfigError

#: Options of earlier versions that go on working, by command: the option that each is now.
ALIASES = {"psf": {"--fits": "--out"}, "draw": {"--glb": "--out"}}
#: Words for values by the end of an option's name, where it has a unit.
_UNITS = {
    "deg": "DEG",
    "arcsec": "ARCSEC",
    "nm": "NM",
    "um": "UM",
    "mm": "MM",
    "s": "SECONDS",
    "m": "METRES",
}
#: Words for values by their kind, in the order in which they are looked for.
_KINDS = {"path": "FILE", "int": "N", "float": "NUMBER"}


class PlainHelp:
    """Mixin of commands and groups that writes help without Python's types."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters, each with the word that stands for its value in help."""
        params: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for param in params:
            _name_value(param, ctx)
        return params


class PlainCommand(PlainHelp, TyperCommand):
    """A command of pachon."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse arguments, with options of earlier versions; one that is gone says what has replaced it."""
        aliases = ALIASES.get(str(self.name), {})
        renamed = [aliases.get(option, option) + equals + value for option, equals, value in map(_parts, args)]
        if any(param.param_type_name == "argument" and param.name == "out" for param in self.params):
            renamed = _with_out_last(renamed)
        try:
            return super().parse_args(ctx, renamed)
        except Exception as error:
            if type(error).__name__ == "NoSuchOption":
                self._refuse_retired(str(getattr(error, "option_name", "")))
            raise

    def _refuse_retired(self, option: str) -> None:
        """Raise the error of an option that another one has replaced."""
        has_picture = any("--picture" in param.opts for param in self.params)
        if has_picture and option in ("-o", "--out"):
            raise ConfigError(
                f"pachon {self.name} {option}: it names data, of which this command writes none: expected --picture "
                "FILE for the picture, --table FILE for the numbers"
            )


def _parts(argument: str) -> tuple[str, str, str]:
    return argument.partition("=") if argument.startswith("--") else (argument, "", "")


def _with_out_last(args: list[str]) -> list[str]:
    """Return arguments with the value of --out, where it is given, behind the others: as the argument OUT."""
    for place, (option, equals, value) in enumerate(map(_parts, args)):
        if option == "--out" and equals:
            return [*args[:place], *args[place + 1 :], value]
        if option in ("-o", "--out"):
            return [*args[:place], *args[place + 2 :], *args[place + 1 : place + 2]]
    return args


def _name_value(param: Any, ctx: Any) -> None:
    """Give a parameter the word for its value; arguments and flags have none but their name."""
    is_option = param.param_type_name == "option"
    if is_option and not getattr(param, "is_flag", False):
        param.metavar = param.metavar or _word(param, ctx)
    elif hasattr(param, "display_type_rich"):
        # Of some versions of typer only: others show no types of Python.
        param.display_type_rich = _no_type


def _word(param: Any, ctx: Any) -> str:
    """Return the word for the value of an option, by its unit or kind."""
    kind = param.display_type(ctx) if hasattr(param, "display_type") else param.type.name
    unit = _UNITS.get(str(param.name).rpartition("_")[2]) if "_" in str(param.name) else None
    if unit and "path" not in kind:
        return unit
    word = next((word for name, word in _KINDS.items() if name in kind.lower()), "TEXT")
    return "FOLDER" if word == "FILE" and (param.help or "").startswith("Folder") else word


def _no_type(ctx: Any) -> None:
    """Return nothing, as the kind of a value."""
