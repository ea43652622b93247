"""Results have a short representation, a table with units, files, a JSON-safe summary, HTML and pictures."""

import dataclasses
import inspect
import json

import numpy as np
import pytest
from astropy.table import QTable
from matplotlib.figure import Figure
from public_calls import calls

import pachon
from pachon.core.plotting import picture_bytes
from pachon.core.result import Result

PUBLIC = {name: getattr(pachon, name) for name in pachon.__all__}
KINDS = {name for name, kind in PUBLIC.items() if inspect.isclass(kind) and issubclass(kind, Result)}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A result of each class, from the valid calls of public functions."""
    found = {}
    for function, arguments in calls(tmp_path_factory.mktemp("calls")).values():
        kind = inspect.signature(function).return_annotation if inspect.isfunction(function) else None
        if kind in KINDS and kind not in found:
            found[kind] = function(**arguments)
    return found


def test_every_result_is_made(results):
    assert set(results) == KINDS


def test_representations_are_short(results):
    for name, result in results.items():
        assert repr(result).startswith(f"<{name}: ")
        assert len(repr(result)) < 200
        assert "array(" not in repr(result)


def test_summaries_are_json(results):
    for name, result in results.items():
        summary = result.summary()
        assert json.loads(json.dumps(summary, allow_nan=False)) == summary, name
        assert all(isinstance(key, str) for key in summary)


def test_tables_have_units_and_descriptions(results):
    for name, result in results.items():
        table = result.to_table()
        assert isinstance(table, QTable)
        assert len(table) > 0, name
        for column in table.colnames:
            assert table[column].info.description, f"{name}.{column}"


@pytest.mark.parametrize("suffix", [".ecsv", ".csv", ".fits", ".parquet"])
def test_tables_are_written(results, suffix, tmp_path):
    for name, result in results.items():
        if type(result).write is not Result.write and suffix != ".fits":
            continue
        path = tmp_path / f"{name}{suffix}"
        result.write(path)
        assert path.stat().st_size > 50
        if suffix in (".ecsv", ".fits") and type(result).write is Result.write:
            read, table = QTable.read(path), result.to_table()
            assert read.colnames == table.colnames
            for column in table.colnames:
                assert getattr(read[column], "unit", None) == getattr(table[column], "unit", None)
                if np.asarray(table[column]).dtype.kind == "f":
                    np.testing.assert_array_equal(np.asarray(read[column]), np.asarray(table[column]))


def test_notebooks_show_table_and_picture(results):
    for name, result in results.items():
        html = result._repr_html_()
        assert "<table>" in html
        assert ("data:image/png" in html) == hasattr(result, "plot"), name
        assert len(html) < 500_000


def test_pictures_are_drawn_where_asked(results):
    drawn = {name: result for name, result in results.items() if hasattr(result, "plot")}
    assert len(drawn) > 15
    for name, result in drawn.items():
        assert inspect.signature(result.plot).parameters["ax"].default is None, name
        figure = Figure(figsize=(12, 6), layout="constrained")
        left, right = figure.subplots(1, 2)
        left.plot([0.0, 1.0])
        result.plot(ax=right)
        # What was drawn lies in the right half, and the left panel is as it was.
        assert left in figure.axes, name
        assert len(figure.axes) > 1, name
        figure.draw_without_rendering()
        width = figure.bbox.width
        assert left.get_window_extent().x1 < 0.52 * width, name
        assert all(axes.get_window_extent().x0 > 0.48 * width for axes in figure.axes if axes is not left), name


def test_the_units_are_those_of_the_docstrings():
    @dataclasses.dataclass(frozen=True)
    class Lengths(Result):
        """Lengths.

        Attributes
        ----------
        length : ndarray, shape [n]
            Length of a rod [um], measured. Another sentence [s].
        number : ndarray, shape [n]
            Number of rods.
        name : str
            Name.
        """

        _table = ("length", "number", "double")
        length: np.ndarray
        number: np.ndarray
        name: str = "rods"

        @property
        def double(self):
            """Twice the length [um], shape [n]."""
            return 2.0 * self.length

    made = Lengths(np.array([1.0, np.nan]), np.array([2, 3]))
    table = made.to_table()
    assert [str(getattr(table[c], "unit", "")) for c in table.colnames] == ["um", "None", "um"]
    assert table["length"].info.description == "Length of a rod [um], measured"
    assert table["double"].info.description == "Twice the length [um]"
    assert table.meta == {"name": "rods"}
    assert repr(made) == "<Lengths: 2 rows of length, number, double>"
    medians = {"median_length": 1.0, "median_number": 2.5, "median_double": 2.0}
    assert made.summary() == {"name": "rods", "rows": 2, **medians}


def test_bytes_are_equal_for_equal_results(results, tmp_path):
    spots = results["SpotDiagram"]
    for name in ("a.fits", "b.fits"):
        spots.write(tmp_path / name)
    assert (tmp_path / "a.fits").read_bytes() == (tmp_path / "b.fits").read_bytes()
    assert picture_bytes(spots.plot(), "png") == picture_bytes(spots.plot(), "png")


def test_wrong_places_for_pictures_are_refused(results):
    loose = Figure().add_axes((0.1, 0.1, 0.8, 0.8))
    for wrong in ("figure", 5, loose):
        with pytest.raises(pachon.DomainError, match=r"^ax = .*: expected Axes of a grid"):
            results["SpotDiagram"].plot(ax=wrong)


def test_unknown_files_are_refused(results, tmp_path):
    with pytest.raises(pachon.ConfigError, match=r"spots\.txt: expected a file that ends in \.ecsv"):
        results["SpotDiagram"].write(tmp_path / "spots.txt")
