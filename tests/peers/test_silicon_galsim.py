"""Silicon against GalSim: its table of absorption lengths, and its SiliconSensor with the same photons."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.units import ARCSEC
from pachon.measure.shapes import measure_shapes
from pachon.models.camera.silicon import Silicon
from pachon.models.media.silicon import absorption_length
from pachon.raytrace.rays import RayStatus, field_direction, parallel_rays
from pachon.raytrace.trace import trace
from pachon.wavefront.psf.psf import make_psfs

galsim = pytest.importorskip("galsim")

#: Seeing of 0.6 arcsec as a Gaussian, per axis [rad].
SEEING = 0.255 * ARCSEC


def test_absorption_lengths_are_those_of_galsims_table():
    path = Path(galsim.meta_data.share_dir) / "sensors" / "abs_length.dat"
    nanometres, micrometres = np.loadtxt(path, skiprows=1).T
    known = (nanometres >= 300.0) & (nanometres <= 1100.0)
    nanometres, micrometres = nanometres[known], micrometres[known]
    ours = absorption_length(nanometres * 1e-9, 295.0) * 1e6
    # The same measurements. Theirs has them every 5 nm, ours every 10 nm, and they are rough: up to 7 % in between.
    every_ten = nanometres % 10.0 == 0.0
    np.testing.assert_allclose(ours[every_ten], micrometres[every_ten], rtol=5e-3)
    np.testing.assert_allclose(ours, micrometres, rtol=0.07)


@pytest.mark.long
@pytest.mark.parametrize(("band", "wavelength"), [pytest.param("z", 870e-9, marks=pytest.mark.slow), ("y", 970e-9)])
def test_size_and_ellipticity_are_those_of_galsims_sensor(band, wavelength):
    """Photons traced here, with GalSim's refraction, conversion, drift and pixels, against the fast engine."""
    count, rng = 500_000, np.random.default_rng(3)
    telescope = pachon.load_telescope(f"lsst_v3.3_{band}").perturbed("Detector", shift=(0.0, 0.0, 8e-6))
    field = np.deg2rad([1.1, 0.7])
    sensor = galsim.SiliconSensor(rng=galsim.BaseDeviate(5), nrecalc=1e300)
    diffusion = sensor._calculate_diff_step() * 1e-6
    # The temperature of GalSim's table.
    silicon = Silicon(sensor.config["SensorThickness"] * 1e-6, temperature=295.0)
    engine, stamps = pachon.FastEngine(n_pupil=5000), pachon.Stamps(41, diffusion=diffusion, jitter=SEEING)

    radius = 0.5 * telescope.pupil_diameter * np.sqrt(rng.uniform(telescope.pupil_obscuration**2, 1.0, count))
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    end = trace(telescope, parallel_rays(telescope, field_direction(field[:1], field[1:]), wavelength, points))
    passed = end.status == RayStatus.OK
    landing, travel = end.position[passed, :2], end.direction[passed]

    psfs = [
        make_psfs(telescope, field[None], [wavelength], engine=engine, stamps=replace(stamps, silicon=s))
        for s in (silicon, None)
    ]
    focal_length = 10e-6 / psfs[0].pixel_scale
    airy = galsim.Airy(lam=wavelength * 1e9, diam=telescope.pupil_diameter, obscuration=telescope.pupil_obscuration)
    kicks = airy.shoot(passed.sum(), galsim.BaseDeviate(7))
    diffraction = np.stack([kicks.x, kicks.y], axis=-1) * ARCSEC
    moved = landing + focal_length * (diffraction + SEEING * rng.standard_normal((passed.sum(), 2)))
    moved = (moved - psfs[0].reference_point[0, :2]) / 10e-6
    photons = galsim.PhotonArray(
        passed.sum(),
        x=moved[:, 0],
        y=moved[:, 1],
        dxdz=travel[:, 0] / travel[:, 2],
        dydz=travel[:, 1] / travel[:, 2],
        wavelength=wavelength * 1e9,
        flux=1.0,
    )
    galsim.Refraction(silicon.index(wavelength)).applyTo(photons)
    image, deepest = (galsim.ImageD(galsim.BoundsI(-20, 20, -20, 20), scale=1.0) for _ in range(2))
    sensor.accumulate(photons, image)
    # GalSim converts what is not absorbed at the bottom, where all light beyond the band gap goes too: take that away.
    photons.wavelength[:] = 1300.0
    sensor.accumulate(photons, deepest)
    image -= deepest * (1.0 - silicon.absorbed(wavelength))

    images = np.stack([image.array / image.array.sum(), psfs[0].image[0], psfs[1].image[0]])
    shapes = measure_shapes(images, psfs[0].pixel_scale, 0.7 * ARCSEC)
    theirs, ours, without = np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=1)
    # Three standard errors of so many photons, of which a component of e has 0.6 and the logarithm of the size 0.5 for
    # one photon, and 3e-4 of the pixel boundaries of GalSim's sensor, which are not quite straight.
    error = 3.0 * 0.6 / math.sqrt(image.array.sum()) + 3e-4
    assert np.abs(ours - theirs).max() < error
    assert np.abs(without - theirs).max() > 3.0 * error
    assert image.array.sum() / passed.sum() == pytest.approx(psfs[0].inside[0], rel=6e-3)
