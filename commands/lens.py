"""The command on lens files, ``pachon convert``; :mod:`~pachon.commands.cli` registers it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import Lenient, Model, load_model


def convert_command(
    model: Model,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File to write: .yaml (ours) or .zmx (Zemax).")],
    glass_catalogue: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE.agf", help="Glass catalogue to look glasses up in; once for each."),
    ] = None,
    lenient: Lenient = False,
) -> None:
    """Write a telescope in another format: a Zemax or CODE V file as ours, or any model as a Zemax file.

    Glasses that a Zemax file needs and the bundled catalogue does not have go to an .agf file beside it.

    **Examples**

    - `pachon convert lens.zmx lens.yaml`

    - `pachon convert lens.zmx lens.yaml --glass-catalogue schott.agf --lenient`

    - `pachon convert lsst_v3.3_r lsst.zmx`
    """
    from ..models.io.prescription import save_telescope

    telescope = load_model(model, lenient, glass_catalogue or ())
    save_telescope(telescope, out)
    print(f"{telescope.name}: {len(telescope.surfaces)} surfaces written to {out}")


COMMANDS = {"convert": convert_command}
