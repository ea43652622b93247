"""Workers of this machine: this process, or several.

All workers call the same function for each task, and yield results in any order. No result depends on the worker. The
threads of each worker are bounded, so that all workers together have no more threads than processors.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, Generic, TypeVar

from ...core.errors import ProductError
from ...core.threads import thread_count

Task = TypeVar("Task")
Result = TypeVar("Result")
#: Function that computes one task on a number of threads.
Measure = Callable[[Task, int], Result]
#: Tasks handed out ahead of the results, to each worker: none waits, and a cluster never holds all tasks.
AHEAD = 2
#: Variables that bound the threads of libraries.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


@dataclass(frozen=True)
class Workers(Generic[Task, Result]):
    """Workers for tasks of one kind.

    `results` yields the result of every task as soon as it is there, in any order, and raises a ProductError if a
    worker or the connection to it is lost.
    """

    description: str  #: number and kind
    results: Callable[[Iterable[Task]], Iterator[Result]]


def serial_worker(measure: Measure[Task, Result], threads: int | None = None) -> Workers[Task, Result]:
    """Return this process as the only worker, with all processors or a number of threads."""
    count = thread_count(threads)
    return Workers(f"this process, {count} threads", lambda tasks: (measure(task, count) for task in tasks))


def process_workers(measure: Measure[Task, Result], count: int, threads: int | None = None) -> Workers[Task, Result]:
    """Return processes of this machine that share its processors, or a number of threads, evenly.

    `measure` is a function of a module, or a picklable object: it computes one task on a number of threads.
    """
    each = max(1, thread_count(threads) // count)

    def results(tasks: Iterable[Task]) -> Iterator[Result]:
        # A fresh interpreter, not a fork: Warp and OpenMP keep threads that a fork would lose. Variables that bound the
        # threads of libraries must be set before a worker imports them.
        with _environment({name: str(each) for name in _THREAD_VARIABLES}):
            pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=_leave_interrupts)
            waiting: set[Future[Result]] = set()
            try:
                for task in tasks:
                    waiting.add(pool.submit(measure, task, each))
                    if len(waiting) >= AHEAD * count:
                        done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                        yield from (future.result() for future in done)
                while waiting:
                    done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                    yield from (future.result() for future in done)
            except BrokenProcessPool:
                raise ProductError(
                    "a worker process died, killed or short of memory; what was computed is kept, go on with --resume"
                ) from None
            finally:
                pool.shutdown(wait=True, cancel_futures=True)

    return Workers(f"{count} processes of {each} thread{'s' * (each > 1)}", results)


def worker_name() -> str:
    """Return the name of this worker: machine and process."""
    return f"{os.uname().nodename if hasattr(os, 'uname') else 'machine'}:{os.getpid()}"


def _leave_interrupts() -> None:
    """Let Ctrl-C end the process that hands out tasks, not those that compute them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    before: dict[str, Any] = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
