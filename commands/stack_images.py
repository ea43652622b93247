"""The command ``pachon stack-images``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from ..core.errors import ConfigError, PachonError
from ..core.number_text import NumberText, number_with_error
from ..core.terminal import print_line
from .options import Json, Quiet, TableFile, Threads
from .tables import Rows, print_json, write_rows
from .verdicts import stack_verdict
from .workers import DaskWorkers, Processes, Scheduler, long_work

app = typer.Typer()

_CAPTION = (
    "Per square arcminute: detected objects that are no stars, galaxies usable for shear on the images, and on stamps "
    "of their own; mean difference of the ellipticities of those usable on both, and of their responses."
)


@app.command("stack-images")
def stack_images_command(
    folder: Annotated[Path, Argument(metavar="FOLDER", help="Folder of pachon visits.")],
    tiles: Annotated[int | None, Option(min=1, help="Most tiles of the sky, from the pointing outwards; 1.")] = None,
    faintest: Annotated[
        float | None, Option(help="Faintest galaxy [AB mag]; by default that of S/N 4 in the stack of all visits.")
    ] = None,
    side: Annotated[int | None, Option(min=64, help="Pixels along a side of a tile; those of a CCD.")] = None,
    noise: Annotated[bool | None, Option("--noise/--no-noise", help="With noise, or expected images.")] = None,
    measure: Annotated[bool, Option("--measure/--no-measure", help="Measure the galaxies of the stacks.")] = True,
    resume: Annotated[bool, Option("--resume", help="Go on after the visits that are stacked already.")] = False,
    processes: Processes = None,
    scheduler: Scheduler = None,
    workers: DaskWorkers = None,
    table: TableFile = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Draw the images of visits and stack them: galaxies and stars, resampled onto common pixels, and measured.

    The CCDs of every visit that see the tiles are drawn with the stars of `pachon visits` and galaxies like those of
    the Hubble Ultra Deep Field, at the roll and the pointing of the visit, with noise. Their images are resampled as
    the PSFs of the visits are. The stacks of 1, 10, 100 and all visits become FITS images; on them galaxies are
    detected and measured with the PSF of the models of the visits, beside the same galaxies on stamps of their own.

    Images, tables of galaxies, images.json (with the correlations of the ellipticities, as of `pachon null-test`) and
    pictures go into the folder images of the visits.

    **Examples**

    - `pachon visits -o deep -n 10`, then `pachon stack-images deep`: the size of one CCD, ten minutes on two cores
    - `pachon stack-images deep --side 1024 --no-measure`: only 3.4 arcminutes, too few stars to measure, a few minutes
    - `pachon stack-images deep --resume`: go on where it was stopped, or with the visits added since
    """
    from ..pipeline.config import with_options
    from ..studies.visits.image_stack.config import ImageStackConfig
    from ..studies.visits.image_stack.measure import measure_stack
    from ..studies.visits.image_stack.stack_images import stack_images

    settings = with_options(ImageStackConfig(), tiles=tiles, faintest=faintest, side=side, noise=noise)
    if table is not None and not measure:
        raise ConfigError("--table with --no-measure: expected one of them, without galaxies there is no table")
    hint = f"finished visits are in {folder}, and --resume goes on from there"
    with long_work(
        quiet, hint, threads=threads, resume=resume, processes=processes, scheduler=scheduler, dask=workers
    ) as execution:
        stack = stack_images(folder, settings, execution=execution)
        try:
            metrics_by_visits = measure_stack(folder, execution=execution) if measure else {}
        except PachonError as error:
            raise error.followed_by(
                f"the stacked images are kept in {stack.folder}, not all of them measured (--no-measure)"
            ) from None
    metrics = {str(visits): figures for visits, figures in metrics_by_visits.items()}
    rows = _stack_rows(metrics)
    write_rows(rows, table)
    if as_json:
        print_json({"folder": str(stack.folder.resolve()), "stacks": metrics})
    elif not quiet:
        if metrics:
            rows.show()
        print_line(f"images: {stack.folder.resolve()}")


def _stack_rows(metrics: dict[str, dict[str, Any]]) -> Rows:
    rows = []
    shifts: list[str]
    response: str
    for visits, stack_metrics in metrics.items():
        densities = [
            NumberText(stack_metrics[key], ".1f")
            for key in ("detected_per_arcmin2", "usable_per_arcmin2", "usable_per_arcmin2_stamps")
        ]
        if stack_metrics["pairs"]:
            error = stack_metrics["mean_difference_error"]
            shifts = [number_with_error(stack_metrics[f"mean_difference_{e}"], error, ".4f") for e in ("e1", "e2")]
            response = number_with_error(
                stack_metrics["response_difference"], stack_metrics["response_difference_error"], ".3f"
            )
        else:
            shifts, response = ["", ""], ""
        rows.append((visits, *densities, *shifts, response))
    headings = (
        "visits",
        *(f"{name} [1/arcmin²]" for name in ("detected", "usable", "on stamps")),
        *("e1 difference", "e2 difference", "response"),
    )
    return Rows(headings, rows, _CAPTION, verdict=stack_verdict(metrics) if metrics else "")
