"""Moments that stars share through layers on the ground, each as far as its light takes the same part of the pupil."""

import numpy as np

from pachon.wavefront.atmosphere.field_pupils import FieldPupils
from pachon.wavefront.atmosphere.ground_moments import GroundMoments, ground_covariance, ground_factor
from pachon.wavefront.atmosphere.moment_covariance import ExposedAir, moment_covariance
from pachon.wavefront.atmosphere.slope_covariance import slope_covariance
from pachon.wavefront.pupil_sampling import spiral_annulus

DIAMETER, HOLE, SIDE, EXPOSURE = 8.0, 0.5, 12, 15.0
# Turbulence of more than a metre, of which few points make the sums.
AIR = ExposedAir((0.0, 6000.0), (0.6, 0.4), ((3.0, 1.0), (20.0, 5.0)), EXPOSURE, 0.16, 25.0, 6.0, DIAMETER, HOLE)


def parts(x, y):
    """The full pupil, its left half, and what is left of it where the light is cut off on that side, [3, ...]."""
    full = (np.hypot(x, y) < 0.5 * DIAMETER) & (np.hypot(x, y) > 0.5 * HOLE * DIAMETER)
    return np.stack([full, full & (x < 0.0), full & (x > -1.0)]).astype(np.float64)


def pupils(rays=4):
    """Cells of these pupils, as of one star at the centre of the field and two on a ring."""
    line = DIAMETER * ((np.arange(SIDE * rays) + 0.5) / (SIDE * rays) - 0.5)
    cells = parts(*np.meshgrid(line, line)).reshape(3, SIDE, rays, SIDE, rays).mean(axis=(2, 4))
    return FieldPupils(np.array([0.0, 0.01]), 2, DIAMETER, cells, cells[0])


def by_brute_force(count=120):
    """Covariances of p, q, s through pairs of the pupils: sums over pairs of points, other ones at each moment."""
    table = slope_covariance(AIR.r0, AIR.outer_scale, AIR.cutoff)
    spiral = spiral_annulus(0.5 * DIAMETER, HOLE, 120).points
    rng = np.random.default_rng(0)

    def pupil_points():
        turn = rng.uniform(0.0, 2.0 * np.pi)
        points = spiral @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        light = parts(*points.T)
        return points, light / light.sum(axis=1, keepdims=True)

    def means(delay):
        (first, light), (second, other) = pupil_points(), pupil_points()
        apart = first[:, None] - second + np.array(AIR.velocities[0]) * delay
        square = (apart**2).sum(axis=-1)
        knot = np.minimum(np.rint(np.sqrt(square) / table.step).astype(int), len(table.isotropic) - 1)
        same, directed = AIR.weights[0] * table.isotropic[knot], AIR.weights[0] * table.directed[knot]
        difference = directed * (apart[..., 0] ** 2 - apart[..., 1] ** 2)
        slopes = same + difference, 2.0 * directed * apart[..., 0] * apart[..., 1], same - difference
        return light @ wick(*slopes) @ other.T, np.stack([light @ s @ other.T for s in slopes])

    def wick(a, b, c):
        return np.stack([2 * (a * a + c * c - 2 * b * b), 4 * (a * c + b * b), 2 * (a * a + 2 * b * b + c * c)])

    products, mean = 0.0, {}
    for k in range(count):
        draws = [means((k + shift) * EXPOSURE / count) for shift in (-0.25, 0.25)]
        product, mean[k] = (np.mean([draw[n] for draw in draws], axis=0) for n in (0, 1))
        products = products + (count - k) / count**2 * (product + np.swapaxes(product, 1, 2)) * (1.0 if k else 0.5)
        mean[-k] = np.swapaxes(mean[k], 1, 2)
    of_moments = np.array([[mean[i - j] for j in range(count)] for i in range(count)])  # [count, count, 3, n, n]
    lost = sum(np.mean([wick(*s) for s in of_moments.mean(axis=axis)], axis=0) for axis in (0, 1))
    return np.moveaxis(products - lost + wick(*of_moments.mean(axis=(0, 1))), 0, 2)


def test_covariances_through_unlike_pupils_are_sums_over_their_points():
    of_nodes = ground_covariance(AIR.on_ground(), pupils())[..., :3]
    expected = by_brute_force()
    scale = expected[0, 0]
    np.testing.assert_allclose(of_nodes / scale, expected / scale, atol=0.03)
    # Parts of the pupil have more of a variance, and share less of it.
    assert (of_nodes[1, 1] > 1.05 * scale).all()
    assert (of_nodes[1, 2] < 0.9 * of_nodes[1, 1]).all()


def test_the_full_pupil_has_the_covariance_of_its_baselines():
    alone = moment_covariance(AIR.on_ground(), np.zeros((1, 2))).second[0]
    np.testing.assert_allclose(ground_covariance(AIR.on_ground(), pupils())[0, 0], alone, atol=0.01 * alone[2])


def test_drawn_moments_have_these_covariances():
    shared = np.diag([2.0, 3.0, 4.0])
    factor = ground_factor(AIR, (1.0,), pupils(), shared)
    covariance = (factor @ factor.T).reshape(3, 3, 3, 3)
    # Through the full pupil they are what stars share; the first three numbers make them.
    np.testing.assert_allclose(covariance[0, :, 0], shared, atol=0.06)
    assert np.array_equal(np.triu(factor[:3], 1), np.zeros((3, 9)))
    assert covariance[1, 0, 1, 0] > 1.05 * covariance[0, 0, 0, 0]


def test_without_layers_on_the_ground_all_pupils_share_the_same():
    high = AIR._replace(altitudes=(5000.0, 6000.0))
    drawn = GroundMoments.draw(ground_factor(high, (1.0,), pupils(), np.eye(3)), pupils(), np.arange(9.0))
    assert np.array_equal(drawn.values, np.repeat(np.arange(3.0)[None], 3, axis=0))


def test_between_rings_and_directions_moments_are_interpolated():
    of_rings = FieldPupils(np.array([0.0, 0.01, 0.02]), 8, DIAMETER, np.zeros((17, 2, 2)), np.zeros((2, 2)))
    angle = 2.0 * np.pi * np.arange(8) / 8
    nodes = np.concatenate(
        [[[0.0, 0.0]], *(r * np.stack([np.cos(angle), np.sin(angle)], axis=1) for r in (0.01, 0.02))]
    )
    np.testing.assert_allclose(of_rings.weights(nodes), np.eye(17), atol=1e-12)
    places = np.random.default_rng(1).uniform(-0.02, 0.02, (50, 2))
    weights = of_rings.weights(places)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    # Linear functions of the field are linear in the radius, and of the first order in the direction.
    inside = np.hypot(*places.T) < 0.02
    np.testing.assert_allclose((weights @ nodes)[inside], places[inside], atol=1e-12)
