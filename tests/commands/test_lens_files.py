"""Lens files on the command line: their own fields, wavelengths and units, ray aiming, glasses, lost fields."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pachon.commands.cli import main
from pachon.design.layout.layout import layout
from pachon.design.metrics.spots import spots
from pachon.models.io.prescription import load_telescope, save_telescope
from pachon.models.shapes.shape import Plane
from pachon.models.surface import Interaction

DATA = Path(__file__).parents[1] / "data" / "zmx"
WIDE, LENS, FINITE = (
    str(DATA / f"{name}.zmx") for name in ("circular_aperture_example_with_aperture", "lens1", "US05831776-1")
)
FEW = ["--sampling", "rings", "--rays", "3"]


@pytest.fixture(autouse=True)
def without_pictures(monkeypatch):
    """Pictures are not what these tests are about, and drawing them takes longer than all else."""
    monkeypatch.setattr("pachon.core.plotting.picture_bytes", lambda figure, kind: b"")


def metrics(capsys, *arguments):
    assert main([*arguments, "--json", "--picture", "picture.png"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.long
def test_a_wide_angle_lens_has_all_its_fields(in_folder, capsys):
    found = metrics(capsys, "spots", WIDE, *FEW)
    assert np.array(found["field_deg"]) == pytest.approx(np.array([[0, 0], [0, 35], [0, 50]]), abs=1e-12)
    assert np.isfinite(found["rms_radius_um"]).all()
    # Without aiming no light of the last field passes, and that is said.
    assert main(["spots", WIDE, *FEW, "--aiming", "off", "--picture", "picture.png"]) == 2
    assert "field = (0, 50) deg: the chief ray does not reach the detector" in capsys.readouterr().err


@pytest.mark.long
def test_fields_and_wavelengths_are_those_of_the_file_or_of_the_options(in_folder, capsys):
    own = metrics(capsys, "spots", LENS, *FEW)
    assert own["wavelength_nm"] == pytest.approx([486.1327, 587.5618, 656.2725], rel=1e-8)
    given = metrics(capsys, "spots", LENS, *FEW, "--field-deg", "5", "--wavelength-nm", "600")
    assert (given["field_deg"], given["wavelength_nm"]) == ([[0.0, 5.0]], [600.0])
    # A function of one wavelength has the primary one.
    found = metrics(capsys, "opd", LENS, "--grid", "16")
    assert (found["field_deg"], found["wavelength_nm"]) == ([0.0, 0.0], pytest.approx(587.5618, rel=1e-8))


@pytest.mark.long
def test_objects_at_a_finite_distance_are_in_millimetres(in_folder, capsys):
    found = spots(load_telescope(FINITE), sampling="rings", n_pupil=3).summary()
    # 4 to 1: the file's image heights are 0, 8 and 12 mm.
    assert np.array(found["object_mm"])[:, 1] == pytest.approx([0.0, -32.0, -48.0], abs=0.02)
    assert not any("arcsec" in key for key in found)
    assert main(["rays", FINITE, "--picture", "picture.png"]) == 0
    out = capsys.readouterr().out
    assert "object [mm]" in out
    assert "arcsec" not in out
    assert main(["throughput", FINITE, "--picture", "picture.png"]) == 0
    assert capsys.readouterr().out.count(" mm ") >= 3


def test_aiming_is_checked(capsys, in_folder):
    assert main(["spots", LENS, "--aiming", "always"]) == 2
    assert "aiming = 'always': expected one of off, paraxial, real" in capsys.readouterr().err
    assert main(["spots", "paul_baker", "--aiming", "real"]) == 2
    assert "aiming = 'real': expected a surface that is the stop" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize("command", ["spots", "info"])
def test_catalogues_and_lenience_wherever_a_model_is_opened(in_folder, capsys, command):
    text = Path(LENS).read_text(encoding="utf-8")
    lens, catalogue = in_folder / "lens.zmx", in_folder / "mine.agf"
    lens.write_text(
        text.replace("N-SK16 1 0", "N-MINE 0 0").replace("  STOP\n", "  STOP\n  NEWK 3\n"), encoding="utf-8"
    )
    catalogue.write_text("NM N-MINE 1 0 1.6 60\nCD 2.56\nLD 0.4 1.0\n", encoding="utf-8")
    options = [] if command == "info" else [*FEW, "--picture", "picture.png"]
    assert main([command, str(lens), *options, "--glass-catalogue", str(catalogue)]) == 2
    assert "NEWK" in capsys.readouterr().err
    assert main([command, str(lens), *options, "--lenient", "--glass-catalogue", str(catalogue)]) == 0
    warnings = capsys.readouterr().err
    assert "NEWK" in warnings
    assert "N-MINE" not in warnings


@pytest.mark.long
def test_draw_says_which_fields_are_lost(in_folder, capsys):
    assert layout(load_telescope(WIDE)).dark == []
    assert main(["draw", WIDE, "--picture", "picture.svg", "--aiming", "off"]) == 0
    out = capsys.readouterr().out
    assert "field = (0, 50) deg: no ray arrives, so none is drawn" in out
    assert "--aiming paraxial" in out


def test_info_is_in_the_unit_of_the_file(tmp_path, capsys):
    assert main(["info", LENS]) == 0
    out = capsys.readouterr().out
    row = next(line.split() for line in out.splitlines() if line.startswith("S1 "))
    # Radius, thickness, glass and index; the glass is the file's.
    assert row[:5] == ["S1", "refract", "-12.43979", "5.514017", "N-SK16"]
    assert "radius [mm]" in out
    assert "focal length         25 mm" in out
    assert "0, 0°; 0, 8.48528°; 0, 12°" in out
    assert main(["info", FINITE]) == 0
    out = capsys.readouterr().out
    assert "real image height  0, 0 mm; 0, 8 mm; 0, 12 mm" in out
    # A semi-diameter that stops no light stands in brackets; one that is automatic follows the light.
    assert not next(line.split() for line in out.splitlines() if line.startswith("S39 "))[-1].endswith(")")
    fixed = tmp_path / "fixed.zmx"
    fixed.write_text(Path(FINITE).read_text(encoding="utf-8").replace("E+1 0 0 0 1", "E+1 1 0 0 1"), encoding="utf-8")
    assert main(["info", str(fixed)]) == 0
    out = capsys.readouterr().out
    assert next(line.split() for line in out.splitlines() if line.startswith("S39 "))[-1] == "(77.2242)"
    assert "it stops no light" in out


def test_info_cuts_no_column(in_folder, capsys):
    save_telescope(load_telescope(LENS), "long.yaml")
    text = (in_folder / "long.yaml").read_text(encoding="utf-8").replace("S1", "a_very_long_name_" * 8)
    (in_folder / "long.yaml").write_text(text, encoding="utf-8")
    assert main(["info", "long.yaml"]) == 0
    out = capsys.readouterr().out
    assert "…" not in out
    assert "a_very_long_name_" * 8 in out
    assert "N-SK16" in out


def test_a_name_that_cannot_be_read_is_not_written(in_folder, capsys):
    assert main(["convert", LENS, "lens.foo"]) == 2
    endings = ".yaml, .yml, .zmx, .seq, .len, .json, .roa"
    assert capsys.readouterr().err == f"pachon: error: lens.foo: expected a name that ends in {endings}\n"
    assert not (in_folder / "lens.foo").exists()


@pytest.mark.long
def test_a_long_table_of_ghosts_says_what_it_leaves_out(in_folder, capsys):
    options = ["--rays", "400", "--field-deg", "1", "--picture", "picture.png"]
    assert main(["ghosts", LENS, *options]) == 0
    out = capsys.readouterr().out
    rows = [line for line in out.splitlines() if line.startswith(("S", "Image")) and "e-" in line]
    assert len(rows) == 20
    # Six lens surfaces and the detector: 21 pairs.
    assert "Shown are the first 20, 1 more follow them: --json has all." in " ".join(out.split())


@pytest.mark.long
def test_the_lenses_of_a_file_are_its_bodies(in_folder, capsys):
    found = metrics(capsys, "sensitivity", LENS, "--zernikes", "6", "--field-deg", "0", "--out", "m.fits")
    assert {name.split(".")[0] for name in found["parameters"]} == {"L1", "L2", "L3"}


def test_a_stop_beside_the_light_and_a_missing_detector_are_said(in_folder, capsys):
    """Coordinate breaks about a stop move it from the entrance pupil; without ray aiming no light passes it."""
    telescope = load_telescope("paul_baker")
    first, *others = telescope.surfaces
    stop = replace(first, name="stop", interaction=Interaction.PASS, shape=Plane(), vertex=(0.0, 12.5, 30.0))
    aside = replace(telescope, name="aside", surfaces=(stop, first, *others)).with_design(stop="stop")
    save_telescope(aside, "aside.yaml")
    assert main(["spots", "aside.yaml", *FEW, "--picture", "picture.png"]) == 0
    assert "the stop stop lies 12.5 m in y beside the entrance pupil that rays fill" in capsys.readouterr().err
    save_telescope(replace(telescope, name="blind", surfaces=telescope.surfaces[:-1]), "blind.yaml")
    assert main(["spots", "blind.yaml", *FEW, "--field-deg", "0", "--picture", "picture.png"]) == 0
    assert capsys.readouterr().err == (
        "pachon: warning: blind: the last surface, M3, is no detector: light is measured on it\n"
    )
