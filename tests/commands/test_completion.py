"""Values that shells complete: models, CCDs, surfaces, kinds, figures, metrics, sites, bands, configuration keys."""

import os
import subprocess
import sys

import pytest
import typer

from pachon.commands import cli
from pachon.models.camera.cameras import load_camera
from pachon.models.io.bundled import BUNDLED

ROOT = typer.main.get_command(cli.app)
#: Parameters with values of their own, and the number of these: fewer would be a loss.
PARAMETERS, VALUES = 160, 4600


def command_of(path):
    command = ROOT
    for name in path.split():
        command = command.commands[name]
    return command


def completed(path, name, typed="", **values):
    """Values that a shell offers for an option, or an argument by its name, behind other values."""
    command = command_of(path)
    context = command.make_context(command.name, [], resilient_parsing=True)
    context.params |= values
    parameter = next(p for p in command.params if name in (*p.opts, p.name))
    return [item.value for item in parameter.shell_complete(context, typed)]


@pytest.mark.parametrize(
    ("path", "name", "typed", "values"),
    [
        ("spots", "model", "paul", ["paul_baker"]),
        ("donuts", "--telescope", "hs", ["hsc"]),
        ("run", "--ccds", "R22_S1", ["R22_S10", "R22_S11", "R22_S12"]),
        ("run", "--ccds", "R22_S10,R22_S1", ["R22_S10,R22_S11", "R22_S10,R22_S12"]),
        ("run", "--raft", "R2", ["R20", "R21", "R22", "R23", "R24"]),
        ("visits", "--band", "r,", ["r,u", "r,g", "r,i", "r,z", "r,y"]),
        ("new", "kind", "s", ["schmidt", "singlet"]),
        ("schema", "kind", "site", ["site"]),
        ("reproduce", "figures", "fig1", ["fig1", *(f"fig{k}" for k in range(10, 19))]),
        ("donuts", "--site", "mauna", ["maunakea"]),
        ("donuts", "--convention", "", ["pachon", "ts_wep", "donut"]),
        ("donuts", "--perturb", "M2.d", ["M2.dx=", "M2.dy=", "M2.dz="]),
        ("baseline save", "--limit", "e", ["ee80"]),
        ("attribute", "--causes", "ccd,ti", ["ccd,tilt"]),
        ("operands", "--operand", "EFF", ["EFFL"]),
        ("run", "--set", "psf.engine=", [f"psf.engine={w}" for w in ("fast", "wave", "long_exposure", "statistical")]),
        ("run", "--set", "psf.stamp", ["psf.stamp="]),
        ("config", "words", "align.control.g", ["align.control.gain"]),
        ("sweep run", "--example", "", ["table1", "table1_small"]),
        ("camera", "heights", "com", ["comcam"]),
        ("spots", "--sampling", "s", ["spiral", "square"]),
        ("convert", "--format", "o", ["oslo", "optiland"]),
    ],
)
def test_values_are_completed(path, name, typed, values, in_folder):
    assert completed(path, name, typed) == values


def test_names_are_those_of_the_telescope_or_configuration_typed_before(in_folder):
    assert completed("footprint", "--surface", "M", model="lsst_v3.3_r") == ["M1", "M2", "M3"]
    assert completed("optimize", "--variables", "M2.d", model="lsst_v3.3_r") == ["M2.dx", "M2.dy", "M2.dz"]
    assert completed("ghosts", "--reflectivity", "L1", model="lsst_v3.3_r") == ["L1_entrance=", "L1_exit="]
    (in_folder / "mine.yaml").write_text("telescope: hsc\n")
    names = load_camera("hsc").ccd_names
    assert set(names) <= set(completed("run", "--ccds", config="mine.yaml"))
    assert completed("run", "config") == ["mine.yaml"]
    assert set(completed("info", "model")) == {*BUNDLED, "mine.yaml"}


def test_what_cannot_be_read_completes_nothing(in_folder, capsys):
    (in_folder / "bad.yaml").write_text("telescope: [\n")
    assert completed("run", "--ccds", config="bad.yaml") == []
    assert completed("footprint", "--surface", model="none.zmx") == []
    assert completed("footprint", "--surface") == []
    assert capsys.readouterr() == ("", "")


@pytest.mark.long
def test_many_parameters_have_values(in_folder):
    counts = []
    for path in typer_leaves(ROOT):
        command = command_of(path)
        counts += [len(completed(path, p.name, model="lsst_v3.3_r")) for p in command.params]
    assert sum(count > 0 for count in counts) >= PARAMETERS
    assert sum(counts) >= VALUES


def typer_leaves(command, path=()):
    for name, inner in getattr(command, "commands", {}).items():
        yield from typer_leaves(inner, (*path, name))
    if not hasattr(command, "commands"):
        yield " ".join(path)


@pytest.mark.long
@pytest.mark.parametrize(
    ("typed", "values"),
    [("pachon info paul", ["paul_baker"]), ("pachon spots paul_baker --surf", []), ("pachon run --ra", ["--raft"])],
)
def test_shells_get_them(typed, values, tmp_path):
    environment = os.environ | {"_PACHON_COMPLETE": "complete_bash", "COMP_WORDS": typed}
    environment |= {"COMP_CWORD": str(typed.count(" ")), "PYTHONPATH": os.getcwd()}
    command = [sys.executable, "-m", "pachon"]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.split() == values
    assert done.stderr == ""
