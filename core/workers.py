"""Workers that compute jobs, such as CCDs or points of a sweep: this process, or processes of this machine.

All workers, those of a cluster in :mod:`.dask_cluster` included, call the same function for each job and yield results
in any order. No result depends on the worker. The threads of each worker are bounded, so that all workers together have
no more threads than processors.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

from .arguments import check_arguments
from .errors import ProductError
from .number_text import counted
from .process_pool import end_processes, first_done
from .threads import thread_count
from .units import require_count

#: Most processes of one machine.
_MOST_PROCESSES = 10_000

#: Picklable function that does one job on a number of threads and returns its result.
Compute = Callable[[Any, int], Any]
#: Jobs submitted to each worker ahead of its results: no worker idles, and a cluster never holds all jobs.
JOBS_AHEAD = 2
#: Variables that bound the threads of libraries.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
#: Interval at which a worker checks that its parent process is alive [s].
PARENT_SECONDS = 0.5


@dataclass(frozen=True)
class Workers:
    """Workers that do jobs.

    `results` yields the result of every job as soon as it is there, in any order, and raises a ProductError if a worker
    or the connection to it is lost.
    """

    description: str  #: number and kind
    processes: int  #: processes of this machine among which its memory is shared; 0 on others
    results: Callable[[Iterable[Any]], Generator[Any, None, None]]


#: Function that makes workers of the function that does a job.
MakeWorkers = Callable[[Compute], Workers]


def serial_worker(compute: Compute, threads: int | None = None) -> Workers:
    """Return this process as the only worker, with all processors or a number of threads."""
    count = thread_count(threads)
    return Workers(f"this process, {counted(count, 'thread')}", 1, lambda jobs: (compute(job, count) for job in jobs))


@check_arguments
def process_workers(compute: Compute, count: int, threads: int | None = None) -> Workers:
    """Return processes of this machine that share its processors evenly.

    Parameters
    ----------
    compute : callable
        Function of a module, or picklable object, of a job and its number of threads, as :class:`Execution` hands on.
    count : int
        Number of processes.
    threads : int, optional
        Number of threads of all processes together; all processors by default.

    Raises
    ------
    DomainError
        If a number is less than 1.
    """
    count = require_count(count, "count", 1, _MOST_PROCESSES)
    threads_per_process = max(1, thread_count(threads) // count)

    def results(jobs: Iterable[Any]) -> Generator[Any, None, None]:
        # A fresh interpreter, not a fork: Warp and OpenMP keep threads that a fork would lose. Variables that bound the
        # threads of libraries must be set before a worker imports them.
        with _environment({name: str(threads_per_process) for name in _THREAD_VARIABLES}):
            pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=begin_worker)
            waiting: set[Future[Any]] = set()
            try:
                for job in jobs:
                    waiting.add(pool.submit(compute, job, threads_per_process))
                    if len(waiting) >= JOBS_AHEAD * count:
                        done, waiting = first_done(pool, waiting)
                        yield from (future.result() for future in done)
                while waiting:
                    done, waiting = first_done(pool, waiting)
                    yield from (future.result() for future in done)
            except BrokenProcessPool:
                raise ProductError(
                    "a worker process died, killed or short of memory; what was computed is kept, go on with --resume"
                ) from None
            except BaseException:
                # Ctrl-C or an error: nobody will take the results of the jobs under way, which may take minutes.
                end_processes(pool)
                raise
            finally:
                pool.shutdown(wait=True, cancel_futures=True)

    return Workers(
        f"{counted(count, 'process', 'processes')} of {counted(threads_per_process, 'thread')}", count, results
    )


def worker_name() -> str:
    """Return the name of this worker: machine and process."""
    return f"{os.uname().nodename if hasattr(os, 'uname') else 'machine'}:{os.getpid()}"


def begin_worker(parent: int | None = None) -> None:
    """Leave Ctrl-C to the process that submits the jobs, by default the parent, and exit with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=exit_with_parent, args=(parent or os.getppid(),), daemon=True).start()


def exit_with_parent(parent: int) -> None:
    """Exit once the parent process has ended; a killed parent cannot stop its workers. Never returns."""
    while os.getppid() == parent:
        time.sleep(PARENT_SECONDS)
    os._exit(1)


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
