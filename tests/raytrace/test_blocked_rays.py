"""Rays that general apertures and solid obstructions block: kernels against NumPy, meshes against analytic baffles."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import pachon
from pachon.core.errors import PrescriptionError, UnknownNameError
from pachon.models.aperture import Annulus, Circle, Complement, Ellipse, Intersection, Polygon, Rectangle, Union, Vane
from pachon.models.io.prescription import load_telescope, save_telescope
from pachon.models.media.medium import ConstantIndex
from pachon.models.obstruction import Obstruction
from pachon.models.shapes.shape import Conic, Plane, Sphere
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope
from pachon.raytrace.rays import RayStatus
from pachon.wavefront.pupil_optics import trace_pupils

STAR = tuple(
    (0.2 + r * np.cos(a), -0.1 + r * np.sin(a))
    for r, a in zip([1.6, 0.6] * 5, 0.3 + np.arange(10) * np.pi / 5, strict=True)
)
DISC, RING, BOX = Circle(1.1, 0.2, -0.3), Annulus(0.5, 1.2, 0.1, 0.4), Rectangle(0.7, 2.2, 0.3, -0.2, 0.6)
VANE, ROD, OUTLINE = Vane(0.3, 0.2, -0.5, 2.4), Vane(0.2, 0.1, 0.3, 0.5, both_ways=True), Polygon(STAR)


def telescope_of(*surfaces, **changes):
    fields = dict(
        name="test", surfaces=surfaces, stop_z=0.0, pupil_diameter=4.0, pupil_obscuration=0.0, launch_distance=5.0,
        reference_sphere_radius=1.0, field_radius=0.1, field_limit=0.5, wavelength_range=(3e-7, 1e-6),
        default_wavelength=5e-7,
    )  # fmt: skip
    return Telescope(**(fields | changes))


def plane(name, z, aperture=None, interaction=Interaction.PASS, **more):
    return Surface(name, interaction, Plane(), (0.0, 0.0, z), VACUUM, aperture, **more)


def detector(z):
    return plane("Detector", z, interaction=Interaction.DETECTOR)


def square(n, seed=1, half=2.0):
    return np.random.default_rng(seed).uniform(-half, half, (2, n))


@pytest.mark.parametrize(
    "aperture",
    [
        BOX, VANE, ROD, OUTLINE, Ellipse(1.3, 0.5, 0.2, -0.3, 0.6), Complement(Ellipse(0.4, 1.5)),
        Complement(DISC), Complement(RING), Complement(OUTLINE),
        Union((DISC, BOX)), Intersection((DISC, BOX, OUTLINE)),
        Complement(Union((VANE, ROD, Circle(0.4)))),
        Intersection((DISC, Complement(Union((VANE, Intersection((RING, Complement(BOX)))))))),
        Union((Intersection((BOX, RING)), Complement(Union((OUTLINE, Complement(DISC)))), Intersection((ROD, DISC)))),
    ],
)  # fmt: skip
def test_general_apertures_stop_the_rays_that_their_regions_do_not_contain(aperture):
    # Tilted, so that the region is seen to be that of the surface's own x and y.
    stop = plane("stop", 0.0, aperture).moved(rotation=[[0.0, -0.8, 0.6], [1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    telescope = telescope_of(stop, detector(-1.0))
    rays = pachon.launch_rays(telescope, (0.02, -0.01), 5e-7, square(3001))
    at_stop, at_end = pachon.trace(telescope, rays, surfaces="all")
    x, y, _ = stop.to_local(at_stop.position).T
    inside = aperture.contains(x, y)
    assert 100 < inside.sum() < 2900
    # Equal to the last ray: a rim is as thin as rounding, and no ray of this seed is that near.
    assert np.array_equal(at_end.status, np.where(inside, RayStatus.OK, RayStatus.VIGNETTED))


def test_a_baffle_plane_does_not_change_the_way_of_light(lsst_r, annulus_points):
    index = 3
    baffle = plane("Baffle", 2.0, Annulus(0.3, 1.0))
    surfaces = (*lsst_r.surfaces[:index], baffle, *lsst_r.surfaces[index:])
    with_baffle = replace(lsst_r, surfaces=surfaces)
    rays = pachon.launch_rays(lsst_r, (0.01, 0.02), 620e-9, annulus_points(500))
    plain, crossed = pachon.trace(lsst_r, rays), pachon.trace(with_baffle, rays)
    # Rounding of an intermediate stop in 20 m of path.
    assert np.abs(plain.position - crossed.position).max() < 1e-14
    assert np.abs(plain.path_length - crossed.path_length).max() < 1e-13
    assert (crossed.vignetted & ~plain.vignetted).sum() > 0


def test_a_baffle_in_another_medium_is_refused():
    glass = ConstantIndex(1.5)
    with pytest.raises(PrescriptionError, match="'b': expected a baffle to stay in the medium before it"):
        telescope_of(replace(plane("b", 0.0), medium_after=glass), replace(detector(-1.0), medium_after=glass))


def ring_mesh(inner, outer, z, sections=720):
    """Triangulate a flat ring whose polygons of so many sides have the areas of the circles."""
    angle = 2 * np.pi * np.arange(sections) / sections
    # Facets cross the circle they stand for: they are off by at most r (pi/n)^2 / 2 either way.
    rim = np.sqrt(2 * np.pi / sections / np.sin(2 * np.pi / sections))
    points = np.concatenate([r * rim * np.stack([np.cos(angle), np.sin(angle)], axis=1) for r in (inner, outer)])
    a, b = np.arange(sections), (np.arange(sections) + 1) % sections
    faces = np.concatenate([np.stack([a, b, b + sections], 1), np.stack([a, b + sections, a + sections], 1)])
    return trimesh.Trimesh(np.column_stack([points, np.full(len(points), z)]), faces, process=False)


def test_a_mesh_of_baffles_blocks_the_rays_that_the_analytic_baffles_block(lsst_r, annulus_points):
    # Between M1 and M2 and between M2 and M3 too, where light runs up and down through the same plane.
    z, inner, outer = 5.0, 2.2, 2.6
    vanes = [(0.5, 2.0), (0.3, 3.0)]
    solid = [ring_mesh(inner, outer, z)]
    for angle, length in vanes:
        turn = trimesh.transformations.rotation_matrix(angle, (0, 0, 1))
        # A thin box: analytic planes at its top, and rays of 1.4 deg cross 0.01 mm of it sideways at most.
        box = trimesh.creation.box((length, 0.2, 4e-4), trimesh.transformations.translation_matrix((3.0, 0, z)))
        solid.append(box.apply_transform(turn))
    mesh = trimesh.util.concatenate(solid)
    regions = Union((Annulus(inner, outer), *(
        Rectangle(length, 0.2, 3.0 * np.cos(angle), 3.0 * np.sin(angle), angle) for angle, length in vanes
    )))  # fmt: skip
    obstructed = replace(lsst_r, obstructions=(Obstruction.from_mesh("top", mesh, before=("M1", "M2", "M3")),))
    baffles = [plane(f"plane_{i}", z, Complement(regions)) for i in range(3)]
    m1, m2, m3, *rest = lsst_r.surfaces
    analytic = replace(lsst_r, surfaces=(baffles[0], m1, baffles[1], m2, baffles[2], m3, *rest))
    rays = pachon.launch_rays(lsst_r, (0.015, -0.02), 620e-9, annulus_points(20000))
    ours, peer = pachon.trace(obstructed, rays), pachon.trace(analytic, rays)
    plain = pachon.trace(lsst_r, rays)
    assert np.array_equal(ours.position, plain.position)
    blocked, expected = (r.vignetted & ~plain.vignetted for r in (ours, peer))
    assert expected.sum() > 1000
    # What may differ lies within 20 um of a rim (facets 2.6 m * (pi/720)^2 / 2 = 25 um, half of it either way;
    # thickness 10 um; single precision 2 um): of 20000 rays over 39 m^2 that cross 60 m of rims, less than one.
    assert np.count_nonzero(blocked != expected) <= 3


def test_a_soup_of_triangles_blocks_as_the_closed_mesh_does():
    sphere = trimesh.creation.icosphere(4, 0.8).apply_translation((0.3, 0.0, 1.0))
    soup = sphere.triangles[np.random.default_rng(2).permutation(len(sphere.faces))]
    # Turned over, doubled, and with a quarter of the back taken away: what faces the light still stops it.
    upper = soup[soup[:, :, 2].mean(axis=1) > 0.9]
    telescope = telescope_of(plane("a", 0.0), detector(-1.0))
    rays = pachon.launch_rays(telescope, (0.0, 0.0), 5e-7, square(4000))
    results = [
        pachon.trace(replace(telescope, obstructions=(Obstruction("ball", t),)), rays).vignetted
        for t in (sphere.triangles, soup, soup[:, ::-1], np.concatenate([soup, soup]), upper)
    ]
    assert all(np.array_equal(results[0], r) for r in results[1:])
    # Closed form, but for the facets: 2562 corners on the sphere, whose edges lie within 1 % of its radius.
    r = np.hypot(rays.position[:, 0] - 0.3, rays.position[:, 1])
    assert results[0][r < 0.79].all()
    assert not results[0][r > 0.8].any()


def test_rays_that_start_inside_a_closed_mesh_are_blocked_where_they_leave_it():
    shell = Obstruction.from_mesh("shell", trimesh.creation.box((3.0, 3.0, 3.0)))
    telescope = telescope_of(plane("a", 1.0), detector(-1.2), obstructions=(shell,), launch_distance=1.6)
    inside = pachon.launch_rays(telescope, (0.0, 0.0), 5e-7, square(100, half=1.4))
    inside = replace(inside, position=inside.position * (1, 1, 0) + (0, 0, 1.2))
    assert not pachon.trace(telescope, inside).vignetted.any()
    longer = replace(telescope, surfaces=(plane("a", 1.0), detector(-2.0)))
    assert pachon.trace(longer, inside).vignetted.all()


def test_ways_that_an_obstruction_blocks():
    glass = ConstantIndex(1.5)
    lens = (
        Surface("front", Interaction.REFRACT, Sphere(-9.0), (0, 0, 1.0), glass),
        Surface("back", Interaction.REFRACT, Plane(), (0, 0, 0.0), VACUUM),
    )
    rays = pachon.launch_rays(telescope_of(plane("x", 0.0)), (0.0, 0.0), 5e-7, ([0.1, 0.5], [0.0, 0.1]))

    def blocked(z, before=None):
        sheet = Obstruction.from_mesh("sheet", ring_mesh(1e-6, 3.0, z, 16), before=before)
        telescope = telescope_of(plane("b", 3.0), *lens, plane("c", -0.5), detector(-2.0), obstructions=(sheet,))
        vignetted = [r.vignetted for r in pachon.trace(telescope, rays, surfaces="all")]
        assert all(v.all() or not v.any() for v in vignetted)
        return [bool(v.all()) for v in vignetted]

    assert blocked(4.0) == [True] * 5
    assert blocked(2.0) == [False, True, True, True, True]
    # Inside the lens nothing stands, unless it is said so.
    assert blocked(0.5) == [False] * 5
    assert blocked(0.5, ("back",)) == [False, False, True, True, True]
    # The baffle plane in between belongs to the way to the detector.
    assert blocked(-0.3) == [False, False, False, True, True]
    assert blocked(-0.3, ("Detector",)) == [False, False, False, True, True]
    assert blocked(-1.0, ("Detector",)) == [False, False, False, False, True]
    assert blocked(-1.0, ("front",)) == [False] * 5
    assert blocked(4.0, ("front",)) == [True] * 5


def test_what_touches_a_mirror_does_not_darken_it():
    mirror = Surface("M", Interaction.MIRROR, Conic(8.0, -1.0), (0, 0, 0), VACUUM)
    telescope = telescope_of(mirror, detector(4.0))
    x, y = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9))
    points = np.stack([x, y, (x**2 + y**2) / 16], axis=-1)
    corner = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    facets = np.concatenate([np.stack(corner[:3], 2), np.stack([corner[0], *corner[2:]], 2)]).reshape(-1, 3, 3)
    lower = Obstruction("cell", facets - (0, 0, 1e-3))
    rays = pachon.launch_rays(telescope, (0.0, 0.0), 5e-7, (points[::2, ::2, 0].ravel(), points[::2, ::2, 1].ravel()))
    assert not pachon.trace(replace(telescope, obstructions=(lower,)), rays).vignetted.any()


def test_the_image_engines_see_obstructions(lsst_r):
    # Half of the pupil dark, as a disc over it: the wavefront's flags are those of the trace.
    half = Obstruction.from_mesh("half", trimesh.creation.box((5.0, 10.0, 0.1)).apply_translation((2.5, 0.0, 8.0)))
    dark = replace(lsst_r, obstructions=(half,))
    axis = np.linspace(-4.1, 4.1, 24)
    pupil = np.meshgrid(axis, axis)
    both = [pachon.wavefront_opd(t, (0.0, 0.0), 620e-9, pupil).lit for t in (lsst_r, dark)]
    assert np.array_equal(both[1], both[0] & (pupil[0] < 0))
    assert both[1].sum() > 100
    # And so is what the engines of images take their light from.
    points = np.stack([p.ravel() for p in pupil], axis=-1)
    both = [trace_pupils(t, np.zeros((1, 2)), np.array([620e-9]), points).lit[0, 0] for t in (lsst_r, dark)]
    assert np.array_equal(both[1], both[0] & (points[:, 0] < 0))


def test_obstructions_are_written_and_read(tmp_path, lsst_r):
    mesh = trimesh.creation.annulus(0.5, 0.6, 0.2).apply_translation((0, 0, 5.0))
    mesh.apply_scale(1000.0)
    mesh.export(tmp_path / "tube.stl")
    save_telescope(lsst_r, tmp_path / "mine.yaml")
    text = (tmp_path / "mine.yaml").read_text()
    listed = "obstructions:\n  - {name: tube, file: tube.stl, scale: 0.001, before: [M1, M3]}\nsurfaces:"
    (tmp_path / "mine.yaml").write_text(text.replace("surfaces:\n", listed + "\n", 1))
    telescope = load_telescope(tmp_path / "mine.yaml")
    (tube,) = telescope.obstructions
    assert tube.before == ("M1", "M3")
    assert np.allclose(tube.triangles, mesh.triangles / 1000, atol=1e-6)
    (tmp_path / "tube.stl").unlink()
    save_telescope(telescope, tmp_path / "again.yaml")
    assert load_telescope(tmp_path / "again.yaml") == telescope
    assert hash(load_telescope(tmp_path / "again.yaml")) == hash(telescope)
    glb = tmp_path / "tube.glb"
    mesh.export(glb)
    assert np.allclose(Obstruction.from_file(glb, scale=1e-3).mesh.bounds, tube.mesh.bounds, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda t: Obstruction("x", np.empty((0, 3, 3))), "obstruction 'x': mesh of shape .*: expected at least one"),
        (lambda t: Obstruction("x", np.full((2, 3, 3), np.nan)), "'x': 2 of 2 triangles: expected finite corners"),
        (lambda t: Obstruction("x", np.zeros((1, 3, 3)), ()), "'x': before = .*: expected names of surfaces"),
        (lambda t: Obstruction.from_mesh("x", trimesh.creation.box(), scale=0.0), "scale = 0.0: expected a positive"),
        (lambda t: Obstruction.from_file("box.step"), "box.step: expected a mesh file that ends in .stl"),
        (lambda t: Obstruction.from_file("box.stl"), "box.stl: no such file"),
        (lambda t: replace(t, obstructions=(Obstruction("x", np.ones((1, 3, 3)), ("M9",)),)), "unknown mirror, lens"),
        (lambda t: replace(t, obstructions=(Obstruction("x", np.full((1, 3, 3), 99.0)),)), "reaches z = 99 m: exp"),
        (lambda t: replace(t, obstructions=(Obstruction("x", np.ones((1, 3, 3))),) * 2), "'x' occurs more than once"),
    ],
)  # fmt: skip
def test_impossible_obstructions_are_refused(lsst_r, make, message):
    with pytest.raises((PrescriptionError, UnknownNameError), match=message):
        make(lsst_r)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "cannot be read as a mesh|expected a mesh with at least one triangle"),
        (b"not a mesh at all", "cannot be read as a mesh|expected a mesh with at least one triangle"),
        (b"solid x\nendsolid x\n", "cannot be read as a mesh|expected a mesh with at least one triangle"),
    ],
)
def test_a_file_that_is_no_mesh_is_refused_in_one_line(tmp_path, content, message):
    (tmp_path / "bad.stl").write_bytes(content)
    with pytest.raises(PrescriptionError, match=message) as raised:
        Obstruction.from_file(tmp_path / "bad.stl")
    assert "\n" not in str(raised.value)
    assert "bad.stl" in str(raised.value)


def test_a_mesh_with_corners_that_are_not_finite_is_refused(tmp_path):
    mesh = trimesh.creation.box()
    mesh.vertices[3, 2] = np.nan
    mesh.export(tmp_path / "bad.stl")
    with pytest.raises(PrescriptionError, match=r"bad\.stl: obstruction 'bad': .* triangles: expected finite corners"):
        Obstruction.from_file(tmp_path / "bad.stl")


def test_obstructions_are_added_to_those_that_are_there():
    triangles = trimesh.creation.box((1.0, 1.0, 0.2)).triangles
    one = Obstruction("one", triangles + np.array([-1.0, 0.0, 2.0]))
    two = Obstruction("two", triangles + np.array([1.0, 0.0, 2.0]))
    clear = telescope_of(detector(0.0))
    blocked = clear.with_obstructions(one).with_obstructions(two)
    x = np.array([-1.0, 0.0, 1.0])
    rays = pachon.launch_rays(blocked, (0.0, 0.0), 5e-7, (x, np.zeros(3)))
    assert not pachon.trace(clear, rays).vignetted.any()
    assert pachon.trace(blocked, rays).vignetted.tolist() == [True, False, True]
    with pytest.raises(PrescriptionError, match="one"):
        blocked.with_obstructions(one)
