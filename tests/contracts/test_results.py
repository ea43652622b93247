"""Results have a short representation, a table with units, files, a JSON-safe summary, HTML and pictures."""

import dataclasses
import inspect
import json

import numpy as np
import public_calls
import pytest
from astropy.table import QTable
from matplotlib.figure import Figure
from public_names import public_objects

import pachon
from pachon.core.plotting import picture_bytes
from pachon.core.result import Result
from pachon.imaging.image_file import OBJECT_COLUMNS
from pachon.reconstruction.focal_plane_psf.mosaic import PsfShapes
from pachon.studies.baseline.check import Deviation
from pachon.studies.shimming.shim import Motion

# What is tested is made once for the file, in seconds.
pytestmark = pytest.mark.long

PUBLIC = public_objects()
#: A focal plane has a table of its own, which :meth:`from_heights` reads back.
OWN_TABLES = {"FocalPlane"}
KINDS = {name for name, kind in PUBLIC.items() if inspect.isclass(kind) and issubclass(kind, Result)}


def _made_by_hand(made):
    """Tiny results of what takes long."""
    three, shapes = np.zeros(3), PsfShapes(np.zeros(3), np.zeros(3), np.full(3, 1e-6))
    stack = dict.fromkeys(("xi", "eta", "x", "y", "e1", "e2", "size", "model_e1", "model_e2", "model_size"), three)
    stamps = np.ones((3, 5, 5), dtype=np.float32)
    shims = {"merit": "fwhm", "parts": "rafts", "fitted": {}, "checked": {}, "correlations": {}, "focused": made.plane}
    aligned = {"scene": None, "designed": None, "visits": (), "floor": 0.0, "first": None, "last": None}
    visits = {name: np.zeros((3, 2)) for name in ("states", "estimates", "errors")}
    loose = Deviation("spot", "um", 1.0, 0.1, 1.2, None)
    lost = Deviation("opd", "nm", 1.0, 0.1, None, "batoid", "no light")
    return [
        pachon.studies.BaselineCheck("a.json", "lsst", (lost, loose), ()),
        pachon.studies.SweepTable(
            "s", np.arange(3), np.arange(3), {"M2.dz_um": three}, {"median_fwhm": three}, np.array(["", "", "x"]), three
        ),
        pachon.studies.Shims(**shims, focus=Motion(), motions={"R22": Motion(1e-6)}, focal_plane=made.plane),
        pachon.studies.Alignment(**aligned, **visits, expected=three, donuts=np.arange(3)),
        pachon.studies.PsfStack(visits=2, star=three > 0, count=np.arange(3), true=stamps, model=stamps, **stack),
        pachon.reconstruction.StaticHeights(made.plane, np.zeros((189, 2, 2)), 4),
        pachon.FocalPlanePsf(None, three == 0, shapes, {}, np.nan, (), 3e-6, 1e-6, 21),
        dataclasses.replace(made.ccd_image, objects=dict.fromkeys(OBJECT_COLUMNS, three)),
        pachon.sensing.ExposureWavefront(
            np.arange(4, 7), np.eye(3), np.ones((3, 3, 3)), np.eye(3), 1e-7, 0.8, 1.0, None, ("a",)
        ),
        pachon.sensing.FreedomEstimate(made.dofs, three[:1], np.eye(1), np.ones(1)),
        pachon.sensing.ObservatoryZernikes(
            convention="ts_wep",
            frame="CCS",
            unit="um",
            wave=np.nan,
            obscuration=0.6,
            noll=np.array([4, 5]),
            values=np.zeros((1, 2)),
            covariance=np.eye(2)[None],
            fields=np.zeros((1, 2)),
        ),
        pachon.trace(made.tel, made.rays),
        pachon.models.height_statistics(made.plane)["all"],
        pachon.design.Yield.of(np.array([1.0, 2.0, np.nan]), 1.5),
        pachon.sky.GalaxyStamps(np.full(2, 22.0), np.full(2, 1e-6), (), np.zeros((2, 2)), np.eye(2), 1e-7, 1e9, 1e-6),
    ]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A result of each class: of the valid calls of public functions, and their arguments."""
    folder = tmp_path_factory.mktemp("calls")
    made = public_calls._Made(folder)
    several = [getattr(made, name.removeprefix("make_")) for name in dir(made) if name.startswith("make_")]
    several += _made_by_hand(made)
    found = {type(one).__name__: one for one in several if isinstance(one, Result)}
    for function, arguments in public_calls.calls(folder).values():
        kind = inspect.signature(function).return_annotation
        if kind in KINDS and kind not in found:
            found[kind] = function(**arguments)
    return {name: one for name, one in sorted(found.items()) if name in KINDS}


def test_every_result_is_made(results):
    assert set(results) == KINDS


def test_representations_are_short(results):
    for name, result in results.items():
        assert repr(result).startswith((f"<{name}: ", f"<{name} of "))
        assert len(repr(result)) < 200
        assert "array(" not in repr(result)


def test_no_public_object_prints_walls_of_digits(results, tmp_path):
    made = public_calls._Made(tmp_path)
    several = [getattr(made, name.removeprefix("make_")) for name in dir(made) if name.startswith("make_")]
    own = [one for one in several if type(one).__module__.startswith("pachon") and type(one).__name__ in PUBLIC]
    own += [made.spots.request, made.spots.request.pupil, made.lsst.obstructions, made.aberration, made.baseline]
    # A configuration is its text, key by key.
    walls = {type(one).__name__: len(repr(one)) for one in own if len(repr(one)) > 220}
    assert set(walls) <= {"Configuration"}


def test_summaries_are_json(results):
    for name, result in results.items():
        summary = result.summary()
        assert json.loads(json.dumps(summary, allow_nan=False)) == summary, name
        assert all(isinstance(key, str) for key in summary)


def test_tables_have_units_and_descriptions(results):
    for name in results.keys() - OWN_TABLES:
        table = results[name].to_table()
        assert isinstance(table, QTable)
        assert table.colnames, name
        for column in table.colnames:
            assert table[column].info.description, f"{name}.{column}"


@pytest.mark.parametrize(
    ("suffix", "every"),
    [(".ecsv", 3), (".csv", 1), (".fits", 3), (".parquet", 1)]
    + [pytest.param(suffix, 1, marks=pytest.mark.slow) for suffix in (".ecsv", ".fits")],
)
def test_tables_are_written(results, suffix, every, tmp_path):
    """Every third result in the formats that take longest; all of them in the slow form."""
    for name, result in list(results.items())[::every]:
        if type(result).write is not Result.write or name in OWN_TABLES:
            continue
        path = tmp_path / f"{name}{suffix}"
        result.write(path)
        assert path.stat().st_size > 50
        if suffix in (".ecsv", ".fits"):
            read, table = QTable.read(path), result.to_table()
            assert read.colnames == table.colnames
            for column in table.colnames:
                assert getattr(read[column], "unit", None) == getattr(table[column], "unit", None)
                if np.asarray(table[column]).dtype.kind == "f":
                    np.testing.assert_array_equal(np.asarray(read[column]), np.asarray(table[column]))


def test_notebooks_show_table_and_picture(results):
    check_html(results, ["Vignetting", "Shapes", "OpdMap"])


@pytest.mark.slow
def test_notebooks_show_all_tables_and_pictures(results):
    check_html(results, list(results))


def check_html(results, names):
    for name in names:
        html = results[name]._repr_html_()
        assert "<table>" in html
        assert ("data:image/png" in html) == hasattr(results[name], "plot"), name
        assert len(html) < 500_000


def test_pictures_have_the_same_option(results):
    # Yields and parabasal optics are a few numbers.
    numbers = {"ParabasalOptics", "Yield"}
    assert {name for name, result in results.items() if not hasattr(result, "plot")} == numbers
    for name in results.keys() - numbers:
        assert inspect.signature(results[name].plot).parameters["ax"].default is None, name


def test_pictures_are_drawn_where_asked(results):
    check_places(results, ["SpotDiagram", "Correlation", "FieldZernikes"])


@pytest.mark.slow
def test_all_pictures_are_drawn_where_asked(results):
    check_places(results, [name for name, result in results.items() if hasattr(result, "plot")])


def check_places(results, names):
    for name in names:
        result = results[name]
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
        with pytest.raises(pachon.errors.DomainError, match=r"^ax = .*: expected Axes of a grid"):
            results["SpotDiagram"].plot(ax=wrong)


def test_unknown_files_are_refused(results, tmp_path):
    with pytest.raises(pachon.errors.ConfigError, match=r"spots\.txt: expected a file that ends in \.ecsv"):
        results["SpotDiagram"].write(tmp_path / "spots.txt")
