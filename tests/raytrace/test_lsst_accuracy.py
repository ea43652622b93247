"""The traced LSST shows what its designers say of it (Jee & Tyson 2011, section 2; Seppala 2002)."""

import numpy as np
import pytest

import pachon
from pachon.raytrace.rays import field_direction
from pachon.wavefront.chief_rays import chief_rays

ANGLES = np.deg2rad([0.2, 0.6, 1.0, 1.2, 1.4, 1.6, 1.75])


def test_focal_length_and_plate_scale(lsst_r):
    step = 1e-4
    end = chief_rays(lsst_r, field_direction([-step, step], [0.0, 0.0], "gnomonic"), 624e-9)
    focal_length = (end.position[1, 0] - end.position[0, 0]) / (2 * step)
    # "Focal length of 10.3 m, f/1.23". The paper's 0.0197"/um would be 10.47 m, which its own 10.3 m is not.
    assert focal_length == pytest.approx(10.31, abs=0.01)
    assert focal_length / 8.36 == pytest.approx(1.23, abs=0.005)
    assert np.rad2deg(1e-6 / focal_length) * 3600 == pytest.approx(0.0200, abs=5e-5)


def test_distortion_is_below_a_tenth_of_a_per_cent(lsst_r):
    end = chief_rays(lsst_r, field_direction(np.tan(ANGLES), 0 * ANGLES, "gnomonic"), 624e-9)
    scale = end.position[:, 0] / np.tan(ANGLES)
    assert np.ptp(scale) / scale.mean() < 1e-3


@pytest.mark.parametrize("band", ["u", "r", "y"])
def test_illumination_is_flat_and_falls_by_a_tenth_at_the_edge(band):
    telescope = pachon.load_telescope(f"lsst_v3.3_{band}")
    cells = ((np.arange(200) + 0.5) / 200 - 0.5) * 8.36
    x, y = np.meshgrid(cells, cells)
    light = []
    for angle in (0.0, *ANGLES):
        rays = pachon.launch_rays(telescope, (angle, 0.0), telescope.default_wavelength, (x, y))
        light.append((pachon.trace(telescope, rays).status == 0).sum())
    relative = np.array(light) / light[0]
    # "Nearly uniform" to 1.2 deg, where the design has lost 1.7 %, and "about 10 %" less at the edge. Which rays are
    # lost is held to batoid ray by ray elsewhere; 200 cells across leave 0.2 % of noise.
    assert np.abs(relative[:4] - 1).max() < 0.01
    assert 0.98 < relative[4] < 0.99
    assert 0.87 < relative[-1] < 0.93
