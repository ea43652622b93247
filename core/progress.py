"""Progress display: bars on a terminal, plain lines elsewhere, always on standard error."""

from __future__ import annotations

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
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from .terminal import print_line, terminal_text


class Stage:
    """One stage of a run in progress, with a bar on a terminal or, if `say`, with lines.

    `bar` moves the bar on by a number of items. `check` is called whenever something is done, and may raise.
    """

    def __init__(self, bar: Callable[[int], None] | None, say: bool, check: Callable[[], None]) -> None:
        self._bar, self._say, self._check = bar, say, check
        self._start = time.perf_counter()

    def advance(self, count: int = 1) -> None:
        """Advance by a number of items."""
        self._check()
        if self._bar is not None:
            self._bar(count)

    def line(self, text: str) -> None:
        """Write one line, unless there is a bar."""
        if self._say:
            print_line(text, error=True)

    def step(self, name: str, done: int, total: int) -> None:
        """Write that one more part is done, and the time left, unless there is a bar."""
        seconds = time.perf_counter() - self._start
        seconds_left = seconds / done * (total - done)
        time_left = f"{seconds_left:.0f} s" if seconds_left < 100.0 else f"{seconds_left / 60.0:.0f} min"
        forecast = f", {_speed_text(done / seconds)}, about {time_left} left" if done < total else ""
        self.line(f"{name} ({done} of {total}{forecast})")


class _SpeedColumn(ProgressColumn):
    """Items per second, or per minute where they take long."""

    def render(self, task: Task) -> Text:
        return Text("" if not task.speed else _speed_text(task.speed), style="progress.data.speed")


def _speed_text(per_second: float) -> str:
    return f"{per_second:.3g}/s" if per_second >= 0.1 else f"{60.0 * per_second:.3g}/min"


class Reporter:
    """Progress display of a run, and the time [s] that each stage takes.

    `check` is called at every step that is reported, to stop the run by raising an exception.
    """

    def __init__(self, quiet: bool = False, check: Callable[[], None] | None = None) -> None:
        self.quiet = quiet
        self.check = check or (lambda: None)
        self.seconds: dict[str, float] = {}

    def line(self, text: str) -> None:
        """Write one line."""
        if not self.quiet:
            print_line(text, error=True)

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Stage]:
        """Show one stage while it runs; without the total number of items its bar has no length."""
        self.check()
        start = time.perf_counter()
        console = Console(stderr=True)
        if self.quiet or not console.is_terminal:
            stage = Stage(None, not self.quiet, self.check)
            yield stage
            self.seconds[title] = time.perf_counter() - start
            stage.line(f"{title}: {self.seconds[title]:.1f} s")
            return
        columns = (
            SpinnerColumn(finished_text="[green]✓"),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=32),
            MofNCompleteColumn(),
            _SpeedColumn(),
            TimeRemainingColumn(compact=True),
            TimeElapsedColumn(),
        )
        shown = columns if total is not None else (*columns[:2], columns[-1])
        with Progress(*shown, console=console) as bars:
            task = bars.add_task(terminal_text(title), total=total)
            yield Stage(lambda count: bars.advance(task, count), False, self.check)
            bars.update(task, total=total or 1, completed=total or 1)
        self.seconds[title] = time.perf_counter() - start
