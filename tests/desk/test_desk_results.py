"""Desks of results: tolerances, donuts, visits of a list and stacks, against files and results of Python."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable

import pachon
from pachon.core.errors import DomainError, ProductError
from pachon.core.products import Stamp
from pachon.core.table_files import in_format_of, write_table
from pachon.desk.donut_views import DonutBench, DonutStamps
from pachon.desk.tolerance_views import ToleranceBench
from pachon.desk.visit_views import STACK_KINDS, NightBench, StackBench
from pachon.studies.night.detector_row import COLUMNS
from pachon.studies.night.visit_product import VisitProduct, product_name
from pachon.studies.tolerance.file import ToleranceFile
from pachon.studies.tolerance.product import write_tolerances
from pachon.studies.tolerance.study import run_tolerances
from pachon.studies.visits.stack import PsfStack

STAMP = Stamp("0" * 64, 1)


@pytest.fixture(scope="module")
def drawn():
    """A hundred telescopes within two tolerances."""
    tolerances = [pachon.Tolerance("M2.dx", 4e-4), pachon.Tolerance("M3.dx", 1e-4)]
    options = {"n": 100, "seed": 1, "fields": np.deg2rad([[0.0, 0.0], [0.3, 0.0]]), "compensators": ["Detector.dz"]}
    return pachon.monte_carlo(pachon.paul_baker(), tolerances, "wavefront", **options)


def tolerance_folder(folder, upper_ends=(8.0, 5.25), costs=(3.0, 0.5)):
    """Write the tables of a study of two tolerances of a triplet, one draw of which loses its light."""
    folder.mkdir()
    (folder / "summary.json").write_text(
        json.dumps(
            {"telescope": "triplet", "merit": "spots", "unit": "um", "nominal": 5.0, "compensators": ["Image.dz_um"]}
        )
    )
    draws = QTable({"merit": [5.5, 6.5, np.nan] * u.um})
    draws["Image.dz_um (compensator)"] = [1.0, 2.0, 3.0] * u.um
    draws["L2.dy_um"], draws["S1.conic"] = [10.0, -20.0, 0.0] * u.um, [0.1, 0.2, -0.1]
    draws.write(folder / "draws.ecsv")
    ends = {"lower_end": [6.0, 5.5] * u.um, "upper_end": upper_ends * u.um, "cost": costs * u.um}
    sizes = {"size": [20.0, 0.2], "unit": ["um", "1"]}
    QTable({"name": ["L2.dy_um", "S1.conic"], **sizes, **ends}).write(folder / "sensitivity.ecsv")
    return folder


def donut_table(path):
    """Write a table of three donuts as `pachon donuts` does, of two Zernikes."""
    table = QTable({"field_x": [0.0, 1.0, -1.0] * u.deg, "field_y": [0.5, 0.0, 0.25] * u.deg})
    table["reasons"], table["fwhm"] = ["ok", "blend", "ok"], [0.6, 0.7, 0.8] * u.arcsec
    for j, values in ((4, [30.0, -40.0, 0.0]), (5, [40.0, 30.0, 5.0])):
        table[f"Z{j}"], table[f"Z{j}_err"] = values * u.nm, [1.0, 2.0, 3.0] * u.nm
    table.write(path)
    return path


def night_folder(folder):
    """Write the products of three visits, the second of which failed."""
    (folder / "visits").mkdir(parents=True)
    for number, band, reason in ((7, "r", ""), (8, "r", "below the horizon"), (5, "i", "")):
        rows = {name: np.arange(4) + 0.25 * number for name in COLUMNS if name not in ("visitId", "band")}
        rows["detector"] = np.arange(4)
        rows["expMidptMJD"] = np.full(4, 60000.0 - number / 24)
        product = VisitProduct(number, band, {} if reason else rows, {}, {}, {}, reason)
        product.write(folder / "visits" / product_name(number), STAMP)
    return folder


def stack_folder(folder):
    """Write stacks of one and ten visits: Gaussians of known ellipticity at a grid of points."""
    folder.mkdir()
    y, x = np.mgrid[-15:16, -15:16]
    u_, v = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(-1e-3, 1e-3, 7)]))
    for visits in (1, 10):
        images = [
            np.exp(-0.5 * ((x / (3 * (1 + e))) ** 2 + (y / (3 * (1 - e))) ** 2)) for e in 0.05 * u_ / (1e-3 * visits)
        ]
        true = np.float32(images)
        model = np.float32([np.exp(-0.5 * (x**2 + y**2) / 9.0)] * len(u_))
        zero, size = np.zeros(len(u_)), np.full(len(u_), 3e-6)
        star = np.arange(len(u_)) % 2 == 0
        columns = {"star": star, "count": np.full(len(u_), visits), "true": true, "model": model}
        shapes = {"e1": zero, "e2": zero, "size": size, "model_e1": zero, "model_e2": zero, "model_size": size}
        stack = PsfStack(visits=visits, xi=u_, eta=v, x=u_, y=v, **columns, **shapes)
        stack.write_product(folder / f"stack_{visits:04d}.fits", STAMP)
    return folder


def test_drawn_telescopes_are_points_with_the_units_of_the_study(drawn):
    bench = ToleranceBench.of(drawn)
    # Of wavefronts in nm.
    np.testing.assert_allclose(bench.metrics["wavefront"], 1e9 * drawn.merit)
    assert bench.label("wavefront") == "wavefront [nm]"
    assert set(bench.parameters) == {"M2.dx", "M3.dx", "Detector.dz (compensator)"}
    np.testing.assert_array_equal(bench.parameters["M3.dx"], drawn.deviations[:, 1])
    view = bench.tornado("wavefront")
    np.testing.assert_allclose(view.high, sorted(1e9 * drawn.contribution))
    rows = bench.in_slice("M2.dx", 0.0, 1e-4)
    np.testing.assert_array_equal(rows, [i for i, d in enumerate(drawn.deviations[:, 0]) if 0 <= d <= 1e-4])
    assert bench.numbers("wavefront", rows)["points selected"] == (float(len(rows)), "")


def test_the_folder_of_tolerances_has_the_changes_at_both_ends(tmp_path):
    bench = ToleranceBench.read(tolerance_folder(tmp_path / "tolerance"))
    view = bench.tornado("spots")
    assert view.parameters == ("S1.conic", "L2.dy_um")
    np.testing.assert_allclose((view.low, view.high), ([0.5, 1.0], [0.25, 3.0]))
    assert view.ranges == ("± 0.2", "± 20 um")
    assert view.axis == "change of spots, the tolerance alone [um]"
    assert list(bench.parameters) == ["L2.dy_um", "S1.conic", "Image.dz_um (compensator)"]
    assert bench.numbers("spots", [])["spots, largest"] == (6.5, "um")


def test_a_tolerance_that_loses_the_light_is_the_costliest(tmp_path):
    bench = ToleranceBench.read(tolerance_folder(tmp_path / "tolerance", (8.0, np.nan), (3.0, np.inf)))
    assert list(bench.parameters) == ["S1.conic", "L2.dy_um", "Image.dz_um (compensator)"]
    assert bench.tornado("spots").parameters == ("L2.dy_um", "S1.conic")


def test_a_table_of_donuts_has_their_zernikes(tmp_path):
    bench = DonutBench.read(donut_table(tmp_path / "donuts.ecsv"))
    bars, field = bench.bars(1), bench.over_field(5)
    np.testing.assert_array_equal((bars.x, bars.value, bars.error), ([4, 5], [-40.0, 30.0], [2.0, 2.0]))
    np.testing.assert_array_equal((field.x, field.y, field.value), ([0, 1, -1], [0.5, 0, 0.25], [40, 30, 5]))
    # 30, 40 and 40, 30 nm: 50 nm.
    assert bench.numbers(1)["rms of the wavefront"] == (50.0, "nm")
    assert bench.numbers(0)["rms, median of all"] == (50.0, "nm")
    assert bench.images(0) is None


def test_stamps_of_donuts_are_image_model_and_difference(tmp_path):
    table = DonutBench.read(donut_table(tmp_path / "donuts.ecsv"))
    model = np.arange(1.0, 13.0).reshape(1, 3, 4)
    image = model + 6.0
    stamps = DonutStamps(np.repeat(image, 3, axis=0), np.concatenate([model, model, np.full((1, 3, 4), np.nan)]))
    bench = DonutBench(**{**vars(table), "stamps": stamps})
    [row] = bench.images(0).rows.values()
    np.testing.assert_allclose(row[:, :3], np.concatenate([image, model, np.full((1, 3, 4), 6.0)]) / 12.0)
    # A flagged donut has no model.
    assert bench.images(2) is None


@pytest.mark.parametrize("ending", ["ecsv", "csv"])
def test_zernikes_of_a_table_in_micrometres_are_shown_in_nanometres(tmp_path, ending):
    path = donut_table(tmp_path / "donuts.ecsv")
    expected, table = DonutBench.read(path).zernikes, QTable.read(path)
    for name in ("Z4", "Z4_err", "Z5", "Z5_err"):
        table[name] = table[name].to(u.um)
    path = path.with_suffix(f".{ending}")
    write_table(path, in_format_of(path, table))
    np.testing.assert_allclose(DonutBench.read(path).zernikes, expected, rtol=1e-6)


def test_a_night_has_the_rows_of_its_visits_in_the_order_of_time(tmp_path):
    bench = NightBench(night_folder(tmp_path / "night"))
    assert (list(bench.visits), bench.bands, bench.failed) == (["7", "5"], ("r", "i"), 1)
    times = bench.times(bench.start)
    # 2 hours apart; medians of 0, 1, 2, 3 and a quarter of the number.
    np.testing.assert_allclose((times.x, times.value), ([0.0, 2.0], [1.5 + 1.75, 1.5 + 1.25]), atol=1e-6)
    state = SimpleNamespace(band="i", visit="5", column="magLim")
    sky = bench.sky(state)
    np.testing.assert_allclose((sky.x, sky.value), 2 * [np.arange(4) + 1.25])
    assert sky.label == "magLim [mag]"
    assert bench.numbers(state)["magLim, largest"] == (4.25, "mag")
    assert bench.numbers(bench.start)["visits that failed"] == (1.0, "")


def test_stacks_have_the_adaptive_moments_of_their_images(tmp_path):
    bench = StackBench(stack_folder(tmp_path / "stacks"))
    assert list(bench.stacks) == ["1", "10"]
    g1 = pachon.adaptive_moments(bench.stacks["10"].true, 1.0).g1
    for kind, expected in zip(STACK_KINDS, (g1, 0 * g1, g1), strict=True):
        np.testing.assert_allclose(bench.whiskers("10", kind).e1, expected, atol=1e-7)
    g1 = bench.whiskers("1", "PSF").e1
    assert bench.numbers("1", "PSF")["adaptive ellipticity g, rms"] == (
        pytest.approx(100 * np.sqrt(np.mean(g1**2))),
        "%",
    )
    view = bench.correlation("1", "PSF")
    # Brute force over all pairs, which the bins hold; g2 is zero.
    first, second = np.triu_indices(len(bench.stacks["1"].x), 1)
    assert view.n_pairs.sum() == len(first)
    mean = np.nansum(view.n_pairs * view.xi_plus) / view.n_pairs.sum()
    assert mean == pytest.approx((g1[first] * g1[second]).mean(), rel=1e-5)


def test_what_has_no_page_is_one_line(tmp_path):
    pytest.importorskip("bokeh", reason="a desk needs Bokeh: pip install 'pachon[desk]'")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ProductError, match=r"expected the folder of a run .*, of visits .* or of tolerances"):
        pachon.open_desk(tmp_path / "empty")
    (tmp_path / "visits").mkdir()
    with pytest.raises(ProductError, match="no visit is finished"):
        pachon.open_desk(tmp_path)
    QTable({"x": [1.0]}).write(tmp_path / "stars.ecsv")
    with pytest.raises(ProductError, match="expected the table of pachon donuts"):
        pachon.open_desk(tmp_path / "stars.ecsv")
    broken = tolerance_folder(tmp_path / "tolerance")
    (broken / "summary.json").write_text("{")
    with pytest.raises(ProductError, match="no summary of tolerances"):
        pachon.open_desk(broken)


def test_maps_of_a_night_are_the_pixels_of_its_files(tmp_path):
    healsparse = pytest.importorskip("healsparse", reason="maps need healsparse: pip install 'pachon[healpix]'")
    hpgeom = pytest.importorskip("hpgeom")
    folder = night_folder(tmp_path / "night")
    name = "deepCoadd_psf_size_consolidated_map_weighted_mean_r.hsp"
    pixels = hpgeom.query_circle(512, 359.9, 1.0, 2.0, nest=True)
    written = healsparse.HealSparseMap.make_empty(32, 512, dtype=np.float64)
    written.update_values_pix(pixels, np.linspace(2.0, 3.0, len(pixels)))
    written.metadata = {"BUNIT": "pixel"}
    written.write(str(folder / name), nocompress=True)
    bench = NightBench(folder)
    assert list(bench.maps) == ["psf_size, r"]
    view = bench.map("psf_size, r")
    assert view.label == "psf_size, r [pixel]"
    np.testing.assert_array_equal(view.value, np.linspace(2.0, 3.0, len(pixels)))
    # Corners are beside the centres, on the side of the sky where the visits are (ra of 1 to 5 deg).
    ra, dec = hpgeom.pixel_to_angle(512, np.sort(pixels), nest=True)
    away = np.hypot((view.ra.mean(axis=1) - ra + 180.0) % 360.0 - 180.0, view.dec.mean(axis=1) - dec)
    assert away.max() < 1e-3
    assert np.abs(view.ra).max() < 5.0
    # Of many pixels four are averaged, and again.
    written.update_values_pix(hpgeom.query_circle(512, 3.0, 1.0, 10.0, nest=True), 4.0)
    written.write(str(folder / name), nocompress=True, clobber=True)
    assert len(bench.map("psf_size, r").value) < 6000
    (folder / name).write_bytes(b"SIMPLE")
    with pytest.raises(ProductError, match="damaged or no map"):
        bench.map("psf_size, r")


@pytest.mark.long
def test_every_page_is_made_without_a_browser(tmp_path, drawn):
    pytest.importorskip("bokeh", reason="a desk needs Bokeh: pip install 'pachon[desk]'")
    pages = {
        tolerance_folder(tmp_path / "tolerance"): {"x0", "other", "tornado"},
        donut_table(tmp_path / "donuts.ecsv"): {"field", "zernikes", "stamps"},
        night_folder(tmp_path / "night"): {"sky", "times", "map"},
        stack_folder(tmp_path / "stacks"): {"whiskers", "xi"},
    }
    for source, pictures in pages.items():
        names = {root.name for root in pachon.open_desk(source).document().roots}
        assert pictures | {"sidebar", "status", "numbers"} <= names, source
    assert pachon.open_desk(drawn).name == drawn.telescope


@pytest.mark.long
def test_clicks_and_choices_change_what_is_shown(tmp_path, drawn):
    pytest.importorskip("bokeh", reason="a desk needs Bokeh: pip install 'pachon[desk]'")
    from pachon.desk.donut_session import DonutSession
    from pachon.desk.sweep_session import SweepSession
    from pachon.desk.visit_session import NightSession

    donuts = DonutSession(DonutBench.read(donut_table(tmp_path / "donuts.ecsv")))
    donuts.field.source.selected.indices = [1]
    assert (donuts.donut, donuts.donut_spinner.value) == (1, 1)
    assert "blend" in donuts.status.text
    assert not donuts.stamps.figure.visible
    night = NightSession(NightBench(night_folder(tmp_path / "night")))
    night.times.source.selected.indices = [1]
    assert (night.state.visit, night.visit.value) == ("5", "5")
    # Visit 5 is one of another band.
    night.band.value = "r"
    assert (night.state.visit, night.visit.options) == ("all", ["all", "7"])
    points = SweepSession(ToleranceBench.of(drawn))
    points.slice_select.value = "M2.dx"
    low, high = points.slice_range.value
    inside = np.flatnonzero((drawn.deviations[:, 0] >= low) & (drawn.deviations[:, 0] <= high))
    assert points.source.selected.indices == inside.tolist()
    assert f">{1e9 * drawn.merit[inside].max():.4g}</b>" in points.table.text
    points.show_slice(high, low)
    assert "no point has such a value" in points.status.text
    points.slice_select.value = points.slice_select.options[0]
    assert points.source.selected.indices == []


@pytest.mark.long
def test_a_drawn_telescope_opens_with_the_merit_of_its_draw(tmp_path):
    lens = tmp_path / "lens.yaml"
    pachon.save_telescope(pachon.new_telescope("triplet"), lens)
    content = {
        "telescope": str(lens),
        "fields_deg": [[0.0, 0.0], [0.0, 8.0]],
        "rings": 2,
        # A decentre, a glass, and the shape of a surface, which has no slider.
        "tolerances": [
            {"name": "L2.dy_um", "size": 20},
            {"name": "S1.n", "size": 1e-3},
            {"name": "S1.irregularity_nm", "size": 60, "zernikes": [5, 6]},
        ],
        "compensators": ["Detector.dz_um"],
        "draws": 4,
    }
    file = ToleranceFile.model_validate(content)
    study = run_tolerances(pachon.load_telescope(lens), file, tmp_path / "points.tolerance")
    write_tolerances(study, file, tmp_path)
    bench = ToleranceBench.read(tmp_path)
    opened, state = bench.opened(3)
    assert opened.nominal.name == f"{study.telescope}_draw_3"
    radii = pachon.spots(opened.telescope(state), np.deg2rad(content["fields_deg"]), n_pupil=2).rms_radius
    assert np.sqrt(np.mean(radii**2)) == pytest.approx(study.merit[3], rel=1e-9)
    with pytest.raises(DomainError, match=r"^draw 4: expected one of the study, 0 to 3$"):
        bench.opened(4)
    lens.write_text(lens.read_text().replace("triplet", "other", 1))
    with pytest.raises(ProductError, match="has changed since"):
        bench.opened(3)
