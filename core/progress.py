"""Progress display: bars on a terminal, plain lines elsewhere, always on standard error."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text


class Stage:
    """One stage of a run in progress.

    Parameters
    ----------
    bars : Progress, optional
        Bars on a terminal.
    task : TaskID, optional
        The bar of this stage.
    say : bool
        Whether to write lines in place of bars.
    check : callable
        Called whenever something is done; may raise.
    """

    def __init__(self, bars: Progress | None, task: TaskID | None, say: bool, check: Callable[[], None]) -> None:
        self._bars = bars
        self._check = check
        self._task = task
        self._say = say
        self._start = time.perf_counter()

    def advance(self, count: int = 1) -> None:
        """Advance by a number of items."""
        self._check()
        if self._bars is not None and self._task is not None:
            self._bars.advance(self._task, count)

    def line(self, text: str) -> None:
        """Write one line, unless there are bars."""
        if self._say:
            print(text, file=sys.stderr, flush=True)

    def step(self, name: str, done: int, total: int) -> None:
        """Write that one more part is done, and the time left, unless there are bars."""
        seconds = time.perf_counter() - self._start
        left = seconds / done * (total - done)
        rest = (
            f", {_rate(done / seconds)}, about "
            + (f"{left:.0f} s" if left < 100.0 else f"{left / 60.0:.0f} min")
            + " left"
        )
        self.line(f"{name} ({done} of {total}{rest if done < total else ''})")


class _Rate(ProgressColumn):
    """Items per second, or per minute where they take long."""

    def render(self, task: Task) -> Text:
        return Text("" if not task.speed else _rate(task.speed), style="progress.data.speed")


def _rate(per_second: float) -> str:
    return f"{per_second:.3g}/s" if per_second >= 0.1 else f"{60.0 * per_second:.3g}/min"


class Reporter:
    """Progress display of a run, and the time that each stage takes.

    Parameters
    ----------
    quiet : bool
        Whether to print nothing.
    check : callable, optional
        Called at every step that is reported, to stop the run by raising an exception.
    """

    def __init__(self, quiet: bool = False, check: Callable[[], None] | None = None) -> None:
        self.quiet = quiet
        self._check = check or (lambda: None)
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
            Name of the stage.
        total : int, optional
            Number of items; without it the bar has no length.
        """
        self._check()
        start = time.perf_counter()
        console = Console(stderr=True)
        if self.quiet or not console.is_terminal:
            stage = Stage(None, None, not self.quiet, self._check)
            yield stage
            self.seconds[title] = time.perf_counter() - start
            stage.line(f"{title}: {self.seconds[title]:.1f} s")
            return
        columns = (
            SpinnerColumn(finished_text="[green]✓"),
            TextColumn("{task.description}"),
            BarColumn(bar_width=32),
            MofNCompleteColumn(),
            _Rate(),
            TimeRemainingColumn(compact=True),
            TimeElapsedColumn(),
        )
        shown = columns if total is not None else (*columns[:2], columns[-1])
        with Progress(*shown, console=console) as bars:
            task = bars.add_task(title, total=total)
            yield Stage(bars, task, False, self._check)
            bars.update(task, total=total or 1, completed=total or 1)
        self.seconds[title] = time.perf_counter() - start
