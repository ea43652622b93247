"""The command line, ``pachon run | reproduce | diagnose | attribute | study | opd | info``, and its groups of commands.

A group is a file ``command_<subject>.py`` whose ``COMMANDS`` maps names to functions. What is slow to import, which is
all that computes, is imported inside those functions: ``pachon --help`` is to be quick.

Exit status 0: done; 2: bad input or a file that cannot be written, one line on standard error; 130: interrupted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated, Any

import typer

from ..core.errors import PachonError
from . import baseline as command_baseline
from . import design as command_design
from . import design_images as command_design_images
from . import diagnostics as command_diagnostics
from . import field as command_field
from . import lens as command_lens
from . import models as command_models
from . import reproduce as command_reproduce
from . import run as command_run
from . import sensitivity as command_sensitivity
from . import study as command_study
from . import sweep as command_sweep
from .options import InterruptedRunError

#: The groups of commands, in the order of the help.
_GROUPS = (
    command_run,
    command_reproduce,
    command_diagnostics,
    command_study,
    command_sweep,
    command_baseline,
    command_design,
    command_field,
    command_design_images,
    command_models,
    command_lens,
    command_sensitivity,
)
# Both live in typer or in click, as the version of typer has it; this way the right ones are caught.
_UsageError: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

app = typer.Typer(
    name="pachon",
    help="Ray-traced telescope wavefronts, turbulent atmospheres and PSF reconstruction.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)

_INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Parameters
    ----------
    arguments : sequence of str, optional
        Arguments; those of the process by default.
    """
    try:
        status = app(args=None if arguments is None else list(arguments), prog_name="pachon", standalone_mode=False)
        sys.stdout.flush()
        if status == _INTERRUPTED:
            return _fail("interrupted", _INTERRUPTED)
        return status if isinstance(status, int) else 0
    except InterruptedRunError as error:
        return _fail(str(error), _INTERRUPTED)
    except _UsageError as error:
        return _fail(error.format_message())
    except BrokenPipeError:
        # Whoever read our output has gone; Python would complain once more when it closes the stream.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except PachonError as error:
        return _fail(str(error))
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except MemoryError:
        return _fail("not enough memory; fewer threads or smaller atmosphere.screen_size need less")
    except (KeyboardInterrupt, typer.Abort):
        return _fail("interrupted", _INTERRUPTED)


def _fail(text: str, status: int = 2) -> int:
    print(f"pachon: error: {' '.join(text.split())}", file=sys.stderr, flush=True)
    return status


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"pachon {version('pachon')}")
        raise typer.Exit


@app.callback()
def _common(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    del show_version


for _group in _GROUPS:
    for _name, _command in _group.COMMANDS.items():
        app.command(_name)(_command)


if __name__ == "__main__":
    sys.exit(main())
