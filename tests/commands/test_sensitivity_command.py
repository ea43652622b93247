"""``pachon sensitivity`` and ``pachon optimize``."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

import pachon
from pachon.commands.cli import main
from pachon.core.products import read_fits
from pachon.design.optimize.sensitivity import sensitivity

STOP_INSIDE = str(Path(__file__).parents[1] / "data" / "lensfiles" / "stop_inside.zmx")


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_the_matrix_is_printed_and_saved(tmp_path, capsys):
    chosen = ["--parameters", "M2.dz,M3.radius", "--field-deg", "0", "--field-deg", "0.3,0.2", "--zernikes", "11"]
    assert main(["sensitivity", "paul_baker", *chosen, "--json", "--picture", "matrix.png"]) == 0
    printed = json.loads(capsys.readouterr().out)
    expected = sensitivity(
        pachon.load_telescope("paul_baker"), ["M2.dz", "M3.radius"], np.deg2rad([[0, 0], [0.3, 0.2]]), n_zernike=11
    )
    # JSON has nine digits.
    assert np.allclose(printed["matrix_m_per_unit"], expected.matrix, rtol=1e-8, atol=1e-18)
    hdus = read_fits(tmp_path / "sensitivity_paul_baker.fits")
    assert np.array_equal(hdus["MATRIX"].data, expected.matrix)
    assert list(hdus["PARAMETERS"].data["ADDRESS"]) == ["M2.dz", "M3.radius"]
    assert np.allclose(hdus["FIELDS"].data["X"], [0.0, 0.3])
    assert (tmp_path / "matrix.png").stat().st_size > 1000


def test_tables(tmp_path, capsys):
    assert main(["sensitivity", "paul_baker", "--parameters", "M2.*,M1.a6,M2.curvature", "--out", "m.ecsv"]) == 0
    assert "M2.dz" in capsys.readouterr().out
    table = Table.read(tmp_path / "m.ecsv")
    assert len(table) == 31 * 28
    assert str(table["M1.a6"].unit) == "m6"
    assert str(table["M2.rx"].unit) == "m / rad"


def test_a_parameter_without_effect_has_no_largest_terms(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["sensitivity", "auxtel", "--parameters", "M3.dx,M2.dz", "--no-picture"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert next(row for row in rows if row[:1] == ["M3.dx"])[1:3] == ["-", "0"]
    assert next(row for row in rows if row[:1] == ["M2.dz"])[1] == "Z4,"


@pytest.mark.usefixtures("empty_pictures")
def test_optimize_writes_a_prescription(tmp_path, capsys):
    command = ["optimize", "paul_baker", "--variables", "M2.conic,Detector.dz", "--merit", "wavefront"]
    assert main([*command, "--bounds", "M2.conic=-0.7:-0.5", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["rms_end_m"] < 0.2 * printed["rms_start_m"]
    written = pachon.load_telescope(str(tmp_path / "optimized_paul_baker.yaml"))
    assert written.surface("M2").shape.conic == pytest.approx(printed["values"][0], rel=1e-8)
    assert main([*command, "--bounds", "Detector.dz_um=-1:1", "--json"]) == 0
    assert abs(json.loads(capsys.readouterr().out)["changes"][1]) <= 1e-6
    assert main([*command, "--focal-length", "33.6"]) == 0
    assert "rms of wavefront" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["sensitivity", "paul_baker", "--parameters", "M9.dz"], "M9"),
        (["sensitivity", "paul_baker", "--out", "matrix.txt"], ".fits or .ecsv"),
        (["sensitivity", "paul_baker", "--parameters", ","], "such as M2.dx,M1.radius"),
        (["optimize", "paul_baker", "--variables", "M2.rz"], "M2.rz has no effect"),
        (["optimize", "paul_baker", "--variables", "M2.dz", "--merit", "speed"], "speed"),
        (["optimize", "paul_baker", "--variables", "M2.dz", "--bounds", "M2.dz"], "ADDRESS=LOW:HIGH"),
        (["optimize", "paul_baker", "--variables", "M2.radius", "--bounds", "M2.radius=50:60"], "(50, 60) m: expected"),
        (["optimize", "paul_baker", "--variables", "M2.dz", "--bounds", "M2.dz_deg=0:1"], "M2.dz is in m, not in deg"),
    ],
)
def test_bad_input_is_one_line(command, words, capsys):
    assert main(command) == 2
    error = capsys.readouterr().err
    assert error.startswith("pachon: error: ")
    assert error.count("\n") == 1
    assert words in error


def test_what_cannot_be_written_is_refused_before_the_optimisation(tmp_path, capsys, monkeypatch):
    def never(*args, **options):
        raise AssertionError("computed before the output was checked")

    monkeypatch.setattr("pachon.design.optimize.optimize.optimize", never)
    lens = pachon.load_telescope("paul_baker")
    pachon.save_telescope(lens, tmp_path / "other.yaml")
    (tmp_path / "two.yaml").write_text("variables: [M2.conic]\nconfigurations: [{telescope: other.yaml}]\n")
    first, third = (lens.surface(name).shape.parameters.get("conic", 0.0) for name in ("M1", "M3"))
    follower = pachon.models.Pickup("M3", "conic", "M1", 1.0, third - first)
    pachon.save_telescope(lens.with_design(pickups=(follower,)), tmp_path / "linked.yaml")
    linked = [str(tmp_path / "linked.yaml"), "--variables", "M2.conic"]
    for given, words in (
        (["paul_baker", "--config", "two.yaml", "--out", "one.yaml"], "none with several configurations"),
        ([*linked, "--out", "better.zmx"], "pickup M3.conic: a Zemax file has no place for it"),
        ([*linked, "--out", "better.foo"], "expected a name that ends in"),
    ):
        assert main(["optimize", *given]) == 2
        assert words in capsys.readouterr().err


@pytest.mark.slow
def test_a_stop_inside_is_filled_and_it_is_said(capsys):
    """What `optimize` reports is what `spots --aiming real` finds; a lens that got worse is not called better."""
    command = ["optimize", STOP_INSIDE, "--variables", "S6.thickness", "--out", "moved.zmx"]
    assert main([*command, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["rays_fill"] == ["S4"]
    assert main(["spots", "moved.zmx", "--aiming", "real", "--json"]) == 0
    radii = np.array(json.loads(capsys.readouterr().out)["rms_radius_um"])
    assert found["rms_end_m"] == pytest.approx(1e-6 * np.sqrt(np.mean(radii**2)), rel=1e-6)
    assert main([*command[:3], "S1.radius", *command[4:], "--focal-length", "0.07"]) == 0
    said = capsys.readouterr().out
    assert "rays fill the stop S4, as with --aiming real; without: " in said
    assert re.search(r"^not better than the start: spots of [\d.]+ -> [\d.]+ µm$", said, re.M)
    assert main(["sensitivity", STOP_INSIDE, "--parameters", "S2.thickness", "--zernikes", "8"]) == 0
    assert "rays fill the stop S4, as with --aiming real" in capsys.readouterr().out


@pytest.mark.long
@pytest.mark.usefixtures("empty_pictures")
def test_an_operand_that_is_not_held_is_said(tmp_path, capsys):
    lens = pachon.load_telescope("paul_baker")
    least = 1e3 * pachon.design.TotalLength(minimum=0.0).measure(lens) + 10.0
    (tmp_path / "opt.yaml").write_text(
        f"variables: [Detector.dz]\nbounds: {{Detector.dz_mm: [-1, 1]}}\nfields_deg: [[0, 0]]\nn_pupil: 2\n"
        f"operands: [{{kind: total_length_mm, min: {least!r}}}]\n"
    )
    command = ["optimize", "paul_baker", "--config", str(tmp_path / "opt.yaml")]
    assert main(command) == 0
    said = capsys.readouterr().out
    # The detector goes to a bound, one millimetre nearer.
    assert re.search(r"^total_length: .* \(>= [\d.]+\): not held, off by -0\.009 m$", said, re.M)
    assert main([*command, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["operands_not_held"] == ["total_length"]
    assert not found["operands"][0]["holds"]
