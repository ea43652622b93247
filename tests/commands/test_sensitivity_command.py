"""``pachon sensitivity`` and ``pachon optimize``."""

import json

import numpy as np
import pytest
from astropy.table import Table

import pachon
from pachon.commands.cli import main
from pachon.core.products import read_fits
from pachon.design.optimize.sensitivity import sensitivity


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_the_matrix_is_printed_and_saved(tmp_path, capsys):
    chosen = ["--parameters", "M2.dz,M3.radius", "--field-deg", "0", "--field-deg", "0.3,0.2", "--zernikes", "11"]
    assert main(["sensitivity", "paul_baker", *chosen, "--json"]) == 0
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
    assert (tmp_path / "sensitivity_paul_baker.png").stat().st_size > 1000


def test_tables(tmp_path, capsys):
    assert main(["sensitivity", "paul_baker", "--parameters", "M2.*,M1.a6,M2.curvature", "--out", "m.ecsv"]) == 0
    assert "M2.dz" in capsys.readouterr().out
    table = Table.read(tmp_path / "m.ecsv")
    assert len(table) == 31 * 28
    assert str(table["M1.a6"].unit) == "m6"
    assert str(table["M2.rx"].unit) == "m / rad"


def test_optimize_writes_a_prescription(tmp_path, capsys):
    command = ["optimize", "paul_baker", "--variables", "M2.conic,Detector.dz", "--merit", "wavefront"]
    assert main([*command, "--bounds", "M2.conic=-0.7:-0.5", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["rms_end_m"] < 0.2 * printed["rms_start_m"]
    written = pachon.load_telescope(str(tmp_path / "optimized_paul_baker.yaml"))
    assert written.surface("M2").shape.conic == pytest.approx(printed["values"][0], rel=1e-8)
    assert main([*command, "--focal-length", "33.6"]) == 0
    assert "rms of wavefront" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["sensitivity", "paul_baker", "--parameters", "M9.dz"], "M9"),
        (["sensitivity", "paul_baker", "--out", "matrix.txt"], ".fits or .ecsv"),
        (["optimize", "paul_baker", "--variables", "M2.rz"], "M2.rz has no effect"),
        (["optimize", "paul_baker", "--variables", "M2.dz", "--merit", "speed"], "speed"),
        (["optimize", "paul_baker", "--variables", "M2.dz", "--bounds", "M2.dz"], "ADDRESS=LOW:HIGH"),
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
    follower = pachon.Pickup("M3", "conic", "M1", 1.0, third - first)
    pachon.save_telescope(lens.with_design(pickups=(follower,)), tmp_path / "linked.yaml")
    linked = [str(tmp_path / "linked.yaml"), "--variables", "M2.conic"]
    for given, words in (
        (["paul_baker", "--config", "two.yaml", "--out", "one.yaml"], "none with several configurations"),
        ([*linked, "--out", "better.zmx"], "pickup M3.conic: a Zemax file has no place for it"),
        ([*linked, "--out", "better.foo"], "expected a name that ends in"),
    ):
        assert main(["optimize", *given]) == 2
        assert words in capsys.readouterr().err
