"""The command line, ``pachon``: its commands, exit statuses and errors.

Every file of commands has an ``app`` that this one adds to its own. Modules that compute are slow to import;
commands import them inside their functions, so that ``pachon --help`` is quick.

Exit status 0: done; 1: a check failed; 2: bad input or a file that cannot be written, one line on standard error, or
no command, after the help; 130: interrupted.
"""

from __future__ import annotations

import functools
import io
import logging
import os
import re
import sys
from collections.abc import Sequence
from copy import copy
from importlib import import_module
from typing import Annotated, Any

import typer
from typer import Option

from ..core.errors import PachonError
from ..core.terminal import print_line
from ..core.version import VERSION
from .help_group import HelpGroup
from .interrupt import InterruptedRunError
from .panels import plain_help, sort_into_panels
from .targets import with_checked_targets

# The error of bad arguments is a class of typer or of click, depending on the version of typer.
_UsageError: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

app = typer.Typer(
    name="pachon",
    cls=HelpGroup,
    help="Ray-traced telescope wavefronts, turbulent atmospheres and PSF reconstruction.\n\n"
    "In every command -o is the file or folder of the product, --picture that of the picture, --table that of the "
    "table that is printed. Products that are folders have their pictures in them.",
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
#: The files of commands, in the order of the help.
_FILES = (
    *("run", "images", "visits", "stack_images", "reproduce", "diagnostics", "measure", "model", "study", "design"),
    *("tolerance", "sweep", "baseline", "camera", "shim", "donuts", "align", "telescope", "files", "config"),
    *("desk", "warm_up"),
)
_GROUPS = [import_module(f".{name}", __package__) for name in _FILES]
_INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line with arguments, by default those of the process, and return its exit status."""
    # It reports a cache that it cannot write, and then uses a temporary one.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    _show_notices()
    _show_all_characters()
    command_line = sys.argv[1:] if arguments is None else list(arguments)
    try:
        first = command_line[0] if command_line else _completed_command()
        status = _built(first)(args=command_line, prog_name="pachon", standalone_mode=False)
        sys.stdout.flush()
        if status == _INTERRUPTED:
            return _fail("interrupted", _INTERRUPTED)
        return status if isinstance(status, int) else 0
    except InterruptedRunError as error:
        return _fail(str(error), _INTERRUPTED)
    except _UsageError as error:
        return _fail(_usage_text(error))
    except BrokenPipeError:
        return _reader_has_gone()
    except SystemExit as end:
        # Rich ends the program where the reader of its output has gone.
        if isinstance(end.__context__, BrokenPipeError):
            return _reader_has_gone()
        raise
    except PachonError as error:
        return _fail(str(error))
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except MemoryError:
        return _fail("not enough memory; fewer threads or smaller atmosphere.screen_size need less")
    except (KeyboardInterrupt, typer.Abort):
        return _fail("interrupted", _INTERRUPTED)


@functools.cache
def _built(first: str) -> Any:
    """Return what runs the command of a name, once built: that takes longer than a short command."""
    return typer.main.get_command(_app_with(first))


def _app_with(first: str) -> typer.Typer:
    """Return an app with the command of a name, and with all where there is none.

    Typer builds all commands of an app before it runs one, which takes longer than a short command.
    """
    commands = [c for group in _GROUPS for c in group.app.registered_commands if c.name == first]
    groups = [g for group in _GROUPS for g in group.app.registered_groups if g.name == first]
    if not commands and not groups:
        return app
    command_app = copy(app)
    command_app.registered_commands, command_app.registered_groups = commands, groups
    return command_app


def _completed_command() -> str:
    """Return the command whose options or values a shell asks to complete; empty where it asks for something else."""
    if "_PACHON_COMPLETE" not in os.environ:
        return ""
    typed = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS") or ""
    words = typed.split()
    # The command itself is completed as long as no space is behind it.
    return words[1] if len(words) > 2 or (len(words) == 2 and typed[-1].isspace()) else ""


def _usage_text(error: Any) -> str:
    """Return the text of an error of arguments; where one is missing, with the first example of the command."""
    text = error.format_message()
    command = error.ctx.command if getattr(error, "ctx", None) else None
    example = re.search(r"\*\*Examples\*\*\s+- `([^`]+)`", getattr(command, "help", None) or "")
    lacks_argument = any(c.__name__ == "MissingParameter" for c in type(error).__mro__)
    return f"{text} For example: {example[1]}" if lacks_argument and example else text


def _reader_has_gone() -> int:
    """Send what is left of the output nowhere: Python would complain once more when it closes the stream."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _show_all_characters() -> None:
    """Let streams that cannot encode a character, such as those of an ASCII terminal, show a question mark."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")


class _NoticeHandler(logging.Handler):
    """Shows notices of the library on standard error, each on a line."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one notice."""
        print_line(record.getMessage(), error=True)


def _show_notices() -> None:
    """Let the command line show what the library has to say, once."""
    logger = logging.getLogger("pachon")
    if not any(isinstance(handler, _NoticeHandler) for handler in logger.handlers):
        logger.addHandler(_NoticeHandler())
        logger.setLevel(logging.INFO)


def _fail(text: str, status: int = 2) -> int:
    print_line(f"pachon: error: {' '.join(text.split())}", error=True)
    return status


def _print_version(show_version: bool) -> None:
    if show_version:
        print_line(f"pachon {VERSION}")
        raise typer.Exit


@app.callback()
def _common(
    show_version: Annotated[
        bool, Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    del show_version


for _group in _GROUPS:
    app.add_typer(_group.app)
sort_into_panels(app)
plain_help(app)
with_checked_targets(app)


if __name__ == "__main__":
    sys.exit(main())
