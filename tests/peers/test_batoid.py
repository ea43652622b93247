"""The ray trace and the OPD against batoid, an independent tracer."""

import numpy as np
import pytest

import pachon

batoid = pytest.importorskip("batoid")

BANDS = {"u": 365e-9, "g": 480e-9, "r": 622e-9, "i": 754e-9, "z": 869e-9, "y": 971e-9}
# 0.1 nm: both trace in double precision over 20 m, so 1e-13 m would be rounding; 1e-10 m is what the designs need.
NEAR = 1e-10


def both(telescope, optic, wavelength, field, pupil):
    rays = pachon.launch_rays(telescope, field, wavelength, pupil)
    ours = pachon.trace(telescope, rays)
    theirs = batoid.RayVector.fromStop(
        *pupil, optic=optic, wavelength=wavelength, theta_x=field[0], theta_y=field[1], projection="zemax"
    )
    optic.trace(theirs)
    position = theirs.toCoordSys(batoid.CoordSys()).r
    return ours, theirs, position


def assert_same(ours, theirs, position):
    assert np.abs(ours.position - position).max() < NEAR
    assert np.abs(ours.path_length - theirs.t).max() < NEAR
    assert np.array_equal(ours.vignetted, theirs.vignetted)


@pytest.mark.parametrize("band", list(BANDS))
def test_random_rays_in_every_band(band):
    telescope = pachon.load_telescope(f"lsst_v3.3_{band}")
    optic = batoid.Optic.fromYaml(f"LSST_{band}.yaml")
    rng = np.random.default_rng(ord(band))
    # 200 rays: 20 fields out to the edge, 10 pupil points each, over the square about the pupil (some vignetted).
    vignetted = 0
    for _ in range(20):
        radius, angle = np.deg2rad(1.75) * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
        pupil = rng.uniform(-4.18, 4.18, (2, 10))
        ours, theirs, position = both(
            telescope, optic, BANDS[band], (radius * np.cos(angle), radius * np.sin(angle)), pupil
        )
        assert_same(ours, theirs, position)
        vignetted += ours.vignetted.sum()
    assert 0 < vignetted < 200


@pytest.mark.parametrize(
    ("name", "theirs", "shift", "tilt"),
    [
        ("M1", "M1", (1e-3, -2e-3, 3e-4), (0, 0, 0)),
        ("M2", "M2", (1e-4, 2e-4, -3e-4), (2e-3, -1e-3, 0)),
        ("M3", "M3", (0, 0, 0), (1e-3, 2e-3, 3e-3)),
        ("Camera", "LSSTCamera", (1e-3, -1e-3, 5e-4), (1e-3, -2e-3, 4e-3)),
        ("L2", "L2", (1e-3, 0, 2e-4), (2e-3, 1e-3, 0)),
        ("Detector", "Detector", (0, 0, 1e-4), (1e-3, 1e-3, 0)),
    ],
)
def test_rigid_body_perturbations(lsst_r, annulus_points, name, theirs, shift, tilt):
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    rotation = batoid.RotX(tilt[0]) @ batoid.RotY(tilt[1]) @ batoid.RotZ(tilt[2])
    optic = optic.withLocallyRotatedOptic(theirs, rotation).withGloballyShiftedOptic(theirs, shift)
    telescope = lsst_r.perturbed(name, shift=shift, tilt=tilt)
    assert_same(*both(telescope, optic, 622e-9, (0.015, -0.02), annulus_points(50)))


@pytest.mark.parametrize("degrees", [0.0, 35.0, -110.0])
def test_a_tilted_ccd_turns_with_the_camera(lsst_r, annulus_points, degrees):
    # The tilt of the central CCD, about the camera's own x axis: in batoid that of a detector rotated before.
    tilt, angle = 4e-4, np.deg2rad(degrees)
    heights = pachon.FocalPlane.flat("lsst").with_moved("R22_S11", dz=2e-5, rx=tilt)
    pupil, field = annulus_points(50), (2e-4, -5e-4)
    telescope = lsst_r.with_rotator(angle)
    ours = pachon.trace(telescope, pachon.launch_rays(telescope, field, 622e-9, pupil), focal_plane=heights)
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    optic = optic.withLocallyRotatedOptic("Detector", batoid.RotZ(angle) @ batoid.RotX(tilt))
    optic = optic.withGloballyShiftedOptic("Detector", (0.0, 0.0, 2e-5))
    theirs = batoid.RayVector.fromStop(
        *pupil, optic=optic, wavelength=622e-9, theta_x=field[0], theta_y=field[1], projection="zemax"
    )
    optic.trace(theirs)
    position = theirs.toCoordSys(batoid.CoordSys()).r
    assert (ours.ccd == heights.ccd_index("R22_S11")).all()
    assert np.abs(ours.position - position).max() < NEAR
    # The tilt matters, ten thousand times the tolerance: these stars lie 5 mm from its axis.
    assert np.abs(position[:, 2] - lsst_r.surfaces[-1].vertex[2] - 2e-5).max() > 2e-7


@pytest.mark.parametrize("field", [(0.0, 0.0), (0.02, 0.0), (-0.011, 0.017)])
def test_opd(lsst_r, field):
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    theirs = batoid.analysis.wavefront(optic, *field, 622e-9, projection="zemax", nx=32)
    # batoid's even grid: 32 points, spacing D/30, from -16/15 of the radius.
    axis = (np.arange(32) - 16) / 15 * 4.18
    ours = pachon.wavefront_opd(lsst_r, field, 622e-9, np.meshgrid(axis, axis))
    lit = ours.lit & ~theirs.array.mask
    assert lit.sum() > 0.98 * max(ours.lit.sum(), (~theirs.array.mask).sum())
    # Rounding only: 20 m of path at 1e-16 each over a dozen surfaces.
    assert np.abs(ours.waves - theirs.array)[lit].max() * 622e-9 < 1e-12
