"""``pachon config`` and ``--set``: keys are explained, mistyped ones have a hint, values are checked as in a file."""

import json

import pytest

from pachon.commands import config_kinds, stored_names
from pachon.commands.cli import main
from pachon.commands.config import example, keys_of, unit_of
from pachon.core.errors import ConfigError, UnknownNameError
from pachon.core.set_keys import with_set_keys
from pachon.pipeline.config import Configuration


@pytest.mark.long
def test_stored_names_are_those_of_the_modules():
    assert stored_names.stored_names() == stored_names.current_names()


@pytest.mark.long
@pytest.mark.parametrize("kind", config_kinds.KINDS)
def test_every_key_has_a_type_a_meaning_and_a_unit(kind):
    _, keys = keys_of(kind)
    assert len(keys) > 5
    for key in keys:
        assert key.type
        assert key.description
        if key.key.rpartition("_")[2] in ("deg", "arcsec", "um", "nm", "mm", "urad", "mas", "s"):
            assert unit_of(key)


@pytest.mark.long
@pytest.mark.parametrize("kind", sorted({*config_kinds.KINDS} - {"optimization"}))
def test_examples_are_accepted(kind):
    """All can be copied, but for the keys of a visit, which a list gives together."""
    config = config_kinds.model_of(kind)()
    texts = [text for key in keys_of(kind)[1] if (text := example(key)) is not None]
    assert len(texts) > 5
    for text in texts:
        if not text.removeprefix("run.").startswith("visit."):
            with_set_keys(config, [text])


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("psf.engin", "did you mean run.psf.engine?"),
        ("run.psf.engin", "did you mean run.psf.engine?"),
        ("atmospere", "did you mean run.atmosphere?"),
        ("contrl.gain", "did you mean align.control.gain?"),
        ("fwhm", "did you mean run.reconstruction.weight_fwhm_arcsec?"),
        ("sweep.design.point", "did you mean sweep.design.points?"),
        ("run.xyz", "expected a key of run, which pachon config run lists, or one of run, images"),
    ],
)
def test_a_mistyped_key_has_a_hint(text, hint, capsys):
    with pytest.raises(UnknownNameError) as caught:
        keys_of(text)
    assert hint in str(caught.value)
    assert main(["config", text]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert hint in error


def test_a_key_is_explained(capsys):
    assert main(["config", "atmosphere.exposure_s"]) == 0
    out = capsys.readouterr().out
    for words in ("run.atmosphere.exposure_s", "number above 0", "unit", "15", "run, attribute", "--set atmosphere."):
        assert words in out
    assert main(["config", "psf.engine", "--json"]) == 0
    (key,) = json.loads(capsys.readouterr().out)["keys"]
    assert key["choices"] == ["fast", "wave", "long_exposure"] or set(key["choices"]) >= {"fast", "wave"}
    assert key["default"] in key["choices"]


def test_keys_are_written_as_a_table(in_folder, capsys):
    assert main(["config", "run", "--table", "keys.csv"]) == 0
    assert capsys.readouterr().out
    lines = (in_folder / "keys.csv").read_text().splitlines()
    assert lines[0] == "key,default,values,meaning"
    assert len(lines) == len(keys_of("run")[1]) + 1


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("seed", ["--set 'seed'", "expected KEY=VALUE"]),
        ("stars.trth=50", ["stars.trth", "did you mean truth"]),
        ("psf.engine=fats", ["--set", 'psf.engine = "fats"', "did you mean fast?"]),
        ("seed=[1", ["--set 'seed=[1'", "not valid YAML"]),
        ("seed.deep=1", ["seed = ", "has no keys"]),
    ],
)
@pytest.mark.parametrize("command", ["run", "attribute", "study", "shim"])
def test_a_wrong_setting_is_one_line(command, text, parts, in_folder, capsys):
    assert main([command, "--set", text]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    for part in parts:
        assert part in error
    assert list(in_folder.iterdir()) == []


@pytest.mark.parametrize("stated", ["file", "--set"])
@pytest.mark.parametrize(("command", "function"), [("shim", "shimming.shim.shim"), ("study", "psf_choice.study.study")])
def test_ccds_of_the_configuration_are_used(command, function, stated, in_folder, monkeypatch):
    """Not all CCDs, or the nine of a study, in their place."""
    used_ccds = []

    def record(first, *_, **__):
        used_ccds.append(getattr(first, "config", first).ccds)
        raise ConfigError("seen")

    monkeypatch.setattr(f"pachon.studies.{function}", record)
    (in_folder / "run.yaml").write_text("ccds: [R01_S02, R22_S11]\n")
    assert main([command, *(["run.yaml"] if stated == "file" else ["--set", "ccds=[R01_S02, R22_S11]"])]) == 2
    assert main([command, "run.yaml", "--ccds", "R22_S00"]) == 2
    assert used_ccds == [("R01_S02", "R22_S11"), ("R22_S00",)]


def test_settings_are_those_of_a_file(in_folder):
    texts = ["stars.truth=50", "focal_plane.moved.R22.dz_um=5", "changes={M2.dz_um: 3}", "changes.M1.Z5_nm=20"]
    settings = with_set_keys(Configuration(), texts)
    assert settings.stars.truth == 50
    assert settings.focal_plane.moved["R22"].dz_um == 5
    assert dict(settings.changes) == {"M2.dz_um": 3, "M1.Z5_nm": 20}


@pytest.mark.parametrize("name", ["hsc", "lsstcam"])
def test_a_camera_has_no_keys(name, in_folder, capsys):
    assert main(["camera", name, "--set", "seed=3"]) == 2
    assert f"--set: expected a configuration in place of {name}" in capsys.readouterr().err


def test_kind_and_key_may_be_two_words(capsys):
    explanations = []
    for words in (["run.focal_plane.budget"], ["run", "focal_plane.budget"]):
        assert main(["config", *words]) == 0
        explanations.append(capsys.readouterr().out)
    assert explanations[0] == explanations[1]
    assert "focal_plane" in explanations[0]
