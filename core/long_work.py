"""Long work: jobs that workers compute, in a folder in which a killed computation goes on.

Each computation of many jobs has the same steps. :func:`claim_folder` writes its configuration, or refuses a folder of
another one. :meth:`Execution.finished` tells which jobs have whole products. :meth:`Execution.results` hands out the
others and yields their results in the order of the jobs, so that no product depends on the workers.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from .arguments import check_arguments
from .errors import PachonError, ProductError
from .files import folder_of_worker, make_folder, marked_folder, write_bytes, write_new_bytes
from .products import Stamp, is_whole
from .progress import Reporter
from .schema import json_text
from .workers import MakeWorkers, Workers, serial_worker

_T = TypeVar("_T")
#: Differences of two configurations that a message names.
_SHOWN_DIFFERENCES = 3
#: Most lines of progress where there is no bar: with more jobs, each line stands for several.
_MOST_LINES = 200


@dataclass(frozen=True)
class Job:
    """Part of long work, picklable."""

    number: int
    label: str  #: name in messages, such as "point 3" or "CCD R22_S11"
    content: Any  #: argument of the computation


@dataclass(frozen=True)
class JobResult:
    """Result of one job, as a worker returns it."""

    number: int
    value: Any  #: result of the computation, or the PachonError that names the job
    files: tuple[tuple[str, bytes], ...] = ()  #: names and contents, where the worker does not share the folder


@dataclass(frozen=True)
class JobComputation:
    """Compute jobs; a picklable function for every kind of worker where `compute` is picklable.

    With a folder `compute` takes the folder to write to as its last argument: that one where a worker shares it, else a
    temporary one.
    """

    compute: Callable[..., Any]  #: function of the content of a job, a number of threads, and a folder if there is one
    folder: Path | None = None  #: of the products
    mark: str = ""  #: file in the folder, by which workers that share it are told

    def __call__(self, job: Job, threads: int) -> JobResult:
        """Compute one job."""
        try:
            if self.folder is None:
                return JobResult(job.number, self.compute(job.content, threads))
            with folder_of_worker(self.folder, self.mark) as place:
                value = self.compute(job.content, threads, place)
                shared = place == self.folder
                files = () if shared else tuple((path.name, path.read_bytes()) for path in sorted(place.iterdir()))
            return JobResult(job.number, value, files)
        except PachonError as error:
            return JobResult(job.number, error.within(subject=job.label))


@check_arguments
@dataclass(frozen=True)
class Execution:
    """Way in which long work is done; no product depends on it.

    Attributes
    ----------
    workers : callable, optional
        Function that makes the workers that compute the jobs, such as
        ``lambda compute: process_workers(compute, 4)`` (:mod:`pachon.core.workers`); by default this process.
    threads : int, optional
        Number of threads of this process; all processors by default.
    resume : bool
        Whether to keep the jobs that a folder has finished, and go on after them.
    reporter : Reporter
        Progress display; silent by default.
    """

    workers: MakeWorkers | None = None
    threads: int | None = None
    resume: bool = False
    reporter: Reporter = field(default_factory=lambda: Reporter(quiet=True))

    @property
    def alone(self) -> bool:
        """Whether this process is the only worker."""
        return self.workers is None

    def finished(self, products: Mapping[_T, Path], stamp: Stamp) -> tuple[_T, ...]:
        """Return the jobs whose products are whole and have a stamp; none where nothing is resumed."""
        return tuple(job for job, path in products.items() if is_whole(path, stamp)) if self.resume else ()

    @contextmanager
    def results(
        self,
        compute: Callable[..., Any],
        labels: Sequence[str],
        contents: Iterable[Any],
        *,
        title: str | None = None,
        sizes: Sequence[int] | None = None,
        folder: Path | None = None,
        product: Callable[[int], Path] | None = None,
        save: Callable[[Any], None] | None = None,
        check: Callable[[int], None] = lambda _: None,
    ) -> Iterator[Iterator[Any]]:
        """Compute jobs, and yield the iterator over their results, in the order of the jobs.

        A result waits in memory for those before it. Workers take jobs in their order, so few wait at once. At the end
        of the ``with`` block, by an error or Ctrl-C too, the jobs under way are ended.

        Parameters
        ----------
        compute : callable
            Picklable function of the content of a job and a number of threads; and of the folder to write to, where
            there is a `folder`.
        labels : sequence of str
            Names of the jobs in messages, all different.
        contents : iterable
            Contents of the jobs, made as workers take them.
        title : str, optional
            Title of the progress bar; without one there is none.
        sizes : sequence of int, optional
            Items of each job, above zero, that the progress counts; one by default.
        folder : Path, optional
            Folder of the files of all jobs. Those of workers that do not share it are written as they arrive.
        product : callable, optional
            Path of the file of a job, by its number, that is the sign of its end: of such files it is written last.
        save : callable, optional
            Function that stores a result as soon as it is there, in any order.
        check : callable
            Called with the number of processes of this machine before the first job; raises if memory is short.

        Raises
        ------
        PachonError
            That of a job that failed, which names it; if a worker is lost.
        """

        def store(result: JobResult) -> None:
            if isinstance(result.value, PachonError):
                raise result.value
            if result.files and folder is not None:
                last = None if product is None else product(result.number).name
                for name, data in sorted(result.files, key=lambda file: file[0] == last):
                    write_bytes(folder / name, data)
            if save is not None:
                save(result.value)

        with nullcontext("") if folder is None else marked_folder(folder) as mark:
            computation = JobComputation(compute, None if folder is None else folder.resolve(), mark)
            if self.workers is None:
                job_workers = serial_worker(computation, self.threads)
            else:
                job_workers = self.workers(computation)
                title = None if title is None else f"{title}, {job_workers.description}"
            check(job_workers.processes)
            jobs = (Job(i, *job) for i, job in enumerate(zip(labels, contents, strict=True)))
            with closing(self._ordered(job_workers, jobs, labels, title, sizes, store)) as ordered:
                yield ordered

    def _ordered(
        self,
        job_workers: Workers,
        jobs: Iterator[Job],
        labels: Sequence[str],
        title: str | None,
        sizes: Sequence[int] | None,
        store: Callable[[JobResult], None],
    ) -> Generator[Any, None, None]:
        """Store results as they arrive, and yield them in the order of the jobs."""
        waiting: dict[int, Any] = {}
        due = items_done = 0
        lines_apart = max(1, len(labels) // _MOST_LINES)
        sizes = [1] * len(labels) if sizes is None else sizes
        with (
            nullcontext() if title is None else self.reporter.stage(title, total=sum(sizes)) as stage,
            closing(job_workers.results(jobs)) as arriving,
        ):
            for done, result in enumerate(arriving, start=1):
                store(result)
                items_done += sizes[result.number]
                if stage is not None:
                    stage.advance(sizes[result.number])
                    if done % lines_apart == 0:
                        stage.step(labels[result.number], items_done, sum(sizes))
                waiting[result.number] = result.value
                while due in waiting:
                    yield waiting.pop(due)
                    due += 1


def claim_folder(
    path: Path,
    content: bytes,
    *,
    products: str,
    noun: str,
    now: Mapping[str, Any],
    read: Callable[[Path], Mapping[str, Any]],
    free_keys: Sequence[str] = (),
    wanted: bool = True,
    remedy: str = "choose another --out",
) -> None:
    """Write the configuration of long work into its folder, or refuse a folder of another one.

    If several computations start in a new folder together, one of them writes the file. The others, and one in an
    existing folder, compare it with their own; otherwise it is written again.

    Parameters
    ----------
    path : Path
        File of the configuration; its folder is made where missing.
    content : bytes
        Content of the file.
    products : str
        Pattern of the names of products. With some of them and without the file a folder is refused.
    noun : str
        What the folder holds, in messages: "visits".
    now : mapping
        The configuration.
    read : callable
        Function that reads the configuration from a file.
    free_keys : sequence of str
        Keys, or sections, that may change.
    wanted : bool
        Whether what the folder holds is to be gone on with; otherwise a folder with a configuration is refused.
    remedy : str
        End of the messages.

    Raises
    ------
    ProductError
        If the folder holds other products, or cannot be made or written.
    """
    folder = path.parent
    make_folder(folder)
    if not path.exists() and (stray_products := sorted(folder.glob(products))):
        raise ProductError(f"{folder} holds {stray_products[0].name} but no {path.name}; {remedy}")
    if write_new_bytes(path, content):
        return
    try:
        before = read(path)
    except PachonError as error:
        raise ProductError(f"{folder} holds {noun} that cannot be read ({error}); {remedy}") from None
    if not wanted:
        raise ProductError(f"{folder} holds {noun} already; go on with --resume, or {remedy}")
    if changed := differences(before, now, free_keys):
        shown = "; ".join(changed[:_SHOWN_DIFFERENCES])
        if len(changed) > _SHOWN_DIFFERENCES:
            shown += f" and {len(changed) - _SHOWN_DIFFERENCES} more"
        raise ProductError(f"{folder} holds {noun} of another configuration ({shown}); {remedy}")
    write_bytes(path, content)


def differences(old: Mapping[str, Any], new: Mapping[str, Any], free_keys: Sequence[str] = ()) -> list[str]:
    """Return one ``key: old -> new`` for each key, but for the free ones, in which configurations differ."""
    before, after = dict(_flat(old)), dict(_flat(new))
    keys = [*before, *(k for k in after if k not in before)]
    return [
        f"{k}: {json_text(before.get(k))} -> {json_text(after.get(k))}"
        for k in keys
        if before.get(k) != after.get(k) and not any(f"{k}.".startswith(f"{free}.") for free in free_keys)
    ]


def _flat(content: Mapping[str, Any], place: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{place}{key}.")
        else:
            yield f"{place}{key}", value
