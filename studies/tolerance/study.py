"""Tolerance study of a telescope: sensitivity, inverse sensitivity and Monte Carlo, resumable, on any workers."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import ConfigError
from ...core.progress import Reporter
from ...core.threads import one_blas_thread
from ...core.workers import Compute, MakeWorkers, Workers, serial_worker
from ...design.optimize.merit import Beams
from ...design.tolerancing.criterion import Criterion
from ...design.tolerancing.toleranced_merit import TolerancedMerit
from ...models.parameters.tolerances import draw
from ...models.paraxial import following_stop
from ...models.telescope import Telescope
from ..sweep.store import PointResult, StoreKind, SweepPoint, SweepStore, check_same_sweep, create_store, store_exists
from .file import ToleranceFile
from .measurement import DRAW, INVERSE, LOWER, NOMINAL, UPPER, Batch, ToleranceMeasurement
from .plan import tolerance_plan
from .result import ToleranceStudy

#: Points that a worker computes at once.
_BATCH = 25
_STORE = StoreKind("tolerance study", "pachon tolerance makes", "remove it, and begin again")


@check_arguments
@one_blas_thread()
def run_tolerances(
    telescope: Telescope,
    file: ToleranceFile,
    store: str | os.PathLike[str] | None = None,
    *,
    merit: Callable[[Telescope], float] | None = None,
    resume: bool = False,
    workers: MakeWorkers | None = None,
    reporter: Reporter | None = None,
) -> ToleranceStudy:
    """Compute sensitivity, inverse sensitivity and Monte Carlo of tolerances.

    The results depend on telescope and file alone, not on workers, order or interruptions. Rays fill the stop of each
    telescope as in :func:`~pachon.design.optimize.optimize.optimize`.

    Parameters
    ----------
    telescope : Telescope
        The telescope as designed.
    file : ToleranceFile
        Tolerances, compensators, merit and Monte Carlo; see :mod:`~.file`.
    store : str or path, optional
        SQLite file that keeps what was computed.
    merit : callable, optional
        Function of a telescope that returns a number to be kept small, in place of the merit of the file. For several
        processes it must be one of a module. Compensators minimise the spots.
    resume : bool
        Go on with an existing store.
    workers : callable, optional
        Function that makes workers of the function that computes points; by default this process.
    reporter : Reporter, optional
        Progress display; silent by default.

    Raises
    ------
    UnknownNameError, ConfigError, DomainError
        If a name does not exist, a compensator has no effect, or the store is that of another study or in the way.
    """
    if merit is not None and file.method != "traced":
        raise ConfigError(f"method = {file.method!r}: expected 'traced' for a merit of one's own")
    plan = tolerance_plan(file, following_stop(telescope))
    criterion = _criterion(file, plan.telescope, merit)
    if plan.telescope.design_data.aiming != telescope.design_data.aiming:
        filled = f"{criterion.definition}; rays fill the stop {telescope.design_data.stop}, aiming: real"
        criterion = replace(criterion, definition=filled)
    toleranced = TolerancedMerit.of(
        plan.telescope, plan.tolerances, plan.compensators, plan.degrees_of_freedom, criterion
    )
    measurement = ToleranceMeasurement(toleranced, file.loss_percent / 100.0)
    n = len(plan.tolerances)
    deviations = draw(plan.tolerances, file.seed, file.draws)
    traced = file.method == "traced"
    points, values = _points(toleranced, deviations if traced else deviations[:0])
    results = dict(_results(measurement, points, values, file, store, resume, workers, reporter))
    numbers = np.array([results[i] for i in range(len(points))])
    ends = numbers[1 : 1 + 2 * n].reshape(n, 2)
    return ToleranceStudy.of(
        toleranced,
        file.method,
        deviations,
        numbers[1 + 3 * n :] if traced else None,
        float(numbers[0]),
        lower=ends[:, 0],
        upper=ends[:, 1],
        inverse=numbers[1 + 2 * n : 1 + 3 * n],
        loss=measurement.loss,
        requirement=None if file.requirement is None else file.requirement / criterion.scale,
    )


def _criterion(file: ToleranceFile, telescope: Telescope, function: Callable[[Telescope], float] | None) -> Criterion:
    """Return the criterion of a file, or a function of one's own, for a telescope; it takes one thread."""
    fields = None if file.fields_deg is None else np.deg2rad(file.fields_deg)
    wavelengths = None if file.wavelengths_nm is None else np.array(file.wavelengths_nm) * 1e-9
    weights = None if file.field_weights is None else list(file.field_weights)
    beams = Beams.of(telescope, fields, wavelengths, field_weights=weights, n_pupil=file.rings, threads=1)
    frequency = None if file.frequency_per_mm is None else 1e3 * file.frequency_per_mm
    return Criterion.of(file.merit, telescope, beams, frequency=frequency, function=function)


def _points(toleranced: TolerancedMerit, deviations: np.ndarray) -> tuple[list[SweepPoint], np.ndarray]:
    """Return all points, and deviations and compensators of each, shape [n_point, n_degree_of_freedom].

    The telescope as designed comes first, then the ends of each tolerance, the inverse sensitivities, and the draws.
    """
    sizes = np.array([t.size for t in toleranced.tolerances])
    n = len(sizes)
    ends = np.stack([-np.diag(sizes), np.diag(sizes)], axis=1).reshape(2 * n, n)
    rows = np.concatenate([np.zeros((1, n)), ends, np.zeros((n, n)), deviations])
    about: list[dict[str, Any]] = [{"kind": NOMINAL}]
    about += [{"kind": kind, "tolerance": i} for i in range(n) for kind in (LOWER, UPPER)]
    about += [{"kind": INVERSE, "tolerance": i} for i in range(n)]
    about += [{"kind": DRAW, "draw": i} for i in range(len(deviations))]
    return [SweepPoint(i, parameters, 0) for i, parameters in enumerate(about)], toleranced.compensated(rows)


def _results(
    measured: ToleranceMeasurement,
    points: list[SweepPoint],
    values: np.ndarray,
    file: ToleranceFile,
    store: str | os.PathLike[str] | None,
    resume: bool,
    workers: MakeWorkers | None,
    reporter: Reporter | None,
) -> Iterator[tuple[int, float]]:
    """Yield number and result of every point, those in the store first; new ones are written to it."""
    reporter = Reporter(quiet=True) if reporter is None else reporter
    opened = None if store is None else _open(Path(store), file, points, resume)
    try:
        done: list[PointResult] = [] if opened is None else opened.results()
        yield from map(_number, done)
        finished = {result.number for result in done}
        missing = [p for p in points if p.number not in finished]
        batches = [_batch(missing[i : i + _BATCH], values) for i in range(0, len(missing), _BATCH)]
        chosen = (workers or _one_thread)(measured)
        title = f"tolerances: {len(missing)} telescopes, {chosen.description}"
        with reporter.stage(title, len(missing)) as stage:
            for found in chosen.results(batches) if batches else ():
                for result in found:
                    if opened is not None:
                        opened.write(result)
                    yield _number(result)
                stage.advance(len(found))
    finally:
        if opened is not None:
            opened.close()


def _one_thread(compute: Compute) -> Workers:
    return serial_worker(compute, 1)


def _open(path: Path, file: ToleranceFile, points: Sequence[SweepPoint], resume: bool) -> SweepStore:
    if path.exists() and not resume:
        raise store_exists(path)
    if not path.exists():
        create_store(path, file, points, {}, _STORE)
    store = SweepStore(path, _STORE)
    check_same_sweep(store, file)
    return store


def _batch(points: Sequence[SweepPoint], values: np.ndarray) -> Batch:
    return Batch(tuple(points), values[[p.number for p in points]])


def _number(result: PointResult) -> tuple[int, float]:
    (value,) = (result.metrics or {"merit": np.nan}).values()
    return result.number, value
