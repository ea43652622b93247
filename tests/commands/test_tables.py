"""Tables of commands as files: numbers with units, errors in columns of their own, names that each format can hold."""

import math

import numpy as np
import pytest
from astropy.table import Table
from astropy.units import Unit

from pachon.commands.tables import Rows, number_texts
from pachon.core.number_text import CellText, number_with_error, number_with_unit

ROWS = Rows(
    ("CCD", "ξ+ [µm]", "m1", "", "rms [waves]", "light [%]", ""),
    [
        ("R22_S11", "1.5", number_with_error(0.001, 0.002, ".3f"), "a", "1", "50.0", "3"),
        ("Süd", "-", "", "b", "2", "12.5", "4"),
    ],
    verdict="Two rows.",
)
NUMBERS = {"m1": [0.001, math.nan], "m1_error": [0.002, math.nan]}


@pytest.mark.parametrize(
    ("ending", "xi"), [("ecsv", "ξ+"), ("csv", "ξ+ [um]"), ("fits", "xi+"), ("parquet", "ξ+ [um]")]
)
def test_numbers_errors_and_units_are_written(ending, xi, tmp_path):
    path = tmp_path / f"t.{ending}"
    if ending == "parquet":
        parquet = pytest.importorskip("pyarrow.parquet")
        ROWS.write(path)
        table = Table(parquet.read_table(path).to_pydict())
    else:
        ROWS.write(path)
        table = Table.read(path, format={"csv": "ascii.csv", "ecsv": "ascii.ecsv"}.get(ending))
    assert len(table) == 2
    for name, values in NUMBERS.items():
        np.testing.assert_array_equal(np.ma.filled(table[name], np.nan).astype(float), values)
    assert float(table[xi][0]) == 1.5
    assert list(table["rms [waves]"]) == [1.0, 2.0]
    assert {"name", "name_2"} <= set(table.colnames)
    assert table["CCD"][1] == ("S?d" if ending == "fits" else "Süd")
    if ending in ("ecsv", "fits"):
        assert table[xi].unit == Unit("um")
        assert table["light"].unit == Unit("%")


def test_a_table_without_rows_is_written(tmp_path):
    Rows(("CCD", "rms [nm]"), []).write(tmp_path / "t.ecsv")
    assert len(Table.read(tmp_path / "t.ecsv", format="ascii.ecsv")) == 0


def test_the_verdict_stands_above(capsys):
    ROWS.show()
    assert capsys.readouterr().out.startswith("Two rows.\nCCD ")


@pytest.mark.parametrize("ending", ["ecsv", "csv", "fits"])
def test_numbers_are_written_in_full_and_shown_rounded(ending, tmp_path, capsys):
    values = [1.0 / 3.0, -1e-5 / 3.0, math.nan]
    rows = Rows(("CCD", "fwhm [arcsec]"), [*zip("abc", number_texts(values, ".2f"), strict=True)])
    path = tmp_path / f"t.{ending}"
    rows.write(path)
    column = Table.read(path).columns[1]
    np.testing.assert_array_equal(np.ma.filled(np.ma.asarray(column, dtype=float), math.nan), values)
    rows.show()
    assert [line.split()[1] for line in capsys.readouterr().out.splitlines()[1:]] == ["0.33", "0.00", "-"]


def test_cells_of_several_values_are_columns(tmp_path):
    cells = [
        (
            number_with_error(1 / 3, 0.1, ".1f"),
            number_with_unit(2 / 3, ".2g", "mm"),
            CellText("3 of 4", {"": 3, "stars": 4}),
            "1_53",
        ),
        ("-", number_with_unit(0.5, ".2g", ""), CellText("1 of 2", {"": 1, "stars": 2}), "1_54"),
    ]
    assert cells[0] == ("0.3 ± 0.1", "0.67 mm", "3 of 4", "1_53")
    Rows(("m1", "size", "used", "CCD"), cells).write(tmp_path / "t.ecsv")
    table = Table.read(tmp_path / "t.ecsv", format="ascii.ecsv")
    assert table.colnames == ["m1", "m1_error", "size", "size_unit", "used", "stars", "CCD"]
    assert [*table[0]] == [1 / 3, 0.1, 2 / 3, "mm", 3, 4, "1_53"]
    assert np.isnan([table["m1"][1], table["m1_error"][1]]).all()
    assert table["stars"].dtype.kind == "i"
