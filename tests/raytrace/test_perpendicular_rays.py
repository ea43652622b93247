"""Rays perpendicular to the axis of a conic, or nearly so, as on off-axis paraboloids that turn light by 90 degrees."""

import numpy as np
import pytest

import pachon
from pachon.models.io.prescription import load_telescope
from pachon.models.shapes.polynomial import ZernikeSag
from pachon.models.shapes.shape import Conic, EvenAsphere, Plane
from pachon.models.shapes.sum import Sum
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope
from pachon.raytrace.adjoint.backward_pass import OutputGradient, backward_pass, landing_gradient
from pachon.raytrace.adjoint.forward_pass import forward_pass
from pachon.raytrace.rays import Rays, RayStatus

WAVELENGTH = 5e-7
#: Direction cosines along the axis: exactly 0 of either sign, nearly 0, and usual ones.
COSINES = (0.0, -0.0, 1e-12, -1e-12, 1e-3, -1e-3, 0.03, -0.03, 0.3, -0.3, 0.9, -0.9)
CONICS = (0.0, -0.6, -1.0, -1.8, 0.7)

RELAY = """VERS 231205 341
MODE SEQ
UNIT MM X W X CM MR CPMM
ENPD 1 0
FTYP 0 0 1 1 0 0 0 1
XFLN 0
YFLN 0
WAVM 1 0.55 1
PWAV 1
SURF 0
  TYPE STANDARD
  CURV 0.0
  DISZ INFINITY
SURF 1
  TYPE STANDARD
  CURV 0.0
  DISZ 100
SURF 2
  TYPE COORDBRK
  CURV 0
  PARM 2 -100
  DISZ 0
SURF 3
  STOP
  TYPE STANDARD
  CURV -0.01
  CONI -1
  DISZ -100
  GLAS MIRROR 0 0
SURF 4
  TYPE STANDARD
  CURV 0.01
  CONI -1
  DISZ 100
  GLAS MIRROR 0 0
SURF 5
  TYPE STANDARD
  CURV 0.0
  DISZ 0
"""


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def system(*surfaces):
    """Return a telescope of some surfaces; its beam has 1 mm."""
    return Telescope(
        name="test",
        surfaces=surfaces,
        stop_z=0.0,
        pupil_diameter=1e-3,
        pupil_obscuration=0.0,
        launch_distance=1.0,
        reference_sphere_radius=1.0,
        field_radius=0.01,
        field_limit=0.02,
        wavelength_range=(3e-7, 1e-6),
        default_wavelength=WAVELENGTH,
    )


def mirror(name, shape, *vertex):
    return Surface(name, Interaction.MIRROR, shape, vertex, VACUUM)


def detector(*vertex, shape=None):
    return Surface("Detector", Interaction.DETECTOR, shape or Plane(), vertex, VACUUM)


def intersections(radius, conic, start, direction):
    """Return both intersections with a conic and the normal's component along the ray at each, [2, n, 3] and [2, n].

    The zeros of F = (x^2 + y^2 + (1 + k) z^2) / R - 2 z along each ray, in extended precision.
    """
    p, d = start.T.astype(np.longdouble), direction.T.astype(np.longdouble)
    weight = np.array([1, 1, 1 + np.longdouble(conic)])[:, None]
    square = (weight * d * d).sum(axis=0) / radius
    linear = 2 * (weight * p * d).sum(axis=0) / radius - 2 * d[2]
    constant = (weight * p * p).sum(axis=0) / radius - 2 * p[2]
    root = np.sqrt(linear**2 - 4 * square * constant)
    t = np.stack([(-linear - root) / (2 * square), (-linear + root) / (2 * square)])
    # The normal that points along +z at the vertex is -grad F / 2.
    return (p[:, None] + t * d[:, None]).transpose(1, 2, 0), -(2 * square * t + linear) / 2


def rays_to_sheet(radius, conic, rng):
    """Return rays that cross the sheet of a conic at its vertex, not grazing it: starts and directions, [n, 3].

    Every other one starts close to one of its two intersections, as rays between two off-axis paraboloids do.
    """
    cosine = np.repeat(COSINES, 200)
    angle, place = rng.uniform(0, 2 * np.pi, (2, len(cosine)))
    sine = np.sqrt(1 - cosine**2)
    direction = np.stack([sine * np.cos(angle), sine * np.sin(angle), cosine], axis=1)
    # Up to nine tenths of the way to the equator, where there is one.
    r = rng.uniform(0.05, 0.9 / np.sqrt(max(1.0, 1 + conic)), len(cosine)) * abs(radius)
    x, y = r * np.cos(place), r * np.sin(place)
    z = r**2 / radius / (1 + np.sqrt(1 - (1 + conic) * r**2 / radius**2))
    point = np.stack([x, y, z], axis=1)
    normal = np.stack([-x, -y, radius - (1 + conic) * z], axis=1) / radius
    steep = np.abs((normal * direction).sum(axis=1)) > 0.1
    travel = rng.uniform(-2.0, 2.0, len(cosine)) * abs(radius)
    start = point - travel[:, None] * direction
    points, _ = intersections(radius, conic, start, direction)
    beside = points[rng.integers(2, size=len(cosine)), np.arange(len(cosine))].astype(float)
    beside += 10.0 ** rng.uniform(-15, -3, (len(cosine), 1)) * direction
    start[::2] = beside[::2]
    usable = steep & (np.abs(points).max(axis=(0, 2)) < 20.0)
    return start[usable], direction[usable]


def wanted(points, along, positive):
    """Return the intersections whose normal component along the ray is positive, or negative, [n, 3]."""
    return np.where(((along[0] > 0) == positive)[:, None], points[0], points[1]).astype(float)


@pytest.mark.parametrize("radius", [0.7, -1.3])
@pytest.mark.parametrize("conic", CONICS)
def test_the_intersection_follows_the_sign_of_the_cosine(radius, conic, rng):
    start, direction = rays_to_sheet(radius, conic, rng)
    telescope = system(detector(0.0, 0.0, 0.0, shape=Conic(radius, conic)))
    result = pachon.trace(telescope, Rays(start, direction, np.zeros(len(start)), WAVELENGTH))
    # A ray perpendicular to the axis counts as one along +z.
    expected = wanted(*intersections(radius, conic, start, direction), direction[:, 2] >= 0)
    assert (result.status == RayStatus.OK).all()
    assert len(start) > 1500
    # Rounding of squares of some metres, over a normal component of 0.1 at least.
    assert np.abs(result.position - expected).max() < 1e-12


@pytest.mark.parametrize("height", [0.4, -0.4])
@pytest.mark.parametrize("radius", [0.7, -1.3])
@pytest.mark.parametrize("conic", CONICS)
def test_a_mirror_reflects_on_the_side_of_the_next_surface(radius, conic, height, rng):
    start, direction = rays_to_sheet(radius, conic, rng)
    rays = Rays(start, direction, np.zeros(len(start)), WAVELENGTH)
    telescope = system(mirror("M", Conic(radius, conic), 0.0, 0.0, 0.0), detector(0.3, -0.2, height))
    result = pachon.trace(telescope, rays, surfaces="all")[0]
    # The light comes from the side of the next vertex; where the cosine is not small, its sign decides as on any conic.
    across = np.abs(direction[:, 2]) < 0.05
    positive = np.where(across, height < 0, direction[:, 2] > 0)
    expected = wanted(*intersections(radius, conic, start, direction), positive)
    assert np.abs(result.position - expected).max() < 1e-12


@pytest.fixture(scope="module")
def beam():
    """Points [m] of the entrance pupil, its centre and the tangential axis among them."""
    angle, radius = np.linspace(0, 2 * np.pi, 13), np.array([1e-7, 1e-5, 1e-4, 2e-4, 3e-4, 4e-4, 5e-4])[:, None]
    return np.append(0.0, radius * np.cos(angle)), np.append(0.0, radius * np.sin(angle))


def test_a_relay_of_two_paraboloids(tmp_path, beam):
    (tmp_path / "relay.zmx").write_text(RELAY)
    telescope = load_telescope(tmp_path / "relay.zmx")
    rays = pachon.launch_rays(telescope, (0.0, 0.0), telescope.default_wavelength, beam)
    _, first, second, image = pachon.trace(telescope, rays, surfaces="all")
    assert (image.status == RayStatus.OK).all()
    # The beam converges between the mirrors: on the second one w is 0 at its centre, and of both signs about it.
    assert first.direction[0, 2] == 0.0
    assert first.direction[:, 2].min() < -1e-3
    assert first.direction[:, 2].max() > 1e-3
    axis = np.array([0.0, -0.1, 0.0])
    x, y, z = (first.position - axis).T
    assert np.abs(z - (x**2 + y**2) / 0.2).max() < 1e-12
    # The second paraboloid is the first one, reflected in the common focus; so are the rays.
    focus = np.array([0.0, -0.1, 0.05])
    assert np.abs(second.position - (2 * focus - first.position)).max() < 1e-12
    assert np.abs(image.direction - [0.0, 0.0, -1.0]).max() < 1e-13
    # Paths between two plane waves are equal, to the rounding of 0.3 m.
    assert np.ptp(image.path_length) < 2e-15


@pytest.mark.parametrize("f2", [0.03, 0.05, 0.08])
@pytest.mark.parametrize("upwards", [False, True])
def test_beam_expanders_of_two_paraboloids(beam, f2, upwards):
    f1 = 0.05
    # Confocal, and facing each other or the same way.
    vertex, sign = (f1 - f2, 1.0) if upwards else (f1 + f2, -1.0)
    first = mirror("M1", Conic(2 * f1, -1.0), 0.0, -0.1, 0.0)
    second = mirror("M2", Conic(sign * 2 * f2, -1.0), 0.0, -0.1, vertex)
    telescope = system(first, second, detector(0.0, -0.1, vertex + sign * 0.3))
    rays = pachon.launch_rays(telescope, (0.0, 0.0), WAVELENGTH, beam)
    on_first, on_second, image = pachon.trace(telescope, rays, surfaces="all")
    assert (image.status == RayStatus.OK).all()
    # A paraboloid has the radius 2 f tan(a / 2) at an angle a from its axis, seen from the focus.
    x, y = on_first.position[:, 0], on_first.position[:, 1] + 0.1
    ratio = -4 * f1 * f2 / (x**2 + y**2) if upwards else -f2 / f1 * np.ones_like(x)
    expected = np.stack([ratio * x, ratio * y - 0.1, vertex + sign * ratio**2 * (x**2 + y**2) / (4 * f2)], axis=1)
    assert np.abs(on_second.position - expected).max() < 1e-12
    assert np.abs(image.direction - [0.0, 0.0, sign]).max() < 1e-13
    assert np.ptp(image.path_length) < 1e-14


@pytest.mark.parametrize(
    "change",
    [
        EvenAsphere(-0.1, -1.0, (2e-3, 1e-2)),
        Sum((Conic(-0.1, -1.0), ZernikeSag((0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 2e-6), 0.12))),
    ],
)
def test_deformed_mirrors_start_from_the_same_side(beam, change):
    first = mirror("M1", Conic(0.1, -1.0), 0.0, -0.1, 0.0)
    telescope = system(first, mirror("M2", change, 0.0, -0.1, 0.1), detector(0.0, -0.1, -0.1))
    rays = pachon.launch_rays(telescope, (0.0, 0.0), WAVELENGTH, beam)
    x, y, z = (pachon.trace(telescope, rays, surfaces="all")[1].position - [0.0, -0.1, 0.1]).T
    assert y.max() < -0.09
    assert np.abs(z - change.sag(x, y)).max() < 1e-12


def test_planes_have_one_intersection():
    # Almost perpendicular to the axis of a plane mirror, from either side.
    telescope = system(mirror("M", Plane(), 0.0, 0.0, 0.0), detector(0.0, 0.0, 1.0))
    cosine = np.array([1e-3, -1e-3, 1e-9, -1e-9, 0.0])
    direction = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], axis=1)
    start = np.tile([0.0, 0.0, 1e-3], (5, 1))
    rays = Rays(start, direction, np.zeros(5), WAVELENGTH)
    result = pachon.trace(telescope, rays, surfaces="all")[0]
    assert (result.status == [RayStatus.OK] * 4 + [RayStatus.MISSED]).all()
    expected = -1e-3 * direction[:4, 0] / cosine[:4]
    assert np.abs(result.position[:4, 0] / expected - 1).max() < 1e-15 / 1e-3
    assert np.abs(result.position[:4, 2]).max() < 1e-18


# Outputs near 0.1 m are good to 2e-16 m, over steps of 1e-5: 2e-11, and so twenty times that. Steps of 1e-5 in lengths
# of 0.1 m leave less in the fourth order.
ROUNDING = 4e-10


@pytest.fixture(scope="module")
def relay():
    first, second = mirror("M1", Conic(0.1, -1.0), 0.0, -0.1, 0.0), mirror("M2", Conic(-0.1, -1.0), 0.0, -0.1, 0.1)
    return system(first, second, detector(0.0, -0.1, -0.1))


@pytest.fixture(scope="module")
def relay_rays(relay, beam):
    return pachon.launch_rays(relay, (0.0, 0.0), WAVELENGTH, beam)


@pytest.fixture(scope="module")
def derivatives(relay, relay_rays):
    """Derivatives of the landing x and y, and of the path, [3, ...]."""
    forward = forward_pass(relay, relay_rays)
    zero = np.zeros((1, 3, forward.n_rays))
    gradients = landing_gradient(forward), OutputGradient(zero, zero, np.ones(1))
    passes = [backward_pass(forward, gradient, start=True) for gradient in gradients]
    return lambda what, *k: np.concatenate([getattr(p, what)(*k) if k else getattr(p, what) for p in passes])


@pytest.fixture(scope="module")
def outputs(relay_rays):
    def of(telescope, rays=relay_rays):
        end = pachon.trace(telescope, rays)
        return np.stack([*telescope.surfaces[-1].to_local(end.position)[:, :2].T, end.path_length])

    return of


@pytest.mark.parametrize("k", [0, 1])
def test_derivatives_by_motions(relay, outputs, derivatives, slope, k):
    surface = relay.surfaces[k]
    motion = derivatives("motion", k)
    for axis in range(3):
        unit = np.eye(3)[axis]
        shift = slope(lambda h, v=unit: outputs(relay.perturbed(surface.name, shift=h * v)), 1e-5)
        assert np.abs(shift - motion[:, axis]).max() < ROUNDING
        twist = np.concatenate([-np.cross(unit, surface.vertex), unit])
        tilt = slope(lambda h, v=unit: outputs(relay.perturbed(surface.name, tilt=h * v)), 1e-4)
        assert np.abs(tilt - np.einsum("oin,i->on", motion, twist)).max() < ROUNDING


@pytest.mark.parametrize("k", [0, 1])
@pytest.mark.parametrize("parameter", ["radius", "conic"])
def test_derivatives_by_shape(relay, outputs, derivatives, slope, k, parameter):
    name, shape = relay.surfaces[k].name, relay.surfaces[k].shape
    f, fx, fy = shape.sag_derivative(parameter, *derivatives("intersection", k)[:2])
    sag = derivatives("sag", k)
    value = shape.parameters[parameter]
    numeric = slope(lambda h: outputs(relay.with_shape(name, shape.with_parameter(parameter, value + h))), 1e-5)
    assert np.abs(sag[:, 0] * f + sag[:, 1] * fx + sag[:, 2] * fy - numeric).max() < ROUNDING


def test_derivatives_by_the_start_of_the_rays(relay, outputs, derivatives, relay_rays, slope):
    start = derivatives("start")
    for axis in range(3):
        unit = np.eye(3)[axis]

        def moved(h, unit=unit):
            position = relay_rays.position + h * unit
            return outputs(relay, Rays(position, relay_rays.direction, relay_rays.path_length, WAVELENGTH))

        def turned(h, unit=unit):
            direction = np.cos(h) * relay_rays.direction + np.sin(h) * unit
            return outputs(relay, Rays(relay_rays.position, direction, relay_rays.path_length, WAVELENGTH))

        assert np.abs(slope(moved, 1e-5) - start[:, axis]).max() < ROUNDING
        if axis < 2:
            assert np.abs(slope(turned, 1e-5) - start[:, 3 + axis]).max() < 10 * ROUNDING
