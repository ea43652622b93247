"""The commands ``pachon diagnose`` and ``pachon attribute``; :mod:`~pachon.commands.cli` registers them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .options import (
    Ccds,
    Config,
    Json,
    ObservedStars,
    Quiet,
    Raft,
    Threads,
    TruthStars,
    interruptible,
    name_list,
    one_name_list,
    resolved_configuration,
    show_table,
    wide_console,
)


def diagnose_command(
    folder: Annotated[Path, typer.Argument(metavar="RUN_FOLDER", help="Folder of a run, finished or not.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder to write to; by default diagnostics, in that of the run.")
    ] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="End where a CCD has no product that can be read, and do not leave it out.")
    ] = False,
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
    from ..core.files import json_text
    from ..pipeline.measure.diagnostics import diagnose

    result = diagnose(folder, out, strict=strict)
    if as_json:
        print(json_text(result.as_dict()))
        return
    _show_diagnostics(result)


def _show_diagnostics(result: Any) -> None:
    from ..pipeline.report.tables import DIAGNOSTICS_CAPTION, DIAGNOSTICS_COLUMNS, diagnostics_rows

    show_table(DIAGNOSTICS_COLUMNS, diagnostics_rows(result.overall), DIAGNOSTICS_CAPTION)
    if result.missing:
        reason = next(iter(result.missing.values()))
        wide_console().print(f"{len(result.missing)} CCDs are left out; the first: {reason}", style="bold")
    print(f"diagnostics: {result.folder.resolve()}")


def attribute_command(
    config: Config = None,
    ccds: Ccds = None,
    raft: Raft = None,
    causes: Annotated[
        str | None,
        typer.Option(
            help="Causes to switch off, separated by commas, of global, raft, ccd, tilt, potato_chip, heights, "
            "active_optics, optics, atmosphere, ground_layer, diffusion, noise; all that are on by default."
        ),
    ] = None,
    average: Annotated[
        bool, typer.Option("--average", help="The mean over all turbulence: quick, and leaves optics and heights.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder to write to.")] = Path("pachon_attribution"),
    truth_stars: TruthStars = None,
    observed_stars: ObservedStars = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Find what each cause does: the same stars with everything, and once more with each cause switched off.

    As long as a run for each cause. Heights, turbulence and positions of the stars stay as they were, so a difference
    is the doing of the cause. Tables (ECSV), a picture and all figures (attribution.json) go into one folder.

    **Examples**

    - `pachon attribute --raft R22 --average`: seconds

    - `pachon attribute pachon_run/config.yaml --causes ccd,potato_chip,atmosphere --truth-stars 200`
    """
    from ..core.files import json_text, make_folder
    from ..studies.attribution.attribution import attribute, checked_causes, write_attribution

    names = one_name_list(ccds=ccds, raft=raft)
    engine = "long_exposure" if average else None
    resolved = resolved_configuration(
        config, ccds=names, stars__truth=truth_stars, stars__observed=observed_stars, psf__engine=engine
    )
    chosen = checked_causes(resolved, None if causes is None else name_list(causes, "--causes"))
    make_folder(out)
    with interruptible(quiet) as reporter:
        result = attribute(resolved, chosen, threads=threads, reporter=reporter)
    write_attribution(result, out, resolved)
    if as_json:
        print(json_text(result.figures))
        return
    if not quiet:
        _show_attribution(result.figures)
    print(f"attribution: {out.resolve()}")


def _show_attribution(figures: dict[str, dict[str, float]]) -> None:
    from ..pipeline.report.tables import ATTRIBUTION_CAPTION, ATTRIBUTION_COLUMNS, attribution_rows

    show_table(ATTRIBUTION_COLUMNS, attribution_rows(figures), ATTRIBUTION_CAPTION)


COMMANDS = {"diagnose": diagnose_command, "attribute": attribute_command}
