"""The commands ``pachon sweep``, ``sweep status``, ``sweep export`` and ``sweep report``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from ..core.errors import ConfigError, DomainError
from ..core.terminal import print_line
from ..core.threads import thread_count
from . import completion
from .choices import names
from .default_group import DefaultGroup
from .options import Json, Quiet, Threads, set_option, yaml_file
from .tables import plain_table, print_json, wide_console
from .workers import DaskWorkers, Processes, Scheduler, long_work

if TYPE_CHECKING:
    from ..core.long_work import Execution

app = typer.Typer()
#: Most points that could not be computed of which `status` prints the reasons.
_SHOWN = 20
sweep_app = typer.Typer(cls=DefaultGroup, subcommand_metavar="| COMMAND [ARGS]...")
app.add_typer(sweep_app, name="sweep")

Store = Annotated[
    Path,
    names(completion.files(".sweep"), metavar="STORE", help="Store of a sweep, SWEEP.sweep.", kind=Argument),
]


@sweep_app.callback()
def sweep_group() -> None:
    """Vary heights, optics, atmosphere or settings, measure each point, and rank what matters.

    One SQLite file holds all points; the report, `report.html` in a folder beside it, has the tornado chart, curves,
    error budget and allowances. The same points give the same metrics on any machine.

    **Examples**

    - `pachon sweep --example table1_small`: the height budget of Jee & Tyson (2011), Table 1, half a minute
    - `pachon sweep heights.yaml -o heights.sweep`, and after an interruption `--resume`
    - `pachon sweep heights.yaml --scheduler tcp://login1:8786`: on a Dask cluster
    - `pachon sweep status heights.sweep`
    - `pachon sweep export heights.sweep -o heights.ecsv`, or .csv, .fits, .parquet
    - `pachon sweep report heights.sweep`
    """


@sweep_app.command("run")
def sweep_run(
    sweep: Annotated[Path | None, yaml_file("SWEEP.yaml", "Sweep to run.", kind=Argument)] = None,
    out: Annotated[Path | None, Option("--out", "-o", help="Store to write; SWEEP.sweep by default.")] = None,
    resume: Annotated[bool, Option("--resume", help="Compute only the points that are missing.")] = False,
    processes: Processes = None,
    scheduler: Scheduler = None,
    workers: DaskWorkers = None,
    example: Annotated[
        str | None,
        names(completion.words("table1", "table1_small"), metavar="table1|table1_small", help="Run a bundled sweep."),
    ] = None,
    settings: Annotated[list[str] | None, set_option("sweep")] = None,
    threads: Threads = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Run a sweep and write its report; the word `run` may be left out.

    Without --processes, --scheduler or --workers there is a process for each processor.

    **Examples**

    - `pachon sweep heights.yaml --processes 4`
    - `pachon sweep heights.yaml --resume`
    - `pachon sweep heights.yaml --set design.points=9 -o fine.sweep`: any key of `pachon config sweep`
    """
    if (sweep is None) == (example is None):
        raise ConfigError("pachon sweep: expected a sweep file, or --example NAME")
    path = sweep or _example(example or "")
    store = out or path.with_suffix(".sweep")
    resumed = f"go on with: pachon sweep {path} -o {store} --resume"
    if scheduler is None and workers is None and processes is None:
        processes = thread_count(threads)
    with long_work(
        quiet, resumed, threads=threads, resume=resume, processes=processes, scheduler=scheduler, dask=workers
    ) as execution:
        outcome = _run(path, store, settings or (), execution)
    if not (as_json or quiet):
        print_line(outcome.pop("verdict"))
    _show(outcome, as_json, quiet)


def _run(path: Path, store: Path, settings: Sequence[str], execution: Execution) -> dict[str, Any]:
    """Compute the points that are missing, write the report, and return the counts.

    DomainError where no point can be computed; the store stays.
    """
    from ..studies.sweep.analysis import summary, verdict
    from ..studies.sweep.file import load_sweep
    from ..studies.sweep.report import write_report
    from ..studies.sweep.store import SweepStore
    from ..studies.sweep.sweep import run_sweep
    from ..studies.sweep.table import read_table

    outcome = run_sweep(load_sweep(path, settings), store, folder=path.parent, execution=execution)
    with SweepStore(store) as opened:
        if outcome.failed == outcome.points:
            first = opened.results()[0]
            raise DomainError(f"no point can be computed; point {first.number}: {first.problem}", file=store)
        with execution.reporter.stage("report"):
            report = str(write_report(opened, _report_folder(store)))
            sentence = verdict(summary(read_table(opened), opened.sweep))
    counts = {key: getattr(outcome, key) for key in ("points", "kept", "computed", "failed")}
    return {"verdict": sentence, "store": str(store), **counts, "report": report}


def _example(name: str) -> Path:
    """Write a bundled sweep file into the current folder, where there is none of that name, and return its path."""
    from ..core.errors import unknown_name
    from ..core.files import write_bytes
    from ..studies.sweep.file import EXAMPLES

    examples = sorted(path.stem for path in EXAMPLES.glob("*.yaml"))
    if name not in examples:
        raise unknown_name("example", name, examples)
    path = Path(f"{name}.yaml")
    if not path.exists():
        write_bytes(path, (EXAMPLES / path.name).read_bytes())
    return path


@sweep_app.command("status")
def sweep_status(store: Store, as_json: Json = False) -> None:
    """Count the points of a store: computed, failed and missing.

    **Examples**

    - `pachon sweep status heights.sweep`
    """
    from ..studies.sweep.store import SweepStore

    with SweepStore(store) as opened:
        results = opened.results()
        count = len(opened.points())
        sweep = opened.sweep
    problems = [r for r in results if r.problem is not None]
    status = {
        "sweep": sweep.name,
        "pachon": opened.about["pachon"],
        "design": sweep.design.kind,
        "points": count,
        "computed": len(results) - len(problems),
        "failed": len(problems),
        "missing": count - len(results),
        "seconds_a_point": float(f"{sum(r.seconds for r in results) / len(results):.3g}") if results else None,
        "workers": len({r.worker for r in results}),
    }
    _show(status, as_json)
    if problems and not as_json:
        for result in problems[:_SHOWN]:
            print_line(f"point {result.number}: {result.problem}")
        if len(problems) > _SHOWN:
            print_line(f"{len(problems) - _SHOWN} more have failed: sweep export has all")


@sweep_app.command("export")
def sweep_export(
    store: Store,
    out: Annotated[
        Path | None, Option("--out", "-o", "--table", help="Table to write, .ecsv, .csv, .fits or .parquet.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Write the points of a store as a table; of a damaged store those that can still be read.

    **Examples**

    - `pachon sweep export heights.sweep`: heights.ecsv
    - `pachon sweep export heights.sweep -o heights.parquet`
    """
    from ..studies.sweep.store import DamagedStoreError, SweepStore
    from ..studies.sweep.table import export_table, salvage

    target = out or store.with_suffix(".ecsv")
    damaged = {}
    try:
        with SweepStore(store) as opened:
            count = export_table(opened, target)
    except DamagedStoreError as error:
        count, damaged = salvage(store, target), {"damaged": str(error)}
    _show({"table": str(target), "points": count, **damaged}, as_json)


@sweep_app.command("report")
def sweep_report(
    store: Store,
    out: Annotated[Path | None, Option("--out", "-o", help="Folder to write to; beside the store.")] = None,
    as_json: Json = False,
) -> None:
    """Write the report of a store: tornado chart, curves, error budget and allowances.

    **Examples**

    - `pachon sweep report heights.sweep -o heights_report`
    """
    from ..studies.sweep.report import write_report
    from ..studies.sweep.store import SweepStore

    with SweepStore(store) as opened:
        report = write_report(opened, out or _report_folder(store))
    _show({"report": str(report)}, as_json)


def _report_folder(store: Path) -> Path:
    return store.with_name(f"{store.stem}_report")


def _show(values: dict[str, Any], as_json: bool, quiet: bool = False) -> None:
    if as_json:
        print_json(values)
    elif not quiet:
        lines = plain_table(show_header=False)
        for name, value in values.items():
            lines.add_row(name.replace("_", " "), "" if value is None else f"{value}")
        wide_console().print(lines, highlight=False)
