"""The command ``pachon visits``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ..core.errors import ConfigError
from ..core.number_text import NumberText, number_with_error
from ..core.terminal import print_line
from . import completion
from .choices import names
from .night import Bands, ListFile, Night, Where, names_list, night_settings, part_of, require_list, show_night
from .options import (
    AllCcds,
    Ccds,
    Config,
    Json,
    Quiet,
    Raft,
    TableFile,
    Threads,
    chosen_ccds,
    refuse_stated,
    set_option,
)
from .tables import Rows, print_json, write_rows
from .verdicts import null_verdict, visits_verdict
from .workers import DaskWorkers, Processes, Scheduler, long_work

app = typer.Typer()

_CAPTION = (
    "Stacks of PSFs on the sky; rms of |g| and of (T - T model)/T of adaptive moments. Residual: true PSF minus the "
    "mean of the models of the visits, at the stars and at places where no star is. Mean ξ+ from 10' to 3 deg. Last, "
    "the weighted e of Jee & Tyson (2011), where no star is."
)

_NULL_CAPTION = (
    "Fits of Gaussians: usable galaxies; mean |ξ+| over all separations; ξ+ of the difference of ellipticities by the "
    "PSF of the models and by the true PSF, beyond 10'; biases of the shear with either."
)
_SHEAR_CAPTION = (
    "Functionals: galaxies with weight; ξ+ of the difference of the shears by the PSF of the models and by the true "
    "PSF, within and beyond 10'; biases with the true PSF; part of the PSF's ellipticity, and of the models' error of "
    "it, in the shear."
)


@app.command("visits")
def visits_command(
    config: Config = None,
    ccds: Ccds = None,
    raft: Raft = None,
    all_ccds: AllCcds = False,
    count: Annotated[int | None, Option("--count", "-n", min=1, help="Visits; 10 by default.")] = None,
    dither_deg: Annotated[float | None, Option(help="Radius of the disc of the pointings [deg].")] = None,
    roll: Annotated[
        str | None,
        names(
            completion.words("random"),
            metavar="random|DEG,...",
            help="Position angles of the telescope: random, or one for each visit, as 0,90.",
        ),
    ] = None,
    rotator: Annotated[
        str | None,
        names(
            completion.words("random"),
            metavar="random|DEG,...",
            help="Angles of the camera against the telescope: random, or one for each visit.",
        ),
    ] = None,
    out: Annotated[Path, Option("--out", "-o", help="Folder of the stacks.")] = Path("pachon_visits"),
    visit_list: ListFile = None,
    where: Where = None,
    band: Bands = None,
    night: Night = None,
    stack: Annotated[
        bool, Option("--stack", help="Of a list of one field and band: stack its PSFs, as without a list.")
    ] = False,
    models: Annotated[
        bool | None, Option("--models/--no-models", help="Of a list: with PSF models, or without.")
    ] = None,
    products: Annotated[bool, Option("--products", help="Of a list: keep stars, PSFs and models of each CCD.")] = False,
    nside: Annotated[int | None, Option(min=0, help="Of a list: HEALPix resolution of the maps, 0 for none.")] = None,
    part: Annotated[
        str | None, Option(metavar="I/N", help="Of a list: compute the I-th of N parts; all share the folder.")
    ] = None,
    seed: Annotated[int | None, Option(help="Seed of all random numbers.")] = None,
    resume: Annotated[bool, Option("--resume", help="Go on after the visits that are finished already.")] = False,
    processes: Processes = None,
    scheduler: Scheduler = None,
    workers: DaskWorkers = None,
    table: TableFile = None,
    settings: Annotated[list[str] | None, set_option("visits")] = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Visit a field many times, each time rolled at random, and stack the PSFs: true ones and models (Figs. 15, 16).

    Telescope and CCD heights stay; turbulence, noise and roll change from visit to visit. A PSF model is fitted to the
    stars of each visit, and resampled onto the common axes as the images would be. The folder has the stacks of 1, 10,
    100 and all visits (FITS: PSFs and their shapes at every star and place), summary.json and two pictures.

    Where the configuration leaves them open: r band of the LSST, the nine CCDs of the central raft.

    **Examples**

    - `pachon visits --raft R22`: ten visits of the central raft, a minute on two cores
    - `pachon visits --all -n 100 -o full`: 100 visits of 189 CCDs, an hour and a half
    - `pachon visits --all -n 200 -o full --resume --processes 2`: a hundred more, two visits side by side
    - `pachon visits --rotator random`: the camera turned against the telescope too, by up to 90 degrees
    - `pachon visits -n 2 --roll 0,0 --rotator 0,45`: a telescope that stands still on the sky, its camera turned
    - `pachon visits my_visits.yaml --set run.band=i`: any key of `pachon config visits`
    - `pachon visits --list baseline.db --where "night = 5" --band r,i --raft R22 -o night5`: visits of a scheduler,
      each with its own pointing, angles, band, time and air; a table of PSF and depth, and maps of the sky
    - `pachon visits --list ddf.db --band r --stack -o ddf`, `pachon null-test ddf`: the visits to one field, stacked
    - `pachon visits --list visits.csv -o night --part 3/8`: one of eight jobs of a batch system, all in one folder

    my_visits.yaml may read

        run:
          band: i
          active_optics: {residual_um: 0.2}
          reconstruction: {model: focal_plane}
        visits: {count: 30, dither_deg: 0.3}
    """
    from ..core.set_keys import with_set_keys
    from ..pipeline.config import with_options
    from ..studies.night.config import ListSection
    from ..studies.night.night import run_night
    from ..studies.visits.config import VisitsConfig, load_visits_configuration
    from ..studies.visits.visits import stack_visits

    ccd_names = chosen_ccds(ccds, raft, all_ccds)
    if stack:
        require_list(("--stack", None if visit_list is not None else stack))
        excluded: dict[str, object] = {
            "--nside": nside,
            "--part": part,
            "--products": products or None,
            "--models": models,
        }
        excluded |= {"--count": count, "--dither-deg": dither_deg, "--roll": roll, "--rotator": rotator}
        refuse_stated(excluded, " with --stack: expected none")
    elif visit_list is not None or (config is not None and names_list(config)):
        stack_options = {"--count": count, "--dither-deg": dither_deg, "--roll": roll, "--rotator": rotator}
        refuse_stated(stack_options, " with a list: expected none, visits of a list have their own")
        night_config = night_settings(
            config,
            settings,
            run__ccds=ccd_names,
            run__seed=seed,
            visits__list=None if visit_list is None else str(visit_list.resolve()),
            visits__where=where,
            visits__band=band,
            visits__night=night,
            maps__nside=nside,
            models=models,
            products=products or None,
        )
        hint = f"finished visits are in {out}, and --resume goes on from there"
        with long_work(
            quiet, hint, threads=threads, resume=resume, processes=processes, scheduler=scheduler, dask=workers
        ) as execution:
            base_folder = None if config is None else config.parent
            night_result = run_night(night_config, out, base=base_folder, part=part_of(part), execution=execution)
        show_night(night_result, out, table, quiet=quiet, as_json=as_json)
        return
    if not stack:
        require_list(
            *(("--where", where), ("--band", band), ("--night", night), ("--nside", nside), ("--part", part)),
            *(("--products", products or None), ("--models", models)),
        )
    base = with_set_keys(VisitsConfig() if config is None else load_visits_configuration(config), settings or ())
    visits_config = with_options(
        base,
        run__ccds=ccd_names,
        run__seed=seed,
        visits__count=count,
        visits__dither_deg=dither_deg,
        visits__roll_deg=angles_of("--roll", roll),
        visits__rotator_deg=angles_of("--rotator", rotator),
    )
    folder = None if config is None else config.parent
    if visit_list is not None:
        listed = ListSection(list=str(visit_list.absolute()), where=where, band=band, night=night)
        visits_config = visits_config.with_list(listed, folder)
    else:
        visits_config = visits_config.with_named_list(folder)
    experiment = visits_config.experiment(folder)
    hint = f"finished visits are in {out}, and --resume goes on from there"
    with long_work(
        quiet, hint, threads=threads, resume=resume, processes=processes, scheduler=scheduler, dask=workers
    ) as execution:
        result = stack_visits(visits_config, out, experiment=experiment, execution=execution)
    rows = _stack_rows(result.summary["stacks"])
    write_rows(rows, table)
    if as_json:
        print_json(result.summary)
    elif not quiet:
        rows.show()
        print_line(f"visits: {out.resolve()}")


def angles_of(option: str, text: str | None) -> str | tuple[float, ...] | None:
    """Return the angles of an option [deg], or the word random."""
    if text is None or text == "random":
        return text
    try:
        return tuple(float(angle) for angle in text.split(","))
    except ValueError:
        raise ConfigError(f"{option} = {text}: expected random, or angles in degrees with commas between") from None


def _stack_rows(stacks: dict[str, dict[str, float]]) -> Rows:
    columns = {
        "g of the PSF": "rms_g",
        "residual, stars": "rms_residual_g_stars",
        "residual, places": "rms_residual_g_places",
        "dT/T": "rms_dt_g_places",
        "ξ+ of the PSF": "xi_plus_psf_g_long",
        "ξ+, residual": "xi_plus_residual_places_g_long",
        "weighted e": "rms_e",
        "e, residual": "rms_residual_e_places",
        "ξ+ of e, residual": "xi_plus_residual_places_long",
    }
    headings = ("visits", "points", *columns)
    rows = [
        (visits, str(stack_metrics["points"]), *(NumberText(stack_metrics[key], ".1e") for key in columns.values()))
        for visits, stack_metrics in stacks.items()
    ]
    return Rows(headings, rows, _CAPTION, verdict=visits_verdict(stacks))


@app.command("null-test")
def null_test_command(
    folder: Annotated[Path, Argument(metavar="FOLDER", help="Folder of pachon visits.")],
    tiles: Annotated[int | None, Option(min=1, help="Most tiles of the sky, from the pointing outwards.")] = None,
    rings: Annotated[int, Option(min=10, help="Rings of galaxies for the calibration of the shear.")] = 2000,
    resume: Annotated[bool, Option("--resume", help="Keep the tiles that are finished.")] = False,
    processes: Processes = None,
    scheduler: Scheduler = None,
    workers: DaskWorkers = None,
    table: TableFile = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Measure galaxies in stacks of visits, and correlate ellipticities that no shear has touched (Figs. 17, 18).

    Galaxies like those of the Hubble Ultra Deep Field are drawn under the true PSF of the stack and measured twice,
    with the PSF of the models and with the true one: the difference is what the PSF models do to the shear. Each time
    by a Gaussian, as in the paper, and by linear functionals without bias. Rings of galaxies under a shear of 0.02 give
    the multiplicative and the additive bias of all. Each galaxy has a stamp of its own; neighbours are left out.

    Tables of galaxies, null_test.json and two pictures go into the folder of the visits. A tile takes ten seconds in a
    stack of one visit, and up to a minute in one of a hundred, which shows more galaxies.

    **Examples**

    - `pachon null-test pachon_visits`: all stacks that the folder has
    - `pachon null-test full --tiles 20 --resume`
    """
    from ..studies.visits.null_result import null_metrics
    from ..studies.visits.null_test import null_test

    hint = f"finished tiles are in {folder}, and --resume goes on from there"
    with long_work(
        quiet, hint, threads=threads, resume=resume, processes=processes, scheduler=scheduler, dask=workers
    ) as execution:
        results = null_test(folder, tiles=tiles, rings=rings, execution=execution)
    metrics_by_visits = {str(visits): null_metrics(result) for visits, result in results.items()}
    rows = _null_rows(metrics_by_visits)
    write_rows(rows, table)
    if as_json:
        print_json({"stacks": metrics_by_visits})
    elif not quiet:
        rows.show()
        _show_shears(metrics_by_visits)
        print_line(f"null test: {folder.resolve()}")


def _null_rows(metrics_by_visits: dict[str, dict[str, float]]) -> Rows:
    """Return what Gaussians measure, stack by stack."""
    keys = ("mean_abs_xi_plus", "shot_noise_xi_plus", "xi_plus_difference_long")
    rows = []
    for visits, metrics in metrics_by_visits.items():
        biases = [
            number_with_error(metrics[name], metrics[f"{name}_error"], ".4f")
            for name in ("m1_model", "c1_model", "m1_true", "c1_true")
        ]
        density = NumberText(metrics["usable_per_arcmin2"], ".1f")
        rows.append((visits, density, *(NumberText(metrics[key], ".1e") for key in keys), *biases))
    headings = ("visits", "usable [1/arcmin²]", "|ξ+|", "shot noise", "difference", "m1", "c1", "m1 true", "c1 true")
    return Rows(headings, rows, _NULL_CAPTION, verdict=null_verdict(metrics_by_visits))


def _show_shears(metrics_by_visits: dict[str, dict[str, float]]) -> None:
    headings = (
        "visits",
        "galaxies",
        "difference < 10'",
        "> 10'",
        "m1 true",
        "c1 true",
        "alpha true",
        "beta",
        "expected",
    )
    names = (
        *("xi_plus_difference_short", "xi_plus_difference_long", "m1_true", "c1_true", "alpha_true"),
        *("beta", "beta_expected"),
    )
    rows = []
    for visits, metrics in metrics_by_visits.items():
        figures = [
            (metrics.get(f"shear_{name}", float("nan")), metrics.get(f"shear_{name}_error", float("nan")))
            for name in names
        ]
        texts = [
            number_with_error(v, error, ".1e", ".0e") if "xi" in n else number_with_error(v, error, ".4f")
            for n, (v, error) in zip(names, figures, strict=True)
        ]
        rows.append((visits, str(metrics["shear_galaxies"]), *texts))
    Rows(headings, rows, _SHEAR_CAPTION).show()
