"""A second process for computations in parallel with this one, such as half of the plots of a report."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import current_process, get_context
from multiprocessing.reduction import ForkingPickler
from typing import Any

from .errors import ProductError
from .launch_threads import end_if_alone
from .process_pool import first_done
from .threads import thread_count
from .workers import begin_worker

#: Function that takes a function of a module and its arguments, all picklable, and returns a function that waits for
#: the result.
Submit = Callable[..., Callable[[], Any]]


@contextmanager
def second_process(threads: int | None = None) -> Iterator[Submit]:
    """Yield a function that hands computations to a second process, which does them one after the other.

    The process is a fork of this one, so it starts at once; it ends with the block, or with this process. There is none
    for one thread, where this process has other threads, whose locks a fork would keep, where it may have no processes
    of its own, as those of a ``multiprocessing.Pool``, or outside Linux, whose libraries survive forks: computations
    are then done in this process, at once. Waiting for a result raises what the computation has raised, or ProductError
    if the process was killed.
    """
    possible = thread_count(threads) > 1 and sys.platform == "linux" and not current_process().daemon
    if not possible or not end_if_alone():
        yield _run_at_once
        return
    pool = ProcessPoolExecutor(1, mp_context=get_context("fork"), initializer=begin_worker, initargs=(os.getpid(),))

    def submit(function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
        # The pool would pickle arguments in a thread of its own, while this one goes on to change what they hold.
        future = pool.submit(_run_pickled, bytes(ForkingPickler.dumps((function, arguments))))
        return lambda: _result(pool, future)

    try:
        # A process is started by the first computation.
        submit(os.getpid)
        yield submit
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _run_pickled(call: bytes) -> Any:
    function, arguments = ForkingPickler.loads(call)
    return function(*arguments)


def _run_at_once(function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    result = function(*arguments)
    return lambda: result


def _result(pool: ProcessPoolExecutor, future: Future[Any]) -> Any:
    try:
        first_done(pool, [future])
        return future.result()
    except BrokenProcessPool:
        raise ProductError(
            "the second process died, killed or short of memory; what was computed is kept, go on with --resume"
        ) from None
