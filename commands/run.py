"""The command ``pachon run``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

from ..core.number_text import counted
from ..core.terminal import print_line, print_warning
from .inputs import configuration, configured_experiment
from .night import (
    Bands,
    ListFile,
    Night,
    VisitNumber,
    Where,
    listed_experiment,
    listed_visit,
    part_of,
    require_list,
)
from .options import (
    AllCcds,
    Ccds,
    Config,
    Json,
    ObservedStars,
    Quiet,
    Raft,
    Settings,
    TableFile,
    Threads,
    TruthStars,
    chosen_ccds,
)
from .tables import Rows, plain_table, print_json, wide_console, write_rows
from .workers import DaskWorkers, Processes, Scheduler, long_work

if TYPE_CHECKING:
    from ..pipeline.run import RunResult

app = typer.Typer()
#: Most CCDs whose metrics are printed.
_SHOWN = 21


@app.command("run")
def run_command(
    config: Config = None,
    ccds: Ccds = None,
    raft: Raft = None,
    all_ccds: AllCcds = False,
    out: Annotated[Path, Option("--out", "-o", help="Folder of the run.")] = Path("pachon_run"),
    seed: Annotated[int | None, Option(help="Seed of all random numbers.")] = None,
    resume: Annotated[bool, Option("--resume", help="Keep the CCDs that are finished, compute the others.")] = False,
    strict: Annotated[bool, Option("--strict", help="End at the first CCD that cannot be modelled.")] = False,
    part: Annotated[
        str | None, Option(metavar="I/N", help="Compute the I-th of N parts; all parts share the folder.")
    ] = None,
    processes: Processes = None,
    scheduler: Scheduler = None,
    workers: DaskWorkers = None,
    visit_list: ListFile = None,
    visit: VisitNumber = None,
    where: Where = None,
    band: Bands = None,
    night: Night = None,
    truth_stars: TruthStars = None,
    observed_stars: ObservedStars = None,
    table: TableFile = None,
    settings: Settings = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Follow starlight from the sky to a PSF model: optics, CCD heights, atmosphere, noisy stars, correlations.

    Without a configuration: r band of the LSST, nine CCDs from the centre of the field to its edge.

    Everything goes into one folder: report.html, summary.json, a FITS product for each CCD, config.yaml with every
    default written out (running it again gives the same bytes), and the focal plane as a table and as a mesh.

    **Examples**

    - `pachon run`: the default, under a minute on two cores
    - `pachon run --raft R22 --out central_raft --seed 7`
    - `pachon run --ccds R22_S11,R24_S12 --truth-stars 400`
    - `pachon run --set psf.engine=wave --set atmosphere.exposure_s=30`: any key; `pachon config run` explains all
    - `pachon run pachon_run/config.yaml --out again`: the same bytes
    - `pachon run --all --out full --resume`: go on where a run was stopped
    - `pachon run --all --out full --scheduler tcp://login1:8786`: on a Dask cluster
    - `pachon run --all --out full --part 3/8`: one of eight jobs of a batch system, with one folder for all
    - `pachon run --list baseline.db --visit 1004 --out visit1004`: a visit of a scheduler's list
    """
    from ..pipeline.run import run
    from ..pipeline.simulate.ccd_loop import left_out_line

    options: dict[str, Any] = {
        "ccds": chosen_ccds(ccds, raft, all_ccds),
        "seed": seed,
        "stars__truth": truth_stars,
        "stars__observed": observed_stars,
    }
    if visit_list is None:
        require_list(("--visit", visit), ("--where", where), ("--band", band), ("--night", night))
        experiment = configured_experiment(config, settings, **options)
    else:
        base = configuration(config, settings, **options)
        folder = None if config is None else config.parent
        listed = listed_visit(base, visit_list, visit, where, band, night, folder)
        experiment = listed_experiment(base, listed, folder)
    hint = f"finished CCDs are in {out}, and --resume goes on from there"
    with long_work(
        quiet, hint, threads=threads, resume=resume, processes=processes, scheduler=scheduler, dask=workers
    ) as execution:
        result = run(experiment, out, strict=strict, part=part_of(part), execution=execution)
    if quiet:  # the reporter has printed nothing
        for name, reason in result.not_modelled.items():
            print_line(f"pachon: {left_out_line(name, reason)}", error=True)
        for warning in result.summary.get("warnings", ()):
            print_line(f"pachon: {warning}", error=True)
    if result.report:
        write_rows(_ccd_rows(result), table)
    elif table is not None:
        print_warning(f"{table} is not written: {counted(len(result.missing), 'CCD')} of other parts missing")
    if as_json:
        part_summary = {"missing": list(result.missing), "not_modelled": result.not_modelled}
        print_json(result.summary if result.report else part_summary)
    elif not quiet:
        if result.report:
            _show_run(result, result.report, sum(execution.reporter.seconds.values()))
        else:
            _show_part(result)


def _show_part(result: RunResult) -> None:
    count = len(result.missing)
    example_names = f"{', '.join(result.missing[:3])}{', ...' if count > 3 else ''}"
    print_line(
        f"{counted(len(result.computed), 'CCD')} computed, {len(result.kept)} there already; {count} missing: "
        f"{example_names}"
    )
    print_line("the last part to end writes the report")


def _ccd_rows(result: RunResult) -> Rows:
    """Return the metrics of each CCD."""
    from ..pipeline.report.tables import PER_CCD_CAPTION, PER_CCD_COLUMNS, per_ccd

    headings = [f"{name} [{unit}]" if unit else name for name, unit in PER_CCD_COLUMNS]
    return Rows(headings, per_ccd(result.summary), PER_CCD_CAPTION, left=sum(not unit for _, unit in PER_CCD_COLUMNS))


def _show_run(result: RunResult, report: Path, seconds: float) -> None:
    from ..pipeline.report.tables import MODELS_CAPTION, MODELS_COLUMNS, MOMENTS_NOTE, headline, models_rows, verdict

    console = wide_console()
    console.print(f"{verdict(result.summary)}\n", highlight=False)
    headlines = plain_table(show_header=False)
    for name, value in headline(result.summary):
        headlines.add_row(name, value)
    rows = _ccd_rows(result)
    if len(rows.rows) <= _SHOWN:
        rows.show()
        console.print()
    console.print(headlines)
    console.print(MOMENTS_NOTE)
    models = models_rows(result.summary)
    if models:
        console.print()
        Rows(MODELS_COLUMNS, models, MODELS_CAPTION).show()
    console.print(f"\n{counted(len(result.computed), 'CCD')} computed, {len(result.kept)} kept, {seconds:.0f} s")
    if result.not_modelled:
        console.print(f"left out, not to be modelled: {', '.join(result.not_modelled)}", style="bold")
    print_line(f"report: {report.resolve()}")
