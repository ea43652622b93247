"""Diffraction gratings: the grating equation in vectors, optical paths, derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from adjoint_outputs import position_and_path

import pachon
from pachon.core.errors import PrescriptionError
from pachon.models.media.medium import ConstantIndex
from pachon.models.parameters.parameters import apply
from pachon.models.rotation import rotation_matrix
from pachon.raytrace.adjoint.adjoint_matrix import column_table
from pachon.raytrace.adjoint.backward_pass import backward_pass, landing_gradient
from pachon.raytrace.adjoint.forward_pass import forward_pass

WAVELENGTH = 550e-9
QUANTITIES = ("sag", "index", "intersection", "gap", "grooves")
GLASS = ConstantIndex(1.5168)
AIR = ConstantIndex(1.0)
WATER = ConstantIndex(1.33)


def telescope(*surfaces, medium_before=AIR, **changes):
    """A telescope of given surfaces whose light is 20 mm wide."""
    basis = {
        "stop_z": 0.0, "pupil_diameter": 0.02, "pupil_obscuration": 0.0, "launch_distance": 2.0,
        "reference_sphere_radius": 1.0, "field_radius": 0.01, "field_limit": 0.5, "wavelength_range": (2e-7, 5e-6),
        "default_wavelength": WAVELENGTH,
    }  # fmt: skip
    return pachon.Telescope("spectrograph", surfaces, medium_before=medium_before, **(basis | changes))


def axes(*degrees):
    return tuple(map(tuple, rotation_matrix(np.radians(degrees)).tolist()))


def grated(shape, grating, *, interaction="MIRROR", after=AIR, rotation=None):
    turn = axes(0.0, 0.0, 0.0) if rotation is None else rotation
    kind = pachon.Interaction[interaction]
    return pachon.Surface("G", kind, shape, (0.001, -0.002, 0.01), after, rotation=turn, grating=grating)


def rays(count=40, seed=3, size=0.01, wavelength=WAVELENGTH):
    """Rays downwards in a cone of some 10 degrees."""
    rng = np.random.default_rng(seed)
    direction = np.stack([*rng.uniform(-0.17, 0.17, (2, count)), -np.ones(count)], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    position = np.stack([*rng.uniform(-size, size, (2, count)), np.full(count, 0.3)], axis=1)
    return pachon.Rays(position, direction, np.zeros(count), wavelength)


SHAPES = {
    "plane": pachon.Plane(),
    "sphere": pachon.Sphere(-0.4),
    "conic": pachon.Conic(0.3, -1.7),
    "asphere": pachon.models.EvenAsphere(-0.5, 0.4, (12.0, -300.0)),
    "toroid": pachon.models.Toroid(-0.6, -0.4, 0.3),
}
#: Ways through a grating: interaction, media before and behind.
WAYS = {
    "mirror": ("MIRROR", AIR, AIR),
    "mirror in water": ("MIRROR", WATER, WATER),
    "into glass": ("REFRACT", AIR, GLASS),
    "out of glass": ("REFRACT", GLASS, AIR),
    "in air": ("REFRACT", AIR, AIR),
}


@pytest.mark.parametrize("order", [-3, 1, 2])
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("shape", SHAPES)
def test_the_grating_equation_in_vectors(shape, way, order):
    """Tangential components of n d grow by m wavelength lines times those of the unit vector across the grooves."""
    interaction, before, after = WAYS[way]
    turn = axes(8.0, -5.0, 20.0)
    grating = pachon.models.Grating(order, 150.0, 0.4)
    surface = grated(SHAPES[shape], grating, interaction=interaction, after=after, rotation=turn)
    start = rays()
    end = pachon.trace(telescope(surface, medium_before=before), start)
    assert (end.status == pachon.RayStatus.OK).all()
    matrix = np.array(turn)
    local = (end.position - surface.vertex) @ matrix
    dx, dy = surface.shape.gradient(local[:, 0], local[:, 1])
    normal = np.stack([-dx, -dy, np.ones_like(dx)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    step = order * WAVELENGTH * 150e3 * np.array([-np.sin(0.4), np.cos(0.4), 0.0])
    coming, leaving = start.direction @ matrix, end.direction @ matrix
    change = after.n * leaving - before.n * coming - step
    # Rounding of sums of some ten products of numbers up to 1.5.
    assert np.abs(np.cross(change, normal)).max() < 4e-15
    assert np.abs(np.linalg.norm(leaving, axis=1) - 1.0).max() < 4e-15
    sides = np.sign((coming * normal).sum(axis=1)) * np.sign((leaving * normal).sum(axis=1))
    assert (sides == (-1.0 if interaction == "MIRROR" else 1.0)).all()
    distance = np.linalg.norm(end.position - start.position, axis=1)
    assert np.abs(end.path_length - before.n * distance - local @ step).max() < 1e-15


def test_order_zero_reflects_and_refracts():
    for interaction, after in (("MIRROR", AIR), ("REFRACT", GLASS)):
        surface = grated(pachon.Sphere(-0.4), pachon.models.Grating(0, 1200.0), interaction=interaction, after=after)
        start = rays()
        ruled, plain = (pachon.trace(telescope(s), start) for s in (surface, replace(surface, grating=None)))
        assert np.abs(ruled.direction - plain.direction).max() < 1e-15
        assert np.array_equal(ruled.position, plain.position)
        assert np.array_equal(ruled.path_length, plain.path_length)


def test_an_order_that_does_not_exist_has_a_status_of_its_own():
    """sin b = sin a + m wavelength lines: beyond one, no light leaves."""
    surface = grated(pachon.Plane(), pachon.models.Grating(2, 1200.0))
    detector = pachon.Surface("D", pachon.Interaction.DETECTOR, pachon.Plane(), (0.0, 0.0, 0.5), AIR)
    start = rays()
    sine = start.direction[:, 1] + 2 * WAVELENGTH * 1.2e6
    exists = start.direction[:, 0] ** 2 + sine**2 < 1.0
    assert not exists.any()
    end = pachon.trace(telescope(surface, detector), start)
    assert (end.status == pachon.RayStatus.EVANESCENT).all()
    for wavelength in (380e-9, 415e-9, 430e-9):
        start = rays(wavelength=wavelength)
        sine = start.direction[:, 1] + 2 * wavelength * 1.2e6
        exists = start.direction[:, 0] ** 2 + sine**2 < 1.0
        end = pachon.trace(telescope(surface), start)
        assert np.array_equal(end.status == pachon.RayStatus.OK, exists)
        assert np.array_equal(end.status == pachon.RayStatus.EVANESCENT, ~exists)


def test_beyond_the_critical_angle_an_order_leaves_the_glass():
    """Totally reflected light of order 0 has orders that pass: sin b = n sin a - wavelength lines."""
    turn = axes(50.0, 0.0, 0.0)
    surface = grated(pachon.Plane(), pachon.models.Grating(-1, 600.0), interaction="REFRACT", rotation=turn)
    ray = pachon.Rays(np.array([[0.0, 0.0, 0.3]]), np.array([[0.0, 0.0, -1.0]]), np.zeros(1), WAVELENGTH)
    glass = telescope(replace(surface, grating=None), medium_before=GLASS)
    assert pachon.trace(glass, ray).status[0] == pachon.RayStatus.TOTAL_REFLECTION
    end = pachon.trace(telescope(surface, medium_before=GLASS), ray)
    incidence = (ray.direction @ np.array(turn))[0, 1]
    sign = np.sign(incidence)
    surface = replace(surface, grating=pachon.models.Grating(-int(sign), 600.0))
    end = pachon.trace(telescope(surface, medium_before=GLASS), ray)
    assert end.status[0] == pachon.RayStatus.OK
    expected = GLASS.n * incidence - sign * WAVELENGTH * 6e5
    assert (end.direction @ np.array(turn))[0, 1] == pytest.approx(expected, abs=1e-15)


@pytest.fixture(scope="module")
def spectrograph():
    """Two gratings, one of them on the back of a lens, and a detector, all tilted."""
    lens = pachon.Surface(
        "front", pachon.Interaction.REFRACT, pachon.Sphere(0.8), (0.0, 0.0, 0.2), GLASS, rotation=axes(3.0, 1.0, 0.0)
    )
    back = pachon.Surface(
        "back", pachon.Interaction.REFRACT, pachon.models.EvenAsphere(-0.7, 0.2, (1.0,)), (0.0, 0.0, 0.19), AIR,
        rotation=axes(-2.0, 4.0, 9.0), grating=pachon.models.Grating(-1, 90.0, 1.2),
    )  # fmt: skip
    mirror = pachon.Surface(
        "mirror", pachon.Interaction.MIRROR, pachon.models.Toroid(0.9, 0.7, -0.4), (0.0, 0.0, 0.0), AIR,
        rotation=axes(12.0, -6.0, 5.0), grating=pachon.models.Grating(2, 120.0, -0.3),
    )  # fmt: skip
    first = telescope(lens, back, mirror)
    ray = pachon.Rays(np.array([[0.0, 0.0, 0.4]]), np.array([[0.0, 0.0, -1.0]]), np.zeros(1), WAVELENGTH)
    end = pachon.trace(first, ray)
    place = end.position[0] + 0.3 * end.direction[0]
    screen = pachon.Surface("D", pachon.Interaction.DETECTOR, pachon.Plane(), tuple(map(float, place)), AIR)
    return telescope(lens, back, mirror, screen)


@pytest.fixture(scope="module")
def responses(spectrograph):
    start = rays(20, size=0.005)
    start = replace(start, direction=np.array([0.02, 0.01, -1.0]) / np.sqrt(1.0005) + 0.0 * start.direction)
    start = replace(start, direction=start.direction / np.linalg.norm(start.direction, axis=1, keepdims=True))
    start = replace(start, position=start.position + np.array([0.0, 0.0, 0.1]))
    forward = forward_pass(spectrograph, start)
    assert (forward.status == pachon.RayStatus.OK).all()
    four = position_and_path(forward)
    table = column_table(spectrograph, [*((s, name) for s in range(4) for name in QUANTITIES), (4, "gap")])
    return start, backward_pass(forward, four, table), four


def outputs(optics, start):
    end = pachon.trace(optics, start)
    return np.concatenate([end.position.T, end.path_length[None]])


def slope(function, h):
    """The first derivative at 0 by differences of two steps, whose error is of the fourth order."""
    near, far = ((function(k * h) - function(-k * h)) / (2 * k * h) for k in (1.0, 2.0))
    return (4.0 * near - far) / 3.0


@pytest.mark.parametrize("name", ["front", "back", "mirror", "D"])
def test_derivatives_by_motions(spectrograph, responses, name):
    start, adjoint, _ = responses
    motion = adjoint.motion(spectrograph.surface_names.index(name))
    for k in range(6):
        way = "shift" if k < 3 else "tilt"

        def moved(h, k=k, way=way):
            optics = spectrograph
            step = h * np.eye(3)[k % 3]
            if way == "shift":
                return outputs(optics.perturbed(name, shift=step), start)
            turned = tuple(s.moved(rotation=rotation_matrix(step)) if s.name == name else s for s in optics.surfaces)
            return outputs(replace(optics, surfaces=turned), start)

        numeric = slope(moved, 1e-5)
        # Rounding of 1e-16 m in the outputs over steps of 1e-5.
        assert np.abs(motion[:, k] - numeric).max() < 2e-10


def test_derivatives_by_sags(spectrograph, responses):
    """A change of the sag that is linear in x and y, with the slopes of it."""
    start, adjoint, _ = responses
    for name in ("back", "mirror"):
        place = spectrograph.surface_names.index(name)
        x, y = adjoint.intersection(place)
        by_sag = adjoint.sag(place)
        for terms in (((0, 0, 1.0),), ((1, 0, 1.0),), ((0, 2, 1.0),)):
            ((i, j, _),) = terms
            value = x**i * y**j
            dx = i * x ** max(i - 1, 0) * y**j
            dy = j * x**i * y ** max(j - 1, 0)
            expected = by_sag[:, 0] * value + by_sag[:, 1] * dx + by_sag[:, 2] * dy

            def changed(h, i=i, j=j, name=name):
                return outputs(spectrograph.with_deformation(name, pachon.models.XYPolynomial(((i, j, h),))), start)

            numeric = slope(changed, 1e-6)
            assert np.abs(expected - numeric).max() < 1e-9 * max(1.0, np.abs(numeric).max())


def test_derivatives_by_indices(spectrograph, responses):
    start, adjoint, _ = responses
    expected = adjoint.index(0)[:, 1] + adjoint.index(1)[:, 0]

    def glass(h):
        front, *others = spectrograph.surfaces
        return outputs(
            replace(spectrograph, surfaces=(replace(front, medium_after=ConstantIndex(GLASS.n + h)), *others)), start
        )

    numeric = slope(glass, 1e-4)
    assert np.abs(expected - numeric).max() < 1e-11

    # The air, in which the mirror stands: behind the lens, in front of and behind the mirror.
    expected = adjoint.index(1)[:, 1] + adjoint.index(2).sum(axis=1) + adjoint.index(3)[:, 0]

    def air(h):
        medium = ConstantIndex(1.0 + h)
        front, *others = spectrograph.surfaces
        surfaces = (front, *(replace(s, medium_after=medium) for s in others))
        return outputs(replace(spectrograph, surfaces=surfaces), start)

    numeric = slope(air, 1e-4)
    assert np.abs(expected - numeric).max() < 1e-11


@pytest.mark.parametrize("name", ["back", "mirror"])
@pytest.mark.parametrize(("quantity", "step"), [("lines_per_mm", 0.5), ("groove_angle", 3e-3)])
def test_derivatives_by_grooves(spectrograph, responses, name, quantity, step):
    start, adjoint, _ = responses
    by_grooves = adjoint.grooves(spectrograph.surface_names.index(name))
    derivative = spectrograph.surface(name).grating.path_derivative(quantity)
    expected = np.einsum("ojn,j->on", by_grooves, derivative)

    def changed(h):
        return outputs(apply(spectrograph, {f"{name}.{quantity}": h}), start)

    numeric = slope(changed, step)
    assert np.abs(expected - numeric).max() < 1e-8 * np.abs(numeric).max()


def test_landing_derivatives_are_those_of_paths(spectrograph, responses):
    """Rays land where the path to a point is stationary: of a wave front the gradient of the path is the direction."""
    start, _, four = responses
    forward = forward_pass(spectrograph, start)
    adjoint = backward_pass(forward, landing_gradient(forward), start=True)
    assert adjoint.start is not None
    assert np.isfinite(adjoint.start).all()
    paths = backward_pass(forward, replace(four, path=np.array([0.0, 0.0, 0.0, 1.0])), start=True).start
    ends = pachon.trace(spectrograph, start)
    # dL along the start less that along the landing point, n d . dQ: Malus and Dupin.
    landing, path = paths[:3, :3], paths[3, :3]
    expected = np.einsum("in,ijn->jn", ends.direction.T, landing) - start.direction.T
    assert np.abs(path - expected).max() < 1e-13


def test_gratings_are_of_mirrors_and_lenses():
    with pytest.raises(PrescriptionError, match="grating: expected a mirror or a lens surface"):
        pachon.Surface(
            "D", pachon.Interaction.DETECTOR, pachon.Plane(), (0, 0, 0), AIR, grating=pachon.models.Grating(1, 1.0)
        )
    with pytest.raises(PrescriptionError, match="lines_per_mm = 0"):
        pachon.models.Grating(1, 0.0)
