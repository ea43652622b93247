"""The command ``pachon align``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option

from ..core.number_text import NumberText
from ..core.terminal import print_line
from .choices import choice
from .options import Config, Json, Quiet, TableFile, Threads, set_option
from .tables import Rows, print_json, write_rows
from .workers import long_work

app = typer.Typer()
_CAPTION = (
    "Root mean squares over pupil and field; late: the second half of the visits. g and T = Mxx + Myy are of adaptive "
    "moments, added to T of the telescope as designed; last, the weighted e of Jee & Tyson (2011), about half of g."
)


@app.command("align")
def align_command(
    config: Config = None,
    visits: Annotated[int | None, Option("--visits", "-n", min=1, help="Number of visits; 20 by default.")] = None,
    heights: Annotated[
        str | None, choice(("nominal", "lsstcam"), help="Heights of the wavefront sensors: nominal, or as built.")
    ] = None,
    believed_heights: Annotated[
        str | None,
        choice(("nominal", "lsstcam"), help="Heights that the estimate takes them to have; by default the true ones."),
    ] = None,
    gain: Annotated[
        float | None, Option(help="Fraction of the estimated state that is corrected; 1 by default.")
    ] = None,
    seed: Annotated[int | None, Option(help="Seed of all random numbers.")] = None,
    out: Annotated[Path, Option("--out", "-o", help="Folder to write to.")] = Path("pachon_align"),
    resume: Annotated[bool, Option("--resume", help="Go on with the visits in the folder.")] = False,
    settings: Annotated[list[str] | None, set_option("align")] = None,
    table: TableFile = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Keep a telescope aligned by the donuts of its corner rafts, visit after visit.

    Fifty degrees of freedom are off at first and drift. In each visit the eight halves of the wavefront sensors image a
    star each, through turbulence and with noise; Zernikes are fitted to the donuts, the state is estimated and
    corrected. Tables of visits, states and estimates (ECSV), summary.json, pictures and the configuration go into one
    folder. A visit takes 4 to 7 s of processor time. A killed loop goes on by --resume, to the same bytes, and so does
    one that is to have more visits.

    **Examples**

    - `pachon align`: 20 visits, two minutes
    - `pachon align -n 100 --heights lsstcam --believed-heights nominal -o ignored`: sensors as built, taken as nominal
    - `pachon align -n 200 --resume -o ignored`: a hundred visits more
    - `pachon align my_loop.yaml --set air.r0_m=0.12`: any key of `pachon config align`

    my_loop.yaml may read

        visits: 50
        errors: {initial: 3, gravity: 0.2}
        donuts: {electrons: 1e6, second_stars: 0.14}
        control: {gain: 0.7}
    """
    from ..core.set_keys import with_set_keys
    from ..pipeline.config import with_options
    from ..studies.alignment.config import AlignConfig, load_align_configuration
    from ..studies.alignment.loop import align
    from ..studies.alignment.product import alignment_summary, verdict, write_alignment

    base = with_set_keys(AlignConfig() if config is None else load_align_configuration(config), settings or ())
    align_config = with_options(
        base,
        visits=visits,
        donuts__heights=heights,
        donuts__believed_heights=believed_heights,
        control__gain=gain,
        seed=seed,
    )
    folder = None if config is None else config.parent
    hint = f"finished visits are in {out}, and --resume goes on from there"
    with long_work(quiet, hint, threads=threads, resume=resume) as execution:
        alignment = align(align_config, folder=folder, store=out, execution=execution)
    write_alignment(alignment, out)
    summary = alignment_summary(alignment)
    rows = _state_rows(summary, verdict(summary))
    write_rows(rows, table)
    if as_json:
        print_json(summary)
        return
    if not quiet:
        rows.show()
    print_line(f"alignment: {out.resolve()}")


#: Cells of rows that have no images.
_NO_IMAGES = ("",) * 4


def _state_rows(summary: dict[str, Any], sentence: str) -> Rows:
    """Return wavefront and images of the telescope as designed, at the floor, and in late visits."""
    rows = [
        (
            "as designed",
            NumberText(summary["designed_wavefront_nm"], ".0f"),
            "0",
            "0.0",
            "0.0",
            NumberText(1e3 * summary["designed_rms_g"], ".2f"),
            NumberText(1e3 * summary["designed_rms_e"], ".2f"),
        ),
        (
            "floor",
            NumberText(summary["floor_wavefront_nm"], ".0f"),
            NumberText(summary["floor_added_nm"], ".0f"),
            *_NO_IMAGES,
        ),
        (
            "late visits",
            NumberText(summary["late_wavefront_nm"], ".0f"),
            NumberText(summary["late_added_nm"], ".0f"),
            NumberText(summary["late_fwhm_added_mas"], ".1f"),
            NumberText(100 * summary["late_t_added_arcsec2"] / summary["designed_t_arcsec2"], ".1f"),
            NumberText(1e3 * summary["late_rms_g"], ".2f"),
            NumberText(1e3 * summary["late_rms_e"], ".2f"),
        ),
        (
            "worst late visit",
            NumberText(summary["late_worst_wavefront_nm"], ".0f"),
            NumberText(summary["late_worst_added_nm"], ".0f"),
            *_NO_IMAGES,
        ),
    ]
    headings = (
        "",
        "wavefront [nm]",
        "added [nm]",
        "FWHM added [mas]",
        "T added [%]",
        "rms g [1e-3]",
        "rms e [1e-3]",
    )
    return Rows(headings, rows, _CAPTION, verdict=sentence)
