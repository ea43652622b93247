"""Results of parallel jobs in the order of the jobs, so that sums over them are reproducible."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

from .errors import PachonError
from .progress import Reporter
from .workers import Compute, MakeWorkers, serial_worker


@dataclass(frozen=True)
class OrderedJob:
    """Job of :func:`ordered_results`."""

    number: int
    label: str  #: name in messages
    content: Any  #: argument of the computation


@dataclass(frozen=True)
class OrderedComputation:
    """Computation of ordered jobs, picklable where `compute` is."""

    compute: Compute  #: function of the content of a job and of a number of threads

    def __call__(self, job: OrderedJob, threads: int) -> tuple[int, Any]:
        """Return the number of a job and its result, or the error that names the job."""
        try:
            return job.number, self.compute(job.content, threads)
        except PachonError as error:
            return job.number, error.within(subject=job.label)


def ordered_results(
    compute: Compute,
    labels: Sequence[str],
    contents: Iterable[Any],
    *,
    title: str | None = None,
    workers: MakeWorkers | None = None,
    threads: int | None = None,
    check: Callable[[int], None] = lambda _: None,
    reporter: Reporter,
) -> Iterator[Any]:
    """Compute jobs, and yield their results in the order of the jobs.

    A result waits in memory for those before it. Workers take jobs in their order, so few wait at once.

    Parameters
    ----------
    compute : callable
        Picklable function of the content of a job and of a number of threads.
    labels : sequence of str
        Names of the jobs in messages, all different.
    contents : iterable
        Contents of the jobs, made as workers take them.
    title : str, optional
        Title of the progress bar; without one there is none.
    workers : callable, optional
        Function that makes the workers; by default this process.
    threads : int, optional
        Number of threads of this process; all processors by default.
    check : callable
        Called with the number of processes of this machine before the first job; raises if memory is short.
    reporter : Reporter
        Progress display.

    Raises
    ------
    PachonError
        That of a job that failed; if a worker is lost.
    """
    ordered = OrderedComputation(compute)
    job_workers = serial_worker(ordered, threads) if workers is None else workers(ordered)
    check(job_workers.processes)
    jobs = (OrderedJob(i, *job) for i, job in enumerate(zip(labels, contents, strict=True)))
    named = title if workers is None else f"{title}, {job_workers.description}"
    waiting: dict[int, Any] = {}
    done = due = 0
    with nullcontext() if title is None else reporter.stage(str(named), total=len(labels)) as stage:
        for number, result in job_workers.results(jobs):
            if isinstance(result, PachonError):
                raise result
            done += 1
            if stage is not None:
                stage.advance()
                stage.step(labels[number], done, len(labels))
            waiting[number] = result
            while due in waiting:
                yield waiting.pop(due)
                due += 1
