"""Progress of a long command, and its end by Ctrl-C."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..core.progress import Reporter


class InterruptedRunError(Exception):
    """A command ended by Ctrl-C; the text names the place of the finished parts."""


@contextmanager
def interruptible(quiet: bool, finished: str = "") -> Iterator[Reporter]:
    """Yield the reporter of a long command, which Ctrl-C ends with one line that names the finished parts."""
    from ..core.interrupt import remembered_interrupts
    from ..core.progress import Reporter

    try:
        with remembered_interrupts() as check:
            yield Reporter(quiet, check)
    except KeyboardInterrupt:
        raise InterruptedRunError(f"interrupted; {finished}" if finished else "interrupted") from None
