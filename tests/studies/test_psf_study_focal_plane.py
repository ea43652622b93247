"""Focal-plane models in the study of PSF models, beside those of single CCDs."""

import json
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

from pachon.commands.cli import main
from pachon.core.progress import Reporter
from pachon.pipeline import focal_plane_stage
from pachon.studies.psf_choice.plan import FOCAL_PLANE, NOISE_FREE, Case, Plan, make_plan
from pachon.studies.psf_choice.product import write_study
from pachon.studies.psf_choice.residuals import case_metrics, measure_residuals
from pachon.studies.psf_choice.stars import fit, observe, simulate
from pachon.studies.psf_choice.study import Study, fit_focal_plane, study, study_experiment

#: All of them need stars, of seconds.
pytestmark = pytest.mark.long

OPTIONS = {"stars": (12,), "orders": (1,), "components": (4,), "snrs": (30.0,), "draws": 2}


@pytest.fixture(scope="module")
def small(focal_plane_config, plane):
    """A study with a plane in place of the focal-plane model, and its configuration."""
    config = focal_plane_config()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(focal_plane_stage, "FocalPlanePsf", plane)
        return config, study(config, make_plan(config, **OPTIONS), threads=1)


def test_plan_adds_models_without_order_basis_and_components(tiny):
    plan, without = make_plan(tiny(reconstruction__model="focal_plane")), make_plan(tiny())
    assert without == replace(plan, focal_plane=False)
    added = [case for case in plan.cases() if case.interpolation in FOCAL_PLANE]
    assert without.cases() == tuple(case for case in plan.cases() if case not in added)
    assert {(c.basis, c.order, c.components) for c in added} == {("moments", 0, 3)}
    settings = {(n, snr) for n in plan.stars for snr in (30.0, NOISE_FREE)} | {(12, s) for s in plan.snrs}
    assert {(c.stars, c.snr, c.interpolation) for c in added} == {(*s, how) for s in settings for how in FOCAL_PLANE}
    assert len(added) == 2 * len(settings)
    assert (str(added[0]), str(added[-1])) == ("focal plane, no telescope", "focal plane")


@pytest.mark.slow
def test_metrics_are_those_of_one_model_of_all_ccds(small):
    config, result = small
    experiment = study_experiment(config, result.plan)
    ccds = simulate(experiment, 2, Reporter(quiet=True))
    squares = {key: [] for key in ("e_at_stars", "e_away", "size_at_stars", "size_away", "mean_e_away")}
    for draw in range(2):
        seen = [observe(experiment, ccd, 30.0, draw) for ccd in ccds]
        used = [s.observation.used for s in seen]
        at = [c.exposure.positions.observed[u] for c, u in zip(ccds, used, strict=True)]
        shapes = [
            np.stack([s.observation.shapes.e1, s.observation.shapes.e2, np.log(s.observation.shapes.size)], axis=1)[u]
            for s, u in zip(seen, used, strict=True)
        ]
        terms = [np.column_stack([np.ones(len(p)), p]) for p in at]
        planes = np.linalg.lstsq(np.concatenate(terms), np.concatenate(shapes), rcond=None)[0]
        truth = [np.stack([c.holdout.e1, c.holdout.e2, np.log(c.holdout.size)], axis=1) for c in ccds]
        there = [c.exposure.positions.holdout for c in ccds]
        holdout = [np.column_stack([np.ones(len(p)), p]) for p in there]
        for kind, values, places in (("at_stars", shapes, terms), ("away", truth, holdout)):
            left = [v - p @ planes for v, p in zip(values, places, strict=True)]
            squares[f"e_{kind}"] += [np.mean(d[:, :2] ** 2) for d in left]
            squares[f"size_{kind}"] += [np.mean(np.expm1(d[:, 2]) ** 2) for d in left]
            if kind == "away":
                squares["mean_e_away"] += [np.mean(d[:, :2].mean(axis=0) ** 2) for d in left]
    for how in FOCAL_PLANE:
        found = result.metrics[Case(20, 30.0, "moments", how, 0, 3)]
        for key, values in squares.items():
            name = key if key.startswith("mean") else f"rms_{key}"
            assert found[name] == pytest.approx(np.sqrt(np.mean(values)), rel=1e-6), key
        assert np.isnan(found["noise_law_away"])
        assert found["lost"] == 0.0


@pytest.mark.slow
def test_other_models_are_as_without_it(small, focal_plane_config):
    _, result = small
    config = focal_plane_config(reconstruction__model="ccd")
    other = study(config, make_plan(config, **OPTIONS), threads=1)
    rest = {case: found for case, found in result.metrics.items() if case.interpolation not in FOCAL_PLANE}
    assert list(rest) == list(other.metrics)
    for case, found in rest.items():
        np.testing.assert_array_equal(list(found.values()), list(other.metrics[case].values()), str(case))


def test_too_few_stars_are_a_problem(small):
    _, result = small
    problems = {case: why for case, why in result.problems.items() if case.interpolation in FOCAL_PLANE}
    assert {(c.stars, c.snr) for c in problems} == {(12, 30.0), (12, NOISE_FREE)}
    assert set(problems.values()) == {"24 stars: expected at least 30"}


@pytest.mark.slow
def test_files_and_table_have_the_model(small, tmp_path, settings_file, capsys, monkeypatch):
    config, result = small
    write_study(result, tmp_path, config)
    table, summary = Table.read(tmp_path / "study.ecsv"), json.loads((tmp_path / "study.json").read_text())
    for described, how in zip(summary["focal_plane"], FOCAL_PLANE, strict=True):
        row = table[(table["interpolation"] == how) & (table["stars"] == 20) & (table["snr"] == 30.0)]
        assert (row["basis"][0], row["order"][0], row["components"][0]) == ("moments", 0, 3)
        assert list(row["rms_e_away"]) == [pytest.approx(described["figures"]["rms_e_away"], rel=1e-8)]
    given = []

    def finished(config, plan, **_):
        given.append((config.reconstruction.model, plan.focal_plane))
        return result

    # The table of the command has both models, whichever way they are asked for.
    monkeypatch.setattr("pachon.studies.psf_choice.study.study", finished)
    for plot in ("choices_plot", "stars_plot"):
        monkeypatch.setattr(f"pachon.studies.psf_choice.product.{plot}", lambda *_: b"")
    assert main(["study", str(settings_file), "--focal-plane", "-o", str(tmp_path / "out")]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("20 stars, focal plane")]
    assert len(rows) == 2
    assert main(["study", str(settings_file), "-o", str(tmp_path / "without")]) == 0
    assert given == [("focal_plane", True), ("ccd", False)]


def test_stated_noise_is_the_scatter_of_the_draws(focal_plane_config):
    config = focal_plane_config()
    experiment = study_experiment(config, make_plan(config, stars=(40,)))
    ccds, case = (
        simulate(experiment, 1, Reporter(quiet=True)),
        Case(40, 60.0, interpolation="no_telescope").normalised(),
    )
    draws = [[observe(experiment, ccd, 60.0, k) for ccd in ccds] for k in range(20)]
    stated, names = [], [ccd.exposure.name for ccd in ccds]

    def keep(_, stars, *, telescope, ccds, threads):
        assert not telescope
        assert ccds == names
        stated.append(stars)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pachon.studies.psf_choice.study.fit_focal_plane_model", keep)
        for seen in draws:
            fit_focal_plane(case, experiment, ccds, seen)
        fit_focal_plane(replace(case, stars=7), experiment, ccds, draws[0])
        quiet = [observe(experiment, ccd, NOISE_FREE, 0) for ccd in ccds]
        fit_focal_plane(replace(case, snr=NOISE_FREE), experiment, ccds, quiet)
    *noisy, first, noise_free = stated
    deviation = np.concatenate([(s.values - noise_free.values) / s.noise for s in noisy])
    # 1600 stars: 1.8 % rms; 5 % for a noise of e that is not quite linear.
    np.testing.assert_allclose(deviation.std(axis=0), 1.0, atol=0.1)
    assert len(first) == 14
    np.testing.assert_array_equal(first.x[:7], ccds[0].exposure.positions.observed[:7, 0])
    assert noise_free.noise.max() < 1e-4


@pytest.mark.slow
def test_optics_leave_less_than_polynomials(focal_plane_config):
    # No turbulence but its mean: what is left of a PSF is the optics, which the model has.
    config = focal_plane_config(active_optics__residual_um=0.3)
    experiment = study_experiment(config, make_plan(config, **OPTIONS))
    ccds = simulate(experiment, 1, Reporter(quiet=True))
    seen = [observe(experiment, ccd, 30.0, 0) for ccd in ccds]
    linear, whole = Case(20, 30.0, "pixels", "snr", 1, 0), Case(20, 30.0, "moments", "focal_plane", 0, 3)
    own = [fit(linear, *pair) for pair in zip(ccds, seen, strict=True)]
    model = fit_focal_plane(whole, experiment, ccds, seen, threads=1)
    polynomials, optics = (
        case_metrics([measure_residuals(experiment, case, ccds, seen, models)])
        for case, models in ((linear, own), (whole, [model, model]))
    )
    assert model.heights is not None
    # 0.91 and 0.70 with these stars; chi-squares of 40 stars scatter by 0.2.
    assert optics["rms_e_away"] < polynomials["rms_e_away"]
    assert optics["rms_size_away"] < 0.8 * polynomials["rms_size_away"]
    assert all(0.4 < value < 1.6 for value in model.chi2.values())


def test_focal_plane_models_are_recommended_last():
    base = Case(40, order=1, components=20)
    without, whole = (replace(base, interpolation=how).normalised() for how in FOCAL_PLANE)
    plan = Plan(base, (40,), (1,), (20,), (30.0,), focal_plane=True)
    scatter = np.array([1.0, -1.0, 1.0, -1.0])

    def recommended(*means):
        squares = {
            case: mean + scatter * k for k, (case, mean) in enumerate(zip((whole, without, base), means, strict=True))
        }
        return Study(plan, {case: {"lost": 0.0} for case in squares}, {}, squares).recommended()

    assert recommended(10.0, 10.1, 10.2) == base
    assert recommended(10.0, 10.1, 15.0) == without
    assert recommended(10.0, 15.0, 15.0) == whole
