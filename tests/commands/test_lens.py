"""``pachon convert``, and lens files of other programs on the command line."""

from pathlib import Path

import pytest

from pachon.commands.cli import main
from pachon.models.io.prescription import load_telescope

DATA = Path(__file__).parents[1] / "data" / "zmx"


def test_a_zemax_file_becomes_ours_and_back(tmp_path, capsys):
    ours, theirs = tmp_path / "lens.yaml", tmp_path / "again.zmx"
    assert main(["convert", str(DATA / "HoO-V2C18Ex46.zmx"), str(ours)]) == 0
    assert capsys.readouterr().out.startswith("HoO-V2C18Ex46: 6 surfaces written")
    assert load_telescope(ours) == load_telescope(DATA / "HoO-V2C18Ex46.zmx")
    assert main(["convert", str(ours), str(theirs)]) == 0
    assert load_telescope(theirs).surface_names == load_telescope(ours).surface_names


def test_a_telescope_becomes_a_file_of_batoid_and_back(tmp_path, capsys):
    theirs, ours = tmp_path / "theirs.yaml", tmp_path / "ours.yaml"
    assert main(["convert", "auxtel", str(theirs), "--format", "batoid"]) == 0
    assert theirs.read_text(encoding="utf-8").startswith("opticalSystem:\n  type: CompoundOptic\n  name: auxtel\n")
    assert main(["convert", str(theirs), str(ours)]) == 0
    assert load_telescope(ours).surface_names == load_telescope("auxtel").surface_names
    assert main(["convert", "auxtel", str(theirs), "--format", "oslo"]) == 2
    assert "format = 'oslo': expected one of pachon, batoid, zemax" in capsys.readouterr().err


def test_lenient_prints_a_line_for_each_thing_left_out(tmp_path, capsys):
    text = (DATA / "lens1.zmx").read_text(encoding="utf-8").replace("  STOP\n", "  STOP\n  NEWK 3\n  ELAP 1 2\n")
    lens = tmp_path / "lens.zmx"
    lens.write_text(text, encoding="utf-8")
    assert main(["convert", str(lens), str(tmp_path / "lens.yaml")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("pachon: error: ")
    assert error.count("\n") == 1
    assert main(["convert", str(lens), str(tmp_path / "lens.yaml"), "--lenient"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert [line.startswith(f"pachon: warning: {lens}, line ") for line in lines] == [True, True]
    assert main(["info", str(lens), "--lenient", "--json"]) == 0


def test_glass_catalogues_are_looked_at_first(tmp_path):
    lens = tmp_path / "lens.zmx"
    text = (DATA / "lens1.zmx").read_text(encoding="utf-8")
    lens.write_text(text.replace("N-SK16 1 0", "N-MINE 0 0"), encoding="utf-8")
    catalogue = tmp_path / "own.agf"
    catalogue.write_text("NM N-MINE 1 0 1.6 60\nCD 2.56\nLD 0.4 1.0\n", encoding="utf-8")
    out = tmp_path / "lens.yaml"
    assert main(["convert", str(lens), str(out)]) == 2
    assert main(["convert", str(lens), str(out), "--glass-catalogue", str(catalogue)]) == 0
    assert float(load_telescope(out).surface("S1").medium_after.index(6e-7)) == pytest.approx(1.6, rel=1e-15)


@pytest.mark.parametrize("path", sorted(DATA.glob("*.zmx")), ids=lambda p: p.stem)
def test_info_describes_every_file(path, capsys):
    assert main(["info", str(path)]) == 0
    assert path.name in capsys.readouterr().out
