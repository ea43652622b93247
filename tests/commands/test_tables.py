"""Tables of commands as files: numbers with units, errors in columns of their own, names that each format can hold."""

import math

import numpy as np
import pytest
from astropy.table import Table
from astropy.units import Unit

from pachon.commands.tables import Rows

ROWS = Rows(
    ("CCD", "ξ+ [µm]", "m1", "", "rms [waves]", "light [%]", ""),
    [("R22_S11", "1.5", "0.001 ± 0.002", "a", "1", "50.0", "3"), ("Süd", "-", "", "b", "2", "12.5", "4")],
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
