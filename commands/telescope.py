"""The commands ``pachon info`` and ``pachon convert``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from typer import Argument

from ..core.errors import PrescriptionWarning
from ..core.number_text import counted
from ..core.terminal import print_line
from . import completion
from .choices import choice, names
from .imports import import_modules
from .inputs import load_model, warnings_shown
from .options import Configuration, GlassCatalogues, Json, Lenient, Model, TableFile, refuse_stated
from .tables import Rows, plain_table, print_json, wide_console

if TYPE_CHECKING:
    from ..models.io.prescription import LensFormat

app = typer.Typer()
#: Endings of files whose light travels along +z, ours along -z: their radii have the opposite signs.
_ALONG_Z = (".zmx", ".zar", ".seq", ".len", ".json", ".roa")


@app.command("info")
def info_command(
    model: Annotated[
        str | None,
        names(completion.models, metavar="MODEL", help="Bundled model, or path of a prescription.", kind=Argument),
    ] = None,
    glass_catalogue: GlassCatalogues = None,
    lenient: Lenient = False,
    configuration: Configuration = None,
    table: TableFile = None,
    as_json: Json = False,
) -> None:
    """Show the lens table and the first-order properties of a telescope; without a model, list the bundled ones.

    Radii and z are in the telescope frame: origin at the vertex of the primary, +z towards the sky, a positive radius
    has its centre on the +z side.

    **Examples**

    - `pachon info`
    - `pachon info lsst_v3.3_r`
    - `pachon info my_telescope.yaml --json`
    """
    console = wide_console()
    if model is None:
        of_model = {
            "--glass-catalogue": glass_catalogue or None,
            "--lenient": lenient,
            "--configuration": configuration or None,
        }
        refuse_stated(of_model, ": expected MODEL with it")
        from ..models.io.bundled import bundled_models

        models = bundled_models()
        if table is not None:
            Rows(("model", "description"), [(m["name"], m["description"]) for m in models], left=2).write(table)
        if as_json:
            print_json({"models": models})
            return
        listed_models = plain_table()
        listed_models.add_column("model", no_wrap=True)
        listed_models.add_column("description")
        for entry in models:
            listed_models.add_row(entry["name"], entry["description"])
        console.print(listed_models)
        return
    import_modules(("pachon.models.io.prescription", "pachon.pipeline.report.info"))
    from ..pipeline.report.info import coefficient_lines, describe, figure_rows, surface_columns, surface_rows

    description = describe(load_model(model, lenient, glass_catalogue or (), configuration))
    lens_table = Rows(surface_columns(description), surface_rows(description), left=2)
    if table is not None:
        lens_table.write(table)
    if as_json:
        print_json(description)
        return
    title = ": ".join(filter(None, (description["name"], description["description"])))
    console.print(title, highlight=False)
    console.print(f"source: {description['source']}\n", highlight=False)
    drawn = any(s["clear_m"] is None and s["semi_diameter_m"] for s in description["surfaces"])
    caption = "In brackets: what a surface is made or drawn to; it stops no light. " if drawn else ""
    if model.lower().endswith(_ALONG_Z):
        caption += "Radii are positive towards +z, to the object: the file has the opposite signs."
    replace(lens_table, caption=caption.strip()).show()
    for line in coefficient_lines(description):
        console.print(line, highlight=False)
    console.print()
    properties = plain_table(show_header=False)
    for name, value in figure_rows(description):
        properties.add_row(name, value)
    console.print(properties)


@app.command("convert")
def convert_command(
    model: Model,
    out: Annotated[
        Path, Argument(metavar="OUT", help="File to write: .yaml (ours), .zmx, .seq, .len, .json (optiland), .roa.")
    ],
    format: Annotated[
        str,
        choice(
            ("pachon", "batoid", "zemax", "codev", "oslo", "optiland", "rayoptics"),
            metavar="FORMAT",
            help="Format, where the name does not tell it.",
        ),
    ] = "",
    glass_catalogue: GlassCatalogues = None,
    lenient: Lenient = False,
    configuration: Configuration = None,
) -> None:
    """Write a telescope in another format: ours, batoid's, or that of a lens design program.

    What the format has no place for (pickups, solves, coatings, formulas of glasses, fields...) is refused, with
    `--lenient` left out with a warning.

    Read and written are files of Zemax (.zmx, read also .zar), CODE V (.seq), OSLO (.len), optiland (.json), ray-optics
    (.roa), and of batoid and ours (.yaml). Glasses that a Zemax file needs and the bundled catalogue does not have go
    to an .agf file beside it.

    **Examples**

    - `pachon convert lens.zmx lens.yaml`
    - `pachon convert lens.zmx lens.yaml --glass-catalogue schott.agf --lenient`
    - `pachon convert lsst_v3.3_r lsst.zmx`
    - `pachon convert doublet.len doublet.json`
    - `pachon convert zoom.zmx tele.yaml --configuration 3`
    - `pachon convert lens.zmx lens.roa`
    - `pachon convert lsst_v3.3_r LSST_r.yaml --format batoid`
    """
    from ..models.io.prescription import save_telescope

    telescope = load_model(model, lenient, glass_catalogue or (), configuration)
    with warnings_shown(PrescriptionWarning):
        save_telescope(telescope, out, format=cast("LensFormat", format), lenient=lenient)
    print_line(f"{telescope.name}: {counted(len(telescope.surfaces), 'surface')} written to {out}")
