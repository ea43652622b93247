"""The command ``pachon tolerance``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from ..core.file_names import file_name
from ..core.number_text import number_with_unit
from ..core.terminal import print_line
from .choices import choice
from .inputs import errors_of, load_model
from .options import GlassCatalogues, Json, Lenient, Model, Quiet, TableFile, Threads, set_option, yaml_file
from .tables import Rows, number_texts, print_json, write_rows
from .workers import DaskWorkers, Processes, Scheduler, long_work

app = typer.Typer()
#: Tolerances in the table, the costliest.
_SHOWN = 12


@app.command("tolerance")
def tolerance_command(
    model: Model,
    tolerances: Annotated[Path, yaml_file("TOL.yaml", "Tolerances, compensators, merit, requirement.", kind=Argument)],
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder to write to; by default tolerance_ and the model.")
    ] = None,
    method: Annotated[
        str | None, choice(("linear", "quadratic", "traced"), help="Method of the Monte Carlo, as in the file.")
    ] = None,
    draws: Annotated[int | None, Option("--draws", "-n", min=1, help="Telescopes to draw, as in the file.")] = None,
    seed: Annotated[int | None, Option(help="Seed of the draws, as in the file.")] = None,
    resume: Annotated[bool, Option("--resume", help="Compute only what is missing in the folder.")] = False,
    glass_catalogue: GlassCatalogues = None,
    lenient: Lenient = False,
    processes: Processes = None,
    scheduler: Scheduler = None,
    workers: DaskWorkers = None,
    table: TableFile = None,
    settings: Annotated[list[str] | None, set_option("tolerances")] = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Find what tolerances cost, how tight they must be, and how many telescopes meet a requirement.

    Every tolerance is traced at both of its ends (sensitivity), the size that costs a stated loss is found (inverse
    sensitivity), and telescopes are drawn with all of them at once; compensators follow. A page, tables (ECSV), plots
    and summary.json go into one folder, with the store of what was computed.

    **Examples**

    - `pachon tolerance triplet.zmx tol.yaml`
    - `pachon tolerance triplet.zmx tol.yaml --method linear -n 100000 -o many`
    - `pachon tolerance triplet.zmx tol.yaml --set requirement=9`: any key of `pachon config tolerances`
    - `pachon tolerance lsst_v3.3_r tol.yaml --processes 4`, and after an interruption `--resume`
    """
    from ..core.files import make_folder
    from ..models.io.bundled import BUNDLED
    from ..models.paraxial import following_stop
    from ..studies.tolerance.file import load_tolerances, with_settings
    from ..studies.tolerance.product import STORE_FILE, tolerance_summary, write_tolerances
    from ..studies.tolerance.report import verdict
    from ..studies.tolerance.study import run_tolerances

    telescope = load_model(model, lenient, glass_catalogue or ())
    source = model if model in BUNDLED else str(Path(model).resolve())
    file = with_settings(load_tolerances(tolerances, source, settings or ()), method=method, draws=draws, seed=seed)
    folder = out or Path(f"tolerance_{file_name(telescope.name)}")
    make_folder(folder)
    resumed = f"go on with: pachon tolerance {model} {tolerances} -o {folder} --resume"
    with (
        long_work(
            quiet, resumed, threads=threads, resume=resume, processes=processes, scheduler=scheduler, dask=workers
        ) as execution,
        errors_of(tolerances),
    ):
        study = run_tolerances(telescope, file, folder / STORE_FILE, execution=execution)
    write_tolerances(study, file, folder)
    summary = tolerance_summary(study)
    rows = _offender_rows(summary, verdict(summary))
    write_rows(rows, table)
    if as_json:
        print_json({**summary, "folder": str(folder)})
        return
    if not quiet:
        replace(rows, rows=rows.rows[:_SHOWN]).show()
        _show_draws(summary)
        if following_stop(telescope) is not telescope:
            print_line(f"rays fill the stop {telescope.design_data.stop}, as with aiming: real")
    print_line(f"tolerances: {folder.resolve()}")


def _offender_rows(summary: dict[str, Any], sentence: str) -> Rows:
    """Return the costliest tolerances."""
    unit = f" [{summary['unit']}]" if summary["unit"] else ""
    plain = f" {summary['unit']}" if summary["unit"] else ""
    rows = []
    for offender in summary["worst_offenders"]:
        size_unit = "" if offender["unit"] == "1" else offender["unit"]
        ends = number_texts([offender["lower_end"], offender["upper_end"]], ".5g")
        rows.append(
            (
                offender["name"],
                number_with_unit(offender["size"], ".4g", size_unit),
                *ends,
                number_with_unit(offender["size_for_the_loss"], ".4g", size_unit),
            )
        )
    headings = ("tolerance", "size", f"lower end{unit}", f"upper end{unit}", f"{summary['loss_percent']:g} % loss at")
    caption = f"The costliest of {summary['tolerances']}; as designed {summary['nominal']:.5g}{plain}."
    return Rows(headings, rows, caption, verdict=sentence)


def _show_draws(summary: dict[str, Any]) -> None:
    """Print the Monte Carlo."""
    plain = f" {summary['unit']}" if summary["unit"] else ""
    reached = ", ".join(f"{p} % {summary[f'reached_by_{p}_percent']:.5g}" for p in (50, 80, 95))
    lost = f"; {summary['lost']} without light" if summary["lost"] else ""
    print_line(f"{summary['draws']} telescopes, {summary['method']}: reached by {reached}{plain}{lost}")
    if "yield" in summary:
        yield_summary = summary["yield"]
        interval = f"{100 * yield_summary['low']:.1f} to {100 * yield_summary['high']:.1f} %"
        print_line(
            f"requirement {summary['requirement']:g}{plain}: met by {100 * yield_summary['fraction']:.1f} %"
            f" ({interval})"
        )
