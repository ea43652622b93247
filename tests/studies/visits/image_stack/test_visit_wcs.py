"""World coordinates of a CCD in a visit against chief rays traced from the sky."""

import numpy as np
import pytest

import pachon
from pachon.imaging.wcs import ccd_wcs
from pachon.studies.visits.image_stack.visit_wcs import VisitWcs
from pachon.studies.visits.plan import Visit

VISIT = Visit(3, 3, roll=1.1, pointing=(0.004, -0.003))
WAVELENGTH = 620e-9


@pytest.fixture(scope="module")
def wcs(lsst_r):
    return VisitWcs(ccd_wcs(lsst_r, pachon.lsst_camera(), "R22_S12", wavelength=WAVELENGTH), VISIT)


@pytest.fixture(scope="module")
def pixels():
    return np.random.default_rng(1).uniform(0.0, 4003.0, (50, 2))


def test_the_sky_falls_where_its_chief_rays_do(lsst_r, wcs, pixels):
    camera = pachon.lsst_camera()
    landing = VISIT.on_detector(lsst_r, wcs.to_sky(pixels), WAVELENGTH)
    center = camera.centers[camera.ccd_index("R22_S12")]
    # 0.3 milliarcseconds is the tolerance of the polynomials: 1.5e-3 pixel.
    # The pixels' x and y run along y and x of the focal plane.
    found = (landing - center)[:, ::-1] / camera.pixel_size + [2047.5, 2001.5]
    assert np.allclose(found, pixels, rtol=0, atol=1.5e-3)


def test_pixels_and_sky_are_inverse(wcs, pixels):
    assert np.allclose(wcs.to_pixel(wcs.to_sky(pixels)), pixels, rtol=0, atol=1e-6)


def test_jacobians_are_the_derivatives(wcs, pixels):
    sky, step = wcs.to_sky(pixels), 1e-6
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        slope = (wcs.to_pixel(sky + shift) - wcs.to_pixel(sky - shift)) / (2.0 * step)
        # Of 1e6 pixels a radian; third derivatives times the square of the step are far below.
        assert np.allclose(wcs.jacobians(pixels)[:, :, axis], slope, rtol=0, atol=1.0)
