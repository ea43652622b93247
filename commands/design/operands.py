"""The command ``pachon operands``: names of operands with their definitions, or their numbers of a telescope."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument

from ...core.errors import ConfigError, PachonError, error_context
from ...core.number_text import NumberText
from .. import completion
from ..choices import names
from ..inputs import load_model
from ..options import GlassCatalogues, Json, Lenient, TableFile
from ..tables import Rows, print_json
from .command import app

if TYPE_CHECKING:
    from ...design.optimize.operand import Operand
    from ...models.telescope import Telescope


@app.command("operands")
def operands_command(
    model: Annotated[
        str | None,
        names(completion.models, metavar="MODEL", help="Bundled telescope or file, to measure.", kind=Argument),
    ] = None,
    operand: Annotated[
        list[str] | None,
        names(
            completion.operands,
            metavar="OPERAND",
            help="Operand to measure, its keys as in files: MNEG, 'REAY surface=S3 field_deg=0,9'.",
        ),
    ] = None,
    glass_catalogue: GlassCatalogues = None,
    lenient: Lenient = False,
    table: TableFile = None,
    as_json: Json = False,
) -> None:
    """List the operands of optimisations by their names in Zemax and CODE V; of a telescope with their numbers.

    Without --operand, the numbers are of those operands that need no surface, field or frequency.

    **Examples**

    - `pachon operands`: names, units, further keys and definitions
    - `pachon operands my_lens.zmx`: focal lengths, pupils, Seidel sums, lengths...
    - `pachon operands my_lens.zmx --operand MNCG --operand "MTFA field_deg=0,9 frequency_per_mm=20"`
    """
    if model is None:
        if operand:
            raise ConfigError("--operand is given without MODEL: expected the telescope that it is measured of")
        _deliver(_list_names(), table, as_json)
        return
    telescope = load_model(model, lenient, glass_catalogue or ())
    measured = _numbers(telescope, operand or [])
    json_content = {"telescope": telescope.name, "operands": measured}
    _deliver((_number_rows(telescope.name, measured), json_content), table, as_json)


def _deliver(content: tuple[Rows, dict[str, Any]], table: Path | None, as_json: bool) -> None:
    """Write the table where it has a path, and print it, or the content of the JSON."""
    rows, json_content = content
    if table is not None:
        rows.write(table)
    if as_json:
        print_json(json_content)
    else:
        rows.show()


def _number_rows(telescope: str, measured: list[dict[str, Any]]) -> Rows:
    """Return measured operands as a table."""
    rows = []
    for operand in measured:
        number = "" if operand["number"] is None else NumberText(operand["number"], ".9g")
        rows.append((operand["operand"], operand["definition"], operand["unit"], number))
    return Rows(("operand", "definition", "unit", telescope), rows, left=3)


def _list_names() -> tuple[Rows, dict[str, Any]]:
    """Return the names of operands, as a table and for JSON."""
    from ...design.optimize.operand_names import NAMES
    from ...design.optimize.optimize_file import file_keys

    headings = ("operand", "unit", "keys", "definition")
    rows = [(name, entry.unit, ", ".join(file_keys(entry)), entry.definition) for name, entry in NAMES.items()]
    caption = (
        "In files {kind: EFFL, target: 50}, or min and max. Keys with * are needed. "
        "More kinds: docs/howto/optimisation.md."
    )
    json_content = {"operands": [dict(zip(headings, row, strict=True)) for row in rows]}
    return Rows(headings, rows, caption, left=4), json_content


def _numbers(telescope: Telescope, texts: list[str]) -> list[dict[str, Any]]:
    """Return operands with number, unit and definition; of all that need nothing more where no texts are given."""
    from ...design.optimize.operand_names import NAMES, entry_fields, operand
    from ...design.optimize.optimize_file import operand_of_text

    stated: list[tuple[Operand, str]] = []
    for text in texts:
        with error_context(subject=f"--operand {text}"):
            item = operand_of_text(text)
        name = item.stated.name if item.stated is not None else ""
        stated.append(
            (item, NAMES[name].definition if name in NAMES else (type(item).__doc__ or "").partition("\n")[0])
        )
    if not texts:
        # The names of CODE V are second ones.
        alone = [e for e in NAMES.values() if not any(entry_fields(e).values()) and "CODE V" not in e.definition]
        stated = [(operand(entry.name, 0.0), entry.definition) for entry in alone]
    rows = []
    for item, definition in stated:
        unit, size = item.shown_unit
        try:
            number: float | None = item.measure(telescope) / size
        except PachonError as error:
            if texts:
                raise
            # Not every telescope has a focus, a glass or a magnification.
            number, definition = None, error.problem
        rows.append({"operand": item.label, "number": number, "unit": unit, "definition": definition})
    return rows
