"""The command ``pachon reproduce``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.table import Table
from typer import Argument, Option

from ..core.terminal import print_line
from . import completion
from .choices import choice, names
from .options import Json, Quiet, TableFile, Threads
from .tables import Rows, print_json, wide_console, write_rows
from .verdicts import reproduced_verdict
from .workers import DaskWorkers, Processes, Scheduler, long_work

if TYPE_CHECKING:
    from ..wavefront.psf.engines import EngineName

app = typer.Typer()


@app.command("reproduce")
def reproduce_command(
    figures: Annotated[
        list[str] | None,
        names(
            completion.figures,
            metavar="FIGURE",
            help="Figures fig1 ... fig18, table1, or all, the default.",
            kind=Argument,
        ),
    ] = None,
    scale: Annotated[
        str,
        choice(
            ("small", "paper"),
            help="small (two minutes), or paper (189 CCDs: an hour; with 100 visits, half a day).",
        ),
    ] = "small",
    engine: Annotated[
        str,
        choice(("fast", "statistical"), help="PSFs of the run and of the visits: through screens, or without them."),
    ] = "fast",
    out: Annotated[Path, Option("--out", "-o", help="Folder of the figures.")] = Path("pachon_figures"),
    seed: Annotated[int, Option(min=0, help="Seed of all random numbers.")] = 1,
    processes: Processes = None,
    scheduler: Scheduler = None,
    workers: DaskWorkers = None,
    table: TableFile = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Reproduce the figures of Jee & Tyson (2011), with the paper's values beside ours.

    Each gives plots (PNG), their data (ECSV or FITS) and a verdict; `all` writes summary.json too.
    Figures 9 and 11 to 14 show one run of the pipeline, in the sub-folder run, 15 to 18 stacks of visits, in the
    sub-folder visits: both are kept, go on where they were stopped, and are used again.

    **Examples**

    - `pachon reproduce`: all of them, small
    - `pachon reproduce fig3 table1 --out figures`
    - `pachon reproduce all --scale paper --out paper_figures`
    - `pachon reproduce fig15 fig16 --scale paper --processes 2`: visits side by side
    - `pachon reproduce fig14 --scale paper --engine statistical`: a survey's engine, without screens
    """
    from ..studies.reproduce.reproduce import reproduce_at

    hint = f"finished parts are in {out}, and are used by the next call"
    with long_work(quiet, hint, threads=threads, processes=processes, scheduler=scheduler, dask=workers) as execution:
        summary = reproduce_at(
            figures or ("all",), scale, out, seed=seed, engine=cast("EngineName", engine), execution=execution
        )
    headings = ("figure", "paper", "here", "verdict", "why")
    cells = [(name, *(figure[key] for key in headings[1:])) for name, figure in summary["figures"].items()]
    write_rows(Rows(headings, cells), table)
    if as_json:
        print_json(summary)
    elif not quiet:
        _show_reproduced(summary, out)


def _show_reproduced(summary: dict[str, Any], folder: Path) -> None:
    print_line(reproduced_verdict(summary["figures"]))
    table = Table(header_style="bold", padding=(0, 1), show_lines=True)
    table.add_column("figure", no_wrap=True)
    for name in ("paper", "here", "verdict"):
        table.add_column(name, ratio=1)
    for name, figure in summary["figures"].items():
        table.add_row(name, figure["paper"], figure["here"], f"{figure['verdict']}: {figure['why']}")
    wide_console().print(table, highlight=False)
    print_line(f"figures: {folder.resolve()}")
