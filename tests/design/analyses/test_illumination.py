import numpy as np
import pytest

import pachon
from pachon.raytrace.launch import launch_bundles
from pachon.raytrace.rays import field_direction


def test_a_small_stop_at_the_mirror_gives_the_fourth_power_of_the_cosine(paraboloid):
    # The image is f tan(theta), without distortion: cos^4. At f/100 to the square of the aperture.
    fields = np.stack([np.zeros(3), np.deg2rad([0.0, 1.0, 2.0])], axis=-1)
    result = pachon.relative_illumination(paraboloid(2.0, 100.0), fields, n_pupil=64)
    assert result.relative == pytest.approx(np.cos(fields[:, 1]) ** 4, abs=2e-5)
    assert result.f_number == pytest.approx(100.0, rel=1e-4)


def test_the_solid_angle_is_that_of_the_rays_that_meet_at_a_point(singlet):
    telescope, w = singlet(3e-3, stop_z=0.01), 587e-9
    turn = np.linspace(0.0, 2.0 * np.pi, 361)
    rim = 5e-3 * np.stack([np.cos(turn), np.sin(turn)], axis=-1)[:, None]
    for angle in (0.0, 0.2):
        rays = pachon.launch_rays(telescope, (0.0, angle), w, ([0.0], [0.0]))
        aim = pachon.trace(telescope, rays).position[0, :2]
        # Newton's method: the field whose ray through each point of the rim meets the detector there.
        slopes = np.tile([0.0, np.tan(angle)], (361, 1))
        for _ in range(6):
            ends = [pachon.trace(telescope, launched(telescope, slopes + step, w, rim)) for step in STEPS]
            miss = ends[0].position[:, :2] - aim
            jacobian = np.stack([(e.position[:, :2] - ends[0].position[:, :2]) / 1e-6 for e in ends[1:]], axis=-1)
            slopes = slopes - np.linalg.solve(jacobian, miss[..., None])[..., 0]
        assert np.abs(miss).max() < 1e-9
        x, y = ends[0].direction[:, :2].T
        area = 0.5 * abs((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())
        result = pachon.relative_illumination(telescope, [(0.0, angle)], w, n_pupil=500)
        # The polygon of 360 sides: 5e-5; 500 points at equal areas: 1e-4; at 0.2 rad the rays of one field land some
        # 0.1 mm apart, and over that the irradiance changes by 4e-4.
        assert result.solid_angle[0] == pytest.approx(area, rel=2e-4 if angle == 0.0 else 8e-4)


STEPS = np.array([[0.0, 0.0], [1e-6, 0.0], [0.0, 1e-6]])


def launched(telescope, slopes, wavelength, rim):
    return launch_bundles(telescope, field_direction(*slopes.T, "gnomonic"), wavelength, rim)


def test_vignetting_counts(paraboloid):
    telescope = paraboloid(2.0, 10.0, baffle=(1.0, 0.05))
    # A baffle of half the radius lets a quarter of the light through; on the axis relative to itself.
    result = pachon.relative_illumination(telescope, [(0.0, 0.0)], n_pupil=4000)
    assert result.lit_fraction[0] == pytest.approx(0.25, abs=5e-3)
    assert result.relative[0] == 1.0
