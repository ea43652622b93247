"""Derivatives of rays against central differences, closed forms, and each other."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.models.aperture import Circle
from pachon.models.shapes.mesh import MeshSurface
from pachon.models.shapes.polynomial import ZernikeSag
from pachon.models.shapes.shape import Conic, Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM
from pachon.raytrace.adjoint.adjoint_matrix import column_table, polynomial_terms
from pachon.raytrace.adjoint.backward_pass import OutputGradient, backward_pass, landing_gradient, position_gradient
from pachon.raytrace.adjoint.forward_pass import forward_pass
from pachon.raytrace.adjoint.sphere_adjoint import SphereAdjoint
from pachon.raytrace.rays import RayStatus, field_direction
from pachon.wavefront.reference_sphere import path_to_sphere, sphere_distance_derivatives

RADIUS = 5.0
FIELD, WAVELENGTH = (0.01, 0.02), 620e-9


def bare(telescope):
    """Return the telescope without apertures: differences must not lose rays."""
    return replace(telescope, surfaces=tuple(replace(s, aperture=None) for s in telescope.surfaces))


@pytest.fixture(scope="module")
def crooked(lsst_r):
    """A misaligned LSST with a Zernike deformation of M3 and a phase screen in front of the filter."""
    moved = bare(lsst_r).perturbed("M2", shift=(1e-3, 2e-3, 1e-4), tilt=(1e-4, 2e-4, 0.01))
    moved = moved.perturbed("Camera", shift=(1e-3, -2e-3, 1e-4), tilt=(1e-4, -2e-4, 0.03))
    moved = moved.with_deformation("M3", ZernikeSag((0.0,) * 6 + (2e-6, -3e-6, 1e-6), 2.508, 0.55))
    where = moved.surface_names.index("Filter_entrance")
    ahead = moved.surfaces[where]
    screen = Surface(
        "screen",
        Interaction.PHASE,
        ZernikeSag((0.0, 0.0, 0.0, 2e-6, 1e-6, 0.0, 3e-6), 0.4),
        tuple(np.array(ahead.vertex) - [0, 0, 0.1]),
        VACUUM,
        rotation=ahead.rotation,
    )
    return replace(moved, surfaces=(*moved.surfaces[:where], screen, *moved.surfaces[where:]))


@pytest.fixture(scope="module")
def rays(crooked, annulus_points):
    return pachon.launch_rays(crooked, FIELD, WAVELENGTH, annulus_points(45, seed=4))


@pytest.fixture(scope="module")
def forward(crooked, rays):
    return forward_pass(crooked, rays)


@pytest.fixture(scope="module")
def center(forward):
    # Off the rays, so that all terms of the sphere count.
    return forward.position[:, 0] + [2e-5, 1e-5, 0.0]


@pytest.fixture(scope="module")
def outputs(rays, center):
    def of(telescope):
        """Landing x and y in the detector's frame, and path to the sphere."""
        end = pachon.trace(telescope, rays)
        landing = telescope.surfaces[-1].to_local(end.position)[:, :2].T
        return np.stack([*landing, path_to_sphere(end.path_length, 1.0, end.position, end.direction, center, RADIUS)])

    return of


@pytest.fixture(scope="module")
def responses(forward, center):
    where = np.repeat(center[:, None], forward.n_rays, axis=1)
    distance, by_position, by_direction = sphere_distance_derivatives(
        forward.position, forward.direction, where, RADIUS
    )
    to_sphere = OutputGradient(by_position[None], by_direction[None], np.ones(1), index=distance[None])
    return backward_pass(forward, landing_gradient(forward)), backward_pass(forward, to_sphere)


def both(responses, surface, what):
    return np.concatenate([getattr(r, what)(surface) for r in responses])


# Differences of numbers near 30 m, good to 4e-15 m, over steps of 2e-4: 2e-11, and so twenty times that. Outputs move
# by 1 to 10 m per m or rad.
ROUNDING = 4e-10


@pytest.mark.parametrize("k", range(13))
def test_motions_of_each_surface(crooked, outputs, responses, slope, k):
    surface = crooked.surfaces[k]
    motion = both(responses, k, "motion")
    for axis in range(3):
        unit = np.eye(3)[axis]
        shift = slope(lambda h, v=unit: outputs(crooked.perturbed(surface.name, shift=h * v)), 2e-4)
        assert np.abs(shift - motion[:, axis]).max() < ROUNDING
        # A tilt about its own axis through the vertex, as a motion v + w x r of the telescope frame.
        w = surface.matrix[:, axis]
        twist = np.concatenate([-np.cross(w, surface.vertex), w])
        tilt = slope(lambda h, v=unit: outputs(crooked.perturbed(surface.name, tilt=h * v)), 1e-4)
        assert np.abs(tilt - np.einsum("oin,i->on", motion, twist)).max() < ROUNDING


@pytest.mark.parametrize(
    ("name", "parameter", "step"),
    [
        ("M1", "radius", 1e-3),
        ("M1", "conic", 1e-3),
        ("M1", "a6", 1e-9),
        ("M2", "a8", 1e-7),
        ("M3", "Z8", 1e-5),
        ("M3", "a6", 1e-8),
        ("L2_exit", "conic", 1e-2),
        ("L2_entrance", "curvature", 1e-4),
        ("screen", "Z7", 1e-5),
        ("screen", "Z4", 1e-5),
    ],
)
def test_shape_parameters(crooked, outputs, responses, slope, name, parameter, step):
    k = crooked.surface_names.index(name)
    shape = crooked.surfaces[k].shape
    value = shape.parameters[parameter]
    f, fx, fy = shape.sag_derivative(parameter, *responses[0].intersection(k))
    sag = both(responses, k, "sag")
    change = step * (sag[:, 0] * f + sag[:, 1] * fx + sag[:, 2] * fy)
    numeric = slope(lambda h: outputs(crooked.with_shape(name, shape.with_parameter(parameter, value + h * step))), 1.0)
    # 4e-15 m of rounding in each of the outputs, as above; changes are 1e-8 to 1e-4 m.
    assert np.abs(change).max() > 1e-9
    assert np.abs(change - numeric).max() < 4e-14 + 1e-9 * np.abs(numeric).max()


@pytest.mark.parametrize("k", [3, 4, 8, 11])
def test_indices(forward, responses, rays, slope, k, monkeypatch, center, crooked):
    """The index behind surface k, changed in the kernel's own table: of the next one it is the index in front."""
    from pachon.raytrace import trace as module

    plain = module.indices_and_wavelength

    def outputs(h):
        def changed(telescope, wavelength):
            index = plain(telescope, wavelength)
            index[k + 1] += h
            return index

        monkeypatch.setattr(module, "indices_and_wavelength", changed)
        end = pachon.trace(crooked, rays)
        monkeypatch.setattr(module, "indices_and_wavelength", plain)
        landing = crooked.surfaces[-1].to_local(end.position)[:, :2].T
        last = changed(crooked, WAVELENGTH)[-3]
        return np.stack([*landing, path_to_sphere(end.path_length, last, end.position, end.direction, center, RADIUS)])

    found = both(responses, k, "index")[:, 1] + both(responses, k + 1, "index")[:, 0]
    numeric = slope(outputs, 1e-4)
    assert np.abs(found - numeric).max() < ROUNDING * max(1.0, np.abs(numeric).max())


def test_start_of_the_rays(crooked, rays, forward, slope):
    response = backward_pass(forward, position_gradient(forward), start=True)
    for axis in range(6):
        unit = np.eye(6)[axis]

        def landing(h, unit=unit):
            direction = rays.direction + h * unit[3:]
            moved = replace(rays, position=rays.position + h * unit[:3], direction=direction)
            return pachon.trace(crooked, moved).position.T

        # The direction is a free vector in the derivative, but a unit vector in the trace: compare across it.
        if axis < 3:
            assert np.abs(slope(landing, 1e-3) - response.start[:, axis]).max() < ROUNDING
    across = np.cross(rays.direction, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across, axis=1)[:, None]

    def turned(h):
        direction = np.cos(h) * rays.direction + np.sin(h) * across
        return pachon.trace(crooked, replace(rays, direction=direction)).position.T

    expected = np.einsum("oin,ni->on", response.start[:, 3:], across)
    # Plate scale 10 m a radian, rounding as above.
    assert np.abs(slope(turned, 1e-4) - expected).max() < 10 * ROUNDING


def test_moving_everything_is_moving_the_light(forward, responses):
    """Forces and torques telescope: the sum over all surfaces is that of the light, the other way round."""
    landing, path = responses
    count = len(forward.telescope.surfaces)
    total = sum(path.motion(k) for k in range(count))
    assert np.allclose(total, path.gap(count) - path.gap(0), atol=1e-13)
    # In the detector's own frame nothing is left behind it.
    assert np.abs(landing.gap(count)).max() == 0.0


def test_a_plane_mirror_turns_light_by_twice_its_tilt(lsst_r):
    def flat(name, kind, z):
        return Surface(name, kind, Plane(), (0.0, 0.0, z), VACUUM)

    folded = replace(
        lsst_r,
        surfaces=(flat("mirror", Interaction.MIRROR, 0.0), flat("detector", Interaction.DETECTOR, 3.0)),
        groups={},
        group_frames={},
    )
    rays = pachon.launch_rays(folded, (0.0, 0.0), WAVELENGTH, ([0.5, 0.0], [0.0, -1.5]))
    forward = forward_pass(folded, rays)
    turn = backward_pass(forward, landing_gradient(forward)).motion(0)[:, 3:]
    # About y by a: the light turns by 2 a towards +x over 3 m; the hit at x rises by -a x, which moves nothing here.
    assert np.allclose(turn[0, 1], 2 * 3.0, atol=1e-14)
    assert np.allclose(turn[1, 0], -2 * 3.0, atol=1e-14)


def test_a_change_of_sag_is_a_change_of_path(perfect):
    """Raised by f, a mirror moves by f cos(i) along its normal and shortens the path by 2 f cos(i)^2; slope tan(i)."""
    telescope, rays = perfect
    forward = forward_pass(telescope, rays)
    where = np.repeat(forward.position[:, :1], forward.n_rays, axis=1)
    _, by_position, by_direction = sphere_distance_derivatives(forward.position, forward.direction, where, 1.0)
    response = backward_pass(forward, OutputGradient(by_position[None], by_direction[None], np.ones(1)))
    sx, sy = telescope.surfaces[0].shape.gradient(*response.intersection(0))
    assert np.allclose(response.sag(0)[0, 0], -2.0 / (1.0 + sx**2 + sy**2), atol=1e-14)
    # Fermat: slopes turn a ray about its focus, which changes no path.
    assert np.abs(response.sag(0)[0, 1:]).max() < 1e-14


@pytest.fixture(scope="module")
def perfect():
    """One paraboloid with a detector in its focus: rays of the axis meet in one point, all paths equal."""
    mirror = Surface("mirror", Interaction.MIRROR, Conic(4.0, -1.0), (0.0, 0.0, 0.0), VACUUM)
    detector = Surface("detector", Interaction.DETECTOR, Plane(), (0.0, 0.0, 2.0), VACUUM)
    base = pachon.load_telescope("paul_baker")
    telescope = replace(base, surfaces=(mirror, detector), groups={}, group_frames={}, stop_z=0.0)
    return telescope, pachon.launch_rays(telescope, (0.0, 0.0), WAVELENGTH, ([0.3, 0.0, 0.5], [0.0, 0.4, 0.5]))


def test_polynomials(forward, crooked):
    wanted = {(0, "sag"), (0, "intersection"), (7, "sag"), (7, "intersection")}
    rows = column_table(crooked, wanted)
    first, blocks = int(rows.max()) + 1, []
    for surface, scale, degree in ((0, 4.0, 7), (7, 0.5, 4)):
        terms = polynomial_terms(degree)
        places = np.arange(first, first + len(terms), dtype=np.int32)
        # A term left out takes no column.
        places[3] = -1
        places[4:] -= 1
        blocks.append((surface, scale, degree, places))
        first = int(places.max()) + 1
    response = backward_pass(forward, landing_gradient(forward), rows, polynomials=blocks)
    assert response.values.shape[1] == first
    for surface, scale, degree, places in blocks:
        f, gx, gy = np.moveaxis(response.sag(surface), 1, 0)
        x, y = response.intersection(surface) / scale
        for (m, k, imaginary), row in zip(polynomial_terms(degree), places, strict=True):
            if row < 0:
                continue
            z, s = x + 1j * y, x * x + y * y
            power = m * z ** max(m - 1, 0)
            radial = k * s ** max(k - 1, 0)
            along_x = 2 * x * radial * z**m + s**k * power
            along_y = 2 * y * radial * z**m + 1j * s**k * power
            whole = f * s**k * z**m + (gx * along_x + gy * along_y) / scale
            expected = whole.imag if imaginary else whole.real
            # A handful of rounding steps.
            assert np.abs(response.values[:, row] - expected).max() < 1e-13 * max(1.0, np.abs(expected).max())


@pytest.mark.parametrize("lit_only", [False, True])
def test_one_kernel_equals_forward_and_backward_pass(crooked, annulus_points, forward, center, responses, lit_only):
    rows = column_table(
        crooked, {(0, "sag"), (0, "intersection"), (5, "index"), (12, "index"), (1, "gap"), (13, "gap")}
    )
    first = int(rows.max()) + 1
    stopped = replace(crooked, surfaces=(replace(crooked.surfaces[0], aperture=Circle(3.6)), *crooked.surfaces[1:]))
    directions = field_direction(*np.transpose([(0.0, 0.01), FIELD]))
    centers, zeros = np.stack([forward.position[:, 5], center], axis=1), np.array([3.0, 17.0])
    pupil = np.stack(annulus_points(45, seed=4), axis=1)
    one_go = SphereAdjoint(
        stopped, directions, forward.packets.light, pupil, centers, zeros, RADIUS, rows, first, lit_only=lit_only
    )
    one = [one_go.matrix(slice(0, 2), threads=n) for n in (1, 2, 5)]
    for response, status in one[1:]:
        assert np.array_equal(response.values, one[0][0].values)
        assert np.array_equal(status, one[0][1])
    # A field point does not depend on those before it.
    response, status = one_go.matrix(slice(1, 2))
    assert np.array_equal(response.values, one[0][0].values[:, :, 1:])
    assert np.array_equal(status, one[0][1][1:])
    vignetted = status[0] == RayStatus.VIGNETTED
    assert 5 < vignetted.sum() < 40
    assert (status[0][~vignetted] == RayStatus.OK).all()
    counts = np.where(vignetted & lit_only, 0.0, 1.0)
    values = response.values[0, :, 0]
    where = np.repeat(center[:, None], len(pupil), axis=1)
    distance, by_position, _ = sphere_distance_derivatives(forward.position, forward.direction, where, RADIUS)
    assert np.allclose(values[first], counts * (forward.path_length + distance - 17.0), atol=2e-14)
    assert np.allclose(values[first + 1 : first + 4], counts * by_position, atol=1e-14)
    # The rays start where NumPy puts them, but for rounding of some ten metres.
    assert np.allclose(response.intersection(0)[:, 0], responses[1].intersection(0), atol=2e-14)
    for what, surface in (("sag", 0), ("index", 5), ("index", 12), ("gap", 1), ("gap", 13)):
        # The same arithmetic but for the order of a few sums.
        expected = counts * getattr(responses[1], what)(surface)
        assert np.allclose(getattr(response, what)(surface)[:, :, 0], expected, atol=2e-13)


def test_a_mesh_is_refused(crooked):
    x, y = np.meshgrid(np.linspace(-5.0, 5.0, 3), np.linspace(-5.0, 5.0, 3))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(9)], axis=-1)
    faces = [(i, i + 1, i + 4) for i in (0, 1, 3, 4)] + [(i, i + 4, i + 3) for i in (0, 1, 3, 4)]
    meshed = crooked.with_shape("M3", MeshSurface(vertices, np.array(faces)))
    point = np.zeros((1, 2))
    with pytest.raises(DomainError, match="surface M3: expected a shape that can be differentiated, not a mesh"):
        forward_pass(meshed, pachon.launch_rays(meshed, FIELD, WAVELENGTH, point.T))
    rows = column_table(meshed, ())
    with pytest.raises(DomainError, match="surface M3: expected a shape that can be differentiated, not a mesh"):
        SphereAdjoint(
            meshed, np.array([[0.0, 0.0, -1.0]]), np.ones(15), point, np.zeros((3, 1)), np.zeros(1), 5.0, rows, 0
        )


def test_lost_rays_do_not_spoil_others(crooked, annulus_points):
    px, py = annulus_points(40, seed=4)
    far = np.concatenate([px[:20], [60.0], px[20:]]), np.concatenate([py[:20], [0.0], py[20:]])
    some = forward_pass(crooked, pachon.launch_rays(crooked, FIELD, WAVELENGTH, far))
    others = forward_pass(crooked, pachon.launch_rays(crooked, FIELD, WAVELENGTH, (px, py)))
    assert some.arrived.sum() == 40
    with_lost = backward_pass(some, landing_gradient(some)).values[:, :, some.arrived]
    assert np.array_equal(with_lost, backward_pass(others, landing_gradient(others)).values)
