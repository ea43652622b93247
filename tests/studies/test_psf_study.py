import json
import re
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

from pachon.commands.cli import main
from pachon.core.errors import ConfigError, DomainError
from pachon.core.progress import Reporter
from pachon.core.units import ARCMIN, ARCSEC
from pachon.measure.shapes import measure_shapes
from pachon.pipeline.config import load_configuration
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate.ccd_exposure import CcdExposure, NoiseFreeStars
from pachon.pipeline.simulate.ccd_observation import Observation
from pachon.pipeline.simulate.star_field import CcdOutline, Depth, make_star_field
from pachon.reconstruction.psf_model.polynomial import mapped
from pachon.reconstruction.psf_model.recipe import DEFAULT
from pachon.studies.psf_choice.plan import NOISE_FREE, PROCESSES, Case, Plan, make_plan
from pachon.studies.psf_choice.residuals import case_metrics, measure_residuals, noise_law, residual_correlations
from pachon.studies.psf_choice.stars import SimulatedCcd, fit, observe, simulate
from pachon.studies.psf_choice.study import Study, study, study_experiment

#: All of them need a finished study, of seconds.
pytestmark = pytest.mark.long

SCALE = 0.2 * ARCSEC


def _planted(name, degree, n_stars, n_holdout, half=0.02):
    """A CCD whose PSF is a Gaussian plus two even shapes, their amplitudes polynomials of this degree; centred."""
    outline = CcdOutline(name, (-half, half, -half, half), 1e-5)
    places = make_star_field(outline, n_holdout, n_stars, 3, fwhm=0.7 * ARCSEC, depth=Depth())
    rng = np.random.default_rng([degree, *name.encode()])
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    amplitudes = rng.normal(0.0, 0.01, (2, len(powers)))
    amplitudes[:, [i + j == degree for i, j in powers]] += 0.03  # the highest power must be there

    def images(positions, size):
        u, v = mapped(positions, places.ccd.bounds).T
        a = amplitudes @ [u**i * v**j for i, j in powers]
        y, x = np.mgrid[:size, :size] - (size - 1) / 2.0
        round_psf = np.exp(-0.5 * (x**2 + y**2) / 1.7**2)
        round_psf /= round_psf.sum()
        shapes = [(x**2 - y**2) / 1.7**2 * round_psf, 2.0 * x * y / 1.7**2 * round_psf]
        return round_psf + np.einsum("kn,kyx->nyx", a, shapes)

    def exposed(positions, size):
        return NoiseFreeStars(
            images(positions, size), SCALE, positions * 0.01, np.ones(len(positions)), np.zeros((len(positions), 2))
        )

    exposure = CcdExposure(name, places, exposed(places.holdout, 31), exposed(places.observed, 41))
    stamps, nothing = images(places.observed, 31), np.zeros(n_stars, dtype=int)
    truth, shapes = (measure_shapes(i, SCALE, 0.7 * ARCSEC) for i in (exposure.holdout.image, stamps))
    return SimulatedCcd(exposure, truth, Observation((0.0, 0.0), stamps, shapes, nothing, nothing == 0))


def _figures(experiment, case, ccds, draws):
    samples = []
    for draw in range(draws):
        seen = [observe(experiment, ccd, case.snr, draw) for ccd in ccds]
        models = [fit(case, *pair) for pair in zip(ccds, seen, strict=True)]
        samples.append(measure_residuals(experiment, case, ccds, seen, models))
    return case_metrics(samples)


@pytest.fixture(scope="module")
def experiment(tiny):
    return Experiment.from_config(tiny())


def test_a_cubic_field_is_recovered_by_order_three(experiment):
    ccds = [_planted(name, 3, 40, 60) for name in ("R22_S11", "R24_S12")]
    case = Case(40, NOISE_FREE, components=2)
    found = _figures(experiment, case, ccds, 1)
    # Exact but for rounding: amplitudes are linear in the stamps, and two components span them.
    assert found["rms_e_away"] < 1e-10
    assert found["rms_size_away"] < 1e-10
    assert found["noise_law_away"] == found["noise_law_g_away"] == 0.0
    # To the last step of the adaptive moments.
    assert found["rms_g_away"] < 1e-6
    assert found["rms_dt_g_away"] < 1e-6
    assert _figures(experiment, replace(case, order=2), ccds, 1)["rms_e_away"] > 1e-3
    assert _figures(experiment, replace(case, order=4), ccds, 1)["rms_e_away"] < 1e-10


@pytest.mark.parametrize(("order", "interpolation"), [(3, "equal"), (4, "softened")])
def test_noise_leaves_what_the_law_says(experiment, order, interpolation):
    ccds, draws = [_planted(name, 3, 60, 60) for name in ("R22_S11", "R24_S12")], 10
    # All pixels, so that nothing of the noise is left out of the basis; bright stars, for which e is linear in it.
    case = Case(60, 100.0, "pixels", interpolation, order, 0)
    found = _figures(experiment, case, ccds, draws)
    # The mean square is y'My of the noise y of the stars: its variance is 2 tr(MSMS), S the noise's covariance. On top
    # come 3 %: the law takes e's noise times S/N to be the same for bright and faint stars.
    squares, expected = 0.0, 0.0
    for ccd in ccds:
        seen = observe(experiment, ccd, case.snr, 0)
        weights = np.ones(60) if interpolation == "equal" else 1.0 / (seen.snr**-2 + 1e-4)
        u, v = mapped(ccd.exposure.positions.observed, ccd.exposure.positions.ccd.bounds).T
        at, bt = mapped(ccd.exposure.positions.holdout, ccd.exposure.positions.ccd.bounds).T
        powers = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
        terms, there = (np.stack([x**i * y**j for i, j in powers], axis=1) for x, y in ((u, v), (at, bt)))
        solve = there @ np.linalg.solve(terms.T @ (weights[:, None] * terms), terms.T * weights)
        m = solve.T @ solve * np.sqrt(seen.variance * seen.variance[:, None])
        squares, expected = squares + np.trace(m @ m), expected + np.trace(m)
    sigma = 0.5 * np.sqrt(2.0 * squares) / expected / np.sqrt(2.0 * draws)  # of the rms; e1 and e2 are independent
    assert sigma < 0.1
    assert found["rms_e_away"] == pytest.approx(found["noise_law_away"], rel=3.0 * sigma + 0.03)
    # 50 degrees of freedom and fewer in place of 10: 2 % at 3 sigma, and the same 3 %.
    assert found["rms_e_at_stars"] == pytest.approx(found["noise_law_at_stars"], rel=0.05)
    assert found["rms_g_away"] == pytest.approx(found["noise_law_g_away"], rel=3.0 * sigma + 0.03)
    assert found["rms_g_at_stars"] == pytest.approx(found["noise_law_g_at_stars"], rel=0.05)
    assert found["lost"] == 0
    # The residuals at the stars sum to zero over each CCD, whatever the error of the model: the flattery. In pixels
    # exactly; in e nearly, which is not quite linear in them.
    if interpolation == "equal":
        assert found["mean_e_at_stars"] < 0.1 * found["mean_e_away"]


def test_residuals_of_g_are_those_of_hsm(experiment):
    """GalSim's adaptive moments of truth and model at each holdout position, one CCD at a time."""
    galsim = pytest.importorskip("galsim")
    ccds, case = [_planted(name, 2, 24, 12) for name in ("R22_S11", "R24_S12")], Case(24, components=4, order=1)
    found = _figures(experiment, case, ccds, 1)

    def moments(images):
        hsm = [galsim.hsm.FindAdaptiveMom(galsim.Image(np.asarray(image, dtype=float))) for image in images]
        g = np.array([[m.observed_shape.g1, m.observed_shape.g2] for m in hsm]).T
        square = (g**2).sum(axis=0)
        return g, np.array([m.moments_sigma for m in hsm]) ** 2 * (1.0 + square) / (1.0 - square)

    squares, changes, means = [], [], []
    for ccd in ccds:
        model = fit(case, ccd, observe(experiment, ccd, case.snr, 0))
        (true, size), (g, model_size) = (
            moments(v) for v in (ccd.exposure.holdout.image, model.at(ccd.exposure.positions.holdout))
        )
        squares.append(np.mean((true - g) ** 2))
        changes.append(np.mean((1.0 - model_size / size) ** 2))
        means.append(np.mean((true - g).mean(axis=1) ** 2))
    # To the last steps of both iterations.
    assert found["rms_g_away"] == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-3)
    assert found["rms_dt_g_away"] == pytest.approx(np.sqrt(np.mean(changes)), rel=1e-3)
    assert found["mean_g_away"] == pytest.approx(np.sqrt(np.mean(means)), rel=1e-3)


def test_noise_law_is_p_over_n():
    rng = np.random.default_rng(0)
    stars, extent = rng.uniform(-1.0, 1.0, (40, 2)), (-1.0, 1.0, -1.0, 1.0)
    at_stars, elsewhere = noise_law(stars, stars, np.full(40, 0.04), None, 3, extent)
    assert at_stars == pytest.approx(0.04 * (1.0 - 10 / 40), rel=1e-12)
    assert elsewhere == pytest.approx(0.04 * 10 / 40, rel=1e-12)
    # One star for each term: nothing is left at the stars, which says nothing about other places.
    at_stars, elsewhere = noise_law(stars[:10], stars, np.full(10, 0.04), None, 3, extent)
    assert at_stars < 1e-20
    assert elsewhere > 0.04


def test_noise_law_against_fits_of_noise():
    rng = np.random.default_rng(1)
    stars, places = rng.uniform(0.0, 3.0, (15, 2)), rng.uniform(0.0, 3.0, (8, 2))
    sigma, weights = rng.uniform(0.5, 2.0, 15), rng.uniform(0.1, 4.0, 15)
    expected = noise_law(stars, places, sigma**2, weights, 1, (0.0, 3.0, 0.0, 3.0))
    noise = sigma[:, None] * rng.normal(size=(15, 40_000))
    t, p = (np.column_stack([np.ones(len(q)), q]) for q in (stars, places))
    root = np.sqrt(weights)[:, None]
    c = np.linalg.lstsq(t * root, noise * root, rcond=None)[0]
    # 40 000 draws of three free numbers: mean squares to 0.4 %.
    assert expected == pytest.approx((np.mean((noise - t @ c) ** 2), np.mean((p @ c) ** 2)), rel=0.015)


def test_stars_are_nested_and_noise_is_common(experiment):
    ccd = _planted("R22_S11", 2, 24, 10)
    seen, again, other = (observe(experiment, ccd, 30.0, draw) for draw in (0, 0, 1))
    np.testing.assert_array_equal(seen.observation.images, again.observation.images)
    assert np.abs(seen.observation.images - other.observation.images).max() > 1e-3
    np.testing.assert_array_equal(seen.snr, other.snr)
    for n in (6, 12, 24):
        model = fit(Case(n, 30.0, components=4, order=1), ccd, seen)
        np.testing.assert_array_equal(model.positions, ccd.exposure.positions.observed[:n])
    # The same star at another limit: its place among the magnitudes stays.
    bright = observe(experiment, ccd, 100.0, 0)
    assert seen.snr.min() >= 30.0
    assert bright.snr.min() >= 100.0
    np.testing.assert_array_equal(np.argsort(seen.snr), np.argsort(bright.snr))


def test_correlations_are_means_over_pairs():
    rng = np.random.default_rng(2)
    centers = np.array([[0.0, 0.0], [0.02, 0.0], [0.0, 0.03]])
    fields = [c + rng.uniform(0.0, 0.002, (12, 2)) for c in centers]  # CCDs of 7', 70' and more apart
    residuals = [rng.normal(0.0, 0.01, (3, 12)) for _ in centers]
    xi, left = residual_correlations(fields, residuals)

    def long_range(chosen):
        r = np.concatenate([fields[i] for i in chosen])
        e = np.concatenate([residuals[i][0] + 1j * residuals[i][1] for i in chosen])
        apart = np.hypot(*(r[:, None] - r).transpose(2, 0, 1)) > 10.0 * ARCMIN
        return (e[:, None] * e.conj()).real[apart].mean()

    # TreeCorr keeps ellipticities in single precision.
    assert xi[1] == pytest.approx(long_range((0, 1, 2)), rel=1e-5)
    assert left[:, 1] == pytest.approx([long_range(c) for c in ((1, 2), (0, 2), (0, 1))], rel=1e-5)


def test_the_simplest_of_the_best_is_recommended():
    base = Case(40, order=3, components=20)
    plan = Plan(base, (40,), (1, 2, 3), (20,), (30.0,))
    scatter = np.array([0.0, 2.0, -2.0, 0.0])
    squares = {
        base: 10.0 + scatter,  # the best
        replace(base, order=2): 10.5 + np.array([1.0, -1.0, 1.0, -1.0]) + scatter,  # 0.5 +- 0.6 more
        replace(base, order=1): 11.0 + np.array([0.1, -0.1, 0.1, -0.1]) + scatter,  # 1.0 +- 0.06 more
        replace(base, stars=80): 1.0 + scatter,  # another question
    }
    figures = {case: {"lost": 0.0} for case in squares}
    found = Study(plan, figures, {}, squares)
    assert found.recommended() == replace(base, order=2)
    assert found.best_order(40, "equal") == base
    figures[replace(base, order=2)] = {"lost": 1.0}
    assert found.recommended() == base
    assert Study(plan, {}, {base: "why"}, {}).recommended() is None


def test_plan_of_a_configuration(tiny):
    plan = make_plan(tiny(), stars=(6, 24), orders=(0, 2), components=(8,), snrs=(100.0,))
    assert plan.base == Case(12, 30.0, "pca", "equal", 1, 4)
    assert (plan.stars, plan.orders, plan.components, plan.snrs) == ((6, 12, 24), (0, 1, 2), (4, 8), (30.0, 100.0))
    cases = plan.cases()
    assert len(set(cases)) == len(cases)
    assert all(case == case.normalised() for case in cases)
    assert {c.basis for c in cases} == {"pca", "pixels", "shapelets"}
    assert all(c.components < c.stars for c in cases if c.basis == "pca")
    other = tiny(
        reconstruction__recipe="paper",
        reconstruction__basis="pixels",
        reconstruction__components=None,
        reconstruction__weights="softened",
    )
    assert make_plan(other, components=(8,)).base == Case(12, 30.0, "pixels", "softened", 1, 0)
    assert make_plan(tiny(reconstruction__interpolation="kriging")).base.interpolation == "kriging"
    assert plan.default == Case(12, 30.0, "pixels", "kriging", 4, 0)
    assert {replace(plan.default, stars=n) for n in plan.stars} < set(cases)
    for options in ({"stars": (1,)}, {"orders": (-1,)}, {"components": (0,)}, {"snrs": (np.inf,)}, {"draws": 0}):
        with pytest.raises(ConfigError, match=next(iter(options)).removesuffix("s")):
            make_plan(tiny(), **options)


@pytest.fixture(scope="module")
def small(tiny):
    # Fewer components than those of the base, with which one fit is made for both.
    plan = make_plan(tiny(), stars=(6,), orders=(1, 3), components=(2,), snrs=(30.0,), draws=2)
    return plan, study(tiny(), plan, threads=1)


def test_noise_in_words():
    assert Case(40).noise_text == "of S/N 30 and more"
    assert Case(40, snr=NOISE_FREE).noise_text == "without noise"


def test_cases_about_the_default_model_have_recipes():
    """As of the config.yaml of a run, which names pixels and kriging: components are those of other bases alone."""
    base = Case.of_recipe(40, 30.0, DEFAULT)
    cases = Plan(base, (30, 40), (1, 2), (5, 20), (30.0,)).cases()
    assert base in cases
    counts = {(basis, count) for basis in ("pca", "shapelets") for count in (5, 20)}
    assert {(case.basis, case.components) for case in cases} == {("pixels", 0), *counts}
    assert all(case == Case.of_recipe(case.stars, case.snr, case.recipe()) for case in cases if case.snr != NOISE_FREE)


def test_every_case_has_figures_or_a_problem(small):
    plan, result = small
    assert {*result.metrics, *result.problems} == set(plan.cases())
    assert not set(result.metrics) & set(result.problems)
    for case, problem in result.problems.items():
        assert case.terms > case.stars
        assert "10 polynomial terms need as many stars, 6 given" in problem
    assert len(result.problems) == 4
    for case, found in result.metrics.items():
        assert np.isfinite(found["rms_e_away"]), case
        assert np.isnan(found["noise_law_away"]) == (case.interpolation in PROCESSES)
        assert np.isfinite(found["rms_g_away"]), case


def test_a_case_is_what_its_parts_give(small, tiny):
    plan, result = small
    experiment = study_experiment(tiny(), plan)
    ccds = simulate(experiment, 2, Reporter(quiet=True))  # and two threads change nothing
    for case in (plan.base, replace(plan.base, stars=6, interpolation="snr"), replace(plan.base, basis="pixels")):
        # Principal components of one fit are truncated, by rounding those of a fit of fewer.
        for key, value in _figures(experiment, case.normalised(), ccds, 2).items():
            assert result.metrics[case.normalised()][key] == pytest.approx(value, rel=1e-6, nan_ok=True), key


def test_stars_with_defects_are_refused(tiny):
    config = tiny(stars__cosmic_rays=0.1)
    with pytest.raises(ConfigError, match=r"stars\.cosmic_rays = 0\.1: expected 0"):
        study(config, make_plan(config))


@pytest.mark.slow
def test_command_line(settings_file, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    command = ["study", str(settings_file), "--threads", "1", "--components", "4", "--snr", "30", "--draws", "1"]
    assert main([*command, "--ccds", "R22_S11,R24_S12", "--stars", "12,6", "--orders", "1,3", "-o", str(out)]) == 0
    printed = capsys.readouterr()
    assert "ways to model" in printed.err
    assert "Recommended for 12 stars of S/N 30 and more: " in printed.out
    assert "could not be fitted" in printed.out
    assert printed.out.endswith(f"study: {out.resolve()}\n")
    names = ["config.yaml", "study.ecsv", "study.json", "study_choices.png", "study_stars.png"]
    assert sorted(p.name for p in out.iterdir()) == names
    table, summary = Table.read(out / "study.ecsv"), json.loads((out / "study.json").read_text())
    assert all(column.description for column in table.itercols())
    assert (table["problem"] != "").sum() == len(summary["not_fitted"]) > 0
    base = summary["base"]
    row = table[
        (table["stars"] == 12)
        & (table["order"] == 1)
        & (table["basis"] == "pca")
        & (table["interpolation"] == "equal")
        & (table["snr"] == 30.0)
        & (table["components"] == 4)
    ]
    for key in ("rms_e_away", "rms_g_away", "xi_plus_g_away_short"):
        assert list(row[key]) == [pytest.approx(base["figures"][key], rel=1e-8)]  # nine digits in JSON
    words = "rms of one component of g of adaptive moments, truth - model, where no star is"
    assert table["rms_g_away"].description == words
    assert table["noise_law_at_stars"].description.startswith("rms of one component of the weighted e that noise alone")
    for name in ("study_choices.png", "study_stars.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    # One CCD has no correlations and no errors over CCDs, but all the rest. The written configuration is the study's.
    monkeypatch.setattr("pachon.studies.psf_choice.product.choices_plot", lambda *_: b"")
    assert load_configuration(out / "config.yaml").stars.observed == 12
    monkeypatch.setattr("pachon.studies.psf_choice.product.stars_plot", lambda *_: b"")
    alone = [*command, "--ccds", "R22_S11", "--stars", "12", "--orders", "1", "--out", str(tmp_path / "alone")]
    assert main(alone) == 0
    sentence = capsys.readouterr().out.splitlines()[0]
    assert re.search(r"residual of g at holdout positions \d\.\d\de-\d\d\.$", sentence)
    found = json.loads((tmp_path / "alone" / "study.json").read_text())["base"]["figures"]
    assert found["xi_plus_away_long"] is None
    assert found["error_rms_e_away"] is None
    assert found["rms_e_away"] > 0.0


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--stars", "ten"], ["--stars = 'ten'", "whole numbers"]),
        (["--stars", "1"], ["stars = 1"]),
        (["--snr", "30,"], []),
        (["--snr", "nan"], ["snr = nan"]),
        (["--orders", "-1"], ["orders = -1"]),
        (["--ccds", "R22_S1l"], ["did you mean R22_S"]),
        (["--draws", "0"], ["draws"]),
    ],
)
def test_bad_input_is_one_line(settings_file, tmp_path, capsys, arguments, parts, monkeypatch):
    def never(*_, **__):
        raise ConfigError("simulated")

    monkeypatch.setattr("pachon.studies.psf_choice.study.study", never)
    assert main(["study", str(settings_file), "-o", str(tmp_path / "out"), *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("pachon: error: ")
    for part in parts:
        assert part in err
    assert (tmp_path / "out").exists() == (not parts)


def test_a_model_without_shapes_is_a_problem(experiment):
    ccd = _planted("R22_S11", 1, 12, 5)
    seen = observe(experiment, ccd, NOISE_FREE, 0)
    case = Case(12, NOISE_FREE, components=2, order=1)
    model = fit(case, ccd, seen)
    basis = replace(model.basis, mean=np.zeros_like(model.mean), components=np.zeros_like(model.components))
    dark = replace(model, basis=basis)
    with pytest.raises(DomainError, match="CCD R22_S11: the model has no shape anywhere"):
        measure_residuals(experiment, case, [ccd], [seen], [dark])
