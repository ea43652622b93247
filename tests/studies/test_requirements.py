"""Requirements and tolerances of baselines: what is given, what it accepts, and causes of failures."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from pachon import load_telescope, make_baseline, spots
from pachon.commands.cli import main
from pachon.core.errors import ConfigError
from pachon.studies import read_baseline, write_baseline
from pachon.studies.baseline.baseline import check_baseline
from pachon.studies.baseline.check import BROKEN, MISSING, BaselineCheck, Deviation
from pachon.studies.baseline.file import Limit, baseline_text
from pachon.studies.baseline.requirements import Requirements, check_used, given_limit, given_tolerance, parse_rules
from pachon.testing import assert_matches_baseline

MODEL = "paul_baker"
ONE = ["--field-deg", "0.3,0", "--wavelength-nm", "600"]


@pytest.fixture(scope="module")
def plain():
    """Baseline of one field and one wavelength."""
    return make_baseline(MODEL, fields=np.deg2rad([[0.3, 0.0]]), wavelengths=[600e-9], threads=1)[0]


def written(path, baseline, **changes):
    """Write a baseline with changes of its metrics, functions of name and metric by field."""
    figures = {
        name: metric.model_copy(update={key: change(name, metric) for key, change in changes.items()})
        for name, metric in baseline.figures.items()
    }
    write_baseline(path, baseline.model_copy(update={"figures": figures}))
    return path


def moved(millimetres):
    return load_telescope(MODEL).perturbed("M2", shift=(0.0, 0.0, millimetres * 1e-3))


# --- what is given -------------------------------------------------------------------------------------------------


def test_amounts_are_in_the_unit_of_each_metric():
    rules = parse_rules("tolerance", ["1 %", "spot rms = 0.1 um", "spot = 2e-3mm", "vignetting=0.02"])
    # A part of the value, never below the metric's own; an amount; the rule with the most words.
    assert given_tolerance(rules, "opd axis", "nm", -250.0, 0.003) == 2.5
    assert given_tolerance(rules, "opd axis", "nm", 1e-3, 0.003) == 0.003
    assert given_tolerance(rules, "spot rms axis", "um", 5.0, 1e-6) == 0.1
    assert given_tolerance(rules, "spot axis", "um", 5.0, 1e-6) == pytest.approx(2.0, rel=1e-15)
    assert given_tolerance(rules, "spotless", "um", 5.0, 1e-6) == 0.05
    assert given_tolerance(rules, "vignetting axis", "", 0.5, 1e-3) == 0.02
    assert given_tolerance((), "opd", "nm", 1.0, 1e-3) is None

    limits = parse_rules("limit", ["spot rms < 10 um", "spot rms > 1e-3 mm", "spot < 20", "opd > -5"])
    assert given_limit(limits, "spot rms axis", "um") == Limit(max=10.0, min=1.0)
    assert given_limit(limits, "spot axis", "um") == Limit(max=20.0)
    assert given_limit(limits, "opd axis", "nm") == Limit(min=-5.0)
    assert given_limit(limits, "ee80", "um") is None


def test_a_limit_holds_at_its_bounds():
    both = Limit(max=10.0, min=1.0)
    assert [both.holds(v) for v in (0.999, 1.0, 5.0, 10.0, 10.001)] == [False, True, True, True, False]
    assert str(both) == "<= 10, >= 1"
    assert Limit(max=0.0).holds(-1.0)
    assert not Limit(min=0.0).holds(-1.0)


@pytest.mark.parametrize(
    ("option", "text"),
    [
        ("tolerance", "1e-3"),  # of what?
        ("tolerance", "spot < 1"),
        ("tolerance", "spot = 0"),
        ("tolerance", "spot = -1 um"),
        ("tolerance", "spot = much"),
        ("tolerance", "spot ="),
        ("tolerance", ""),
        ("tolerance", "1.2.3 %"),
        ("limit", "spot = 10 um"),
        ("limit", "< 10 um"),
        ("limit", "spot"),
        ("limit", "1 < spot < 10"),
        ("limit", "spot < nan"),
    ],
)
def test_texts_that_are_none_are_one_line(option, text):
    with pytest.raises(ConfigError) as caught:
        parse_rules(option, [text])
    assert str(caught.value).startswith(f"{option} = {text!r}: expected ")
    assert "\n" not in str(caught.value)


def test_units_and_names_that_do_not_fit_are_named():
    with pytest.raises(
        ConfigError, match=r"^limit = 'spot < 3 kg': expected a unit that converts to um, that of spot a"
    ):
        given_limit(parse_rules("limit", ["spot < 3 kg"]), "spot a", "um")
    with pytest.raises(ConfigError, match=r"^limit = 'lit < 3 um': expected a unit that converts to a pure number"):
        given_limit(parse_rules("limit", ["lit < 3 um"]), "lit", "")
    with pytest.raises(ConfigError, match=r"^limit of spot a: expected a least value below the largest, 1 um"):
        given_limit(parse_rules("limit", ["spot < 1 um", "spot > 2 um"]), "spot a", "um")
    with pytest.raises(
        ConfigError, match=r"^tolerance = 'spt = 1 um': no metric begins with 'spt'; there are opd, spot"
    ):
        check_used(parse_rules("tolerance", ["opd = 1 nm", "spt = 1 um"]), ["spot a", "opd a", "opd b"], {})
    with pytest.raises(ConfigError, match=r"^limit = 'psf fwhm < 1 arcsec': no metrics of kind psf: no light"):
        check_used(parse_rules("limit", ["psf fwhm < 1 arcsec"]), ["spot a"], {"psf": "no light"})


# --- what it accepts -----------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_requirement_is_met_or_broken_whatever_the_drift(plain, tmp_path):
    own = 1e6 * float(spots(load_telescope(MODEL), np.deg2rad([[0.3, 0.0]]), 600e-9, threads=1).rms_radius.squeeze())
    rules = parse_rules("limit", [f"spot rms < {own + 1.0:.6g} um"])
    path = written(
        tmp_path / "b.baseline.json",
        plain,
        tolerance=lambda name, metric: 1e9,
        limit=lambda name, metric: given_limit(rules, name, metric.unit),
    )
    # All may move, but spots may grow by a micrometre only; in a beam of f/1.2 defocus of 1 um makes 0.3 um.
    near, far = (check_baseline(path, moved(d), threads=1) for d in (1e-4, 0.3))
    assert near.passed
    assert not far.passed
    assert [d.name.partition(" ")[0] for d in far.out] == ["spot"]
    assert far.causes[BROKEN] == far.out
    assert far.out[0].found > own + 1.0
    assert far.verdict == f"{path}: 1 of {len(plain.figures)} metrics of {far.model} beyond their limits"
    assert f"<= {own + 1.0:.6g}" in far.text()
    with pytest.raises(AssertionError, match="requirement broken: spot 1"):
        assert_matches_baseline(moved(0.3), path, threads=1)


@pytest.mark.long
def test_given_tolerances_are_written_with_their_reason(plain, tmp_path):
    rules = ["landing = 1 mm", "zernike=1um", "spot rms = 50 %"]
    baseline, _ = make_baseline(
        MODEL,
        fields=np.deg2rad([[0.3, 0.0]]),
        wavelengths=[600e-9],
        threads=1,
        requirements=Requirements(rules, ["ee80 < 1 mm"]),
    )
    for name, metric in baseline.figures.items():
        kind, before = name.partition(" ")[0], plain.figures[name]
        expected = {"landing": 1.0, "zernike": 1e3, "spot": 0.5 * before.value}.get(kind, before.tolerance)
        assert metric.tolerance == pytest.approx(expected, rel=1e-6)
        assert metric.reason == ("given" if kind in ("landing", "zernike", "spot") else before.reason)
        assert metric.value == before.value
        assert metric.limit == (Limit(max=1e3) if kind == "ee80" else None)
    assert "given" in baseline.reasons
    assert "given" not in plain.reasons


# --- causes --------------------------------------------------------------------------------------------------------


def deviation(name, found, limit=None):
    return Deviation(name, "um", 1.0, 0.1, found, None, None if found is not None else "no light", limit)


def test_failures_are_grouped_by_cause_each_once():
    all_of_them = (
        deviation("spot a", 3.0, Limit(max=2.0)),  # out of tolerance, too
        deviation("spot b", 1.05, Limit(max=1.02)),
        deviation("opd a", None, Limit(max=2.0)),
        deviation("opd b", 1.2),
        deviation("ee80", 1.0, Limit(max=2.0)),
    )
    for changed, cause in (
        ((), "drift of the same inputs (machine, libraries)"),
        (("pachon",), "pachon changed"),
        (("pachon", "prescription"), "prescription changed"),
        (("prescription", "configuration"), "prescription and configuration changed"),
    ):
        check = BaselineCheck("f", "m", all_of_them, (), changed)
        named = {key: [d.name for d in each] for key, each in check.causes.items()}
        assert named == {BROKEN: ["spot a", "spot b"], MISSING: ["opd a"], cause: ["opd b"]}
        assert check.verdict == "f: 3 of 5 metrics of m out of tolerance, 2 of 5 metrics of m beyond their limits"
        lines = check.text().splitlines()
        heads = [line for line in lines if line.startswith((BROKEN, MISSING, cause))]
        assert heads == ["requirement broken: spot 2", "metric missing: opd 1", f"{cause}: opd 1"]
        summary = check.summary()
        assert summary["causes"] == {BROKEN: 2, MISSING: 1, cause: 1}
        assert [d["cause"] for d in summary["deviations"]] == [BROKEN, BROKEN, MISSING, cause, None]
        json.dumps(summary["deviations"][0]["limit"])
    assert "ee80" not in check.text()
    assert "within: ee80 1" in check.text(everything=True)
    assert BaselineCheck("f", "m", all_of_them[4:], ()).verdict.endswith("within their tolerances and limits")


# --- files and commands --------------------------------------------------------------------------------------------


def test_files_without_limits_are_those_of_an_older_pachon(plain, tmp_path):
    path = written(tmp_path / "b.baseline.json", plain)
    content = json.loads(path.read_text())
    assert content["version"] == 3
    name = next(n for n in content["figures"] if n.startswith("spot"))
    assert "limit" not in content["figures"][name]
    content["figures"][name]["limit"] = {"max": 1e3}  # by hand, in a file of the first version
    path.write_text(json.dumps(content))
    baseline = read_baseline(path)
    assert baseline.figures[name].limit == Limit(max=1e3)
    again = json.loads(baseline_text(baseline))
    assert again["version"] == 4
    assert again["figures"][name]["limit"] == {"max": 1e3}


@pytest.mark.long
def test_commands(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save = ["baseline", "save", MODEL, "-o", "b.baseline.json", *ONE, "--tolerance", "50 %"]
    assert main([*save, "--limit", "spot"]) == 2
    assert "limit = 'spot': expected NAME < AMOUNT" in capsys.readouterr().err
    assert not Path("b.baseline.json").exists()
    assert main([*save, "--limit", "spot rms > 1 m", "--quiet"]) == 0
    assert "1 metric is beyond their limits, such as spot rms" in capsys.readouterr().err
    assert main(["check", "b.baseline.json", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)["baselines"][0]
    assert found["causes"] == {BROKEN: 1}
    assert [d["limit"] for d in found["deviations"] if d["cause"]] == [{"min": 1e6}]
    # Accepting new values accepts no broken requirement.
    assert main(["baseline", "update", "b.baseline.json"]) == 0
    captured = capsys.readouterr()
    assert "0 of" in captured.out
    assert "beyond their limits" in captured.err


@pytest.mark.long
def test_a_lens_file_with_several_wavelengths_has_all_its_metrics_and_limits(tmp_path):
    """Tolerances of lengths come from the path of one ray, whatever wavelengths the file weighs."""
    lens = str(Path(__file__).parents[1] / "data" / "zmx" / "lens1.zmx")
    assert len(load_telescope(lens).design_data.wavelengths) == 3
    baseline, left_out = make_baseline(
        lens,
        tmp_path,
        fields=np.zeros((1, 2)),
        requirements=Requirements(["landing = 1 um"], ["spot rms < 3 um"]),
        threads=1,
    )
    assert not left_out
    kinds = {name.split()[0] for name in baseline.figures}
    assert kinds == {"opd", "landing", "zernike", "spot", "ee80", "distortion", "vignetting"}
    write_baseline(tmp_path / "b.baseline.json", baseline)
    check = check_baseline(tmp_path / "b.baseline.json", lens, threads=1)
    beyond = {name for name, f in baseline.figures.items() if name.startswith("spot rms") and f.value > 3.0}
    assert {d.name for d in check.causes[BROKEN]} == beyond != set()


@pytest.mark.long
def test_a_field_with_too_little_light_loses_its_zernikes_alone(tmp_path):
    """At 0.75 degrees of HSC rays of the whole annulus leave the corrector: its terms are those of the light."""
    fields = np.radians([[0.0, 0.3], [0.0, 0.75], [0.0, 0.9]])
    baseline, left_out = make_baseline("hsc", tmp_path, fields=fields, threads=1)
    assert not left_out
    zernikes = [name for name in baseline.figures if name.startswith("zernike")]
    assert len(zernikes) == 24
    assert not any("0.9)" in name for name in zernikes)
    _, left_out = make_baseline("hsc", tmp_path, fields=fields[2:], threads=1)
    assert re.search(r"light passes at \d+ % of the pupil, where jmax = \d+ terms cannot be", left_out["zernike"])


def test_sources_are_those_of_names_that_begin_with_their_words(plain):
    sourced = plain.with_sources({"spot rms": "a peer"}).with_sources({"landing": "a listing"})
    expected = {"spot rms": "a peer", "landing": "a listing"}
    for name, metric in sourced.figures.items():
        assert metric.checked_against == next((v for k, v in expected.items() if name.startswith(k)), None)
        assert metric.value == plain.figures[name].value
    with pytest.raises(ConfigError, match=r"checked: no argument of make_baseline; expected baseline.with_sources"):
        make_baseline(MODEL, checked={"opd": "a peer"})
    with pytest.raises(ConfigError, match=r"limits: no argument of make_baseline; expected requirements=Requirements"):
        make_baseline(MODEL, limits=[])
