"""Runs with a model of the whole focal plane: what stands where in the products, and that any way there is the same."""

import json
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import yaml
from astropy.io import fits

from pachon.commands.cli import main
from pachon.core.errors import ConfigError, DomainError, ProductError, UnknownNameError
from pachon.core.long_work import Execution
from pachon.core.progress import Reporter
from pachon.measure.adaptive_moments import adaptive_moments
from pachon.measure.correlation import shear_correlation
from pachon.models.camera.cameras import load_camera
from pachon.pipeline import focal_plane_stage, run_folder
from pachon.pipeline.config import to_yaml
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.focal_plane_stage import FOCAL_PLANE_PSF_NAME, apply_focal_plane_model
from pachon.pipeline.report import pictures as pictures_module
from pachon.pipeline.report.diagnostics import diagnose
from pachon.pipeline.report.tables import headline, models_rows
from pachon.pipeline.run import run
from pachon.pipeline.run_folder import stamp_of
from pachon.pipeline.summary import correlations, run_metrics, separation_bins
from pachon.reconstruction.ccd_product import CCD_KINDS, KINDS, of_ccd_model, read_product
from pachon.reconstruction.focal_plane_psf.model import FocalPlanePsf

CCDS = ("R22_S11", "R22_S12")
ARCSEC = np.pi / 180.0 / 3600.0
#: What the tables of a product hold of a model.
OF_MODEL = {"MODEL_E1", "MODEL_E2", "MODELSZ", "RES_E1", "RES_E2", "LOO_E1", "LOO_E2"}
OF_MODEL |= {"MODEL_G1", "MODEL_G2", "MODELSIG", "LOO_G1", "LOO_G2", "LOO_SIG"}
ADDED = ["CCD_E1", "CCD_E2", "CCD_SIZE", "CCD_G1", "CCD_G2", "CCD_SIG", "SIG_E1", "SIG_E2", "SIG_SIZE"]


@pytest.fixture
def no_report(monkeypatch):
    monkeypatch.setattr("pachon.pipeline.report.pictures.draw_pictures", lambda *_: [])


@pytest.fixture(scope="module")
def focal_plane_config(focal_plane_config, tmp_path_factory):
    """The configuration of two CCDs on a camera of their raft alone: heights of 9 CCDs are fitted, not of 189."""
    lsst = load_camera("lsst")
    raft = [i for i, name in enumerate(lsst.ccd_names) if name.startswith("R22")]
    ccds = [
        {"name": lsst.ccd_names[i], "raft": "R22", "x_mm": x, "y_mm": y, "pixels": lsst.pixels[i].tolist()}
        for i, (x, y) in zip(raft, (1e3 * lsst.centers[raft]).tolist(), strict=True)
    ]
    path = tmp_path_factory.mktemp("camera") / "raft.yaml"
    path.write_text(yaml.safe_dump({"name": "raft", "source": "test", "pixel_um": 10, "ccds": ccds}))
    return partial(focal_plane_config, camera=str(path), focal_plane__budget="simulated")


@pytest.fixture(scope="module")
def whole_run(focal_plane_config, tmp_path_factory):
    """The folder of a finished run with the real model; its report has no pictures."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pachon.pipeline.report.pictures.draw_pictures", lambda *_: [])
        run(focal_plane_config(), folder, execution=Execution(threads=1))
    return folder


@pytest.fixture(scope="module")
def ccd_run(focal_plane_config, tmp_path_factory):
    """The same run with the models of single CCDs alone."""
    folder = tmp_path_factory.mktemp("single") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pachon.pipeline.report.pictures.draw_pictures", lambda *_: [])
        run(focal_plane_config(reconstruction__model="ccd"), folder, execution=Execution(threads=1))
    return folder


@pytest.fixture(scope="module")
def products(ccd_run):
    return [read_product(ccd_run / f"ccd_{name}.fits") for name in CCDS]


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.name != "timings.json"}


def tables(folder, name, *extensions):
    with fits.open(folder / f"ccd_{name}.fits") as hdus:
        return [np.array(hdus[e].data) for e in extensions]


@pytest.mark.long
def test_a_run_with_a_focal_plane_model_leaves_one_file_more(whole_run, ccd_run, focal_plane_config):
    names = {p.name for p in ccd_run.iterdir()}
    assert {p.name for p in whole_run.iterdir()} == names | {FOCAL_PLANE_PSF_NAME}
    assert FOCAL_PLANE_PSF_NAME == "focal_plane_psf.fits"
    header = fits.getheader(whole_run / FOCAL_PLANE_PSF_NAME)
    assert stamp_of(Experiment.from_config(focal_plane_config())).matches(header)


@pytest.mark.long
def test_columns_of_the_model_are_those_of_the_focal_plane_and_the_ccds_own_stay_beside(whole_run, ccd_run):
    model = FocalPlanePsf.read(whole_run / FOCAL_PLANE_PSF_NAME)
    for name in CCDS:
        for extension in ("STARS", "TRUTH"):
            (now,), (before,) = (tables(folder, name, extension) for folder in (whole_run, ccd_run))
            assert [n for n in now.dtype.names if n not in ADDED] == list(before.dtype.names)
            assert [n for n in now.dtype.names if n in ADDED] == ADDED
            for key in set(before.dtype.names) - OF_MODEL:
                assert now[key].tobytes() == before[key].tobytes()
            for own, key in (
                ("CCD_E1", "MODEL_E1"),
                ("CCD_E2", "MODEL_E2"),
                ("CCD_SIZE", "MODELSZ"),
                ("CCD_G1", "MODEL_G1"),
                ("CCD_SIG", "MODELSIG"),
            ):
                assert now[own].tobytes() == before[key].tobytes()
            x, y = now["X"].astype(float) * 1e-3, now["Y"].astype(float) * 1e-3
            shapes, sigma = model.shapes(name, x, y), model.uncertainty(name, x, y)
            for start, found in (("MODEL_E", shapes), ("SIG_E", sigma)):
                # Read from its file, the model may round in another order.
                np.testing.assert_allclose(now[f"{start}1"], found.e1, rtol=0.0, atol=1e-9)
                np.testing.assert_allclose(now[f"{start}2"], found.e2, rtol=0.0, atol=1e-9)
            if extension == "TRUTH":
                # Adaptive moments of the mean star are as near to the true PSF's as those of the drawn image.
                drawn = adaptive_moments(model.draw(name, x, y), 0.2 * ARCSEC)
                for true, column, adaptive in (
                    (now["G1"], now["MODEL_G1"], drawn.g1),
                    (now["G2"], now["MODEL_G2"], drawn.g2),
                    (np.log(now["SIGMA"] * ARCSEC), np.log(now["MODELSIG"] * ARCSEC), np.log(drawn.sigma)),
                ):
                    assert np.std(true - column) < 1.1 * np.std(true - adaptive)
            np.testing.assert_allclose(now["MODELSZ"] * ARCSEC, shapes.size, rtol=1e-9)
            np.testing.assert_allclose(now["SIG_SIZE"] * ARCSEC, sigma.size, rtol=1e-6)
            for i in "12":
                np.testing.assert_array_equal(now[f"RES_E{i}"], now[f"E{i}"] - now[f"MODEL_E{i}"])
                assert not np.array_equal(now[f"MODEL_E{i}"], before[f"MODEL_E{i}"])
                assert (now[f"SIG_E{i}"] > 0.0).all()


@pytest.mark.long
def test_all_else_in_a_product_keeps_its_bytes(whole_run, ccd_run):
    for name in CCDS:
        with fits.open(whole_run / f"ccd_{name}.fits") as now, fits.open(ccd_run / f"ccd_{name}.fits") as before:
            assert [h.name for h in now] == [h.name for h in before]
            assert (now[0].header["PSFMODEL"], "PSFMODEL" in before[0].header) == ("focal_plane", False)
            for one, other in zip(now[1:], before[1:], strict=True):
                if one.name not in ("STARS", "TRUTH"):
                    assert one.header.tostring() == other.header.tostring()
                    assert one.data.tobytes() == other.data.tobytes()
        # Checksums hold.
        assert read_product(whole_run / f"ccd_{name}.fits").has_focal_plane_model


def test_default_runs_have_no_more_columns(finished_run):
    assert not (finished_run / FOCAL_PLANE_PSF_NAME).exists()
    with fits.open(finished_run / "ccd_R22_S11.fits") as hdus:
        assert "PSFMODEL" not in hdus[0].header
        for extension in ("STARS", "TRUTH"):
            assert not set(ADDED) & set(hdus[extension].columns.names)
    product = read_product(finished_run / "ccd_R22_S11.fits")
    assert product.kinds == KINDS
    assert of_ccd_model(product.observed) is product.observed
    with pytest.raises(UnknownNameError, match="residual_ccd"):
        product.ellipticity("residual_ccd")
    summary = json.loads((finished_run / "summary.json").read_text())
    assert not [key for key in summary["all"] if "chi2" in key or "ccd" in key.split("_")]
    assert "warnings" not in summary


@pytest.mark.slow
def test_a_finished_run_resumed_on_two_threads_has_the_same_bytes(whole_run, focal_plane_config, tmp_path, no_report):
    shutil.copytree(whole_run, tmp_path / "copy")
    (tmp_path / "copy" / FOCAL_PLANE_PSF_NAME).unlink()
    assert run(focal_plane_config(), tmp_path / "copy", execution=Execution(resume=True, threads=2)).computed == ()
    assert contents(tmp_path / "copy") == contents(whole_run)


@pytest.mark.slow
def test_a_run_stopped_while_products_are_rewritten_goes_on_to_the_same_bytes(
    focal_plane_config, tmp_path, plane_model, no_report, monkeypatch
):
    run(focal_plane_config(), tmp_path / "at_once")
    real, out = focal_plane_stage.write_focal_plane_columns, tmp_path / "out"

    def stopped(folder, product):
        if product.name == CCDS[1]:
            raise KeyboardInterrupt
        real(folder, product)

    monkeypatch.setattr(focal_plane_stage, "write_focal_plane_columns", stopped)
    with pytest.raises(KeyboardInterrupt):
        run(focal_plane_config(), out)
    states = [fits.getheader(out / f"ccd_{name}.fits")["PSFMODEL"] for name in CCDS]
    assert states == ["focal_plane", "ccd"]
    with pytest.raises(ProductError, match="CCD R22_S12: has no focal-plane model yet, which pachon run --resume adds"):
        diagnose(out, strict=True)
    monkeypatch.setattr(focal_plane_stage, "write_focal_plane_columns", real)
    result = run(focal_plane_config(), out, execution=Execution(resume=True))
    assert (result.kept, result.computed) == (CCDS, ())
    assert contents(out) == contents(tmp_path / "at_once")


@pytest.mark.slow
def test_a_run_that_grows_models_all_ccds_again(focal_plane_config, tmp_path, plane_model, no_report):
    options = {"stars__observed": 32}
    run(focal_plane_config(ccds=CCDS[:1], **options), tmp_path / "grows")
    alone = tables(tmp_path / "grows", CCDS[0], "STARS")[0]
    assert run(focal_plane_config(**options), tmp_path / "grows", execution=Execution(resume=True)).kept == CCDS[:1]
    assert not np.array_equal(tables(tmp_path / "grows", CCDS[0], "STARS")[0]["MODEL_E1"], alone["MODEL_E1"])
    run(focal_plane_config(**options), tmp_path / "at_once")
    assert contents(tmp_path / "grows") == contents(tmp_path / "at_once")


@pytest.mark.slow
def test_ccds_computed_apart_make_the_run_of_one_machine(focal_plane_config, tmp_path, plane_model, no_report):
    run(focal_plane_config(), tmp_path / "at_once")
    together = tmp_path / "together"
    together.mkdir()
    for name in CCDS:
        # Each alone has too few stars, and leaves its product nevertheless.
        with pytest.raises(DomainError, match="20 stars: expected at least 30"):
            run(focal_plane_config(ccds=(name,)), tmp_path / name)
        for file in (f"ccd_{name}.fits", "config.yaml"):
            shutil.copy(tmp_path / name / file, together)
    assert run(focal_plane_config(), together, execution=Execution(resume=True)).computed == ()
    assert contents(together) == contents(tmp_path / "at_once")


@pytest.mark.slow
def test_a_ccd_that_cannot_be_modelled_is_left_out(focal_plane_config, tmp_path, plane_model, no_report, monkeypatch):
    real, config = run_folder.model_ccds, focal_plane_config(stars__observed=32)

    def fails(experiment, exposures):
        products = real(experiment, exposures)
        error = DomainError("too few stars")
        return [error if e.name == CCDS[0] else p for e, p in zip(exposures, products, strict=True)]

    monkeypatch.setattr(run_folder, "model_ccds", fails)
    result = run(config, tmp_path / "out")
    assert result.not_modelled == {CCDS[0]: "too few stars"}
    monkeypatch.setattr(run_folder, "model_ccds", real)
    run(focal_plane_config(stars__observed=32, ccds=CCDS[1:]), tmp_path / "alone")
    name = f"ccd_{CCDS[1]}.fits"
    assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    assert run(config, tmp_path / "out", execution=Execution(resume=True)).computed == CCDS[:1]
    run(config, tmp_path / "at_once")
    assert contents(tmp_path / "out") == contents(tmp_path / "at_once")


@pytest.mark.long
def test_a_product_of_another_model_is_not_kept(ccd_run, focal_plane_config, tmp_path, plane_model, no_report):
    shutil.copytree(ccd_run, tmp_path / "out")
    with pytest.raises(ProductError, match=r'reconstruction\.model: "ccd" -> "focal_plane"'):
        run(focal_plane_config(), tmp_path / "out", execution=Execution(resume=True))


@pytest.mark.long
def test_stars_that_are_not_used_have_no_prediction_without_them(products, focal_plane_config, plane_model):
    first = products[0]
    used = first.observed.used.copy()
    used[[0, 7]] = False
    changed = [replace(first, observed=replace(first.observed, used=used)), products[1]]
    applied, model = apply_focal_plane_model(Experiment.from_config(focal_plane_config()), changed)
    expected = model.leave_one_out.e1
    assert len(expected) == 38
    np.testing.assert_array_equal(np.isnan(applied[0].observed.leave_one_out_e2), ~used)
    found = np.concatenate([p.observed.leave_one_out_e1[p.observed.used] for p in applied])
    np.testing.assert_array_equal(found, expected)
    assert np.isfinite(applied[0].observed.model_e1).all()
    # Applied to what has a model already: the CCDs' own stay what they were.
    again, _ = apply_focal_plane_model(Experiment.from_config(focal_plane_config()), applied)
    for one, other, before in zip(again, applied, changed, strict=True):
        for key in ("model_e1", "model_size", "ccd_e1", "ccd_e2", "ccd_size", "sigma_e1"):
            np.testing.assert_array_equal(getattr(one.holdout, key), getattr(other.holdout, key))
        np.testing.assert_array_equal(one.holdout.ccd_size, before.holdout.model_size)


@pytest.mark.long
def test_stars_of_an_ideal_telescope_have_no_telescope_to_fit(products, focal_plane_config):
    experiment = replace(Experiment.from_config(focal_plane_config()), atmosphere_only=True)
    applied, model = apply_focal_plane_model(experiment, products, threads=1)
    assert model.heights is None
    assert applied[0].has_focal_plane_model


@pytest.mark.long
def test_metrics_are_of_both_models(products, focal_plane_config, plane_model):
    applied, model = apply_focal_plane_model(Experiment.from_config(focal_plane_config()), products)
    assert applied[0].kinds == (*KINDS, *CCD_KINDS)
    correlated = correlations(applied)
    assert set(correlated) == {"truth", "observed", "residual", "away", *CCD_KINDS}
    metrics, before = run_metrics(applied, correlated), run_metrics(products, correlations(products))
    together, old = metrics["all"], before["all"]
    for name in ("at_stars", "away"):
        assert together[f"rms_residual_{name}_ccd"] == old[f"rms_residual_{name}"]
        assert together[f"rms_residual_{name}"] != old[f"rms_residual_{name}"]
    for kind in ("residual", "away"):
        assert together[f"xi_plus_{kind}_ccd_short"] == old[f"xi_plus_{kind}_short"]
    stars = [p.holdout for p in applied]
    x, y, e1, e2 = (np.concatenate([getattr(s, k) for s in stars]) for k in ("field_x", "field_y", "e1", "e2"))
    x_mm, y_mm, size = (np.concatenate([getattr(s, k) for s in stars]) for k in ("x", "y", "size"))
    plane = model.shapes("", x_mm, y_mm)
    expected = shear_correlation(x, y, e1 - plane.e1, e2 - plane.e2, bins=separation_bins(applied))
    np.testing.assert_array_equal(correlated["away"].xi_plus, expected.xi_plus)
    for i, (key, values) in enumerate((("e1", e1 - plane.e1), ("e2", e2 - plane.e2))):
        assert together[f"chi2_away_{key}"] == pytest.approx(np.mean((values / model.scatter[i]) ** 2), rel=1e-12)
    relative = (size / plane.size - 1.0) / model.scatter[2]
    assert together["chi2_away_size"] == pytest.approx(np.mean(relative**2), rel=1e-9)
    assert {"chi2_away_size", "rms_residual_away_ccd"} <= set(metrics["ccd"][CCDS[0]])


@pytest.mark.slow
def test_the_report_has_both_residuals_and_the_warnings(focal_plane_config, tmp_path, plane_model, monkeypatch, capsys):
    drawn = {}

    def keep(name):
        real = getattr(pictures_module, name)

        def drawing(*arguments):
            drawn[name] = arguments
            return real(*arguments)

        return drawing

    for name in ("heights_plot", "whiskers_plot", "close_up_plot", "eigen_psf_plot", "spectrum_plot", "stamps_plot"):
        monkeypatch.setattr(pictures_module, name, lambda *_, **__: b"")
    for name in ("correlation_plot", "models_plot"):
        monkeypatch.setattr(pictures_module, name, keep(name))
    result = run(focal_plane_config(), tmp_path / "out", execution=Execution(threads=1, reporter=Reporter()))
    assert "the plane is <flat>\n" in capsys.readouterr().err
    assert list(drawn["correlation_plot"][0]) == ["truth", "observed", "residual", "away"]
    assert set(CCD_KINDS) < set(drawn["models_plot"][0])
    page, metrics = result.report.read_text(), result.summary["all"]
    assert result.summary["warnings"] == ["the plane is <flat>"]
    assert {k: metrics[f"chi2_left_out_{k}"] for k in ("e1", "e2", "size")} == {"e1": 0.5, "e2": 1.5, "size": 2.5}
    assert "<li>the plane is &lt;flat&gt;</li>" in page
    assert '<a href="#models">' in page
    assert "one model of the whole focal plane" in page
    for key in ("rms_residual_away", "rms_residual_away_ccd", "rms_residual_at_stars_ccd"):
        assert f"<td>{100 * metrics[key]:.2f} %</td>" in page
    assert "<td>0.50, 1.50, 2.50</td>" in page
    assert ", ".join(f"{metrics[f'chi2_away_{k}']:.2f}" for k in ("e1", "e2", "size")) in page
    for kind in ("residual", "away", *CCD_KINDS):
        assert f"{metrics[f'xi_plus_{kind}_short']:.1e} ± " in page
    assert len(models_rows(result.summary)) == 14


def test_the_report_of_models_of_single_ccds_has_no_such_section(finished_run):
    page, text = ((finished_run / name).read_text() for name in ("report.html", "summary.json"))
    summary = json.loads(text.replace("null", "NaN"))
    assert "models" not in {line.partition('id="')[2].partition('"')[0] for line in page.splitlines()}
    assert models_rows(summary) == []
    assert not [name for name, _ in headline(summary) if "own model" in name]


@pytest.mark.slow
def test_diagnostics_have_both_models(whole_run, ccd_run, tmp_path, capsys):
    now, before = (diagnose(folder, tmp_path / folder.parent.name) for folder in (whole_run, ccd_run))
    assert tuple(now.correlations) == (*KINDS, *CCD_KINDS)
    for kind in ("residual", "away"):
        for key in ("mean_e1", "rms_e", "mean_dt", "rms_dt"):
            assert now.overall[f"{key}_{kind}_ccd"] == before.overall[f"{key}_{kind}"]
            np.testing.assert_array_equal(now.table[f"{key}_{kind}_ccd"], before.table[f"{key}_{kind}"])
            assert now.overall[f"{key}_{kind}"] != before.overall[f"{key}_{kind}"]
    assert main(["diagnose", str(whole_run), "--out", str(tmp_path / "c")]) == 0
    assert "CCD's own model, at holdout positions" in capsys.readouterr().out


def test_optics_alone_are_refused(focal_plane_config):
    with pytest.raises(ConfigError, match=r"^reconstruction.model = focal_plane: expected atmosphere.enabled = true"):
        focal_plane_config(atmosphere__enabled=False, psf__engine="fast")


def test_layers_are_of_the_focal_plane_model_alone(focal_plane_config):
    assert focal_plane_config(reconstruction__turbulence="layers").reconstruction.turbulence == "layers"
    with pytest.raises(ConfigError, match=r"^reconstruction.turbulence = layers: expected model = focal_plane[^\n]*$"):
        focal_plane_config(reconstruction__turbulence="layers", reconstruction__model="ccd")


@pytest.mark.long
def test_too_few_stars_are_one_line(focal_plane_config, tmp_path, capsys):
    path = tmp_path / "small.yaml"
    path.write_text(to_yaml(focal_plane_config(ccds=CCDS[:1])))
    assert main(["run", str(path), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("pachon: error: ")
    assert error.count("\n") == 1
    assert "20" in error
    assert "30" in error


@pytest.mark.slow
def test_who_wants_no_progress_reads_the_warnings(focal_plane_config, tmp_path, plane_model, no_report, capsys):
    path = tmp_path / "small.yaml"
    path.write_text(to_yaml(focal_plane_config()))
    assert main(["run", str(path), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert capsys.readouterr().err == "pachon: the plane is <flat>\n"
    shutil.rmtree(tmp_path / "out")
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert "CCD by CCD" in out
    assert "reduced chi-square, at holdout positions: e1, e2, size" in out
