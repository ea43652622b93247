"""Clear apertures: each region against a restated one and against batoid, set algebra, rims, refusals, YAML."""

import numpy as np
import pytest

from pachon.core.errors import PrescriptionError
from pachon.models.aperture import Annulus, Circle, Complement, Ellipse, Intersection, Polygon, Rectangle, Union, Vane
from pachon.models.io.prescription import load_telescope, save_telescope

X, Y = np.random.default_rng(3).uniform(-2.0, 2.0, (2, 20000))
# A star of five points, which is neither convex nor symmetric about the axes it is measured along.
STAR = tuple(
    (0.2 + r * np.cos(a), -0.1 + r * np.sin(a))
    for r, a in zip([1.6, 0.6] * 5, 0.3 + np.arange(10) * np.pi / 5, strict=True)
)
REGIONS = [
    Circle(1.1, 0.2, -0.3),
    Annulus(0.5, 1.2, 0.1, 0.4),
    Rectangle(0.7, 2.2, 0.3, -0.2, 0.6),
    Vane(0.3, 0.2, -0.5, 2.4),
    Polygon(STAR),
]


def winding(corners, x, y):
    """Sum the angles under which a point sees the edges: 2 pi inside, 0 outside."""
    corners = np.array(corners)
    to = corners[:, 0] - x[:, None] + 1j * (corners[:, 1] - y[:, None])
    return np.abs(np.angle(np.roll(to, -1, axis=1) / to).sum(axis=1)) > np.pi


def test_polygon_is_what_sees_all_its_edges_around_it():
    assert np.array_equal(Polygon(STAR).contains(X, Y), winding(STAR, X, Y))
    assert np.array_equal(Polygon(STAR[::-1]).contains(X, Y), winding(STAR, X, Y))


def test_rectangle_and_vane_are_the_polygons_that_they_draw():
    def along(x, y, angle, points):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return tuple(map(tuple, (np.array(points) @ turn.T + (x, y)).tolist()))

    box = along(0.3, -0.2, 0.6, [(-0.35, -1.1), (0.35, -1.1), (0.35, 1.1), (-0.35, 1.1)])
    assert np.array_equal(Rectangle(0.7, 2.2, 0.3, -0.2, 0.6).contains(X, Y), winding(box, X, Y))
    # 10 m is beyond every point of the square.
    one = along(0.2, -0.5, 2.4, [(0.0, -0.15), (10.0, -0.15), (10.0, 0.15), (0.0, 0.15)])
    assert np.array_equal(Vane(0.3, 0.2, -0.5, 2.4).contains(X, Y), winding(one, X, Y))
    both = along(0.2, -0.5, 2.4, [(-10.0, -0.15), (10.0, -0.15), (10.0, 0.15), (-10.0, 0.15)])
    assert np.array_equal(Vane(0.3, 0.2, -0.5, 2.4, both_ways=True).contains(X, Y), winding(both, X, Y))


def test_ellipse_is_the_polygon_inscribed_in_it():
    turns = np.linspace(0.0, 2 * np.pi, 20_000, endpoint=False)
    along, across = 1.3 * np.cos(turns), 0.5 * np.sin(turns)
    corners = tuple(zip(0.2 + 0.8 * along - 0.6 * across, -0.3 + 0.6 * along + 0.8 * across, strict=True))
    ellipse = Ellipse(1.3, 0.5, 0.2, -0.3, np.arctan2(0.6, 0.8))
    assert np.array_equal(ellipse.contains(X, Y), Polygon(corners).contains(X, Y))
    assert 0.1 < ellipse.contains(X, Y).mean() < 0.9
    assert not Ellipse(1.0, 2.0).contains(0.0, 2.0)
    assert np.array_equal(Ellipse(0.7, 0.7, 0.1, 0.2).contains(X, Y), Circle(0.7, 0.1, 0.2).contains(X, Y))


def test_each_region_is_that_of_batoid():
    batoid = pytest.importorskip("batoid")
    peers = [
        batoid.ObscCircle(1.1, 0.2, -0.3),
        batoid.ObscAnnulus(0.5, 1.2, 0.1, 0.4),
        batoid.ObscRectangle(0.7, 2.2, 0.3, -0.2, 0.6),
        batoid.ObscRay(0.3, 2.4, 0.2, -0.5),
        batoid.ObscPolygon(*(list(c) for c in zip(*STAR, strict=True))),
    ]
    for ours, theirs in zip(REGIONS, peers, strict=True):
        inside = ours.contains(X, Y)
        assert 0 < inside.sum() < X.size
        assert np.array_equal(inside, [theirs.contains(x, y) for x, y in zip(X, Y, strict=True)])


def test_algebra_of_sets():
    a, b = Circle(1.1, 0.2, -0.3), Polygon(STAR)
    in_a, in_b = a.contains(X, Y), b.contains(X, Y)
    assert np.array_equal(Union((a, b)).contains(X, Y), in_a | in_b)
    assert np.array_equal(Intersection((a, b)).contains(X, Y), in_a & in_b)
    assert np.array_equal(Complement(a).contains(X, Y), ~in_a)
    # De Morgan's law ties the three together.
    neither = Intersection((Complement(a), Complement(b)))
    assert np.array_equal(Complement(Union((a, b))).contains(X, Y), neither.contains(X, Y))


def test_rims_count_to_the_sides_that_the_classes_state():
    assert not Circle(1.0).contains(1.0, 0.0)
    assert Complement(Circle(1.0)).contains(1.0, 0.0)
    assert Annulus(1.0, 2.0).contains(1.0, 0.0)
    assert not Annulus(1.0, 2.0).contains(2.0, 0.0)
    assert not Rectangle(2.0, 4.0).contains(1.0, 0.0)
    assert not Rectangle(2.0, 4.0).contains(0.0, 2.0)
    assert not Vane(0.2).contains(0.0, 0.0)
    assert Vane(0.2, both_ways=True).contains(0.0, 0.0)
    left, right = (Polygon(((x, 0.0), (x + 1.0, 0.0), (x + 1.0, 1.0), (x, 1.0))) for x in (0.0, 1.0))
    assert bool(left.contains(1.0, 0.5)) != bool(right.contains(1.0, 0.5))


@pytest.mark.parametrize(
    "corners",
    [
        ((0, 0), (1, 1), (1, 0), (0, 1)),  # an hour-glass
        ((0, 0), (1, 0), (1, 0), (0, 1)),  # a corner twice
        ((0, 0), (2, 0), (1, 0), (1, 1)),  # an edge that runs back over the one before it
        ((0, 0), (2, 0), (2, 2), (1, 0), (0, 2)),  # a corner on another edge
        ((0, 0), (2, 0), (2, 1), (1, 0.5), (0, 1), (2, 0.9)),  # crosses twice
    ],
)
def test_a_polygon_that_crosses_itself_is_refused(corners):
    with pytest.raises(PrescriptionError, match=r"polygon = .* edge .* meets edge .*: expected an outline"):
        Polygon(tuple((float(x), float(y)) for x, y in corners))


def test_of_many_edges_the_first_pair_that_meets_is_named():
    def segments_meet(a, b, c, d):
        (ux, uy), (vx, vy) = b - a, d - c
        s, t = np.linalg.solve([[ux, -vx], [uy, -vy]], c - a)
        return 0 <= s <= 1 and 0 <= t <= 1

    rng = np.random.default_rng(4)
    for _ in range(5):
        angle = np.sort(rng.random(60)) * 2 * np.pi
        outline = (1.0 + 0.3 * rng.random((60, 1))) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        Polygon(tuple(map(tuple, outline.tolist())))
        swapped = rng.integers(58)
        outline[[swapped, swapped + 2]] = outline[[swapped + 2, swapped]]
        following = np.roll(outline, -1, axis=0)
        i, j = next(
            (i, j)
            for i in range(60)
            for j in range(i + 2, 60 - (i == 0))
            if segments_meet(outline[i], following[i], outline[j], following[j])
        )
        with pytest.raises(PrescriptionError, match=rf"edge {i + 1}, from .* meets edge {j + 1}, from"):
            Polygon(tuple(map(tuple, outline.tolist())))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Polygon(((0.0, 0.0), (1.0, 0.0))), "polygon of 2 corners: expected at least three"),
        (lambda: Polygon(((0.0, 0.0), (1.0, 0.0), (0.0, np.nan))), "expected at least three finite"),
        (lambda: Rectangle(0.0, 1.0), "rectangle = .*: expected two positive lengths"),
        (lambda: Rectangle(1.0, 1.0, angle=np.inf), "expected finite centre and angle"),
        (lambda: Ellipse(-1.0, 1.0), "ellipse = .*: expected two positive lengths"),
        (lambda: Ellipse(1.0, 1.0, x=np.nan), "expected finite centre and angle"),
        (lambda: Vane(-0.1), "vane = -0.1 m: expected a positive width"),
        (lambda: Vane(0.1, x=np.nan), "expected finite point and angle"),
        (lambda: Union(()), "union of no parts: expected at least one region"),
    ],
)
def test_impossible_regions_are_refused(make, message):
    with pytest.raises(PrescriptionError, match=message):
        make()


HEAD = """
name: test
source: here
version: "1"
units: {length: mm, angle: deg, wavelength: um}
stop: {z: 0}
pupil: {diameter: 1000, obscuration: 0.0}
launch_distance: 5000
reference_sphere_radius: 1000
field: {radius: 1, limit: 2}
wavelengths: {range: [0.3, 1.2], default: 0.6}
surfaces:
"""


def read(tmp_path, keys):
    path = tmp_path / "mine.yaml"
    path.write_text(HEAD + f"  - {{name: a, type: baffle, shape: plane, z: 0, {keys}}}\n")
    return load_telescope(path)


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("circle: 300, centre: [10, 20]", Circle(0.3, 0.01, 0.02)),
        ("aperture: {annulus: [100, 300]}", Annulus(0.1, 0.3)),
        ("aperture: {ellipse: [100, 300], angle: 90}", Ellipse(0.1, 0.3, angle=np.pi / 2)),
        ("aperture: {rectangle: [100, 300], angle: 90}", Rectangle(0.1, 0.3, angle=np.pi / 2)),
        ("aperture: {polygon: [[0, 0], [100, 0], [0, 100]]}", Polygon(((0.0, 0.0), (0.1, 0.0), (0.0, 0.1)))),
        ("obscuration: {circle: 100}", Complement(Circle(0.1))),
        ("annulus: [100, 300], obscuration: {vane: 10, from: [5, 0], angle: 90, both_ways: true}",
         Intersection((Annulus(0.1, 0.3), Complement(Vane(0.01, 0.005, 0.0, np.pi / 2, both_ways=True))))),
        ("aperture: {union: [{circle: 10}, {intersection: [{circle: 300}, {complement: {circle: 200}}]}]}",
         Union((Circle(0.01), Intersection((Circle(0.3), Complement(Circle(0.2))))))),
    ],
)  # fmt: skip
def test_apertures_in_a_file_and_back(tmp_path, keys, expected):
    telescope = read(tmp_path, keys)
    assert telescope.surfaces[0].aperture == expected
    save_telescope(telescope, tmp_path / "again.yaml")
    assert load_telescope(tmp_path / "again.yaml") == telescope


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("circle: 3, aperture: {circle: 4}", "surfaces[a].circle = 3: expected circle or aperture, not both"),
        ("aperture: {}", "surfaces[a].aperture has nothing: expected one of circle, annulus, ellipse, rectangle"),
        ("obscuration: {disc: 4}", "surfaces[a].obscuration has disc: expected one of circle"),
        ("aperture: {circle: 4, vane: 3}", "surfaces[a].aperture has circle, vane: expected one of"),
        ("aperture: {rectangle: [1, 2], from: [0, 0]}", "unknown key surfaces[a].aperture.from = [0, 0]"),
        ("aperture: {rectangle: [1, -2]}", "surfaces[a].aperture.rectangle = [0.001, -0.002] m: expected two positive"),
        ("aperture: {polygon: [[0, 0], [1, 1], [1, 0], [0, 1]]}", "surfaces[a].aperture.polygon = 4 corners: edge 1"),
        ("aperture: {polygon: [[0, 0], [1, x], [1, 0]]}", "surfaces[a].aperture.polygon[1] = [1, 'x']: expected a"),
        ("aperture: {union: [{circle: 4}, {vane: 0}]}", "surfaces[a].aperture.union[1].vane = 0.0 m: expected a pos"),
        ("aperture: {union: []}", "surfaces[a].aperture.union = []: expected a list of mappings"),
        ("aperture: {vane: 1, both_ways: 2}", "surfaces[a].aperture.both_ways = 2: expected true or false"),
        ("centre: [1, 2], obscuration: {circle: 1}", "surfaces[a].centre = [1, 2]: expected a circle or an annulus"),
    ],
)  # fmt: skip
def test_malformed_apertures_say_file_key_value_and_what_was_expected(tmp_path, keys, message):
    with pytest.raises(PrescriptionError) as raised:
        read(tmp_path, keys)
    text = str(raised.value)
    assert text.startswith(str(tmp_path / "mine.yaml"))
    assert message in text
    assert "\n" not in text
