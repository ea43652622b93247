"""Options of a long command that choose its workers: processes of this machine, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

from typer import Option

from ..core.errors import ConfigError
from .interrupt import interruptible

if TYPE_CHECKING:
    from ..core.long_work import Execution
    from ..core.progress import Reporter
    from ..core.workers import MakeWorkers

Processes = Annotated[int | None, Option(min=1, help="Compute in so many processes.")]
Scheduler = Annotated[str | None, Option(metavar="tcp://HOST:PORT", help="Compute on a Dask cluster.")]
DaskWorkers = Annotated[int | None, Option("--workers", min=1, help="Start a local Dask cluster with so many workers.")]


@contextmanager
def long_work(
    quiet: bool,
    finished: str,
    *,
    threads: int | None,
    resume: bool = False,
    processes: int | None = None,
    scheduler: str | None = None,
    dask: int | None = None,
) -> Iterator[Execution]:
    """Yield the execution of a long command; Ctrl-C ends it with one line that names the finished parts."""
    if sum(option is not None for option in (processes, scheduler, dask)) > 1:
        raise ConfigError("--processes, --scheduler and --workers: expected one of them")
    from ..core.long_work import Execution

    with interruptible(quiet, finished) as reporter, _workers(processes, scheduler, dask, threads, reporter) as workers:
        yield Execution(workers, threads, resume, reporter)


@contextmanager
def _workers(
    processes: int | None, scheduler: str | None, dask: int | None, threads: int | None, reporter: Reporter
) -> Iterator[MakeWorkers | None]:
    """Yield the function that makes the workers of at most one option; None where none is given."""
    from ..core.dask_cluster import dask_client, dask_workers, local_cluster
    from ..core.workers import process_workers, serial_worker

    if scheduler is not None:
        with dask_client(scheduler) as client:
            yield lambda compute: dask_workers(compute, client)
    elif dask is not None:
        with local_cluster(dask, reporter.line) as client:
            yield lambda compute: dask_workers(compute, client, local=True)
    elif processes is None:
        yield None
    elif processes == 1:
        yield lambda compute: serial_worker(compute, threads)
    else:
        yield lambda compute: process_workers(compute, processes, threads)
