"""Rectangular and rotated CCDs: maps, membership and outlines against their definitions restated."""

import numpy as np
import pytest

from pachon import PachonError, load_camera
from pachon.models import Camera
from pachon.models.camera.lsst import lsst_camera

PIXEL = 15e-6
#: Centre [mm], pixels and angle [deg] of each CCD; all sizes and angles differ.
CCDS = {
    "A": ((0.0, 0.0), (2048, 4176), 0.0),
    "B": ((60.0, 5.0), (2048, 4176), 90.0),
    "C": ((-45.0, -10.0), (1024, 1000), 33.0),
    "D": ((10.0, 60.0), (3000, 500), -170.0),
    "E": ((-10.0, -60.0), (2000, 1000), 180.0),
    "F": ((40.0, -45.0), (1500, 1501), 270.0),
}


def camera_of(ccds=CCDS, **options):
    centers, pixels, angles = zip(*ccds.values(), strict=True)
    return Camera(
        "mixed", tuple(ccds), (), np.full(len(ccds), -1), 1e-3 * np.array(centers), np.array(pixels), PIXEL,
        rotation_deg=np.array(angles), **options
    )  # fmt: skip


def square_camera():
    """Return the grid of the LSST with square CCDs."""
    lsst = lsst_camera()
    return Camera(
        "square", lsst.ccd_names, lsst.raft_names, lsst.raft_index, lsst.centers, np.array([4096, 4096]), 10e-6
    )


def turned(vector, degrees):
    """Return a vector turned from +x towards +y, by complex numbers."""
    z = complex(*vector) * np.exp(1j * np.deg2rad(degrees))
    return np.array([z.real, z.imag])


@pytest.mark.parametrize("name", CCDS)
def test_pixels_are_counted_along_the_ccd(name):
    camera, (center, (nx, ny), angle) = camera_of(), CCDS[name]
    i = camera.ccd_index(name)
    for pixel in ((0, 0), (nx - 1, 0), (0, ny - 1), (17.25, 400.0)):
        local = (np.array(pixel) - [(nx - 1) / 2, (ny - 1) / 2]) * PIXEL
        expected = 1e-3 * np.array(center) + turned(local, angle)
        # Rounding of numbers of a decimetre.
        assert np.allclose(camera.from_pixel(i, np.array(pixel, dtype=float)), expected, rtol=0, atol=1e-16)
        assert np.allclose(camera.to_pixel(i, expected), pixel, rtol=0, atol=1e-9)
        assert np.allclose(camera.to_uv(i, expected), 2 * local / (np.array([nx, ny]) * PIXEL), rtol=0, atol=1e-12)


def test_maps_of_many_ccds_are_those_of_each():
    camera, rng = camera_of(), np.random.default_rng(2)
    ccd, uv = rng.integers(0, len(CCDS), 40), rng.uniform(-1, 1, (40, 2))
    xy = camera.from_uv(ccd, uv)
    one = np.array([camera.from_uv(int(i), p) for i, p in zip(ccd, uv, strict=True)])
    assert np.array_equal(xy, one)
    assert np.allclose(camera.to_uv(ccd, xy), uv, rtol=0, atol=1e-12)
    assert np.array_equal(camera.ccd_at(*xy.T), ccd)
    # A vector along the CCD's y, back and forth.
    along = camera.frame(ccd).along_focal_plane(np.zeros(40), np.ones(40))
    assert np.allclose(camera.frame(ccd).along_ccd(*along), [np.zeros(40), np.ones(40)], atol=1e-15)


def test_quarter_turns_are_exact():
    camera = camera_of({f"Q{q + 4}": ((70.0 * q, 0.0), (100, 300), 90.0 * q) for q in range(-4, 5)})
    for q in range(-4, 5):
        x, y = camera.frame(q + 4).along_focal_plane(1.0, 0.0)
        assert (x, y) == ((1, 0), (0, 1), (-1, 0), (0, -1))[q % 4]


def test_membership_equals_a_search_through_every_rectangle():
    camera, rng = camera_of(), np.random.default_rng(7)
    x, y = rng.uniform(-0.1, 0.1, (2, 6000))
    for margin in (0.0, 2e-3):
        expected = np.full(x.shape, -1)
        for i, (center, pixels, angle) in enumerate(CCDS.values()):
            local = np.array([turned(p, -angle) for p in np.stack([x, y], -1) - 1e-3 * np.array(center)])
            inside = (np.abs(local) <= 0.5 * PIXEL * np.array(pixels) + margin).all(axis=1)
            expected[inside] = i
        assert np.array_equal(camera.ccd_at(x, y, margin=margin), expected)
        assert set(expected) == {-1, *range(len(CCDS))}


def test_depth_is_the_distance_to_the_nearest_rim():
    camera = camera_of()
    c = camera.ccd_index("C")
    uv = np.array([[0.0, 0.0], [0.9, 0.0], [0.0, -0.5], [1.1, 0.0]])
    half = 0.5 * PIXEL * np.array([1024, 1000])
    expected = [half.min(), 0.1 * half[0], 0.5 * half[1], -0.1 * half[0]]
    assert np.allclose(camera.depth(c, *camera.from_uv(c, uv).T), expected, rtol=0, atol=1e-15)


def test_outlines_hold_all_pixels_and_no_more():
    camera = camera_of()
    for i, (_, (nx, ny), angle) in enumerate(CCDS.values()):
        rim = np.array([(-0.5, -0.5), (nx - 0.5, -0.5), (nx - 0.5, ny - 0.5), (-0.5, ny - 0.5)])
        corners = camera.corners([i])[0]
        assert np.allclose(corners, camera.from_pixel(i, rim), rtol=0, atol=1e-15)
        xmin, xmax, ymin, ymax = camera.bounds([i])
        assert np.allclose([[xmin, ymin], [xmax, ymax]], [corners.min(axis=0), corners.max(axis=0)])
        # The rectangle of the star positions, turned about its centre, is the CCD again.
        (x0, x1, y0, y1), turn = camera.rectangle(i)
        box = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
        center = box.mean(axis=0)
        again = np.array([center + turned(p - center, np.rad2deg(turn)) for p in box])
        assert abs(turn) <= np.pi / 4
        assert (angle % 90 == 0) == (turn == 0)
        for corner in corners:
            assert np.hypot(*(again - corner).T).min() < 1e-15


def test_a_square_camera_is_as_it_was():
    """Maps of an unrotated camera are those of plain differences, to the last bit."""
    square, rng = square_camera(), np.random.default_rng(3)
    ccd, uv = rng.integers(0, 189, 500), rng.uniform(-1, 1, (500, 2))
    assert np.array_equal(square.from_uv(ccd, uv), square.centers[ccd] + 20.48e-3 * uv)
    xy = rng.uniform(-0.3, 0.3, (500, 2))
    assert np.array_equal(square.to_uv(ccd, xy), (xy - square.centers[ccd]) / 20.48e-3)
    assert np.array_equal(square.to_pixel(ccd, xy), (xy - square.centers[ccd]) / 10e-6 + 2047.5)
    assert square.alike
    assert not camera_of().alike


@pytest.mark.parametrize("name", CCDS)
def test_pixels_of_a_transposed_camera_exchange_x_and_y(name):
    camera, (center, (nx, ny), angle) = camera_of(transposed=True), CCDS[name]
    i = camera.ccd_index(name)
    for pixel in ((0, 0), (nx - 1, 0), (0, ny - 1), (17.25, 400.0)):
        across = (np.array(pixel) - [(nx - 1) / 2, (ny - 1) / 2]) * PIXEL
        expected = 1e-3 * np.array(center) + turned(across[::-1], angle)
        assert np.allclose(camera.from_pixel(i, np.array(pixel, dtype=float)), expected, rtol=0, atol=1e-16)
        assert np.allclose(camera.to_pixel(i, expected), pixel, rtol=0, atol=1e-9)
        assert np.allclose(camera.along_pixels(i, turned(across[::-1], angle)), across, rtol=0, atol=1e-16)
    assert np.allclose(camera.half_sizes[i], 0.5 * PIXEL * np.array([ny, nx]), rtol=0, atol=1e-16)
    # The corners of the CCD are those of its pixels.
    rim = np.array([(-0.5, -0.5), (nx - 0.5, -0.5), (nx - 0.5, ny - 0.5), (-0.5, ny - 0.5)])
    for corner in camera.from_pixel(i, rim):
        assert np.hypot(*(camera.corners([i])[0] - corner).T).min() < 1e-15


def test_members_are_rafts_or_ccds():
    lsst = lsst_camera()
    assert [lsst.ccd_names[i] for i in lsst.members("R22")] == list(lsst.ccds_of_raft("R22"))
    assert lsst.members("R22_S11") == (lsst.ccd_index("R22_S11"),)
    assert list(lsst.parts) == list(lsst.raft_names)
    assert camera_of().parts == {name: (i,) for i, name in enumerate(CCDS)}


BESIDE = ((0.0, 0.0), (100, 100), 0.0), ((1.5, 0.0), (100, 100), 0.0)


@pytest.mark.parametrize(
    ("ccds", "words"),
    [
        ({"A": BESIDE[0], "B": ((1.4, 0.0), (100, 100), 0.0)}, "CCDs A and B overlap"),
        # Bounding boxes that overlap do not count, rectangles do: corners of a square turned by 45 degrees.
        ({"A": BESIDE[0], "B": ((1.7, 0.0), (100, 100), 45.0)}, "CCDs A and B overlap"),
        ({"A": ((0.0, 0.0), (1000, 10), 0.0), "B": ((0.0, 0.0), (1000, 10), 90.0)}, "CCDs A and B overlap"),
        ({"A": BESIDE[0], "B": ((1.5, 0.0), (100, 0), 0.0)}, r"CCD B, pixels = \[100, 0\]: expected whole numbers"),
        ({"A": ((np.nan, 0.0), (100, 100), 0.0)}, "centers: expected finite numbers"),
        ({"all": BESIDE[0]}, "'all': expected a name of letters"),
        ({"A/B": BESIDE[0]}, "'A/B': expected a name of letters"),
    ],
)
def test_bad_cameras_are_refused_with_names(ccds, words):
    with pytest.raises(PachonError, match=words):
        camera_of(ccds)


def test_neighbours_may_touch():
    camera_of(dict(zip("AB", BESIDE, strict=True)))
    # The corner of a turned square between two others: boxes overlap, CCDs do not.
    camera_of({"A": BESIDE[0], "B": ((1.3, 1.3), (100, 100), 45.0)})


def test_unknown_cameras_are_listed():
    with pytest.raises(PachonError, match="unknown camera 'hcs': did you mean hsc"):
        load_camera("hcs")


@pytest.mark.parametrize("angle", [90.0, -30.0, 123.0])
def test_a_turned_camera_has_the_same_ccds_in_other_axes(angle):
    camera, rng = camera_of(), np.random.default_rng(7)
    ccd, uv = rng.integers(0, len(camera), 200), rng.uniform(-1, 1, (200, 2))
    turned = camera.turned(angle)
    x, y = camera.from_uv(ccd, uv).T
    expected = (x + 1j * y) * np.exp(-1j * np.deg2rad(angle))
    assert np.allclose(turned.from_uv(ccd, uv), np.stack([expected.real, expected.imag], axis=1), rtol=0, atol=1e-15)
    assert (turned.ccd_at(expected.real, expected.imag) == camera.ccd_at(x, y)).mean() > 0.99
    assert turned.ccd_names == camera.ccd_names
    assert np.array_equal(camera.turned(0.0).centers, camera.centers)
