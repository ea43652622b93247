"""The optics over CCD heights, without atmosphere: what Figure 8 of Jee & Tyson (2011) shows."""

import numpy as np
import pytest

import pachon
from pachon.wavefront.chief_rays import fields_at

ARCSEC = np.deg2rad(1 / 3600)


@pytest.fixture(scope="module")
def ellipticity(lsst_r):
    def measure(positions, focal_plane):
        psf = pachon.make_psfs(
            lsst_r,
            fields_at(lsst_r, positions),
            [624e-9],
            focal_plane=focal_plane,
            engine=pachon.WaveEngine(pupil_spacing=0.08),
            # 1.5 arcsec, five times the width of the weight; the image repeats itself after 1.6 arcsec.
            stamps=pachon.Stamps(31, pixel_size=2.5e-6, diffusion=0.0),
        )
        shape = pachon.measure_shapes(psf.image, psf.pixel_scale, weight_fwhm=0.3 * ARCSEC)
        return shape.e1 + 1j * shape.e2

    return measure


@pytest.fixture(scope="module")
def borders():
    """Points 2.6 mm apart on either side of 24 borders between CCDs, and as far apart within one of the two."""
    centers = pachon.lsst_camera().centers
    radius = np.hypot(*centers.T)
    # The right-hand neighbour in the raft stands one CCD pitch away: 42.25 mm for CCDs of at least 40 mm.
    to_right = np.hypot(*(centers - centers[:, None] - [0.04225, 0.0]).transpose(2, 0, 1))
    chosen = np.flatnonzero((radius > 0.10) & (radius < 0.24) & (to_right.min(axis=1) < 1e-4))
    left = centers[np.random.default_rng(4).choice(chosen, 24, replace=False)]
    along = np.array([1.0, 0.0])
    return tuple(left + (0.5 * 0.04225 + step) * along for step in (-1.3e-3, 1.3e-3, -3.9e-3))


def rms(values):
    return np.sqrt(np.mean(np.abs(values) ** 2))


@pytest.mark.slow
def test_ellipticity_jumps_at_ccd_borders_and_only_there(ellipticity, borders):
    here, across, within = borders
    heights = pachon.FocalPlane.from_budget("lsst", seed=1)
    flat = pachon.FocalPlane.flat("lsst")
    jump = rms(ellipticity(across, heights) - ellipticity(here, heights))
    smooth = rms(ellipticity(within, heights) - ellipticity(here, heights))
    no_step = rms(ellipticity(across, flat) - ellipticity(here, flat))
    # Steps of some 5 um against slopes of micrometres per centimetre; without heights the design varies over degrees.
    assert jump > 0.03
    assert jump > 4 * smooth
    assert no_step < 0.01


@pytest.mark.long
def test_ellipticity_is_large_off_axis_and_turns_with_the_sign_of_the_height(ellipticity):
    centers = pachon.lsst_camera().centers
    radius = np.hypot(*centers.T)
    heights = pachon.FocalPlane.from_budget("lsst", seed=1)
    center = ellipticity(centers[radius < 0.05], heights)
    ring = ellipticity(centers[(radius > 0.15) & (radius < 0.22)][::2], heights)
    # "Most of the large sticks exceed 10 %", and the centre is least sensitive to height.
    assert np.abs(center).mean() < 0.05
    assert np.median(np.abs(ring)) > 0.10
    assert np.abs(ring).max() < 0.40

    # At one place of the field, a CCD 8 um higher and 8 um lower: radial and tangential.
    place = np.array([[0.205, 0.0]])

    def raised(height):
        table = {"x": 0.205 + np.array([0, 0.004, 0]), "y": np.array([0, 0, 0.004]), "z": np.full(3, height)}
        return ellipticity(place, pachon.FocalPlane.from_heights(table))[0]

    assert raised(8e-6).real > 0.05
    assert raised(-8e-6).real < -0.05
