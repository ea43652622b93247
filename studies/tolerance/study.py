"""Tolerance study of a telescope: sensitivity, inverse sensitivity and Monte Carlo, resumable, on any workers."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import ConfigError
from ...core.long_work import Execution
from ...core.threads import one_blas_thread
from ...design.optimize.merit import Beams
from ...design.tolerancing.criterion import Criterion
from ...design.tolerancing.toleranced_merit import TolerancedMerit
from ...models.parameters.tolerances import draw
from ...models.paraxial import following_stop
from ...models.telescope import Telescope
from ..sweep.store import PointResult, StoreKind, SweepPoint, open_store
from .file import ToleranceFile
from .measurement import DRAW, INVERSE, LOWER, MERIT, NOMINAL, SIZE, UPPER, Batch, ToleranceMeasurement, moved_by
from .plan import tolerance_plan
from .result import ToleranceStudy

#: Points that a worker computes at once.
_BATCH = 25
#: Words of messages about stores of tolerance studies.
STORE = StoreKind("tolerance study", "pachon tolerance makes", "remove it, and begin again")


@check_arguments
@one_blas_thread()
def run_tolerances(
    telescope: Telescope,
    file: ToleranceFile,
    store: str | os.PathLike[str] | None = None,
    *,
    merit: Callable[[Telescope], float] | None = None,
    execution: Execution | None = None,
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
    execution : Execution, optional
        Workers that compute the points, whether to go on with an existing store, and progress display.

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
    numbers, moves = _numbers(measurement, points, values, file, store, execution or Execution())
    ends = numbers[1 : 1 + 2 * n].reshape(n, 2)
    return ToleranceStudy.of(
        toleranced,
        file.method,
        deviations,
        (numbers[1 + 3 * n :], moves[1 + 3 * n :]) if traced else None,
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


def _numbers(
    measured: ToleranceMeasurement,
    points: list[SweepPoint],
    values: np.ndarray,
    file: ToleranceFile,
    path: str | os.PathLike[str] | None,
    execution: Execution,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the result of every point, and its compensators, NaN of inverse sensitivities, [n_point, n_compensator].

    Points that the store misses are computed, and written to it.
    """
    numbers = np.full(len(points), np.nan)
    names = [moved_by(name) for name in measured.toleranced.compensators]
    moves = np.full((len(points), len(names)), np.nan)
    finished: set[int] = set()

    def keep(result: PointResult) -> None:
        metrics = result.metrics or {}
        numbers[result.number] = metrics.get(MERIT, metrics.get(SIZE, np.nan))
        moves[result.number] = [metrics.get(name, np.nan) for name in names]

    with ExitStack() as stack:
        store = None
        if path is not None:
            store = open_store(Path(path), file, lambda: points, resume=execution.resume, kind=STORE)
            stack.enter_context(store)
            for result in store.results():
                # Earlier versions left out the compensators, which were linear: such points are computed again.
                if MERIT not in (result.metrics or {}) or set(names) <= set(result.metrics or {}):
                    keep(result)
                    finished.add(result.number)

        def save(batch: list[PointResult]) -> None:
            for result in batch:
                if store is not None:
                    store.write(result)
                keep(result)

        open_points = [p for p in points if p.number not in finished]
        groups = [tuple(open_points[i : i + _BATCH]) for i in range(0, len(open_points), _BATCH)]
        batches = [Batch(group, values[[p.number for p in group]]) for group in groups]
        title = f"tolerances: {len(open_points)} telescopes, {_BATCH} at a time"
        labels = [batch.label for batch in batches]
        with execution.results(measured, labels, batches, title=title, save=save) as results:
            for _ in results:
                pass
    return numbers, moves
