"""Statistics of heights: closed forms of planes, bowls and steps, and the camera as built against brute force."""

from dataclasses import replace

import numpy as np
import pytest

from pachon import FocalPlane
from pachon.models import height_statistics
from pachon.models.camera.camera import Camera
from pachon.models.camera.ccd_surfaces import CcdSurfaces
from pachon.models.camera.lsst import lsst_camera


def plane_of(polynomial, vendors=()):
    n = len(polynomial)
    centers = np.stack([np.arange(n) * 0.05, np.zeros(n)], axis=1)
    names = tuple(f"A_S0{i}" for i in range(n))
    camera = Camera("toy", names, ("A",), np.zeros(n, dtype=int), centers, np.array([4096, 4096]), 10e-6, vendors)
    padded = np.zeros((n, 10))
    padded[:, : len(polynomial[0])] = polynomial
    return FocalPlane(camera, CcdSurfaces(camera.half_sizes, padded, np.zeros((n, 2, 4))), np.ones(n, dtype=bool))


def test_steps_planes_and_bowls_have_their_closed_forms():
    # Piston, slope along x, bowl u^2 [um], of four CCDs of two makers.
    coefficients = 1e-6 * np.array([[2, 3, 0, 0], [-2, 3, 0, 0], [0, 0, 0, 6], [0, 0, 0, 6]])
    found = height_statistics(plane_of(coefficients, ("itl", "itl", "e2v", "e2v")))
    assert list(found) == ["all", "itl", "e2v"]
    # On the grid of 24 cell centres a side the variance of u is (1 - 1/24^2) / 3.
    grid = 1 - 1 / 24**2
    itl = found["itl"]
    assert itl.n_ccd == 2
    assert itl.mean == pytest.approx(0.0, abs=1e-18)
    assert itl.ccd_mean_rms == pytest.approx(2e-6)
    assert itl.tilt_rms == pytest.approx(3e-6 * np.sqrt(grid / 3))
    assert itl.within_rms == pytest.approx(itl.tilt_rms)
    assert itl.shape_rms == pytest.approx(0.0, abs=1e-16)
    assert itl.rms == pytest.approx(np.hypot(itl.within_rms, 2e-6))
    # A slope is uniform: 95 % of it lie within 95 % of the range of the cell centres, to a step of the grid.
    assert itl.within_width95 == pytest.approx(0.95 * 6e-6, abs=6e-6 / 24)
    assert itl.peak_to_valley == pytest.approx(4e-6 + 6e-6 * 23 / 24)
    e2v = found["e2v"]
    assert e2v.mean == pytest.approx(2e-6 * grid)
    assert e2v.tilt_rms == pytest.approx(0.0, abs=1e-16)
    # u^2 has the variance 4/45.
    assert e2v.shape_rms == pytest.approx(6e-6 * np.sqrt(4 / 45), rel=5e-3)


def test_only_measured_ccds_count():
    plane = plane_of(1e-6 * np.array([[1.0], [9.0]]))
    plane = replace(plane, measured=np.array([True, False]))
    found = height_statistics(plane)
    assert list(found) == ["all"]
    assert (found["all"].n_ccd, found["all"].mean) == (1, pytest.approx(1e-6))


@pytest.mark.long
def test_the_camera_as_built_is_rougher_on_itl_ccds():
    plane = FocalPlane.as_measured("lsstcam")
    found = height_statistics(plane)
    assert (found["itl"].n_ccd, found["e2v"].n_ccd) == (72, 117)
    # Random points of the measured rectangles in place of a grid: 200 a CCD are good to some per cent. So are the rims,
    # where heights are largest, of which the grid has whole cells or none.
    camera = lsst_camera()
    # Some rectangles end beyond the pixels.
    half = camera.half_sizes[:, :, None]
    limits = np.clip(plane.surfaces.zernikes.limits, -half, half)
    rng = np.random.default_rng(1)
    at = camera.centers[:, None] + rng.uniform(limits[:, None, :, 0], limits[:, None, :, 1], (189, 200, 2))
    heights = plane.height(*np.moveaxis(at, -1, 0))
    for vendor in ("itl", "e2v"):
        of = heights[[v == vendor for v in camera.vendors]]
        assert found[vendor].rms == pytest.approx(of.std(), rel=0.07)
        within = of - of.mean(axis=1, keepdims=True)
        assert found[vendor].within_rms == pytest.approx(within.std(), rel=0.07)
        widths = np.diff(np.percentile(of, (2.5, 97.5), axis=1), axis=0)
        assert found[vendor].within_width95 == pytest.approx(np.median(widths), rel=0.1)
    assert found["itl"].shape_rms > 3 * found["e2v"].shape_rms
