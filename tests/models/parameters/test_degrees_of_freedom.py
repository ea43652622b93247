"""Degrees of freedom against batoid, against changes made by hand, and against central differences."""

import dataclasses
import json

import batoid
import numpy as np
import pytest
from astropy import units as u
from astropy.table import Table

import pachon
from pachon.commands.cli import main
from pachon.core.errors import ConfigError, DomainError, PachonError, PrescriptionError, UnknownNameError
from pachon.design.optimize.sensitivity import sensitivity
from pachon.design.optimize.sensitivity_file import write_sensitivity
from pachon.models.io.grid_file import write_grid
from pachon.models.parameters.degrees_of_freedom import DegreeOfFreedom, DegreesOfFreedom, SurfaceDeformation, unit_size
from pachon.models.parameters.degrees_of_freedom_file import load_degrees_of_freedom
from pachon.models.parameters.parameters import apply
from pachon.models.parameters.thermal import thermal
from pachon.models.shapes.freeform import OddAsphere, Toroid
from pachon.models.shapes.grid import GridSag
from pachon.models.shapes.modes import GridModes
from pachon.models.shapes.polynomial import ZernikeSag
from pachon.models.shapes.shape import EvenAsphere, Plane

ARCSEC = np.deg2rad(1.0 / 3600.0)
FIELD, WAVELENGTH = (0.012, -0.021), 620e-9
NODES = np.linspace(-4.5, 4.5, 41)


@pytest.fixture(scope="module")
def dof():
    return load_degrees_of_freedom("lsst")


def waves(term, scale=1.0):
    """A smooth map over M1 and M3 on nodes of 225 mm [m]."""
    x, y = np.meshgrid(NODES, NODES)
    return GridSag(NODES, NODES, scale * np.cos(0.7 * term * x + 0.3) * np.sin(0.5 * y + term))


@pytest.fixture(scope="module")
def maps():
    """Two modes of M1 and M3 on one grid, and two that move several things at once."""
    modes = SurfaceDeformation("bend", ("M1", "M3"), GridModes({"B1": waves(1), "B2": waves(2)}))
    zernikes = SurfaceDeformation("print", ("M2",), ZernikeSag((0.0,) * 11, 1.71, 0.9))
    members = (
        DegreeOfFreedom("first", "um", {"bend.B1": 1.0}),
        DegreeOfFreedom("second", "um", {"bend.B2": 1.0, "print.Z11": -0.2, "M2.dz": 3.0}),
        DegreeOfFreedom("tilt", "arcsec", {"Camera.rx": 1.0, "M2.rx": -0.5, "M2.dy": 6.0}),
    )
    return DegreesOfFreedom(members, (modes, zernikes), "maps")


def test_the_bundled_vector(dof):
    assert len(dof) == 50
    assert dof.names[:6] == ("M2_dz", "M2_dx", "M2_dy", "M2_rx", "M2_ry", "Camera_dz")
    assert dof.names[10] == "M1M3_B1"
    assert dof.names[30] == "M2_B1"
    assert dof.names[-1] == "M2_B20"
    assert set(dof.units) == {"um", "arcsec"}
    # The bending modes are no true ones, and the file says so to whoever reads what it is.
    assert "stand-ins" in dof.description


def test_rigid_bodies_are_perturbed(lsst_r, dof):
    values = {"M2_dz": 30.0, "M2_rx": 4 * u.arcsec, "Camera_dx": 0.2 * u.mm, "Camera_ry": -3.0}
    by_hand = lsst_r.perturbed("Camera", shift=(200e-6, 0, 0), tilt=(0, -3 * ARCSEC, 0))
    by_hand = by_hand.perturbed("M2", shift=(0, 0, 30e-6), tilt=(4 * ARCSEC, 0, 0))
    moved = dof.apply(lsst_r, values)
    for one, other in zip(moved.surfaces, by_hand.surfaces, strict=True):
        # Micrometres become metres by a factor: rounding.
        assert np.allclose(one.vertex, other.vertex, rtol=0, atol=1e-15)
        assert np.allclose(one.matrix, other.matrix, rtol=0, atol=1e-15)
    assert dof.vector(values)[6] == pytest.approx(200.0)
    assert dof.apply(lsst_r, np.zeros(50)) is lsst_r


def test_a_whole_vector_against_batoid(lsst_r, dof, annulus_points):
    rng = np.random.default_rng(3)
    vector = rng.normal(size=50) * np.where(np.array(dof.units) == "arcsec", 5.0, 20.0)
    vector[10:] *= 0.01
    named = dict(zip(dof.names, vector, strict=True))
    bend = {label: [0.0] * 4 + [1e-6 * named[f"{label}_B{k}"] for k in range(1, 21)] for label in ("M1M3", "M2")}
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    for name in ("M1", "M3"):
        optic = optic.withPerturbedSurface(f"LSST.{name}", batoid.Zernike(bend["M1M3"], 4.18, 0.55))
    optic = optic.withPerturbedSurface("LSST.M2", batoid.Zernike(bend["M2"], 1.71, 0.9))
    for body, place in (("M2", "LSST.M2"), ("Camera", "LSST.LSSTCamera")):
        turn = batoid.RotX(named[f"{body}_rx"] * ARCSEC) @ batoid.RotY(named[f"{body}_ry"] * ARCSEC)
        optic = optic.withLocallyRotatedOptic(place, turn)
        optic = optic.withGloballyShiftedOptic(
            place, 1e-6 * np.array([named[f"{body}_{m}"] for m in ("dx", "dy", "dz")])
        )
    pupil = annulus_points(200)
    rays = batoid.RayVector.fromStop(
        *pupil, optic=optic, wavelength=WAVELENGTH, theta_x=FIELD[0], theta_y=FIELD[1], projection="zemax"
    )
    optic.trace(rays)
    telescope = dof.apply(lsst_r, vector)
    ours = pachon.trace(telescope, pachon.launch_rays(telescope, FIELD, WAVELENGTH, pupil))
    theirs = rays.toCoordSys(batoid.CoordSys()).r
    # The undisturbed rays are hundreds of micrometres away.
    still = pachon.trace(lsst_r, pachon.launch_rays(lsst_r, FIELD, WAVELENGTH, pupil))
    assert np.abs(still.position - theirs).min(axis=0)[:2].max() > 1e-5
    # Two traces through twelve surfaces, batoid's Newton steps ending at 1e-14 m.
    assert np.abs(ours.position - theirs).max() < 1e-12
    path = ours.path_length - ours.path_length[0] - (rays.t - rays.t[0])
    assert np.abs(path).max() < 1e-12


def test_maps_against_batoid(lsst_r, maps, annulus_points):
    pupil = annulus_points(200)
    telescope = maps.apply(lsst_r, {"first": 0.7, "second": -0.4})
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    grid = 1e-6 * (0.7 * waves(1).values - 0.4 * waves(2).values)
    for name in ("M1", "M3"):
        optic = optic.withPerturbedSurface(f"LSST.{name}", batoid.Bicubic(NODES, NODES, grid))
    coefficients = np.zeros(12)
    coefficients[11] = 0.4e-6 * 0.2
    optic = optic.withPerturbedSurface("LSST.M2", batoid.Zernike(coefficients, 1.71, 0.9))
    optic = optic.withGloballyShiftedOptic("LSST.M2", [0, 0, -0.4e-6 * 3.0])
    rays = batoid.RayVector.fromStop(
        *pupil, optic=optic, wavelength=WAVELENGTH, theta_x=FIELD[0], theta_y=FIELD[1], projection="zemax"
    )
    optic.trace(rays)
    ours = pachon.trace(telescope, pachon.launch_rays(telescope, FIELD, WAVELENGTH, pupil))
    assert np.abs(ours.position - rays.toCoordSys(batoid.CoordSys()).r).max() < 1e-12
    path = ours.path_length - ours.path_length[0] - (rays.t - rays.t[0])
    assert np.abs(path).max() < 1e-12


def test_maps_from_files(tmp_path, lsst_r, maps):
    for mode in ("B1", "B2"):
        write_grid(maps.deformations[0].shape.modes[mode], tmp_path / f"{mode}.fits")
    (tmp_path / "modes.yaml").write_text(
        "name: maps\n"
        "figures:\n"
        "  bend: {surfaces: [M1, M3], grids: {B1: B1.fits, B2: B2.fits}}\n"
        "  print: {surfaces: [M2], zernike: {outer_radius: 1.71, inner_radius: 0.9, terms: 11}}\n"
        "degrees_of_freedom:\n"
        "  - {name: first, unit: um, of: bend.B1}\n"
        "  - {name: second, unit: um, of: {bend.B2: 1.0, print.Z11: -0.2, M2.dz: 3.0}}\n"
        "  - {name: tilt, unit: arcsec, of: {Camera.rx: 1.0, M2.rx: -0.5, M2.dy: 6.0}}\n"
    )
    read = load_degrees_of_freedom(tmp_path / "modes.yaml")
    assert read == maps
    assert read.apply(lsst_r, [0.1, 0.2, 0.3]) == maps.apply(lsst_r, [0.1, 0.2, 0.3])


def test_sensitivity_is_central_differences(lsst_r, maps):
    fields = np.array([[0.0, 0.0], [0.01, 0.02]])
    found = pachon.sensitivity(lsst_r, maps, fields, n_zernike=15)
    assert found.matrix.shape == (2, 15, 3)
    assert found.parameters.names == ("first", "second", "tilt")
    assert found.parameters.units == ("um", "um", "arcsec")
    for i, step in enumerate((0.05, 0.05, 2.0)):
        # Fourth order; the same rays stay lit. The rounding of the paths is 1e-14 m over changes of 1e-7 m.
        ends = []
        for n in (-2, -1, 1, 2):
            vector = np.zeros(3)
            vector[i] = n * step
            ends.append(sensitivity(maps.apply(lsst_r, vector), ["M2.dz"], fields, n_zernike=15).zernikes)
        difference = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)
        assert np.abs(difference - found.matrix[..., i]).max() < 1e-6 * np.abs(difference).max()


@pytest.mark.parametrize("addresses", [None, ["M2.dz", "Camera.rx", "M1.Z5"]])
def test_parameters_of_a_sensitivity_can_be_applied(lsst_r, maps, addresses):
    fields = np.array([[0.0, 0.0], [0.01, 0.02]])
    if addresses is None:
        found, values = pachon.sensitivity(lsst_r, maps, fields, n_zernike=11), np.array([0.02, -0.01, 0.3])
    else:
        found, values = sensitivity(lsst_r, addresses, fields, n_zernike=11), np.array([1e-7, 1e-6, -2e-8])
    moved = found.parameters.apply(lsst_r, values)
    assert moved == (
        maps.apply(lsst_r, values) if addresses is None else apply(lsst_r, dict(zip(addresses, values, strict=True)))
    )
    change = sensitivity(moved, ["M2.dz"], fields, n_zernike=11).zernikes - found.zernikes
    # To first order.
    assert np.abs(change).max() > 1e-9
    assert found.matrix @ values == pytest.approx(change, abs=1e-3 * np.abs(change).max())


def test_tables_of_sensitivities_have_units_of_degrees_of_freedom(lsst_r, maps, tmp_path):
    write_sensitivity(tmp_path / "matrix.ecsv", pachon.sensitivity(lsst_r, maps, [[0.0, 0.01]], n_zernike=4))
    table = Table.read(tmp_path / "matrix.ecsv")
    assert table["first"].unit == u.m / u.um
    assert table["tilt"].unit == u.m / u.arcsec


def test_deformations_beside_those_that_a_surface_has(lsst_r, dof, annulus_points):
    """Bending twice is bending by the sum, though the mirror has a Zernike sag, of other rims, already."""
    pupil = annulus_points(60)
    start = lsst_r.with_deformation("M1", ZernikeSag((0, 0, 0, 0, 2e-7, 1e-7), 4.18, 2.558))
    twice = dof.apply(dof.apply(start, {"M1M3_B2": 0.1, "M2_B4": 0.3}), {"M1M3_B2": 0.2, "M1M3_B9": 0.1})
    once = dof.apply(start, {"M1M3_B2": 0.3, "M1M3_B9": 0.1, "M2_B4": 0.3})
    one, other = (pachon.wavefront_opd(t, FIELD, WAVELENGTH, pupil).value for t in (once, twice))
    assert np.abs(one - other).max() < 1e-13
    plain = pachon.wavefront_opd(start, FIELD, WAVELENGTH, pupil).value
    assert np.abs(one - plain).max() > 1e-7


def test_the_camera_rotator(lsst_r):
    """The image turns the other way on a camera that turns; the telescope's light knows nothing of it."""
    angle = np.deg2rad(30.0)
    turned = lsst_r.perturbed("Camera", tilt=(0.0, 0.0, angle))
    pupil = ([3.0, 0.0, -3.5], [0.5, 3.3, -1.0])
    still, moved = (pachon.trace(t, pachon.launch_rays(t, FIELD, WAVELENGTH, pupil)) for t in (lsst_r, turned))
    # Lenses are round: rounding.
    assert np.abs(moved.position - still.position).max() < 1e-13
    on_still, on_turned = (t.surfaces[-1].to_local(still.position) for t in (lsst_r, turned))
    back = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    assert np.abs(on_turned - on_still @ back.T).max() < 1e-13
    # A deformation of a lens, and the CCDs, go with it.
    deformation = ZernikeSag((0, 0, 0, 0, 3e-7, 0, 1e-7), 0.775)
    asked = lsst_r.with_deformation("L1_entrance", deformation).perturbed("Camera", tilt=(0.0, 0.0, angle))
    cos, sin = np.cos(angle), np.sin(angle)
    field = (
        np.arctan(cos * np.tan(FIELD[0]) - sin * np.tan(FIELD[1])),
        np.arctan(sin * np.tan(FIELD[0]) + cos * np.tan(FIELD[1])),
    )
    x, y = np.array(pupil)
    one = pachon.wavefront_opd(lsst_r.with_deformation("L1_entrance", deformation), FIELD, WAVELENGTH, pupil)
    other = pachon.wavefront_opd(asked, field, WAVELENGTH, (cos * x - sin * y, sin * x + cos * y))
    assert np.abs(one.value - other.value).max() < 1e-13
    ccds = pachon.FocalPlane.flat("lsst")
    end = pachon.trace(turned, pachon.launch_rays(turned, FIELD, WAVELENGTH, pupil), focal_plane=ccds)
    assert np.array_equal(end.ccd, ccds.ccd_at(on_turned[:, 0], on_turned[:, 1]))
    assert not np.array_equal(end.ccd, ccds.ccd_at(on_still[:, 0], on_still[:, 1]))


def test_uniform_expansion_is_a_larger_telescope(lsst_r, annulus_points):
    """Rays of a telescope 1 + s times as large, launched 1 + s times as far out, land 1 + s times as far out."""
    stretch = 2e-6
    bare = dataclasses.replace(
        lsst_r, surfaces=tuple(dataclasses.replace(s, aperture=None) for s in lsst_r.surfaces), obstructions=()
    )
    temperature = DegreesOfFreedom((thermal(bare, 1e-7),))
    warm = temperature.apply(bare, {"temperature": 20 * u.K})
    rays = pachon.launch_rays(bare, FIELD, WAVELENGTH, annulus_points(50))
    cold, far = (
        pachon.trace(t, dataclasses.replace(rays, position=rays.position * s))
        for t, s in ((bare, 1.0), (warm, 1.0 + stretch))
    )
    # Second order of the expansion: 4e-12 of the aspheric terms, whose powers change by up to -7 times the expansion.
    assert np.abs(far.position - (1.0 + stretch) * cold.position).max() < 1e-11
    assert np.abs(far.position - cold.position).max() > 5e-6


def test_a_lens_that_warms_up(lsst_r):
    warm = DegreesOfFreedom((thermal(lsst_r, {"L1_entrance": 5e-7}, {"L1_entrance": 1e-5}),)).apply(lsst_r, [10.0])
    name = "L1_entrance"
    assert warm.surface(name).shape.radius == pytest.approx(lsst_r.surface(name).shape.radius * (1 + 5e-6), rel=1e-15)
    assert warm.surface(name).vertex[2] == pytest.approx(lsst_r.surface(name).vertex[2] * (1 + 5e-6), rel=1e-15)
    change = warm.surface(name).medium_after.index(6e-7) - lsst_r.surface(name).medium_after.index(6e-7)
    assert change == pytest.approx(1e-4, rel=1e-9)
    assert warm.surface("L1_exit") == lsst_r.surface("L1_exit")


@pytest.mark.parametrize(
    "shape",
    [
        Toroid(4.0, -6.0, -0.7, (2e-3, -1e-3)),
        OddAsphere(5.0, -0.5, (1e-3, 2e-3, -3e-3)),
    ],
)
def test_a_warm_shape_is_a_larger_one(lsst_r, shape):
    warm = DegreesOfFreedom((thermal(lsst_r.with_shape("M1", shape), {"M1": 1e-6}),))
    larger = warm.apply(lsst_r.with_shape("M1", shape), [1.0]).surface("M1").shape
    x, y = np.random.default_rng(1).uniform(-0.6, 0.6, (2, 20))
    grown = (1.0 + 1e-6) * shape.sag(x / (1.0 + 1e-6), y / (1.0 + 1e-6))
    # Second order of the expansion, and rounding.
    assert np.abs(larger.sag(x, y) - grown).max() < 1e-14
    assert np.abs(shape.sag(x, y) - grown).max() > 1e-8


def test_lines_of_a_warm_grating_are_farther_apart(lsst_r):
    grating = pachon.models.Grating(1, 100.0)
    surfaces = tuple(dataclasses.replace(s, grating=grating if s.name == "M2" else None) for s in lsst_r.surfaces)
    telescope = dataclasses.replace(lsst_r, surfaces=surfaces)
    warm = DegreesOfFreedom((thermal(telescope, {"M2": 2e-5}),)).apply(telescope, [10.0])
    assert warm.surface("M2").grating.lines_per_mm == pytest.approx(100.0 * (1.0 - 2e-4), rel=1e-12)


def test_powers_of_lengths():
    shape = EvenAsphere(2.0, -1.0, (0.0, 3.0))
    surface = pachon.load_telescope("lsst_v3.3_r").surface("M1")
    telescope = pachon.load_telescope("lsst_v3.3_r").with_shape("M1", shape)
    assert thermal(telescope, {"M1": 1e-6}).of == {"M1.radius": 2e-6, "M1.a6": pytest.approx(-15e-6)}
    assert surface.vertex == (0.0, 0.0, 0.0)
    assert thermal(telescope.with_shape("M1", Plane()), {"M1": 1e-6}).of == {}


def test_selection_and_addresses(lsst_r, dof):
    two = dof.select(["Camera_dz", "M2_dz"])
    assert two.names == ("Camera_dz", "M2_dz")
    plain = DegreesOfFreedom.of_parameters(lsst_r, ["M2.rx", "Camera.dz", "M1.conic"])
    assert plain.units == ("rad", "m", "1")
    assert plain.apply(lsst_r, [0.0, 1e-5, 0.0]) == lsst_r.perturbed("Camera", shift=(0, 0, 1e-5))


@pytest.mark.parametrize(("text", "size"), [("um", 1e-6), ("arcsec", ARCSEC), ("K", 1.0), ("1", 1.0), ("mm", 1e-3)])
def test_units(text, size):
    assert unit_size(text) == pytest.approx(size, rel=1e-14)


def test_modes_know_themselves():
    grids = {"B1": waves(1), "B2": waves(2)}
    modes = GridModes(grids)
    changed = modes.with_parameter("B2", 2e-7)
    assert changed == GridModes(grids, {"B2": 2e-7})
    # At zero both are flat, and still not the same: their derivatives differ.
    assert modes != GridModes({"B1": waves(1), "B2": waves(3)})
    assert hash(modes) != hash(changed)
    x, y = np.array([0.3, -2.0]), np.array([1.0, 0.7])
    f, fx, fy = changed.sag_derivative("B1", x, y)
    assert np.array_equal(f, waves(1).sag(x, y))
    assert np.array_equal((fx, fy), waves(1).gradient(x, y))
    assert np.allclose(changed.sag(x, y), 2e-7 * waves(2).sag(x, y), rtol=1e-14)
    assert "B2: 2e-07" in repr(changed)
    with pytest.raises(PrescriptionError, match="nodes of mode 'B1'"):
        GridModes({"B1": waves(1), "B2": GridSag(NODES * 2, NODES, waves(1).values)})
    with pytest.raises(PrescriptionError, match="at least one map"):
        GridModes({})


@pytest.mark.parametrize(
    ("values", "error", "words"),
    [
        ({"M2_dzz": 1.0}, UnknownNameError, "M2_dz"),
        ({"M2_dz": 1.0 * u.arcsec}, DomainError, "expected a unit like um"),
        ({"M2_dz": np.nan}, DomainError, "M2_dz = nan"),
        (np.zeros(49), DomainError, r"expected \[50\]"),
    ],
)
def test_bad_values(lsst_r, dof, values, error, words):
    with pytest.raises(error, match=words):
        dof.apply(lsst_r, values)


def test_a_telescope_that_lacks_a_body(dof):
    with pytest.raises(PachonError, match=r"degree of freedom 'M2_dz'.*'M2'"):
        dof.apply(pachon.load_telescope("decam"), {"M2_dz": 1.0})


GOOD = "name: a\ndegrees_of_freedom:\n  - {name: one, unit: um, of: M2.dz}\n"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("unit: um", "unit: furlongs", "'one'.*furlongs"),
        ("unit: um", "unit: kg", "'one'.*kg"),
        ("of: M2.dz", "of: {}", "expected an address"),
        ("of: M2.dz", "of: {M2.dz: much}", "M2.dz = 'much': expected a number"),
        ("name: one,", "nam: one,", "nam"),
        ("  - {name", "  - {name: one, unit: um, of: M2.dx}\n  - {name", "'one' occurs more than once"),
        ("name: a", "name: a\nfigures: {f: {surfaces: [M1]}}", "one of zernike, grids, hdf5"),
        ("name: a", "name: a\nfigures: {f: {surfaces: [M1], grids: {}}}", "names of modes"),
        ("name: a", "name: a\nfigures: {f: {surfaces: [M1], grids: {B1: no.fits}}}", "no such file"),
        ("name: a", "name: a\nfigures: {f: {surfaces: [M1], zernike: {outer_radius: 1, terms: 2.5}}}", "terms"),
        (
            "name: a",
            "name: a\nfigures: {f: {surfaces: [M1], zernike: {outer_radius: 1, inner_radius: 2, terms: 2}}}",
            "inner",
        ),
    ],
)
def test_bad_files(tmp_path, old, new, words):
    path = tmp_path / "bad.yaml"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(PrescriptionError, match=words) as caught:
        load_degrees_of_freedom(path)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("deformation", "of", "words"),
    [
        ("f", "f.Z9", "unknown mode of deformation f"),
        ("f", "f", "unknown term|expected"),
        ("M2", "M2.Z1", "has the name of a surface"),
        ("f", "M9.dz", "M9"),
        ("f", "M2.dq", "dq"),
    ],
)
def test_bad_combinations(lsst_r, deformation, of, words):
    shape = ZernikeSag((0.0,) * 4, 1.0)
    dof = DegreesOfFreedom(
        (DegreeOfFreedom("one", "um", {of: 1.0}),), (SurfaceDeformation(deformation, ("M1",), shape),)
    )
    with pytest.raises(PachonError, match=f"degree of freedom 'one'.*({words})"):
        dof.apply(lsst_r, [1.0])


def test_bad_beginnings():
    with pytest.raises(UnknownNameError, match="lsst"):
        load_degrees_of_freedom("lsts")
    with pytest.raises(PrescriptionError, match="no such file"):
        load_degrees_of_freedom("nowhere.yaml")
    with pytest.raises(ConfigError, match="at least one"):
        DegreesOfFreedom(())


def test_bad_temperatures(lsst_r):
    with pytest.raises(DomainError, match="dn_dt of M1"):
        thermal(lsst_r, 1e-6, {"M1": 1e-5})
    with pytest.raises(DomainError, match="expansion of M1"):
        thermal(lsst_r, {"M1": np.inf})
    with pytest.raises(UnknownNameError, match="M9"):
        thermal(lsst_r, {"M9": 1e-6})


@pytest.mark.long
def test_the_command(tmp_path, monkeypatch, capsys, lsst_r, dof):
    monkeypatch.chdir(tmp_path)
    place = ["--field-deg", "0,1", "--zernikes", "11"]
    assert main(["sensitivity", "lsst_v3.3_r", "--degrees-of-freedom", "lsst", "--json", *place]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["parameters"] == list(dof.names)
    assert shown["units"][3] == "arcsec"
    expected = pachon.sensitivity(lsst_r, dof, np.deg2rad([[0.0, 1.0]]), n_zernike=11).matrix
    # JSON has nine digits.
    assert np.allclose(shown["matrix_m_per_unit"], expected, rtol=1e-8, atol=1e-12 * np.abs(expected).max())
    assert (tmp_path / "sensitivity_lsst_v3.3_r.fits").is_file()
    for wrong in (["--degrees-of-freedom", "lsts"], ["--degrees-of-freedom", "lsst", "--parameters", "M2.dz"]):
        assert main(["sensitivity", "lsst_v3.3_r", *wrong]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
