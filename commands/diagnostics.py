"""The commands ``pachon diagnose`` and ``pachon attribute``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from ..core.errors import ConfigError
from ..core.number_text import counted
from ..core.terminal import print_line
from . import completion
from .choices import names
from .inputs import configured_experiment, warnings_shown
from .interrupt import interruptible
from .options import (
    Ccds,
    Config,
    Gain,
    Json,
    MinSnr,
    ObservedStars,
    Quiet,
    Raft,
    Settings,
    StarImages,
    StarStamp,
    StarX,
    StarY,
    TableFile,
    Threads,
    TruthStars,
    name_list,
    one_name_list,
    refuse_stated,
)
from .tables import Rows, print_json, wide_console, write_rows
from .verdicts import attribution_verdict, diagnose_verdict, piff_verdict

if TYPE_CHECKING:
    from ..reconstruction.piff.comparison import PiffComparison

app = typer.Typer()


@app.command("diagnose")
def diagnose_command(
    folder: Annotated[
        Path, Argument(metavar="RUN_FOLDER", help="Folder of a run, finished or not; with --piff a table of stars.")
    ],
    out: Annotated[
        Path | None,
        Option("--out", "-o", help="Folder to write to; by default diagnostics, in that of the run, or STARS_piff."),
    ] = None,
    strict: Annotated[bool, Option("--strict", help="End at the first CCD without a readable product.")] = False,
    piff: Annotated[Path | None, Option(help="File of Piff, to be compared with our model at the stars.")] = None,
    chip: Annotated[int | None, Option(help="Chip of the Piff file, where it has several.")] = None,
    x: StarX = "x",
    y: StarY = "y",
    stamp: StarStamp = "stamp",
    images: StarImages = None,
    min_snr: MinSnr = 20.0,
    gain: Gain = 1.0,
    table: TableFile = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Measure the residuals of a run: ellipticity and size of each CCD, correlations, rho statistics, with jackknife.

    Side by side: residuals at the stars of the fit, which are too small, leave-one-out residuals, and residuals at
    holdout positions. Tables (ECSV), plots and all metrics (diagnostics.json) go into one folder. With `--piff`, a PSF
    model of Piff and one of ours are compared at the stars of a table, as `pachon model` takes it.

    **Examples**

    - `pachon diagnose pachon_run`
    - `pachon diagnose pachon_run --out residuals`
    - `pachon diagnose pachon_run --json`: all metrics on standard output
    - `pachon diagnose stars.fits --piff stars.piff`: Piff and ours side by side
    """
    from ..pipeline.report.diagnostics import diagnose
    from ..pipeline.report.tables import (
        DIAGNOSTICS_CAPTION,
        DIAGNOSTICS_COLUMNS,
        PIFF_CAPTION,
        PIFF_COLUMNS,
        diagnostics_rows,
        piff_rows,
    )

    if piff is None:
        of_stars = {"--chip": chip is not None, "--images": images is not None}
        of_stars |= {"--x": x != "x", "--y": y != "y", "--stamp": stamp != "stamp"}
        of_stars |= {"--min-snr": min_snr != 20.0, "--gain": gain != 1.0}
        refuse_stated(of_stars, ": expected --piff with it, whose stars the table has")
    elif strict:
        raise ConfigError("--strict with --piff: expected none, a table of stars has no CCDs")
    if piff is not None:
        columns = {"x": x, "y": y, "stamp": stamp, "images": images}
        options = {"chip": chip, "min_snr": min_snr, "gain": gain}
        piff_comparison, written = _compare(folder, piff, out, columns, options, quiet)
        sentence = piff_verdict(piff_comparison.models)
        rows = Rows(PIFF_COLUMNS, piff_rows(piff_comparison.models), PIFF_CAPTION, verdict=sentence)
        write_rows(rows, table)
        if as_json:
            print_json(piff_comparison.as_dict())
        elif not quiet:
            rows.show()
            print_line(f"comparison: {written.resolve()}")
        return
    result = diagnose(folder, out, strict=strict)
    rows = Rows(
        DIAGNOSTICS_COLUMNS,
        diagnostics_rows(result.overall),
        DIAGNOSTICS_CAPTION,
        verdict=diagnose_verdict(result.overall, len(result.missing)),
    )
    write_rows(rows, table)
    if as_json:
        print_json(result.as_dict())
        return
    if not quiet:
        rows.show()
    if result.missing:
        reason = next(iter(result.missing.values()))
        wide_console().print(
            f"{counted(len(result.missing), 'CCD is', 'CCDs are')} left out; the first: {reason}", style="bold"
        )
    print_line(f"diagnostics: {result.folder.resolve()}")


def _compare(
    stars: Path,
    piff: Path,
    out: Path | None,
    columns: dict[str, Any],
    options: dict[str, Any],
    quiet: bool,
) -> tuple[PiffComparison, Path]:
    """Compare a model of Piff with ours at the stars of a table; return the comparison and its folder."""
    from ..core.errors import WcsWarning
    from ..reconstruction.own_stars.star_catalogue import load_stars
    from ..reconstruction.piff.comparison import compare_with_piff
    from ..reconstruction.piff.psf import load_piff

    folder = stars.with_name(f"{stars.stem}_piff") if out is None else out
    with interruptible(quiet) as reporter, reporter.stage(f"PSF of {stars.name}"):
        with warnings_shown(WcsWarning):
            psf = load_piff(piff)
        cutouts = load_stars(stars, **columns)
        piff_comparison = compare_with_piff(psf, *cutouts.part(cutouts.unflagged()), **options)
        piff_comparison.write_folder(folder)
    return piff_comparison, folder


@app.command("attribute")
def attribute_command(
    config: Config = None,
    ccds: Ccds = None,
    raft: Raft = None,
    causes: Annotated[
        str | None,
        names(
            completion.causes,
            listed=True,
            metavar="CAUSE,...",
            help="Causes to switch off, separated by commas, of global, raft, ccd, tilt, potato_chip, heights, "
            "active_optics, optics, atmosphere, ground_layer, diffusion, absorption_depth, brighter_fatter, "
            "tree_rings, edge_rolloff, noise; all that are on by default.",
        ),
    ] = None,
    average: Annotated[bool, Option("--average", help="Average over all turbulence; quick.")] = False,
    out: Annotated[Path, Option("--out", "-o", help="Folder to write to.")] = Path("pachon_attribution"),
    truth_stars: TruthStars = None,
    observed_stars: ObservedStars = None,
    table: TableFile = None,
    settings: Settings = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Attribute ellipticity to its causes: the same stars with all causes, and once more without each of them.

    Each cause takes as long as a run. Heights, turbulence and positions of the stars stay the same, so a difference
    is due to the cause. Tables (ECSV), a plot and all metrics (attribution.json) go into one folder.

    **Examples**

    - `pachon attribute --raft R22 --average`: 20 seconds
    - `pachon attribute pachon_run/config.yaml --causes ccd,potato_chip,atmosphere --truth-stars 200`
    """
    from ..core.files import make_folder
    from ..pipeline.report.tables import ATTRIBUTION_CAPTION, ATTRIBUTION_COLUMNS, attribution_rows
    from ..studies.attribution.attribution import attribute
    from ..studies.attribution.causes import always_on, checked_causes
    from ..studies.attribution.product import write_attribution

    ccd_names = one_name_list(ccds=ccds, raft=raft)
    engine = "long_exposure" if average else None
    resolved = configured_experiment(
        config, settings, ccds=ccd_names, stars__truth=truth_stars, stars__observed=observed_stars, psf__engine=engine
    ).config
    cause_names = checked_causes(resolved, None if causes is None else name_list(causes, "--causes"))
    make_folder(out)
    with interruptible(quiet) as reporter:
        result = attribute(resolved, cause_names, threads=threads, reporter=reporter)
    write_attribution(result, out, resolved)
    rows = Rows(
        ATTRIBUTION_COLUMNS,
        attribution_rows(result.metrics),
        ATTRIBUTION_CAPTION,
        verdict=attribution_verdict(result.metrics),
    )
    write_rows(rows, table)
    if as_json:
        print_json(result.metrics)
        return
    if not quiet:
        rows.show()
        for name, reason in always_on(resolved).items() if causes is None else ():
            print_line(f"{name} is on in all cases: {reason}")
    if result.left_out:
        print_line(f"left out of all cases, not to be modelled in one: {', '.join(result.left_out)}")
    print_line(f"attribution: {out.resolve()}")
