"""One surface alone: against batoid, root finding, central differences, and the laws of reflection and refraction."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import pachon
from pachon.core.errors import DomainError
from pachon.models.media.medium import ConstantIndex

RNG = np.random.default_rng(8)
X, Y = np.linspace(-1.0, 1.0, 41), np.linspace(-1.1, 1.1, 31)
HEIGHTS = 0.01 * np.sin(3 * X) * np.cos(2 * Y)[:, None]
ZERNIKES = pachon.models.ZernikeSag(tuple(1e-3 * RNG.normal(size=15)), 1.0, 0.4)
TETRAHEDRON = np.array([[-2.0, -2.0, 0.1], [2.0, -2.0, -0.1], [0.0, 2.5, 0.2], [0.1, 0.0, 0.3]])
SHAPES = {
    "plane": pachon.Plane(),
    "sphere": pachon.Sphere(-4.0),
    "conic": pachon.Conic(5.0, -1.3),
    "even asphere": pachon.models.EvenAsphere(5.0, 0.3, (1e-3, 2e-4, -1e-5)),
    "odd asphere": pachon.models.OddAsphere(5.0, -0.4, (1e-3, 1e-2, 3e-3)),
    "biconic": pachon.models.Biconic(4.0, -6.0, -0.3, 0.8),
    "toroid": pachon.models.Toroid(4.0, 6.0, -0.7),
    "xy polynomial": pachon.models.XYPolynomial(((1, 0, 1e-3), (2, 1, 3e-3), (0, 5, -1e-3))),
    "zernikes": ZERNIKES,
    "grid": pachon.models.GridSag(X, Y, HEIGHTS),
    "grid modes": pachon.models.GridModes(
        {"a": pachon.models.GridSag(X, Y, HEIGHTS), "b": pachon.models.GridSag(X, Y, HEIGHTS**2)}, {"a": 0.5, "b": 3.0}
    ),
    "mesh": pachon.models.MeshSurface(TETRAHEDRON, np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]])),
    "sum": pachon.models.Sum((pachon.Sphere(4.0), ZERNIKES)),
}
VERTEX = np.array([0.1, -0.05, 0.2])
TURN = Rotation.from_euler("xyz", [0.1, -0.05, 0.3]).as_matrix()


def placed(shape, interaction=pachon.Interaction.PASS, **options):
    axes = tuple(tuple(float(v) for v in row) for row in TURN)
    return pachon.Surface("only", interaction, shape, tuple(VERTEX), ConstantIndex(1.0), rotation=axes, **options)


def rays_down(n=50, half_width=0.6, tilt=0.1):
    x, y = RNG.uniform(-half_width, half_width, (2, n))
    direction = np.stack([*RNG.uniform(-tilt, tilt, (2, n)), -np.ones(n)], axis=-1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return pachon.Rays(np.stack([x, y, np.full(n, 2.0)], axis=-1), direction, np.zeros(n), 5e-7)


def local(result):
    return (result.position - VERTEX) @ TURN


def normals_at(surface, result):
    """Unit normals in the telescope frame."""
    return surface.normal(*local(result)[:, :2].T) @ TURN.T


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_intersections_lie_on_ray_and_surface_as_root_finding_has_them(shape):
    surface, rays = placed(shape), rays_down()
    result = pachon.intersect(surface, rays, n=1.33)
    assert np.all(result.status == pachon.RayStatus.OK)
    # Into the frame of the surface and back.
    assert np.allclose(result.direction, rays.direction, rtol=0, atol=1e-15)
    p, d = (rays.position - VERTEX) @ TURN, rays.direction @ TURN
    t = np.array(
        [
            brentq(
                lambda t, a=a, b=b: a[2] + t * b[2] - float(surface.sag(a[0] + t * b[0], a[1] + t * b[1])), 1.0, 3.0,
                xtol=1e-15, rtol=1e-15,
            )
            for a, b in zip(p, d, strict=True)
        ]
    )  # fmt: skip
    # Rounding of distances of two metres.
    assert np.allclose(result.position, rays.position + t[:, None] * rays.direction, rtol=0, atol=3e-15)
    assert np.allclose(result.path_length, 1.33 * t, rtol=0, atol=5e-15)


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_normals_against_central_differences_of_the_sag(shape):
    surface = placed(shape)
    x, y = RNG.uniform(-0.6, 0.6, (2, 40))
    h = 1e-5
    along_x = (surface.sag(x + h, y) - surface.sag(x - h, y)) / (2 * h)
    along_y = (surface.sag(x, y + h) - surface.sag(x, y - h)) / (2 * h)
    normal = surface.normal(x, y)
    assert np.allclose(np.linalg.norm(normal, axis=-1), 1.0, rtol=0, atol=1e-15)
    assert np.all(normal[:, 2] > 0)
    # Differences: rounding 1e-16 / h, and h^2 times third derivatives of about ten.
    assert np.allclose(-normal[:, :2] / normal[:, 2:], np.stack([along_x, along_y], axis=-1), rtol=0, atol=5e-9)
    assert surface.normal(0.1, 0.2).shape == (3,)


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_laws_of_reflection_and_refraction_in_vectors(shape):
    surface, rays = placed(shape), rays_down()
    reflected, refracted = pachon.reflect(surface, rays), pachon.refract(surface, rays, 1.0, 1.5)
    normal = normals_at(surface, reflected)
    before = np.cross(rays.direction, normal)
    # Slopes differ by rounding of the positions times curvatures of up to ten.
    assert np.allclose(np.cross(reflected.direction, normal), before, rtol=0, atol=1e-13)
    assert np.allclose(
        np.sum(reflected.direction * normal, axis=1), -np.sum(rays.direction * normal, axis=1), atol=1e-13
    )
    assert np.allclose(1.5 * np.cross(refracted.direction, normal), before, rtol=0, atol=1e-13)
    assert np.allclose(np.linalg.norm(refracted.direction, axis=1), 1.0, rtol=0, atol=1e-14)
    # And back again.
    back = pachon.Rays(refracted.position, -refracted.direction, np.zeros(50), 5e-7)
    assert np.allclose(pachon.refract(surface, back, 1.5, 1.0).direction, -rays.direction, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", ["plane", "sphere", "conic", "even asphere", "zernikes", "sum"])
def test_as_batoid_does(name):
    batoid = pytest.importorskip("batoid")
    zernikes = batoid.Zernike([0.0, *ZERNIKES.coefficients], R_outer=1.0, R_inner=0.4)
    theirs = {
        "plane": lambda: batoid.Plane(),
        "sphere": lambda: batoid.Sphere(-4.0),
        "conic": lambda: batoid.Quadric(5.0, -1.3),
        "even asphere": lambda: batoid.Asphere(5.0, 0.3, [1e-3, 2e-4, -1e-5]),
        "zernikes": lambda: zernikes,
        "sum": lambda: batoid.Sum([batoid.Sphere(4.0), zernikes]),
    }[name]()
    shape, rays = SHAPES[name], rays_down()
    x, y = RNG.uniform(-0.6, 0.6, (2, 20))
    assert np.allclose(shape.sag(x, y), theirs.sag(x, y), rtol=0, atol=1e-15)
    assert np.allclose(shape.normal(x, y), theirs.normal(x, y), rtol=0, atol=1e-14)
    start = batoid.RayVector(*rays.position.T.copy(), *rays.direction.T.copy(), wavelength=5e-7)
    glass = batoid.ConstMedium(1.5)
    pairs = [
        (pachon.intersect(shape, rays), theirs.intersect(start.copy())),
        (pachon.reflect(shape, rays), theirs.reflect(start.copy())),
        (pachon.refract(shape, rays, 1.0, 1.5), theirs.refract(start.copy(), batoid.ConstMedium(1.0), glass)),
    ]
    for ours, batoids in pairs:
        assert np.allclose(ours.position, batoids.r, rtol=0, atol=1e-14)
        unit = batoids.v / np.linalg.norm(batoids.v, axis=1, keepdims=True)
        assert np.allclose(ours.direction, unit, rtol=0, atol=1e-13)
        assert np.allclose(ours.path_length, batoids.t, rtol=0, atol=1e-14)


def test_a_parabola_has_one_focus():
    """Light parallel to the axis of a paraboloid of radius 4 m meets at 2 m, all paths equal."""
    rays = rays_down(tilt=0.0)
    end = pachon.intersect(placed_at(2.0), pachon.reflect(pachon.Conic(4.0, -1.0), rays))
    assert np.allclose(end.position, [0.0, 0.0, 2.0], rtol=0, atol=2e-15)
    assert np.allclose(end.path_length, 4.0, rtol=0, atol=2e-15)


def placed_at(z, **options):
    return pachon.Surface(
        "plane", pachon.Interaction.DETECTOR, pachon.Plane(), (0.0, 0.0, z), ConstantIndex(1.0), **options
    )


def test_surfaces_one_after_the_other_are_the_trace_of_the_telescope():
    telescope = pachon.load_telescope("lsst_v3.3_r")
    x, y = RNG.uniform(-4.0, 4.0, (2, 60))
    rays = pachon.launch_rays(telescope, (0.01, 0.005), 620e-9, (x, y))
    result, index = rays, 1.0
    for surface, expected in zip(telescope.surfaces, pachon.trace(telescope, rays, "all"), strict=True):
        after = float(surface.medium_after.index(620e-9))
        if surface.interaction == pachon.Interaction.MIRROR:
            result = pachon.reflect(surface, result, n=index)
        elif surface.interaction == pachon.Interaction.REFRACT:
            result = pachon.refract(surface, result, index, after)
        else:
            result = pachon.intersect(surface, result, n=index)
        index = after
        assert np.array_equal(result.status, expected.status)
        assert np.array_equal(result.position, expected.position)
        assert np.array_equal(result.direction, expected.direction)
        assert np.array_equal(result.path_length, expected.path_length)
    assert set(result.status) == {pachon.RayStatus.OK, pachon.RayStatus.VIGNETTED}


def test_statuses_outlive_later_surfaces():
    x = np.array([0.0, 0.6, 3.0])
    down = np.tile([0.0, 0.0, -1.0], (3, 1))
    rays = pachon.Rays(np.stack([x, 0 * x, 0 * x + 2.0], axis=-1), down, np.zeros(3), 5e-7)
    sphere = pachon.Surface(
        "S",
        pachon.Interaction.MIRROR,
        pachon.Sphere(2.0),
        (0.0, 0.0, 0.0),
        ConstantIndex(1.0),
        pachon.models.Circle(0.5),
    )
    status = pachon.RayStatus
    first = pachon.intersect(sphere, rays)
    assert first.status.tolist() == [status.OK, status.VIGNETTED, status.MISSED]
    after = pachon.intersect(placed_at(-1.0), first)
    assert after.status.tolist() == first.status.tolist()
    assert np.isnan(after.position[2]).all()
    assert np.isfinite(after.position[:2]).all()
    steep = pachon.Rays(np.array([[0.0, 0.0, 1.0]]), np.array([[0.8, 0.0, -0.6]]), np.zeros(1), 5e-7)
    assert pachon.refract(placed_at(0.0), steep, 1.5, 1.0).status.tolist() == [status.TOTAL_REFLECTION]


def test_a_phase_screen_is_met_at_its_plane():
    screen = placed(pachon.models.GridSag(X, Y, HEIGHTS), pachon.Interaction.PHASE)
    rays = rays_down()
    assert np.allclose(local(pachon.intersect(screen, rays))[:, 2], 0.0, atol=3e-15)
    assert np.all(screen.sag(X, 0 * X) == 0.0)
    assert np.array_equal(screen.normal(0.3, 0.2), [0.0, 0.0, 1.0])


@pytest.mark.parametrize("index", [0.0, -1.0, np.nan, np.inf])
def test_indices_are_positive_numbers(index):
    with pytest.raises(DomainError, match=r"refractive index = .*: expected a positive number"):
        pachon.intersect(pachon.Plane(), rays_down(2), n=index)
    with pytest.raises(DomainError, match=r"refractive index = .*: expected a positive number"):
        pachon.refract(pachon.Plane(), rays_down(2), 1.0, index)
