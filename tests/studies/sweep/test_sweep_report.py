"""Report of a sweep against closed forms: effects of two parameters that add in their squares."""

import json
import math
from pathlib import Path

import pytest

from pachon.core.page import with_digits
from pachon.models.parameters.changes import ANGLES, LENGTHS
from pachon.studies.metrics.stars import STARS
from pachon.studies.metrics.telescope import TELESCOPE_METRICS
from pachon.studies.sweep.analysis import allowances, curves
from pachon.studies.sweep.file import read_sweep
from pachon.studies.sweep.report import write_report
from pachon.studies.sweep.store import PointResult, SweepStore, create_store
from pachon.studies.sweep.sweep import numbered_points
from pachon.studies.sweep.table import described_metric, described_parameter, read_table

SWEEP = read_sweep(
    {
        "parameters": {
            "a": {"nominal": 0, "range": [0, 4], "marks": {"budget": 2}},
            "b": {"nominal": 0, "range": [0, 2], "marks": {"budget": 1}},
        },
        "design": {"points": 5, "replicas": 2},
        "xi_target": 5e-6,
    },
    "test",
)


def test_effects_budget_and_allowances_are_those_of_a_sum_of_squares(tmp_path):
    points = numbered_points(SWEEP, Path())
    create_store(tmp_path / "s.sweep", SWEEP, points, {})
    with SweepStore(tmp_path / "s.sweep") as store:
        for p in points:
            # Random numbers of a replica, in common to its points, cancel in every effect.
            xi = 1e-6 * (p.parameters["a"] ** 2 + 3.0 * p.parameters["b"] ** 2) + 1e-7 * (p.seed % 7)
            store.write(PointResult(p.number, {"xi_raw_short": xi}, None, 0.1, "here"))
        report = write_report(store, tmp_path / "report")
    found = json.loads((report.parent / "summary.json").read_text())["metrics"]["xi_raw_short"]
    assert found["largest_change"] == pytest.approx({"a": 16e-6, "b": 12e-6})
    added = {"a": 4e-6, "b": 3e-6, "sum": 7e-6, "together": 7e-6, "together_error": 0.0}
    assert found["budget_budget"] == pytest.approx(added)
    for name, factor in (("a", 1e-6), ("b", 3e-6)):
        expected = {"power": 2.0, "alone": math.sqrt(5e-6 / factor), "shared": math.sqrt(2.5e-6 / factor), "error": 0.0}
        assert found["allowance"][name] == pytest.approx(expected)
    pictures = {path.name for path in report.parent.glob("*.png")}
    assert pictures == {f"{kind}xi_raw_short.png" for kind in ("curves_", "budget_", "allowance_")} | {"tornado.png"}
    page = report.read_text()
    assert "they add, as far as this tells" in page
    sentence = '<p class="verdict">a matters most for xi_raw_short, which it changes by up to +1.6e-05; next is b'
    assert page.index(sentence) < page.index("<img") < page.index("<table")


@pytest.mark.usefixtures("empty_pictures")
@pytest.mark.parametrize(
    ("excess", "words"), [(0.3, "they do not simply add"), (0.0, "they add, as far as this tells")]
)
def test_effects_that_do_not_add_in_any_replica_do_not_add(tmp_path, excess, words):
    """All at once make three tenths more in each of four replicas, whose effects differ by far more than that."""
    sweep = SWEEP.model_copy(update={"design": SWEEP.design.model_copy(update={"replicas": 4})})
    points = numbered_points(sweep, Path())
    create_store(tmp_path / "s.sweep", sweep, points, {})
    seeds = sorted({p.seed for p in points})
    with SweepStore(tmp_path / "s.sweep") as store:
        for p in points:
            a, b = (p.parameters[name] ** 2 for name in "ab")
            xi = 1e-6 * (1 + seeds.index(p.seed)) * (a + 3.0 * b) * (1.0 + excess * (a > 0.0 and b > 0.0))
            store.write(PointResult(p.number, {"xi_raw_short": xi}, None, 0.1, "here"))
        assert words in write_report(store, tmp_path / "report").read_text()


@pytest.mark.long
def test_metrics_of_a_store_write_no_picture_outside_the_folder(tmp_path):
    points = numbered_points(SWEEP, Path())
    here = tmp_path / "a" / "b"
    here.mkdir(parents=True)
    create_store(here / "s.sweep", SWEEP, points, {})
    with SweepStore(here / "s.sweep") as store:
        for p in points:
            store.write(PointResult(p.number, {"x/../../../pwned": 1.0 + p.parameters["a"]}, None, 0.1, "here"))
        # Folders of the first part of the path, which the system would follow.
        (here / "report" / "curves_x").mkdir(parents=True)
        write_report(store, here / "report")
    assert len(list((here / "report").glob("curves_x_.._.._.._pwned-*.png"))) == 1
    assert {path.name for path in tmp_path.rglob("*") if here not in path.parents} == {"a", "b"}


@pytest.mark.long
@pytest.mark.usefixtures("empty_pictures")
@pytest.mark.parametrize("slope", [pytest.param(0.0, marks=pytest.mark.slow), -1.0, math.nan])
def test_a_metric_that_nothing_raises_has_a_report_without_allowances(tmp_path, slope):
    points = numbered_points(SWEEP, Path())
    create_store(tmp_path / "s.sweep", SWEEP, points, {})
    with SweepStore(tmp_path / "s.sweep") as store:
        for p in points:
            metrics = {"fwhm": 1.0 + p.parameters["a"], "xi_raw_short": 1e-6 + slope * p.parameters["a"]}
            store.write(PointResult(p.number, metrics, None, 0.1, "here"))
        report = write_report(store, tmp_path / "report")
    pictures = {path.name for path in report.parent.glob("*.png")}
    assert "curves_fwhm.png" in pictures
    assert not any(name.startswith("allowance") for name in pictures)


@pytest.mark.long
def test_names_are_shown_letter_by_letter(tmp_path):
    """HTML in a name is no HTML in the report, and dollar signs are no mathematics in its pictures."""
    script, maths = "<script>alert(1)</script>", "M2 x$^{$.dz_um"
    content = SWEEP.model_dump(mode="json")
    named = {script: content["parameters"]["a"], maths: content["parameters"]["b"]}
    for parameter in named.values():
        parameter["marks"] = {script: parameter["marks"]["budget"], "$\\frac{$": 1.5}
    sweep = read_sweep(content | {"parameters": named, "name": script}, "test")
    create_store(tmp_path / "s.sweep", sweep, points := numbered_points(sweep, Path()), {})
    with SweepStore(tmp_path / "s.sweep") as store:
        for p in points:
            xi = 1e-6 * sum(value**2 for value in p.parameters.values())
            store.write(PointResult(p.number, {"xi_raw_short": xi}, None, 0.1, "here"))
        page = write_report(store, tmp_path / "report").read_text()
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert maths in page


def test_errors_of_effects_are_those_of_the_mean_over_replicas(tmp_path):
    points = numbered_points(SWEEP, Path())
    create_store(tmp_path / "s.sweep", SWEEP, points, {})
    seeds = sorted({p.seed for p in points})
    with SweepStore(tmp_path / "s.sweep") as store:
        for p in points:
            # The effect of a is once and three times its square, in two replicas.
            xi = 1e-6 * (1 + 2 * seeds.index(p.seed)) * p.parameters["a"] ** 2
            store.write(PointResult(p.number, {"xi_raw_short": xi}, None, 0.1, "here"))
        curve = next(c for c in curves(read_table(store), SWEEP, "xi_raw_short") if c.parameter == "a")
    # Of two values, the standard error of the mean is half their difference.
    assert curve.change == pytest.approx(2e-6 * curve.value**2)
    assert curve.error == pytest.approx(1e-6 * curve.value**2)
    # A change of half its size, of a square, is a quarter of the distance.
    allowed = allowances([curve], 8e-6)[0]
    assert (allowed.alone, allowed.error) == pytest.approx((2.0, 0.25))


def test_every_metric_and_parameter_is_defined_in_the_report(tmp_path):
    for name, group in [*STARS.items(), *TELESCOPE_METRICS.items()]:
        assert all(metric.meaning for metric in group.metrics), name
    # The longest name that fits: one is the beginning of the other.
    assert "0.5 to 1 deg from the axis" in described_metric("mean_e_0.5_to_1_deg").text
    assert described_metric("mean_e").text.startswith("mean modulus")
    assert described_metric("spot_rms_um").unit == "um"
    assert described_parameter("focal_plane.raft_um") == ("um", "rafts, peak to valley, not the budget's [um]")
    assert described_parameter("R22_S11.rx_urad") == ("urad", "change of R22_S11: tilt about x")
    assert described_parameter("M1.Z5_nm") == ("nm", "change of Z5 of M1")
    for unit in (*LENGTHS, *ANGLES):
        assert described_parameter(f"L1.rx_{unit}") == (unit, "change of L1: tilt about x")
        assert described_metric(f"solved L1.rx_{unit}").unit == unit
    content = {"parameters": {"M2.dz_um": {"nominal": 0, "range": [0, 4]}}, "design": {"points": 3}}
    sweep = read_sweep(content, "test")
    create_store(tmp_path / "s.sweep", sweep, points := numbered_points(sweep, Path()), {})
    with SweepStore(tmp_path / "s.sweep") as store:
        for p in points:
            store.write(
                PointResult(p.number, {"effective_fwhm_arcsec": 0.6 + p.parameters["M2.dz_um"]}, None, 0.1, "here")
            )
        page = write_report(store, tmp_path / "report").read_text()
    for text in ("effective FWHM of the median star", "<td>arcsec</td>", "change of M2: shift along z"):
        assert text in page


def test_digits_are_those_that_the_error_allows():
    for value, error, text in (
        (1.234567, 0.01, "1.235"),
        (1.234567e-6, 3e-8, "1.235e-06"),
        (-0.5678, 0.2, "-0.57"),
        (0.001, 5.0, "0.001"),
        (12345.678, 0.0, "1.23e+04"),
        (0.6543, math.nan, "0.654"),
    ):
        assert with_digits(value, error) == text


@pytest.mark.usefixtures("empty_pictures")
def test_motions_of_compensators_come_after_what_they_compensate(tmp_path):
    content = {"parameters": {"M2.dz_um": {"nominal": 0, "range": [0, 4]}}, "design": {"points": 3}}
    sweep = read_sweep(content, "test")
    create_store(tmp_path / "s.sweep", sweep, points := numbered_points(sweep, Path()), {})
    motions = [f"solved Detector.{name}" for name in ("dx_um", "dy_um", "dz_um", "rx_urad", "ry_urad")]
    with SweepStore(tmp_path / "s.sweep") as store:
        for p in points:
            metrics = dict.fromkeys((*motions, "spot_rms_um"), 10.0 * p.parameters["M2.dz_um"])
            store.write(PointResult(p.number, metrics, None, 0.1, "here"))
        report = write_report(store, tmp_path / "report")
    # Four metrics have curves.
    assert (report.parent / "curves_spot_rms_um.png").is_file()
    assert '<p class="verdict">M2.dz_um is the one parameter of spot_rms_um' in report.read_text()
