"""Computation of a sweep: its missing points, by workers, into its store."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, ProductError
from ...core.long_work import Execution
from ...core.memory import available_bytes, readable
from ...core.number_text import counted
from ...core.random_streams import stream
from ...pipeline.config import Configuration
from .design import design_points, point_count
from .file import SweepFile
from .point import PointMeasurement, check_sweep
from .store import PointResult, SweepPoint, check_same_sweep, open_store

#: More points than this are a mistake: at a second each they would take a year.
MOST_POINTS = 30_000_000
# Size of a point in the store [bytes].
_BYTES_ON_DISK = 1500
# Size of a point in memory while the design is made [bytes].
_BYTES_IN_MEMORY = 2500


@dataclass(frozen=True)
class SweepOutcome:
    """Numbers of points of a sweep after a computation."""

    path: Path  #: store
    points: int
    kept: int  #: computed before
    computed: int  #: computed now
    failed: int  #: could not be computed


@check_arguments
def run_sweep(
    sweep: SweepFile, path: str | os.PathLike[str], *, folder: Path | None = None, execution: Execution | None = None
) -> SweepOutcome:
    """Compute the missing points of a sweep.

    The metrics of a point depend on the sweep file alone, not on workers, order or interruptions.

    Parameters
    ----------
    sweep : SweepFile
        The sweep.
    path : str or path
        The store, a SQLite file.
    folder : Path, optional
        Folder that relative paths in the configuration start from; the current one by default.
    execution : Execution, optional
        Workers that compute the points; threads; progress display; and whether to continue an existing store, where
        points that could not be computed are tried again.

    Raises
    ------
    ConfigError
        If the store belongs to another sweep, or there is one and nothing is resumed.
    PachonError
        If a name or value of the sweep is not possible, the store cannot be written, or the workers are lost.
    """
    execution = execution or Execution()
    path, folder = Path(path), Path() if folder is None else folder

    def checked_points() -> list[SweepPoint]:
        check_room(sweep, path)
        points = numbered_points(sweep, folder)
        check_sweep(sweep, points, folder)
        return points

    place = str(folder.resolve())
    with open_store(path, sweep, checked_points, resume=execution.resume, extra={"folder": place}) as store:

        def save(result: PointResult) -> None:
            # Each point reads the telescope again: one of another telescope is never kept.
            check_same_sweep(store, sweep)
            store.write(result)

        store.forget_problems()
        finished = store.finished()
        points = store.points()
        unfinished_points = [p for p in points if p.number not in finished]
        if finished:
            execution.reporter.line(
                f"{len(finished)} of {counted(len(points), 'point is', 'points are')} there already"
            )
        if unfinished_points:
            labels = [point.label for point in unfinished_points]
            title = f"{sweep.name}: {counted(len(labels), 'point')}"
            compute = PointMeasurement(sweep, place)
            with execution.results(compute, labels, unfinished_points, title=title, save=save) as results:
                for result in results:
                    if result.problem is not None:
                        execution.reporter.line(f"point {result.number}: {result.problem}")
        failed = sum(result.problem is not None for result in store.results())
    return SweepOutcome(path, len(points), len(finished), len(unfinished_points), failed)


def numbered_points(sweep: SweepFile, folder: Path) -> list[SweepPoint]:
    """Return the points of a sweep with their numbers and seeds.

    All points of a replica share one seed, the first that of the configuration. With common random numbers, differences
    between points are effects of their parameters.
    """
    base = sweep.base if isinstance(sweep.base, dict) else {}
    first = base.get("seed", Configuration.model_fields["seed"].default)
    points = design_points(sweep)
    seeds = [first, *(int(stream(first, "replica", i).integers(2**31)) for i in range(1, sweep.design.replicas))]
    return [
        SweepPoint(replica * len(points) + i, point, seed)
        for replica, seed in enumerate(seeds)
        for i, point in enumerate(points)
    ]


def check_room(sweep: SweepFile, path: Path) -> None:
    """Refuse a sweep with more points than memory or disk can hold, with required and available space."""
    count = point_count(sweep) * sweep.design.replicas
    place = next(parent for parent in (path.resolve().parent, *path.resolve().parents) if parent.exists())
    try:
        usage = shutil.disk_usage(place)
    except OSError as error:
        raise ProductError(f"{place}: {error.strerror}") from None
    # What has no size, such as /proc, is not full: the first write says what is wrong with it.
    disk = usage.free if usage.total else None
    for kind, need, free in (
        ("memory", count * _BYTES_IN_MEMORY, available_bytes()),
        ("disk", count * _BYTES_ON_DISK, disk),
    ):
        if free is not None and need > 0.8 * free:
            raise ConfigError(
                f"sweep {sweep.name}: {count:,} points take about {readable(need)} of {kind}, {readable(free)} are "
                "free: expected fewer points"
            )
    if count > MOST_POINTS:
        raise ConfigError(f"sweep {sweep.name}: {count:,} points: expected at most {MOST_POINTS:,}")
