"""Workers that compute points: this process, processes of this machine, or a Dask cluster.

All workers call the same function for each point, and yield results in any order. No result depends on the worker. The
threads of each worker are bounded, so that all workers together have no more threads than processors. For a cluster the
package ``distributed`` must be installed.
"""

from __future__ import annotations

import logging
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice
from multiprocessing import get_context
from typing import Any
from uuid import uuid4

from ...core.errors import ConfigError, ProductError
from ...core.threads import thread_count
from ...core.version import VERSION
from .store import PointResult, SweepPoint

#: Function that computes one point on a number of threads.
Measure = Callable[[SweepPoint, int], PointResult]
#: Points handed out ahead of the results, to each worker: none waits, and a cluster never holds all points.
AHEAD = 2
#: Variables that bound the threads of libraries.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
#: Time between two looks of a worker at whether its driver lives [s].
PARENT_SECONDS = 0.5
#: Longest wait for an answer of a scheduler [s].
CONNECT_SECONDS = 20.0


@dataclass(frozen=True)
class Workers:
    """Workers that compute the points of a sweep.

    `results` yields the result of every point as soon as it is there, in any order, and raises a ProductError if a
    worker or the connection to it is lost.
    """

    description: str  #: number and kind
    results: Callable[[Iterable[SweepPoint]], Iterator[PointResult]]


def serial_worker(measure: Measure, threads: int | None = None) -> Workers:
    """Return this process as the only worker, with all processors or a number of threads."""
    count = thread_count(threads)
    return Workers(f"this process, {count} threads", lambda points: (measure(point, count) for point in points))


def process_workers(measure: Measure, count: int, threads: int | None = None) -> Workers:
    """Return processes of this machine that share its processors, or a number of threads, evenly.

    `measure` is a function of a module, or a picklable object: it computes one point on a number of threads.
    """
    each = max(1, thread_count(threads) // count)

    def results(points: Iterable[SweepPoint]) -> Iterator[PointResult]:
        # A fresh interpreter, not a fork: Warp and OpenMP keep threads that a fork would lose. Variables that bound the
        # threads of libraries must be set before a worker imports them.
        with _environment({name: str(each) for name in _THREAD_VARIABLES}):
            pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=_begin)
            waiting: set[Future[PointResult]] = set()
            try:
                for point in points:
                    waiting.add(pool.submit(measure, point, each))
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


def _begin() -> None:
    """Let Ctrl-C end the process that hands out points, not those that compute them; these end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this process when its parent has gone: one that is killed cannot tell its workers."""
    while os.getppid() == parent:
        time.sleep(PARENT_SECONDS)
    os._exit(1)


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


def dask_workers(measure: Measure, client: Any) -> Workers:
    """Return the workers of a Dask cluster, reached through a ``distributed.Client``.

    The points of a lost worker are computed by another. Without any worker, the results wait until one comes.
    """
    info = client.scheduler_info()
    count = len(info["workers"])
    description = f"{count} Dask worker{'s' * (count != 1)} of {info['address']}"

    def results(points: Iterable[SweepPoint]) -> Iterator[PointResult]:
        from distributed import CancelledError, as_completed
        from distributed.scheduler import KilledWorker

        source = iter(points)
        ahead = AHEAD * max(1, sum(client.nthreads().values()))
        # Own keys: one scheduler may serve several sweeps, each with a point 0.
        batch = uuid4().hex[:8]

        def submit(point: SweepPoint) -> Any:
            # On one thread: Dask runs as many points side by side as a worker has threads.
            return client.submit(measure, point, 1, key=f"pachon-{batch}-{point.number}")

        running = as_completed([submit(point) for point in islice(source, ahead)], loop=client.loop, raise_errors=False)
        for future in running:
            try:
                yield future.result()
            except KilledWorker:
                raise ProductError(
                    f"point {future.key.rpartition('-')[2]}: the workers that computed it died, one after another; "
                    "are they short of memory? What was computed is kept, go on with --resume"
                ) from None
            except (CancelledError, OSError):
                raise ProductError(
                    "the Dask scheduler is lost; what was computed is kept, go on with --resume"
                ) from None
            following = next(source, None)
            if following is not None:
                running.add(submit(following))

    return Workers(description, results)


@contextmanager
def dask_client(address: str, security: Any = None) -> Iterator[Any]:
    """Connect to a Dask scheduler, such as ``tls://host:8786``, whose workers have the same pachon.

    `security` is a ``distributed.Security``, by default that of Dask's own configuration. No answer, another version of
    pachon, or no package ``distributed`` are a ConfigError.
    """
    _require_distributed("--scheduler")
    if not re.fullmatch(r"(tcp|tls|ws|wss|ucx)://\S+:\d+", address):
        raise ConfigError(f"--scheduler = {address}: expected an address such as tcp://host:8786 or tls://host:8786")
    from distributed import Client

    with _quiet_dask():
        try:
            client = Client(address, timeout=CONNECT_SECONDS, security=security, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError(
                f"--scheduler = {address}: no answer within {CONNECT_SECONDS:g} s ({_first_line(error)}); is the "
                "scheduler running, the address as it prints it, the port open, TLS the same on both sides?"
            ) from None
        try:
            check_versions(client)
            yield client
        finally:
            client.close(timeout=5)


@contextmanager
def local_cluster(workers: int | None, say: Callable[[str], None]) -> Iterator[Any]:
    """Start a Dask cluster of processes on this machine, print the address of its dashboard, and connect to it."""
    _require_distributed("--workers")
    from distributed import Client, LocalCluster

    with (
        _quiet_dask(),
        LocalCluster(n_workers=workers, threads_per_worker=1, processes=True) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        say(f"Dask dashboard: {cluster.dashboard_link}")
        yield client


def check_versions(client: Any) -> None:
    """Refuse workers with another version of pachon, whose results may differ, or without it."""
    for worker, theirs in client.run(_version, on_error="return").items():
        if not isinstance(theirs, str):
            raise ConfigError(f"worker {worker}: pachon cannot be imported there ({_first_line(theirs)})")
        if theirs != VERSION:
            raise ConfigError(f"worker {worker}: has pachon {theirs}, expected {VERSION} as here")


@contextmanager
def _quiet_dask() -> Iterator[None]:
    """Silence Dask's tracebacks of lost connections: an error of one line replaces them."""
    import distributed  # noqa: F401 - sets up its loggers

    names = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]
    before = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


def _require_distributed(option: str) -> None:
    if find_spec("distributed") is None:
        raise ConfigError(f"{option} needs the package distributed: pip install 'pachon[dask]'")


def _version() -> str:
    return VERSION


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
