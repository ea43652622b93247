import copy
import pickle

import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.core.errors import DomainError, PrescriptionError, UnknownNameError
from pachon.design.metrics.field_zernikes import wavefront_zernikes
from pachon.models.io.prescription import load_telescope
from pachon.models.rotation import rotation_matrix
from pachon.models.surface import Interaction

LSST = load_telescope("lsst_v3.3_r")
SHIFT, TILT = (1.1e-3, -2.3e-3, 0.7e-3), (3e-3, -5e-3, 7e-3)
# Names of our groups in batoid's tree.
PEER_NAMES = {"Camera": "LSSTCamera"}


def batoid_moved(optic, batoid, name, shift, tilt):
    name = PEER_NAMES.get(name, name)
    rotation = batoid.RotX(tilt[0]) @ batoid.RotY(tilt[1]) @ batoid.RotZ(tilt[2])
    return optic.withLocallyRotatedOptic(name, rotation).withGloballyShiftedOptic(name, list(shift))


def assert_same_places(telescope, optic):
    for surface in telescope.surfaces:
        system = optic[surface.name].coordSys
        # Rounding of a few products of numbers up to 5 m.
        assert np.allclose(surface.vertex, system.origin, rtol=0, atol=5e-15)
        assert np.allclose(surface.matrix, system.rot, rtol=0, atol=1e-15)


def test_rotation_is_x_then_new_y_then_new_z():
    # Closed form: with a quarter turn about x, the new y axis is the old z; turning about that carries x to y.
    quarter = np.pi / 2
    x_axis = rotation_matrix((quarter, quarter, 0.0)) @ [1.0, 0.0, 0.0]
    assert np.allclose(x_axis, [0.0, 1.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("name", ["M1", "M2", "M3", "L2_exit", "Detector", "Camera", "L1", "L2", "Filter", "L3"])
def test_perturbed_equals_batoids_coordinate_systems(name):
    batoid = pytest.importorskip("batoid")
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    assert_same_places(LSST.perturbed(name, shift=SHIFT, tilt=TILT), batoid_moved(optic, batoid, name, SHIFT, TILT))


def test_perturbing_twice_equals_batoid():
    # One lens inside the moved camera, then the camera again, whose own frame the lens surface has not changed.
    batoid = pytest.importorskip("batoid")
    telescope, optic = LSST, batoid.Optic.fromYaml("LSST_r.yaml")
    for name, factor in (("L1_entrance", 1.0), ("Camera", -2.0), ("L3", 3.0), ("Camera", 0.5), ("M2", 1.0)):
        shift, tilt = factor * np.array(SHIFT), factor * np.array(TILT)
        telescope = telescope.perturbed(name, shift=shift, tilt=tilt)
        optic = batoid_moved(optic, batoid, name, shift, tilt)
    assert_same_places(telescope, optic)


def test_rotation_about_a_point_leaves_it_in_place():
    about = np.array([0.2, -0.1, 4.0])
    moved = LSST.perturbed("Camera", tilt=TILT, about=about)
    for before, after in zip(LSST.surfaces[3:], moved.surfaces[3:], strict=True):
        # The fixed point has the same place in every surface's own frame.
        assert np.allclose(before.to_local(about), after.to_local(about), rtol=0, atol=1e-14)


def test_a_pure_shift_is_exact_and_reversible_tilts_cancel():
    moved = LSST.perturbed("M2", shift=(0.0, 0.0, 0.25))
    assert moved.surface("M2").vertex == (0.0, 0.0, 6.1562006 + 0.25)
    assert moved.surface("M2").rotation == LSST.surface("M2").rotation
    back = LSST.perturbed("M2", tilt=(1e-2, 0, 0)).perturbed("M2", tilt=(-1e-2, 0, 0))
    assert np.allclose(back.surface("M2").matrix, np.eye(3), atol=1e-16)


def test_perturbing_leaves_the_original_and_everything_else():
    before = pickle.dumps(LSST)
    moved = LSST.perturbed("L2", shift=SHIFT, tilt=TILT)
    assert pickle.dumps(LSST) == before
    changed = [a.name for a, b in zip(LSST.surfaces, moved.surfaces, strict=True) if a != b]
    assert changed == ["L2_entrance", "L2_exit"]


def test_perturbed_accepts_quantities():
    plain = LSST.perturbed("M2", shift=(1e-3, 0.0, 2e-3), tilt=(np.deg2rad(1.0), 0.0, 0.0), about=(0.0, 0.0, 6.0))
    units = LSST.perturbed("M2", shift=[1, 0, 2] * u.mm, tilt=[1, 0, 0] * u.deg, about=[0, 0, 6000] * u.mm)
    for a, b in zip(plain.surfaces, units.surfaces, strict=True):
        assert np.allclose(a.vertex, b.vertex, rtol=0, atol=1e-16)
        assert np.allclose(a.matrix, b.matrix, rtol=0, atol=1e-16)


def test_bad_perturbations_are_refused():
    with pytest.raises(UnknownNameError, match=r"unknown surface or group 'camara': did you mean Camera"):
        LSST.perturbed("camara", shift=SHIFT)
    with pytest.raises(UnknownNameError, match=r"unknown surface .* 'L1_exot'"):
        LSST.surface("L1_exot")
    with pytest.raises(DomainError, match=r"shift = .*: expected three finite numbers"):
        LSST.perturbed("M2", shift=(1.0, 2.0))
    with pytest.raises(DomainError, match=r"tilt = .*: expected three finite numbers"):
        LSST.perturbed("M2", tilt=(0.0, float("nan"), 0.0))
    with pytest.raises(DomainError, match="tilt"):
        LSST.perturbed("M2", tilt=[1, 2, 3] * u.m)


def test_wavelength_and_field_are_checked():
    assert LSST.check_wavelength(620 * u.nm) == pytest.approx(620e-9, rel=1e-15)
    assert np.array_equal(LSST.check_wavelength([0.3e-6, 1.2e-6]), [0.3e-6, 1.2e-6])
    with pytest.raises(DomainError, match="wavelength = 1300 nm: expected 300 to 1200 nm"):
        LSST.check_wavelength([5e-7, 1.3e-6])
    with pytest.raises(DomainError, match="wavelength"):
        LSST.check_wavelength(float("nan"))
    x, y = LSST.check_field(1.5 * u.deg, [0.0, 2.0] * u.deg)
    assert x.shape == y.shape == (2,)
    with pytest.raises(DomainError, match=r"field = \(2, 2\) deg: expected within 2.5 deg"):
        LSST.check_field(np.deg2rad(2.0), np.deg2rad([0.0, 2.0]))
    with pytest.raises(DomainError, match="field"):
        LSST.check_field(0.0, float("nan"))
    LSST.check_field(np.deg2rad(2.5), 0.0)


def test_telescopes_compare_hash_copy_and_pickle():
    assert copy.deepcopy(LSST) == LSST == pickle.loads(pickle.dumps(LSST))
    assert hash(LSST) == hash(load_telescope("lsst_v3.3_r"))
    assert LSST.perturbed("M2", shift=(0, 0, 1e-12)) != LSST
    with pytest.raises(TypeError):
        LSST.groups["L1"] = ("M1",)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"surfaces": ()}, "at least one surface"),
        ({"surfaces": LSST.surfaces + LSST.surfaces[:1]}, "'M1' occurs more than once"),
        ({"groups": {"M1": ("M2",)}}, "group 'M1' has the name of a surface"),
        ({"groups": {"A": ("M7",)}}, "group 'A': unknown surface 'M7'"),
        ({"groups": {"A": ()}}, "group 'A'"),
        ({"pupil_diameter": 0.0}, "pupil_diameter = 0.0: expected a positive number"),
        ({"pupil_obscuration": 1.0}, "pupil_obscuration"),
        ({"stop_z": float("nan")}, "stop_z"),
        ({"wavelength_range": (1e-6, 1e-7)}, "wavelength_range"),
        ({"default_wavelength": 2e-6}, "default_wavelength"),
        ({"band": (1e-7, 5e-7)}, "band"),
    ],
)
def test_impossible_telescopes_are_refused(change, message):
    fields = {name: getattr(LSST, name) for name in LSST.__dataclass_fields__} | {"group_frames": {}} | change
    with pytest.raises(PrescriptionError, match=message):
        type(LSST)(**fields)


def test_a_mirror_stays_in_its_medium():
    glass = LSST.surface("L1_entrance").medium_after
    m1 = LSST.surface("M1")
    odd = type(m1)(m1.name, Interaction.MIRROR, m1.shape, m1.vertex, glass, m1.aperture)
    fields = {name: getattr(LSST, name) for name in LSST.__dataclass_fields__}
    with pytest.raises(PrescriptionError, match="surface 'M1': expected a mirror to stay in the medium"):
        type(LSST)(**(fields | {"surfaces": (odd, *LSST.surfaces[1:])}))


def test_a_telescope_of_public_names_focuses_the_axis():
    """A paraboloid of radius 4 m has its focus 2 m above the vertex."""
    vacuum = pachon.ConstantIndex(1.0)
    mirror = pachon.Surface(
        "M1", pachon.Interaction.MIRROR, pachon.Conic(4.0, -1.0), (0, 0, 0), vacuum, pachon.models.Circle(0.5)
    )
    detector = pachon.Surface("D", pachon.Interaction.DETECTOR, pachon.Plane(), (0, 0, 2), vacuum)
    telescope = pachon.Telescope(
        name="paraboloid",
        surfaces=(mirror, detector),
        stop_z=0.0,
        pupil_diameter=1.0,
        pupil_obscuration=0.0,
        launch_distance=5.0,
        reference_sphere_radius=2.0,
        field_radius=0.01,
        field_limit=0.02,
        wavelength_range=(3e-7, 1e-6),
        default_wavelength=5e-7,
    )
    assert pachon.first_order(telescope).focal_length == pytest.approx(2.0, rel=1e-15)
    result = pachon.trace(telescope, pachon.launch_rays(telescope, (0, 0), 5e-7, ([0.1, -0.3], [0.2, 0.0])))
    assert isinstance(result, pachon.raytrace.TraceResult)
    # Rounding of 5 m.
    assert np.allclose(result.position, [0.0, 0.0, 2.0], atol=1e-14)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"shape": 4.0}, "shape = 4.0: expected a Shape"),
        ({"medium_after": 1.5}, "medium_after = 1.5: expected a Medium"),
        ({"interaction": "mirror"}, "interaction = 'mirror': expected an Interaction"),
        ({"aperture": 0.5}, "aperture = 0.5: expected one of a Circle"),
    ],
)
def test_arguments_of_a_surface_of_another_kind_are_refused(wrong, message):
    vacuum = pachon.ConstantIndex(1.0)
    right = {"shape": pachon.Plane(), "medium_after": vacuum, "interaction": pachon.Interaction.MIRROR}
    with pytest.raises(pachon.errors.DomainError, match=message):
        pachon.Surface(name="M1", vertex=(0.0, 0.0, 0.0), **right | wrong)


def test_a_rotator_turns_the_detector_alone():
    tilted = LSST.perturbed("Detector", tilt=(1e-3, -2e-3, 0.0)).perturbed("L1", tilt=(0.0, 1e-3, 0.0))
    rotated = tilted.with_rotator(30.0 * u.deg)
    assert rotated.surfaces[:-1] == tilted.surfaces[:-1]
    before, after = tilted.surfaces[-1], rotated.surfaces[-1]
    assert after.vertex == before.vertex
    # About its own normal, which keeps the tilt that it has in the telescope frame; x goes towards y.
    np.testing.assert_allclose(after.matrix[:, 2], before.matrix[:, 2], atol=1e-15)
    expected = np.cos(np.pi / 6) * before.matrix[:, 0] + np.sin(np.pi / 6) * before.matrix[:, 1]
    np.testing.assert_allclose(after.matrix[:, 0], expected, atol=1e-15)
    assert np.abs(after.matrix[:, 0] - before.matrix[:, 0]).max() > 0.1


@pytest.mark.parametrize("turns", [0.0, 1.0, -2.0])
def test_whole_turns_of_the_rotator_change_no_bit(turns):
    assert LSST.with_rotator(turns * 2.0 * np.pi) == LSST
    assert LSST.with_rotator(turns * 360.0 * u.deg) == LSST


@pytest.mark.parametrize("angle", [np.nan, np.inf, [0.1, 0.2]])
def test_an_angle_of_the_rotator_that_is_no_number_is_refused(angle):
    with pytest.raises(DomainError, match=r"angle = .*: expected one finite number"):
        LSST.with_rotator(angle)


def test_a_telescope_in_air_is_the_one_described_in_air():
    """LSST's lens table in the air of the one with baffles, which states it: spherical aberration changes by 4 nm."""
    stated = load_telescope("lsst_v3.3_r_obstructed")
    assert stated.medium_before == pachon.Air(69328.0, 293.15, 1067.0, formula="filippenko")
    field = np.deg2rad([[1.2, 0.5]])
    vacuum, in_air, expected = (
        wavefront_zernikes(telescope, field, 620e-9, jmax=22).coefficients[0]
        for telescope in (LSST, LSST.in_medium(stated.medium_before), stated)
    )
    np.testing.assert_allclose(in_air, expected, rtol=0, atol=0.02e-9)
    assert vacuum[10] - expected[10] == pytest.approx(4.3e-9, abs=0.1e-9)
