"""The command ``pachon shim``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from typer import Option

from ..core.errors import ConfigError
from ..core.number_text import NumberText
from ..core.terminal import print_line
from . import completion
from .choices import choice, names
from .inputs import configuration, configured_experiment
from .interrupt import interruptible
from .options import Ccds, Config, Json, Quiet, Raft, Settings, TableFile, Threads, one_name_list
from .tables import Rows, print_json, write_rows
from .verdicts import shim_verdict

if TYPE_CHECKING:
    from ..studies.shimming.shim import ShimmedParts, ShimMerit, Shims

app = typer.Typer()
_CAPTION = (
    "Mean over the area of the CCDs of the long-exposure PSF, at places that the fit did not use. Focused: moved as a "
    "whole, which needs no shims. Plane: CCDs without heights, focused. g and T = Mxx + Myy are of adaptive moments, "
    "xi+ of g: rms over logarithmic bins of separation. Last, the weighted e of Jee & Tyson (2011), about half of g."
)


@app.command("shim")
def shim_command(
    config: Config = None,
    ccds: Ccds = None,
    raft: Raft = None,
    heights: Annotated[
        str | None,
        names(
            completion.heights,
            metavar="lsstcam|FILE",
            help="Measured heights: as built, or an ECSV or FITS file; those of the configuration.",
        ),
    ] = None,
    merit: Annotated[
        str,
        choice(
            ("fwhm", "ellipticity", "xi"),
            "--minimise",
            "--merit",
            help="Mean FWHM, rms of g, or rms of its correlation.",
        ),
    ] = "fwhm",
    parts: Annotated[str, choice(("rafts", "ccds"), help="What moves.")] = "rafts",
    out: Annotated[Path, Option("--out", "-o", help="Folder to write to.")] = Path("pachon_shims"),
    table: TableFile = None,
    settings: Settings = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Find by how much rafts or CCDs should move for the sharpest, roundest or least correlated images.

    Telescope, band, heights and seeing are those of the configuration; all CCDs are used unless it or an option names
    some. Motions (shims.ecsv), gains (shims.json), a plot, and the configuration with the shims go into one folder.

    **Examples**

    - `pachon shim --heights lsstcam`: rafts of LSSTCam as built, half a minute
    - `pachon shim my_config.yaml --parts ccds --minimise ellipticity`
    - `pachon shim --heights lsstcam --minimise xi`: a smaller correlation of ellipticities over the focal plane
    - `pachon run pachon_shims/config.yaml --out shimmed`: the run with the shims
    """
    from ..core.files import make_folder
    from ..studies.shimming.product import shim_metrics, write_shims
    from ..studies.shimming.shim import shim

    ccd_names = one_name_list(ccds=ccds, raft=raft) or configuration(config, settings).ccds or ("all",)
    experiment = configured_experiment(
        config, settings, ccds=ccd_names, focal_plane__heights=heights, psf__engine="long_exposure"
    )
    make_folder(out)
    with interruptible(quiet) as reporter:
        try:
            shims = shim(
                experiment,
                merit=cast("ShimMerit", merit),
                parts=cast("ShimmedParts", parts),
                threads=threads,
                reporter=reporter,
            )
        except ConfigError as error:
            raise error.renamed("--parts") if error.key == "parts" else error from None
    write_shims(shims, out, experiment)
    rows = _state_rows(shims)
    write_rows(rows, table)
    if as_json:
        print_json(shim_metrics(shims))
        return
    if not quiet:
        rows.show()
    print_line(f"shims: {out.resolve()}")


def _state_rows(shims: Shims) -> Rows:
    """Return the means over the focal plane: as it is, focused, shimmed, and without heights."""
    from ..studies.shimming.shim import STATES

    checked = shims.checked
    reference = checked["focused"].fwhm
    rows = [
        (
            state,
            NumberText(m.fwhm, ".4f"),
            NumberText(1e3 * (m.fwhm - reference), "+.2f"),
            NumberText(m.size, ".4f"),
            NumberText(1e3 * m.rms_g, ".2f"),
            NumberText(1e6 * m.rms_xi_g, ".2f"),
            NumberText(1e3 * m.rms_e, ".2f"),
        )
        for state, m in ((state, checked[state]) for state in STATES)
    ]
    headings = (
        "focal plane",
        "mean FWHM [arcsec]",
        "less focused [mas]",
        "mean T [arcsec²]",
        "rms g [1e-3]",
        "rms xi+ of g [1e-6]",
        "rms e [1e-3]",
    )
    sentence = shim_verdict(shims.merit, shims.parts, checked["focused"], checked["shimmed"])
    return Rows(headings, rows, _CAPTION, verdict=sentence)
