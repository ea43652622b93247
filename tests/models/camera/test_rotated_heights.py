"""Heights of rectangular and rotated CCDs: one surface, whatever the CCD's own axes."""

import numpy as np
import pytest

from pachon import FocalPlane
from pachon.models import Camera, height_statistics
from pachon.models.camera.ccd_surfaces import CcdSurfaces
from pachon.models.shapes.shape import Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM
from pachon.raytrace.detector import land_bundle, land_on_ccds

PIXEL = 15e-6
CENTERS = np.array([[-0.05, 0.01], [0.05, -0.02], [0.0, 0.12]])
PIXELS = np.array([[2048, 4176], [1000, 3000], [2500, 2500]])


def camera(angles, pixels=PIXELS, **options):
    return Camera(
        "three", ("A", "B", "C"), ("R",), np.array([0, 0, -1]), CENTERS, pixels, PIXEL,
        rotation_deg=np.array(angles, dtype=float), **options
    )  # fmt: skip


def points(plane, count=200, seed=0):
    """Return random places on all CCDs [m]."""
    ccd, uv = np.arange(3).repeat(count), np.random.default_rng(seed).uniform(-0.99, 0.99, (3 * count, 2))
    return plane.camera.from_uv(ccd, uv)


@pytest.mark.parametrize("angles", [(0, 0, 0), (90, 180, -90), (30, -75, 200)])
def test_slopes_are_the_differences_of_heights(angles):
    plane = FocalPlane.from_budget(camera(angles), seed=3).with_moved("R", rx=2e-4, ry=-1e-4)
    xy = points(plane)
    step = 1e-6
    for axis in range(2):
        e = step * np.eye(2)[axis]
        found = (plane.height(*(xy + e).T) - plane.height(*(xy - e).T)) / (2 * step)
        # Third derivatives of waves of two cycles a CCD: step^2 k^3 amplitude, and rounding of 1e-21 / step.
        assert np.allclose(plane.gradient(*xy.T)[:, axis], found, rtol=0, atol=1e-10)


def test_a_quarter_turn_with_swapped_sides_is_the_same_focal_plane():
    """The term over the whole focal plane, motions and nominal heights do not depend on how a CCD is described."""
    placement = np.array([[1e-6, 1e-4, -5e-5], [0, 0, 2e-4], [-3e-6, 1e-4, 0]])
    upright = camera((0, 0, 0), placement=placement)
    turned = camera((90, -90, 270), PIXELS[:, ::-1], placement=placement)
    # Half turns change the signs of u and v alone.
    half = camera((180, 180, -180), placement=placement)
    planes = [
        FocalPlane.from_budget(c, seed=5, terms="global").with_moved("R", dz=1e-6, rx=3e-4).with_moved("C", ry=1e-4)
        for c in (upright, turned, half)
    ]
    xy = points(planes[0])
    for plane in planes[1:]:
        assert np.allclose(plane.height(*xy.T), planes[0].height(*xy.T), rtol=0, atol=1e-19)
        assert np.allclose(plane.gradient(*xy.T), planes[0].gradient(*xy.T), rtol=0, atol=1e-15)


def test_nominal_heights_are_planes_about_the_centres():
    plane = FocalPlane.flat(camera((0, 40, 90), placement=np.array([[2e-6, 0, 0], [0, 1e-4, 0], [0, 0, 1e-4]])))
    x, y = points(plane).T
    ccd = plane.ccd_at(x, y)
    dx, dy = np.stack([x, y]) - CENTERS[ccd].T
    expected = np.select([ccd == 0, ccd == 1, ccd == 2], [2e-6, np.tan(1e-4) * dy, -np.tan(1e-4) * dx])
    assert np.allclose(plane.height(x, y), expected, rtol=0, atol=1e-19)


def test_budget_terms_have_their_sizes_on_rectangles():
    wide = camera((0, 30, -60))
    whole = FocalPlane.from_budget(wide, seed=8, terms="global", budget="simulated")
    uv = np.stack(np.meshgrid(*[np.linspace(-1, 1, 81)] * 2), axis=-1).reshape(-1, 2)
    xy = wide.from_uv(np.arange(3)[:, None], uv * (1 - 1e-9))
    heights = whole.height(xy[..., 0], xy[..., 1])
    # The search on a grid misses the extremes of a quadratic by its square of the cell.
    assert np.ptp(heights) == pytest.approx(10e-6, rel=1e-3)
    assert heights.max() == pytest.approx(-heights.min(), rel=1e-3)
    ripple = FocalPlane.from_budget(wide, seed=8, terms="potato_chip")
    heights = ripple.height(xy[..., 0], xy[..., 1])
    assert np.ptp(heights, axis=1) == pytest.approx(5e-6, rel=2e-3)
    # Mean over the area, by the trapezoidal rule.
    weight = np.outer(*[np.r_[0.5, np.ones(79), 0.5]] * 2).ravel()
    assert np.abs(heights @ weight / weight.sum()).max() < 5e-9
    # No raft, no piston of one.
    rafts = FocalPlane.from_budget(wide, seed=8, terms="raft")
    assert rafts.polynomial[2, 0] == 0.0 != rafts.polynomial[0, 0] == rafts.polynomial[1, 0]


def test_measured_points_are_given_back():
    plane = FocalPlane.from_budget(camera((0, 30, -60)), seed=1)
    fitted = FocalPlane.from_heights(plane.to_table(40), plane.camera)
    xy = points(plane)
    # As for the LSST's: ripples of two cycles are met within 1e-4 of their height.
    assert np.abs(fitted.height(*xy.T) - plane.height(*xy.T)).max() < 5e-9
    one, other = height_statistics(plane)["all"], height_statistics(fitted)["all"]
    assert other.rms == pytest.approx(one.rms, rel=1e-3)


def test_meshes_stay_within_their_bound():
    plane = FocalPlane.from_budget(camera((15, 0, 90)), seed=4)
    cells = 6
    mesh, bound = plane.to_mesh(cells), plane.facet_error(cells)
    middles = mesh.triangles.mean(axis=1)
    error = np.abs(plane.height(*middles[:, :2].T) - middles[:, 2]).reshape(3, -1).max(axis=1)
    assert (error <= bound).all()
    # Bounds that are too generous by far would say nothing.
    assert (error > 0.02 * bound).all()
    # Normals along +z, whatever the angle.
    assert (mesh.face_normals[:, 2] > 0.99).all()


@pytest.mark.parametrize("angles", [(0, 90, 180), (20, -50, 130)])
def test_rays_land_on_rotated_ccds(angles):
    plane = FocalPlane.from_budget(camera(angles), seed=2)
    xy, rng = points(plane, 60), np.random.default_rng(9)
    direction = np.column_stack([rng.uniform(-0.4, 0.4, (len(xy), 2)), np.ones(len(xy))])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    detector = Surface("D", Interaction.DETECTOR, Plane(), (0.0, 0.0, 0.0), VACUUM)
    landed = land_on_ccds(detector, plane, np.column_stack([xy, np.zeros(len(xy))]), direction)
    on = landed.ccd >= 0
    assert on.mean() > 0.97
    x, y, z = landed.position[on].T
    # Newton's third step leaves less than rounding.
    assert np.abs(z - plane.height(x, y)).max() < 1e-19
    start = tuple(np.column_stack([xy, np.zeros(len(xy))])[on].T)
    x, y, lit = land_bundle(detector, plane, start, tuple(direction[on].T))
    assert lit.all()
    assert np.allclose(np.stack([x, y], -1), landed.position[on][:, :2], rtol=0, atol=1e-15)


def test_sides_of_two_sizes_are_told_apart():
    half = np.array([[1e-2, 2e-2], [1e-2, 2e-2], [1e-2, 3e-2]])
    polynomial = np.zeros((3, 10))
    polynomial[:, 5] = 1e-6  # v^2
    zero = np.zeros(2)
    for sizes, index in ((half, 2), (half[:2], 1)):
        n = len(sizes)
        surfaces = CcdSurfaces(sizes, polynomial[:n].copy(), np.zeros((n, 2, 4)))
        at = np.array([0.5, 1.0]) * sizes[index, 1]
        assert np.allclose(surfaces.height(np.full(2, index), zero, at), [0.25e-6, 1e-6], rtol=1e-15)
        slope = surfaces.gradient(np.full(2, index), zero, at)[:, 1]
        assert np.allclose(slope, [1e-6 / sizes[index, 1], 2e-6 / sizes[index, 1]], rtol=1e-15)
