"""The command ``pachon design-report``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Option

from ...core.terminal import print_line
from ..interrupt import interruptible
from ..options import AcrossBand, FieldsDeg, Lenient, Model, Quiet, Threads, WavelengthsNm
from .command import SharedOptions, app


@app.command("design-report")
def design_report_command(
    model: Model,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Page to write, .html; by default design_report_MODEL.html.")
    ] = None,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthsNm = None,
    across_band: AcrossBand = None,
    lenient: Lenient = False,
    threads: Threads = None,
    quiet: Quiet = False,
) -> None:
    """Write the design report: prescription, first-order data, layout and all analyses in one page that prints well.

    **Examples**

    - `pachon design-report my_lens.zmx`
    - `pachon design-report lsst_v3.3_r -o lsst.html --field-deg 0 --field-deg 1.2 --field-deg 1.75 --across-band 3`
    """
    from ...core.files import require_writable, write_bytes
    from ...design.report.report import STEPS, design_report

    shared = SharedOptions(model, field_deg, wavelength_nm, across_band, lenient=lenient)
    telescope, fields, wavelengths = shared.first_arguments
    path = out or Path(f"design_report_{shared.stem}.html")
    require_writable(path, file=True)
    with interruptible(quiet) as reporter, reporter.stage("design report", STEPS) as stage:
        page = design_report(telescope, fields, wavelengths, threads=threads, progress=stage.advance)
    write_bytes(path, page.encode())
    if not quiet:
        print_line(f"report: {path.resolve()}")
