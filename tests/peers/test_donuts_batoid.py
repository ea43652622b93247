"""A donut of batoid's rays: its wavefront is the difference of batoid's Zernikes, sign and frame included."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import pachon

batoid = pytest.importorskip("batoid")

WAVELENGTH = 622e-9
PIXEL, SIZE, FINE = 20e-6, 91, 4


@pytest.mark.long
def test_wavefront_of_a_donut_is_that_of_batoid():
    field = np.deg2rad([0.6, 0.9])
    behind = batoid.Optic.fromYaml("LSST_r.yaml").withGloballyShiftedOptic("LSST.LSSTCamera.Detector", [0, 0, 1.5e-3])
    # The sizes of real misalignments; less than a nanometre is beyond Z22.
    true = behind.withGloballyShiftedOptic("LSST.M2", [1e-4, -5e-5, 5e-6])
    u = np.linspace(-4.2, 4.2, 701)
    x, y = (v.ravel() for v in np.meshgrid(u, u))
    rays = batoid.RayVector.fromStop(
        x, y, optic=true, wavelength=WAVELENGTH, theta_x=field[0], theta_y=field[1], projection="zemax"
    )
    chief = batoid.RayVector.fromStop(
        0.0, 0.0, optic=true, wavelength=WAVELENGTH, theta_x=field[0], theta_y=field[1], projection="zemax"
    )
    true.trace(rays)
    true.trace(chief)
    lit = ~rays.vignetted & ~rays.failed
    place = np.stack([rays.x[lit] - chief.x[0], rays.y[lit] - chief.y[0]]) / PIXEL
    margin = 8
    edges = np.arange((SIZE + 2 * margin) * FINE + 1) / FINE - 0.5 * (SIZE + 2 * margin)
    fine = gaussian_filter(np.histogram2d(place[1], place[0], [edges, edges])[0], FINE)
    image = fine.reshape(len(fine) // FINE, FINE, -1, FINE).sum(axis=(1, 3))[margin:-margin, margin:-margin]
    fit = pachon.fit_donuts(
        pachon.load_telescope("lsst_v3.3_r").perturbed("Detector", shift=(0.0, 0.0, 1.5e-3)),
        5e6 * image[None] / lit.sum(),
        [field],
        WAVELENGTH,
        sky_variance=500.0,
        model=pachon.DonutModel(
            air=pachon.DonutAir(fwhm=0.0), detector=pachon.DonutDetector(pixel_size=PIXEL, diffusion=PIXEL)
        ),
    )
    before, after = (
        batoid.zernikeGQ(optic, *field, WAVELENGTH, projection="zemax", jmax=37, eps=0.61)[4:23] * WAVELENGTH
        for optic in (behind, true)
    )
    assert np.linalg.norm(after - before) > 60e-9
    # Rims of 700 rays across, and 3e-3 of the wavefront (docs/explanation/donuts.md).
    assert np.linalg.norm(fit.zernikes[0] - (after - before)) < 6e-9


@pytest.mark.long
def test_a_moved_camera_is_not_a_moved_detector():
    """The wavefront that a fit under the wrong body takes for the telescope's (docs/explanation/donuts.md)."""
    telescope, optic = pachon.load_telescope("lsst_v3.3_r"), batoid.Optic.fromYaml("LSST_r.yaml")
    fields = np.deg2rad([0.0, 0.5, 1.0, 1.5, 1.75])
    shift = (0.0, 0.0, 1.5e-3)
    camera, detector = (
        pachon.wavefront_zernikes(
            telescope.perturbed(body, shift=shift), [(0.0, field) for field in fields], WAVELENGTH, jmax=22
        ).coefficients
        for body in ("Camera", "Detector")
    )
    size = 1e9 * np.linalg.norm((camera - detector)[:, 4:], axis=1)
    assert np.round(size).tolist() == [38, 69, 146, 269, 349]
    bodies = [optic.withGloballyShiftedOptic(name, shift) for name in ("LSST.LSSTCamera", "LSST.LSSTCamera.Detector")]
    for field, ours in zip(fields, camera - detector, strict=True):
        moved, still = (
            batoid.zernikeGQ(body, 0.0, field, WAVELENGTH, projection="zemax", jmax=22, eps=0.612)[4:23] * WAVELENGTH
            for body in bodies
        )
        # 349 nm of terms up to Z22 on pupils whose vignetted edges the two sample differently.
        assert np.abs(moved - still - ours[3:]).max() < 1e-9


def test_motions_in_zcs_are_those_of_batoid_rubin():
    """batoid_rubin, builder.py: shifts (-dx, dy, -dz) and turns RotX(-rx) RotY(ry) of batoid's optics."""
    telescope, field = pachon.load_telescope("lsst_v3.3_r"), np.deg2rad([0.6, 0.9])
    names = [
        "M2.dx",
        "M2.dy",
        "M2.dz",
        "M2.rx",
        "M2.ry",
        "Camera.dx",
        "Camera.dy",
        "Camera.dz",
        "Camera.rx",
        "Camera.ry",
    ]
    values = 5.0 * np.array([2e-5, -3e-5, 1e-5, 5e-6, 8e-6, -4e-5, 1e-5, -5e-6, 1e-5, -6e-6])
    freedoms = pachon.models.DegreesOfFreedom.of_parameters(telescope, names)
    estimate = pachon.sensing.FreedomEstimate(freedoms, values, np.eye(10), np.ones(10))
    corrections = pachon.sensing.hexapod_corrections(estimate, frame="ZCS")
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    for body, shift, tilt in zip(("M2", "LSSTCamera"), -corrections.shift, -corrections.tilt, strict=True):
        optic = optic.withGloballyShiftedOptic(body, np.array([-shift[0], shift[1], -shift[2]]) * 1e-6)
        rx, ry = batoid.RotX(np.deg2rad(-tilt[0] / 3600.0)), batoid.RotY(np.deg2rad(tilt[1] / 3600.0))
        optic = optic.withLocallyRotatedOptic(body, rx @ ry)
    theirs = batoid.zernikeGQ(optic, *field, WAVELENGTH, projection="zemax", jmax=22, eps=0.61)[4:] * WAVELENGTH
    changed = freedoms.apply(telescope, values)
    ours = pachon.wavefront_zernikes(changed, [field], WAVELENGTH, jmax=22).coefficients[0, 3:]
    design = pachon.wavefront_zernikes(telescope, [field], WAVELENGTH, jmax=22).coefficients[0, 3:]
    assert np.linalg.norm(ours - design) > 300e-9
    # The obscurations are 0.61 and 0.612.
    np.testing.assert_allclose(ours, theirs, atol=4e-9)
