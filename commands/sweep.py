"""The command ``pachon sweep`` with its status, export and report; :mod:`~pachon.commands.cli` registers it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core.errors import ConfigError
from .options import Json, Quiet, Threads, interruptible, show_table

if TYPE_CHECKING:
    from ..core.progress import Reporter
    from ..studies.sweep.workers import Measure, Workers

_VERBS = ("status", "export", "report")


def sweep_command(
    what: Annotated[
        str | None,
        typer.Argument(metavar="SWEEP.yaml | status | export | report", help="Sweep to run, or what to do."),
    ] = None,
    store: Annotated[Path | None, typer.Argument(metavar="[STORE]", help="Store of a sweep, after a verb.")] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Store to write (SWEEP.sweep), table of an export, or folder of a report."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Compute only what the store does not hold yet.")] = False,
    processes: Annotated[
        int | None, typer.Option(min=1, help="Processes of this machine; one for each processor by default.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:PORT", help="Compute on the workers of a Dask cluster.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Compute on a Dask cluster of this machine, with its dashboard.")
    ] = None,
    example: Annotated[
        str | None, typer.Option(metavar="NAME", help="Write a bundled sweep and run it: table1, or table1_small.")
    ] = None,
    threads: Threads = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Vary heights, optics, atmosphere or settings, measure each point, and say what matters.

    One SQLite file holds all points; the report, `report.html` in a folder beside it, has the tornado chart, curves,
    error budget and allowances. The same points give the same figures whoever computes them.

    **Examples**

    - `pachon sweep --example table1_small`: the height budget of Jee & Tyson (2011), Table 1, in minutes

    - `pachon sweep heights.yaml -o heights.sweep`, and after an interruption `--resume`

    - `pachon sweep heights.yaml --scheduler tcp://login1:8786`: on a Dask cluster

    - `pachon sweep status heights.sweep`

    - `pachon sweep export heights.sweep -o heights.ecsv`, or .csv, .fits, .parquet

    - `pachon sweep report heights.sweep`
    """
    if what in _VERBS:
        if store is None:
            raise ConfigError(f"pachon sweep {what}: expected the store of a sweep after it")
        {"status": _status, "export": _export, "report": _report}[what](store, out, as_json)
        return
    if store is not None:
        raise ConfigError(f"{what} {store}: expected one sweep file, or one of {', '.join(_VERBS)} and a store")
    if (what is None) == (example is None):
        raise ConfigError("pachon sweep: expected a sweep file, or --example NAME")
    path = _example(example) if example else Path(what or "")
    sweep_store = out or path.with_suffix(".sweep")
    resumed = f"go on with: pachon sweep {path} -o {sweep_store} --resume"
    with (
        interruptible(quiet, resumed) as reporter,
        _workers(processes, scheduler, workers, threads, reporter) as maker,
    ):
        figures = _run(path, sweep_store, resume, maker, reporter)
    _show(figures, as_json, quiet)


def _run(
    path: Path, store: Path, resume: bool, maker: Callable[[Measure], Workers], reporter: Reporter
) -> dict[str, Any]:
    """Compute what is missing, draw the report, and return what is shown in the end."""
    from ..studies.sweep.file import load_sweep
    from ..studies.sweep.report import write_report
    from ..studies.sweep.store import SweepStore
    from ..studies.sweep.sweep import run_sweep

    outcome = run_sweep(load_sweep(path), store, folder=path.parent, resume=resume, workers=maker, reporter=reporter)
    report = None
    if outcome.failed < outcome.points:
        with reporter.stage("report"), SweepStore(store) as opened:
            report = str(write_report(opened, _report_folder(store)))
    return {
        "store": str(store),
        "points": outcome.points,
        "kept": outcome.kept,
        "computed": outcome.computed,
        "failed": outcome.failed,
        "report": report,
    }


@contextmanager
def _workers(
    processes: int | None, scheduler: str | None, dask_workers: int | None, threads: int | None, reporter: Reporter
) -> Iterator[Callable[[Measure], Workers]]:
    """Yield what makes workers of the function that computes a point."""
    if sum(option is not None for option in (processes, scheduler, dask_workers)) > 1:
        raise ConfigError("--processes, --scheduler and --workers: expected one of them")
    from ..core.threads import thread_count
    from ..studies.sweep.workers import DaskWorkers, ProcessWorkers, SerialWorker, dask_client, local_cluster

    if scheduler is not None or dask_workers is not None:
        with local_cluster(dask_workers, reporter.line) if scheduler is None else dask_client(scheduler) as client:

            def on_cluster(measure: Measure) -> Workers:
                return DaskWorkers(measure, client)

            yield on_cluster
        return
    count = thread_count(threads) if processes is None else processes

    def on_this_machine(measure: Measure) -> Workers:
        return SerialWorker(measure, threads) if count == 1 else ProcessWorkers(measure, count, threads)

    yield on_this_machine


def _example(name: str) -> Path:
    """Write a bundled sweep file into the current folder, where there is none of that name, and return its path."""
    from ..core.errors import unknown_name
    from ..core.files import write_bytes
    from ..studies.sweep.file import EXAMPLES

    names = sorted(path.stem for path in EXAMPLES.glob("*.yaml"))
    if name not in names:
        raise unknown_name("example", name, names)
    path = Path(f"{name}.yaml")
    if not path.exists():
        write_bytes(path, (EXAMPLES / path.name).read_bytes())
    return path


def _status(path: Path, out: Path | None, as_json: bool) -> None:
    from ..studies.sweep.store import SweepStore

    with SweepStore(path) as store:
        results = store.results()
        count = len(store.points())
        sweep = store.sweep
    problems = [r for r in results if r.problem is not None]
    figures = {
        "sweep": sweep.name,
        "pachon": store.about["pachon"],
        "design": sweep.design.kind,
        "points": count,
        "computed": len(results) - len(problems),
        "failed": len(problems),
        "missing": count - len(results),
        "seconds_a_point": sum(r.seconds for r in results) / len(results) if results else None,
        "workers": len({r.worker for r in results}),
    }
    _show(figures, as_json, False)
    if problems and not as_json:
        show_table(["point", "problem"], [[str(r.number), r.problem or ""] for r in problems[:20]], left=2)


def _export(path: Path, out: Path | None, as_json: bool) -> None:
    from ..core.errors import ProductError
    from ..studies.sweep.store import SweepStore
    from ..studies.sweep.table import export_table, salvage

    target = out or path.with_suffix(".ecsv")
    try:
        with SweepStore(path) as store:
            count = export_table(store, target)
    except ProductError as error:
        if "damaged" not in str(error):
            raise
        count = salvage(path, target)
        _show({"table": str(target), "points": count, "damaged": str(error)}, as_json, False)
        return
    _show({"table": str(target), "points": count}, as_json, False)


def _report(path: Path, out: Path | None, as_json: bool) -> None:
    from ..studies.sweep.report import write_report
    from ..studies.sweep.store import SweepStore

    with SweepStore(path) as store:
        report = write_report(store, out or _report_folder(path))
    _show({"report": str(report)}, as_json, False)


def _report_folder(store: Path) -> Path:
    return store.with_name(f"{store.stem}_report")


def _show(figures: dict[str, Any], as_json: bool, quiet: bool) -> None:
    from ..core.files import json_text

    if as_json:
        print(json_text(figures))
    elif not quiet:
        show_table(["", ""], [[k.replace("_", " "), "" if v is None else f"{v}"] for k, v in figures.items()], left=2)


COMMANDS = {"sweep": sweep_command}
