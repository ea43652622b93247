"""The commands on a telescope as it is: ``pachon opd`` and ``info``; :mod:`~pachon.commands.cli` registers them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from .options import (
    FieldDeg,
    Json,
    Lenient,
    Model,
    Threads,
    WavelengthNm,
    degrees_pair,
    load_model,
    picture_kind,
    show_table,
    wide_console,
)


def opd_command(
    model: Model,
    field_deg: FieldDeg = "0,0",
    wavelength_nm: WavelengthNm = None,
    grid: Annotated[int, typer.Option(min=8, max=4096, help="Points across the pupil.")] = 256,
    zernikes: Annotated[int, typer.Option(min=4, max=500, help="Highest Noll index to fit.")] = 28,
    out: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            "--out",
            "-o",
            help="Picture to write, .png, .pdf or .svg; by default named after the model and field.",
        ),
    ] = None,
    threads: Threads = None,
    lenient: Lenient = False,
    as_json: Json = False,
) -> None:
    """Draw and save the optical path difference of a telescope at one field point, with its Zernike terms.

    Path of the chief ray minus path of each ray, to a sphere about where the chief ray meets the detector.

    **Examples**

    - `pachon opd lsst_v3.3_r --field-deg 0,1.225 --wavelength-nm 622`

    - `pachon opd paul_baker --field-deg 0.3,0.3 --zernikes 11 --out coma.png`

    - `pachon opd my_telescope.yaml --json`: figures only on standard output
    """
    import numpy as np

    from ..core.files import json_text, write_bytes
    from ..core.plotting import picture_bytes
    from ..wavefront.opd import wavefront_opd
    from ..wavefront.zernike import fit_zernikes

    kind = picture_kind(out)
    telescope = load_model(model, lenient)
    x, y = degrees_pair(field_deg, "--field-deg")
    wavelength = telescope.default_wavelength if wavelength_nm is None else wavelength_nm * 1e-9
    opd = wavefront_opd(telescope, tuple(np.deg2rad([x, y])), wavelength, grid=grid, threads=threads)
    radius, obscuration = 0.5 * telescope.pupil_diameter, telescope.pupil_obscuration
    fit = fit_zernikes(opd, radius, obscuration, zernikes)
    path = out or Path(f"opd_{telescope.name}_{x:g}_{y:g}_{opd.wavelength * 1e9:g}nm.png")
    write_bytes(path, picture_bytes(opd.plot(fit, telescope.name), kind))
    figures = {
        "model": telescope.name,
        "field_deg": [x, y],
        "wavelength_nm": opd.wavelength * 1e9,
        "rms_nm": opd.rms * 1e9,
        "rms_waves": opd.rms / opd.wavelength,
        "peak_to_valley_nm": opd.peak_to_valley * 1e9,
        "rms_without_tilt_nm": float(np.nanstd(opd.without_tilt)) * 1e9,
        "lit_fraction": float(opd.lit.sum() / _annulus_points(opd, telescope)),
        "reference_sphere_m": {"center": opd.center, "radius": opd.radius},
        "obscuration": fit.obscuration,
        "zernike_nm": fit.coefficients * 1e9,
        "residual_rms_nm": fit.residual_rms * 1e9,
        "picture": str(path),
    }
    if as_json:
        print(json_text(figures))
        return
    _show_opd(figures)


def _annulus_points(opd: Any, telescope: Any) -> int:
    """Return how many points of the grid lie in the unvignetted pupil."""
    radius_squared = (opd.x**2 + opd.y**2) / (0.5 * telescope.pupil_diameter) ** 2
    return int(((radius_squared <= 1.0) & (radius_squared >= telescope.pupil_obscuration**2)).sum())


def _show_opd(figures: dict[str, Any]) -> None:
    from ..models.zernike_polynomials import NOLL_NAMES, noll_to_nm

    console = wide_console()
    console.print(
        f"{figures['model']} at field ({figures['field_deg'][0]:g}, {figures['field_deg'][1]:g}) deg, "
        f"{figures['wavelength_nm']:g} nm: rms {figures['rms_nm']:.2f} nm = {figures['rms_waves']:.4f} waves, "
        f"peak to valley {figures['peak_to_valley_nm']:.1f} nm; "
        f"tilt taken off, rms {figures['rms_without_tilt_nm']:.2f} nm"
    )
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for name in ("Noll", "n", "m", "\\[nm]", "\\[waves]"):
        table.add_column(name, justify="right")
    table.add_column("term")
    for j, value in enumerate(figures["zernike_nm"], start=1):
        n, m = noll_to_nm(j)
        row = (f"{j}", f"{n}", f"{m}", f"{value:.3f}", f"{value / figures['wavelength_nm']:.5f}", NOLL_NAMES.get(j, ""))
        table.add_row(*row)
    console.print(table)
    console.print(f"left over: {figures['residual_rms_nm']:.3f} nm rms over the lit points")
    print(f"picture: {Path(figures['picture']).resolve()}")


def info_command(
    model: Annotated[str | None, typer.Argument(help="Bundled model, or path of a prescription.")] = None,
    lenient: Lenient = False,
    as_json: Json = False,
) -> None:
    """Show the lens table and the first-order figures of a telescope; without a model, list those that come along.

    Radii and z are in the telescope frame: origin at the vertex of the primary, +z towards the sky, a positive radius
    has its centre on the +z side.

    **Examples**

    - `pachon info`

    - `pachon info lsst_v3.3_r`

    - `pachon info my_telescope.yaml --json`
    """
    from ..core.files import json_text
    from ..pipeline.report.info import SURFACE_COLUMNS, describe, figure_rows, list_models, surface_rows

    console = wide_console()
    if model is None:
        models = list_models()
        if as_json:
            print(json_text({"models": models}))
            return
        table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
        table.add_column("model", no_wrap=True)
        table.add_column("what it is")
        for entry in models:
            table.add_row(entry["name"], entry["description"])
        console.print(table)
        return
    description = describe(load_model(model, lenient))
    if as_json:
        print(json_text(description))
        return
    console.print(f"{description['name']}: {description['description']}", highlight=False)
    console.print(f"source: {description['source']}\n", highlight=False)
    show_table(SURFACE_COLUMNS, surface_rows(description), left=2)
    console.print()
    figures = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for what, value in figure_rows(description):
        figures.add_row(what, value)
    console.print(figures)


COMMANDS = {"opd": opd_command, "info": info_command}
