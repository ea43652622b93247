"""The desk of a sweep: linked points, effects of parameters, and points that open."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError, ProductError
from pachon.desk.sweep_views import SweepBench, is_store
from pachon.studies.sweep.file import read_sweep
from pachon.studies.sweep.store import PointResult, SweepStore, create_store
from pachon.studies.sweep.sweep import numbered_points

CONTENT = {
    "name": "motions",
    "base": {"telescope": "lsst_v3.3_i", "changes": {"Camera.dz_um": 5.0}},
    "parameters": {
        "M2.dz_um": {"nominal": 0, "values": [-10, 0, 10]},
        "M2.rx_urad": {"nominal": 0, "values": [0, 5]},
    },
    "metrics": ["fwhm"],
}


def metric_of(point):
    return 0.6 + 0.002 * point["M2.dz_um"] ** 2 + 0.01 * point["M2.rx_urad"] - 0.001 * point["M2.dz_um"]


def store_of(folder, **changes):
    """Return a store whose metric is a polynomial of the parameters; nothing is simulated."""
    sweep, path = read_sweep({**CONTENT, **changes}, "test"), folder / "motions.sweep"
    points = numbered_points(sweep, folder)
    create_store(path, sweep, points, {"folder": str(folder)})
    with SweepStore(path) as store:
        for point in points:
            metrics = {"fwhm_arcsec": metric_of(point.parameters), "rms_e": float(point.number)}
            store.write(PointResult(point.number, metrics, None, 1.0, "here"))
    return path


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return store_of(tmp_path_factory.mktemp("sweep"))


def test_the_tornado_has_the_changes_by_each_parameter_alone(path):
    view = SweepBench(path).tornado("fwhm_arcsec")
    assert view.parameters == ("M2.rx_urad", "M2.dz_um")
    # 0.002 x^2 - 0.001 x at -10 and 10, and 0.01 x at 5.
    np.testing.assert_allclose(view.low, [np.nan, 0.21])
    np.testing.assert_allclose(view.high, [0.05, 0.19])
    assert view.ranges == ("0 to 5", "-10 to 10")
    assert view.axis == "change of fwhm_arcsec from nominal [arcsec]"


def test_other_designs_have_rank_correlations(tmp_path):
    grid = {"kind": "grid"}
    parameters = {"M2.dz_um": {"values": [1, 2, 3, 4]}, "M2.rx_urad": {"values": [0, 1e-3]}}
    view = SweepBench(store_of(tmp_path, design=grid, parameters=parameters)).tornado("fwhm_arcsec")
    assert view.axis == "rank correlation"
    assert view.parameters[-1] == "M2.dz_um"
    # The metric rises with both; ranks of the four values are those of the eight points but for pairs.
    assert view.high[-1] == pytest.approx(np.corrcoef(np.repeat([1.5, 3.5, 5.5, 7.5], 2), np.arange(1, 9))[0, 1])


def test_numbers_are_those_of_the_selected_points(path):
    bench = SweepBench(path)
    values = bench.table.metrics["fwhm_arcsec"]
    numbers = bench.numbers("fwhm_arcsec", [0, 2])
    assert numbers["points selected"] == (2.0, "")
    assert numbers["fwhm_arcsec, largest"] == (max(values[0], values[2]), "arcsec")
    assert bench.numbers("fwhm_arcsec", [])["points"] == (float(len(values)), "")
    assert (bench.label("M2.dz_um"), bench.label("fwhm_arcsec")) == ("M2.dz [um]", "fwhm_arcsec [arcsec]")


def test_a_point_opens_as_the_telescope_of_its_parameters(path):
    sweep = SweepBench(path)
    number = next(int(n) for n, x in zip(sweep.table.number, sweep.parameters["M2.rx_urad"], strict=True) if x)
    bench, state = sweep.opened(number)
    assert bench.model == "lsst_v3.3_i"
    assert state.value("optics.M2_rx") == pytest.approx(np.rad2deg(5e-6) * 3600)
    changes = {"Camera.dz_um": 5.0, "M2.rx_urad": 5.0}
    telescope = pachon.models.apply_changes(pachon.load_telescope("lsst_v3.3_i"), changes)
    radii = [pachon.spots(t, (0.01, 0.01), n_pupil=4).rms_radius[0] for t in (telescope, bench.telescope(state))]
    assert radii[0] == pytest.approx(radii[1], rel=1e-9)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"focal_plane.raft_um": {"nominal": 0, "values": [0, 6]}}, "expected parameters of the telescope alone"),
        ({"R22.dz_um": {"nominal": 0, "values": [0, 6]}}, "expected parameters of the telescope alone"),
        ({"M2.conic": {"nominal": 0, "values": [0, 0.1]}}, "expected a motion, radius or thickness"),
    ],
)
def test_a_point_of_another_kind_is_one_line(parameters, message, tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "metric_of", lambda point: 1.0)
    bench = SweepBench(store_of(tmp_path, parameters=parameters))
    with pytest.raises(DomainError, match=message) as caught:
        bench.opened(1)
    assert str(caught.value).startswith(f"point 1: {next(iter(parameters))}: ")
    with pytest.raises(DomainError, match=r"^point 99: expected one of the sweep, 0 to 1$"):
        bench.opened(99)


def test_telescopes_of_points_are_those_beside_the_sweep(tmp_path, monkeypatch):
    """Wherever the desk is opened."""
    monkeypatch.setitem(globals(), "metric_of", lambda point: 1.0)
    (tmp_path / "files").mkdir()
    thick = pachon.new_telescope("triplet", field_radius=0.1)
    pachon.save_telescope(thick, tmp_path / "files" / "mine.yaml")
    parameters = {"telescope": {"nominal": "mine.yaml", "values": ["mine.yaml"]}}
    changes = {"parameters": parameters, "base": {}, "metrics": ["spots"]}
    path = store_of(tmp_path / "files", **changes)
    bench, _ = SweepBench(path).opened(0)
    assert bench.nominal.surface_names == thick.surface_names


def test_what_is_no_sweep_is_one_line(tmp_path):
    file = tmp_path / "x.sweep"
    file.write_text("SQLite? no")
    assert not is_store(file)
    sweep = read_sweep(CONTENT, "test")
    create_store(tmp_path / "empty.sweep", sweep, numbered_points(sweep, tmp_path), {})
    assert is_store(tmp_path / "empty.sweep")
    with pytest.raises(ProductError, match="no point has been computed yet"):
        SweepBench(tmp_path / "empty.sweep")


@pytest.mark.long
def test_plots_are_linked_and_a_selection_sets_the_point(path):
    pytest.importorskip("bokeh", reason="a desk needs Bokeh: pip install 'pachon[desk]'")
    from pachon.desk.sweep_session import SweepSession

    session = SweepSession(SweepBench(path))
    shown = [plot.figure for plot in (*session.plots, session.against)]
    # One source: a selection in one plot is that of all.
    assert {figure.renderers[0].data_source for figure in shown} == {session.source}
    session.source.selected.indices = [2]
    assert session.point.value == session.bench.table.number[2]
    value = session.bench.metrics["fwhm_arcsec"][2]
    assert f"{value:.4g}" in session.table.text
    session.metric_select.value = "rms_e"
    np.testing.assert_array_equal(session.source.data["metric"], session.bench.metrics["rms_e"])
    assert shown[0].yaxis[0].axis_label.startswith("rms_e")
    document = pachon.open_desk(path).document()
    tornado = document.get_model_by_name("tornado")
    assert tornado.yaxis[0].major_label_overrides == {0: "M2.rx_urad", 1: "M2.dz_um"}
    assert {"tornado", "x0", "x1", "other"} <= {root.name for root in document.roots}
