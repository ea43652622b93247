"""What a run says while it works: bars on a terminal, plain lines elsewhere, always on standard error."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


class Stage:
    """One stage of a run, on its way.

    Parameters
    ----------
    bars : Progress, optional
        Bars on a terminal.
    task : TaskID, optional
        The bar of this stage.
    say : bool
        Whether to write lines: nobody sees bars.
    """

    def __init__(self, bars: Progress | None, task: TaskID | None, say: bool) -> None:
        self._bars = bars
        self._task = task
        self._say = say

    def advance(self, count: int = 1) -> None:
        """Tell that so many more items are done."""
        if self._bars is not None and self._task is not None:
            self._bars.advance(self._task, count)

    def line(self, text: str) -> None:
        """Write one line, where there are no bars to see."""
        if self._say:
            print(text, file=sys.stderr, flush=True)


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

    def line(self, text: str) -> None:
        """Write one line."""
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Stage]:
        """Show one stage while it runs.

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
            stage = Stage(None, None, not self.quiet)
            yield stage
            self.seconds[title] = time.perf_counter() - start
            stage.line(f"{title}: {self.seconds[title]:.1f} s")
            return
        columns = (
            SpinnerColumn(finished_text="[green]✓"),
            TextColumn("{task.description}"),
            BarColumn(bar_width=32),
            MofNCompleteColumn(),
            TimeRemainingColumn(compact=True),
            TimeElapsedColumn(),
        )
        shown = columns if total is not None else (*columns[:2], columns[-1])
        with Progress(*shown, console=console) as bars:
            task = bars.add_task(title, total=total)
            yield Stage(bars, task, False)
            bars.update(task, total=total or 1, completed=total or 1)
        self.seconds[title] = time.perf_counter() - start
