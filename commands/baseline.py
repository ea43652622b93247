"""The commands ``pachon baseline save``, ``baseline update`` and ``check``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ..core.errors import ConfigError
from ..core.number_text import counted
from ..core.terminal import print_line, print_warning
from . import completion
from .choices import names
from .help_group import HelpGroup
from .interrupt import interruptible
from .options import (
    FieldsDeg,
    Json,
    Model,
    Quiet,
    Settings,
    Threads,
    WavelengthsNm,
    ccd_list,
    field_list,
    name_list,
    yaml_file,
)
from .tables import print_json

app = typer.Typer()
baseline_app = typer.Typer(cls=HelpGroup)
app.add_typer(baseline_app, name="baseline")


@baseline_app.callback()
def baseline_group() -> None:
    """Store the metrics of a telescope, for `pachon check` to compare with.

    Wavefront, landing points, Zernikes, spots, encircled energy, distortion and vignetting; with a configuration also
    the height of every CCD and its effect on the wavefront, PSFs, and the residuals of a PSF model. Each has a
    tolerance with its reason, and a line of its own in the file.

    **Examples**

    - `pachon baseline save lsst_v3.3_r -o lsst.baseline.json`
    - `pachon baseline save telescope.yaml -o telescope.baseline.json --config run.yaml`
    - `pachon baseline update telescope.baseline.json`: new values where out of tolerance, all else stays
    """


@baseline_app.command("save")
def baseline_save(
    model: Model,
    out: Annotated[Path, Option("--out", "-o", help="Baseline to write, NAME.baseline.json.")],
    config: Annotated[
        Path | None, yaml_file("RUN.yaml", "Run configuration, by its file: adds heights, PSFs, a PSF model.")
    ] = None,
    settings: Settings = None,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthsNm = None,
    ccds: Annotated[str | None, ccd_list("CCDs for PSFs, with commas; the first is modelled.")] = None,
    tolerance: Annotated[
        list[str] | None,
        names(
            completion.metrics,
            metavar="TEXT",
            help="Tolerance: '1 %' of all values, or 'spot rms = 0.1 um'; again for more.",
        ),
    ] = None,
    limit: Annotated[
        list[str] | None,
        names(completion.metrics, metavar="TEXT", help="Requirement: 'spot rms < 10 um'; again for more."),
    ] = None,
    threads: Threads = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compute the metrics of a telescope, and write them with their tolerances and limits.

    By default the tolerance of a metric is what another machine may change. `--tolerance` gives a wider one, `--limit`
    a requirement that the metric must meet: both of all metrics whose names begin with the words given.

    **Examples**

    - `pachon baseline save telescope.yaml -o telescope.baseline.json --config run.yaml --ccds R22_S11,R02_S01`
    - `pachon baseline save telescope.yaml -o design.baseline.json --tolerance "1 %" --limit "spot rms < 10 um"`
    """
    from ..studies.baseline.baseline import make_baseline
    from ..studies.baseline.file import write_baseline
    from ..studies.baseline.requirements import Requirements
    from ..studies.metrics.camera import CAMERA
    from ..studies.metrics.optics import OPTICS

    count = len(OPTICS) + (0 if config is None else len(CAMERA))
    with interruptible(quiet or as_json) as reporter, reporter.stage("baseline", count) as stage:
        baseline, left_out = make_baseline(
            model,
            out.parent,
            config,
            fields=field_list(field_deg),
            wavelengths=[nm / 1e9 for nm in wavelength_nm] if wavelength_nm else None,
            ccds=None if ccds is None else name_list(ccds, "--ccds"),
            requirements=Requirements(tuple(tolerance or ()), tuple(limit or ())),
            settings=settings or (),
            threads=threads,
            progress=stage.advance,
        )
    write_baseline(out, baseline)
    for kind, why in left_out.items():
        print_warning(f"no metrics of kind {kind}: {why}")
    broken = [name for name, m in baseline.figures.items() if m.limit is not None and not m.limit.holds(m.value)]
    _warn_broken(broken)
    if as_json:
        print_json({"baseline": str(out), "figures": len(baseline.figures), "left_out": left_out})
    elif not quiet:
        print_line(f"{out}: {counted(len(baseline.figures), 'metric')} of {baseline.model}")


@baseline_app.command("update")
def baseline_update(
    path: Annotated[Path, Argument(metavar="FILE", help="Baseline to update.")],
    threads: Threads = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Accept changed metrics: new values for those out of tolerance, all else stays.

    **Examples**

    - `pachon baseline update telescope.baseline.json`
    """
    from ..studies.baseline.baseline import updated_baseline
    from ..studies.baseline.file import write_baseline

    with interruptible(quiet or as_json) as reporter, reporter.stage(str(path)) as stage:
        baseline, check = updated_baseline(path, threads=threads, progress=stage.advance)
    write_baseline(path, baseline)
    _warn_broken([d.name for d in check.deviations if d.broken])
    if as_json:
        print_json({"baseline": str(path), "updated": [d.name for d in check.moved]})
    elif not quiet:
        print_line(f"{path}: {len(check.moved)} of {counted(len(check.deviations), 'metric')} updated")


def _warn_broken(names: list[str]) -> None:
    """Print a warning for metrics that do not meet their requirements."""
    if names:
        print_warning(f"{counted(len(names), 'metric is', 'metrics are')} beyond their limits, such as {names[0]}")


@app.command("check")
def check_command(
    files: Annotated[list[Path] | None, Argument(metavar="FILE", help="Baselines; the bundled by default.")] = None,
    model: Annotated[
        str | None,
        names(completion.models, metavar="MODEL", help="Telescope in place of the baseline's own: bundled, or a path."),
    ] = None,
    config: Annotated[
        Path | None, yaml_file("RUN.yaml", "Run configuration, by its file, in place of its own.")
    ] = None,
    settings: Settings = None,
    everything: Annotated[bool, Option("--all", help="Show all metrics, not the worst alone.")] = False,
    threads: Threads = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compute the metrics of baselines again, and list those that are out of tolerance or beyond their limits.

    By cause: requirements broken, metrics missing, inputs changed; worst first. Exit status 1 when there are any.
    Without a file, the bundled baselines of the LSST are checked, whose metrics agree with Zemax, batoid and GalSim as
    far as those have them.

    **Examples**

    - `pachon check`: does this installation agree with the one that was verified?
    - `pachon check telescope.baseline.json`: after a change of the prescription, in CI
    - `pachon check telescope.baseline.json --model as_built.yaml --json`
    - `pachon check telescope.baseline.json --set seed=2`: with another value of a key of its configuration
    """
    from ..studies.baseline.baseline import bundled_baselines, check_baseline
    from ..studies.metrics.camera import CAMERA
    from ..studies.metrics.optics import OPTICS

    if not files and (model is not None or config is not None or settings):
        raise ConfigError("pachon check: expected a FILE with --model, --config or --set")
    checks = []
    with interruptible(quiet or as_json) as reporter:
        for path in files or bundled_baselines():
            with reporter.stage(path.name, len(OPTICS) + len(CAMERA)) as stage:
                checks.append(
                    check_baseline(
                        path, model, config, settings=settings or (), threads=threads, progress=stage.advance
                    )
                )
    passed = all(check.passed for check in checks)
    if as_json:
        print_json({"passed": passed, "baselines": [check.summary() for check in checks]})
    elif not quiet:
        for check in checks:
            print_line(check.text(everything))
    if not passed:
        raise typer.Exit(1)
