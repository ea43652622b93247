"""What a run says while it works: bars on a terminal, one line a stage elsewhere, always on standard error."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

Advance = Callable[[int], None]


class Reporter:
    """Tell how far a run has come, and keep how long each stage took.

    Parameters
    ----------
    quiet : bool
        Say nothing at all.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.quiet = quiet
        self.seconds: dict[str, float] = {}

    def note(self, text: str) -> None:
        """Say one line."""
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Advance]:
        """Show one stage while it runs; yields what to call with the number of items done.

        Parameters
        ----------
        title : str
            What is being done.
        total : int, optional
            Number of items; without it the stage shows that it runs, not how far it is.
        """
        start = time.perf_counter()
        console = Console(stderr=True)
        if self.quiet or not console.is_terminal:
            yield lambda count: None
            self.seconds[title] = self.seconds.get(title, 0.0) + time.perf_counter() - start
            self.note(f"{title}: {self.seconds[title]:.1f} s")
            return
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=32),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
        )
        with Progress(*columns, console=console) as bars:
            task = bars.add_task(title, total=total)
            yield lambda count: bars.advance(task, count)
            bars.update(task, total=total or 1, completed=total or 1)
        self.seconds[title] = self.seconds.get(title, 0.0) + time.perf_counter() - start
