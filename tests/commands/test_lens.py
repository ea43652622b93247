"""``pachon convert``, and lens files of other programs on the command line."""

from pathlib import Path

import pytest

from pachon.commands.cli import main
from pachon.models.io.prescription import load_telescope

DATA = Path(__file__).parents[1] / "data" / "zmx"
LENSES = DATA.parent / "lensfiles"


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
    assert main(["convert", "auxtel", str(theirs), "--format", "mine"]) == 2
    assert "format = 'mine': expected one of pachon, batoid, zemax" in capsys.readouterr().err


def test_lenient_prints_a_line_for_each_thing_left_out(tmp_path, capsys):
    text = (DATA / "lens1.zmx").read_text(encoding="utf-8").replace("  STOP\n", "  STOP\n  NEWK 3\n  USAP 1 2\n")
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


def test_a_lens_of_oslo_becomes_one_of_optiland_and_of_zemax(tmp_path, capsys):
    lens = tmp_path / "lens.len"
    lens.write_text(
        'LEN NEW "singlet" 100 2\nEBR 5\nANG 1\nTH 1e20\nNXT\nGLA N-BK7\nRD 50\nTH 3\nNXT\nPY 0\nNXT\nEND 3\n',
        encoding="utf-8",
    )
    for name in ("lens.json", "lens.zmx"):
        assert main(["convert", str(lens), str(tmp_path / name)]) == 0
        again, first = load_telescope(tmp_path / name), load_telescope(lens)
        assert capsys.readouterr().out.startswith("lens: 3 surfaces written")
        assert [s.vertex[2] for s in again.surfaces] == pytest.approx([s.vertex[2] for s in first.surfaces], abs=1e-16)
    # Back focus of a plano-convex lens: R / (n - 1) - t / n.
    n = float(first.surfaces[0].medium_after.index(587.56e-9))
    assert first.surfaces[-1].vertex[2] == pytest.approx(-(3e-3 + 0.05 / (n - 1) - 3e-3 / n), rel=1e-12)


@pytest.mark.parametrize("path", sorted([*DATA.glob("*.zmx"), *LENSES.glob("[!r]*.[jr]*")]), ids=lambda p: p.name)
def test_info_describes_every_file(path, capsys):
    assert main(["info", str(path)]) == 0
    assert path.name in capsys.readouterr().out
