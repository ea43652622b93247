"""The loop over the visits of a list, and the tables and maps that grow with it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from ...core.arguments import check_arguments
from ...core.errors import DomainError, PachonError
from ...core.files import make_folder
from ...core.long_work import Execution, claim_folder
from ...core.number_text import counted
from ...core.products import Stamp
from ...pipeline.experiment import Experiment
from ...pipeline.listed_visit import check_bands, visit_experiment
from ...pipeline.memory import check_memory
from ...pipeline.run_folder import CONFIG_NAME
from ...sky.visit_list.visit_list import ListedVisit, VisitList
from .config import SELECTION_KEYS, NightConfig, load_night_configuration, require_same_list
from .night_files import write_night
from .sky_pixels import healpix_module
from .visit_product import VisitProduct, VisitWork, has_ccd_products, product_name

#: Folder of the products of the visits.
VISITS_FOLDER = "visits"
#: Growth of the number of visits after which tables and maps are written again: all of their times together are then a
#: multiple of the last one.
_GROWTH = 1.3
# Visits from which writing them takes more than some seconds, which is told.
_MANY = 500


@dataclass(frozen=True)
class NightResult:
    """Products of :func:`run_night`.

    Attributes
    ----------
    folder : Path
        Its products.
    visits : VisitList
        The visits of the list.
    left_out : dict of int to str
        Visits that have failed, by their numbers, each with the reason.
    missing : tuple of int
        Visits of other parts that are not finished.
    summary : dict
        Content of ``summary.json``.
    """

    folder: Path
    visits: VisitList
    left_out: dict[int, str]
    missing: tuple[int, ...]
    summary: dict[str, Any]


@check_arguments
def run_night(
    config: NightConfig,
    folder: Path,
    *,
    base: Path | None = None,
    part: tuple[int, int] = (1, 1),
    execution: Execution | None = None,
) -> NightResult:
    """Simulate the visits of a list, and write what a survey knows of them.

    Each visit has its own pointing, angles, band, time and air. Tables and maps hold the visits that are finished and
    grow with them. All products have the same bytes on any number of threads, by whatever workers or parts, and after
    any number of interruptions.

    Parameters
    ----------
    config : NightConfig
        Configuration.
    folder : Path
        Folder of the products, made where missing.
    base : Path, optional
        Folder that relative paths in the configuration start from; the current one by default.
    part : (i, n)
        Compute the i-th of n parts of the visits, of 1 to n; parts run side by side in one folder. Parts beyond the
        number of visits have nothing to compute.
    execution : Execution, optional
        Workers that compute the visits, threads, whether to go on after finished visits, and progress display.

    Returns
    -------
    NightResult

    Raises
    ------
    PachonError
        If the list cannot be read, has bands that the telescope has not, or has changed since the folder was begun; if
        a product cannot be written; or if all visits fail.
    """
    execution = execution or Execution()
    if config.maps.nside:
        healpix_module()
    visits = config.read_list(base)
    number, parts = part
    if not 1 <= number <= parts:
        raise DomainError(f"part = {number}/{parts}: expected i/n with i from 1 to n")
    if parts > 1:
        execution = replace(execution, resume=True)
    reporter = execution.reporter
    for remark in visits.remarks:
        reporter.line(f"{visits.source}: {remark}")
    check_bands(config.run, visits, base)
    experiment = _first_experiment(config, visits, base)
    config = config.started(visits, experiment, base)
    stamp = Stamp(config.content_digest(experiment), experiment.config.seed)
    claim_night(folder, config, resume=execution.resume)
    products = folder / VISITS_FOLDER
    make_folder(products)
    paths = {visit: products / product_name(visit) for visit in visits.visit.tolist()}
    finished = _finished(config, experiment, paths, stamp, execution)
    due = [i for i in range(number - 1, len(visits), parts) if int(visits.visit[i]) not in finished]
    if finished:
        reporter.line(f"{len(finished)} of {counted(len(visits), 'visit is', 'visits are')} finished already")
    write = partial(write_night, folder, config, experiment, visits, stamp)
    written = len(finished)
    for visit, reason in _results(
        VisitWork(config, stamp, base), products, [visits[i] for i in due], experiment, execution
    ):
        finished.add(visit.visit)
        if reason:
            reporter.line(f"{visit.label} is left out: {reason}")
        if len(finished) >= max(_GROWTH * written, written + 1) and len(finished) < len(visits):
            if len(finished) >= _MANY:
                reporter.line(f"tables and maps of {len(finished)} visits are written")
            write(_read(paths, finished, stamp))
            written = len(finished)
    if parts > 1:
        other_visits = {visit: path for visit, path in paths.items() if visit not in finished}
        finished |= _finished(config, experiment, other_visits, stamp, execution)
    missing = tuple(visit for visit in paths if visit not in finished)
    with reporter.stage("tables and maps"):
        left_out, summary = write(_read(paths, finished, stamp), complete=not missing)
    if len(left_out) == len(visits):
        first, reason = next(iter(left_out.items()))
        count = counted(len(visits), "visit")
        raise DomainError(f"none of {count} has a PSF; visit {first}: {reason}", file=visits.source)
    return NightResult(folder, visits, left_out, missing, summary)


def _finished(
    config: NightConfig, experiment: Experiment, paths: dict[int, Path], stamp: Stamp, execution: Execution
) -> set[int]:
    """Return the visits whose products are whole, those of their CCDs among them where these are kept."""
    finished = set(execution.finished(paths, stamp))
    if not config.products:
        return finished
    return {visit for visit in finished if has_ccd_products(paths[visit], stamp, experiment.camera)}


def _results(
    work: VisitWork, folder: Path, due: Sequence[ListedVisit], experiment: Experiment, execution: Execution
) -> Iterator[tuple[ListedVisit, str]]:
    """Compute visits, and yield each with the reason why it failed, or nothing."""
    if not due:
        return
    alone = execution.alone
    with execution.results(
        partial(work.compute_here, execution.reporter) if alone else work,
        [visit.label for visit in due],
        due,
        title=None if alone else counted(len(due), "visit"),
        folder=folder,
        product=lambda number: folder / product_name(due[number].visit),
        check=lambda processes: check_memory(experiment, execution.threads if alone else 1, copies=processes),
    ) as results:
        yield from zip(due, results, strict=True)


def _first_experiment(config: NightConfig, visits: VisitList, base: Path | None) -> Experiment:
    """Return the experiment of the first visit that has one."""
    errors: list[PachonError] = []
    for index in range(len(visits)):
        try:
            return visit_experiment(config.run, visits[index], base)
        except PachonError as error:
            errors.append(error)
    raise errors[0]


def _read(paths: dict[int, Path], finished: set[int], stamp: Stamp) -> Iterator[VisitProduct]:
    """Yield the products of the finished visits, in the order of the list."""
    for visit, path in paths.items():
        if visit in finished:
            yield VisitProduct.read(path, stamp)


def claim_night(folder: Path, config: NightConfig, *, resume: bool) -> None:
    """Write the configuration, or check that the folder is of the same night, with the same list.

    ProductError if it is not.
    """
    path = folder / CONFIG_NAME
    before: NightConfig | None = None
    if resume and path.is_file():
        with suppress(PachonError):  # claim_folder says what is wrong with the file
            before = load_night_configuration(path)
    require_same_list(folder, "a night", None if before is None else before.visits, config.visits)
    claim_folder(
        path,
        config.to_yaml().encode(),
        products=f"{VISITS_FOLDER}/visit_*.fits",
        noun="a night",
        now=config.as_dict(),
        read=lambda path: load_night_configuration(path).as_dict(),
        # The digest tells the visits, wherever their file lies now.
        free_keys=[f"visits.{key}" for key in SELECTION_KEYS],
        wanted=resume,
    )
