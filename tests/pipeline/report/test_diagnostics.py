import itertools
import json
import re
import shutil

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from pachon.commands.cli import main
from pachon.core.errors import ProductError
from pachon.measure.adaptive_moments import adaptive_moments
from pachon.measure.correlation import SeparationBins
from pachon.measure.correlation_plots import rho_plot
from pachon.measure.rho_statistics import rho_statistics
from pachon.measure.shapes import measure_shapes
from pachon.models.camera.cameras import load_camera
from pachon.pipeline.report import diagnostics, focal_plane_plots
from pachon.pipeline.report.diagnostics import FOLDER_NAME, diagnose
from pachon.pipeline.report.focal_plane_plots import RESIDUAL_TITLES, residual_plot
from pachon.pipeline.summary import separation_bins
from pachon.reconstruction.ccd_product import KINDS, product_path, read_product

CCDS = ("R22_S11", "R24_S12")
ARCSEC = np.pi / 180.0 / 3600.0


@pytest.fixture(scope="module")
def diagnosed(finished_run, tmp_path_factory, undrawn):
    with undrawn():
        return diagnose(finished_run, tmp_path_factory.mktemp("diagnosed"))


@pytest.fixture
def run_copy(finished_run, tmp_path):
    """A run that a test may damage."""
    shutil.copytree(finished_run, tmp_path / "run")
    return tmp_path / "run"


def test_residuals_of_each_ccd_are_those_of_its_product(finished_run, diagnosed):
    assert list(diagnosed.table["ccd"]) == list(CCDS)
    for name in CCDS:
        row = diagnosed.table[list(CCDS).index(name)]
        with fits.open(product_path(finished_run, name)) as hdus:
            stars, truth = np.array(hdus["STARS"].data), np.array(hdus["TRUTH"].data)
        e1, e2 = stars["E1"] - stars["LOO_E1"], stars["E2"] - stars["LOO_E2"]
        # Sums of a dozen stars in another order.
        assert row["mean_e1_residual"] == pytest.approx(np.nanmean(stars["RES_E1"]), rel=1e-9)
        assert row["mean_e2_left_out"] == pytest.approx(np.nanmean(e2), rel=1e-9)
        assert row["rms_e_left_out"] == pytest.approx(np.sqrt(np.nanmean(np.concatenate([e1, e2]) ** 2)), rel=1e-9)
        assert row["mean_e2_away"] == pytest.approx(np.nanmean(truth["RES_E2"]), rel=1e-9)
        squares = np.concatenate([truth["RES_E1"], truth["RES_E2"]]) ** 2
        assert row["rms_e_away"] == pytest.approx(np.sqrt(np.nanmean(squares)), rel=1e-9)
        assert (row["stars"], row["truth_psfs"]) == (12, 14)


def test_sizes_are_of_the_model_at_the_star(finished_run, diagnosed):
    for name in CCDS:
        row = diagnosed.table[list(CCDS).index(name)]
        product = read_product(product_path(finished_run, name))
        for kind, stars in (("residual", product.observed), ("away", product.holdout)):
            images = product.model.at(np.stack([stars.x, stars.y], axis=1))
            model = measure_shapes(images, product.pixel_scale, 0.7 * ARCSEC)
            # The product was made with the same weight: its ellipticities of the model come out again.
            np.testing.assert_allclose(model.e1, stars.model_e1, rtol=0.0, atol=1e-12)
            # Kept in arcseconds: there and back costs one rounding each.
            np.testing.assert_allclose(model.size, stars.model_size, rtol=1e-14)
            # T from the semi-axes: sqrt(a b) = size, (a - b)/(a + b) = |e|.
            q = [(1 - np.hypot(*e)) / (1 + np.hypot(*e)) for e in ((stars.e1, stars.e2), (model.e1, model.e2))]
            trace, model_trace = (s**2 * (r + 1 / r) for s, r in zip((stars.size, model.size), q, strict=True))
            growth = (trace - model_trace) / trace
            assert row[f"mean_dt_{kind}"] == pytest.approx(np.nanmean(growth), rel=1e-8)
            assert row[f"rms_dt_{kind}"] == pytest.approx(np.sqrt(np.nanmean(growth**2)), rel=1e-8)


def test_adaptive_moments_are_those_of_stars_and_models(finished_run, diagnosed):
    for name in CCDS:
        row = diagnosed.table[list(CCDS).index(name)]
        product = read_product(product_path(finished_run, name))
        observed, holdout = product.observed, product.holdout
        # The products hold images in single precision; of the holdout positions, they were measured before.
        star = adaptive_moments(product.observed_images, product.pixel_scale)
        np.testing.assert_allclose(observed.g1, star.g1, atol=1e-6)
        np.testing.assert_allclose(observed.sigma, star.sigma, rtol=1e-6)
        np.testing.assert_allclose(
            holdout.g2, adaptive_moments(product.holdout_images, product.pixel_scale).g2, atol=1e-6
        )
        left_out = adaptive_moments(product.model.leave_one_out(), product.pixel_scale)
        np.testing.assert_allclose(observed.leave_one_out_g1[observed.used], left_out.g1, atol=1e-9)
        for kind, stars in (("residual", observed), ("away", holdout)):
            model = adaptive_moments(product.model.at(np.stack([stars.x, stars.y], axis=1)), product.pixel_scale)
            np.testing.assert_allclose(stars.model_g2, model.g2, atol=1e-9)
            np.testing.assert_allclose(stars.model_sigma, model.sigma, rtol=1e-9)
            g = np.concatenate([stars.g1 - model.g1, stars.g2 - model.g2])
            assert row[f"rms_g_{kind}"] == pytest.approx(np.sqrt(np.nanmean(g**2)), rel=1e-6)
            q = [(1 - np.hypot(*e)) / (1 + np.hypot(*e)) for e in ((stars.g1, stars.g2), (model.g1, model.g2))]
            trace, model_trace = (s**2 * (r + 1 / r) for s, r in zip((stars.sigma, model.sigma), q, strict=True))
            assert row[f"mean_dt_g_{kind}"] == pytest.approx(np.nanmean(1.0 - model_trace / trace), rel=1e-6)
        square = holdout.g1**2 + holdout.g2**2
        trace = holdout.sigma**2 * (1.0 + square) / (1.0 - square)
        assert row["rms_scatter_dt_g"] == pytest.approx(np.std(trace) / np.mean(trace), rel=1e-9)
        for moments, (e1, e2) in (("e", (holdout.e1, holdout.e2)), ("g", (holdout.g1, holdout.g2))):
            about_mean = np.sqrt(0.5 * (np.nanvar(e1) + np.nanvar(e2)))
            assert row[f"rms_scatter_{moments}"] == pytest.approx(about_mean, rel=1e-9)


def test_rho_statistics_of_g_are_of_adaptive_moments(finished_run, diagnosed):
    products = [read_product(product_path(finished_run, name)) for name in CCDS]
    stars = [p.holdout for p in products]
    x, y = np.concatenate([p.sky_positions("away") for p in products], axis=1)
    keys = ("g1", "g2", "sigma", "model_g1", "model_g2", "model_sigma")
    columns = [np.concatenate([getattr(s, key) for s in stars]) for key in keys]
    expected = rho_statistics(x, y, *columns, bins=separation_bins(products))
    for name, rho in expected.items():
        np.testing.assert_array_equal(getattr(diagnosed.rho_g["away"], name).xi_plus, rho.xi_plus)
    np.testing.assert_allclose(
        diagnosed.rho_g["away"].rho1.xi_plus, diagnosed.correlations_g["away"].xi_plus, rtol=1e-12
    )


def test_figures_of_the_whole_run_are_those_of_its_summary(finished_run, diagnosed):
    summary = json.loads((finished_run / "summary.json").read_text())
    for kind, key in (("residual", "at_stars"), ("left_out", "left_out"), ("away", "away")):
        # The file has nine digits.
        assert diagnosed.overall[f"rms_e_{kind}"] == pytest.approx(summary["all"][f"rms_residual_{key}"], rel=1e-8)
        assert diagnosed.overall[f"rms_g_{kind}"] == pytest.approx(summary["all"][f"rms_residual_g_{key}"], rel=1e-8)
        assert diagnosed.overall[f"rms_dt_g_{kind}"] == pytest.approx(summary["all"][f"rms_dt_g_{key}"], rel=1e-8)
    for kind, correlation in summary["correlation"].items():
        ours = diagnosed.correlations[kind]
        in_g = np.array(summary["correlation_g"][kind]["xi_plus"], dtype=float)
        np.testing.assert_allclose(diagnosed.correlations_g[kind].xi_plus, in_g, rtol=5e-9, atol=1e-12)
        np.testing.assert_array_equal(ours.n_pairs, correlation["pairs"])
        xi = np.array(correlation["xi_plus"], dtype=float)
        # Nine digits in the file are good to 5e-9.
        np.testing.assert_allclose(ours.xi_plus, xi, rtol=5e-9, atol=1e-13)
        assert ours.n_patches == 0
        assert np.isnan(diagnosed.overall[f"largest_{kind}_error_plus"])
    assert tuple(diagnosed.correlations) == KINDS


def test_rho_one_is_the_correlation_of_the_residual(diagnosed):
    for kind in ("residual", "away"):
        rho, xi = diagnosed.rho[kind].rho1, diagnosed.correlations[kind]
        np.testing.assert_allclose(rho.xi_plus, xi.xi_plus, rtol=1e-12)
        np.testing.assert_array_equal(rho.n_pairs, xi.n_pairs)


def test_largest_correlation_is_sought_between_10_arcmin_and_3_degrees(diagnosed):
    # The two CCDs lie 83' apart, and each is 13.7' across.
    for kind, c in diagnosed.correlations.items():
        inside = (c.r_arcmin >= 10.0) & (c.r_arcmin <= 180.0) & (c.n_pairs > 0)
        assert inside.any()
        assert abs(diagnosed.overall[f"largest_{kind}_xi_plus"]) == np.abs(c.xi_plus[inside]).max()
        assert 10.0 <= diagnosed.overall[f"largest_{kind}_r_arcmin"] <= 180.0


def test_files_hold_what_was_returned(diagnosed):
    assert sorted(p.name for p in diagnosed.folder.iterdir()) == sorted(diagnosed.files)
    table = Table.read(diagnosed.folder / "ccds.ecsv")
    assert table.colnames == diagnosed.table.colnames
    np.testing.assert_array_equal(table["rms_e_away"], diagnosed.table["rms_e_away"])
    assert all(column.description for column in table.itercols())
    xi = Table.read(diagnosed.folder / "correlations.ecsv")
    chosen = xi[xi["kind"] == "away"]
    np.testing.assert_array_equal(chosen["xi_plus"], diagnosed.correlations["away"].xi_plus)
    np.testing.assert_array_equal(chosen["error_plus"], diagnosed.correlations["away"].error_plus)
    # Two CCDs are too few for a jackknife.
    assert "scatter" in chosen["error_plus"].description
    rho = Table.read(diagnosed.folder / "rho.ecsv")
    np.testing.assert_array_equal(rho[rho["kind"] == "away rho4"]["xi_plus"], diagnosed.rho["away"].rho4.xi_plus)
    assert len(set(rho["kind"])) == 10
    for name in ("residuals", "correlations", "rho"):
        assert (diagnosed.folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_same_bytes_again(finished_run, tmp_path):
    first, again = (diagnose(finished_run, tmp_path / name) for name in ("first", "again"))
    for name in first.files:
        assert (again.folder / name).read_bytes() == (first.folder / name).read_bytes()


@pytest.fixture
def no_pictures(monkeypatch):
    for name in ("residual_plot", "correlation_plot", "rho_plot"):
        monkeypatch.setattr(diagnostics, name, lambda *_: b"")


@pytest.mark.slow
def test_an_unfinished_run_of_one_ccd(run_copy):
    product_path(run_copy, CCDS[1]).unlink()
    result = diagnose(run_copy)
    assert result.folder == run_copy / FOLDER_NAME
    assert result.missing == {CCDS[1]: f"CCD {CCDS[1]}: has no product yet"}
    assert list(result.table["ccd"]) == [CCDS[0]]
    assert result.correlations["away"].n_patches == 0
    assert "scatter" in Table.read(result.folder / "correlations.ecsv")["error_plus"].description


@pytest.mark.parametrize("damaged", [b"", b"no FITS at all", None], ids=["empty", "no FITS", "cut short"])
def test_a_damaged_product_is_left_out_and_the_others_stay_as_they_were(diagnosed, run_copy, no_pictures, damaged):
    path = product_path(run_copy, CCDS[0])
    path.write_bytes(path.read_bytes()[:5000] if damaged is None else damaged)
    result = diagnose(run_copy)
    assert list(result.missing) == [CCDS[0]]
    assert str(path) in result.missing[CCDS[0]]
    assert list(result.table["ccd"]) == [CCDS[1]]
    for key in ("mean_e1_residual", "rms_e_away", "rms_dt_away"):
        assert result.table[key][0] == diagnosed.table[key][1]
    with pytest.raises(ProductError, match=path.name):
        diagnose(run_copy, strict=True)


def test_why_a_ccd_was_not_modelled_is_told_again(run_copy, no_pictures, capsys):
    product_path(run_copy, CCDS[1]).unlink()
    summary = json.loads((run_copy / "summary.json").read_text())
    (run_copy / "summary.json").write_text(json.dumps({**summary, "not_modelled": {CCDS[1]: "too few stars"}}))
    assert diagnose(run_copy).missing == {CCDS[1]: f"CCD {CCDS[1]}: too few stars"}
    assert main(["diagnose", str(run_copy)]) == 0
    assert f"1 CCD is left out; the first: CCD {CCDS[1]}: too few stars" in capsys.readouterr().out
    assert main(["diagnose", str(run_copy), "--strict"]) == 2
    assert capsys.readouterr().err == f"pachon: error: CCD {CCDS[1]}: too few stars\n"


def test_bad_input_is_one_line(run_copy, tmp_path, capsys):
    for folder, message in ((tmp_path, "there is no config.yaml"), (tmp_path / "none", "there is no config.yaml")):
        with pytest.raises(ProductError, match=message):
            diagnose(folder)
    path = product_path(run_copy, CCDS[0])
    whole = path.read_bytes()
    path.write_bytes(whole[:5000])
    with pytest.raises(ProductError, match=f"{path.name}: damaged"):
        diagnose(run_copy, strict=True)
    path.write_bytes(whole)
    config = run_copy / "config.yaml"
    config.write_text(config.read_text().replace("seed: 1 ", "seed: 2 "))
    with pytest.raises(ProductError, match="another version, configuration or seed"):
        diagnose(run_copy)
    for name in CCDS:
        product_path(run_copy, name).unlink()
    with pytest.raises(ProductError, match="none of its 2 CCDs is finished"):
        diagnose(run_copy)
    config.write_text("seed: 1\n")
    with pytest.raises(ProductError, match=r"no configuration that pachon run wrote"):
        diagnose(run_copy)
    assert main(["diagnose", str(run_copy)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("pachon: error: ")


def test_a_file_in_place_of_the_folder(finished_run, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ProductError, match="cannot make the folder"):
        diagnose(finished_run, tmp_path / "file" / "out")


def test_command_line(finished_run, tmp_path, capsys, no_pictures):
    assert main(["diagnose", str(finished_run), "--out", str(tmp_path / "a"), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    written = json.loads((tmp_path / "a" / "diagnostics.json").read_text())
    assert {key: written[key] for key in figures} == figures
    assert main(["diagnose", str(finished_run), "--out", str(tmp_path / "b")]) == 0
    out = capsys.readouterr().out
    assert "noise-free - model, at holdout positions" in out
    assert "at [arcmin]" in out
    assert "…" not in out
    assert out.endswith(f"diagnostics: {(tmp_path / 'b').resolve()}\n")
    assert main(["diagnose", str(finished_run), "--out", str(tmp_path / "b"), "--quiet"]) == 0
    assert capsys.readouterr().out == f"diagnostics: {(tmp_path / 'b').resolve()}\n"
    assert main(["diagnose", "--help"]) == 0
    assert "pachon diagnose " in capsys.readouterr().out.partition("Examples")[2]


def test_pictures_of_ccds_without_figures(diagnosed):
    figures = {name: np.array(diagnosed.table[name]) for name in diagnosed.table.colnames}
    for name in figures:
        if name.startswith(("mean", "rms")):
            figures[name] = figures[name].copy()
            figures[name][0] = np.nan
    camera = load_camera("lsst")
    assert residual_plot(camera, figures).startswith(b"\x89PNG")
    for name in figures:
        if name.startswith(("mean", "rms")):
            figures[name][:] = 0.0
    assert residual_plot(camera, figures).startswith(b"\x89PNG")


@pytest.mark.parametrize("names", [["R22_S11"], ["R22_S11", "R24_S12"], ["R21_S11", "R22_S11", "R32_S11"]])
def test_no_words_of_the_picture_of_residuals_overlap(names, monkeypatch):
    monkeypatch.setattr(focal_plane_plots, "png_bytes", lambda figure: figure)
    camera = load_camera("lsst")
    kinds = [f"{what}_{kind}" for what in ("rms_e", "mean_e1", "mean_e2", "mean_dt") for kind in RESIDUAL_TITLES]
    columns = dict.fromkeys(kinds, np.full(len(names), 0.002))
    x, y = 1e3 * camera.centers[[camera.ccd_index(name) for name in names]].T
    figure = residual_plot(camera, {**columns, "ccd": np.array(names), "x_mm": x, "y_mm": y})
    figure.draw_without_rendering()
    words = [text for text in figure.findobj(Text) if re.search("[a-z%]", text.get_text())]
    boxes = [text.get_window_extent() for text in words]
    assert [
        (words[i].get_text(), words[j].get_text())
        for i, j in itertools.combinations(range(len(words)), 2)
        if Bbox.intersection(boxes[i], boxes[j]) is not None
    ] == []
    outer = figure.bbox
    assert all(outer.x0 <= box.x0 and box.x1 <= outer.x1 and box.y1 <= outer.y1 for box in boxes)


@pytest.mark.long
def test_picture_of_a_perfect_model():
    rng = np.random.default_rng(0)
    x, y, e1, e2 = rng.uniform(0.0, 0.01, (4, 50))
    size = np.full(50, 0.3)
    rho = rho_statistics(x, y, e1, e2, size, e1, e2, size, bins=SeparationBins(1e-3, 0.01, 4))
    assert rho_plot({"residual": rho, "away": rho}).startswith(b"\x89PNG")
