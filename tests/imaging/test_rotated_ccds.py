"""World coordinates and photons of CCDs that are rectangular and turned."""

import numpy as np
import pytest

import pachon
from pachon.core.units import ARCSEC
from pachon.imaging.wcs import ccd_wcs

ANGLES = (0.0, 90.0, 30.0)


def camera(angle):
    return pachon.models.Camera(
        "one", ("A",), (), np.array([-1]), np.array([[0.06, -0.09]]), np.array([3000, 1000]), 10e-6,
        rotation_deg=np.array([angle]),
    )  # fmt: skip


@pytest.mark.parametrize("angle", ANGLES)
def test_pixels_are_on_the_sky_where_their_chief_rays_come_from(lsst_r, angle):
    one = camera(angle)
    wcs = ccd_wcs(lsst_r, one, "A")
    assert wcs.shape == (1000, 3000)
    pixel = np.array([[0.0, 0.0], [2999.0, 0.0], [1200.0, 700.0], [0.0, 999.0]])
    slopes = pachon.fields_at(lsst_r, one.from_pixel(0, pixel), projection="gnomonic")
    # The polynomial is good to a milliarcsecond.
    assert np.abs(wcs.to_sky(pixel) + slopes).max() < 1e-3 * ARCSEC
    assert np.abs(wcs.to_pixel(-slopes) - pixel).max() < 0.01


@pytest.mark.parametrize(
    ("name", "ccd"), [("hsc", "hsc004"), ("hsc", "hsc050"), ("hsc", "hsc102"), ("decam", "N31"), ("decam", "S29")]
)
def test_astropy_agrees_with_the_rays_on_the_outermost_ccds_of_other_cameras(name, ccd):
    # hsc004 and N31 lie at the edge of the field, where the distortion of Hyper Suprime-Cam needs the ninth order.
    telescope, camera = pachon.load_telescope(name), pachon.load_camera(name)
    ra, dec, roll = 2.6, 1.2, 0.8
    wcs = ccd_wcs(telescope, camera, ccd, pointing=(ra, dec), position_angle=roll)
    header = wcs.astropy()
    index = camera.ccd_index(ccd)
    pixel = np.random.default_rng(4).uniform(-0.5, camera.pixels[index] - 0.5, (40, 2))
    source = -pachon.fields_at(telescope, camera.from_pixel(index, pixel), projection="gnomonic")
    # The telescope's +y lies `roll` from north towards east, its +z points to the sky.
    outwards = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    y = np.cos(roll) * np.cross(outwards, east) + np.sin(roll) * east
    vectors = source @ np.stack([np.cross(y, outwards), y]) + outwards
    expected = np.stack([np.arctan2(vectors[:, 1], vectors[:, 0]), np.arctan2(vectors[:, 2], np.hypot(*vectors.T[:2]))])
    found = np.deg2rad(header.all_pix2world(pixel, 0))
    miss = (found - expected.T) * np.stack([np.cos(expected[1]), np.ones(40)], axis=1)
    assert np.abs(miss).max() < 1e-3 * ARCSEC
    back = header.all_world2pix(np.rad2deg(expected.T), 0, tolerance=1e-6)
    scale = np.sqrt(abs(np.linalg.det(np.deg2rad(header.pixel_scale_matrix))))
    assert np.abs(back - pixel).max() * scale < 1e-3 * ARCSEC
    assert np.abs(wcs.to_pixel(wcs.to_sky(pixel)) - pixel).max() < 1e-8
    # Central differences of the pixels of places about the pointing.
    sky, step = wcs.to_sky(pixel), 1e-6
    slopes = [(wcs.to_pixel(sky + d) - wcs.to_pixel(sky - d)) / (2.0 * step) for d in step * np.eye(2)]
    assert np.allclose(np.stack(slopes, axis=2), wcs.jacobians(pixel), rtol=1e-6, atol=1e-6 / scale)


@pytest.mark.parametrize("angle", ANGLES)
def test_photons_are_counted_along_the_ccd(lsst_r, angle):
    galsim = pytest.importorskip("galsim")
    one = camera(angle)
    place = np.array([1234.0, 321.0])
    field = tuple(pachon.fields_at(lsst_r, one.from_pixel(0, place)[None])[0])
    random = galsim.BaseDeviate(5)
    photons = galsim.PhotonArray(400)
    photons.flux = 1.0
    galsim.PupilAnnulusSampler(4.1, 2.6).applyTo(photons, rng=random)
    optics = pachon.galsim.PachonOptics(
        lsst_r, field, focal_plane=pachon.FocalPlane.flat(one), ccd="A", image_pos=galsim.PositionD(*(place + 1.0))
    )
    optics.applyTo(photons)
    found, lit = np.stack([photons.x, photons.y], axis=1), photons.flux > 0
    # The same light without a CCD lies along the axes of the focal plane, about the chief ray.
    other = galsim.PhotonArray(400)
    other.flux = 1.0
    galsim.PupilAnnulusSampler(4.1, 2.6).applyTo(other, rng=galsim.BaseDeviate(5))
    pachon.galsim.PachonOptics(lsst_r, field, pixel_size=10e-6).applyTo(other)
    turned = (other.x + 1j * other.y) * np.exp(-1j * np.deg2rad(angle))
    assert lit.mean() > 0.9
    assert np.allclose(found[lit], np.stack([turned.real, turned.imag], axis=1)[lit], rtol=0, atol=1e-6)
    slope = (other.dxdz + 1j * other.dydz) * np.exp(-1j * np.deg2rad(angle))
    assert np.allclose((photons.dxdz + 1j * photons.dydz)[lit], slope[lit], rtol=0, atol=1e-12)
