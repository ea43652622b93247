"""CCDs of a run as jobs of workers: processes of this machine, or a cluster.

A worker keeps the phase screens of its last CCD for the next one. Workers that share the folder of the run write
products there; others send them back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ..core.errors import PachonError, ProductError
from ..core.files import folder_of_worker, marked_folder, write_bytes
from ..core.progress import Reporter
from ..core.workers import MakeWorkers
from ..reconstruction.ccd_product import product_path
from .experiment import Experiment
from .memory import check_memory
from .run_folder import write_ccd
from .screen_cache import with_cached_screens
from .simulate.ccd_loop import left_out_line, simulate_ccds


@dataclass(frozen=True)
class CcdJob:
    """A CCD to compute."""

    name: str

    @property
    def label(self) -> str:
        """Name in messages."""
        return f"CCD {self.name}"


@dataclass(frozen=True)
class CcdResult:
    """Result of one CCD, as a worker returns it."""

    name: str
    product: bytes | None = None  #: the file, where the worker does not share the folder of the run
    not_modelled: str | None = None  #: reason
    problem: str | None = None  #: one line: the CCD could not be exposed, or its product not be written


@dataclass(frozen=True)
class CcdComputation:
    """Expose and model CCDs of an experiment; a picklable function for every kind of worker."""

    experiment: Experiment
    folder: Path  #: of the run
    mark: str  #: file in the folder, by which workers that share it are told

    def __call__(self, job: CcdJob, threads: int) -> CcdResult:
        """Compute one CCD."""
        try:
            with folder_of_worker(self.folder, self.mark) as place:
                reason = self._write(job.name, place, threads)
                sent = (
                    None if reason is not None or place == self.folder else product_path(place, job.name).read_bytes()
                )
        except PachonError as error:
            return CcdResult(job.name, problem=" ".join(str(error).split()))
        return CcdResult(job.name, sent, reason)

    def _write(self, name: str, folder: Path, threads: int) -> str | None:
        """Write the product of a CCD; or return the reason why it cannot be modelled."""
        experiment = with_cached_screens(self.experiment)
        experiment.make_screens(threads)
        write = partial(write_ccd, experiment, folder)
        return simulate_ccds(experiment, write, (name,), strict=False, threads=threads).not_modelled.get(name)


def compute_ccds(
    experiment: Experiment,
    folder: Path,
    names: Sequence[str],
    workers: MakeWorkers,
    *,
    strict: bool,
    reporter: Reporter,
) -> dict[str, str]:
    """Compute CCDs by workers; return those that cannot be modelled, each with the reason.

    Raises
    ------
    ProductError
        If a CCD cannot be exposed, its product cannot be written, a worker is lost, or, with `strict`, a CCD cannot be
        modelled.
    """
    failed: dict[str, str] = {}
    with marked_folder(folder) as mark:
        chosen = workers(CcdComputation(experiment, folder.resolve(), mark))
        check_memory(experiment, 1, copies=chosen.processes)
        with reporter.stage(f"PSFs of {len(names)} CCDs, {chosen.description}", len(names)) as stage:
            for number, result in enumerate(chosen.results(CcdJob(name) for name in names), start=1):
                if result.problem is not None:
                    raise ProductError(result.problem)
                if result.product is not None:
                    write_bytes(product_path(folder, result.name), result.product)
                if result.not_modelled is not None:
                    if strict:
                        raise ProductError(f"CCD {result.name}: {result.not_modelled}")
                    failed[result.name] = result.not_modelled
                    reporter.line(left_out_line(result.name, result.not_modelled))
                stage.advance()
                stage.step(result.name, number, len(names))
    return {name: failed[name] for name in names if name in failed}
