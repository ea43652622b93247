"""Which of two crossings of a ray with a surface is meant: the one within the clear aperture."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.models.aperture import Annulus, Circle, Ellipse, Polygon, Rectangle
from pachon.models.media.medium import ConstantIndex
from pachon.models.shapes.freeform import Toroid
from pachon.models.shapes.polynomial import ZernikeSag
from pachon.models.shapes.shape import Conic, EvenAsphere, Plane, Sphere
from pachon.models.shapes.sum import Sum
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope
from pachon.raytrace.adjoint.backward_pass import backward_pass, landing_gradient
from pachon.raytrace.adjoint.forward_pass import forward_pass
from pachon.raytrace.rays import Rays, RayStatus

WAVELENGTH = 5e-7
HALF_TURN = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
#: Rounding of places of a metre after a few surfaces.
ON_SURFACE = 1e-12


@pytest.fixture
def rng():
    return np.random.default_rng(36)


def system(*surfaces, diameter=1e-3):
    return Telescope(
        name="test",
        surfaces=surfaces,
        stop_z=0.0,
        pupil_diameter=diameter,
        pupil_obscuration=0.0,
        launch_distance=20.0,
        reference_sphere_radius=1.0,
        field_radius=0.01,
        field_limit=0.02,
        wavelength_range=(3e-7, 1e-6),
        default_wavelength=WAVELENGTH,
    )


def mirror(name, shape, vertex, aperture=None, axes=None):
    surface = Surface(name, Interaction.MIRROR, shape, vertex, VACUUM, aperture)
    return surface if axes is None else replace(surface, rotation=axes)


def detector(*vertex):
    return Surface("Detector", Interaction.DETECTOR, Plane(), vertex, VACUUM)


def rays_of(start, direction):
    return Rays(start, direction, np.zeros(len(start)), WAVELENGTH)


def conic_sag(x, y, radius, conic):
    s = x * x + y * y
    return s / radius / (1 + np.sqrt(1 - (1 + conic) * s / radius**2))


def chords(radius, conic, rng, count=4000):
    """Return lines through two points of the sheet at the vertex: starts anywhere on them, directions, both points."""
    reach = min(1.6, 0.98 / np.sqrt(1 + conic) if conic > -1 else 1.6) * abs(radius)
    size, angle = reach * np.sqrt(rng.uniform(size=(2, count))), rng.uniform(0, 2 * np.pi, (2, count))
    x, y = size * np.cos(angle), size * np.sin(angle)
    points = np.stack([x, y, conic_sag(x, y, radius, conic)], axis=-1)
    direction = points[1] - points[0]
    direction *= rng.choice([-1, 1], count)[:, None] / np.linalg.norm(direction, axis=1, keepdims=True)
    start = points[0] + rng.uniform(-3, 3, (count, 1)) * abs(radius) * direction
    return start, direction, points


@pytest.mark.parametrize("radius", [0.7, -1.3])
@pytest.mark.parametrize("conic", [0.0, -0.6, -1.0, -1.8, 0.7])
@pytest.mark.parametrize(
    "aperture",
    [
        Circle(0.2, x=0.5),
        Ellipse(0.2, 0.1, x=0.2, y=0.4, angle=0.3),
        Rectangle(0.3, 0.2, x=0.1, y=-0.6, angle=0.4),
        Polygon(((0.1, 0.1), (0.1, 0.6), (0.6, 0.3))),
        Annulus(1e-9, 0.3, x=-0.4),
    ],
)
def test_of_two_crossings_the_one_within_the_aperture(radius, conic, aperture, rng):
    start, direction, points = chords(radius, conic, rng)
    within = aperture.contains(*np.moveaxis(points[..., :2], -1, 0))
    one = within[0] != within[1]
    expected = np.where(within[0][:, None], points[0], points[1])[one]
    assert one.sum() > 10
    for interaction in (Interaction.MIRROR, Interaction.PASS):
        surface = replace(mirror("M", Conic(radius, conic), (0.0, 0.0, 0.0), aperture), interaction=interaction)
        telescope = system(surface, detector(0.3, -0.2, 0.4))
        result = pachon.trace(telescope, rays_of(start[one], direction[one]), "all")[0]
        assert (result.status == RayStatus.OK).all()
        assert np.abs(result.position - expected).max() < ON_SURFACE


def test_a_ray_of_the_other_sheet_or_half_misses(rng):
    # Through the upper half of a sphere alone, within the rim of an off-axis aperture in x and y.
    angle = rng.uniform(0, 2 * np.pi, 50)
    direction = np.stack([np.cos(angle), np.sin(angle), 0.1 * np.ones(50)], axis=1) / np.sqrt(1.01)
    start = np.array([0.2, 0.0, 1.7]) - 0.1 * direction
    telescope = system(mirror("M", Sphere(1.0), (0.0, 0.0, 0.0), Circle(0.9, x=0.2)), detector(0.0, 0.0, 1.0))
    assert (pachon.trace(telescope, rays_of(start, direction)).status == RayStatus.MISSED).all()


def relay(first_axes=None, second_axes=None, second=None, size=0.06):
    """Return two equal off-axis paraboloids of 50 mm that turn a wide beam by 90 degrees and back."""
    shapes = [Conic(0.1, -1.0), second or Conic(-0.1, -1.0)]
    mirrors = []
    for i, (shape, axes, y) in enumerate(zip(shapes, (first_axes, second_axes), (0.1, -0.1), strict=True)):
        if axes is not None:
            shape, y = Conic(-shape.radius, shape.conic), -y
        aperture = Circle(size, y=y) if i == 0 else Rectangle(2 * size, 2 * size, y=y)
        mirrors.append(mirror(f"M{i + 1}", shape, (0.0, -0.1, 0.1 * i), aperture, axes))
    return system(*mirrors, detector(0.0, -0.1, -0.3), diameter=2 * size)


def beam(telescope, rng, count=500):
    size, angle = 0.499 * telescope.pupil_diameter * np.sqrt(rng.uniform(size=count)), rng.uniform(0, 2 * np.pi, count)
    pupil = size * np.cos(angle), size * np.sin(angle)
    return pachon.launch_rays(telescope, (0.0, 0.0), WAVELENGTH, pupil)


@pytest.mark.parametrize("first_axes", [None, HALF_TURN])
@pytest.mark.parametrize("second_axes", [None, HALF_TURN])
def test_a_wide_relay_past_90_degrees(first_axes, second_axes, rng):
    telescope = relay(first_axes, second_axes)
    first, second, image = pachon.trace(telescope, beam(telescope, rng), "all")
    assert first.direction[:, 2].min() < -0.4
    assert first.direction[:, 2].max() > 0.6
    assert (image.status == RayStatus.OK).all()
    for points, shift, sign in ((first, 0.0, 1.0), (second, 0.1, -1.0)):
        x, y, z = (points.position - [0.0, -0.1, shift]).T
        assert np.abs(z - sign * (x**2 + y**2) / 0.2).max() < ON_SURFACE
    # The second paraboloid is the first one, reflected in the common focus, and so are the rays.
    assert np.abs(second.position - ([0.0, -0.2, 0.1] - first.position)).max() < ON_SURFACE
    assert np.abs(image.direction - [0.0, 0.0, -1.0]).max() < 1e-13
    assert np.ptp(image.path_length) < 1e-14


@pytest.mark.parametrize(
    "shape",
    [
        EvenAsphere(-0.1, -1.0, (2e-3, 1e-2)),
        Sum((Conic(-0.1, -1.0), ZernikeSag((0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 2e-6), 0.3))),
        Toroid(-0.21, -0.2, 0.0),
    ],
)
def test_searches_start_from_the_crossing_within_the_aperture(shape, rng):
    telescope = relay(second=shape, size=0.03)
    first, second, image = pachon.trace(telescope, beam(telescope, rng, 150), "all")
    x, y, z = (second.position - [0.0, -0.1, 0.1]).T
    lit = image.status == RayStatus.OK
    assert np.abs(z - shape.sag(x, y))[lit].max() < ON_SURFACE
    # Brute force: steps along each ray until it passes the surface within the aperture.
    steps = np.linspace(0.02, 0.4, 2001)[:, None, None]
    start = first.position - [0.0, -0.1, 0.1]
    x, y, z = np.moveaxis(start + steps * first.direction, -1, 0)
    above = z - shape.sag(x, y)
    within = telescope.surfaces[1].aperture.contains(x, y)
    passed = ((above[1:] * above[:-1] < 0) & within[1:] & within[:-1]).any(axis=0)
    # But for rays within a step of the rim.
    assert np.count_nonzero(lit != passed) <= 3
    assert lit.mean() > 0.3


def test_a_lamp_in_an_ellipsoid_with_a_hole(rng):
    semi_axis, offset = 0.5, 0.3
    radius, conic = (semi_axis**2 - offset**2) / semi_axis, -((offset / semi_axis) ** 2)
    lamp, focus = np.array([0.0, 0.0, semi_axis - offset]), np.array([0.0, 0.0, semi_axis + offset])
    cosine, angle = rng.uniform(-1.0, 0.6, 2000), rng.uniform(0, 2 * np.pi, 2000)
    sine = np.sqrt(1 - cosine**2)
    direction = np.stack([sine * np.cos(angle), sine * np.sin(angle), cosine], axis=1)
    # Polar equation of an ellipse about its focus.
    distance = radius / (1 - np.sqrt(-conic) * cosine)
    points = lamp + distance[:, None] * direction
    rim = 0.39
    telescope = system(mirror("M", Conic(radius, conic), (0.0, 0.0, 0.0), Annulus(0.1, rim)), detector(*focus))
    on_mirror, image = pachon.trace(telescope, rays_of(np.tile(lamp, (2000, 1)), direction), "all")
    below = points[:, 2] < semi_axis
    size = np.hypot(*points[:, :2].T)
    clear = below & (size > 0.1) & (size < rim)
    # Beyond its equator the ellipsoid is no surface.
    assert np.abs(on_mirror.position - points)[below].max() < ON_SURFACE
    assert ((image.status == RayStatus.OK) == clear)[below].all()
    assert cosine[clear].max() > 0.4
    assert np.abs(image.position - focus)[clear].max() < 1e-11
    assert np.abs(image.path_length - 2 * semi_axis)[clear].max() < ON_SURFACE


def crossing_in_section(radius, conic, vertex, start, direction, section):
    """Return the crossing of each ray with a conic about z whose height is in a section, else the lower one."""
    start, direction = start.astype(np.longdouble), direction.astype(np.longdouble)
    p, d = (start - [0, 0, vertex]).T, direction.T
    weight = np.array([1, 1, 1 + conic])[:, None]
    a = (weight * d * d).sum(axis=0)
    b = (weight * p * d).sum(axis=0) - radius * d[2]
    e = (weight * p * p).sum(axis=0) - 2 * radius * p[2]
    r = np.sqrt(b * b - a * e)
    q = -b - np.copysign(r, b)
    # Along the axis a paraboloid has one crossing.
    roots = np.stack([np.divide(q, a, out=np.full_like(q, 1e3), where=a != 0), e / q])
    z = start[:, 2] + roots * d[2]
    within = (z > section[0]) & (z < section[1]) & (1 - (1 + conic) * (z - vertex) / radius > 0)
    t = np.where(within[0], roots[0], roots[1])
    return start + t[:, None] * direction, within.any(axis=0)


def reflected(direction, point, radius, conic, vertex):
    normal = point - [0, 0, vertex]
    normal = np.stack([normal[:, 0], normal[:, 1], (1 + conic) * normal[:, 2] - radius], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return direction - 2 * (direction * normal).sum(axis=1, keepdims=True) * normal


@pytest.mark.parametrize("field", [(0.0, 0.0), (0.004, -0.003)])
@pytest.mark.parametrize("half_turn", [False, True])
def test_a_wolter_telescope(field, half_turn, rng):
    """Type I (Wolter 1952): a paraboloid and a confocal hyperboloid, both hit from within at 0.7 degrees."""
    rim, middle, length = 0.15, 3.0, 0.3
    turn = np.arctan(rim / middle)
    far = np.longdouble(rim) / np.tan(turn / 2)
    half = (far - middle) / 2
    semi = (np.hypot(rim, far) - np.hypot(rim, middle)) / 2
    hyperboloid = ((half**2 - semi**2) / semi, -((half / semi) ** 2), semi - half)
    # r^2 = 4 f (z - vertex), its focus that of the hyperboloid.
    f = (np.hypot(rim, far) - far) / 2
    paraboloid = (2 * f, -1.0, middle - far - f)
    sections = (middle, middle + length), (middle - 1.2 * length, middle)

    def size(surface, z):
        radius, conic, vertex = surface
        return np.sqrt(2 * radius * (z - vertex) - (1 + conic) * (z - vertex) ** 2)

    mirrors = []
    for name, surface, section in zip(("P", "H"), (paraboloid, hyperboloid), sections, strict=True):
        radius, conic, vertex = surface
        ring = Annulus(*(float(size(surface, z)) for z in section))
        radius, conic = float(radius), float(conic)
        shape, axes = (Conic(-radius, conic), HALF_TURN) if half_turn else (Conic(radius, conic), None)
        mirrors.append(mirror(name, shape, (0.0, 0.0, float(vertex)), ring, axes))
    telescope = system(*mirrors, detector(0.0, 0.0, 0.0), diameter=0.34)
    r, angle = rng.uniform(0.149, 0.155, 3000), rng.uniform(0, 2 * np.pi, 3000)
    rays = pachon.launch_rays(telescope, field, WAVELENGTH, (r * np.cos(angle), r * np.sin(angle)))
    place, direction, lit = rays.position, rays.direction, np.ones(3000, dtype=bool)
    results = pachon.trace(telescope, rays, "all")
    for result, surface, section in zip(results, (paraboloid, hyperboloid), sections, strict=False):
        place, within = crossing_in_section(*surface, place, direction, section)
        direction = reflected(direction, place, *surface)
        lit &= within
        assert np.abs(result.position - place)[lit].max() < ON_SURFACE
        assert ((result.status == RayStatus.OK) == lit).all()
    assert 0.05 < lit.mean() < 0.8
    if field == (0.0, 0.0):
        # Heights of 3 m, slopes of 0.05.
        assert np.abs(results[-1].position)[lit].max() < 1e-13
        assert np.ptp(results[-1].path_length[lit]) < 1e-13


@pytest.mark.parametrize("half_turn", [False, True])
def test_a_pair_of_hyperboloids(half_turn, rng):
    """Light of one focus, from inside a hyperboloid near its rim, goes on to another that has the same axis."""
    semi, half = 0.1, 0.13
    radius, conic = (half**2 - semi**2) / semi, -((half / semi) ** 2)
    inner = np.array([0.0, 0.0, half - semi])
    cosine, angle = rng.uniform(-0.5, 0.5, 500), rng.uniform(-0.3, 0.3, 500)
    direction = np.stack([np.sqrt(1 - cosine**2) * np.cos(angle), np.sqrt(1 - cosine**2) * np.sin(angle), cosine]).T
    # Polar equation about the inner focus: the sheet around it.
    first = inner + radius / (1 - np.sqrt(-conic) * cosine)[:, None] * direction
    # Light leaves as if it came from the outer focus.
    outer = np.array([0.0, 0.0, -half - semi])
    onward = (first - outer) / np.linalg.norm(first - outer, axis=1, keepdims=True)
    above = 0.6
    # The second hyperboloid opens downwards, has the outer focus as its own inner one, and is hit from within.
    second_radius = (above - outer[2]) * (1 + half / semi)
    slope = onward[:, 2]
    distance = second_radius / (1 + np.sqrt(-conic) * slope)
    second = outer + distance[:, None] * onward
    shapes = Conic(radius, conic), Conic(-second_radius, conic)
    places = (0.0, 0.0, 0.0), (0.0, 0.0, float(above))
    points = first, second
    mirrors = []
    for name, shape, vertex, at in zip("AB", shapes, places, points, strict=True):
        middle, axes = 0.5 * (at[:, 0].min() + at[:, 0].max()), None
        if half_turn:
            shape, axes = Conic(-shape.radius, shape.conic), HALF_TURN
        width, height = 1.01 * np.ptp(at[:, 0]), 2.02 * np.abs(at[:, 1]).max()
        mirrors.append(mirror(name, shape, vertex, Rectangle(width, height, x=middle), axes))
    telescope = system(*mirrors, detector(0.0, 0.0, -1.0))
    start = np.tile(inner, (500, 1))
    on_first, on_second, _ = pachon.trace(telescope, rays_of(start, direction), "all")
    assert np.abs(on_first.position - first).max() < ON_SURFACE
    assert np.abs(on_second.position - second).max() < 10 * ON_SURFACE
    assert (on_second.status == RayStatus.OK).all()


def test_a_retro_path_through_a_lens(rng):
    """Light that a concentric mirror sends back leaves a lens as it came."""
    glass = ConstantIndex(1.5)
    front, back = Sphere(-0.05), Sphere(0.2)
    # Parallel light through the lens; a mirror about its paraxial focus, as rays near the axis see it.
    go = [
        Surface("L1", Interaction.REFRACT, front, (0.0, 0.0, 0.0), glass, Circle(0.04, x=0.01)),
        Surface("L2", Interaction.REFRACT, back, (0.0, 0.0, -0.01), VACUUM, Circle(0.04, x=0.01)),
    ]
    turn = mirror("M", Plane(), (0.0, 0.0, -0.1))
    come = [
        replace(go[1], name="L3", medium_after=glass),
        replace(go[0], name="L4", medium_after=VACUUM),
    ]
    telescope = system(*go, turn, *come, detector(0.0, 0.0, 0.1), diameter=0.02)
    rays = beam(telescope, rng)
    results = pachon.trace(telescope, rays, "all")
    for result, surface in zip(results, telescope.surfaces, strict=True):
        x, y, z = surface.to_local(result.position).T
        assert np.abs(z - surface.sag(x, y)).max() < ON_SURFACE
    # Back along the same way: the rays at the end, reversed, come out of the start.
    end = results[-1]
    back_rays = Rays(end.position, -end.direction, np.zeros(len(end.status)), WAVELENGTH)
    again = pachon.trace(telescope, back_rays, "all")[-1]
    assert np.abs(again.direction + rays.direction).max() < 1e-12
    axis = ((rays.position - again.position) * rays.direction).sum(axis=1, keepdims=True)
    assert np.abs(again.position + axis * rays.direction - rays.position).max() < ON_SURFACE


def test_derivatives_of_a_wide_relay(slope, rng):
    telescope = relay()
    rays = beam(telescope, rng, 30)
    forward = forward_pass(telescope, rays)
    motion = [backward_pass(forward, landing_gradient(forward)).motion(k) for k in range(2)]
    for k, axis in ((0, 0), (1, 1), (1, 2)):

        def landed(h, k=k, axis=axis):
            shifted = telescope.perturbed(telescope.surfaces[k].name, shift=h * np.eye(3)[axis])
            return pachon.trace(shifted, rays).position[:, :2].T

        # As in test_perpendicular_rays: rounding of 0.1 m over steps of 1e-5, and slopes of 4.
        assert np.abs(slope(landed, 1e-5) - motion[k][:, axis]).max() < 2e-9


def test_an_asphere_is_found_where_its_conic_is_missed(rng):
    """Near the rim of an asphere that bends back, rays pass beside the sphere that it departs from."""
    shape = EvenAsphere(0.05, 0.0, (-5000.0,))
    size, angle = rng.uniform(0.036, 0.043, 500), rng.uniform(0, 2 * np.pi, 500)
    x, y = size * np.cos(angle), size * np.sin(angle)
    points = np.stack([x, y, shape.sag(x, y)], axis=1)
    direction = np.stack([-np.sin(angle), np.cos(angle), -0.6 * np.ones(500)], axis=1) / np.sqrt(1.36)
    start = points - 0.03 * direction
    offset = start - [0.0, 0.0, 0.05]
    beside = ((offset * direction).sum(axis=1)) ** 2 < (offset**2).sum(axis=1) - 0.05**2
    assert beside.sum() > 400
    telescope = system(replace(detector(0.0, 0.0, 0.0), shape=shape))
    result = pachon.trace(telescope, rays_of(start, direction))
    assert (result.status[beside] == RayStatus.OK).all()
    assert np.abs(result.position - points)[beside].max() < ON_SURFACE
