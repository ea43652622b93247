"""Rays that meet surfaces of every shape: against root finding, closed forms of screens, and batoid."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import pachon
from pachon.core.launch import ROLLED_OPTIONS, launch, start_warp
from pachon.models.media.medium import ConstantIndex
from pachon.models.shapes.freeform import Biconic, OddAsphere, Toroid
from pachon.models.shapes.grid import GridSag
from pachon.models.shapes.mesh import MeshSurface
from pachon.models.shapes.polynomial import XYPolynomial, ZernikeSag
from pachon.models.shapes.qbfs import QbfsAsphere
from pachon.models.shapes.shape import Conic, EvenAsphere, Plane, Sphere
from pachon.models.shapes.sum import Sum
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import Telescope
from pachon.raytrace.kernels.packet import lanes, to_packets
from pachon.raytrace.kernels.shape import PackedDeformations
from pachon.raytrace.kernels.shape_derivatives import added_derivatives
from pachon.raytrace.pack.shapes import pack_deformations, split_shape
from pachon.raytrace.rays import Rays, RayStatus

# The kernel of this file runs once: to unroll and optimise it would take longer than all else.
wp.set_module_options(ROLLED_OPTIONS | {"optimization_level": 0})

RNG = np.random.default_rng(5)
NODES_X, NODES_Y = np.linspace(-1.0, 1.0, 21), np.linspace(-1.1, 1.1, 15)
GRID = GridSag(NODES_X, NODES_Y, 0.01 * np.sin(3 * NODES_X) * np.cos(2 * NODES_Y)[:, None])
ZERNIKES = ZernikeSag(tuple(1e-3 * RNG.normal(size=28)), 1.0, 0.4)
SHAPES = {
    "plane": Plane(),
    "even asphere": EvenAsphere(5.0, 0.3, (1e-3, 2e-4, -1e-5)),
    "flat asphere": EvenAsphere(np.inf, 0.0, (1e-3, -2e-4)),
    "odd asphere": OddAsphere(5.0, -0.4, (1e-3, 1e-2, 3e-3, -2e-3, 1e-3)),
    "biconic": Biconic(4.0, -6.0, -0.3, 0.8),
    "cylinder": Biconic(4.0, np.inf),
    "toroid": Toroid(4.0, 6.0, -0.7),
    "toroid with powers": Toroid(4.0, -6.0, -0.7, (2e-3, -1e-3, 3e-4)),
    "qbfs": QbfsAsphere(5.0, 0.4, 1.2, (1e-2, -4e-3, 2e-3, 1e-3, -5e-4)),
    "flat qbfs": QbfsAsphere(np.inf, 0.0, 1.3, (1e-2, -4e-3)),
    "xy polynomial": XYPolynomial(((1, 0, 1e-3), (2, 1, 3e-3), (0, 5, -1e-3), (3, 3, 2e-3))),
    "zernikes": ZERNIKES,
    "grid": GRID,
    "sum": Sum((Sphere(4.0), ZERNIKES, GRID)),
    "sum of bases": Sum((EvenAsphere(5.0, 0.3, (1e-3, 2e-4)), Conic(9.0, -2.0), Toroid(4.0, 6.0))),
}
VERTEX = np.array([0.1, -0.05, 0.2])
TURN = Rotation.from_euler("xyz", [0.1, -0.05, 0.3]).as_matrix()


def one_surface(shape, interaction, index=1.0, turn=TURN):
    surface = Surface(
        "only",
        interaction,
        shape,
        tuple(VERTEX),
        ConstantIndex(index),
        rotation=tuple(tuple(float(v) for v in row) for row in turn),
    )
    return Telescope("one", (surface,), 0.0, 2.0, 0.0, 5.0, 5.0, 0.1, 0.1, (3e-7, 1e-6), 5e-7)


def rays_down(n, half_width=0.6):
    x, y = RNG.uniform(-half_width, half_width, (2, n))
    direction = np.stack([*RNG.uniform(-0.1, 0.1, (2, n)), -np.ones(n)], axis=-1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return Rays(np.stack([x, y, np.full(n, 2.0)], axis=-1), direction, np.zeros(n), 5e-7)


def normals(shape, x, y):
    slope_x, slope_y = shape.gradient(x, y)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


@pytest.mark.parametrize("interaction", [Interaction.MIRROR, Interaction.REFRACT])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_rays_land_where_root_finding_puts_them_and_leave_as_they_must(shape, interaction):
    rays = rays_down(40)
    index = 1.5 if interaction == Interaction.REFRACT else 1.0
    result = pachon.trace(one_surface(shape, interaction, index), rays)
    p, d = (rays.position - VERTEX) @ TURN, rays.direction @ TURN

    def landing(a, b):
        def height(t):
            return a[2] + t * b[2] - float(shape.sag(a[0] + t * b[0], a[1] + t * b[1]))

        return brentq(height, (0.5 - a[2]) / b[2], (-0.5 - a[2]) / b[2], xtol=1e-15, rtol=1e-15)

    t = np.array([landing(a, b) for a, b in zip(p, d, strict=True)])
    q = p + t[:, None] * d
    normal = normals(shape, q[:, 0], q[:, 1])
    along = np.sum(d * normal, axis=1, keepdims=True)
    if interaction == Interaction.MIRROR:
        out = d - 2 * along * normal
    else:
        mu = 1 / 1.5
        out = mu * d + (np.sign(along) * np.sqrt(1 - mu**2 * (1 - along**2)) - mu * along) * normal
    assert np.all(result.status == RayStatus.OK)
    # Rounding of distances of two metres; slopes differ by it times curvatures of up to ten.
    assert np.allclose(result.position, q @ TURN.T + VERTEX, rtol=0, atol=3e-15)
    assert np.allclose(result.path_length, t, rtol=0, atol=3e-15)
    assert np.allclose(result.direction, out @ TURN.T, rtol=0, atol=1e-13)


def test_a_lane_does_not_depend_on_its_neighbours():
    rays = rays_down(70)
    telescope = one_surface(Sum((Sphere(4.0), ZERNIKES, GRID)), Interaction.MIRROR)
    whole = pachon.trace(telescope, rays)
    for part in (slice(0, 1), slice(5, 44)):
        some = Rays(rays.position[part], rays.direction[part], rays.path_length[part], rays.wavelength)
        alone = pachon.trace(telescope, some)
        assert np.array_equal(alone.position, whole.position[part])
        assert np.array_equal(alone.direction, whole.direction[part])


def test_rays_beyond_a_grid_miss_it():
    x = np.array([0.0, 0.99, 1.01, -1.5])
    position = np.stack([x, np.zeros(4), np.full(4, 2.0)], axis=-1) + VERTEX * [1, 1, 0]
    down = np.tile([0.0, 0.0, -1.0], (4, 1))
    for shape in (GRID, Sum((Sphere(40.0), GRID))):
        result = pachon.trace(
            one_surface(shape, Interaction.MIRROR, turn=np.eye(3)), Rays(position, down, np.zeros(4), 5e-7)
        )
        assert result.status.tolist() == [RayStatus.OK, RayStatus.OK, RayStatus.MISSED, RayStatus.MISSED]
        assert np.isnan(result.position[2:]).all()


@pytest.mark.parametrize("shape", [GRID, ZERNIKES, XYPolynomial(((1, 0, 1e-3), (2, 0, 2e-3)))])
def test_a_phase_screen_adds_its_path_and_the_slopes_of_it(shape):
    rays = rays_down(100)
    index = 1.2
    screen = one_surface(shape, Interaction.PHASE)
    screen = replace(
        screen,
        medium_before=ConstantIndex(index),
        surfaces=(replace(screen.surfaces[0], medium_after=ConstantIndex(index)),),
    )
    result = pachon.trace(screen, rays)
    p, d = (rays.position - VERTEX) @ TURN, rays.direction @ TURN
    t = -p[:, 2] / d[:, 2]
    q = p + t[:, None] * d
    slope_x, slope_y = shape.gradient(q[:, 0], q[:, 1])
    across = d[:, :2] + np.stack([slope_x, slope_y], axis=-1) / index
    out = np.concatenate([across, -np.sqrt(1 - np.sum(across**2, axis=1, keepdims=True))], axis=1)
    assert np.allclose(result.position, q @ TURN.T + VERTEX, rtol=0, atol=3e-15)
    assert np.allclose(result.path_length, index * t + shape.sag(q[:, 0], q[:, 1]), rtol=0, atol=3e-15)
    assert np.allclose(result.direction, out @ TURN.T, rtol=0, atol=1e-13)


def test_a_screen_too_steep_lets_no_wave_pass_and_a_grid_ends():
    position = np.array([[0.0, 0.0, 2.0], [3.0, 0.0, 2.0]])
    rays = Rays(position, np.tile([0.0, 0.0, -1.0], (2, 1)), np.zeros(2), 5e-7)
    steep = one_surface(XYPolynomial(((1, 0, 1.1),)), Interaction.PHASE, turn=np.eye(3))
    assert pachon.trace(steep, rays).status.tolist() == [RayStatus.TOTAL_REFLECTION] * 2
    grid = one_surface(GRID, Interaction.PHASE, turn=np.eye(3))
    assert pachon.trace(grid, rays).status.tolist() == [RayStatus.OK, RayStatus.MISSED]


def test_a_figure_beside_an_asphere_or_a_map_of_it_is_one_trace():
    """A Zernike defocus and a sphere's worth of r^2 bend light alike, whatever part of the sum they are."""
    rays = rays_down(50)
    first = one_surface(Sum((Conic(5.0, -1.0), XYPolynomial(((2, 0, 1e-3), (0, 2, 1e-3))))), Interaction.MIRROR)
    # A paraboloid is r^2 / 2R: adding 1e-3 r^2 gives another paraboloid.
    second = one_surface(Conic(1 / (0.2 + 2e-3), -1.0), Interaction.MIRROR)
    a, b = pachon.trace(first, rays), pachon.trace(second, rays)
    assert np.allclose(a.position, b.position, rtol=0, atol=3e-15)
    assert np.allclose(a.direction, b.direction, rtol=0, atol=1e-14)


def mesh_of(shape, n, *, smooth):
    grid = np.linspace(-1, 1, n)
    x, y = np.meshgrid(grid, grid)
    x = x + 0.003 * np.sin(7 * y)
    corner = (np.arange(n - 1)[None] + n * np.arange(n - 1)[:, None]).ravel()
    faces = [np.stack([corner, corner + 1, corner + n + 1], -1), np.stack([corner, corner + n + 1, corner + n], -1)]
    vertices = np.stack([x.ravel(), y.ravel(), shape.sag(x, y).ravel()], axis=-1)
    return MeshSurface(vertices, np.concatenate(faces), smooth=smooth)


def test_rays_land_on_the_facets_of_a_mesh_and_leave_by_its_slopes():
    rays, conic = rays_down(500), Conic(6.0, -1.2)
    true = pachon.trace(one_surface(conic, Interaction.MIRROR), rays)
    for smooth, angle in ((False, 1e-2), (True, 5e-5)):
        mesh = mesh_of(conic, 81, smooth=smooth)
        result = pachon.trace(one_surface(mesh, Interaction.MIRROR), rays)
        q, d = (result.position - VERTEX) @ TURN, rays.direction @ TURN
        # A facet chosen in single precision may be a neighbour where two meet, 1e-7 m from its edge, and meets the ray
        # by a slope of 2e-3 times that higher.
        assert np.allclose(mesh.sag(q[:, 0], q[:, 1]), q[:, 2], rtol=0, atol=1e-9)
        normal = normals(mesh, q[:, 0], q[:, 1])
        out = d - 2 * np.sum(d * normal, axis=1, keepdims=True) * normal
        beside = np.linalg.norm(result.direction - out @ TURN.T, axis=1) > 1e-12
        assert beside.mean() < 0.01
        # Facets of 25 mm lie within h^2 / 4R of a sphere of 6 m; slopes of flat ones are off by h / R and twice that.
        assert np.abs(result.position - true.position).max() < 0.025**2 / 4 / 6 * 1.5
        assert np.abs(result.direction - true.direction).max() < angle


def test_rays_beside_a_mesh_miss_it():
    rays = rays_down(10)
    away = Rays(rays.position + np.array([5.0, 0.0, 0.0]), rays.direction, rays.path_length, rays.wavelength)
    mesh = mesh_of(Conic(6.0, -1.2), 11, smooth=False)
    assert np.all(pachon.trace(one_surface(mesh, Interaction.MIRROR), away).status == RayStatus.MISSED)


@wp.kernel
def ask_derivatives(
    first: wp.int32,
    deformations: PackedDeformations,
    s: wp.int32,
    x: wp.array(dtype=lanes),
    y: wp.array(dtype=lanes),
    out: wp.array2d(dtype=lanes),
):
    p = first + wp.tid()
    zx, zy, zxx, zxy, zyy = added_derivatives(deformations, s, x[p], y[p])
    out[0, p] = zx
    out[1, p] = zy
    out[2, p] = zxx
    out[3, p] = zxy
    out[4, p] = zyy


def test_derivatives_in_packets_are_those_of_the_shapes():
    start_warp()
    split = [split_shape(shape) for shape in SHAPES.values()]
    packed = pack_deformations(split)
    x, y = RNG.uniform(-0.7, 0.7, (2, 64))
    places = [wp.array(to_packets(v), dtype=lanes, device="cpu") for v in (x, y)]
    for row, (shape, parts) in enumerate(zip(SHAPES.values(), split, strict=True)):
        out = wp.empty((5, 2), dtype=lanes, device="cpu")
        launch(ask_derivatives, 2, [packed, row, *places, out], threads=1)
        whole, base = (np.stack([*s.gradient(x, y), *s.hessian(x, y)]) for s in (shape, parts.base))
        # Rounding of sums of some dozen terms of size one.
        assert np.allclose(out.numpy().reshape(5, -1), whole - base, rtol=0, atol=1e-14)


def test_traces_equal_batoids():
    batoid = pytest.importorskip("batoid")
    peers = {
        "zernikes": batoid.Zernike([0.0, *ZERNIKES.coefficients], R_outer=1.0, R_inner=0.4),
        "grid": batoid.Bicubic(NODES_X, NODES_Y, GRID.values),
    }
    peers["sum"] = batoid.Sum([batoid.Sphere(4.0), peers["zernikes"], peers["grid"]])
    rays = rays_down(200)
    for name, peer in peers.items():
        result = pachon.trace(one_surface(SHAPES[name], Interaction.MIRROR, turn=np.eye(3)), rays)
        theirs = batoid.RayVector(*rays.position.T, *rays.direction.T, 0.0, 5e-7)
        peer.reflect(theirs, coordSys=batoid.CoordSys(origin=VERTEX))
        landed = theirs.toCoordSys(batoid.CoordSys())
        # batoid stops its own search for the landing below 1e-14 m.
        assert np.allclose(result.position, landed.r, rtol=0, atol=1e-12), name
        assert np.allclose(result.direction, landed.v, rtol=0, atol=1e-12), name
