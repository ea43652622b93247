"""The command ``pachon visits``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from .interrupt import interruptible
from .options import Ccds, Json, Quiet, Raft, Threads, one_name_list
from .tables import Rows, print_json

app = typer.Typer()

_CAPTION = (
    "Stacks of PSFs on the sky; rms of |e|. Residual: true PSF minus the mean of the models of the visits, at the "
    "stars and at places where no star is. Mean xi+ from 10' to 3 deg."
)


@app.command("visits")
def visits_command(
    config: Annotated[Path | None, Argument(metavar="CONFIG.yaml", help="Configuration; all has a default.")] = None,
    ccds: Ccds = None,
    raft: Raft = None,
    all_ccds: Annotated[bool, Option("--all", help="All CCDs of the camera.")] = False,
    count: Annotated[int | None, Option("--count", "-n", min=1, help="Visits; 10 by default.")] = None,
    dither_deg: Annotated[float | None, Option(help="Radius of the disc of the pointings [deg].")] = None,
    out: Annotated[Path, Option("--out", "-o", help="Folder of the stacks.")] = Path("pachon_visits"),
    seed: Annotated[int | None, Option(help="Seed of all random numbers.")] = None,
    resume: Annotated[bool, Option("--resume", help="Go on after the visits that are stacked already.")] = False,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Visit a field many times, each time rolled at random, and stack the PSFs: true ones and models (Figs. 15, 16).

    Telescope and CCD heights stay; turbulence, noise and roll change from visit to visit. A PSF model is fitted to the
    stars of each visit, and resampled onto the common axes as the images would be. The folder has the stacks of 1, 10,
    100 and all visits (FITS: PSFs and their shapes at every star and place), summary.json and two pictures.

    Without a configuration: r band of the LSST, the nine CCDs of the central raft.

    **Examples**

    - `pachon visits --raft R22`: ten visits of the central raft, a minute on two cores
    - `pachon visits --all -n 100 -o full`: 100 visits of 189 CCDs, two hours
    - `pachon visits --all -n 200 -o full --resume`: a hundred more
    - `pachon visits my_visits.yaml`, where my_visits.yaml may read

        run: {band: i, active_optics: {residual_um: 0.2}, reconstruction: {model: focal_plane}}
        visits: {count: 30, dither_deg: 0.3}
    """
    from ..pipeline.config import with_options
    from ..studies.visits.config import VisitsConfig, load_visits_configuration
    from ..studies.visits.visits import stack_visits

    names = one_name_list(ccds=ccds, raft=raft, all="all" if all_ccds else None)
    if config is None and names is None:
        names = ("R22",)
    base = VisitsConfig() if config is None else load_visits_configuration(config)
    settings = with_options(base, run__ccds=names, run__seed=seed, visits__count=count, visits__dither_deg=dither_deg)
    with interruptible(quiet, f"finished visits are in {out}, and --resume goes on from there") as reporter:
        result = stack_visits(settings, out, resume=resume, threads=threads, reporter=reporter)
    if as_json:
        print_json(result.summary)
    elif not quiet:
        _show(result.summary["stacks"])
        print(f"visits: {out.resolve()}")


def _show(stacks: dict[str, dict[str, Any]]) -> None:
    headings = ("visits", "points", "e of the PSF", "residual, stars", "residual, places", "xi+ of the PSF", "residual")
    keys = ("rms_e", "rms_residual_e_stars", "rms_residual_e_places")
    rows = [
        (
            visits,
            str(found["points"]),
            *(f"{found[key]:.1e}" for key in keys),
            *(f"{found[f'xi_plus_{k}_long']:.1e}" for k in ("psf", "residual_places")),
        )
        for visits, found in stacks.items()
    ]
    Rows(headings, rows, _CAPTION).show()
