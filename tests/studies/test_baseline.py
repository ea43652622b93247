"""Baselines: planted faults are caught, an unchanged model passes, bad files are one line, and files diff well."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import pachon
from pachon.commands.cli import main
from pachon.core.errors import ConfigError
from pachon.models.camera.focal_plane import FocalPlane
from pachon.models.io.bundled import DATA
from pachon.models.io.prescription import load_telescope, save_telescope
from pachon.models.shapes.shape import EvenAsphere
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate.ccd_exposure import expose_ccd
from pachon.pipeline.simulate.ccd_model import model_ccd
from pachon.studies.baseline.baseline import bundled_baselines, check_baseline, make_baseline
from pachon.studies.baseline.file import baseline_text, read_baseline, rounded, write_baseline
from pachon.studies.metrics import camera as camera_metrics
from pachon.studies.metrics.camera import CAMERA
from pachon.studies.metrics.optics import OPTICS
from pachon.studies.metrics.scene import Scene
from pachon.studies.metrics.scene import make_plan as scene_plan
from pachon.testing import assert_matches_baseline

#: All of them need a finished study, of seconds.
pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
PARTS = {"rays": ("opd", "landing", "zernike", "spot"), "camera": CAMERA}
RUN = {"seed": 3, "stars": {"truth": 30, "observed": 24}, "reconstruction": {"components": 5, "order": 2}}


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A project's folder: its telescope, its run configuration and the baseline of both."""
    folder = tmp_path_factory.mktemp("project")
    shutil.copy(DATA / "lsst_v3.3_r.yaml", folder / "telescope.yaml")
    (folder / "run.yaml").write_text(yaml.safe_dump(RUN))
    baseline, left_out = make_baseline(str(folder / "telescope.yaml"), folder, folder / "run.yaml", threads=1)
    assert not left_out
    write_baseline(folder / "telescope.baseline.json", baseline)
    # Parts of it, which are quicker to check.
    for name, kinds in PARTS.items():
        some = {key: figure for key, figure in baseline.figures.items() if key.partition(" ")[0] in kinds}
        write_baseline(folder / f"{name}.json", baseline.model_copy(update={"figures": some}))
    return folder


@pytest.fixture
def mine(project, tmp_path):
    """A copy of the project to change."""
    return Path(shutil.copytree(project, tmp_path / "mine"))


def kinds_out(check):
    return {d.name.partition(" ")[0] for d in check.out}


def surface(telescope, name, **changes):
    found = telescope.surface(name)
    return telescope.with_shape(name, replace(found.shape, **changes))


# --- what does not change passes ---------------------------------------------------------------------------------


def test_an_unchanged_model_passes_far_inside_its_tolerances(project):
    check = check_baseline(project / "telescope.baseline.json", threads=2)
    assert check.passed
    assert check.notes == ()
    # Two digits beyond the tolerance are kept, so half of the last one is 1/200 of it; nothing else moves here.
    assert check.deviations[0].ratio <= 0.0051
    assert kinds_of(check) == {*OPTICS, *CAMERA}


def kinds_of(check):
    return {d.name.partition(" ")[0] for d in check.deviations}


def test_bundled_baselines_pass(capsys):
    assert len(bundled_baselines()) == 2
    assert main(["check", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["passed"] is True
    assert [b["notes"] for b in result["baselines"]] == [[], []]
    assert [b["model"] for b in result["baselines"]] == ["lsst_v3.3_g_vacuum_zemax_check", "lsst_v3.3_r"]
    assert max(d["deviation_over_tolerance"] for b in result["baselines"] for d in b["deviations"]) < 0.3


def test_rounding_of_another_machine_passes(project):
    """Every length moved by some units in its last place does more than another order of the same sums does."""
    telescope = load_telescope(project / "telescope.yaml")
    rng = np.random.default_rng(1)
    for s in telescope.surfaces:
        telescope = telescope.perturbed(s.name, shift=(0, 0, 4e-16 * rng.choice((-1, 1)) * max(1, abs(s.vertex[2]))))
        if "radius" in s.shape.parameters and np.isfinite(s.shape.parameters["radius"]):
            telescope = telescope.with_shape(
                s.name,
                s.shape.with_parameter("radius", s.shape.parameters["radius"] * (1 + 4e-16 * rng.choice((-1, 1)))),
            )
    check = check_baseline(project / "telescope.baseline.json", telescope)
    assert check.passed
    assert check.notes == ("the prescription is not the one that the baseline was made from",)
    # With room: the tolerances are not there by luck.
    assert check.deviations[0].ratio < 0.5


def test_the_folder_may_move_and_the_file_is_the_same_bytes(mine, project, tmp_path):
    assert check_baseline(mine / "rays.json").passed
    again, _ = make_baseline(str(mine / "telescope.yaml"), mine, mine / "run.yaml", threads=2)
    # Not the texts themselves: pytest takes minutes to show how two long ones differ.
    assert (baseline_text(again) == (project / "telescope.baseline.json").read_text()) is True
    assert again.model == "telescope.yaml"
    assert again.configuration == "run.yaml"


def test_keys_that_are_set_are_those_of_a_file_and_kept(mine, monkeypatch, capsys):
    """The oracle of `--set` is a configuration file with the same value."""
    monkeypatch.setattr("pachon.studies.baseline.baseline.OPTICS", {})
    monkeypatch.setattr("pachon.studies.baseline.baseline.CAMERA", {"height": CAMERA["height"]})
    (mine / "other.yaml").write_text(yaml.safe_dump(RUN | {"seed": 4}))
    model, path, kept = str(mine / "telescope.yaml"), str(mine / "heights.json"), str(mine / "kept.json")
    assert main(["baseline", "save", model, "-o", path, "--config", str(mine / "run.yaml")]) == 0
    assert "settings" not in json.loads(Path(path).read_text())
    assert main(["baseline", "save", model, "-o", kept, "--config", str(mine / "run.yaml"), "--set", "seed=4"]) == 0
    assert (json.loads(Path(kept).read_text())["settings"], read_baseline(kept).settings) == (["seed=4"], ("seed=4",))
    set_by_key, set_by_file = check_baseline(path, settings=["seed=4"]), check_baseline(path, None, mine / "other.yaml")
    assert set_by_key.deviations == set_by_file.deviations
    assert not set_by_key.passed
    assert check_baseline(kept).passed
    assert check_baseline(kept, None, mine / "other.yaml").passed
    # A key that is set again wins over the stored value.
    assert check_baseline(kept, settings=["seed=3"]).deviations != check_baseline(kept).deviations
    assert check_baseline(path, settings=["seed=3"]).passed
    capsys.readouterr()
    assert main(["check", path, "--set", "seed=4", "--quiet"]) == 1
    assert main(["check", path, "--set", "sead=4"]) == 2
    assert "error: --set: unknown key sead = 4: did you mean seed?" in capsys.readouterr().err


# --- planted faults ----------------------------------------------------------------------------------------------

WEAKEST = ("Filter_entrance", "Filter_exit", "L3_exit", "M1")
#: The weakest and the strongest of them.
IN_CI = {("Filter_entrance", "absolute"), ("M1", "relative")}


@pytest.mark.parametrize(
    ("name", "change"),
    [
        pytest.param(name, change, marks=[pytest.mark.slow] * ((name, change) not in IN_CI))
        for name in WEAKEST
        for change in ("relative", "absolute")
    ],
)
def test_a_radius_off_by_1e_6_is_caught(project, name, change):
    telescope = load_telescope(project / "telescope.yaml")
    radius = telescope.surface(name).shape.parameters["radius"]
    moved = radius * (1 + 1e-6) if change == "relative" else radius + 1e-6
    telescope = telescope.with_shape(name, telescope.surface(name).shape.with_parameter("radius", moved))
    check = check_baseline(project / "rays.json", telescope)
    assert {"opd", "landing"} <= kinds_out(check)
    # Not by a hair.
    assert check.deviations[0].ratio > 10
    with pytest.raises(AssertionError, match=r"metrics of lsst_v3\.3_r out of tolerance"):
        assert_matches_baseline(telescope, project / "rays.json")


def rewrite(path, old, new):
    text = path.read_text()
    assert text.count(old) >= 1, old
    path.write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("file", "old", "new", "kinds"),
    [
        ("telescope.yaml", "radius: 19.835,", "radius: 19.835001,", {"opd", "zernike", "spot", "landing"}),
        # The first term of silica by 1e-6, and another glass.
        pytest.param("telescope.yaml", "0.69618302", "0.69618372", {"opd", "zernike"}, marks=pytest.mark.slow),
        pytest.param(
            "telescope.yaml",
            "{B: [0.69618302, 0.407925877, 0.897464057], C: [0.00467926519, 0.0135122244, 97.9323636], "
            "range: [0.21, 3.71]}",
            "{glass: N-BK7}",
            {"opd", "zernike", "spot", "landing"},
            marks=pytest.mark.slow,
        ),
        # r^6 of the exit of L2 is all that it has; the smallest of the mirrors' is that of M3.
        pytest.param(
            "telescope.yaml",
            "coefficients: [0.0, -0.001656]",
            "coefficients: [0.0]",
            {"opd", "zernike", "spot"},
            marks=pytest.mark.slow,
        ),
        ("telescope.yaml", "[0.0, 4.5e-07, 8.15e-09]", "[0.0, 4.5e-07]", {"opd", "zernike"}),
        ("run.yaml", "seed: 3", "seed: 4", {"height", "defocus", "psf"}),
        ("run.yaml", "seed: 3", "seed: 3\natmosphere: {r0_m: 0.161}", {"psf", "reconstruction"}),
    ],
)
def test_a_change_of_a_file_is_caught_by_the_command(mine, capsys, file, old, new, kinds):
    rewrite(mine / file, old, new)
    of_telescope = file == "telescope.yaml"
    part = mine / ("rays.json" if of_telescope else "camera.json")
    assert main(["check", str(part), "--all"]) == 1
    lines = capsys.readouterr().out.splitlines()
    what = "prescription" if of_telescope else "configuration"
    assert "out of tolerance" in lines[0]
    assert lines[1] == f"the {what} is not the one that the baseline was made from"
    assert lines[2].startswith(f"{what} changed: ")
    rows = [line for line in lines[3:] if not line.startswith(("metric ", "within:"))]
    ratios = [float(line.split()[-1]) for line in rows]
    assert len(ratios) == len(read_baseline(part).figures)
    assert ratios == sorted(ratios, reverse=True)
    assert kinds <= {line.split()[0] for line, ratio in zip(rows, ratios, strict=True) if ratio > 1}


@pytest.mark.parametrize(
    ("ccd", "motion"),
    [
        ("R03_S12", {"dz_um": 1}),
        ("R22_S11", {"dz_um": -1}),
        pytest.param("R03_S12", {"dz_um": -1}, marks=pytest.mark.slow),
        pytest.param("R22_S11", {"dz_um": 1}, marks=pytest.mark.slow),
    ],
)
def test_a_ccd_moved_by_a_micrometre_is_caught_and_named(mine, capsys, ccd, motion):
    (mine / "run.yaml").write_text(yaml.safe_dump(RUN | {"focal_plane": {"moved": {ccd: motion}}}))
    assert main(["check", str(mine / "camera.json"), "--json"]) == 1
    (result,) = json.loads(capsys.readouterr().out)["baselines"]
    out = {d["name"]: d for d in result["deviations"] if d["deviation_over_tolerance"] > 1}
    # One is moved, one modelled: both figures of the one, nothing of any other.
    assert set(out) >= {f"height {ccd}", f"defocus {ccd}"}
    assert all(name.endswith(ccd) for name in out)
    found = out[f"height {ccd}"]
    assert found["found"] - found["stored"] == pytest.approx(motion["dz_um"], abs=1e-6)
    # The wavefront at 0.9 of an f/1.23 pupil: height times 1 - cos of the ray's angle to the chief ray, 36 to 90 nm.
    assert 30 < abs(out[f"defocus {ccd}"]["found"] - out[f"defocus {ccd}"]["stored"]) < 100


def test_a_changed_sign_of_heights_is_caught(project, monkeypatch):
    drawn = FocalPlane.from_budget

    def upside_down(*args, **keywords):
        plane = drawn(*args, **keywords)
        waves = plane.surfaces.waves * [-1, 1, 1, 1]
        return replace(plane, surfaces=replace(plane.surfaces, polynomial=-plane.surfaces.polynomial, waves=waves))

    monkeypatch.setattr(FocalPlane, "from_budget", upside_down)
    check = check_baseline(project / "camera.json")
    assert kinds_out(check) == {"height", "defocus", "psf", "reconstruction"}
    assert sum(d.name.startswith("height") for d in check.out) == 189


def test_a_changed_sign_where_light_meets_the_heights_is_caught(project, monkeypatch):
    """The heights as such stay as they are; those that light meets do not."""
    trace_pupils = camera_metrics.trace_pupils

    def wrong(*arguments, focal_plane=None, **keywords):
        if focal_plane is not None:
            surfaces = focal_plane.surfaces
            focal_plane = replace(focal_plane, surfaces=replace(surfaces, polynomial=-surfaces.polynomial))
        return trace_pupils(*arguments, focal_plane=focal_plane, **keywords)

    monkeypatch.setattr(camera_metrics, "trace_pupils", wrong)
    assert kinds_out(check_baseline(project / "camera.json")) == {"defocus"}


def test_a_telescope_that_loses_a_figure_is_out(project):
    telescope = replace(load_telescope(project / "telescope.yaml"), wavelength_range=(600e-9, 800e-9), band=None)
    check = check_baseline(project / "rays.json", telescope)
    assert not check.passed
    lost = [d for d in check.out if d.found is None]
    assert {d.name.partition(" ")[0] for d in lost} == {"opd", "spot"}
    assert lost[0].ratio == np.inf
    assert "545 nm" in lost[0].problem
    assert "545 nm" in check.text()


# --- files -------------------------------------------------------------------------------------------------------


def test_a_focal_plane_model_is_fitted_to_all_ccds_of_the_plan(focal_plane_config, plane_model):
    experiment = Experiment.from_config(focal_plane_config())
    names = ("R22_S12", "R22_S11", "R24_S12")  # not the run's own
    found = CAMERA["reconstruction"].compute(
        Scene(experiment.telescope, experiment, scene_plan(experiment.telescope, experiment, ccds=names))
    )
    products = [model_ccd(experiment, expose_ccd(experiment, name), noisy=False) for name in names]
    stars = [p.observed for p in products]
    x, y, e1, e2 = (np.concatenate([getattr(s, key) for s in stars]) for key in ("x", "y", "e1", "e2"))
    planes, *_ = np.linalg.lstsq(np.stack([np.ones(len(x)), x, y], axis=1), np.stack([e1, e2], axis=1), rcond=None)

    def rms(s):
        left = np.stack([s.e1, s.e2], axis=1) - np.stack([np.ones(len(s)), s.x, s.y], axis=1) @ planes
        return np.sqrt(np.mean(left**2))

    first = products[0]
    expected = {
        "mean e truth": np.hypot(first.holdout.e1, first.holdout.e2).mean(),
        "rms residual at stars": rms(first.observed),
        "rms residual away": rms(first.holdout),
    }
    assert found == {f"reconstruction R22_S12 {key}": pytest.approx(v, rel=1e-9) for key, v in expected.items()}
    own = np.sqrt(np.mean([first.holdout.residual_e1**2, first.holdout.residual_e2**2]))
    # The model of the CCD itself has another residual, by a tenth and more.
    assert abs(own - expected["rms residual away"]) > 0.1 * own


@pytest.mark.slow
def test_rounding_does_not_move_the_focal_plane_model(focal_plane_config, monkeypatch):
    experiment = Experiment.from_config(focal_plane_config())
    plan = scene_plan(experiment.telescope, experiment, ccds=("R22_S11", "R22_S12"))
    before = CAMERA["reconstruction"].compute(Scene(experiment.telescope, experiment, plan, threads=1))
    rng = np.random.default_rng(0)

    def rounded_otherwise(*arguments, **keywords):
        product = model_ccd(*arguments, **keywords)
        noise = 1e-7 * rng.normal(size=(3, len(product.observed)))  # five times that of fused multiply-adds
        e1, e2, size = (getattr(product.observed, key) for key in ("e1", "e2", "size"))
        moved = replace(product.observed, e1=e1 + noise[0], e2=e2 + noise[1], size=size * (1.0 + noise[2]))
        return replace(product, observed=moved)

    monkeypatch.setattr(camera_metrics, "model_ccd", rounded_otherwise)
    after = CAMERA["reconstruction"].compute(Scene(experiment.telescope, experiment, plan, threads=2))
    # A tenth of the tolerance; 3e-8 measured.
    assert after == {key: pytest.approx(value, abs=2e-7) for key, value in before.items()}
    assert after != before


def test_one_figure_stands_on_one_line_in_order(project):
    path = project / "telescope.baseline.json"
    lines = path.read_text().splitlines()
    first = lines.index(' "figures": {') + 1
    names = [json.loads("{" + line.rstrip(",") + "}") for line in lines[first:-2]]
    assert all(len(n) == 1 for n in names)
    keys = [next(iter(n)) for n in names]
    assert keys == sorted(keys)
    baseline = read_baseline(path)
    assert list(baseline.figures) == keys
    assert {f.reason for f in baseline.figures.values()} == set(baseline.reasons)
    assert baseline.pachon == pachon.__version__
    assert (baseline_text(baseline) == path.read_text()) is True


def test_a_change_changes_the_lines_of_what_changed_and_no_others(mine):
    before = (mine / "camera.json").read_text().splitlines()
    (mine / "run.yaml").write_text(yaml.safe_dump(RUN | {"focal_plane": {"moved": {"R03_S12": {"dz_um": 1}}}}))
    assert main(["baseline", "update", str(mine / "camera.json"), "--quiet"]) == 0
    after = (mine / "camera.json").read_text().splitlines()
    changed = [a.split(":")[0].strip() for a, b in zip(after, before, strict=True) if a != b]
    assert changed == ['"configuration_sha256"', '"defocus R03_S12"', '"height R03_S12"']
    assert main(["check", str(mine / "camera.json"), "--quiet"]) == 0


@pytest.mark.parametrize(
    ("value", "tolerance", "text"), [(1.23456789, 1e-3, 1.23457), (-1e-9, 1e-3, 0.0), (1234.5678, 30.0, 1234.6)]
)
def test_values_keep_two_digits_beyond_their_tolerance(value, tolerance, text):
    assert repr(rounded(value, tolerance)) == repr(text)


def test_another_telescope_is_another(project, capsys):
    file = str(project / "rays.json")
    assert main(["check", file, "--model", "lsst_v3.3_r", "--quiet"]) == 0
    assert main(["check", file, "--model", "lsst_v3.3_i"]) == 1
    out = capsys.readouterr().out
    assert "metrics of lsst_v3.3_i out of tolerance" in out
    # Two notes, one cause, and the worst twenty: another band is another configuration too.
    assert len(out.splitlines()) == 5 + 20
    assert "\nprescription and configuration changed: landing" in out


def test_a_telescope_alone_and_options(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    options = ["--field-deg", "0", "--field-deg", "0.5,0.3", "--wavelength-nm", "600", "--quiet"]
    assert main(["baseline", "save", "paul_baker", "-o", "pb.baseline.json", *options]) == 0
    baseline = read_baseline(Path("pb.baseline.json"))
    assert baseline.plan.fields_deg == ((0.0, 0.0), (0.5, 0.3))
    assert baseline.plan.wavelengths_nm == (600.0,)
    assert baseline.configuration is None
    assert {n.partition(" ")[0] for n in baseline.figures} == set(OPTICS)
    assert main(["check", "pb.baseline.json"]) == 0
    assert "metrics of paul_baker within their tolerances" in capsys.readouterr().out


def test_a_file_beside_the_baselines_folder_is_found(tmp_path, monkeypatch):
    (tmp_path / "designs").mkdir()
    save_telescope(load_telescope("paul_baker"), tmp_path / "designs" / "pb.yaml")
    (tmp_path / "baselines").mkdir()
    monkeypatch.chdir(tmp_path)
    command = ["baseline", "save", "designs/pb.yaml", "-o", "baselines/pb.baseline.json", "--field-deg", "0"]
    assert main([*command, "--quiet"]) == 0
    assert read_baseline(Path("baselines/pb.baseline.json")).model == "../designs/pb.yaml"
    monkeypatch.chdir(tmp_path / "designs")
    assert main(["check", "../baselines/pb.baseline.json", "--quiet"]) == 0


# --- bad input ---------------------------------------------------------------------------------------------------


def broken(project, tmp_path, change):
    content = json.loads((project / "telescope.baseline.json").read_text())
    content["model"] = "lsst_v3.3_r"
    content["configuration"] = None
    del content["configuration_sha256"], content["configuration"]
    change(content)
    path = tmp_path / "bad.baseline.json"
    path.write_text(json.dumps(content))
    return path


def first_figure(content):
    return next(iter(content["figures"].values()))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.update(format="other"), ["format = 'other'", "pachon baseline"]),
        (lambda c: c.update(version=5), ["version = 5", "expected 3 or 4", f"pachon {pachon.__version__}"]),
        (lambda c: first_figure(c).update(limit={}), ["limit", "expected max or min"]),
        (lambda c: first_figure(c).update(limit={"most": 1}), ["limit", "most"]),
        (lambda c: c.update(model="lsst_v3.3_q"), ["lsst_v3.3_q"]),
        (lambda c: c.update(model="none.yaml"), ["none.yaml"]),
        (lambda c: c.update(configuration="none.yaml"), ["none.yaml"]),
        (lambda c: c.update(extra=1), ["unknown key extra"]),
        (lambda c: c.update(figures={}), ["figures"]),
        (lambda c: c.pop("plan"), ["plan"]),
        (lambda c: c["plan"].update(fields_deg=[[0]]), ["plan.fields_deg[0]"]),
        (lambda c: c["plan"].update(wavelengths_nm=[]), ["plan.wavelengths_nm"]),
        (lambda c: first_figure(c).update(value="x"), ['value = "x"', "number"]),
        (lambda c: first_figure(c).update(tolerance=0), ["tolerance = 0", "above 0"]),
        (lambda c: first_figure(c).update(reason="luck"), ["reason = 'luck'", "path"]),
    ],
)
def test_a_bad_file_is_one_line_and_status_2(project, tmp_path, capsys, change, words):
    path = broken(project, tmp_path, change)
    assert main(["check", str(path)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("pachon: error: ")
    assert "bad.baseline.json" in err
    for word in words:
        assert word in err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "no JSON (line 1"),
        ("[1]", "format = 'list'"),
        ("[" * 100000, "no JSON"),
        ('{"figures": {"a": 1, "a": 2}}', "'a' occurs twice"),
        ("\xff", "no JSON"),
        ("<<<<<<< HEAD", "no JSON (line 1"),
    ],
)
def test_what_is_no_json_is_one_line(tmp_path, capsys, text, words):
    path = tmp_path / "b.json"
    path.write_bytes(text.encode("latin-1"))
    assert main(["check", str(path)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert words in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["check", "none.json"], "none.json: no such file"),
        (["check", "."], "cannot be read"),
        (["check", "--model", "lsst_v3.3_i"], "expected a FILE"),
        (["check", "--set", "seed=4"], "expected a FILE"),
        (["baseline", "save", "lsst_v3.3_r", "-o", "x.json", "--set", "seed=4"], "--set seed=4: expected a config"),
        (["baseline", "save", "lsst_v3.3_r"], "'--out'"),
        (["baseline", "sav", "lsst_v3.3_r"], "'save'"),
        (["baseline", "save", "lsst_v3.3_x", "-o", "x.json"], "lsst_v3.3_x"),
        (["baseline", "save", "lsst_v3.3_r", "-o", "x.json", "--ccds", "R22_S11"], "expected a configuration"),
        (["baseline", "save", "lsst_v3.3_r", "-o", "x.json", "--config", "none.yaml"], "none.yaml"),
        (["baseline", "save", "lsst_v3.3_r", "-o", "x.json", "--field-deg", "9"], "field"),
        (["baseline", "update", "none.json"], "none.json: no such file"),
    ],
)
def test_bad_arguments_are_one_line_and_leave_nothing(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    err = capsys.readouterr().err.splitlines()[-1]
    assert err.startswith("pachon: error: ")
    assert words in err
    assert list(tmp_path.iterdir()) == []


def test_a_telescope_without_a_camera_has_no_heights(tmp_path, capsys):
    (tmp_path / "run.yaml").write_text("seed: 1\n")
    command = ["baseline", "save", "paul_baker", "-o", str(tmp_path / "x.json"), "--config", str(tmp_path / "run.yaml")]
    assert main([*command, "--quiet"]) == 2
    assert "expected a camera: lsst, " in capsys.readouterr().err


# --- for other projects ------------------------------------------------------------------------------------------


def test_assert_matches_baseline(project):
    path = project / "rays.json"
    assert_matches_baseline(None, path)
    assert_matches_baseline(project / "telescope.yaml", path)
    assert_matches_baseline("lsst_v3.3_r", str(path))
    with pytest.raises(ConfigError, match="no such file"):
        assert_matches_baseline("lsst_v3.3_r", project / "none.json")
    moved = load_telescope("lsst_v3.3_r").perturbed("M2", shift=(0, 0, 1e-6))
    with pytest.raises(AssertionError) as caught:
        assert_matches_baseline(moved, path)
    lines = str(caught.value).splitlines()
    assert lines[2].startswith("prescription changed: landing")
    assert lines[3].split()[:3] == ["metric", "now", "baseline"]
    assert len(lines) == 4 + 20


def run_pytest(folder, *arguments):
    environment = os.environ | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    command = [sys.executable, "-m", "pytest", "-p", "pachon.pytest_plugin", "-p", "no:cacheprovider", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


@pytest.mark.slow
def test_pytest_collects_baselines(mine):
    shutil.move(mine / "rays.json", mine / "telescope.baseline.json")
    done = run_pytest(mine, "-v")
    assert done.returncode == 0, done.stdout
    assert "telescope.baseline.json::baseline PASSED" in done.stdout
    rewrite(mine / "telescope.yaml", "radius: 19.835,", "radius: 19.835001,")
    done = run_pytest(mine)
    assert done.returncode == 1
    assert "out of tolerance" in done.stdout
    assert "Traceback" not in done.stdout
    assert "def runtest" not in done.stdout


def test_the_plugin_costs_nothing_unused(tmp_path):
    code = "import sys, pachon.pytest_plugin; print('numpy' in sys.modules, 'pydantic' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert settings["project"]["entry-points"]["pytest11"] == {"pachon": "pachon.pytest_plugin"}


def test_asphere_of_the_planted_fault_is_what_it_says():
    shape = load_telescope("lsst_v3.3_r").surface("L2_exit").shape
    assert isinstance(shape, EvenAsphere)
    assert tuple(shape.coefficients) == (0.0, -0.001656)


def test_a_rotated_camera_has_the_figures_that_symmetry_demands(mine):
    """Optics symmetric about the axis, and the mean of all air: the camera may be at any angle."""
    (mine / "run.yaml").write_text(yaml.safe_dump({**RUN, "rotator_deg": 90.0}))
    turned = check_baseline(mine / "camera.json", threads=1)
    assert turned.passed
    assert turned.notes == ("the configuration is not the one that the baseline was made from",)
    # M2 off its axis: the angle now matters, and the camera is compared at the angle of the configuration.
    telescope = load_telescope(str(mine / "telescope.yaml")).perturbed("M2", shift=(2e-4, 0.0, 0.0))
    save_telescope(telescope, mine / "telescope.yaml")
    found = {}
    for angle in (0.0, 90.0):
        (mine / "run.yaml").write_text(yaml.safe_dump({**RUN, "rotator_deg": angle}))
        check = check_baseline(mine / "camera.json", threads=1)
        found[angle] = {d.name: d.found for d in check.out}
    assert "psf" in kinds_out(check)
    assert found[0.0] != found[90.0]
