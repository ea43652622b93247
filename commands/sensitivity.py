"""Commands with derivatives: ``pachon sensitivity`` and ``optimize``; :mod:`~pachon.commands.cli` registers them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..core.errors import ConfigError
from .options import (
    AcrossBand,
    FieldsDeg,
    Json,
    Model,
    Picture,
    Projection,
    Threads,
    WavelengthNm,
    WavelengthsNm,
    deliver,
    field_list,
    load_model,
    name_list,
    number_texts,
    picture_kind,
    show_table,
    wavelength_list,
)

_ADDRESSES = "Separated by commas: M2.dx, Camera.* (six motions), M1.radius, M1.conic, M1.a6, M1.Z4-22, L1_entrance.n"


def sensitivity_command(
    model: Model,
    parameters: Annotated[
        str | None,
        typer.Option(help=f"{_ADDRESSES}. By default five motions of every mirror and group but the first mirror."),
    ] = None,
    degrees_of_freedom: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE", help="In place of parameters: named degrees of freedom, lsst or a .yaml of them."
        ),
    ] = None,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthNm = None,
    zernikes: Annotated[int, typer.Option(min=4, max=500, help="Highest Noll index.")] = 28,
    out: Annotated[
        Path | None, typer.Option(help="Matrix to write, .fits or .ecsv; by default named after the model.")
    ] = None,
    projection: Projection = "zemax",
    picture: Picture = None,
    threads: Threads = None,
    as_json: Json = False,
) -> None:
    """Compute and save the sensitivity matrix: derivatives of Zernike terms, field by field, to degrees of freedom.

    Exact, in metres of wavefront per metre, radian or unit. Without fields: 31 of them, the axis and two rings.

    **Examples**

    - `pachon sensitivity lsst_v3.3_r`

    - `pachon sensitivity lsst_v3.3_r --parameters "M2.*,Camera.*,M1.Z4-22" --out matrix.ecsv`

    - `pachon sensitivity lsst_v3.3_r --degrees-of-freedom lsst`

    - `pachon sensitivity paul_baker --parameters M2.dz,M3.radius --field-deg 0 --field-deg 0.5 --json`
    """
    from ..design.optimize.sensitivity import sensitivity
    from ..design.optimize.sensitivity_file import write_sensitivity
    from ..design.parameters.degrees_of_freedom_file import load_degrees_of_freedom
    from ..design.parameters.parameters import usual_parameters

    picture_kind(picture)
    if out is not None and out.suffix not in (".fits", ".ecsv"):
        raise ConfigError(f"--out {out}: expected a name that ends in .fits or .ecsv")
    if parameters is not None and degrees_of_freedom is not None:
        raise ConfigError("--parameters and --degrees-of-freedom are both given: expected one of them")
    telescope = load_model(model)
    where = field_list(field_deg), None if wavelength_nm is None else wavelength_nm * 1e-9
    if degrees_of_freedom is not None:
        dof = load_degrees_of_freedom(degrees_of_freedom)
        result = dof.sensitivity(telescope, *where, n_zernike=zernikes, projection=projection, threads=threads)
    else:
        chosen = usual_parameters(telescope) if parameters is None else name_list(parameters, "--parameters")
        result = sensitivity(telescope, chosen, *where, n_zernike=zernikes, projection=projection, threads=threads)
    path = out or Path(f"sensitivity_{telescope.name}.fits")
    write_sensitivity(path, result)

    def show() -> None:
        size = (result.matrix[:, 3:] ** 2).mean(axis=0) ** 0.5
        shown = size.argsort(axis=0)[::-1][:3] + 4
        columns = ("parameter", "largest Noll terms", "rms wavefront", "unit")
        rows = [
            (
                p.address,
                ", ".join(f"Z{j}" for j in shown[:, i]),
                f"{result.rms[i]:.5g}",
                f"m/{p.unit}" if p.unit else "m",
            )
            for i, p in enumerate(result.parameters)
        ]
        show_table(columns, rows, "Rms over the fields, piston and tilt left out.", left=2)
        values, _ = result.modes()
        print(f"singular values: {values[0]:.3g} to {values[-1]:.3g}")
        print(f"matrix: {path.resolve()}")

    deliver(result, f"sensitivity_{telescope.name}", picture, as_json, show)


def optimize_command(
    model: Model,
    variables: Annotated[str, typer.Option(help=f"{_ADDRESSES}.")],
    merit: Annotated[str, typer.Option(help="What to make small: spots or wavefront.")] = "spots",
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthsNm = None,
    across_band: AcrossBand = None,
    focal_length: Annotated[float | None, typer.Option(help="Focal length to be held [m].")] = None,
    bounds: Annotated[
        list[str] | None,
        typer.Option(metavar="ADDRESS=LOW:HIGH", help="Limits of a variable; of a motion those of its change."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Prescription to write; by default named after the model.")] = None,
    projection: Projection = "zemax",
    picture: Picture = None,
    threads: Threads = None,
    as_json: Json = False,
) -> None:
    """Optimise a telescope over chosen variables, compensators among them, with exact derivatives.

    **Examples**

    - `pachon optimize lsst_v3.3_r --variables Camera.dz,M2.dz`

    - `pachon optimize paul_baker --variables M1.conic,M2.conic --merit wavefront --bounds M1.conic=-1.1:-0.9`
    """
    from ..design.optimize.optimize import optimize
    from ..design.optimize.targets import FocalLength
    from ..models.io.prescription import save_telescope

    picture_kind(picture)
    telescope = load_model(model)
    result = optimize(
        telescope,
        name_list(variables, "--variables"),
        merit,
        field_list(field_deg),
        wavelength_list(telescope, wavelength_nm, across_band),
        bounds=dict(_bounds(text) for text in bounds or ()),
        targets=() if focal_length is None else (FocalLength(focal_length),),
        projection=projection,
        threads=threads,
    )
    path = out or Path(f"optimized_{telescope.name}.yaml")
    save_telescope(result.telescope, path)

    def show() -> None:
        s = result.summary()
        columns = ("variable", "unit", "start", "end", "change", "uncertainty", "effect of the change [µm]")
        rows = zip(
            s["variables"],
            s["units"],
            number_texts(s["start_values"], ".9g"),
            number_texts(s["values"], ".9g"),
            number_texts(s["changes"], ".4g"),
            number_texts(s["uncertainty"], ".2g"),
            number_texts(abs(result.changes) * result.effect * 1e6, ".4g"),
            strict=True,
        )
        show_table(columns, [*rows], left=2)
        print(f"rms of {s['merit']}: {s['rms_start_m'] * 1e6:.6g} -> {s['rms_end_m'] * 1e6:.6g} µm, {s['steps']} steps")
        for combination in s["collinear"]:
            print(f"cannot be told apart: {combination}")
        print(f"prescription: {path.resolve()}")

    deliver(result, f"optimize_{telescope.name}", picture, as_json, show)


def _bounds(text: str) -> tuple[str, tuple[float, float]]:
    address, _, limits = text.partition("=")
    try:
        low, high = (float(part) for part in limits.split(":"))
    except ValueError:
        raise ConfigError(f"--bounds {text}: expected ADDRESS=LOW:HIGH, such as M1.conic=-1.1:-0.9") from None
    return address.strip(), (low, high)


COMMANDS = {"sensitivity": sensitivity_command, "optimize": optimize_command}
