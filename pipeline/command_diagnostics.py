"""The commands ``pachon diagnose`` and ``pachon attribute``; :mod:`~pachon.pipeline.cli` registers them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from ..models.errors import ConfigError
from .command_options import Json, Threads, name_list, wide_console


def diagnose_command(
    folder: Annotated[Path, typer.Argument(metavar="RUN_FOLDER", help="Folder of a run, finished or not.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder to write to; by default diagnostics, in that of the run.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Look at the residuals of a run: ellipticity and size of each CCD, correlations, rho statistics, with jackknife.

    Residuals at the stars, which flatter the model, at stars left out of the fit, and where no star is, side by side.
    Tables (ECSV), pictures and all figures (diagnostics.json) go into one folder.

    **Examples**

    - `pachon diagnose pachon_run`

    - `pachon diagnose pachon_run --out looked_at`

    - `pachon diagnose pachon_run --json`: all figures on standard output
    """
    from .diagnostics import diagnose
    from .products import json_text

    result = diagnose(folder, out)
    if as_json:
        print(json_text(result.as_dict()))
        return
    _show_diagnostics(result)


def _show_diagnostics(result: Any) -> None:
    from .tables import DIAGNOSTICS_CAPTION, DIAGNOSTICS_COLUMNS, diagnostics_rows

    console = wide_console()
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for name in DIAGNOSTICS_COLUMNS:
        left = name == DIAGNOSTICS_COLUMNS[0]
        table.add_column(name.replace("[", "\\["), justify="left" if left else "right", no_wrap=True)
    for row in diagnostics_rows(result.overall):
        table.add_row(*row)
    console.print(table)
    console.print(DIAGNOSTICS_CAPTION, style="dim", width=100)
    if result.missing:
        console.print(f"{len(result.missing)} CCDs have no product yet: {', '.join(result.missing[:5])}", style="bold")
    print(f"diagnostics: {result.folder.resolve()}")


def attribute_command(
    config: Annotated[
        Path | None, typer.Argument(metavar="CONFIG.yaml", help="Configuration; all has a default.")
    ] = None,
    ccds: Annotated[str | None, typer.Option(help="CCDs, separated by commas: R22_S11,R22_S12.")] = None,
    raft: Annotated[str | None, typer.Option(help="All CCDs of rafts: R22 or R22,R23.")] = None,
    causes: Annotated[
        str | None,
        typer.Option(
            help="Causes to switch off, separated by commas, of global, raft, ccd, tilt, potato_chip, heights, "
            "active_optics, atmosphere, diffusion, noise; all that are on by default."
        ),
    ] = None,
    average: Annotated[
        bool, typer.Option("--average", help="The mean over all turbulence: quick, and leaves optics and heights.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder to write to.")] = Path("pachon_attribution"),
    truth_stars: Annotated[int | None, typer.Option(help="Noise-free PSFs on each CCD.")] = None,
    observed_stars: Annotated[int | None, typer.Option(help="Observed stars on each CCD.")] = None,
    threads: Threads = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no table.")] = False,
    as_json: Json = False,
) -> None:
    """Find what each cause does: the same stars with everything, and once more with each cause switched off.

    As long as a run for each cause. Heights, turbulence and positions of the stars stay as they were, so a difference
    is the doing of the cause. Tables (ECSV), a picture and all figures (attribution.json) go into one folder.

    **Examples**

    - `pachon attribute --raft R22 --average`: seconds

    - `pachon attribute pachon_run/config.yaml --causes ccd,potato_chip,atmosphere --truth-stars 200`
    """
    from .attribution import attribute, checked_causes, write_attribution
    from .config import Configuration, load_configuration, with_options
    from .experiment import resolve
    from .interrupt import remembered_interrupts
    from .products import json_text, make_folder
    from .progress import Reporter

    if ccds is not None and raft is not None:
        raise ConfigError("--ccds and --raft: expected one of them")
    names = name_list(ccds, "--ccds") if ccds is not None else name_list(raft, "--raft") if raft is not None else None
    base = Configuration() if config is None else load_configuration(config)
    engine = "long_exposure" if average else None
    settings = with_options(
        base, ccds=names, stars__truth=truth_stars, stars__observed=observed_stars, psf__engine=engine
    )
    resolved = resolve(settings, None if config is None else config.parent)
    chosen = checked_causes(resolved, None if causes is None else name_list(causes, "--causes"))
    make_folder(out)
    with remembered_interrupts() as check:
        result = attribute(resolved, chosen, threads=threads, reporter=Reporter(quiet, check))
    write_attribution(result, out, resolved)
    if as_json:
        print(json_text(result.figures))
        return
    if not quiet:
        _show_attribution(result.figures)
    print(f"attribution: {out.resolve()}")


def _show_attribution(figures: dict[str, dict[str, float]]) -> None:
    from .tables import ATTRIBUTION_CAPTION, ATTRIBUTION_COLUMNS, attribution_rows

    console = wide_console()
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for name in ATTRIBUTION_COLUMNS:
        left = name == ATTRIBUTION_COLUMNS[0]
        table.add_column(name.replace("[", "\\["), justify="left" if left else "right", no_wrap=True)
    for row in attribution_rows(figures):
        table.add_row(*row)
    console.print(table)
    console.print(ATTRIBUTION_CAPTION, style="dim", width=100)
