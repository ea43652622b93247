"""Commands with exact derivatives: ``sensitivity`` and ``optimize``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from typer import Option

from ...core.errors import ConfigError
from ..options import name_list
from ..tables import Column
from .command import Given, Outcome, design_command

_ADDRESSES = "Separated by commas: M2.dx, Camera.* (six motions), M1.radius, M1.conic, M1.a6, M1.Z4-22, L1_entrance.n"


def _largest_terms(result: Any) -> list[str]:
    """Return the three Noll terms of each parameter that change most over the fields."""
    size = (result.matrix[:, 3:] ** 2).mean(axis=0) ** 0.5
    return [", ".join(f"Z{j}" for j in terms) for terms in (size.argsort(axis=0)[::-1][:3] + 4).T]


@design_command(
    Column("parameter", lambda result: result.parameters.names),
    Column("largest Noll terms", _largest_terms),
    Column("rms wavefront", lambda result: result.rms, ".5g"),
    Column("unit", lambda result: ["m" if unit == "1" else f"m/{unit}" for unit in result.parameters.units]),
    caption="Rms over the fields, piston and tilt left out.",
    left=2,
)
def sensitivity(
    given: Given,
    parameters: Annotated[
        str | None,
        Option(help=f"{_ADDRESSES}. By default five motions of every mirror and group but the first mirror."),
    ] = None,
    degrees_of_freedom: Annotated[
        str | None,
        Option(metavar="NAME|FILE", help="In place of parameters: named degrees of freedom, lsst or a .yaml of them."),
    ] = None,
    zernikes: Annotated[int, Option(min=4, max=500, help="Highest Noll index.")] = 28,
    out: Annotated[Path | None, Option(help="Matrix to write, .fits or .ecsv; named after the model.")] = None,
) -> Outcome:
    """Compute and save the sensitivity matrix: derivatives of Zernike terms, field by field, to degrees of freedom.

    Exact, in metres of wavefront per metre, radian or unit. Without fields: 31 of them, the axis and two rings.

    **Examples**

    - `pachon sensitivity lsst_v3.3_r`
    - `pachon sensitivity lsst_v3.3_r --parameters "M2.*,Camera.*,M1.Z4-22" --out matrix.ecsv`
    - `pachon sensitivity lsst_v3.3_r --degrees-of-freedom lsst`
    - `pachon sensitivity paul_baker --parameters M2.dz,M3.radius --field-deg 0 --field-deg 0.5 --json`
    """
    from ...design.optimize.sensitivity import sensitivity as compute
    from ...design.optimize.sensitivity_file import write_sensitivity
    from ...design.parameters.degrees_of_freedom_file import load_degrees_of_freedom
    from ...design.parameters.parameters import usual_parameters

    if out is not None and out.suffix not in (".fits", ".ecsv"):
        raise ConfigError(f"--out {out}: expected a name that ends in .fits or .ecsv")
    if parameters is not None and degrees_of_freedom is not None:
        raise ConfigError("--parameters and --degrees-of-freedom are both given: expected one of them")
    telescope, *where = given.where
    how = dict(n_zernike=zernikes, **given.how)
    if degrees_of_freedom is not None:
        result = load_degrees_of_freedom(degrees_of_freedom).sensitivity(telescope, *where, **how)
    else:
        chosen = usual_parameters(telescope) if parameters is None else name_list(parameters, "--parameters")
        result = compute(telescope, chosen, *where, **how)
    path = out or Path(f"sensitivity_{telescope.name}.fits")
    write_sensitivity(path, result)
    values, _ = result.modes()
    notes = [f"singular values: {values[0]:.3g} to {values[-1]:.3g}", f"matrix: {path.resolve()}"]
    return Outcome(result, notes=notes)


@design_command(
    Column("variable", "variables"),
    Column("unit", "units"),
    Column("start", "start_values", ".9g"),
    Column("end", "values", ".9g"),
    Column("change", "changes", ".4g"),
    Column("uncertainty", "uncertainty", ".2g"),
    Column("effect of the change [µm]", lambda result: abs(result.changes) * result.effect, ".4g", 1e6),
    left=2,
    band=True,
)
def optimize(
    given: Given,
    variables: Annotated[str, Option(help=f"{_ADDRESSES}.")],
    merit: Annotated[str, Option(help="Merit function to minimise: spots or wavefront.")] = "spots",
    focal_length: Annotated[float | None, Option(help="Focal length to be held [m].")] = None,
    bounds: Annotated[
        list[str] | None,
        Option(metavar="ADDRESS=LOW:HIGH", help="Limits of a variable; of a motion those of its change."),
    ] = None,
    out: Annotated[Path | None, Option(help="Prescription to write; by default named after the model.")] = None,
) -> Outcome:
    """Optimise a telescope over chosen variables, compensators among them, with exact derivatives.

    **Examples**

    - `pachon optimize lsst_v3.3_r --variables Camera.dz,M2.dz`
    - `pachon optimize paul_baker --variables M1.conic,M2.conic --merit wavefront --bounds M1.conic=-1.1:-0.9`
    """
    from ...design.optimize.optimize import optimize as compute
    from ...design.optimize.targets import FocalLength
    from ...models.io.prescription import save_telescope

    telescope, *where = given.where
    result = compute(
        telescope,
        name_list(variables, "--variables"),
        merit,
        *where,
        bounds=dict(_bounds(text) for text in bounds or ()),
        targets=() if focal_length is None else (FocalLength(focal_length),),
        **given.how,
    )
    path = out or Path(f"optimized_{telescope.name}.yaml")
    save_telescope(result.telescope, path)
    s = result.summary()
    rms = f"{s['rms_start_m'] * 1e6:.6g} -> {s['rms_end_m'] * 1e6:.6g} µm, {s['steps']} steps"
    collinear = [f"collinear: {combination}" for combination in s["collinear"]]
    return Outcome(result, notes=[f"rms of {s['merit']}: {rms}", *collinear, f"prescription: {path.resolve()}"])


def _bounds(text: str) -> tuple[str, tuple[float, float]]:
    address, _, limits = text.partition("=")
    try:
        low, high = (float(part) for part in limits.split(":"))
    except ValueError:
        raise ConfigError(f"--bounds {text}: expected ADDRESS=LOW:HIGH, such as M1.conic=-1.1:-0.9") from None
    return address.strip(), (low, high)
