"""Errors, defaults and names of telescopes from batoid's YAML; tests/peers/test_batoid_files.py compares the rays."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import yaml

import pachon
from pachon.core.errors import ConfigError, PrescriptionError, PrescriptionWarning
from pachon.models.aperture import Ellipse
from pachon.models.io.prescription import load_telescope, save_telescope
from pachon.models.media.tabulated import TabulatedIndex
from pachon.models.shapes.freeform import Biconic
from pachon.models.shapes.shape import Conic
from pachon.models.surface import Interaction

MIRROR = {
    "type": "Mirror",
    "name": "M1",
    "surface": {"type": "Paraboloid", "R": 20.0},
    "obscuration": {"type": "ClearAnnulus", "inner": 0.5, "outer": 2.0},
}
DETECTOR = {"type": "Detector", "name": "D", "surface": {"type": "Plane"}, "coordSys": {"z": 10.0},
            "obscuration": {"type": "ClearCircle", "radius": 0.2}}  # fmt: skip
FACE = {"type": "RefractiveInterface", "surface": {"type": "Plane"}}
LENS = {"type": "Lens", "name": "L", "medium": 1.5, "coordSys": {"z": 9.0}, "items": [
    FACE | {"name": "in"}, FACE | {"name": "out", "coordSys": {"z": 0.1}}]}  # fmt: skip


@pytest.fixture
def loaded(tmp_path):
    """``loaded(items, lenient=..., **keys of the system)``: the telescope of a file with these optics."""

    def load(*items, lenient=False, pachon=None, **system):
        content = {"opticalSystem": {"type": "CompoundOptic", "name": "tel", "items": [*items], **system}}
        content |= {} if pachon is None else {"pachon": pachon}
        path = tmp_path / "tel.yaml"
        path.write_text(yaml.safe_dump(copy.deepcopy(content)))
        return load_telescope(path, lenient=lenient)

    return load


def test_what_a_file_leaves_out(loaded):
    tel = loaded(MIRROR, DETECTOR)
    # batoid starts rays at 40 m, on their way to the plane z = 0; the pupil is the first aperture.
    assert (tel.launch_distance, tel.stop_z, tel.pupil_diameter, tel.pupil_obscuration) == (40.0, 0.0, 4.0, 0.0)
    # Focal length R / 2; the detector is drawn a third larger than the field.
    assert tel.reference_sphere_radius == pytest.approx(10.0)
    assert tel.field_radius == pytest.approx(0.75 * math.atan(0.2 / 10.0))
    assert (tel.name, tel.source, tel.default_wavelength) == ("tel", "batoid file tel.yaml", 550e-9)
    assert [s.interaction for s in tel.surfaces] == [Interaction.MIRROR, Interaction.DETECTOR]
    assert tel.surface("M1").shape == Conic(20.0, -1.0)


def test_what_it_states(loaded):
    own = {"source": "notes", "field": {"radius": 0.01, "limit": 0.02}, "camera": "lsst", "version": "2",
           "wavelengths": {"range": [4e-7, 9e-7], "default": 6e-7, "band": [5e-7, 7e-7]},
           "groups": {"both": {"surfaces": ["M1", "D"], "pivot": [0, 0, 1]}}}  # fmt: skip
    tel = loaded(MIRROR, LENS, DETECTOR, pachon=own, pupilSize=3.0, sphereRadius=4.0, backDist=20.0)
    assert (tel.pupil_diameter, tel.reference_sphere_radius, tel.launch_distance) == (3.0, 4.0, 20.0)
    assert (tel.field_radius, tel.field_limit, tel.source, tel.camera, tel.version) == (
        0.01,
        0.02,
        "notes",
        "lsst",
        "2",
    )
    assert (tel.wavelength_range, tel.default_wavelength, tel.band) == ((4e-7, 9e-7), 6e-7, (5e-7, 7e-7))
    assert dict(tel.groups) == {"L": ("in", "out"), "both": ("M1", "D")}
    assert tel.group_frames["L"][0] == (0.0, 0.0, 9.0)
    assert tel.group_frames["both"][0] == (0.0, 0.0, 1.0)


def test_equal_names_are_told_apart_by_the_optics_around_them(loaded):
    other = LENS | {"name": "K", "coordSys": {"z": 9.5}}
    tel = loaded(MIRROR, LENS, other, DETECTOR)
    assert tel.surface_names == ("M1", "L.in", "L.out", "K.in", "K.out", "D")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"surface": {"type": "Paraboloid"}}, r"items\[M1\]\.surface\.R is missing"),
        (
            {"surface": {"type": "Asphere", "R": 9, "conic": 0, "coefs": [1e-3], "imin": 10**30}},
            r"surface\.imin = 1000000.*: expected a number up to 100",
        ),
        ({"surface": {"type": "Spline"}}, r"items\[M1\]\.surface\.type = 'Spline': expected one of Plane, Sphere, "),
        ({"surface": {"type": "Sphere", "R": "x"}}, r"items\[M1\]\.surface\.R = 'x': expected a number"),
        ({"surface": {"type": "Sphere", "R": 0}}, r"items\[M1\]\.surface\.radius = 0\.0: expected a finite radius"),
        ({"surface": {"type": "Zernike", "coef": [0, 1], "x_origin": 0.5}}, r"surface\.x_origin = 0\.5: expected 0"),
        (
            {"surface": {"type": "Bicubic", "xs": [0, 1], "ys": [0, 1], "zs": [[0, 1], [0]]}},
            r"surface\.zs = .*one length",
        ),
        (
            {"surface": {"type": "Bicubic", "xs": [0], "ys": [0], "zs": [[0]], "dzdxs": [[0]]}},
            r"unknown key .*surface\.dzdxs",
        ),
        (
            {"obscuration": {"type": "ObscStar"}},
            r"items\[M1\]\.obscuration\.type = 'ObscStar': expected one of ObscCircle",
        ),
        ({"obscuration": {"type": "ClearPolygon", "xs": [0, 1, 2], "ys": [0, 1]}}, r"ys = 2 numbers: expected 3"),
        ({"coordSys": {"rotx": 0.1}}, r"unknown key .*items\[M1\]\.coordSys\.rotx = 0\.1: did you mean rotX"),
        ({"coordSys": {"shift": [0.1]}}, r"items\[M1\]\.coordSys\.shift = \[0\.1\]: expected a list of 3 numbers"),
        ({"coordSys": {"z": [0.1]}}, r"items\[M1\]\.coordSys\.z = \[0\.1\]: expected a number"),
        ({"inMedium": "water"}, r"items\[M1\]\.inMedium = 'water': expected a refractive index"),
        ({"inMedium": {"type": "ConstMedium", "n": -1}}, r"items\[M1\]\.inMedium\.n = -1\.0: expected a positive"),
        ({"inMedium": {"type": "Glas"}}, r"inMedium\.type = 'Glas': expected one of ConstMedium, TableMedium"),
        ({"coating": 0.9}, r"unknown key opticalSystem\.items\[M1\]\.coating = 0\.9"),
        ({"type": "Miror"}, r"items\[M1\]\.type = 'Miror': expected one of .*\(did you mean Mirror"),
    ],
)
def test_a_wrong_optic_is_refused_in_one_line(loaded, tmp_path, change, message):
    with pytest.raises(PrescriptionError, match=message) as caught:
        loaded(MIRROR | change, DETECTOR)
    assert str(caught.value).startswith(str(tmp_path / "tel.yaml"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("items", "system", "message"),
    [
        ([MIRROR], {}, "expected a Detector as the last optic, not a Mirror"),
        ([MIRROR, DETECTOR, MIRROR | {"name": "M2"}], {}, "expected a Detector as the last optic"),
        ([], {}, r"opticalSystem\.items = \[\]: expected a list"),
        ([MIRROR, LENS | {"items": LENS["items"][:1]}, DETECTOR], {}, r"items\[L\]\.items = .*: expected two items"),
        ([MIRROR, FACE | {"name": "F", "inMedium": 1.4}, DETECTOR], {}, r"F\.inMedium = .*n=1\.4.*: expected .*n=1\.0"),
        ([MIRROR, DETECTOR], {"coordSys": {"z": 1.0}}, r"opticalSystem\.coordSys: expected none"),
        (
            [MIRROR, DETECTOR],
            {"stopSurface": {"type": "Interface", "surface": {"type": "Plane"}, "coordSys": {"x": 1}}},
            "stopSurface: expected a Plane on the axis",
        ),
        (
            [MIRROR, DETECTOR],
            {"stopSurface": {"type": "Interface", "surface": {"type": "Sphere", "R": 9}}},
            "stopSurface: expected a Plane",
        ),
        ([MIRROR, DETECTOR], {"pupilSize": -1}, r"opticalSystem\.pupilSize = -1: expected a positive number"),
        ([MIRROR, DETECTOR], {"backDist": "far"}, r"opticalSystem\.backDist = 'far'"),
        ([MIRROR, DETECTOR], {"type": "Mirror"}, r"opticalSystem\.type = 'Mirror': expected one of CompoundOptic"),
        (
            [
                MIRROR | {"obscuration": {"type": "ObscCircle", "radius": 1}},
                DETECTOR | {"obscuration": {"type": "ObscCircle", "radius": 1}},
            ],
            {},
            "pupilSize is missing",
        ),
    ],
)
def test_a_wrong_system_is_refused_in_one_line(loaded, items, system, message):
    with pytest.raises(PrescriptionError, match=message) as caught:
        loaded(*items, **system)
    assert "\n" not in str(caught.value)


def test_lenient_lists_the_keys_that_it_leaves_out(loaded):
    odd = MIRROR | {"coating": 0.9, "surface": {"type": "Paraboloid", "R": 20.0, "glitter": 1}}
    with pytest.warns(PrescriptionWarning) as caught:
        tel = loaded(odd, DETECTOR, lenient=True, weather="fine")
    assert tel == loaded(MIRROR, DETECTOR)
    for key in ("opticalSystem.items[M1].coating = 0.9", "opticalSystem.items[M1].surface.glitter = 1", "weather"):
        assert sum(key in str(w.message) for w in caught) == 1


def test_lenient_does_not_take_what_it_cannot_trace(loaded):
    with pytest.raises(PrescriptionError, match="Spline"):
        loaded(MIRROR | {"surface": {"type": "Spline"}}, DETECTOR, lenient=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.with_shape("M1", Biconic(9.0, 8.0)), "lsst_v3.3_r: surface M1: shape Biconic: expected"),
        (
            lambda t: replace(t, surfaces=(replace(t.surfaces[0], aperture=Ellipse(4.0, 3.0)), *t.surfaces[1:])),
            "lsst_v3.3_r: surface M1: aperture Ellipse: expected one that batoid has",
        ),
        (lambda t: replace(t, object_distance=100.0), "object_distance = 100.0"),
        (lambda t: replace(t, surfaces=t.surfaces[:-1], groups={}, group_frames={}), "needs a detector"),
        (lambda t: t.with_obstructions(pachon.models.Obstruction("top", np.eye(3)[None])), "obstruction top"),
        (
            lambda t: replace(
                t,
                medium_before=TabulatedIndex((4e-7, 9e-7), (1.0, 1.0), name="gas"),
                surfaces=tuple(replace(s, medium_after=TabulatedIndex((4e-7, 9e-7), (1.0, 1.0))) for s in t.surfaces),
            ),
            r"medium gas \(monotone\): expected one that batoid has",
        ),
    ],
)
def test_what_batoid_cannot_hold_is_refused_by_name(lsst_r, tmp_path, change, message):
    with pytest.raises(PrescriptionError, match=message):
        save_telescope(change(lsst_r), tmp_path / "out.yaml", format="batoid")
    assert list(tmp_path.iterdir()) == []


def test_formats_have_names(lsst_r, tmp_path):
    with pytest.raises(ConfigError, match="format = 'mine': expected one of pachon, batoid, zemax"):
        save_telescope(lsst_r, tmp_path / "out.yaml", format="mine")


def test_groups_that_are_no_neighbours_or_overlap_are_kept_beside(lsst_r, tmp_path):
    groups = {"mirrors": ("M1", "M3"), "first": ("M1", "M2"), "second": ("M2", "M3"), "one": ("M2",)}
    telescope = replace(lsst_r, groups=groups, group_frames={"first": ((0.0, 0.0, 2.0), lsst_r.surfaces[0].rotation)})
    save_telescope(telescope, tmp_path / "out.yaml", format="batoid")
    again = load_telescope(tmp_path / "out.yaml")
    assert dict(again.groups) == groups
    assert again.group_frames == telescope.group_frames
    content = yaml.safe_load((tmp_path / "out.yaml").read_text())
    assert [item["name"] for item in content["opticalSystem"]["items"]][:2] == ["first", "M3"]
    assert list(content["pachon"]["groups"]) == ["mirrors", "second"]


def test_numbers_of_numpy_are_written_as_plain_ones(lsst_r, tmp_path):
    telescope = replace(lsst_r, field_limit=np.deg2rad(2.0), stop_z=np.float64(0.5), pupil_diameter=np.float64(8.0))
    save_telescope(telescope, tmp_path / "out.yaml", format="batoid")
    assert load_telescope(tmp_path / "out.yaml") == telescope
