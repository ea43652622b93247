"""The commands ``pachon new``, ``validate`` and ``schema``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from typer import Argument, Option

from ..core.terminal import print_line
from .choices import choice
from .options import Json
from .tables import print_json

if TYPE_CHECKING:
    from ..models.starting_designs.new import DesignKind
    from ..studies.validation import SchemaKind

app = typer.Typer()


@app.command("new")
def new_command(
    kind: Annotated[
        str,
        choice(
            (
                *("ritchey-chretien", "cassegrain", "dall-kirkham", "gregorian", "newtonian", "schmidt"),
                *("three-mirror", "singlet", "doublet", "triplet"),
            ),
            metavar="KIND",
            help="Kind of telescope or lens.",
            kind=Argument,
        ),
    ],
    out: Annotated[
        Path | None, Argument(metavar="OUT", help="File to write, .yaml; KIND.yaml where not given.")
    ] = None,
    diameter_mm: Annotated[float | None, Option(help="Diameter of the entrance pupil [mm].")] = None,
    f_number: Annotated[float | None, Option(help="Focal ratio.")] = None,
    field_deg: Annotated[float | None, Option(help="Radius of the field of view [deg].")] = None,
    primary_f_number: Annotated[float | None, Option(help="Focal ratio of the primary, of two mirrors.")] = None,
    back_focus_mm: Annotated[float | None, Option(help="Focus behind the primary [mm], of two mirrors.")] = None,
) -> None:
    """Write the commented prescription of a new telescope or lens, from third-order formulas.

    **Examples**

    - `pachon new ritchey-chretien`
    - `pachon new cassegrain my_telescope.yaml --diameter-mm 800 --f-number 10 --field-deg 0.3 --primary-f-number 3`
    - `pachon new triplet lens.yaml --diameter-mm 10 --f-number 4 --field-deg 18`
    """
    from ..core.errors import ConfigError
    from ..core.files import write_bytes
    from ..models.starting_designs.new import new_prescription

    path = out or Path(f"{kind}.yaml")
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise ConfigError(f"OUT = {str(path)!r}: expected a name that ends in .yaml")
    options = {
        "diameter": diameter_mm and diameter_mm * 1e-3,
        "f_number": f_number,
        "field_radius": field_deg and math.radians(field_deg),
        "primary_f_number": primary_f_number,
        "back_focus": back_focus_mm and back_focus_mm * 1e-3,
    }
    telescope, text = new_prescription(cast("DesignKind", kind), **options)
    write_bytes(path, text.encode())
    print_line(f"{telescope.description}: written to {path}")


@app.command("validate")
def validate_command(
    files: Annotated[list[Path], Argument(metavar="FILE...", help="Files to check.")], as_json: Json = False
) -> None:
    """Report all problems of files at once: prescriptions, cameras, configurations, sweeps, tables of heights.

    What a file is, its ending and its keys tell. Each problem is a line, with the number of the line in the file where
    it is known. Exit status 2 if there is one; notes on how a lens file is read leave it at 0.

    **Examples**

    - `pachon validate my_telescope.yaml run.yaml sweep.yaml`
    - `pachon validate lens.zmx --json`
    """
    from ..core.errors import ConfigError
    from ..studies.validation import Validation, validate_file

    reports = []
    for path in files:
        try:
            reports.append(validate_file(path))
        except ConfigError as error:
            if len(files) == 1:
                raise
            # A file of no known kind does not hide the problems of the others.
            reports.append(Validation(str(path), "unknown", (error,)))
    if as_json:
        print_json([report.summary() for report in reports])
    for report in reports if not as_json else []:
        for problem in report.problems:
            print_line(str(problem))
        for note in report.notes:
            print_line(f"{note} (a note, no fault of the file)")
        if not report.problems:
            print_line(f"{report.path}: {report.kind}, no problems")
    if any(report.problems for report in reports):
        raise typer.Exit(2)


@app.command("schema")
def schema_command(
    kind: Annotated[
        str,
        choice(
            (
                *("prescription", "run", "sweep", "images", "visits", "night", "align", "site", "coatings"),
                *("tolerances", "optimization", "degrees_of_freedom", "camera"),
            ),
            metavar="KIND",
            help="Kind of file.",
            kind=Argument,
        ),
    ],
) -> None:
    """Print the JSON schema of a kind of file, with which editors complete and check YAML.

    **Examples**

    - `pachon schema prescription > prescription.schema.json`
    """
    import json

    from ..studies.validation import file_schema

    print_line(json.dumps(file_schema(cast("SchemaKind", kind)), indent=1))
