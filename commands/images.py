"""The command ``pachon images``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from ..core.terminal import print_line
from .choices import choice
from .night import Bands, ListFile, Night, VisitNumber, Where, listed_visit, require_list
from .options import AllCcds, Ccds, Config, Json, Quiet, Raft, TableFile, Threads, chosen_ccds, set_option
from .tables import Rows, print_json, write_rows
from .verdicts import images_verdict
from .workers import DaskWorkers, Processes, Scheduler, long_work

app = typer.Typer()
ImagesSettings = Annotated[list[str] | None, set_option("images")]

#: Settings of --quick: the mean over all turbulence, the middle of a CCD, galaxies that a few minutes would show.
_QUICK = {"run__psf__engine": "long_exposure", "galaxies__faintest": 26.0}
#: Side of the images of --quick [pixels], where none is set and CCDs are not smaller.
_QUICK_SIDE = 1024


@app.command("images")
def images_command(
    config: Config = None,
    ccds: Ccds = None,
    raft: Raft = None,
    all_ccds: AllCcds = False,
    out: Annotated[Path, Option("--out", "-o", help="Folder of the images.")] = Path("pachon_images"),
    exposures: Annotated[int | None, Option(min=1, help="Exposures of the run's time that are summed.")] = None,
    way: Annotated[
        str | None,
        choice(
            ("direct", "eigen"),
            help="direct: each galaxy under its own PSF; eigen: the image, component by component.",
        ),
    ] = None,
    noise: Annotated[bool | None, Option("--noise/--no-noise", help="With noise, or the expected image.")] = None,
    faintest: Annotated[float | None, Option(help="Faintest galaxy [AB mag].")] = None,
    visit_list: ListFile = None,
    visit: VisitNumber = None,
    where: Where = None,
    band: Bands = None,
    night: Night = None,
    seed: Annotated[int | None, Option(help="Seed of all random numbers.")] = None,
    quick: Annotated[
        bool, Option("--quick", help="The middle of each CCD, galaxies to magnitude 26, long-exposure PSF: seconds.")
    ] = False,
    resume: Annotated[bool, Option("--resume", help="Keep the CCDs that are finished, draw the others.")] = False,
    processes: Processes = None,
    scheduler: Scheduler = None,
    workers: DaskWorkers = None,
    table: TableFile = None,
    settings: ImagesSettings = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Make FITS images of the sky as a telescope sees it: galaxies and stars under the PSF of a run, with noise.

    Without a configuration: r band of the LSST, 15 s, all galaxies to magnitude 29, the nine CCDs of `pachon run`.

    Each CCD gets image_CCD.fits (image, variance, mask, world coordinates, table of all objects), a picture of it, and
    cutouts_CCD.png: the middle in one exposure, in 6000 s and without noise. images.yaml has every default written out.

    **Examples**

    - `pachon images --ccds R22_S11 --quick -o first_look`: the middle of a CCD, within seconds
    - `pachon images --ccds R22_S11`: one whole CCD, a minute on two cores
    - `pachon images --all --faintest 27 -o field --processes 2`: the whole focal plane, 31 GB
    - `pachon images --ccds R22_S11 --exposures 400 -o deep`: 400 exposures of 15 s
    - `pachon images --ccds R22_S11 --set run.band=i --set image.sky_mag=20.8`: any key of `pachon config images`
    - `pachon images --ccds R22_S11 --no-noise --way eigen -o expected`
    - `pachon images my_images.yaml -o field --resume`: go on where it was stopped
    - `pachon images --list baseline.db --visit 1004 --ccds R22_S11 -o visit1004`: a visit of a scheduler's list
    - `pachon images my_images.yaml -o field --scheduler tcp://login1:8786`: on a Dask cluster, or `--processes 4`

    my_images.yaml may read

        run: {band: i, ccds: [R22], seed: 7}   # or the path of its file
        pointing: {ra_deg: 53.1, dec_deg: -27.8, position_angle_deg: 30}
        galaxies: {faintest: 27}               # or {catalogue: galaxies.ecsv}
        image: {exposures: 100, gain: 1.6, sky_mag: 20.8}
    """
    from ..core.set_keys import with_set_keys
    from ..imaging.config import ImagesConfig, load_images_configuration, with_files
    from ..imaging.simulate import simulate_images
    from ..pipeline.config import with_options

    folder = None if config is None else config.parent
    base = ImagesConfig() if config is None else load_images_configuration(config)
    if quick:
        base = with_options(base, **_QUICK)
    if settings:
        base = with_files(with_set_keys(base, settings), folder or Path())
    options = {
        "run__ccds": chosen_ccds(ccds, raft, all_ccds),
        "run__seed": seed,
        "image__exposures": exposures,
        "image__way": way,
        "image__noise": noise,
        "galaxies__faintest": faintest,
    }
    images_config = with_options(base, **options)
    if visit_list is None:
        require_list(("--visit", visit), ("--where", where), ("--band", band), ("--night", night))
    else:
        images_config = images_config.of_visit(
            listed_visit(images_config.run, visit_list, visit, where, band, night, folder), folder
        )
    experiment = images_config.experiment(folder)
    if quick and images_config.image.side is None:
        side = min(_QUICK_SIDE, int(experiment.camera.pixels.min()))
        images_config = with_options(images_config, image__side=side)
    hint = f"finished CCDs are in {out}, and --resume goes on from there"
    with long_work(
        quiet, hint, threads=threads, resume=resume, processes=processes, scheduler=scheduler, dask=workers
    ) as execution:
        result = simulate_images(images_config, out, experiment=experiment, execution=execution)
    images = {name: str(path.resolve()) for name, path in result.images.items()}
    rows = Rows(
        ("CCD", "objects"),
        [(name, str(result.objects.get(name, "kept"))) for name in images],
        "Stars and galaxies whose centres lie on the image.",
        verdict=images_verdict(result.objects, len(images)),
    )
    write_rows(rows, table)
    if as_json:
        print_json({"images": images, "objects": result.objects, "kept": list(result.kept)})
    elif not quiet:
        rows.show()
        print_line(f"images: {out.resolve()}")
