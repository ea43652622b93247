"""The command ``pachon study``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer
from typer import Option

from ..core.errors import ConfigError
from ..core.number_text import NumberText
from ..core.terminal import print_line
from .inputs import configuration, configured_experiment
from .interrupt import interruptible
from .options import Config, Json, Quiet, Settings, TableFile, Threads, TruthStars, ccd_list, name_list, one_name_list
from .tables import Rows, print_json, wide_console, write_rows

if TYPE_CHECKING:
    from ..studies.psf_choice.study import Study

app = typer.Typer()

_Number = TypeVar("_Number", int, float)
_COLUMNS = {
    "rms_g_at_stars": "at stars: rms g",
    "rms_g_away": "holdout: rms g",
    "rms_dt_g_away": "rms dT/T",
    "mean_g_away": "mean g of a CCD",
    "xi_plus_g_away_long": "ξ+ of g beyond 10'",
    "rms_e_away": "rms e",
}
_CAPTION = (
    "Residuals of the base, the default, the recommended model, and the best order of each number of stars, in g and T "
    "of adaptive moments. Rms of one component of g: observed - model at the stars of the fit, which is too small; "
    "noise-free - model at holdout positions. Also at holdout positions: rms of dT/T, rms over CCDs of the mean g, "
    "mean ξ+ from 10' to 3 deg, and rms in the weighted e of Jee & Tyson (2011)."
)


@app.command("study")
def study_command(
    config: Config = None,
    ccds: Annotated[str | None, ccd_list("CCDs, separated by commas; by default nine across the field.")] = None,
    stars: Annotated[str, Option(metavar="N,...", help="Stars of a CCD.")] = "10,20,40,80,160",
    orders: Annotated[str, Option(metavar="N,...", help="Orders of the polynomials.")] = "1,2,3,4,5,6",
    components: Annotated[str, Option(metavar="N,...", help="Components of the basis.")] = "5,10,20,40",
    snr: Annotated[str, Option(metavar="SNR,...", help="S/N of the faintest star.")] = "30,100,300",
    focal_plane: Annotated[
        bool,
        Option("--focal-plane", help="Also fit the model of the whole focal plane, with and without the telescope."),
    ] = False,
    draws: Annotated[int, Option(min=1, help="Draws of the noise.")] = 4,
    out: Annotated[Path, Option("--out", "-o", help="Folder to write to.")] = Path("pachon_study"),
    truth_stars: TruthStars = None,
    table: TableFile = None,
    settings: Settings = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Choose a PSF model: number of stars, order, number of components, basis, interpolation, S/N.

    Stars are simulated once and observed through several draws of noise. Some 350 models, variations of that of the
    configuration, are fitted and compared with the noise-free PSFs at holdout positions. Some minutes. Table (ECSV),
    plots and all metrics (study.json) go into one folder.

    With `--focal-plane`, or `reconstruction.model: focal_plane` in the configuration, the model of all CCDs together is
    among them: 66 more fits, of seconds to a minute each. The nine CCDs are far apart, so that none has neighbours;
    `--ccds all`, or whole rafts, shows what it can do.

    **Examples**

    - `pachon study`: forty stars of S/N 30 and more on nine CCDs across the field
    - `pachon study my_config.yaml --ccds R22_S11,R24_S11 -o small_study --stars 20,40 --orders 1,2,3 --draws 2`
    - `pachon study --focal-plane --ccds R21,R22,R23 --stars 40 --orders 1,3 --components 20 --snr 30 --draws 1`
    """
    from ..core.files import make_folder
    from ..studies.psf_choice.plan import make_plan
    from ..studies.psf_choice.product import study_summary, write_study
    from ..studies.psf_choice.study import STUDY_CCDS, study, study_experiment

    ccd_names = one_name_list(ccds=ccds) or configuration(config, settings).ccds
    if config is None:
        ccd_names = ccd_names or STUDY_CCDS
    model = "focal_plane" if focal_plane else None
    # Around polynomials, which have the order, components and weights to study.
    resolved = configured_experiment(
        config, settings, paper_model=True, ccds=ccd_names, stars__truth=truth_stars, reconstruction__model=model
    ).config
    plan = make_plan(
        resolved,
        stars=_numbers(stars, "--stars", int),
        orders=_numbers(orders, "--orders", int),
        components=_numbers(components, "--components", int),
        snrs=_numbers(snr, "--snr", float),
        draws=draws,
    )
    study_experiment(resolved, plan)  # raises for a bad plan, before anything is written
    make_folder(out)
    with interruptible(quiet) as reporter:
        result = study(resolved, plan, threads=threads, reporter=reporter)
    write_study(result, out, resolved)
    rows = _case_rows(result)
    write_rows(rows, table)
    if as_json:
        print_json(study_summary(result))
        return
    if not quiet:
        rows.show()
        _show_problems(result)
    print_line(f"study: {out.resolve()}")


def _case_rows(result: Study) -> Rows:
    """Return the residuals of the base, the default, the recommended model and the best orders."""
    from ..studies.psf_choice.plan import FOCAL_PLANE

    plan, best_case = result.plan, result.recommended()
    cases = [plan.base, plan.default, *([best_case] if best_case is not None else [])]
    ways = ("equal", "softened", *(FOCAL_PLANE if plan.focal_plane else ()))
    for stars in plan.stars:
        cases += [best for how in ways if (best := result.best_order(stars, how))]
    rows = []
    for case in dict.fromkeys(cases):
        if (case_metrics := result.metrics.get(case)) is not None:
            rows.append((f"{case.stars} stars, {case}", *(NumberText(case_metrics[key], ".1e") for key in _COLUMNS)))
    return Rows(("model", *_COLUMNS.values()), rows, _CAPTION, verdict=_verdict(result))


def _verdict(result: Study) -> str:
    """Return the recommended model in one sentence."""
    base, best_case = result.plan.base, result.recommended()
    if best_case is None:
        return f"No model of {base.stars} stars could be fitted."
    metrics = result.metrics[best_case]
    error = metrics["error_rms_g_away"]
    return (
        f"Recommended for {base.stars} stars {base.noise_text}: {best_case}; residual of g at holdout "
        f"positions {metrics['rms_g_away']:.2e}" + (f" ± {error:.0e}." if math.isfinite(error) else ".")
    )


def _show_problems(result: Study) -> None:
    if result.problems:
        case, why = next(iter(result.problems.items()))
        wide_console().print(
            f"{len(result.problems)} models could not be fitted, such as {case.stars} stars, {case}: {why}", style="dim"
        )


def _numbers(text: str, option: str, kind: type[_Number]) -> tuple[_Number, ...]:
    number_texts = name_list(text, option)
    try:
        return tuple(kind(number_text) for number_text in number_texts)
    except ValueError:
        expected = "whole numbers" if kind is int else "numbers"
        raise ConfigError(f"{option} = {text!r}: expected {expected} separated by commas, such as 20,40") from None
