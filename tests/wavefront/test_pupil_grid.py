"""The square grid over the pupil: what lies in the pupil, by other samplings and closed forms."""

from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.wavefront.pupil_grid import pupil_grid
from pachon.wavefront.pupil_sampling import gauss_annulus

LENS = Path(__file__).parents[1] / "data" / "zmx" / "lens1.zmx"
PARABOLOID = """
name: paraboloid
source: made for this test
version: "1"
units: {{length: m, angle: deg, wavelength: um}}
stop: {{z: 0.0}}
pupil: {pupil}
launch_distance: 5.0
reference_sphere_radius: 2.0
field: {{radius: 0.5, limit: 1.0}}
wavelengths: {{range: [0.4, 0.9], default: 0.6}}
surfaces:
  - {{name: M1, type: mirror, shape: paraboloid, z: 0.0, radius: 4.0{aperture}}}
  - {{name: Detector, type: detector, shape: plane, z: 2.0}}
"""


def paraboloid(tmp_path, pupil, aperture=""):
    path = tmp_path / "paraboloid.yaml"
    path.write_text(PARABOLOID.format(pupil=pupil, aperture=aperture), encoding="utf-8")
    return pachon.load_telescope(path)


def check_samplings(telescope, field, jmax):
    """Grid, Zernikes and quadrature measure the same wavefront over the same annulus."""
    radius, obscuration = 0.5 * telescope.pupil_diameter, telescope.pupil_obscuration
    wave = telescope.default_wavelength
    grid = pachon.wavefront_opd(telescope, field, wave, grid=128)
    r = np.hypot(grid.x, grid.y) / radius
    assert np.array_equal(grid.lit, (r <= 1.0) & (r >= obscuration))
    terms = pachon.fit_zernikes(grid, radius, obscuration, jmax).coefficients
    points = gauss_annulus(radius, obscuration, 12, 48)
    exact = pachon.wavefront_opd(telescope, field, wave, tuple(points.points.T))
    mean = points.weights @ exact.value
    rms = np.sqrt(points.weights @ (exact.value - mean) ** 2)
    # A rim of 128 cells across leaves 1e-3 of the area uncertain, with the largest values of the wavefront on it.
    assert grid.rms == pytest.approx(np.sqrt((terms[1:] ** 2).sum()), rel=3e-3)
    assert grid.rms == pytest.approx(rms, rel=3e-3)
    many = pachon.wavefront_opds(telescope, [field], wave, grid=128)
    assert np.array_equal(many.lit[0], grid.lit)
    return grid


def test_a_lens_without_apertures():
    grid = check_samplings(pachon.load_telescope(LENS), (0.0, 0.0), 37)
    # The corners of the square are not pupil: with them it was 244 nm.
    assert 120e-9 < grid.rms < 150e-9


@pytest.mark.parametrize("obscuration", [0.0, 0.4])
def test_a_paraboloid(tmp_path, obscuration):
    pupil = f"{{diameter: 0.4, obscuration: {obscuration}}}"
    check_samplings(paraboloid(tmp_path, pupil), (0.0, np.deg2rad(0.3)), 28)


def test_wide_apertures_leave_the_stated_pupil(tmp_path):
    """An aperture beyond the rim of the pupil stops no light of it."""
    telescope = paraboloid(tmp_path, "{diameter: 0.4, obscuration: 0.4}", ", circle: 0.5")
    check_samplings(telescope, (0.0, np.deg2rad(0.3)), 28)


def test_several_wavelengths_of_the_file(tmp_path):
    """Where surfaces stop light, the rim is looked for at one of them."""
    telescope = paraboloid(tmp_path, "{diameter: 0.4, obscuration: 0.4}", ", circle: 0.5")
    wave = telescope.default_wavelength
    several = telescope.with_design(wavelengths=(0.9 * wave, wave))
    assert all(np.array_equal(a, b) for a, b in zip(pupil_grid(several, 20), pupil_grid(telescope, 20), strict=True))


def test_surfaces_that_stop_all_light_of_the_axis_are_no_rim(tmp_path):
    """Off-axis systems are dark at the centre of the field: the pupil is the stated one."""
    telescope = paraboloid(tmp_path, "{diameter: 0.4, obscuration: 0.4}", ", annulus: [0.5, 0.6]")
    x, y, inside = pupil_grid(telescope, 20)
    assert np.array_equal(inside, (np.hypot(x, y) <= 0.2) & (np.hypot(x, y) >= 0.08))


def test_surfaces_that_stop_the_light_are_the_rim(tmp_path, lsst_r):
    """Where surfaces stop the light, the whole square is traced and they alone decide."""
    ring = paraboloid(tmp_path, "{diameter: 0.4, obscuration: 0.4}", ", annulus: [0.081, 0.2]")
    assert pupil_grid(ring, 20)[2].all()
    opd = pachon.wavefront_opd(ring, (0.0, 0.0), 600e-9, grid=128)
    r = np.hypot(opd.x, opd.y)
    assert np.array_equal(opd.lit, (r < 0.2) & (r > 0.081))
    assert pupil_grid(lsst_r, 20)[2].all()
