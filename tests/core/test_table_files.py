"""Tables of files: units in names of columns; Parquet's byte orders, text, truth values, rows of several numbers."""

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Column, MaskedColumn, QTable, Table
from astropy.time import Time

from pachon.core.errors import ConfigError, ProductError
from pachon.core.table_files import column_in_unit, in_format_of, parquet_bytes, read_columns, write_table

pyarrow = pytest.importorskip("pyarrow")


def test_columns_and_their_words_are_those_given(tmp_path):
    from pyarrow import parquet

    columns = {
        "a": (np.arange(3, dtype=">f8"), "um", "numbers of FITS"),
        "n": (np.arange(3, dtype=np.int32), "", ""),
        "b": (np.array([True, False, True]), "", ""),
        "t": (np.array(["u", "v", "é"]), "", ""),
        "p": (np.arange(6.0).reshape(3, 2), "mm", ""),
    }
    path = tmp_path / "t.parquet"
    path.write_bytes(parquet_bytes(path, columns, {"pachon": 1}, error=ConfigError))
    table = parquet.read_table(path)
    assert table.to_pydict() == {name: values.tolist() for name, (values, _, _) in columns.items()}
    assert table.schema.field("n").type == pyarrow.int32()
    assert table.schema.field("a").metadata == {b"unit": b"um", b"description": b"numbers of FITS"}
    assert table.schema.field("n").metadata is None
    assert table.schema.metadata == {b"pachon": b"1"}


@pytest.mark.parametrize("ending", ["csv", "parquet", "ecsv", "fits"])
def test_units_are_read_again(tmp_path, ending):
    path = tmp_path / f"t.{ending}"
    table = QTable({"Z4": [1.5, 2.5] * u.nm, "slope": [1.0, 2.0] * u.electron / u.pix**2, "n": [3, 4], "w": [0.5, 1.0]})
    table["w"].unit = u.dimensionless_unscaled
    write_table(path, in_format_of(path, table))
    columns = read_columns(path)
    assert (columns["z4"].unit, columns["slope"].unit) == (u.nm, u.electron / u.pix**2)
    assert columns["z4"].tolist() == [1.5, 2.5]
    assert {"n", "w"} <= set(columns)


@pytest.mark.parametrize("writer", ["astropy", "fields"])
def test_units_that_parquet_states_are_those_of_its_columns(tmp_path, writer):
    """A right ascension of 0.9 rad was read as 0.9 deg."""
    path = tmp_path / "t.parquet"
    if writer == "astropy":
        QTable({"RA": [0.9, 1.0] * u.rad, "d": Column([1.0, 2.0], unit="mm"), "n": ["a", "b"]}).write(path)
    else:
        columns = {"RA": (np.array([0.9, 1.0]), "rad", ""), "d": (np.ones(2), "mm", ""), "n": (np.zeros(2), "", "none")}
        path.write_bytes(parquet_bytes(path, columns, error=ConfigError))
    columns = read_columns(path)
    assert column_in_unit(columns, "ra", u.deg).tolist() == [0.9, 1.0]
    assert columns["d"].unit == u.mm
    assert getattr(columns["n"], "unit", None) is None


def test_masked_rows_of_parquet_are_no_numbers(tmp_path):
    """astropy writes what a masked row holds, a magnitude of -99 for example, and the mask beside it."""
    path = tmp_path / "t.parquet"
    masked = MaskedColumn([20.0, -99.0], mask=[False, True], unit="mag")
    Table({"mag": masked, "n": MaskedColumn([1, 2], mask=[True, False]), "x [mm]": masked}).write(path)
    columns = read_columns(path)
    assert list(columns) == ["mag", "n", "x [mm]", "x"]
    np.testing.assert_array_equal(column_in_unit(columns, "x", u.m), [0.02, np.nan])
    np.testing.assert_array_equal(column_in_unit(columns, "mag", None), [20.0, np.nan])
    np.testing.assert_array_equal(column_in_unit(columns, "n", None), [np.nan, 2.0])


def test_names_that_units_would_change_are_kept(tmp_path):
    """Bands and numbers in brackets are none, and a column has its own name first."""
    path = tmp_path / "t.csv"
    headings = ("mag [g]", "mag [r]", "flux [1]", "x", "x [deg]", "[m]", "a [no such unit]")
    path.write_text(",".join(headings) + "\n" + ",".join("1234567") + "\n")
    assert tuple(read_columns(path)) == headings


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_names_that_differ_in_capitals_are_two_columns(tmp_path, ending):
    """Johnson's R stood for Sloan's r, which came before it."""
    path = tmp_path / f"t.{ending}"
    write_table(path, Table({"r": [20.0], "R": [19.0], "Mag": [18.0]}))
    columns = read_columns(path)
    assert {name: float(values[0]) for name, values in columns.items()} == {"r": 20.0, "R": 19.0, "mag": 18.0}
    write_table(path, Table({"MAG": [20.0], "Mag": [19.0]}))
    with pytest.raises(ProductError, match=rf"t\.{ending}: columns MAG and Mag: expected names that differ"):
        read_columns(path)


@pytest.mark.parametrize(("scale", "kind"), [("UTC", Time), ("UTC(NTP)", Column)])
def test_times_of_fits_in_any_scale(tmp_path, scale, kind):
    table = Table({"mag": [20.0], "TIME": Column([5.0], unit="d")}, meta={"TIMESYS": scale, "MJDREF": 60000.0})
    table.write(tmp_path / "t.fits")
    columns = read_columns(tmp_path / "t.fits")
    assert columns["mag"].tolist() == [20.0]
    assert isinstance(columns["time"], kind)


def test_fits_has_texts_beyond_ascii_as_escapes(tmp_path):
    """Names of surfaces ended in a traceback, whatever else there was to write."""
    path = tmp_path / "t.fits"
    table = QTable({"name": ["Möbius", "望", "M3"], "ärea": [1.0, 2.0, 3.0] * u.m**2}, meta={"telescope": "Téléscope"})
    table["name"].info.description, before = "Größe", table.copy()
    image = {"map": (np.ones((2, 2)), "m", "Bild von Ω")}
    write_table(path, table, image, [("TELESCOP", "Téléscope", "name")])
    read = QTable.read(path)
    assert list(read["name"]) == [r"M\xf6bius", r"\u671b", "M3"]
    assert read["name"].info.description == r"Gr\xf6\xdfe"
    assert (read["_xe4rea"] == table["ärea"]).all()
    assert read.meta["TELESCOPE" if "TELESCOPE" in read.meta else "telescope"] == r"T\xe9l\xe9scope"
    assert fits.getheader(path, "map")["TELESCOP"] == r"T\xe9l\xe9scope"
    assert (table == before).all()
    assert table.meta == before.meta
