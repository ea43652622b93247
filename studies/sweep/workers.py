"""Who computes the points of a sweep: this process, processes of this machine, or a Dask cluster.

All of them hand a point to the same function and give its result back in any order; nothing of a result depends on who
computed it. Each worker's threads are bounded, so that processors are not shared by more threads than there are.
"""

from __future__ import annotations

import logging
import os
import re
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import islice
from multiprocessing import get_context
from typing import Any, Protocol
from uuid import uuid4

from ...core.errors import ConfigError, ProductError
from ...core.threads import thread_count
from ...core.version import VERSION
from .store import PointResult, SweepPoint

#: Computes one point on so many threads.
Measure = Callable[[SweepPoint, int], PointResult]
#: Points handed out ahead of the results, to each worker: it never waits, and a cluster is not sent the whole sweep.
AHEAD = 2
#: How long a scheduler is waited for [s].
CONNECT_SECONDS = 20.0
#: Libraries that start threads of their own, by the variable that bounds them.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


class Workers(Protocol):
    """Compute points, and say who they are."""

    @property
    def description(self) -> str:
        """Who computes, in words."""
        ...

    def results(self, points: Iterable[SweepPoint]) -> Iterator[PointResult]:
        """Yield the result of every point, as soon as it is there."""
        ...


class SerialWorker:
    """The process itself, on all of its threads.

    Parameters
    ----------
    measure : callable
        Computes one point.
    threads : int, optional
        Number of threads; all processors by default.
    """

    def __init__(self, measure: Measure, threads: int | None = None) -> None:
        self._measure = measure
        self._threads = thread_count(threads)

    @property
    def description(self) -> str:
        """Who computes, in words."""
        return f"this process, {self._threads} threads"

    def results(self, points: Iterable[SweepPoint]) -> Iterator[PointResult]:
        """Yield the result of every point."""
        for point in points:
            yield self._measure(point, self._threads)


class ProcessWorkers:
    """Processes of this machine, which share its processors evenly.

    Parameters
    ----------
    measure : callable
        Computes one point; a function of a module, or a picklable object.
    workers : int
        Number of processes.
    threads : int, optional
        Threads of all processes together; all processors by default.
    """

    def __init__(self, measure: Measure, workers: int, threads: int | None = None) -> None:
        self._measure = measure
        self._workers = workers
        self._threads = max(1, thread_count(threads) // workers)

    @property
    def description(self) -> str:
        """Who computes, in words."""
        return f"{self._workers} processes of {self._threads} thread{'s' * (self._threads > 1)}"

    def results(self, points: Iterable[SweepPoint]) -> Iterator[PointResult]:
        """Yield the result of every point, as soon as it is there.

        Raises
        ------
        ProductError
            If a process is killed.
        """
        # A fresh interpreter, not a fork: Warp and OpenMP keep threads that a fork would lose. What bounds those of the
        # libraries must be set before a worker imports them.
        with _environment({name: str(self._threads) for name in _THREAD_VARIABLES}):
            pool = ProcessPoolExecutor(self._workers, mp_context=get_context("spawn"), initializer=_leave_interrupts)
            waiting: set[Future[PointResult]] = set()
            try:
                for point in points:
                    waiting.add(pool.submit(self._measure, point, self._threads))
                    if len(waiting) >= AHEAD * self._workers:
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


class DaskWorkers:
    """The workers of a Dask cluster, reached through its scheduler; the package ``distributed`` must be installed.

    Parameters
    ----------
    measure : callable
        Computes one point.
    client : distributed.Client
        Connection to the scheduler.
    """

    def __init__(self, measure: Measure, client: Any) -> None:
        self._measure = measure
        self._client = client

    @property
    def description(self) -> str:
        """Who computes, in words."""
        info = self._client.scheduler_info()
        count = len(info["workers"])
        return f"{count} Dask worker{'s' * (count != 1)} of {info['address']}"

    def results(self, points: Iterable[SweepPoint]) -> Iterator[PointResult]:
        """Yield the result of every point, as soon as it is there.

        A worker that is lost has its points computed by another. Without any worker this waits until one comes.

        Raises
        ------
        ProductError
            If the scheduler is lost.
        """
        from distributed import CancelledError, as_completed
        from distributed.scheduler import KilledWorker

        source = iter(points)
        ahead = AHEAD * max(1, sum(self._client.nthreads().values()))
        # Keys of our own: one scheduler may serve several sweeps, each with a point 0.
        sweep = uuid4().hex[:8]

        def submit(point: SweepPoint) -> Any:
            return self._client.submit(_on_one_thread, self._measure, point, key=f"pachon-{sweep}-{point.number}")

        first = [submit(point) for point in islice(source, ahead)]
        running = as_completed(first, loop=self._client.loop, raise_errors=False)
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


@contextmanager
def _quiet_dask() -> Iterator[None]:
    """Keep Dask's tracebacks of lost connections to itself: one line of ours says what happened and what to do."""
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


@contextmanager
def dask_client(address: str, security: Any = None) -> Iterator[Any]:
    """Connect to a Dask scheduler whose workers have the same pachon.

    Parameters
    ----------
    address : str
        Such as ``tcp://host:8786`` or ``tls://host:8786``.
    security : distributed.Security, optional
        TLS settings; those of Dask's own configuration by default.

    Raises
    ------
    ConfigError
        If ``distributed`` is not installed, the scheduler does not answer, or a worker has another version of pachon.
    """
    if find_spec("distributed") is None:
        raise ConfigError("--scheduler needs the package distributed: pip install 'pachon[dask]'")
    if not re.fullmatch(r"(tcp|tls|ws|wss|ucx)://\S+:\d+", address):
        raise ConfigError(f"--scheduler = {address}: expected an address such as tcp://host:8786 or tls://host:8786")
    with _quiet_dask():
        client = _connected(address, security)
        try:
            check_versions(client)
            yield client
        finally:
            client.close(timeout=5)


def _connected(address: str, security: Any) -> Any:
    from distributed import Client

    try:
        return Client(address, timeout=CONNECT_SECONDS, security=security, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ConfigError(
            f"--scheduler = {address}: no answer within {CONNECT_SECONDS:g} s ({_first_line(error)}); is the scheduler "
            "running, the address as it prints it, the port open, TLS the same on both sides?"
        ) from None


@contextmanager
def local_cluster(workers: int | None, say: Callable[[str], None]) -> Iterator[Any]:
    """Start a Dask cluster of processes on this machine, tell where its dashboard is, and connect to it.

    Raises
    ------
    ConfigError
        If ``distributed`` is not installed.
    """
    if find_spec("distributed") is None:
        raise ConfigError("--workers needs the package distributed: pip install 'pachon[dask]'")
    from distributed import Client, LocalCluster

    with (
        _quiet_dask(),
        LocalCluster(n_workers=workers, threads_per_worker=1, processes=True) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        say(f"Dask dashboard: {cluster.dashboard_link}")
        yield client


def check_versions(client: Any) -> None:
    """Refuse workers of another version of pachon, whose figures would be others.

    Raises
    ------
    ConfigError
        If there is one, or a worker has no pachon.
    """
    ours = VERSION
    for worker, theirs in client.run(_version, on_error="return").items():
        if not isinstance(theirs, str):
            raise ConfigError(f"worker {worker}: pachon cannot be imported there ({_first_line(theirs)})")
        if theirs != ours:
            raise ConfigError(f"worker {worker}: has pachon {theirs}, expected {ours} as here")


def worker_name() -> str:
    """Return who computes, for the table of results: the machine and the process."""
    return f"{os.uname().nodename if hasattr(os, 'uname') else 'machine'}:{os.getpid()}"


def _version() -> str:
    return VERSION


def _on_one_thread(measure: Measure, point: SweepPoint) -> PointResult:
    # Dask runs as many tasks side by side as a worker has threads.
    return measure(point, 1)


def _leave_interrupts() -> None:
    """Let Ctrl-C end the process that hands out points, not those that compute them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


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
