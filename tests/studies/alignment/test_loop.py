"""The active-optics loop: convergence, honesty of what it expects, heights, bytes, files."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import QTable

import pachon
from pachon.commands.cli import main
from pachon.core.errors import ConfigError, ProductError, UnknownNameError
from pachon.core.long_work import Execution
from pachon.core.units import ARCSEC
from pachon.models.io.yaml.writer import telescope_to_yaml
from pachon.pipeline.config_hash import hashed_states
from pachon.pipeline.experiment import Experiment
from pachon.studies.alignment import loop
from pachon.studies.alignment.config import AlignConfig, load_align_configuration
from pachon.studies.alignment.field_quality import FieldMeans
from pachon.studies.alignment.loop import align
from pachon.studies.alignment.product import quality_picture, write_alignment
from pachon.studies.alignment.scene import AlignmentScene
from pachon.studies.alignment.store import VisitStore

QUIET = {"wavefront": False}


def config(**changes):
    return AlignConfig(**({"visits": 4, "air": QUIET} | changes))


@pytest.fixture(scope="module")
def aligned(traced_donuts):
    return align(config())


@pytest.mark.long
def test_the_sensitivity_is_that_of_traced_wavefronts(donut_zernikes):
    scene = AlignmentScene.of(config())
    state = 0.3 * np.random.default_rng(2).normal(size=50)
    moved = scene.freedoms.apply(scene.telescope, state * scene.tolerances)
    change = donut_zernikes(moved, scene) - donut_zernikes(scene.telescope, scene)
    linear = (scene.sensitivity @ state).reshape(change.shape)
    # 7 nm of 90: the part of the second order, and terms beyond Z28 under vignetting.
    assert np.sqrt(((change - linear) ** 2).sum(axis=1)).max() < 0.1 * np.sqrt((change**2).sum(axis=1)).min()
    assert np.sqrt((scene.field_response**2).sum(axis=0)) * scene.tolerances == pytest.approx(50e-9)


def test_what_is_added_over_the_field_is_what_the_response_expects():
    scene = AlignmentScene.of(config())
    state = 0.3 * np.random.default_rng(5).normal(size=50)
    moved = scene.freedoms.apply(scene.telescope, state * scene.tolerances)
    found = scene.quality.means(moved)
    assert found.added == pytest.approx(scene.expected_wavefront(np.outer(state, state)), rel=0.06)
    assert scene.quality.means(scene.telescope).added == 0.0


def test_shapes_over_the_field_are_those_of_hsm():
    """GalSim's adaptive moments of the same images, and the round weight of 0.7 arcsec, which halves g."""
    galsim = pytest.importorskip("galsim")
    scene = AlignmentScene.of(config())
    quality = scene.quality
    found = quality.means(scene.telescope)
    stars = pachon.make_psfs(
        scene.telescope,
        quality.fields,
        scene.wavelengths,
        atmosphere=scene.atmosphere,
        engine="long_exposure",
        stamps=pachon.Stamps(41),
    )
    moments = [galsim.hsm.FindAdaptiveMom(galsim.Image(np.asarray(image, dtype=float))) for image in stars.image]
    g = np.array([m.observed_shape.g for m in moments])
    sigma = np.array([m.moments_sigma for m in moments]) * stars.pixel_scale
    # To the last steps of both iterations.
    assert found.rms_g == pytest.approx(np.sqrt(np.mean(g**2)), rel=1e-3)
    size = np.mean(2.0 * sigma**2 * (1.0 + g**2) / (1.0 - g**2)) / ARCSEC**2
    assert found.size == pytest.approx(size, rel=1e-5)
    assert 1.5 < found.rms_g / found.rms_e < 2.5


def test_visits_of_an_earlier_version_are_refused_in_one_line(tmp_path):
    store = VisitStore(tmp_path, {})
    arrays = dict.fromkeys(("zernikes", "covariance", "usable", "images", "model"), np.zeros(1))
    np.savez(tmp_path / "visit_00000.npz", quality=np.zeros(4), inputs=np.array("{}"), **arrays)
    with pytest.raises(ProductError, match=r"visit_00000\.npz: expected a visit of a loop \(4 means"):
        store.read(0)


@pytest.mark.long
def test_the_loop_converges_within_two_corrections_to_what_it_expects(aligned):
    added = np.array([v.added for v in aligned.visits])
    assert added[0] > 600e-9
    total = np.array([v.wavefront for v in aligned.visits])
    assert total[2:].max() < 1.2 * np.hypot(aligned.designed.wavefront, aligned.floor)
    assert np.sqrt(np.mean(added[2:] ** 2)) == pytest.approx(np.sqrt(np.mean(aligned.expected[2:] ** 2)), rel=0.35)
    assert aligned.visits[0].fwhm > 1.2 * aligned.designed.fwhm
    assert aligned.visits[-1].fwhm == pytest.approx(aligned.designed.fwhm, rel=0.01)
    assert (aligned.donuts == 8).all()


@pytest.mark.long
def test_donuts_without_a_result_do_not_lower_the_floor(aligned, traced_donuts, monkeypatch):
    """Six of the eight in the last visit: their covariance is NaN, which is no perfect measurement."""
    traced = loop.fit

    def fit(scene, exposed, threads):
        fitted = traced(scene, exposed, threads)
        if exposed[1] == 1:
            fitted.usable[:6] = False
            fitted.zernikes[:6] = fitted.error_parts.photons[:6] = np.nan
        return fitted

    monkeypatch.setattr(loop, "fit", fit)
    found = align(config(visits=2))
    assert list(found.donuts) == [8, 2]
    assert found.floor == aligned.floor


@pytest.mark.long
def test_bytes_do_not_depend_on_threads_or_later_visits(aligned, traced_donuts):
    again = align(config(visits=2), execution=Execution(threads=1))
    assert again.states.tobytes() == aligned.states[:2].tobytes()
    assert again.visits == aligned.visits[:2]


@pytest.mark.long
def test_a_killed_loop_goes_on_to_the_same_bytes(traced_donuts, tmp_path, monkeypatch):
    class Killed(BaseException):
        """Stand-in for the end of a process."""

    whole, killed = tmp_path / "whole", tmp_path / "killed"
    align(config(visits=2), store=whole)
    original = loop.fit
    calls = []

    def fit(*arguments):
        calls.append(1)
        if len(calls) == 2:
            raise Killed
        return original(*arguments)

    monkeypatch.setattr(loop, "fit", fit)
    with pytest.raises(Killed):
        align(config(visits=2), store=killed)
    with pytest.raises(ProductError, match="go on with --resume"):
        align(config(visits=2), store=killed)
    with pytest.raises(ProductError, match=r"another configuration \(seed: 1"):
        align(config(visits=2, seed=2), store=killed, execution=Execution(resume=True))
    # One visit stands; the second alone is exposed.
    align(config(visits=2), store=killed, execution=Execution(resume=True))
    assert len(calls) == 3
    names = sorted(path.name for path in whole.iterdir())
    assert names == sorted(path.name for path in killed.iterdir())
    assert len(names) == 3
    for name in names:
        assert (whole / name).read_bytes() == (killed / name).read_bytes()
    damaged = killed / "visit_00000.npz"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    with pytest.raises(ProductError, match=r"visit_00000\.npz: expected a visit of a loop"):
        align(config(visits=2), store=killed, execution=Execution(resume=True))


@pytest.mark.long
def test_a_loop_does_not_go_on_with_other_optics(traced_donuts, tmp_path):
    telescope = tmp_path / "mine.yaml"
    text = telescope_to_yaml(pachon.load_telescope("lsst_v3.3_r"))
    telescope.write_text(text)
    settings = config(visits=1, telescope="mine.yaml")
    align(settings, folder=tmp_path, store=tmp_path / "out")
    # Same optics, but another content, and back again.
    telescope.write_text(text + "\n# changed\n")
    with pytest.raises(ProductError, match=r"visit_00000\.npz: the file of telescope has changed since") as caught:
        align(settings, folder=tmp_path, store=tmp_path / "out", execution=Execution(resume=True))
    assert "\n" not in str(caught.value)
    telescope.write_text(text)
    align(settings, folder=tmp_path, store=tmp_path / "out", execution=Execution(resume=True))


@pytest.mark.slow
def test_files_have_the_loop_and_states_go_into_runs(aligned, tmp_path):
    names = write_alignment(aligned, tmp_path)
    assert sorted(names) == sorted(path.name for path in tmp_path.iterdir())
    visits = QTable.read(tmp_path / "visits.ecsv")
    assert visits["added"].to_value("m") == pytest.approx([v.added for v in aligned.visits])
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["first_visit_within_1.2_floors"] <= 2
    assert load_align_configuration(tmp_path / "config.yaml") == config()
    states = tmp_path / "states.ecsv"
    run = {"active_optics": {"states": "states.ecsv"}, "atmosphere": {"epoch": 3}}
    experiment = Experiment.from_config(pachon.Configuration(**run), tmp_path)
    scene = aligned.scene
    expected = scene.freedoms.apply(scene.telescope, aligned.states[3] * scene.tolerances)
    assert experiment.telescope == expected
    plain = Experiment.from_config(pachon.Configuration(atmosphere={"epoch": 3}))
    assert experiment.config_hash != plain.config_hash
    states.write_text(states.read_text().replace("\n3 ", "\n33 "))
    with pytest.raises(ConfigError, match=r"active_optics.states: .*states.ecsv: visit = 3: expected one row"):
        Experiment.from_config(pachon.Configuration(**run), tmp_path)


def test_runs_without_states_keep_their_hash():
    assert hashed_states({"residual_um": 0.2, "states": None}) == {"residual_um": 0.2}


def test_bad_files_of_states_are_one_line(tmp_path):
    (tmp_path / "states.ecsv").write_text("nothing\n")
    run = pachon.Configuration(active_optics={"states": "states.ecsv"})
    with pytest.raises(ConfigError, match=r"active_optics.states: .*states.ecsv: expected a table of states"):
        Experiment.from_config(run, tmp_path)
    QTable({"visit": [0], "M2_dw": [1.0]}).write(tmp_path / "states.ecsv", overwrite=True)
    with pytest.raises(UnknownNameError, match="M2_dw"):
        Experiment.from_config(run, tmp_path)


def test_a_telescope_without_errors_is_drawn():
    """Nothing is added, which has no logarithm: warnings are errors of tests."""
    quality = FieldMeans(wavefront=1.4e-7, added=0.0, fwhm=0.56, rms_g=0.005, size=0.13, rms_e=0.002)
    scene = SimpleNamespace(designed=quality, visits=(quality, quality), expected=np.zeros(2), floor=0.0)
    assert quality_picture(scene).startswith(b"\x89PNG")


def test_freedoms_without_effect_on_the_wavefront_need_a_tolerance(tmp_path):
    path = tmp_path / "hexapod.yaml"
    members = ("{name: M2_dz, unit: um, of: M2.dz}", "{name: M2_rz, unit: arcsec, of: M2.rz}")
    path.write_text("name: hexapod\ndegrees_of_freedom:\n" + "".join(f"  - {member}\n" for member in members))
    config = AlignConfig(degrees_of_freedom=str(path))
    with pytest.raises(ConfigError, match=r"errors\.tolerances: expected those of M2_rz, which change no wavefront"):
        _ = AlignmentScene.of(config).tolerances
    stated = config.model_copy(update={"errors": config.errors.model_copy(update={"tolerances": {"M2_rz": 100.0}})})
    sizes = AlignmentScene.of(stated).tolerances
    assert sizes[1] == 100.0
    assert 1.0 < sizes[0] < 10.0


@pytest.mark.slow
def test_the_command_shows_the_loop(traced_donuts, tmp_path, capsys):
    (tmp_path / "loop.yaml").write_text("air: {wavefront: false}\nvisits: 9\n")
    arguments = ["align", str(tmp_path / "loop.yaml"), "-n", "1", "-o", str(tmp_path / "out"), "--quiet", "--json"]
    assert main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["visits"] == 1
    assert main(arguments) == 2
    assert "go on with --resume" in capsys.readouterr().err
    assert main([*arguments, "--resume"]) == 0
    assert json.loads(capsys.readouterr().out)["visits"] == 1
    (tmp_path / "loop.yaml").write_text("donuts: {heights: flat}\n")
    assert main(arguments) == 2
    message = capsys.readouterr().err
    assert "donuts.heights" in message
    assert message.count("\n") == 1
    (tmp_path / "loop.yaml").write_text("telescope: hsc\n")
    assert main(arguments) == 2
    assert "telescope = hsc: expected a model with the LSST's camera" in capsys.readouterr().err
