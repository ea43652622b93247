"""LSSTCam as built: its heights, the frame of its file, its vendors and the sensors in its corners."""

import json
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import UnknownNameError
from pachon.models.camera.focal_plane import FocalPlane
from pachon.models.camera.lsst import lsst_camera
from pachon.models.zernike_polynomials import zernike_monomials

FILE = Path(pachon.models.__file__).parent / "data" / "lsstcam_heights.ecsv"
CAMERA = lsst_camera()
ITL_RAFTS = {"R01", "R02", "R03", "R10", "R20", "R41", "R42", "R43"}
#: Pixels along x and y of the images (y and x of the telescope) of CCDs of E2V, and of ITL.
PIXELS = ((4096, 4004), (4072, 4000))


@pytest.fixture(scope="module")
def rows():
    """Return the rows of the file as plain numbers [mm], by sensor, read without astropy or pachon."""
    lines = [line for line in FILE.read_text().splitlines() if not line.startswith("#")]
    found = {}
    for line in lines[1:]:
        name, *numbers, zernikes = line.split(" ")
        found[name] = (*map(float, numbers), np.array(json.loads(zernikes)))
    return found


@pytest.fixture(scope="module")
def plane():
    return FocalPlane.as_measured("lsstcam")


def points_within(row, rng, n):
    """Return positions [mm] on the measured part of a sensor, in the frame of the file."""
    _, _, left, right, bottom, top, _, _ = row
    return rng.uniform(left, right, n), rng.uniform(bottom, top, n)


def test_every_ccd_has_the_zernikes_of_the_file(rows, plane):
    galsim = pytest.importorskip("galsim")
    rng = np.random.default_rng(3)
    assert plane.measured.all()
    for name in CAMERA.ccd_names:
        x0, y0, *_, radius, zernikes = rows[name]
        x, y = points_within(rows[name], rng, 40)
        expected = -1e-3 * galsim.zernike.Zernike([0.0, *zernikes[1:]], radius)(x - x0, y - y0)
        # The camera's x and y are ours; its z runs against ours. A measured rectangle may end beyond the pixels.
        on = plane.ccd_at(1e-3 * x, 1e-3 * y) == CAMERA.ccd_index(name)
        half = 0.5e-2 * np.array(PIXELS[name[:3] in ITL_RAFTS])[::-1]
        assert np.array_equal(on, (np.abs(np.stack([x - x0, y - y0], axis=-1)) <= half).all(axis=-1))
        assert on.mean() > 0.8
        # Rounding of heights of 1e-4 m, of positions to 1e-16 m of 0.3 m and slopes below 1e-2.
        assert np.abs(plane.height(1e-3 * x[on], 1e-3 * y[on]) - expected[on]).max() < 1e-16


def test_zernike_monomials_are_the_textbook_polynomials():
    # Noll (1976), Table I.
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-0.7, 0.7, (2, 100))
    r, t = np.hypot(x, y), np.arctan2(y, x)
    table = [
        np.ones_like(r),
        2 * r * np.cos(t),
        2 * r * np.sin(t),
        np.sqrt(3) * (2 * r**2 - 1),
        np.sqrt(6) * r**2 * np.sin(2 * t),
        np.sqrt(6) * r**2 * np.cos(2 * t),
        np.sqrt(8) * (3 * r**3 - 2 * r) * np.sin(t),
        np.sqrt(8) * (3 * r**3 - 2 * r) * np.cos(t),
        np.sqrt(8) * r**3 * np.sin(3 * t),
        np.sqrt(8) * r**3 * np.cos(3 * t),
        np.sqrt(5) * (6 * r**4 - 6 * r**2 + 1),
    ]
    terms = [np.polynomial.polynomial.polyval2d(x, y, term) for term in zernike_monomials(11)]
    assert np.allclose(terms, table, rtol=0, atol=1e-13)


def test_heights_go_on_along_their_tangents_outside_the_measured_part(rows, plane):
    # R01_S00 lacks 7 mm in the file along its x.
    name = "R01_S00"
    x0, y0, left, *_ = rows[name]
    i = CAMERA.ccd_index(name)
    rim = 1e-3 * left
    y = CAMERA.centers[i, 1] + np.linspace(-0.019, 0.019, 9)
    height, slope = plane.height(np.full(9, rim), y), plane.gradient(np.full(9, rim), y)[:, 0]
    assert rim - CAMERA.centers[i, 0] < -0.0129
    for beyond in (-1e-3, -7e-3):
        expected = height + slope * beyond
        assert np.allclose(plane.height(np.full(9, rim + beyond), y), expected, rtol=0, atol=1e-16)
    assert np.array_equal(plane.gradient(np.full(9, rim - 5e-3), y)[:, 0], slope)
    # A polynomial of degree six would be somewhere else: the file must not be extrapolated.
    *_, radius, zernikes = rows[name]
    galsim = pytest.importorskip("galsim")
    wild = -1e-3 * galsim.zernike.Zernike([0.0, *zernikes[1:]], radius)(0 * y + left - 7.0 - x0, 1e3 * y - y0)
    assert np.abs(wild - height - slope * -7e-3).max() > 1e-6


def test_gradient_is_the_derivative_of_height_inside_and_outside(plane):
    rng = np.random.default_rng(4)
    for name in ("R01_S00", "R22_S11", "R34_S20"):
        center = CAMERA.centers[CAMERA.ccd_index(name)]
        x, y = center[:, None] + rng.uniform(-0.0199, 0.0199, (2, 200))
        step = 1e-6
        along_x = (plane.height(x + step, y) - plane.height(x - step, y)) / (2 * step)
        along_y = (plane.height(x, y + step) - plane.height(x, y - step)) / (2 * step)
        # Differences over 2 um: rounding 1e-17 m / 1e-6 m, and half a step across a rim of curvature 1 / m.
        assert np.allclose(plane.gradient(x, y), np.stack([along_x, along_y], -1), rtol=0, atol=1e-6)


def test_a_moved_raft_moves_rigidly_to_its_rims(plane):
    moved = plane.with_moved("R01", dz=3e-6, rx=1e-5, ry=-2e-5)
    inside = [CAMERA.ccd_index(n) for n in CAMERA.ccds_of_raft("R01")]
    center = CAMERA.centers[inside].mean(axis=0)
    rng = np.random.default_rng(5)
    x, y = (CAMERA.centers[inside][:, None] + rng.uniform(-0.02, 0.02, (9, 50, 2))).reshape(-1, 2).T
    expected = 3e-6 + 1e-5 * (y - center[1]) + 2e-5 * (x - center[0])
    # Small angles: tangents instead of angles are off by 1e-10 of 1e-6 m.
    assert np.allclose(moved.height(x, y) - plane.height(x, y), expected, rtol=0, atol=1e-15)
    assert moved.height(0.0, 0.0) == plane.height(0.0, 0.0)


def test_gaps_have_no_height(plane):
    for x, y in ((21.1e-3, 0.0), (63.5e-3, 0.0), (0.0, 63.5e-3), (0.25, 0.25), (0.4, 0.0)):
        assert np.isnan(plane.height(x, y))


def test_vendors_stand_in_their_rafts():
    assert CAMERA.vendors.count("itl") == 72
    assert CAMERA.vendors.count("e2v") == 117
    rafts = {v: {r for r, w in zip(CAMERA.raft_of, CAMERA.vendors, strict=True) if w == v} for v in ("itl", "e2v")}
    assert rafts["itl"] == {"R01", "R02", "R03", "R10", "R20", "R41", "R42", "R43"}
    assert rafts["e2v"] == {"R11", "R12", "R13", "R14", "R21", "R22", "R23", "R24", "R30", "R31", "R32", "R33", "R34"}
    # ITL rafts fill the rows at both ends of x and two places at the lowest y.
    for ccd, vendor in enumerate(CAMERA.vendors):
        x, y = CAMERA.centers[ccd] / 127e-3
        row, column = round(x) + 2, round(y) + 2
        assert (vendor == "itl") == (row in (0, 4) or (column == 0 and row in (1, 2)))


def test_itl_ccds_are_bowls(rows):
    # Their rims stand behind their centres, seen along the light: by 4 um of Zernike focus, where e2v has 0.5.
    focus = {"itl": [], "e2v": []}
    for name, vendor in zip(CAMERA.ccd_names, CAMERA.vendors, strict=True):
        focus[vendor].append(-1e3 * rows[name][-1][4])
    assert np.percentile(focus["itl"], 5) > 2.0 > np.percentile(focus["e2v"], 95)


def test_corner_sensors_stand_on_either_side_of_the_focus(rows):
    sensors = {s.name: s for s in pachon.models.corner_sensors("lsstcam")}
    assert len(sensors) == 16
    assert {s.raft for s in sensors.values()} == {"R00", "R04", "R40", "R44"}
    for name, sensor in sensors.items():
        x0, y0, left, right, bottom, top, *_ = rows[name]
        assert sensor.center == pytest.approx((1e-3 * x0, 1e-3 * y0), abs=1e-15)
        assert sensor.half_size == pytest.approx((5e-4 * (right - left), 5e-4 * (top - bottom)), abs=1e-15)
        height = float(sensor.height(*sensor.center))
        if sensor.kind == "guider":
            assert abs(height) < 30e-6
        else:
            # SW0 is extra-focal: the light, which goes along +z, reaches it behind the focus.
            side = 1 if name.endswith("SW0") else -1
            assert 1.48e-3 < side * height < 1.52e-3
        # The first digit of the name grows with x, the second with y.
        assert np.sign(sensor.center) == pytest.approx([int(name[1]) / 2 - 1, int(name[2]) / 2 - 1])
        assert np.isnan(sensor.height(sensor.center[0] + 0.03, sensor.center[1]))
    for raft in ("R00", "R04", "R40", "R44"):
        inner, outer = sensors[f"{raft}_SW0"], sensors[f"{raft}_SW1"]
        # The halves lie side by side, that behind the focus nearer to the axis.
        assert np.hypot(*inner.center) < np.hypot(*outer.center)
        apart = np.abs(np.subtract(inner.center, outer.center))
        assert sorted(apart) == pytest.approx([0.0, 23.2456e-3], abs=1e-9)


def test_corner_sensors_have_the_zernikes_of_the_file(rows):
    galsim = pytest.importorskip("galsim")
    rng = np.random.default_rng(6)
    for sensor in pachon.models.corner_sensors():
        x0, y0, *_, radius, zernikes = rows[sensor.name]
        x, y = points_within(rows[sensor.name], rng, 40)
        expected = -1e-3 * galsim.zernike.Zernike([0.0, *zernikes[1:]], radius)(x - x0, y - y0)
        assert np.abs(sensor.height(1e-3 * x, 1e-3 * y) - expected).max() < 1e-15


def test_mesh_keeps_to_the_facet_error(plane):
    mesh = plane.to_mesh(8)
    bound = np.repeat(plane.facet_error(8), 128)
    x, y, z = mesh.triangles_center.T
    assert np.all(np.abs(z - plane.height(x, y)) <= bound)


def test_there_is_no_other_camera_as_built():
    with pytest.raises(UnknownNameError, match="unknown camera as built 'lsstcm': did you mean lsstcam"):
        FocalPlane.as_measured("lsstcm")
