"""The commands ``pachon baseline`` and ``pachon check``; :mod:`~pachon.commands.cli` registers them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..core.errors import ConfigError
from .options import (
    FieldsDeg,
    Json,
    Quiet,
    Threads,
    WavelengthsNm,
    field_list,
    interruptible,
    name_list,
)

_VERBS = ("save", "update")


def baseline_command(
    verb: Annotated[str, typer.Argument(metavar="save | update", help="Make a baseline, or accept changed figures.")],
    subject: Annotated[
        str, typer.Argument(metavar="MODEL | FILE", help="To save: bundled model, or path of a prescription.")
    ],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Baseline to write, NAME.baseline.json.")] = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="RUN.yaml", help="Run configuration: adds CCD heights, PSFs and a reconstruction."),
    ] = None,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthsNm = None,
    ccds: Annotated[
        str | None, typer.Option(metavar="NAMES", help="CCDs for PSFs, separated by commas; the first is modelled.")
    ] = None,
    threads: Threads = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Store the figures of a telescope, for `pachon check` to compare with.

    Wavefront, landing points, Zernikes, spots, encircled energy, distortion and vignetting; with a configuration also
    the height of every CCD and what it does to the wavefront, PSFs, and what a PSF model leaves. Each has a tolerance,
    and the reason for it; one stands on each line.

    **Examples**

    - `pachon baseline save lsst_v3.3_r -o lsst.baseline.json`

    - `pachon baseline save telescope.yaml -o telescope.baseline.json --config run.yaml`

    - `pachon baseline update telescope.baseline.json`: new values for what is out of tolerance, all else stays
    """
    if verb not in _VERBS:
        raise ConfigError(f"pachon baseline {verb}: expected save MODEL -o FILE, or update FILE")
    if verb == "update":
        _update(Path(subject), threads, as_json, quiet)
        return
    if out is None:
        raise ConfigError("pachon baseline save: expected -o FILE, the baseline to write")
    from ..core.files import json_text
    from ..studies.baseline.baseline import make_baseline
    from ..studies.baseline.file import write_baseline
    from ..studies.baseline.metrics import CAMERA, OPTICS

    with interruptible(quiet or as_json) as reporter:
        count = len(OPTICS) + (0 if config is None else len(CAMERA))
        with reporter.stage("baseline", count) as stage:
            baseline, left_out = make_baseline(
                subject,
                out.parent,
                config,
                fields=field_list(field_deg),
                wavelengths=[nm / 1e9 for nm in wavelength_nm] if wavelength_nm else None,
                ccds=None if ccds is None else name_list(ccds, "--ccds"),
                threads=threads,
                advance=stage.advance,
            )
    write_baseline(out, baseline)
    for kind, why in left_out.items():
        typer.echo(f"pachon: warning: no figures of kind {kind}: {why}", err=True)
    if as_json:
        print(json_text({"baseline": str(out), "figures": len(baseline.figures), "left_out": left_out}))
    elif not quiet:
        print(f"{out}: {len(baseline.figures)} figures of {baseline.model}")


def _update(path: Path, threads: int | None, as_json: bool, quiet: bool) -> None:
    from ..core.files import json_text
    from ..studies.baseline.baseline import updated_baseline
    from ..studies.baseline.file import write_baseline

    with interruptible(quiet or as_json) as reporter, reporter.stage(str(path)) as stage:
        baseline, check = updated_baseline(path, threads=threads, advance=stage.advance)
    write_baseline(path, baseline)
    if as_json:
        print(json_text({"baseline": str(path), "updated": [d.name for d in check.out]}))
    elif not quiet:
        print(f"{path}: {len(check.out)} of {len(check.deviations)} figures updated")


def check_command(
    files: Annotated[
        list[Path] | None, typer.Argument(metavar="[FILE]...", help="Baselines; those that come along by default.")
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="Telescope in place of the baseline's own: bundled, or a path.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="RUN.yaml", help="Run configuration in place of the baseline's own.")
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Show all figures, not the worst alone.")] = False,
    threads: Threads = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compute the figures of baselines anew, and say which have moved by more than their tolerances.

    Worst first. Exit status 1 when a figure is out of tolerance. Without a file, the LSST's own baselines are checked,
    whose figures agree with Zemax, batoid and GalSim as far as those have them.

    **Examples**

    - `pachon check`: is this pachon the one that was verified?

    - `pachon check telescope.baseline.json`: after a change of the prescription, in CI

    - `pachon check telescope.baseline.json --model as_built.yaml --json`
    """
    from ..core.files import json_text
    from ..studies.baseline.baseline import bundled_baselines, check_baseline
    from ..studies.baseline.metrics import CAMERA, OPTICS

    if not files and (model is not None or config is not None):
        raise ConfigError("pachon check: expected a FILE with --model or --config")
    checks = []
    with interruptible(quiet or as_json) as reporter:
        for path in files or bundled_baselines():
            with reporter.stage(path.name, len(OPTICS) + len(CAMERA)) as stage:
                checks.append(check_baseline(path, model, config, threads=threads, advance=stage.advance))
    passed = all(check.passed for check in checks)
    if as_json:
        print(json_text({"passed": passed, "baselines": [check.summary() for check in checks]}))
    elif not quiet:
        for check in checks:
            print(check.text(everything))
    if not passed:
        raise typer.Exit(1)


COMMANDS = {"baseline": baseline_command, "check": check_command}
