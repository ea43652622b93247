"""Ideal thin lenses: points to points with equal paths, and their derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from adjoint_outputs import position_and_path

import pachon
from pachon.core.errors import PrescriptionError
from pachon.models.media.medium import ConstantIndex
from pachon.models.rotation import rotation_matrix
from pachon.models.surface import IDENTITY
from pachon.raytrace.adjoint.backward_pass import backward_pass
from pachon.raytrace.adjoint.forward_pass import forward_pass

WAVELENGTH = 550e-9
AIR, WATER = ConstantIndex(1.0), ConstantIndex(1.33)


def axes(*degrees):
    return tuple(map(tuple, rotation_matrix(np.radians(degrees)).tolist()))


def telescope(*surfaces, medium_before=AIR):
    return pachon.Telescope(
        "lenses", surfaces, stop_z=0.0, pupil_diameter=0.02, pupil_obscuration=0.0, launch_distance=2.0,
        reference_sphere_radius=0.5, field_radius=0.01, field_limit=0.5, wavelength_range=(2e-7, 5e-6),
        default_wavelength=WAVELENGTH, medium_before=medium_before,
    )  # fmt: skip


def lens(focal_length, distance=np.inf, *, after=AIR, vertex=(0.0, 0.0, 0.0), rotation=IDENTITY, name="L"):
    return pachon.Surface(
        name, pachon.Interaction.THIN_LENS, pachon.Plane(), vertex, after, rotation=rotation,
        thin_lens=pachon.models.ThinLens(focal_length, distance),
    )  # fmt: skip


CASES = [(0.1, 0.3), (0.1, 0.05), (-0.2, 0.3), (0.1, -0.4), (0.2, np.inf), (0.25, 0.25)]


@pytest.mark.parametrize("media", [(AIR, AIR), (AIR, WATER), (WATER, AIR)])
@pytest.mark.parametrize(("focal_length", "distance"), CASES)
def test_points_to_points_with_equal_paths(focal_length, distance, media):
    """n' / l' = 1 / f - n / l, image heights by the ray through the vertex; paths between the two points are equal."""
    before, after = media
    surface = lens(focal_length, distance, after=after)
    rng = np.random.default_rng(2)
    points = np.stack([*rng.uniform(-0.02, 0.02, (2, 30)), np.zeros(30)], axis=1)
    if np.isinf(distance):
        direction = np.tile([0.12, -0.05, -1.0] / np.linalg.norm([0.12, -0.05, -1.0]), (30, 1))
        paths = points @ direction[0]
    else:
        target = np.array([0.03, -0.01, distance]) - points
        direction = -np.sign(distance) * target / np.linalg.norm(target, axis=1, keepdims=True)
        paths = np.sign(distance) * np.linalg.norm(target, axis=1)
    start = pachon.Rays(points - 0.01 * direction, direction, np.zeros(30), WAVELENGTH)
    end = pachon.trace(telescope(surface, medium_before=before), start)
    assert np.abs(np.linalg.norm(end.direction, axis=1) - 1.0).max() < 4e-16
    added = end.path_length - before.n * 0.01
    vergence = (1.0 / focal_length - before.n / distance) / after.n
    slopes = end.direction[:, :2] / -end.direction[:, 2:]
    if abs(vergence) < 1e-12:
        # Parallel light: planes across it.
        assert np.abs(slopes - slopes[0]).max() < 1e-14
        behind = -after.n * points @ end.direction[0]
    else:
        image = 1.0 / vergence
        landed = points[:, :2] + image * slopes
        # Of an image at some metres the rounding of slopes.
        assert np.abs(landed - landed[0]).max() < 1e-15 * max(1.0, abs(image)) * 5
        behind = after.n * np.sign(image) * np.hypot(image, np.linalg.norm(landed[0] - points[:, :2], axis=1))
    total = before.n * paths + added + behind
    assert np.abs(total - total[0]).max() < 5e-15 * max(1.0, abs(1.0 / vergence) if abs(vergence) > 1e-12 else 1.0)


def test_a_lens_works_both_ways():
    surface = lens(0.1)
    up = pachon.Rays(np.array([[0.01, 0.0, -0.1]]), np.array([[0.0, 0.0, 1.0]]), np.zeros(1), WAVELENGTH)
    end = pachon.trace(telescope(surface), up)
    assert np.allclose(end.direction[0], np.array([-0.1, 0.0, 1.0]) / np.sqrt(1.01), atol=1e-16)


@pytest.fixture(scope="module")
def system():
    turn = axes(6.0, -4.0, 15.0)
    first = lens(0.4, 0.7, vertex=(0.001, 0.002, 0.3), rotation=turn, after=WATER, name="first")
    mirror = pachon.Surface("mirror", pachon.Interaction.MIRROR, pachon.Sphere(1.5), (0.0, 0.0, 0.0), WATER)
    second = lens(-0.3, -0.2, vertex=(0.0, 0.003, 0.2), rotation=axes(-3.0, 5.0, 0.0), name="second")
    screen = pachon.Surface("D", pachon.Interaction.DETECTOR, pachon.Plane(), (0.0, 0.0, 0.5), AIR)
    return telescope(first, mirror, second, screen)


def start(count=20):
    rng = np.random.default_rng(3)
    direction = np.stack([*rng.uniform(-0.03, 0.03, (2, count)), -np.ones(count)], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    position = np.stack([*rng.uniform(-0.01, 0.01, (2, count)), np.full(count, 0.6)], axis=1)
    return pachon.Rays(position, direction, np.zeros(count), WAVELENGTH)


@pytest.mark.parametrize("name", ["first", "mirror", "second"])
def test_derivatives_by_motions(system, name):
    rays = start()
    forward = forward_pass(system, rays)
    assert (forward.status == pachon.RayStatus.OK).all()
    four = position_and_path(forward)
    motion = backward_pass(forward, four).motion(system.surface_names.index(name))
    for k in range(6):

        def moved(h, k=k):
            step = h * np.eye(3)[k % 3]
            keys = {"shift": step} if k < 3 else {"rotation": rotation_matrix(step)}
            surfaces = [s.moved(**keys) if s.name == name else s for s in system.surfaces]
            end = pachon.trace(replace(system, surfaces=tuple(surfaces)), rays)
            return np.concatenate([end.position.T, end.path_length[None]])

        near, far = ((moved(i * 1e-5) - moved(-i * 1e-5)) / (i * 2e-5) for i in (1.0, 2.0))
        numeric = (4.0 * near - far) / 3.0
        # Rounding of 1e-16 m in the outputs over steps of 1e-5.
        assert np.abs(motion[:, k] - numeric).max() < 3e-10


@pytest.mark.parametrize("gaps", [(0,), (1, 2), (3,)])
def test_derivatives_by_refractive_indices(system, gaps):
    """Of the medium in gaps in front of surfaces: before both lenses, between them, where a mirror is, and after."""
    rays = start()
    forward = forward_pass(system, rays)
    four = position_and_path(forward)
    matrix = backward_pass(forward, four)
    found = sum(matrix.index(gap)[:, 0] + (matrix.index(gap - 1)[:, 1] if gap else 0.0) for gap in gaps)

    def changed(h):
        media = [system.medium_before, *(s.medium_after for s in system.surfaces)]
        for gap in gaps:
            media[gap] = ConstantIndex(media[gap].n + h)
        surfaces = tuple(replace(s, medium_after=m) for s, m in zip(system.surfaces, media[1:], strict=True))
        end = pachon.trace(replace(system, surfaces=surfaces, medium_before=media[0]), rays)
        return np.concatenate([end.position.T, end.path_length[None]])

    numeric = (8.0 * (changed(1e-4) - changed(-1e-4)) - (changed(2e-4) - changed(-2e-4))) / 12e-4
    # Rounding of 1e-16 m in the outputs over steps of 1e-4.
    assert np.abs(found - numeric).max() < 1e-11
    assert np.abs(numeric[:3]).max() > 1e-4


def test_thin_lenses_are_planes_with_a_lens():
    with pytest.raises(PrescriptionError, match="thin_lens: expected one of a thin lens, and of that alone"):
        pachon.Surface("L", pachon.Interaction.THIN_LENS, pachon.Plane(), (0, 0, 0), AIR)
    with pytest.raises(PrescriptionError, match="shape Sphere: expected a plane of a thin lens"):
        replace(lens(0.1), shape=pachon.Sphere(1.0))
    with pytest.raises(PrescriptionError, match=r"focal_length = 0\.0"):
        pachon.models.ThinLens(0.0)
