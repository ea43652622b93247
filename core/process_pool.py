"""Results of the processes of a pool, of which one may be killed while it hands on a result."""

from __future__ import annotations

from collections.abc import Collection
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from multiprocessing import connection
from typing import Any

#: Interval at which processes are looked at while there is no result [s].
_LOOK_SECONDS = 1.0


def first_done(
    pool: ProcessPoolExecutor, futures: Collection[Future[Any]]
) -> tuple[set[Future[Any]], set[Future[Any]]]:
    """Wait for a result of a pool; return the futures that are done, and the others.

    Futures of a process that was killed raise BrokenProcessPool. A pool notices that by itself, unless the process was
    halfway through writing a result: the pool's thread then waits for the rest of it, and other processes for the lock.
    """
    while True:
        done, waiting = wait(futures, timeout=_LOOK_SECONDS, return_when=FIRST_COMPLETED)
        if done:
            return done, waiting
        if connection.wait([process.sentinel for process in _processes(pool)], timeout=0):
            end_processes(pool)


def end_processes(pool: ProcessPoolExecutor) -> None:
    """End the processes of a pool at once, whatever they do."""
    for process in _processes(pool):
        process.terminate()
    # With no writer left the pool's thread does not wait for the rest of a result.
    pool._result_queue._writer.close()  # type: ignore[attr-defined]


def _processes(pool: ProcessPoolExecutor) -> list[Any]:
    return list((pool._processes or {}).values())
