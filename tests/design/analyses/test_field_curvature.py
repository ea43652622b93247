import numpy as np
import pytest

import pachon
from pachon.models.first_order import first_order, seidel_sums

FIELDS = np.stack([np.zeros(4), np.deg2rad([0.0, 0.3, 1.0, 2.0])], axis=-1)
#: Close rays are 1e-3 of the pupil from the chief ray: spherical aberration of f/10 at 1e-6 of its size at the rim.
CLOSE = 2e-9


def test_a_sphere_with_its_stop_at_the_centre_of_curvature(sphere):
    # Every chief ray is an axis: the image is a sphere about the same centre, without astigmatism.
    result = pachon.field_curvature(sphere(4.0), FIELDS)
    expected = 2.0 * (1.0 - np.cos(FIELDS[:, 1]))
    assert result.tangential[:, 0] == pytest.approx(expected, abs=CLOSE)
    assert result.sagittal[:, 0] == pytest.approx(expected, abs=CLOSE)
    assert result.distortion[0, 0] == 0.0
    assert result.distortion[1:, 0] == pytest.approx(0.0, abs=1e-9)


def test_a_sphere_with_its_stop_at_the_mirror_by_coddington(sphere):
    # t = (R/2) cos i, s = (R/2) / cos i along the chief ray.
    result = pachon.field_curvature(sphere(0.0), FIELDS)
    assert result.tangential[:, 0] == pytest.approx(-2.0 * np.sin(FIELDS[:, 1]) ** 2, abs=CLOSE)
    assert result.sagittal[:, 0] == pytest.approx(0.0, abs=CLOSE)
    assert result.astigmatism[1:, 0] == pytest.approx(-2.0 * np.sin(FIELDS[1:, 1]) ** 2, abs=CLOSE)


def test_third_order_and_petzval_near_the_axis(singlet):
    # Welford: the foci lie (S3 + S4) and (3 S3 + S4) / (2 n' u'^2) from the paraxial plane.
    telescope, angle = singlet(2e-3, stop_z=0.01), 0.01
    result = pachon.field_curvature(telescope, [(0.0, 0.0), (0.0, angle)])
    s3, s4 = seidel_sums(telescope, field=angle).total[2:4]
    slope = 5e-3 / first_order(telescope).focal_length
    sagittal = -(s3 + s4) / (2.0 * slope**2)
    tangential = -(3.0 * s3 + s4) / (2.0 * slope**2)
    found = [result.sagittal[1, 0] - result.sagittal[0, 0], result.tangential[1, 0] - result.tangential[0, 0]]
    # Fifth order: the square of the field.
    assert found == pytest.approx([sagittal, tangential], rel=1e-3)


def test_distortion_is_that_of_the_other_metric(lsst_r):
    fields = np.deg2rad([(0.0, 0.0), (1.0, 0.0), (0.0, 1.7), (0.9, -0.8)])
    ours = pachon.field_curvature(lsst_r, fields, 622e-9)
    other = pachon.distortion(lsst_r, fields, 622e-9)
    assert ours.focal_length[0] == pytest.approx(other.axis_focal_length, rel=1e-9)
    radius = np.linalg.norm(other.position, axis=-1)
    expected = 100.0 * (radius / other.axis_focal_length / np.linalg.norm(np.tan(fields), axis=-1).clip(1e-12) - 1.0)
    # Scales of central differences in two ways.
    assert ours.distortion[1:, 0] == pytest.approx(expected[1:], abs=1e-6)


def test_distortion_where_scales_differ_along_x_and_y(paraboloid):
    """On a tilted detector the scale of y is f / cos(tilt), and y goes as 1 / (1 - y' tan(tilt)) beside it; x as f."""
    telescope, tilt, slope = paraboloid(2.0, 8.0).perturbed("detector", tilt=(0.2, 0.0, 0.0)), 0.2, 5e-3
    fields = np.arctan([(slope, 0.0), (0.0, slope), (0.0, -slope)])
    result = pachon.field_curvature(telescope, fields)
    keystone = [100.0 * (1.0 / (1.0 + sign * slope * np.tan(tilt)) - 1.0) for sign in (1.0, -1.0)]
    assert result.distortion[0, 0] == pytest.approx(0.0, abs=1e-7)
    assert sorted(result.distortion[1:, 0]) == pytest.approx(keystone, abs=1e-7)
    assert result.focal_length[0] == pytest.approx(2.0 / np.sqrt(np.cos(tilt)), rel=1e-7)
    operands = [100.0 * pachon.design.RelativeDistortion(tuple(f), value=0.0).measure(telescope) for f in fields]
    assert operands == pytest.approx(result.distortion[:, 0].tolist(), abs=1e-5)


def test_a_tilted_field_is_like_one_on_the_axis_of_symmetry(singlet):
    telescope = singlet(2e-3, stop_z=0.01)
    one = pachon.field_curvature(telescope, [(0.0, 0.1)], projection="postel")
    other = pachon.field_curvature(telescope, [(0.06, -0.08)], projection="postel")
    assert other.tangential == pytest.approx(one.tangential, abs=1e-9)
    assert other.sagittal == pytest.approx(one.sagittal, abs=1e-9)


def test_a_request_with_vignetting_factors(paraboloid):
    factors = ((0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.3, 0.4, 0.0))
    fields = ((0.0, 0.0), (0.0, 5e-3))
    telescope = paraboloid(2.0, 8.0).with_design(field_type="angle", fields=fields, vignetting=factors)
    stated = pachon.field_curvature(pachon.Request.of(telescope))
    given = pachon.field_curvature(telescope, fields)
    # Close rays of a smaller pupil are closer: the focus differs by a millionth of the aberration.
    assert stated.tangential == pytest.approx(given.tangential, rel=1e-4, abs=1e-9)
    assert stated.focal_length == pytest.approx(given.focal_length, rel=1e-12)
    assert stated.distortion == pytest.approx(given.distortion, abs=1e-9)
