"""Pickups and solves in files: read, written back, refused where the file has another value."""

from pathlib import Path

import pytest

import pachon
from pachon.core.errors import PrescriptionError, PrescriptionWarning

LENS = Path(__file__).parents[2] / "data" / "zmx" / "lens1.zmx"
#: Two equal lenses back to back, as Zemax writes pickups of radius, thickness and glass, and a paraxial back focus.
SYMMETRIC = """\
VERS 140124 258 36214
MODE SEQ
UNIT MM X W X CM MR CPMM
ENPD 10
FTYP 0 0 1 1 0 0 0
XFLN 0
YFLN 0
WAVM 1 0.5875618 1
PWAV 1
SURF 0
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ INFINITY
SURF 1
  STOP
  TYPE STANDARD
  CURV 1.0E-2 0 0 0 0 ""
  DISZ 4
  GLAS N-BK7 0 0 1.5 40 0 0 0 0 0 0
SURF 2
  TYPE STANDARD
  CURV -2.0E-3 0 0 0 0 ""
  DISZ 2
SURF 3
  TYPE STANDARD
  CURV 2.0E-3 4 2 -1. 0 ""
  DISZ 4
  PZUP 1 1 0 0
  GLAS N-BK7 2 1 1.5 40 0 0 0 0 0 0
SURF 4
  TYPE STANDARD
  CURV -2.0E-2 4 1 -2.0 0 ""
  DISZ 50
  MAZH 0 0
SURF 5
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ 0
"""
PICKUPS = (
    pachon.models.Pickup("S3", "radius", "S2", -1.0),
    pachon.models.Pickup("S3", "thickness", "S1"),
    pachon.models.Pickup("S3", "glass", "S1"),
    # The factor is one of the curvature, so half of it one of the radius.
    pachon.models.Pickup("S4", "radius", "S1", -0.5),
)


def loaded(folder, text):
    (folder / "lens.zmx").write_text(text)
    return pachon.load_telescope(folder / "lens.zmx")


def test_pickups_and_solves_of_zemax_live_on(tmp_path):
    lens = loaded(tmp_path, SYMMETRIC)
    assert lens.design_data.pickups == PICKUPS
    assert lens.design_data.solves == (pachon.models.Solve("S4", "marginal_height"),)
    changed = pachon.models.apply_changes(lens, {"S1.radius_mm": 1.0, "S1.thickness_mm": 0.5})
    assert changed.surface("S4").shape.radius == pytest.approx(-0.5 * changed.surface("S1").shape.radius, rel=1e-14)
    assert changed.surfaces[-1].vertex[2] == pytest.approx(pachon.first_order(changed).focus_z, abs=1e-15)
    # The same lens with the linked values typed by hand.
    focus = -changed.surfaces[-1].vertex[2] * 1e3 - 11.0
    by_hand = (
        SYMMETRIC.replace("CURV 1.0E-2", f"CURV {1 / 99!r}")
        .replace("CURV -2.0E-2", f"CURV {-2 / 99!r}")
        .replace("DISZ 4\n", "DISZ 4.5\n")
        .replace("DISZ 50", f"DISZ {focus!r}")
    )
    typed = loaded(tmp_path, by_hand)
    for one, other in zip(changed.surfaces, typed.surfaces, strict=True):
        assert one.vertex == pytest.approx(other.vertex, abs=1e-15)
        assert one.shape.curvature == pytest.approx(other.shape.curvature, rel=1e-14)


@pytest.mark.parametrize("name", ["again.zmx", "again.yaml"])
def test_they_are_written_back(tmp_path, name):
    lens = loaded(tmp_path, SYMMETRIC)
    # A radius with a factor has no place in a Zemax file that every program would read alike.
    kept = PICKUPS if name.endswith("yaml") else PICKUPS[:3]
    offset = pachon.models.Pickup("S3", "thickness", "S1", 2.0, -4e-3)
    lens = lens.with_design(pickups=(PICKUPS[0], offset, *PICKUPS[2:]))
    if name.endswith("yaml"):
        pachon.save_telescope(lens, tmp_path / name)
    else:
        with pytest.raises(PrescriptionError, match=r"lens: pickup S4.radius: a Zemax file has no place for it$"):
            pachon.save_telescope(lens, tmp_path / name)
        assert not (tmp_path / name).exists()
        with pytest.warns(PrescriptionWarning, match=r"pickup S4.radius: a Zemax file has no place for it; left out"):
            pachon.save_telescope(lens, tmp_path / name, lenient=True)
    again = pachon.load_telescope(tmp_path / name).design_data
    assert set(again.pickups) == {offset, *kept} - {PICKUPS[1]}
    assert again.solves == lens.design_data.solves


def test_all_kinds_in_yaml_with_units(tmp_path):
    lens = pachon.load_telescope(LENS)
    solves = (
        pachon.models.Solve("S1", "edge_thickness", 1e-3, radius=4e-3),
        pachon.models.Solve("S7", "chief_height", 4e-3),
    )
    lens = lens.with_design(pickups=(pachon.models.Pickup("S6", "conic", "S1", -1.0, 0.0),), solves=solves)
    pachon.save_telescope(lens, tmp_path / "lens.yaml")
    assert pachon.load_telescope(tmp_path / "lens.yaml").design_data == lens.design_data


def test_what_is_not_met_is_said(tmp_path):
    with pytest.warns(PrescriptionWarning, match=r"surface 3: pickup S3.radius: the file has another value"):
        lens = loaded(tmp_path, SYMMETRIC.replace("CURV 2.0E-3 4", "CURV 2.1E-3 4"))
    assert [p.address for p in lens.design_data.pickups] == [p.address for p in PICKUPS[1:]]
    wrong = lens.with_design(pickups=(PICKUPS[0],))
    with pytest.raises(PrescriptionError, match=r"pickup S3.radius: expected -0.5, not -0.476190476"):
        pachon.save_telescope(wrong, tmp_path / "wrong.yaml")
    lens = loaded(tmp_path, SYMMETRIC)
    pachon.save_telescope(lens, tmp_path / "good.yaml")
    text = (tmp_path / "good.yaml").read_text()
    for old, new, words in (
        ("marginal_height: 0.0", "height: 0.0", "design.solves"),
        ("radius: S2", "radius: S9", "S9"),
        ("thickness: S1", "thickness: S1, conic: S1", "one of radius, conic, thickness, glass"),
    ):
        assert old in text
        (tmp_path / "bad.yaml").write_text(text.replace(old, new))
        with pytest.raises(PrescriptionError, match=words) as found:
            pachon.load_telescope(tmp_path / "bad.yaml")
        assert "\n" not in str(found.value)


def test_a_format_without_links_refuses_them(tmp_path):
    lens = loaded(tmp_path, SYMMETRIC)
    words = r"pickup S3.radius, .*, solve S4.marginal_height: a .*file.* has no place for it"
    with pytest.raises(PrescriptionError, match=words):
        pachon.save_telescope(lens, tmp_path / "a.json")
    assert not (tmp_path / "a.json").exists()
    with pytest.warns(PrescriptionWarning, match=words):
        pachon.save_telescope(lens, tmp_path / "a.json", lenient=True)
    again = pachon.load_telescope(tmp_path / "a.json")
    heights = [s.vertex[2] for s in lens.surfaces]
    assert [s.vertex[2] for s in again.surfaces] == pytest.approx(heights, abs=1e-15)


def test_files_of_batoid_keep_links_and_design_data(tmp_path):
    """They stand in the section that batoid ignores."""
    for name, lens in (("a", loaded(tmp_path, SYMMETRIC)), ("b", pachon.load_telescope(LENS))):
        pachon.save_telescope(lens, tmp_path / f"{name}.yaml", format="batoid")
        again = pachon.load_telescope(tmp_path / f"{name}.yaml")
        assert again.design_data == lens.design_data
        assert [s.semi_diameter for s in again.surfaces] == [s.semi_diameter for s in lens.surfaces]
    text = (tmp_path / "a.yaml").read_text()
    for old, new, words in (("radius: S2", "radius: S9", "S9"), ("aiming: ", "aimed: ", "design.aimed")):
        if old in text:
            (tmp_path / "bad.yaml").write_text(text.replace(old, new))
            with pytest.raises(PrescriptionError, match=words):
                pachon.load_telescope(tmp_path / "bad.yaml")


def test_every_link_is_written_to_zemax_or_named(tmp_path):
    lens = loaded(tmp_path, SYMMETRIC)
    links = {
        "pickups": (pachon.models.Pickup("S4", "conic", "S1"), pachon.models.Pickup("S4", "glass", "S2")),
        "solves": (
            pachon.models.Solve("S3", "edge_thickness", 3.9e-3, radius=1e-3),
            pachon.models.Solve("S4", "chief_height", 1.0),
        ),
    }
    with pytest.raises(PrescriptionError) as found:
        pachon.save_telescope(lens.with_design(**links), tmp_path / "no.zmx")
    for link in (*links["pickups"], *links["solves"]):
        assert link.address in str(found.value)
    # Tilted, its thickness stands in the lines of coordinate breaks.
    tilted = lens.perturbed("S3", tilt=(1e-3, 0.0, 0.0)).with_design(
        pickups=(), solves=(pachon.models.Solve("S3", "marginal_height"),)
    )
    with pytest.raises(PrescriptionError, match=r"solve S3.marginal_height: a Zemax file has no place"):
        pachon.save_telescope(tilted, tmp_path / "no.zmx")


def test_thickness_behind_a_mirror_is_of_the_other_sign_in_zemax(tmp_path):
    # Lens, mirror, and the way back: DISZ counts along +z of the file, a thickness along the light.
    text = SYMMETRIC[: SYMMETRIC.index("SURF 2")] + (
        "SURF 2\n  TYPE STANDARD\n  CURV 0.0\n  DISZ 30\n"
        "SURF 3\n  TYPE STANDARD\n  CURV -0.01\n  GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0\n  DISZ -29\n  PZUP 2 -1 1 0\n"
        "SURF 4\n  TYPE STANDARD\n  CURV 0.0\n  DISZ 0\n"
    )
    expected = (pachon.models.Pickup("S3", "thickness", "S2", 1.0, -1e-3),)
    mirror = loaded(tmp_path, text)
    assert mirror.design_data.pickups == expected
    pachon.save_telescope(mirror, tmp_path / "again.zmx")
    assert "PZUP 2 -1.0 1.0 0" in (tmp_path / "again.zmx").read_text()
    assert pachon.load_telescope(tmp_path / "again.zmx").design_data.pickups == expected


def test_the_height_of_a_real_marginal_ray_is_left_out_with_a_warning(tmp_path):
    with pytest.warns(PrescriptionWarning, match=r"surface 4: MAZH: zone 0.7 of the pupil: .*; it is not kept"):
        lens = loaded(tmp_path, SYMMETRIC.replace("MAZH 0 0", "MAZH 0 0.7"))
    assert lens.design_data.solves == ()
    assert lens.design_data.pickups == PICKUPS


def test_what_is_not_kept_of_a_zemax_file_is_named(tmp_path):
    """In either mode: the solutions stand in the file, the relations are lost."""
    text = SYMMETRIC
    line = next(one for one in text.splitlines() if one.strip().startswith("CURV") and " 0" in one)
    changed = text.replace(line, f"  CURV {line.split()[1]} 11 4\n  PPAR 3 1 1 0 0", 1)
    (tmp_path / "lens.zmx").write_text(changed)
    words = r"pickups and solves S\d CURV \(f-number\), S\d PPAR: their solutions stand in the file; they are not kept"
    with pytest.warns(PrescriptionWarning, match=words):
        pachon.load_telescope(tmp_path / "lens.zmx")


@pytest.mark.parametrize("move", ["PARM 3 5", "PARM 1 2", "PARM 3 -7\n  PARM 4 4\n  PARM 2 0.5"])
def test_a_back_focus_off_the_axis_is_written_back(tmp_path, move):
    """A lens behind a coordinate break keeps its solve, and the places of its surfaces."""
    path, again = tmp_path / "lens.zmx", tmp_path / "again.zmx"
    lines = SYMMETRIC.splitlines(keepends=True)
    start = next(i for i, line in enumerate(lines) if line.startswith("SURF 1"))
    moved = [line if line[:4] != "SURF" else f"SURF {int(line[5:]) + 1}\n" for line in lines[start:]]
    moved = "".join(moved).replace("PZUP 1 1", "PZUP 2 1").replace("GLAS N-BK7 2 1", "GLAS N-BK7 2 2")
    moved = moved.replace("4 2 -1.", "4 3 -1.").replace("4 1 -2.0", "0 0 0")
    tilt = f"SURF 1\n  TYPE COORDBRK\n  CURV 0\n  {move}\n  DISZ 0\n"
    path.write_text("".join(lines[:start]) + tilt + moved)
    lens = pachon.load_telescope(path)
    assert [s.kind for s in lens.design_data.solves] == ["marginal_height"]
    pachon.save_telescope(lens, again)
    back = pachon.load_telescope(again)
    assert back.design_data.solves == lens.design_data.solves
    assert set(back.design_data.pickups) == set(lens.design_data.pickups)
    for surface, other in zip(lens.surfaces, back.surfaces, strict=True):
        assert surface.vertex == pytest.approx(other.vertex, abs=1e-16)
        assert surface.matrix.ravel() == pytest.approx(other.matrix.ravel(), abs=1e-15)


def test_a_solve_on_a_coordinate_break_is_said(tmp_path):
    path = tmp_path / "lens.zmx"
    break_lines = "SURF 5\n  TYPE COORDBRK\n  CURV 0\n  PARM 3 5\n  DISZ 10\n  MAZH 0 0\nSURF 6\n"
    path.write_text(SYMMETRIC.replace("  MAZH 0 0\n", "").replace("SURF 5\n", break_lines))
    with pytest.warns(PrescriptionWarning, match="S5 MAZH: their solutions stand in the file"):
        pachon.load_telescope(path)
