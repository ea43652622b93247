"""Files that `--table` writes hold numbers in full: the tables of all commands, made of thirds."""

import re
from types import SimpleNamespace

import pytest
import typer
from astropy.table import Table

from pachon.commands import (
    align,
    cli,
    measure,
    night,
    run,
    shim,
    stack_images,
    study,
    tolerance,
    visits,
)
from pachon.commands.design import operands
from pachon.commands.tables import Rows
from pachon.models.camera.height_statistics import HeightStatistics
from pachon.pipeline.report import info, tables
from pachon.studies.psf_choice.plan import Case
from pachon.studies.shimming.shim import STATES

THIRD = 1.0 / 3.0
#: Commands whose tables are words and whole numbers, or files of :func:`pachon.core.table_files.write_table` alone.
WITHOUT_ROUNDING = {"config", "reproduce", "images", "donuts", "model", "sweep export"}


SHIM_METRICS = ("fwhm", "size", "rms_g", "rms_xi_g", "rms_e")


class Thirds(dict):
    """Metrics that are all a third but for those stated."""

    def __missing__(self, key):
        return THIRD

    def get(self, key, default=None):
        return self[key]


def run_rows():
    ccd = Thirds(kink_observed=1, kink_truth=2, stars_used=3, stars=4)
    return run._ccd_rows(SimpleNamespace(summary={"ccd": {"R22_S11": ccd}}))


def study_rows():
    case = Case(40)
    plan = SimpleNamespace(base=case, default=case, stars=(), focal_plane=False)
    result = SimpleNamespace(plan=plan, recommended=lambda: None, metrics={case: Thirds()})
    return study._case_rows(result)


def tolerance_rows():
    offender = Thirds(name="L1.dz", unit="mm")
    summary = Thirds(worst_offenders=[offender], unit="um", tolerances=1)
    return tolerance._offender_rows(summary, "")


def shim_rows():
    # The focused state is another third, so that the difference is no whole number.
    checked = {state: SimpleNamespace(**dict.fromkeys(SHIM_METRICS, THIRD)) for state in STATES}
    checked["focused"] = SimpleNamespace(**dict.fromkeys(SHIM_METRICS, THIRD / 7.0))
    return shim._state_rows(SimpleNamespace(checked=checked, merit="fwhm", parts="ccds"))


def surface_rows():
    surface = {
        "name": "M1",
        "type": "asphere",
        "tilted": False,
        "glass": "",
        "medium_after": "air",
        "clear_m": [THIRD / 7.0, THIRD],
        "aperture": "",
        **dict.fromkeys(("radius_m", "conic", "thickness_m", "index_after", "z_m"), THIRD),
    }
    drawn = surface | {"name": "L1", "clear_m": None, "semi_diameter_m": THIRD}
    description = {"length_unit": "mm", "design": {"stop": "M1"}, "surfaces": [surface, drawn]}
    return Rows(info.surface_columns(description), info.surface_rows(description))


def null_rows():
    return visits._null_rows({"1": Thirds(usable=1)})


def night_rows():
    summary = {"finished": 1, "left_out": {}, "visits": 1, "bands": {"r": Thirds()}}
    return night._band_rows(SimpleNamespace(summary=summary))


def operand_rows():
    return operands._number_rows("lens", [{"operand": "EFFL", "definition": "f", "unit": "mm", "number": THIRD}])


ROWS = {
    "align": lambda: align._state_rows(Thirds(designed_t_arcsec2=0.7), ""),
    "attribute": lambda: Rows(tables.ATTRIBUTION_COLUMNS, tables.attribution_rows({"full": Thirds(), "ccd": Thirds()})),
    "camera": lambda: Rows(
        tables.HEIGHT_COLUMNS, tables.height_rows({"all": HeightStatistics(189, *[THIRD * 1e-6] * 9)})
    ),
    "diagnose": lambda: Rows(tables.DIAGNOSTICS_COLUMNS, tables.diagnostics_rows(Thirds())),
    "diagnose --piff": lambda: Rows(tables.PIFF_COLUMNS, tables.piff_rows([Thirds(model="piff", stars=4)])),
    "info": surface_rows,
    "measure": lambda: measure._image_rows(
        SimpleNamespace(metrics={"image": Thirds(objects=3, stars=2, usable=1, purity=THIRD)}, left_out=())
    ),
    "night": night_rows,
    "null-test": null_rows,
    "operands": operand_rows,
    "run": run_rows,
    "shim": shim_rows,
    "stack-images": lambda: stack_images._stack_rows({"1": Thirds(pairs=1)}),
    "study": study_rows,
    "tolerance": tolerance_rows,
    "visits": lambda: visits._stack_rows({"1": Thirds(points=1)}),
}


def leaves(command, path=()):
    for name, inner in getattr(command, "commands", {}).items():
        if hasattr(inner, "commands"):
            yield from leaves(inner, (*path, name))
        else:
            yield " ".join((*path, name)), inner


@pytest.mark.parametrize("name", ROWS)
def test_cells_of_numbers_have_them_in_full(name, tmp_path):
    rows = ROWS[name]()
    path = tmp_path / "table.ecsv"
    rows.write(path)
    table = Table.read(path, format="ascii.ecsv")
    numbers = {name: table[name] for name in table.colnames if table[name].dtype.kind == "f"}
    assert numbers
    texts = {str(value) for column in numbers.values() for value in column if value == value}
    # Cells that are zero or infinite have no more digits.
    rounded = {text for text in texts if text not in ("0.0", "inf") and len(re.sub(r"e.*|\D", "", text)) < 10}
    assert rounded == set()
    words = [table[name] for name in table.colnames if table[name].dtype.kind not in "if"]
    assert not [text for column in words for text in column if re.search(r"\d\.\d|\de[+-]?\d|±", str(text))]


def test_every_command_that_writes_a_table_is_here():
    writing = {
        name
        for name, command in leaves(typer.main.get_command(cli.app))
        if any("--table" in parameter.opts for parameter in command.params)
        and "command.<locals>" not in command.callback.__qualname__
    }
    assert writing - WITHOUT_ROUNDING == {name.partition(" -")[0] for name in ROWS} - {"night"}
