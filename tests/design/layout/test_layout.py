"""Drawings: what is drawn lies on the surfaces and on the rays, and ends at the apertures."""

import io
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from matplotlib.text import Text

import pachon
from pachon.core.plotting import png_bytes
from pachon.design.layout.layout import layout
from pachon.design.layout.meshes import surface_mesh, tubes
from pachon.design.layout.sections import find_lenses, outer_radius, surface_section
from pachon.models.aperture import Annulus, Circle, Complement, Intersection, Polygon, Rectangle, Union, Vane
from pachon.models.media.medium import ConstantIndex
from pachon.models.obstruction import Obstruction
from pachon.models.shapes.shape import Conic, Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM


def runs(points):
    """Pieces of a line that NaN breaks."""
    known = np.isfinite(points).all(axis=1)
    starts = np.flatnonzero(known & ~np.concatenate([[False], known[:-1]]))
    ends = np.flatnonzero(known & ~np.concatenate([known[1:], [False]]))
    return [points[a : b + 1] for a, b in zip(starts, ends, strict=True)]


def test_a_mirror_with_a_hole_is_two_arcs(lsst_r):
    mirror = lsst_r.surface("M1")
    left, right = runs(surface_section(mirror, 4.18))
    assert [left[0, 1], left[-1, 1], right[0, 1], right[-1, 1]] == pytest.approx([-4.18, -2.558, 2.558, 4.18], abs=1e-6)
    assert right[:, 2] == pytest.approx(mirror.shape.sag(0.0, right[:, 1]), abs=1e-12)
    assert np.all(right[:, 0] == 0.0)


def test_a_turned_surface_is_drawn_where_it_stands(lsst_r):
    moved = lsst_r.perturbed("M2", shift=(0.0, 0.1, 0.2), tilt=(0.02, 0.0, 0.0)).surface("M2")
    points = np.concatenate(runs(surface_section(moved, 1.71)))
    local = moved.to_local(points)
    assert local[:, 2] == pytest.approx(moved.shape.sag(0.0, local[:, 1]), abs=1e-12)
    assert np.ptp(local[:, 1]) == pytest.approx(3.42, abs=1e-6)


def test_of_a_baffle_what_blocks_is_drawn():
    stop = Surface("ring", Interaction.PASS, Plane(), (0.0, 0.0, 1.0), VACUUM, Complement(Annulus(0.5, 0.7)))
    left, right = runs(surface_section(stop, 0.7))
    assert [left[0, 1], left[-1, 1], right[0, 1], right[-1, 1]] == pytest.approx([-0.7, -0.5, 0.5, 0.7], abs=1e-6)


@pytest.mark.parametrize(
    ("region", "radius"),
    [
        (Circle(2.0, x=0.3, y=0.4), 2.5),
        (Annulus(1.0, 2.0), 2.0),
        (Rectangle(6.0, 8.0), 5.0),
        (Polygon(((0.0, 0.0), (3.0, 4.0), (1.0, 0.0))), 5.0),
        (Union((Circle(1.0), Circle(2.0))), 2.0),
        (Intersection((Circle(1.0), Vane(0.1))), 1.0),
        (Complement(Circle(1.0)), np.inf),
        (None, np.inf),
    ],
)
def test_how_far_a_region_reaches(region, radius):
    assert outer_radius(region) == pytest.approx(radius)


def test_lenses_and_rays_of_the_lsst(lsst_r):
    found = layout(lsst_r)
    assert [lens.name for lens in found.lenses] == ["L1", "L2", "Filter", "L3"]
    assert found.lenses[0].index == pytest.approx(1.457, abs=2e-3)
    assert found.reach["L1_entrance"] == pytest.approx(lsst_r.surface("L1_entrance").aperture.radius)
    for field, fan, bundle in zip(found.fields, found.fans, found.bundles, strict=True):
        assert fan[..., 0] == pytest.approx(0.0, abs=1e-12)
        for rays in (fan, bundle):
            # From above everything to one point of the detector, by way of every surface.
            assert rays.shape[1:] == (len(lsst_r.surfaces) + 1, 3)
            assert np.ptp(rays[:, 0, 2]) < 1e-9
            assert rays[0, 0, 2] > max(np.nanmax(p[:, 2]) for p in found.profiles.values())
            assert np.ptp(rays[:, -1], axis=0).max() < 40e-6
            assert rays[:, -1, 1].mean() == pytest.approx(10.31 * np.tan(field[1]), abs=2e-3)
    assert len(found.fans[1]) == 10
    assert found.summary()["extent_m"][2] == pytest.approx(6.6, abs=0.1)


def test_lenses_without_rims_end_where_the_light_does(paraboloid):
    telescope = paraboloid(f_number=4.0)
    glass = ConstantIndex(1.5)
    lens = (
        Surface("A", Interaction.REFRACT, Plane(), (0.0, 0.0, 1.5), glass),
        Surface("B", Interaction.REFRACT, Conic(5.0, 0.0), (0.0, 0.0, 1.52), VACUUM),
    )
    mirror, detector = telescope.surfaces
    found = layout(replace(telescope, surfaces=(mirror, *lens, detector)), wavelength=6e-7)
    # Glass whose back stands in front of it has no body that could be drawn.
    behind = replace(telescope, surfaces=(mirror, lens[0], replace(lens[1], vertex=(0.0, 0.0, 1.48)), detector))
    assert find_lenses(behind, 6e-7) == ()
    assert found.lenses[0].name == "A, B"
    # A cone from 0.25 m at the mirror to the field at the focus, seen from the edge of the field: 0.0175 m.
    assert 0.0625 < found.reach["A"] < 0.09
    assert found.reach["A"] == found.reach["B"]


def test_meshes_have_the_area_of_their_surfaces(lsst_r):
    cap = Surface("cap", Interaction.PASS, Plane(), (0.0, 0.0, 9.8), VACUUM, Complement(Circle(1.1)))
    assert surface_mesh(cap, 1.1).area == pytest.approx(np.pi * 1.1**2, rel=2e-3)
    # Polygons of 120 sides are 5e-4 smaller than circles.
    disc = Surface("disc", Interaction.MIRROR, Plane(), (0.0, 0.0, 0.0), VACUUM, Annulus(0.5, 1.0))
    assert surface_mesh(disc, 1.0).area == pytest.approx(0.75 * np.pi, rel=1e-3)
    mirror = lsst_r.surface("M1")
    local = mirror.to_local(surface_mesh(mirror, 4.18).vertices)
    assert local[:, 2] == pytest.approx(mirror.shape.sag(local[:, 0], local[:, 1]), abs=1e-12)


def test_tubes_are_thin_and_as_long_as_their_lines():
    path = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [1.0, 0.0, 2.0]]])
    mesh = tubes(path, 1e-3)
    # A prism of five sides.
    assert mesh.area == pytest.approx(3.0 * 5 * 2e-3 * np.sin(np.pi / 5), rel=1e-9)
    assert mesh.bounds == pytest.approx(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 2.0]]), abs=1.1e-3)


@pytest.mark.long
def test_a_glb_can_be_read_back_and_stands_upright():
    telescope = pachon.load_telescope("lsst_v3.3_r_obstructed")
    scene = trimesh.load_scene(io.BytesIO(layout(telescope).glb()), file_type="glb")
    assert {"M1", "M2", "M3", "L1", "Filter", "Detector", "CenterCap"} <= set(scene.geometry)
    assert sum(name.startswith("rays") for name in scene.geometry) == 3
    low, high = scene.bounds
    # y is up, and the primary's rim is as wide as it is along x and z.
    assert high[1] > 9.8
    assert -1.0 < low[1] < 0.0
    assert high[0] == pytest.approx(high[2], rel=0.01)
    assert scene.geometry["L1"].visual.material.alphaMode == "BLEND"


@pytest.mark.long
def test_obstructions_are_drawn_too(lsst_r):
    beam = trimesh.creation.box((9.0, 0.05, 0.5), transform=trimesh.transformations.translation_matrix((0, 0, 7.0)))
    telescope = replace(lsst_r, obstructions=(Obstruction.from_mesh("beam", beam),))
    found = layout(telescope)
    assert "beam" in found.scene().geometry
    assert found.fans[0][0, 0, 2] > 7.25
    assert png_bytes(found.plot()).startswith(b"\x89PNG")


@pytest.mark.long
@pytest.mark.parametrize("name", ["lsst_v3.3_r_obstructed", "paul_baker", "hsc", "auxtel"])
def test_bundled_telescopes_can_be_drawn(name):
    found = layout(pachon.load_telescope(name))
    assert png_bytes(found.plot()).startswith(b"\x89PNG")
    assert all(len(fan) for fan in found.fans)


@pytest.mark.long
@pytest.mark.parametrize("name", ["auxtel", "hsc"])
def test_names_of_surfaces_overlap_neither_each_other_nor_the_title(name):
    # AuxTel's lenses stand beside each other behind a fold; HSC's TertiarySpiderSecondPass is long.
    figure = layout(pachon.load_telescope(name)).plot()
    figure.canvas.draw()
    title = figure._suptitle.get_window_extent()
    for axes in figure.axes:
        if axes.texts[0].get_rotation():
            places = np.diff(sorted(text.get_position()[0] for text in axes.texts))
            assert places.min() > 0.024 * np.ptp(axes.get_xlim())
        else:
            # Of the text alone, without its line.
            boxes = sorted((Text.get_window_extent(text) for text in axes.texts), key=lambda box: box.y0)
            assert all(lower.y1 < upper.y0 + 1.0 for lower, upper in pairwise(boxes))
        assert max(text.get_window_extent().y1 for text in axes.texts) < title.y0


def test_the_stop_is_drawn_where_the_light_of_the_axis_ends(request):
    lens = pachon.load_telescope(request.config.rootpath / "tests/data/zmx/lens1.zmx")
    drawing = layout(lens)
    # The marginal ray of the axis, through the rim of the entrance pupil, crosses the plane of the stop, S5.
    rim = 0.5 * lens.pupil_diameter
    rays = pachon.launch_rays(lens, (0.0, 0.0), lens.default_wavelength, ([0.0], [rim]))
    crossing = pachon.trace(lens, rays, surfaces="all")[4].position[0]
    assert np.sort(drawing.stop[:, 1]) == pytest.approx([-crossing[1], crossing[1]], rel=1e-12)
    assert drawing.stop[:, 2] == pytest.approx([lens.surface("S5").vertex[2]] * 2)
    figure = drawing.plot()
    assert "stop" in [text.get_text() for axes in figure.axes for text in axes.texts]
    assert layout(pachon.load_telescope("paul_baker")).stop is None


def test_a_stop_far_in_front_leaves_the_drawing_its_room(paraboloid):
    """The line to its name left the axes, which shrank."""
    surfaces = (Surface("front", Interaction.PASS, Plane(), (0.0, 0.0, 6.0), VACUUM), *paraboloid(2.0, 10.0).surfaces)
    telescope = replace(paraboloid(2.0, 10.0), surfaces=surfaces).with_design(stop="front")
    axes = layout(telescope).plot().axes[0]
    names = [text.get_text() for text in axes.texts]
    assert "mirror" in names
    assert "stop" not in names


def test_no_ray_is_drawn_outside_the_glass(request):
    """A semi-diameter that is smaller than the light gives way to it; it stops none."""
    lens = pachon.load_telescope(request.config.rootpath / "tests/data/zmx/lens1.zmx")
    small = replace(lens, surfaces=tuple(replace(s, semi_diameter=1e-3) for s in lens.surfaces))
    drawing = layout(small)
    for place, surface in enumerate(small.surfaces):
        heights = [np.abs(fan[:, place + 1, 1]).max() for fan in drawing.fans]
        assert drawing.reach[surface.name] >= max(heights) - 1e-12, surface.name
