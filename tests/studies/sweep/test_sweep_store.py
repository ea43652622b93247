import json
import sqlite3

import numpy as np
import pytest
from astropy.table import Table

import pachon
from pachon.core.errors import ConfigError, ProductError
from pachon.studies.sweep.file import read_sweep
from pachon.studies.sweep.store import PointResult, SweepPoint, SweepStore, check_same_sweep, create_store
from pachon.studies.sweep.table import export_table, salvage

SWEEP = read_sweep({"parameters": {"b": {"nominal": 0, "range": [0, 1]}, "a": {"nominal": 0, "range": [0, 1]}}}, "test")
POINTS = [SweepPoint(i, {"b": 0.1 * i, "a": 0.3}, 7) for i in range(40)]


def result(number, **metrics):
    return PointResult(number, metrics or {"xi_nm": 0.1 * number + 0.2, "rms": 1e-300}, None, 0.5, "here")


@pytest.fixture
def store(tmp_path):
    path = tmp_path / "sweep.db"
    create_store(path, SWEEP, POINTS, {})
    with SweepStore(path) as opened:
        yield opened


def test_points_and_figures_come_back_to_the_last_bit(store):
    assert store.points() == POINTS
    assert store.sweep == SWEEP
    rng = np.random.default_rng(1)
    written = [PointResult(i, {"x": float(rng.normal() * 10.0**i)}, None, 0.1, "w") for i in range(-0, 20)]
    for one in written:
        store.write(one)
    assert store.results() == written
    assert store.finished() == set(range(20))


def test_a_point_is_written_once(store):
    store.write(result(3, x=1.0))
    store.write(result(3, x=2.0))
    assert [r.metrics for r in store.results()] == [{"x": 1.0}]


def test_problems_are_kept_and_can_be_forgotten(store):
    store.write(PointResult(0, None, "no light", 0.1, "w"))
    store.write(result(1))
    assert store.results()[0].problem == "no light"
    assert store.forget_problems() == 1
    assert store.finished() == {1}


def test_not_a_number_survives(store):
    store.write(result(0, x=float("nan")))
    assert np.isnan(store.results()[0].metrics["x"])


def test_another_sweep_is_refused_with_what_differs(store):
    other = SWEEP.model_copy(update={"metrics": ("fwhm",)})
    with pytest.raises(ConfigError, match=r"store of another sweep \(metrics: .*\"fwhm\"\]\); give another -o"):
        check_same_sweep(store, other)
    check_same_sweep(store, SWEEP)


def test_stores_that_are_none_are_refused(tmp_path):
    with pytest.raises(ProductError, match="no such file"):
        SweepStore(tmp_path / "none.db")
    (tmp_path / "text.db").write_text("this is no database, but long enough to be taken for one" * 50)
    with pytest.raises(ProductError, match="damaged, or no store of a sweep"):
        SweepStore(tmp_path / "text.db")
    sqlite3.connect(tmp_path / "empty.db").execute("CREATE TABLE t (x)")
    with pytest.raises(ProductError, match="damaged, or no store of a sweep"):
        SweepStore(tmp_path / "empty.db")


@pytest.mark.long
def test_a_full_disk_is_one_line_and_loses_nothing(store, monkeypatch):
    store.write(result(0))
    connect = sqlite3.connect

    def connect_to_full_disk(*arguments, **keywords):
        # SQLite says "database or disk is full" when it may take no more pages, as it does when the disk has none.
        connection = connect(*arguments, **keywords)
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
        connection.execute(f"PRAGMA max_page_count = {pages}")
        return connection

    monkeypatch.setattr(sqlite3, "connect", connect_to_full_disk)
    with (
        SweepStore(store.path) as full,
        pytest.raises(ProductError, match=r"full; what was computed before is kept, go on with --resume"),
    ):
        full.write(result(1, **{f"x{i}": 0.1 for i in range(40_000)}))
    assert store.results() == [result(0)]


@pytest.mark.parametrize("ending", ["ecsv", "csv", "fits", "parquet"])
def test_tables_hold_every_point_in_order(store, tmp_path, ending):
    if ending == "parquet":
        pytest.importorskip("pyarrow")
    for number in (5, 2, 9):
        store.write(result(number))
    store.write(PointResult(7, None, "no light", 0.1, "w"))
    path = tmp_path / f"table.{ending}"
    assert export_table(store, path) == 4
    if ending == "parquet":
        from pyarrow import parquet

        table = parquet.read_table(path).to_pydict()
    else:
        table = Table.read(path)
    assert list(table["number"]) == [2, 5, 7, 9]
    assert np.allclose(table["b"], [0.2, 0.5, 0.7, 0.9], rtol=0, atol=1e-15)
    xi = np.ma.filled(np.ma.array(table["xi_nm"], dtype=float), np.nan)
    assert np.array_equal(xi, [0.1 * 2 + 0.2, 0.1 * 5 + 0.2, np.nan, 0.1 * 9 + 0.2], equal_nan=True)
    if ending == "ecsv":
        assert str(table["xi_nm"].unit) == "nm"
        assert table.colnames[2:4] == ["b", "a"], "parameters in the order of the sweep's file"


def test_exports_without_points_or_of_unknown_kind_are_refused(store, tmp_path):
    with pytest.raises(ProductError, match="no point has been computed yet"):
        export_table(store, tmp_path / "t.ecsv")
    store.write(result(0))
    with pytest.raises(ConfigError, match=r"t\.xls: expected a file that ends in \.ecsv, \.csv, \.fits, \.parquet"):
        export_table(store, tmp_path / "t.xls")


@pytest.mark.long
def test_what_can_be_read_of_a_damaged_store_is_saved(tmp_path):
    path = tmp_path / "sweep.db"
    points = [SweepPoint(i, {"b": 0.1 * i, "a": 0.3}, 7) for i in range(2000)]
    create_store(path, SWEEP, points, {})
    with SweepStore(path) as opened:
        for number in range(2000):
            opened.write(result(number))
    data = bytearray(path.read_bytes())
    # Four pages of 4096 bytes are overwritten, near the end, where the results are.
    start = (len(data) // 4096 - 12) * 4096
    data[start : start + 4 * 4096] = b"\xff" * (4 * 4096)
    path.write_bytes(data)
    kept = salvage(path, tmp_path / "saved.ecsv")
    table = Table.read(tmp_path / "saved.ecsv")
    assert 1000 < kept < 2000
    assert len(table) == kept
    assert np.array_equal(table["xi_nm"], 0.1 * table["number"] + 0.2)
    (tmp_path / "text.db").write_text("nothing")
    with pytest.raises(ProductError, match="nothing can be read of it"):
        salvage(tmp_path / "text.db", tmp_path / "saved.ecsv")


def test_the_sweep_is_kept_as_people_wrote_it(store):
    assert list(json.loads(store.about["sweep"])["parameters"]) == ["b", "a"]


def test_a_store_is_loaded_as_a_table(store):
    for number in (5, 2):
        store.write(result(number))
    table = pachon.studies.load_sweep_table(store.path)
    assert table.number.tolist() == [2, 5]
    assert table.parameters["b"].tolist() == [0.1 * 2, 0.1 * 5]
    assert table.metrics["xi_nm"].tolist() == [0.1 * 2 + 0.2, 0.1 * 5 + 0.2]
