"""Thicknesses, indices and Abbe numbers as parameters: motions by hand, closed forms, exact derivatives."""

import re
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError, UnknownNameError
from pachon.design.optimize.jacobian import ParameterColumns
from pachon.design.optimize.merit import Beams, SpotMerit, WavefrontMerit
from pachon.models.design_data import DesignData
from pachon.models.io.glass_catalogue import GlassCatalogue
from pachon.models.media.medium import ChangedIndex, ConstantIndex, abbe_number, with_index_change
from pachon.models.parameters.parameters import Parameter, apply, parse_parameters, twists

FIELDS = np.deg2rad([[0.0, 0.0], [3.0, 8.0]])
WAVES = [486.1327e-9, 656.2725e-9]


@pytest.fixture(scope="module")
def triplet():
    return pachon.load_telescope("tests/data/zmx/lens1.zmx")


def test_a_thickness_moves_all_that_is_behind(lsst_r, triplet):
    thicker = apply(triplet, {"S2.thickness": 1e-4})
    assert Parameter.parse("S2.thickness", triplet).value(thicker) == pytest.approx(2.6377501487731934e-3 + 1e-4)
    for before, after in zip(triplet.surfaces, thicker.surfaces, strict=True):
        moved = np.subtract(after.vertex, before.vertex)
        assert moved == pytest.approx([0, 0, 0 if before.name in ("S1", "S2") else -1e-4], abs=1e-15)
    # Light travels up behind M1, down behind M2; the group of two surfaces is a lens.
    for name, thickness in (("M1", 6.1562006), ("M2", 6.390), ("L1", 0.08223)):
        found = Parameter.parse(f"{name}.thickness", lsst_r).value(lsst_r)
        assert found == pytest.approx(thickness, rel=1e-3)
    further = apply(lsst_r, {"M2.thickness": 1e-3})
    assert np.subtract(further.surface("M3").vertex, lsst_r.surface("M3").vertex) == pytest.approx([0, 0, -1e-3])
    # Groups behind move with their pivots: a tilt afterwards is about the moved one.
    assert further.group_frames["Camera"][0][2] == pytest.approx(lsst_r.group_frames["Camera"][0][2] - 1e-3)
    assert further.group_frames["L1"][0][2] == pytest.approx(further.surface("L1_entrance").vertex[2])


@pytest.mark.parametrize(
    ("model", "fold", "distance", "along"),
    [("auxtel", "M3", 0.862665389535466, [0, -1, 0]), ("tests/data/lenses/fold.zmx", "fold", 0.0459, [0, 1, 0])],
)
def test_a_thickness_behind_a_fold_is_along_the_light(model, fold, distance, along):
    """It is the whole way to the next vertex, not its part along the normal of the fold mirror."""
    telescope = pachon.load_telescope(model)
    assert Parameter.parse(f"{fold}.thickness", telescope).value(telescope) == pytest.approx(distance, rel=1e-12)
    farther = apply(telescope, {f"{fold}.thickness": 1e-3})
    for before, after in zip(telescope.surfaces, farther.surfaces, strict=True):
        behind = telescope.surface_names.index(before.name) > telescope.surface_names.index(fold)
        assert np.subtract(after.vertex, before.vertex) == pytest.approx(1e-3 * behind * np.array(along), abs=1e-15)
    (velocity,) = twists(telescope, parse_parameters([f"{fold}.thickness"], telescope), np.zeros(1))[:, -1, :3]
    assert velocity == pytest.approx(along, abs=1e-15)


def test_a_tilted_plate_turns_no_light_to_a_fold(tmp_path):
    """The 46 mm behind the fold of the lens were 32, along the normal of the mirror."""
    turn, plane = "SURF\n  TYPE COORDBRK\n  CURV 0\n  PARM 3 {}\n  DISZ {}\n", "SURF\n  TYPE STANDARD\n  CURV 0\n"
    plate = turn.format(30, 0) + plane + "  GLAS N-BK7 0 0 1.5 40 0 0 0 0 0 0\n  DISZ 2\n" + plane + "  DISZ 0\n"
    text = Path("tests/data/lenses/fold.zmx").read_text()
    text = text.replace("DISZ 50\n", f"DISZ 30\n{plate}{turn.format(-30, 18)}")
    numbers = count()
    (tmp_path / "plate.zmx").write_text(re.sub(r"SURF( \d+)?", lambda _: f"SURF {next(numbers)}", text))
    telescope = pachon.load_telescope(tmp_path / "plate.zmx")
    assert len(telescope.surfaces) == 7
    assert Parameter.parse("fold.thickness", telescope).value(telescope) == pytest.approx(0.0459, rel=1e-12)
    # Nor is the distance behind the plate along its own normal: it was 15.6 mm for the 18 of the file.
    assert Parameter.parse("S5.thickness", telescope).value(telescope) == pytest.approx(0.002, rel=1e-12)
    behind = Parameter.parse("S6.thickness", telescope)
    assert behind.value(telescope) == pytest.approx(0.018, rel=1e-12)
    moved = [s.vertex for s in apply(telescope, {"S6.thickness": 1e-3}).surfaces]
    shifts = np.subtract(moved, [s.vertex for s in telescope.surfaces])
    np.testing.assert_allclose(shifts, [[0, 0, 0]] * 5 + [[0, 0, -0.001]] * 2, atol=1e-15)


def test_a_misaligned_mirror_keeps_its_own_axis(lsst_r):
    tilted = lsst_r.perturbed("M2", tilt=(1e-3, 0.0, 0.0))
    expected = lsst_r.surface("M2").vertex[2] - lsst_r.surface("M3").vertex[2]
    found = Parameter.parse("M2.thickness", tilted).value(tilted)
    assert found == pytest.approx(expected * np.cos(1e-3), rel=1e-14)


def test_an_index_ends_at_a_thin_lens_into_another_medium(triplet):
    glass, air = ConstantIndex(1.5), ConstantIndex(1.0)
    front = pachon.Surface("front", pachon.Interaction.REFRACT, pachon.Plane(), (0.0, 0.0, 0.0), glass)
    inside, last = (
        pachon.Surface(name, pachon.Interaction.THIN_LENS, pachon.Plane(), (0.0, 0.0, z), medium,
                       thin_lens=pachon.models.ThinLens(0.1))
        for name, z, medium in (("inside", -0.01, glass), ("last", -0.02, air))
    )  # fmt: skip
    image = pachon.Surface("Image", pachon.Interaction.DETECTOR, pachon.Plane(), (0.0, 0.0, -0.1), air)
    lens = replace(triplet, surfaces=(front, inside, last, image), groups={}, design_data=DesignData())
    changed = apply(lens, {"front.n": 0.1})
    indices = [float(s.medium_after.index(WAVES[0])) for s in changed.surfaces]
    assert indices == pytest.approx([1.6, 1.6, 1.0, 1.0], rel=1e-15)


def test_twists_with_thicknesses(lsst_r, slope):
    """Nested bodies, tilted and moved apart, against central differences of vertices and axes."""
    addresses = ["L1.thickness", "Camera.rx", "L1_exit.ry", "M2.thickness", "Camera.dy", "L2.rx"]
    parameters = parse_parameters(addresses, lsst_r)
    values = np.array([0.02, 0.03, -0.02, 0.05, 0.01, 0.04])
    found = twists(lsst_r, parameters, values)
    start = apply(lsst_r, dict(zip(addresses, values, strict=True)))
    vertices = np.array([s.vertex for s in start.surfaces])
    for row in range(len(addresses)):

        def moved(h, row=row):
            changed = values + h * np.eye(len(values))[row]
            return np.array([s.vertex for s in apply(lsst_r, dict(zip(addresses, changed, strict=True))).surfaces])

        v, w = found[row, :, :3], found[row, :, 3:]
        # Fourth-order differences with a step of 1e-3: 1e-12, and rounding 1e-15 / 1e-3.
        assert np.abs(slope(moved, 1e-3) - (v + np.cross(w, vertices))).max() < 1e-11


def test_an_abbe_number_scales_the_dispersion(triplet):
    """The file states V = 60.279; n_F - n_C is (n_d - 1) / V, and the index at the d line stays."""
    glass = Parameter.parse("N-SK16.abbe", triplet)
    assert glass.value(triplet) == pytest.approx(60.27947998, rel=1e-9)
    softer = apply(triplet, {"N-SK16.abbe": -10.0})
    before, after = (t.surface("S1").medium_after for t in (triplet, softer))
    d, f, c = (float(after.index(w)) for w in (587.5618e-9, 486.1327e-9, 656.2725e-9))
    assert d == pytest.approx(float(before.index(587.5618e-9)), abs=1e-15)
    assert f - c == pytest.approx((d - 1.0) / (glass.value(triplet) - 10.0), rel=1e-12)
    assert softer.surface("S3").medium_after == triplet.surface("S3").medium_after
    # There and back again.
    assert apply(softer, {"S1.abbe": 10.0}).surface("S1").medium_after.index(5e-7) == pytest.approx(
        float(before.index(5e-7)), abs=1e-15
    )


def test_changes_of_a_medium_accumulate():
    glass = GlassCatalogue.bundled()["N-BK7"]
    changed = with_index_change(with_index_change(glass, 1e-3, 1.1), 2e-3, 1.2)
    assert isinstance(changed, ChangedIndex)
    assert (changed.medium, changed.change, changed.dispersion) == (glass, pytest.approx(3e-3), pytest.approx(1.32))
    assert abbe_number(with_index_change(glass, 0.0, 1.25)) == pytest.approx(abbe_number(glass) / 1.25)
    assert abbe_number(ConstantIndex(1.5)) == np.inf


@pytest.mark.parametrize("kind", [SpotMerit, WavefrontMerit])
def test_derivatives(triplet, slope, kind):
    merit = kind(triplet, Beams.of(triplet, FIELDS, WAVES, sampling="rings", n_pupil=2))
    addresses = ["S1.thickness", "S4.thickness", "N-SF2.abbe", "S6.abbe", "N-SF2.n", "S3.ry", "S2.curvature"]
    parameters = parse_parameters(addresses, triplet)
    start = np.array([1e-4, -5e-5, 3.0, -2.0, 2e-3, 1e-3, 0.5])
    values, found = merit.derivatives(ParameterColumns.at(triplet, parameters, start))

    def residuals(changes):
        return merit.residuals(apply(triplet, dict(zip(parameters, changes, strict=True))))

    assert np.allclose(values, residuals(start), atol=1e-14)
    for i, step in enumerate([1e-5, 1e-5, 0.1, 0.1, 1e-4, 1e-4, 1e-2]):
        numeric = slope(lambda h, i=i: residuals(start + h * np.eye(len(start))[i]), step)
        # Fourth order in steps of 1e-3 of the curvature of the merit; paths of 0.1 m are good to 1e-16 m.
        assert np.abs(found[:, i] - numeric).max() < 1e-6 * np.abs(numeric).max() + 1e-15 / step, addresses[i]


@pytest.mark.parametrize(
    ("address", "error", "words"),
    [
        ("Image.thickness", DomainError, "Image.thickness.*behind it"),
        ("S9.thickness", UnknownNameError, "S9"),
        ("S5.abbe", DomainError, "refracting"),
        ("N-SF2.density", UnknownNameError, "density.*abbe"),
    ],
)
def test_wrong_addresses(triplet, address, error, words):
    with pytest.raises(error, match=words):
        Parameter.parse(address, triplet)


def test_wrong_groups_and_numbers(lsst_r, triplet):
    with pytest.raises(DomainError, match=r"Camera.thickness.*group of two"):
        Parameter.parse("Camera.thickness", lsst_r)
    with pytest.raises(DomainError, match=r"thickness of S2 = -0.00136.* m: expected S3 to stay behind it"):
        apply(triplet, {"S2.thickness": -4e-3})
    with pytest.raises(DomainError, match=r"N-SF2.abbe = -6.*positive Abbe"):
        apply(triplet, {"N-SF2.abbe": -40.0})
    front, *others = triplet.surfaces
    plain = replace(triplet, surfaces=(replace(front, medium_after=ConstantIndex(1.5, "plain")), *others))
    with pytest.raises(DomainError, match=r"plain.abbe.*dispersion"):
        Parameter.parse("plain.abbe", plain)
