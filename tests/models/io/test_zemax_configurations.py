"""Zemax files of several configurations: each as the file that states its values itself, with pickups and solves."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError, PrescriptionNote
from pachon.models.first_order import first_order
from pachon.models.io.glass_catalogue import GlassCatalogue

HEADER = """VERS 231205 341
MODE SEQ
UNIT MM X W X CM MR CPMM
{aperture}
FTYP {kind} 0 2 1 0 0 0 1
XFLN 0 0
YFLN 0 {field}
WAVM 1 {wave} 1
PWAV 1
"""
#: Two lenses with an air space that slides between them, a thickness and a curvature that follow, and a focus.
LENS = (
    HEADER
    + """SURF 0
  TYPE STANDARD
  CURV 0
  DISZ INFINITY
SURF 1
  STOP
  TYPE STANDARD
  CURV {front} 0 0 0 0
  DISZ {glass_thickness}
  GLAS {glass} 0 0 1.5 40
SURF 2
  TYPE STANDARD
  CURV -0.01
  DISZ {gap}
SURF 3
  TYPE STANDARD
  CURV 0
  DISZ {rest}{compensator}
SURF 4
  TYPE EVENASPH
  CURV {picked}{curvature_pickup}
  DISZ {picked_thickness}{thickness_pickup}
  PARM 2 {sphere}
  GLAS {glass}{glass_pickup}
SURF 5
  TYPE STANDARD
  CURV 0
  DISZ {focus}{solve}
SURF 6
  TYPE STANDARD
  CURV 0
  DISZ 0
"""
)
STATES = (
    {"aperture": "ENPD 10", "kind": 0, "field": 3.0, "wave": 0.5876, "front": 0.02, "glass_thickness": 5.0,
     "glass": "N-BK7", "gap": 10.0, "sphere": 1e-6},
    {"aperture": "ENPD 8", "kind": 0, "field": 4.0, "wave": 0.55, "front": 0.03, "glass_thickness": 6.0,
     "glass": "N-BK7", "gap": 12.0, "sphere": 2e-6},
    {"aperture": "ENPD 6", "kind": 0, "field": 5.0, "wave": 0.65, "front": 0.01, "glass_thickness": 7.0,
     "glass": "F2", "gap": 14.0, "sphere": -1e-6},
)  # fmt: skip
#: Sum of the two spaces around surface 3, kept by its compensator.
SUM = 30.0
LINKS = {
    "compensator": f"\n  TCOM 2 {SUM}", "curvature_pickup": " 4 1 0.25", "thickness_pickup": "\n  PZUP 1 1.0 -1.0 0",
    "glass_pickup": " 2 1 1.5 40", "solve": "\n  MAZH 0 0",
}  # fmt: skip
NO_LINKS = {
    "compensator": "", "curvature_pickup": "", "thickness_pickup": "", "glass_pickup": " 0 0 1.5 40", "solve": "",
}  # fmt: skip


def paraxial_focus(rows, wavelength):
    """Trace the marginal ray through rows of curvature, thickness and index behind [mm]."""
    height, angle, index = 1.0, 0.0, 1.0
    for curvature, thickness, after in rows:
        angle = (index * angle - height * curvature * (after - index)) / after
        index = after
        last = height
        height += angle * thickness
    return -last / angle


def stated(state):
    """The file of one configuration with all its values, without pickups and solves; the focus from a trace."""
    followers = {
        "rest": SUM - state["gap"], "picked": 0.25 * state["front"], "picked_thickness": state["glass_thickness"] - 1.0,
    }  # fmt: skip
    n = float(GlassCatalogue.bundled()[state["glass"]].index(state["wave"] * 1e-6))
    rows = [
        (state["front"], state["glass_thickness"], n), (-0.01, state["gap"], 1.0), (0.0, followers["rest"], 1.0),
        (followers["picked"], followers["picked_thickness"], n), (0.0, 0.0, 1.0),
    ]  # fmt: skip
    return LENS.format(**state, **followers, **NO_LINKS, focus=paraxial_focus(rows, state["wave"]))


def zoom(active=1):
    """The file of all three, saved in one of them."""
    state = STATES[active - 1]
    rows = [f"MNUM 3 {active}", 'LTTL 0 1 "wide" 0 0 0 1 1 0 0.0 "" 0', 'MOFF 0 1 "" 0 0 0 1 1 0 0.0 "" 0']
    tail = '0 0 0 1 1 1 0 0 "" 0'
    for operand, key in (("THIC 2", "gap"), ("THIC 1", "glass_thickness"), ("CRVT 1", "front"), ("GLSS 1", "glass"),
                         ("WAVE 1", "wave"), ("YFIE 2", "field"), ("FLTP 0", "kind")):  # fmt: skip
        rows += [f"{operand} {i} {s[key]} {tail}" for i, s in enumerate(STATES, start=1)]
    rows += [f"APER 0 {i} {s['aperture'].split()[1]} {tail}" for i, s in enumerate(STATES, start=1)]
    rows += [f"PRAM 4 {i} {s['sphere']} 0 2 0 1 1 1 0 0 0" for i, s in enumerate(STATES, start=1)]
    rest = {"rest": SUM - state["gap"], "picked": 0.25 * state["front"]}
    text = LENS.format(**state, **rest, **LINKS, picked_thickness=state["glass_thickness"] - 1.0, focus=20.0)
    return text + "\n".join(rows) + "\n"


def written(tmp_path, text, name="zoom.zmx"):
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.parametrize("active", [1, 3])
def test_a_configuration_is_the_lens_with_its_own_values(tmp_path, number, active):
    path = written(tmp_path, zoom(active))
    lens = pachon.load_telescope(path, configuration=number)
    expected = pachon.load_telescope(written(tmp_path, stated(STATES[number - 1]), "one.zmx"))
    assert lens.name == f"zoom_{number}"
    # The focus of the active one stands in the file, where the test has another number.
    compared = len(lens.surfaces) - (1 if number == active else 0)
    for surface, other in zip(lens.surfaces[:compared], expected.surfaces[:compared], strict=True):
        np.testing.assert_allclose(surface.vertex, other.vertex, rtol=0, atol=1e-15)
        assert surface.shape.parameters == pytest.approx(other.shape.parameters, rel=1e-12)
        assert surface.medium_after == other.medium_after
    assert lens.pupil_diameter == expected.pupil_diameter
    assert lens.design_data.wavelengths == expected.design_data.wavelengths
    assert lens.design_data.fields == expected.design_data.fields
    assert first_order(lens).focal_length == pytest.approx(first_order(expected).focal_length, rel=1e-12)


def test_the_configuration_of_the_file_is_read_strictly_with_a_note(tmp_path):
    with pytest.warns(PrescriptionNote, match=r"MNUM 3: 1 is read, .*; others are read with configuration = 1, 2"):
        lens = pachon.load_telescope(written(tmp_path, zoom()))
    assert lens.name == "zoom"
    assert lens.surfaces[0].shape.parameters["radius"] == pytest.approx(-0.05)
    validation = pachon.validate_file(written(tmp_path, zoom()))
    assert validation.problems == ()
    assert len(validation.notes) == 1


def test_a_total_thickness_and_a_stop_follow(tmp_path):
    text = zoom().replace("TCOM 2 30.0", "TOLE 1 45.0") + "STPS 0 1 1\nSTPS 0 2 4\nSTPS 0 3 1\n"
    with pytest.warns(PrescriptionNote, match="pickups and solves S3 TOLE: .*; they are not kept"):
        lens = pachon.load_telescope(written(tmp_path, text), configuration=2)
    z = [-s.vertex[2] * 1e3 for s in lens.surfaces]
    assert z[3] - z[0] == pytest.approx(45.0, abs=1e-12)
    assert lens.design_data.stop == "S4"


@pytest.mark.parametrize(
    ("number", "old", "new", "expected"),
    [
        (4, "", "", "configuration = 4: the file has configurations 1 to 3"),
        (0, "", "", "configuration = 0: the file has configurations 1 to 3"),
        (2, "FLTP 0 1", "CROR 0 1", "FLTP|CROR"),
        (2, "APER 0 2", "TSP1 0 2", "TSP1 0 2 8 .*: this operand of a configuration is not understood"),
        (2, "THIC 2 2", "THIC 9 2", "THIC 9 2 12.0 .*: expected a surface from 0 to 6"),
        (2, "MAZH 0 0", "MAZH 1 0.7", "surface 5: MAZH 1 0.7: expected height and zone 0"),
        (2, "TCOM 2 30.0", "CHAZ 2", "surface 3: CHAZ 2: this solve is not made anew"),
        (2, "CURV 0.005 4 1", "CURV 0.005 2 1", "surface 4: CURV 0.005 2 1 .*: this solve is not made anew"),
        (2, "THIC 2 2 12.0", "THIC 2 2 twelve", "surface 2: DISZ twelve: expected a number"),
        (
            2,
            "THIC 2 2 12.0",
            "THIC 2 x 12.0",
            "THIC 2 x 12.0 .*: expected a number, that of a configuration, and a value",
        ),
        (2, "WAVE 1 2", "WAVE 5 2", "WAVM: 0.55: expected a field or wavelength that the file has"),
    ],
)
def test_what_a_configuration_cannot_be_is_one_line(tmp_path, number, old, new, expected):
    assert old in zoom()
    path = written(tmp_path, zoom().replace(old, new))
    if "CROR" in expected:
        # Of another configuration: no matter.
        assert pachon.load_telescope(path, configuration=number).name == "zoom_2"
        return
    with pytest.raises(PrescriptionError, match=expected) as error:
        pachon.load_telescope(path, configuration=number)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(str(path))


def test_files_without_configurations_say_so(tmp_path):
    path = written(tmp_path, stated(STATES[0]))
    assert pachon.load_telescope(path, configuration=1).name == "zoom_1"
    with pytest.raises(PrescriptionError, match="configuration = 2: the file has one configuration"):
        pachon.load_telescope(path, configuration=2)
    with pytest.raises(PrescriptionError, match=r"paul_baker: configuration = 2: expected a file that ends in .zmx"):
        pachon.load_telescope("paul_baker", configuration=2)


def test_a_glass_with_offsets_of_index_and_abbe_number(tmp_path):
    """``GLAS name 4 ... dnd dVd``: differences from the catalogue."""
    text = stated(STATES[0]).replace("GLAS N-BK7 0 0 1.5 40", "GLAS N-BK7 4 0 1.5 40 0 0 0 0 0.001 0.2", 1)
    medium = pachon.load_telescope(written(tmp_path, text)).surfaces[0].medium_after
    d, f, c = (float(medium.index(w)) for w in (0.5875618e-6, 0.4861327e-6, 0.6562725e-6))
    # Schott's figures of N-BK7.
    assert d == pytest.approx(1.5168 + 0.001, abs=2e-6)
    assert (d - 1) / (f - c) == pytest.approx(64.17 + 0.2, abs=6e-3)


def test_the_sum_of_two_thicknesses_is_kept_as_a_pickup(tmp_path):
    text = zoom().split("MNUM")[0].replace(LINKS["curvature_pickup"], "")
    lens = pachon.load_telescope(written(tmp_path, text))
    (pickup,) = (p for p in lens.design_data.pickups if p.surface == "S3")
    assert (pickup.source, pickup.scale, pickup.offset) == ("S2", -1.0, pytest.approx(0.03))
    pachon.save_telescope(lens, tmp_path / "again.zmx")
    assert pickup in pachon.load_telescope(tmp_path / "again.zmx").design_data.pickups
