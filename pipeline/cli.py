"""The command line: ``pachon run | reproduce | diagnose | attribute | opd | info``.

Exit status 0: done; 2: bad input or a file that cannot be written, one line on standard error; 130: interrupted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from ..models.errors import ConfigError, PachonError
from .command_diagnostics import attribute_command, diagnose_command
from .command_options import Json, Threads
from .command_options import name_list as _names
from .command_options import wide_console as _console

# Both live in typer or in click, as the version of typer has it; this way the right ones are caught.
_UsageError: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

app = typer.Typer(
    name="pachon",
    help="Ray-traced telescope wavefronts, turbulent atmospheres and PSF reconstruction.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)

_INTERRUPTED = 130


class _InterruptedRunError(Exception):
    """A run that Ctrl-C ended; says where what was finished lies."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Parameters
    ----------
    arguments : sequence of str, optional
        Arguments; those of the process by default.
    """
    try:
        status = app(args=None if arguments is None else list(arguments), prog_name="pachon", standalone_mode=False)
        sys.stdout.flush()
        if status == _INTERRUPTED:
            return _fail("interrupted", _INTERRUPTED)
        return status if isinstance(status, int) else 0
    except _InterruptedRunError as error:
        return _fail(str(error), _INTERRUPTED)
    except _UsageError as error:
        return _fail(error.format_message())
    except BrokenPipeError:
        # Whoever read our output has gone; Python would complain once more when it closes the stream.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except PachonError as error:
        return _fail(str(error))
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except MemoryError:
        return _fail("not enough memory; fewer threads or smaller atmosphere.screen_size need less")
    except (KeyboardInterrupt, typer.Abort):
        return _fail("interrupted", _INTERRUPTED)


def _fail(text: str, status: int = 2) -> int:
    print(f"pachon: error: {' '.join(text.split())}", file=sys.stderr, flush=True)
    return status


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"pachon {version('pachon')}")
        raise typer.Exit


@app.callback()
def _common(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    del show_version


@app.command("run")
def run_command(
    config: Annotated[
        Path | None, typer.Argument(metavar="CONFIG.yaml", help="Configuration; all has a default.")
    ] = None,
    ccds: Annotated[str | None, typer.Option(help="CCDs, separated by commas: R22_S11,R22_S12.")] = None,
    raft: Annotated[str | None, typer.Option(help="All CCDs of rafts: R22 or R22,R23.")] = None,
    all_ccds: Annotated[bool, typer.Option("--all", help="All CCDs of the camera.")] = False,
    out: Annotated[Path, typer.Option(help="Folder of the run.")] = Path("pachon_run"),
    seed: Annotated[int | None, typer.Option(help="Seed of all random numbers.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep the CCDs that are finished, compute the others.")
    ] = False,
    truth_stars: Annotated[int | None, typer.Option(help="Noise-free PSFs on each CCD.")] = None,
    observed_stars: Annotated[int | None, typer.Option(help="Observed stars on each CCD.")] = None,
    threads: Threads = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no table.")] = False,
    as_json: Json = False,
) -> None:
    """Follow starlight from the sky to a PSF model: optics, CCD heights, atmosphere, noisy stars, PCA, correlations.

    Without a configuration: r band of the LSST, nine CCDs from the centre of the field to its edge.

    Everything goes into one folder: report.html, summary.json, a FITS product for each CCD, config.yaml with every
    default written out (running it again gives the same bytes), and the focal plane as a table and as a mesh.

    **Examples**

    - `pachon run`: the default, a few minutes on two cores

    - `pachon run --raft R22 --out central_raft --seed 7`

    - `pachon run --ccds R22_S11,R24_S12 --truth-stars 400`

    - `pachon run pachon_run/config.yaml --out again`: the same bytes

    - `pachon run --all --out full --resume`: go on where a run was stopped
    """
    from .config import Configuration, load_configuration, with_options
    from .experiment import resolve
    from .interrupt import remembered_interrupts
    from .products import json_text
    from .progress import Reporter
    from .run import run

    chosen = [text for text in (ccds, raft) if text is not None]
    if len(chosen) + all_ccds > 1:
        raise ConfigError("--ccds, --raft and --all: expected one of them")
    names = ("all",) if all_ccds else _names(chosen[0], "--ccds" if ccds else "--raft") if chosen else None
    base = Configuration() if config is None else load_configuration(config)
    settings = with_options(base, ccds=names, seed=seed, stars__truth=truth_stars, stars__observed=observed_stars)
    try:
        resolved = resolve(settings, None if config is None else config.parent)
    except PachonError as error:
        if config is None or settings is not base:
            raise
        raise ConfigError(f"{config}: {error}") from None
    try:
        with remembered_interrupts() as check:
            reporter = Reporter(quiet, check)
            result = run(resolved, out, resume=resume, threads=threads, reporter=reporter)
    except KeyboardInterrupt:
        raise _InterruptedRunError(
            f"interrupted; finished CCDs are in {out}, and --resume goes on from there"
        ) from None
    if as_json:
        print(json_text(result.summary))
    elif not quiet:
        _show_run(result, sum(reporter.seconds.values()))


def _show_run(result: Any, seconds: float) -> None:
    from .tables import PER_CCD_CAPTION, PER_CCD_COLUMNS, headline, per_ccd

    console = _console()
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for what, value in headline(result.summary):
        table.add_row(what, value)
    rows = per_ccd(result.summary)
    if len(rows) <= 21:
        each = Table(box=None, header_style="bold", padding=(0, 1, 0, 0))
        for name, unit in PER_CCD_COLUMNS:
            each.add_column(
                f"{name} [{unit}]".replace("[", "\\[") if unit else name, justify="right" if unit else "left"
            )
        for row in rows:
            each.add_row(*row)
        console.print(each)
        console.print(PER_CCD_CAPTION, style="dim", width=100)
        console.print()
    console.print(table)
    console.print(f"\n{len(result.computed)} CCDs computed, {len(result.kept)} kept, {seconds:.0f} s")
    print(f"report: {result.report.resolve()}")


@app.command("reproduce")
def reproduce_command(
    figures: Annotated[
        list[str] | None, typer.Argument(metavar="fig1 ... fig14 | table1 | all", help="Figures; all by default.")
    ] = None,
    scale: Annotated[str, typer.Option(help="small (a minute or two) or paper (189 CCDs, about an hour).")] = "small",
    out: Annotated[Path, typer.Option(help="Folder of the figures.")] = Path("pachon_figures"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 1,
    threads: Threads = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no table.")] = False,
    as_json: Json = False,
) -> None:
    """Make figures of Jee & Tyson (2011) again, those that need no galaxies: what the paper says, what comes out here.

    Each gives pictures (PNG), the numbers behind them (ECSV or FITS) and a verdict; `all` writes summary.json too.
    Figures 9 and 11 to 14 show one run of the pipeline, in the sub-folder run: it is kept, and used again.

    **Examples**

    - `pachon reproduce`: all of them, small

    - `pachon reproduce fig3 table1 --out figures`

    - `pachon reproduce all --scale paper --out paper_figures`
    """
    from .interrupt import remembered_interrupts
    from .products import json_text
    from .progress import Reporter
    from .reproduce import reproduce_at

    try:
        with remembered_interrupts() as check:
            reporter = Reporter(quiet, check)
            summary = reproduce_at(figures or ("all",), scale, out, seed=seed, threads=threads, reporter=reporter)
    except KeyboardInterrupt:
        raise _InterruptedRunError(
            f"interrupted; what was finished is in {out}, and is used by the next call"
        ) from None
    if as_json:
        print(json_text(summary))
    elif not quiet:
        _show_reproduced(summary, out)


def _show_reproduced(summary: dict[str, Any], folder: Path) -> None:
    console = _console()
    table = Table(header_style="bold", padding=(0, 1), show_lines=True)
    table.add_column("figure", no_wrap=True)
    for name in ("paper", "here", "verdict"):
        table.add_column(name, ratio=1)
    for name, figure in summary["figures"].items():
        table.add_row(name, figure["paper"], figure["here"], f"{figure['verdict']}: {figure['why']}")
    console.print(table, markup=False, highlight=False)
    print(f"figures: {folder.resolve()}")


@app.command("opd")
def opd_command(
    model: Annotated[str, typer.Argument(help="Bundled model, or path of a prescription.")],
    field_deg: Annotated[str, typer.Option("--field-deg", metavar="X,Y", help="Field angle [deg].")] = "0,0",
    wavelength_nm: Annotated[
        float | None, typer.Option("--wavelength-nm", help="Wavelength [nm]; the model's own by default.")
    ] = None,
    grid: Annotated[int, typer.Option(min=8, max=4096, help="Points across the pupil.")] = 256,
    zernikes: Annotated[int, typer.Option(min=4, max=500, help="Highest Noll index to fit.")] = 28,
    out: Annotated[
        Path | None, typer.Option(help="Picture to write; by default named after the model and field.")
    ] = None,
    threads: Threads = None,
    as_json: Json = False,
) -> None:
    """Draw and save the optical path difference of a telescope at one field point, with its Zernike terms.

    Path of the chief ray minus path of each ray, to a sphere about where the chief ray meets the detector.

    **Examples**

    - `pachon opd lsst_v3.3_r --field-deg 0,1.225 --wavelength-nm 622`

    - `pachon opd paul_baker --field-deg 0.3,0.3 --zernikes 11 --out coma.png`

    - `pachon opd my_telescope.yaml --json`: figures only on standard output
    """
    import numpy as np

    from ..models.prescription import load_telescope
    from ..wavefront.opd import wavefront_opd
    from ..wavefront.zernike import annular_zernikes, fit_zernikes
    from .figures_opd import opd_figure
    from .products import json_text, write_bytes

    telescope = load_telescope(model)
    x, y = _pair(field_deg, "--field-deg")
    wavelength = telescope.default_wavelength if wavelength_nm is None else wavelength_nm * 1e-9
    opd = wavefront_opd(telescope, tuple(np.deg2rad([x, y])), wavelength, grid=grid, threads=threads)
    radius, obscuration = 0.5 * telescope.pupil_diameter, telescope.pupil_obscuration
    fit = fit_zernikes(opd, radius, obscuration, zernikes)
    tilt = fit_zernikes(opd, radius, obscuration, 3).coefficients
    rest = opd.value - np.tensordot(tilt, annular_zernikes(3, opd.x / radius, opd.y / radius, obscuration), axes=1)
    path = out or Path(f"opd_{telescope.name}_{x:g}_{y:g}_{opd.wavelength * 1e9:g}nm.png")
    write_bytes(path, opd_figure(opd, rest, fit, telescope.name))
    figures = {
        "model": telescope.name,
        "field_deg": [x, y],
        "wavelength_nm": opd.wavelength * 1e9,
        "rms_nm": opd.rms * 1e9,
        "rms_waves": opd.rms / opd.wavelength,
        "peak_to_valley_nm": opd.peak_to_valley * 1e9,
        "rms_without_tilt_nm": float(np.nanstd(rest)) * 1e9,
        "lit_fraction": float(opd.lit.sum() / _annulus_points(opd, telescope)),
        "reference_sphere_m": {"center": opd.center, "radius": opd.radius},
        "obscuration": fit.obscuration,
        "zernike_nm": fit.coefficients * 1e9,
        "residual_rms_nm": fit.residual_rms * 1e9,
        "picture": str(path),
    }
    if as_json:
        print(json_text(figures))
        return
    _show_opd(figures)


def _annulus_points(opd: Any, telescope: Any) -> int:
    """Return how many points of the grid lie in the unvignetted pupil."""
    radius_squared = (opd.x**2 + opd.y**2) / (0.5 * telescope.pupil_diameter) ** 2
    return int(((radius_squared <= 1.0) & (radius_squared >= telescope.pupil_obscuration**2)).sum())


def _show_opd(figures: dict[str, Any]) -> None:
    from ..wavefront.zernike import NOLL_NAMES, noll_to_nm

    console = _console()
    console.print(
        f"{figures['model']} at field ({figures['field_deg'][0]:g}, {figures['field_deg'][1]:g}) deg, "
        f"{figures['wavelength_nm']:g} nm: rms {figures['rms_nm']:.2f} nm = {figures['rms_waves']:.4f} waves, "
        f"peak to valley {figures['peak_to_valley_nm']:.1f} nm; "
        f"tilt taken off, rms {figures['rms_without_tilt_nm']:.2f} nm"
    )
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for name in ("Noll", "n", "m", "\\[nm]", "\\[waves]"):
        table.add_column(name, justify="right")
    table.add_column("term")
    for j, value in enumerate(figures["zernike_nm"], start=1):
        n, m = noll_to_nm(j)
        row = (f"{j}", f"{n}", f"{m}", f"{value:.3f}", f"{value / figures['wavelength_nm']:.5f}", NOLL_NAMES.get(j, ""))
        table.add_row(*row)
    console.print(table)
    console.print(f"left over: {figures['residual_rms_nm']:.3f} nm rms over the lit points")
    print(f"picture: {Path(figures['picture']).resolve()}")


app.command("diagnose")(diagnose_command)
app.command("attribute")(attribute_command)


@app.command("info")
def info_command(
    model: Annotated[str | None, typer.Argument(help="Bundled model, or path of a prescription.")] = None,
    as_json: Json = False,
) -> None:
    """Show the lens table and the first-order figures of a telescope; without a model, list those that come along.

    Radii and z are in the telescope frame: origin at the vertex of the primary, +z towards the sky, a positive radius
    has its centre on the +z side.

    **Examples**

    - `pachon info`

    - `pachon info lsst_v3.3_r`

    - `pachon info my_telescope.yaml --json`
    """
    from ..models.prescription import load_telescope
    from .info import SURFACE_COLUMNS, describe, figure_rows, list_models, surface_rows
    from .products import json_text

    console = _console()
    if model is None:
        models = list_models()
        if as_json:
            print(json_text({"models": models}))
            return
        table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
        table.add_column("model", no_wrap=True)
        table.add_column("what it is")
        for entry in models:
            table.add_row(entry["name"], entry["description"])
        console.print(table)
        return
    description = describe(load_telescope(model))
    if as_json:
        print(json_text(description))
        return
    console.print(f"{description['name']}: {description['description']}", highlight=False)
    console.print(f"source: {description['source']}\n", highlight=False)
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for i, name in enumerate(SURFACE_COLUMNS):
        table.add_column(name.replace("[", "\\["), justify="left" if i < 2 else "right", no_wrap=True)
    for row in surface_rows(description):
        table.add_row(*row)
    console.print(table)
    console.print()
    figures = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for what, value in figure_rows(description):
        figures.add_row(what, value)
    console.print(figures)


def _pair(text: str, option: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"{option} = {text!r}: expected two numbers in degrees, such as 0,1.2") from None
    return x, y


if __name__ == "__main__":
    sys.exit(main())
