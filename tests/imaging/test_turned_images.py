"""Images of CCDs that are turned and rectangular: stars, galaxies and world coordinates along rows and columns."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.imaging.draw import Window
from pachon.imaging.exposure import Exposure
from pachon.imaging.scene import STAR_ROOM, draw_ccd
from pachon.models.camera.focal_plane import FocalPlane
from pachon.pipeline.simulate.ccd_exposure import ccd_stars, expose_positions
from pachon.sky.galaxies import Galaxies
from pachon.sky.pointing import Pointing

POINTING, ROLL = (0.3, 0.2), 0.7
ARCSEC = np.pi / 648000
#: Places on the CCD [pixel].
PLACES = np.array([[400.0, 300.0], [1500.0, 900.0]])


def on_camera(run, angle):
    """The run with one CCD of 2000 x 1200 pixels, turned, 0.7 deg from the axis, with a tilt and a ripple."""
    camera = pachon.models.Camera(
        "turned", ("A",), (), np.array([-1]), np.array([[0.08, -0.09]]), np.array([2000, 1200]), 10e-6,
        rotation_deg=np.array([angle]),
    )  # fmt: skip
    config = run.config.model_copy(update={"ccds": ("A",)})
    plane = FocalPlane.from_budget(camera, seed=2).with_moved("A", dz=8e-6, rx=3e-4, ry=-1e-4)
    return replace(run, config=config, focal_plane=plane)


def moments(images, width=4.0):
    """Centroid, as a complex number [pixel], and (Q11 - Q22 + 2i Q12) / (Q11 + Q22) under a round weight."""
    y, x = np.indices(images.shape[1:]) - images.shape[1] // 2
    image = images * np.exp(-0.5 * (x * x + y * y) / width**2)
    total = image.sum(axis=(1, 2))
    first = [(image * v).sum(axis=(1, 2)) / total for v in (x, y)]
    dx, dy = x - first[0][:, None, None], y - first[1][:, None, None]
    xx, yy, xy = ((image * v).sum(axis=(1, 2)) / total for v in (dx * dx, dy * dy, dx * dy))
    return first[0] + 1j * first[1], (xx - yy + 2j * xy) / (xx + yy)


@pytest.mark.parametrize("angle", [90.0, 180.0, -90.0])
def test_stamps_along_a_ccd_at_a_quarter_turn_are_turned_by_it(small_run, angle):
    run = on_camera(small_run, angle)
    positions = run.camera.from_pixel(0, PLACES)
    upright = expose_positions(run, positions).image
    along = expose_positions(run, positions, along="A").image
    # The image [y, x] seen from axes that are turned from +x towards +y is turned from +y towards +x.
    expected = np.rot90(upright, round(angle / 90.0), axes=(1, 2))
    assert np.abs(along - expected).max() < 1e-6 * upright.max()


@pytest.mark.parametrize("angle", [30.0, -123.0])
def test_moments_of_stamps_turn_with_the_ccd(small_run, angle):
    run = on_camera(small_run, angle)
    positions = run.camera.from_pixel(0, PLACES)
    first, shape = moments(expose_positions(run, positions).image)
    first_along, shape_along = moments(expose_positions(run, positions, along="A").image)
    turn = np.exp(1j * np.deg2rad(angle))
    assert np.abs(shape).max() > 0.01
    # Square pixels have moments of fourth order that do not turn: 1e-4 of the second ones.
    assert np.abs(first_along * turn - first).max() < 2e-4
    assert np.abs(shape_along * turn**2 - shape).max() < 2e-4


@pytest.mark.parametrize("angle", [180.0, 30.0])
def test_stars_of_a_turned_ccd_are_those_of_make_psfs(small_run, angle):
    run = on_camera(small_run, angle)
    scene = draw_ccd(
        run, "A", lambda xi, eta: Galaxies.concatenate([]), pointing=Pointing(*POINTING, ROLL)
    )  # fmt: skip
    assert scene.electrons.shape == (1200, 2000)
    field = ccd_stars(run, "A", 0.7 * ARCSEC)
    pixels = np.stack([scene.objects["X"], scene.objects["Y"]], axis=1)
    # Turned by hand: places by rotation about the centre of the CCD, the detector by the rotator of the telescope.
    c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    local = (field.observed - [0.08, -0.09]) @ np.array([[c, -s], [s, c]])
    assert np.allclose(pixels, local / 10e-6 + [999.5, 599.5], rtol=0, atol=1e-6)
    nearest = np.rint(pixels).astype(int)
    camera = replace(run.camera, centers=run.camera.centers @ np.array([[c, -s], [s, c]]), rotation_deg=np.zeros(1))
    psfs = pachon.make_psfs(
        run.telescope.with_rotator(np.deg2rad(angle)),
        pachon.fields_at(run.telescope, field.observed, run.wavelengths[len(run.wavelengths) // 2]),
        pachon.Light(run.wavelengths, dispersion=run.dispersion),
        focal_plane=replace(run.focal_plane, camera=camera),
        atmosphere=run.atmosphere,
        aberration=run.aberration,
        engine=pachon.LongExposureEngine(n_pupil=300),
        stamps=pachon.Stamps(
            run.stamp_size + STAR_ROOM,
            pixel_size=run.pixel_size,
            diffusion=run.diffusion,
            jitter=run.jitter,
            offsets=pixels - nearest,
        ),
    )
    electrons = Exposure("r", run.config.atmosphere.exposure_s).electrons(scene.objects["MAG"])
    assert np.allclose(scene.objects["FLUX"], electrons * psfs.lit_fraction.mean(axis=1), rtol=1e-12)
    checked = 0
    for i, (x, y) in enumerate(nearest):
        far = np.abs(nearest - (x, y)).max(axis=1) > 130
        if not (63 <= x < 2000 - 63 and 63 <= y < 1200 - 63) or far.sum() < len(far) - 1:
            continue
        expected = psfs.image[i] * scene.objects["FLUX"][i]
        drawn = scene.electrons[y - 63 : y + 64, x - 63 : x + 64]
        assert np.abs(drawn - expected).max() < 1e-4 * expected.max()
        assert drawn.sum(dtype=np.float64) == pytest.approx(scene.objects["FLUX"][i], rel=1e-4)
        checked += 1
    assert checked > 1


def test_a_galaxy_lies_where_the_header_says_and_keeps_its_light(small_run):
    run = on_camera(small_run, 30.0)
    run = replace(
        run, config=run.config.model_copy(update={"stars": run.config.stars.model_copy(update={"observed": 1})})
    )

    def galaxy(xi, eta):
        return Galaxies.single([np.mean(xi)], [np.mean(eta)], [18.0], [0.4 * ARCSEC], e1=[0.4], e2=[0.0])

    scene = draw_ccd(run, "A", galaxy, pointing=Pointing(*POINTING, ROLL), window=Window(500, 100, 1000, 1000))
    image = scene.exposed(replace(scene.exposure, noise=False))
    row = np.flatnonzero(~image.objects["STAR"])[0]
    at = image.wcs.all_world2pix([[image.objects["RA"][row], image.objects["DEC"][row]]], 0)[0]
    x, y = np.rint(at).astype(int)
    part = scene.electrons[y - 100 : y + 101, x - 100 : x + 101].astype(np.float64)
    assert part.sum() == pytest.approx(scene.objects["FLUX"][row], rel=3e-4)
    # The centre of its light is that of the PSF there: coma and the height of the CCD move both.
    psf = expose_positions(run, run.camera.from_pixel(0, at[None] + [500, 100]), room=STAR_ROOM, along="A").image
    center, star = moments(part[None], 12.0)[0], moments(psf, 12.0)[0]
    assert abs(center[0] + complex(x, y) - complex(*at) - star[0]) < 0.01
    # Elongated towards east: along the column of the Jacobian of xi.
    east = scene.wcs.jacobians(at[None] + [500, 100])[0][:, 0]
    angle = np.angle(moments(part[None])[1][0])
    assert abs(np.exp(1j * angle) - np.exp(2j * np.angle(east[0] + 1j * east[1]))) < 0.15
