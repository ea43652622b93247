"""Shapes against closed forms, differences, and batoid."""

import numpy as np
import pytest

from pachon.core.errors import PrescriptionError, UnknownNameError
from pachon.models.shapes.freeform import Biconic, OddAsphere, Toroid
from pachon.models.shapes.grid import GridSag
from pachon.models.shapes.polynomial import XYPolynomial, ZernikeSag
from pachon.models.shapes.qbfs import QbfsAsphere
from pachon.models.shapes.shape import Conic, EvenAsphere, Plane, Sphere
from pachon.models.shapes.sum import Sum
from pachon.models.zernike_polynomials import annular_zernikes

RNG = np.random.default_rng(7)
X, Y = RNG.uniform(-0.9, 0.9, (2, 300))
NODES_X, NODES_Y = np.linspace(-1.0, 1.0, 21), np.linspace(-1.1, 1.1, 15)
GRID = GridSag(NODES_X, NODES_Y, 0.01 * np.sin(3 * NODES_X) * np.cos(2 * NODES_Y)[:, None])
SHAPES = {
    "plane": Plane(),
    "sphere": Sphere(3.0),
    "conic": Conic(-4.0, -1.3),
    "even asphere": EvenAsphere(5.0, 0.3, (1e-3, 2e-4, -1e-5)),
    "flat asphere": EvenAsphere(np.inf, 0.0, (1e-3, -2e-4)),
    "odd asphere": OddAsphere(5.0, -0.4, (0.0, 1e-2, 3e-3, -2e-3, 1e-3)),
    "cone": OddAsphere(np.inf, 0.0, (0.05,)),
    "biconic": Biconic(4.0, -6.0, -0.3, 0.8),
    "biconic cylinder": Biconic(4.0, np.inf),
    "toroid": Toroid(4.0, 6.0, -0.7),
    "toroid cylinder": Toroid(np.inf, 5.0),
    "toroid with powers": Toroid(4.0, -6.0, -0.7, (2e-3, -1e-3, 3e-4)),
    "powers alone": Toroid(np.inf, np.inf, 0.0, (2e-2, -1e-3)),
    "qbfs": QbfsAsphere(5.0, 0.0, 1.6, (1e-2, -4e-3, 2e-3, 1e-3, -5e-4)),
    "qbfs on a conic": QbfsAsphere(-5.0, 0.4, 1.6, (1e-2, -4e-3, 2e-3)),
    "flat qbfs": QbfsAsphere(np.inf, 0.0, 1.5, (1e-2, -4e-3)),
    "xy polynomial": XYPolynomial(((1, 0, 1e-3), (2, 1, 3e-3), (0, 5, -1e-3), (3, 3, 2e-3))),
    "zernikes": ZernikeSag(tuple(1e-3 * RNG.normal(size=28)), 1.0, 0.4),
    "grid": GRID,
    "sum": Sum((Sphere(4.0), ZernikeSag((0.0, 0.0, 0.0, 1e-3, 2e-3), 1.0), GRID)),
}
each_shape = pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)


def test_toroid_lies_at_its_radius_about_its_axis():
    # A circle in y, z turned about the axis x = 0, z = Rx: the distance from the turned centre is the radius along y.
    z = Toroid(4.0, 1.5).sag(X, Y)
    from_axis = 4.0 - np.hypot(4.0 - z, X)
    assert np.allclose((from_axis - 1.5) ** 2 + Y**2, 1.5**2, rtol=0, atol=1e-14)


def test_toroid_and_biconic_of_one_radius():
    for shape in (Toroid(3.0, 3.0), Biconic(3.0, 3.0)):
        assert np.allclose(shape.sag(X, Y), Sphere(3.0).sag(X, Y), rtol=0, atol=2e-16)
    assert np.allclose(Biconic(-3.0, -3.0, -0.7, -0.7).sag(X, Y), Conic(-3.0, -0.7).sag(X, Y), rtol=0, atol=2e-16)


def test_cylinders_are_flat_along_their_axis():
    profile = 3.0 - np.sqrt(9.0 - X**2)
    for shape in (Toroid(3.0, np.inf), Biconic(3.0, np.inf)):
        assert np.allclose(shape.sag(X, Y), profile, rtol=0, atol=1e-15)
    assert np.allclose(Toroid(np.inf, 3.0).sag(Y, X), profile, rtol=0, atol=1e-15)


def test_toroids_with_powers_revolve_their_curve():
    toroid = Toroid(4.0, 1.5, -0.3, (0.02, -0.01))
    curve = Conic(1.5, -0.3).sag(0.0, Y) + 0.02 * Y**2 - 0.01 * Y**4
    assert np.allclose(np.hypot(4.0 - toroid.sag(X, Y), X), 4.0 - curve, rtol=0, atol=1e-14)


def test_the_first_qbfs_terms_are_those_of_forbes():
    """Forbes (2007), equations 2.11; the departure is along the normal of a sphere."""
    a = np.array([3e-3, -2e-3, 1e-3, 4e-4])
    v = (X**2 + Y**2) / 2.5**2
    q = [
        np.ones_like(v),
        (13 - 16 * v) / np.sqrt(19),
        np.sqrt(2 / 95) * (29 - 4 * v * (25 - 19 * v)),
        np.sqrt(2 / 2545) * (207 - 4 * v * (315 - v * (577 - 320 * v))),
    ]
    expected = Sphere(3.0).sag(X, Y) + v * (1 - v) * (a @ np.array(q).reshape(4, -1)).reshape(v.shape) / np.sqrt(
        1 - (X**2 + Y**2) / 9.0
    )
    found = QbfsAsphere(3.0, 0.0, 2.5, tuple(a)).sag(X, Y)
    assert np.allclose(found, expected, rtol=0, atol=1e-16)


def test_qbfs_terms_have_orthogonal_slopes():
    """Their slopes are orthonormal with the weight 1 / sqrt(1 - u^2) over the aperture, however many."""
    # Gauss-Chebyshev nodes.
    u = np.cos(np.pi * (np.arange(200) + 0.5) / 400)
    flat = [QbfsAsphere(np.inf, 0.0, 1.0, (0.0,) * m + (1.0,)).gradient(u, 0.0 * u)[0] for m in range(24)]
    products = np.mean(np.array(flat)[:, None] * np.array(flat)[None], axis=-1)
    assert np.allclose(products, products[0, 0] * np.eye(24), rtol=0, atol=1e-12)


def test_polynomials_are_their_terms():
    terms = [(i, j, RNG.normal()) for i in range(5) for j in range(5)]
    closed = sum(a * X**i * Y**j for i, j, a in terms)
    # 25 terms of size one.
    assert np.allclose(XYPolynomial(tuple(terms)).sag(X, Y), closed, rtol=0, atol=1e-14)
    r = np.hypot(X, Y)
    odd = OddAsphere(np.inf, 0.0, (0.1, 0.2, 0.3, 0.4, 0.5)).sag(X, Y)
    assert np.allclose(odd, 0.1 * r + 0.2 * r**2 + 0.3 * r**3 + 0.4 * r**4 + 0.5 * r**5, rtol=1e-14)


@pytest.mark.parametrize("inner", [0.0, 0.6, 1.9])
def test_zernike_sag_is_the_sum_of_annular_zernikes(inner):
    coefficients = RNG.normal(size=45)
    x, y = 2.0 * X, 2.0 * Y
    sag = ZernikeSag(tuple(coefficients), 2.1, inner).sag(x, y)
    direct = coefficients @ annular_zernikes(45, x / 2.1, y / 2.1, inner / 2.1)
    # Inside a thin ring the terms reach hundreds of thousands, and so does what cancels: relative to that.
    assert np.allclose(sag, direct, rtol=1e-12, atol=1e-13 * np.abs(direct).max())


def test_a_grid_passes_through_its_nodes_and_keeps_a_plane():
    x, y = np.meshgrid(NODES_X, NODES_Y)
    assert np.allclose(GRID.sag(x, y), GRID.values, rtol=0, atol=1e-17)
    plane = GridSag(NODES_X, NODES_Y, 0.3 * x - 0.2 * y + 0.1)
    assert np.allclose(plane.sag(X, Y), 0.3 * X - 0.2 * Y + 0.1, rtol=0, atol=2e-16)


def test_a_grid_ends_at_its_rim():
    assert np.isfinite(GRID.sag([-1.0, 1.0], [1.1, -1.1])).all()
    assert np.isnan(GRID.sag([1.0001, 0.0, -1.0001], [0.0, 1.1001, 0.0])).all()


@each_shape
def test_gradient_and_hessian_are_differences_of_the_sag(shape):
    e = 1e-5
    # Differences of numbers of size one in steps of 1e-5: rounding 1e-11, third derivatives (below ten) 1e-9.
    slopes = shape.gradient(X, Y)
    assert np.allclose(slopes[0], (shape.sag(X + e, Y) - shape.sag(X - e, Y)) / (2 * e), rtol=0, atol=3e-9)
    assert np.allclose(slopes[1], (shape.sag(X, Y + e) - shape.sag(X, Y - e)) / (2 * e), rtol=0, atol=3e-9)
    along_x = np.subtract(shape.gradient(X + e, Y), shape.gradient(X - e, Y)) / (2 * e)
    along_y = np.subtract(shape.gradient(X, Y + e), shape.gradient(X, Y - e)) / (2 * e)
    # The second derivative of a bicubic jumps at the nodes, where a difference takes the mean.
    inside = np.ones(len(X), dtype=bool)
    if shape is GRID or isinstance(shape, Sum):
        for place, nodes in ((X, NODES_X), (Y, NODES_Y)):
            inside &= np.abs(place[:, None] - nodes).min(axis=1) > 2 * e
    if shape is SHAPES["cone"]:
        # Towards the tip the higher derivatives grow as powers of 1 / r.
        inside &= np.hypot(X, Y) > 0.2
    xx, xy, yy = shape.hessian(X, Y)
    for ours, difference in ((xx, along_x[0]), (xy, along_x[1]), (xy, along_y[0]), (yy, along_y[1])):
        assert np.allclose(ours[inside], difference[inside], rtol=0, atol=1e-8)


@each_shape
def test_derivatives_equal_differences(shape):
    names = [n for n, v in shape.parameters.items() if np.isfinite(v)]
    for name in names[:: max(1, len(names) // 12)]:
        value = shape.parameters[name]
        step = 1e-6 * max(abs(value), 1e-2)
        up, down = shape.with_parameter(name, value + step), shape.with_parameter(name, value - step)
        assert shape.parameters[name] == value
        differences = [
            (up.sag(X, Y) - down.sag(X, Y)) / (2 * step),
            *(np.subtract(up.gradient(X, Y), down.gradient(X, Y)) / (2 * step)),
        ]
        for ours, difference in zip(shape.sag_derivative(name, X, Y), differences, strict=True):
            # Rounding of a sag of size one over a step of 1e-8.
            assert np.allclose(ours, difference, rtol=0, atol=1e-7), name


@each_shape
def test_curvature_and_fourth_order_are_those_of_the_ring_means(shape):
    if isinstance(shape, (GridSag, Sum)) or shape is SHAPES["cone"] or shape is SHAPES["odd asphere"]:
        pytest.skip("no series in even powers at the vertex")
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    r = np.linspace(0.02, 0.1, 9)
    mean = np.array([shape.sag(q * np.cos(angle), q * np.sin(angle)).mean() for q in r]) - shape.sag(0.0, 0.0)
    second, fourth, *_ = np.linalg.lstsq(r[:, None] ** [2, 4, 6, 8], mean, rcond=None)[0]
    # What the series leaves, r^10 of 1e-10 times a coefficient of order one, over r^2 and r^4.
    assert shape.curvature == pytest.approx(2 * second, abs=1e-9)
    assert shape.fourth_order + shape.curvature**3 / 8 == pytest.approx(fourth, abs=1e-6)


def test_fourth_order_of_sums_and_odd_aspheres():
    both = Sum((Conic(4.0, -1.0), EvenAsphere(-7.0, 0.5, (2e-3,))))
    one = (1 + 0.5) * (-1 / 7.0) ** 3 / 8 + 2e-3
    assert both.curvature == pytest.approx(1 / 4 - 1 / 7)
    assert both.fourth_order + both.curvature**3 / 8 == pytest.approx(one, rel=1e-13)
    odd = OddAsphere(4.0, -1.0, (0.0, 0.01, 0.0, 3e-3))
    assert odd.curvature == pytest.approx(1 / 4 + 0.02)
    assert odd.fourth_order + odd.curvature**3 / 8 == pytest.approx(3e-3, rel=1e-13)


def test_changing_a_parameter_gives_the_simplest_shape_that_has_it():
    assert Plane().with_parameter("curvature", 0.25) == Sphere(4.0)
    assert Sphere(4.0).with_parameter("conic", -1.0) == Conic(4.0, -1.0)
    assert Sphere(4.0).with_parameter("curvature", 0.0) == Plane()
    assert EvenAsphere(4.0, -1.0, (0.0, 1e-3)).with_parameter("a6", 2e-3).coefficients == (0.0, 2e-3)
    twice = Sum((ZernikeSag((1e-6, 0.0), 1.0), ZernikeSag((2e-6,), 1.0)))
    assert twice.parameters == {"Z1": 1e-6, "Z2": 0.0, "part2.Z1": 2e-6}
    assert twice.with_parameter("part2.Z1", 0.5).parts[1].coefficients == (0.5,)
    with pytest.raises(UnknownNameError, match="unknown parameter of Conic 'a4'"):
        Conic(4.0, -1.0).sag_derivative("a4", X, Y)


def test_impossible_numbers_are_refused():
    cases = [
        (lambda: Biconic(0.0, 1.0), "radius_x = 0.0"),
        (lambda: Toroid(1.0, float("nan")), "radius_y = nan"),
        (lambda: Toroid(1.0, 2.0, float("inf")), "conic_y = inf"),
        (lambda: OddAsphere(1.0, 0.0, (float("nan"),)), "coefficients"),
        (lambda: XYPolynomial(((1, -1, 0.1),)), "xy term"),
        (lambda: XYPolynomial(((1, 1, 0.1), (1, 1, 0.2))), "more than once"),
        (lambda: ZernikeSag((), 1.0), "at least one coefficient"),
        (lambda: ZernikeSag((0.1,), 1.0, 1.0), "0 <= inner < outer"),
        (lambda: Sum(()), "at least one shape"),
        (lambda: GridSag([0, 1, 2], [0, 1, 2, 3], np.zeros((4, 3))), "grid x has 3 nodes: expected at least 4"),
        (lambda: GridSag([0, 1, 2, 4], [0, 1, 2, 3], np.zeros((4, 4))), "equal steps"),
        (lambda: GridSag([0, 1, 2, 3], [0, 1, 2, 3], np.zeros((4, 5))), r"shape \[4, 5\]: expected \[4, 4\]"),
        (lambda: GridSag([0, 1, 2, 3], [0, 1, 2, 3], np.full((4, 4), np.nan)), r"values\[0, 0\] = nan"),
    ]
    for make, message in cases:
        with pytest.raises(PrescriptionError, match=message):
            make()


def test_sags_equal_batoids():
    batoid = pytest.importorskip("batoid")
    zernike = tuple(1e-3 * RNG.normal(size=28))
    pairs = [
        (GRID, batoid.Bicubic(NODES_X, NODES_Y, GRID.values)),
        (ZernikeSag(zernike, 1.3, 0.5), batoid.Zernike([0.0, *zernike], R_outer=1.3, R_inner=0.5)),
        (
            Sum((Sphere(4.0), ZernikeSag(zernike, 1.3), GRID)),
            batoid.Sum(
                [
                    batoid.Sphere(4.0),
                    batoid.Zernike([0.0, *zernike], R_outer=1.3),
                    batoid.Bicubic(NODES_X, NODES_Y, GRID.values),
                ]
            ),
        ),
    ]
    for ours, theirs in pairs:
        # Sags up to 0.1 m and Zernikes of degree six: rounding.
        assert np.allclose(ours.sag(X, Y), theirs.sag(X, Y), rtol=0, atol=1e-15)
        normal = theirs.normal(X, Y)
        slopes = -normal[:, :2] / normal[:, 2:]
        assert np.allclose(np.stack(ours.gradient(X, Y), axis=-1), slopes, rtol=0, atol=1e-13)


def test_parameters_changed_together_are_those_changed_one_by_one():
    shape = Sum((Conic(10.0, -0.3), ZernikeSag((0.0, 1e-7, 2e-7, 3e-7), 4.0, 1.0)))
    values = {"Z4": 5e-7, "conic": -0.5, "Z1": 1e-8}
    expected = shape
    for name, value in values.items():
        expected = expected.with_parameter(name, value)
    assert shape.with_parameters(values) == expected
    assert shape.with_parameters(values) != shape
    with pytest.raises(UnknownNameError, match="Z9"):
        shape.with_parameters({"Z4": 1e-7, "Z9": 1e-7})
