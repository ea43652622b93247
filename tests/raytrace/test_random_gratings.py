"""Random systems with gratings, thin lenses, mirrors in glass and tilted freeforms, against a tracer restated here."""

import numpy as np
import pytest

import pachon
from pachon.models.media.medium import ConstantIndex
from pachon.models.rotation import rotation_matrix

WAVELENGTH = 633e-9
RAYS = 25


def random_shape(rng):
    """A shape and its sag, restated."""
    kind = rng.choice(["plane", "conic", "asphere", "toroid", "polynomial"])
    radius = rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 1.0)
    k = rng.uniform(-2.0, 1.0)

    def conic(c, s):
        return c * s / (1.0 + np.sqrt(1.0 - (1.0 + k) * c * c * s))

    if kind == "plane":
        return pachon.Plane(), lambda x, y: 0.0 * x
    if kind == "conic":
        return pachon.Conic(radius, k), lambda x, y: conic(1.0 / radius, x * x + y * y)
    if kind == "asphere":
        a, b = rng.uniform(-20.0, 20.0), rng.uniform(-500.0, 500.0)
        shape = pachon.models.EvenAsphere(radius, k, (a, b))
        return shape, lambda x, y: conic(1.0 / radius, x * x + y * y) + (x * x + y * y) ** 2 * (a + b * (x * x + y * y))
    if kind == "toroid":
        across = rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 1.0)
        a = rng.uniform(-0.5, 0.5)

        def toroid(x, y):
            g = conic(1.0 / radius, y * y) + a * y * y
            side = np.sign(across)
            return across - side * np.sqrt((across - g) ** 2 - x * x)

        return pachon.models.Toroid(across, radius, k, (a,)), toroid
    terms = ((1, 1, rng.uniform(-1, 1)), (3, 0, rng.uniform(-5, 5)), (2, 2, rng.uniform(-50, 50)))
    return pachon.models.XYPolynomial(terms), lambda x, y: sum(a * x**i * y**j for i, j, a in terms)


def normals(sag, x, y):
    """Unit normals by differences of the sag, of the fourth order."""
    h = 1e-4
    slopes = []
    for dx, dy in ((h, 0.0), (0.0, h)):
        near, far = (sag(x + i * dx, y + i * dy) - sag(x - i * dx, y - i * dy) for i in (1, 2))
        slopes.append((8.0 * near - far) / (12.0 * h))
    normal = np.stack([-slopes[0], -slopes[1], np.ones_like(x)], axis=1)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def through(surface, sag, before, position, direction, path):
    """Rays behind one surface."""
    axes = np.array(surface.rotation)
    p, d = (position - surface.vertex) @ axes, direction @ axes
    t = -p[:, 2] / d[:, 2]
    for _ in range(60):
        q = p + t[:, None] * d
        normal = normals(sag, q[:, 0], q[:, 1])
        t = t - (q[:, 2] - sag(q[:, 0], q[:, 1])) * normal[:, 2] / np.sum(d * normal, axis=1)
    q = p + t[:, None] * d
    n, after = before.n, surface.medium_after.n
    path = path + n * t
    if surface.thin_lens is not None:
        f, depth = surface.thin_lens.focal_length, np.abs(d[:, 2])
        slope = (n * d[:, :2] / depth[:, None] - q[:, :2] / f) / after
        d = np.column_stack([slope, np.sign(d[:, 2])])
        d = d / np.linalg.norm(d, axis=1, keepdims=True)
        # Of parallel light: the paths of a plane wave, and those to its image f n' behind.
        return q, d, path, axes
    normal = normals(sag, q[:, 0], q[:, 1])
    side = np.sign(np.sum(d * normal, axis=1, keepdims=True))
    grooves = np.zeros(3)
    if surface.grating is not None:
        m, lines, angle = surface.grating.order, 1e3 * surface.grating.lines_per_mm, surface.grating.groove_angle
        grooves = m * WAVELENGTH * lines * np.array([-np.sin(angle), np.cos(angle), 0.0])
    along = n * d + grooves
    along = along - np.sum(along * normal, axis=1, keepdims=True) * normal
    side = -side if surface.interaction == pachon.Interaction.MIRROR else side
    root = np.sqrt(after**2 - np.sum(along**2, axis=1, keepdims=True))
    return q, (along + side * root * normal) / after, path + q @ grooves, axes


def random_system(seed):
    """Surfaces that follow the light, each tilted, and the rays at every one of them by the tracer above."""
    rng = np.random.default_rng(seed)
    direction = np.stack([*rng.uniform(-0.02, 0.02, (2, RAYS)), -np.ones(RAYS)], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    position = np.stack([*rng.uniform(-0.01, 0.01, (2, RAYS)), np.full(RAYS, 0.5)], axis=1)
    start = pachon.Rays(position, direction, np.zeros(RAYS), WAVELENGTH)
    medium, path, surfaces, expected = ConstantIndex(1.0), np.zeros(RAYS), [], []
    for number in range(rng.integers(2, 6)):
        light = direction.mean(axis=0)
        vertex = position.mean(axis=0) + rng.uniform(0.1, 0.3) * light
        # The z axis against the light or along it, then tilted.
        z = rng.choice([-1.0, 1.0]) * light / np.linalg.norm(light)
        x = np.cross([0.3, 0.9, 0.1], z)
        x /= np.linalg.norm(x)
        axes = np.stack([x, np.cross(z, x), z], axis=1) @ rotation_matrix(np.radians(rng.uniform(-20, 20, 3)))
        rotation = tuple(map(tuple, axes.tolist()))
        kind = rng.choice(["MIRROR", "REFRACT", "THIN_LENS"], p=[0.45, 0.45, 0.1])
        shape, sag = random_shape(rng)
        after, thin, grating = medium, None, None
        if kind == "THIN_LENS":
            shape, sag, thin = (
                pachon.Plane(),
                lambda x, y: 0.0 * x,
                pachon.models.ThinLens(float(rng.uniform(0.3, 1.0))),
            )
        elif rng.uniform() < 0.6:
            grating = pachon.models.Grating(
                int(rng.integers(-3, 4)), float(rng.uniform(20, 300)), float(rng.uniform(-3, 3))
            )
        if kind == "REFRACT":
            after = ConstantIndex(float(rng.choice([1.0, 1.33, 1.5, 1.8])))
        surface = pachon.Surface(
            f"S{number}", pachon.Interaction[kind], shape, tuple(map(float, vertex)), after, rotation=rotation,
            grating=grating, thin_lens=thin,
        )  # fmt: skip
        with np.errstate(invalid="ignore"):
            local, leaving, path, frame = through(surface, sag, medium, position, direction, path)
        bounded = np.isfinite(leaving).all() and np.abs(local[:, :2]).max() < 0.08
        if not bounded:
            break
        position, direction = local @ frame.T + surface.vertex, leaving @ frame.T
        medium = after
        surfaces.append(surface)
        expected.append((position, direction, path if thin is None else np.full(RAYS, np.nan)))
        if thin is not None:
            path = np.full(RAYS, np.nan)
    return start, surfaces, expected


def compare(seeds):
    gratings = 0
    for seed in seeds:
        start, surfaces, expected = random_system(seed)
        if not surfaces:
            continue
        telescope = pachon.Telescope(
            "random", tuple(surfaces), stop_z=0.0, pupil_diameter=0.02, pupil_obscuration=0.0, launch_distance=2.0,
            reference_sphere_radius=1.0, field_radius=0.01, field_limit=0.5, wavelength_range=(2e-7, 5e-6),
            default_wavelength=WAVELENGTH,
        )  # fmt: skip
        for met, (position, direction, path) in zip(pachon.trace(telescope, start, "all"), expected, strict=True):
            assert (met.status == pachon.RayStatus.OK).all(), seed
            # Slopes by differences: 1e-11, over some decimetres.
            assert np.abs(met.position - position).max() < 1e-10, seed
            assert np.abs(met.direction - direction).max() < 1e-9, seed
            assert np.isnan(path).all() or np.abs(met.path_length - path).max() < 1e-10, seed
        gratings += sum(s.grating is not None for s in surfaces)
    return gratings


@pytest.mark.long
def test_a_few_random_systems():
    assert compare(range(12)) > 5


@pytest.mark.slow
def test_many_random_systems():
    assert compare(range(100, 1000)) > 500
