"""Shapes on the sky, against moments by brute force, GalSim's sky coordinates and TreeCorr's tangential shear."""

import numpy as np
import pytest
from astropy.wcs import WCS

import pachon
from pachon.core.errors import DomainError
from pachon.measure.shapes import Shapes

ROLLS = [0.0, 30.0, 45.0, 90.0, 135.0, 200.0, 270.0, 315.0]
RA, DEC = 40.0, -35.0


def image_wcs(roll_deg, mirrored, shear=0.0, scale=0.2):
    """Return the WCS of an image turned by `roll_deg`, mirrored or as the sky is seen, sheared along its x."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = "RA---TAN", "DEC--TAN"
    wcs.wcs.crval = RA, DEC
    wcs.wcs.crpix = 1001.0, 1001.0
    turn = np.deg2rad(roll_deg)
    # As the sky is seen x points west, to the right: minus right ascension.
    axes = np.array([[-np.cos(turn), np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    wcs.wcs.cd = axes @ np.diag([-1.0 if mirrored else 1.0, 1.0]) @ np.diag([1 + shear, 1 - shear]) * scale / 3600
    wcs.pixel_shape = (2001, 2001)
    return wcs


def moments(g):
    """Return the second moments of an ellipse (a - b)/(a + b) = |g|."""
    return np.array([[1 + abs(g) ** 2 + 2 * g.real, 2 * g.imag], [2 * g.imag, 1 + abs(g) ** 2 - 2 * g.real]])


def shape_of(q):
    return (q[0, 0] - q[1, 1] + 2j * q[0, 1]) / (np.trace(q) + 2 * np.sqrt(np.linalg.det(q)))


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("roll", ROLLS)
def test_moments_are_carried_by_the_world_coordinates(roll, mirrored):
    wcs, g = image_wcs(roll, mirrored, shear=0.05), 0.2 - 0.13j
    # At the reference point the plane is the sky: west is minus xi. FITS's CD is d(xi, eta)/d(x, y).
    jacobian = np.diag([-1.0, 1.0]) @ wcs.wcs.cd
    expected = shape_of(jacobian @ moments(g) @ jacobian.T)
    for shapes in ([[g.real, g.imag]], Shapes(*np.array([[g.real], [g.imag]]), *[np.zeros(1)] * 5)):
        sky = pachon.to_sky(shapes, wcs, [1000.0], [1000.0])
        assert np.allclose([sky.g1_sky[0], sky.g2_sky[0]], [expected.real, expected.imag], rtol=0, atol=1e-8)
        assert np.allclose(np.rad2deg([sky.ra[0], sky.dec[0]]), [RA, DEC], rtol=0, atol=1e-10)


def test_shapes_without_a_number_have_none_and_no_shapes_are_none():
    sky = pachon.to_sky([[np.nan, np.nan], [0.1, 0.2]], image_wcs(30.0, mirrored=True), [5.0, 6.0], [7.0, 8.0])
    assert np.array_equal(np.isnan(sky.g1_sky), [True, False])
    assert np.array_equal(np.isnan(sky.g2_sky), [True, False])
    assert len(pachon.to_sky(np.zeros((0, 2)), image_wcs(0.0, mirrored=False), [], [])) == 0


def test_galaxies_on_the_sky_are_elongated_as_the_convention_says():
    # As the sky is seen, north up: along x is east to west, x = y is from the north-west to the south-east.
    sky = pachon.to_sky([[0.1, 0.0], [0.0, 0.1]], image_wcs(0.0, mirrored=False), [1000.0, 1000.0], [1000.0, 1000.0])
    assert np.allclose([sky.g1_sky, sky.g2_sky], [[0.1, 0.0], [0.0, 0.1]], rtol=0, atol=1e-8)
    # Of a mirrored image, whose x runs east, x = y is from the north-east: g2 changes its sign.
    mirrored = pachon.to_sky([[0.1, 0.1]], image_wcs(0.0, mirrored=True), 1000.0, 1000.0)
    assert np.allclose([mirrored.g1_sky, mirrored.g2_sky], [[0.1], [-0.1]], rtol=0, atol=1e-8)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("roll", ROLLS)
def test_tangential_galaxies_have_a_positive_tangential_shear(roll, mirrored):
    treecorr = pytest.importorskip("treecorr")
    wcs, rng = image_wcs(roll, mirrored), np.random.default_rng(3)
    x, y = rng.uniform(0.0, 2000.0, (2, 400))
    # Tangential about the middle, in the pixels: along the direction across the radius.
    tangential = -0.05 * np.exp(2j * np.arctan2(y - 1000.0, x - 1000.0))
    sky = pachon.to_sky(np.stack([tangential.real, tangential.imag], axis=1), wcs, x, y)
    lens = treecorr.Catalog(ra=[RA], dec=[DEC], ra_units="deg", dec_units="deg")
    sources = treecorr.Catalog(ra=sky.ra, dec=sky.dec, g1=sky.g1_sky, g2=sky.g2_sky, ra_units="rad", dec_units="rad")
    correlation = treecorr.NGCorrelation(min_sep=0.1, max_sep=5.0, nbins=1, sep_units="arcmin", bin_slop=0.0)
    correlation.process(lens, sources, num_threads=1)
    # Great circles about the middle of 200 arcsec depart from the plane by 1e-6.
    assert correlation.xi[0] == pytest.approx(0.05, abs=1e-6)
    assert correlation.xi_im[0] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("roll", ROLLS)
def test_shapes_are_those_of_galsim_in_sky_coordinates(roll, mirrored):
    galsim = pytest.importorskip("galsim")
    wcs = image_wcs(roll, mirrored, shear=0.02)
    world = galsim.AstropyWCS(wcs=wcs)
    center = galsim.PositionD(801.0, 1301.0)
    galaxy = galsim.Gaussian(sigma=0.8).shear(g1=0.15, g2=-0.2)
    image = galaxy.drawImage(nx=41, ny=41, center=center, wcs=world, method="no_pixel")
    in_pixels = galsim.hsm.FindAdaptiveMom(image).observed_shape
    on_sky = galsim.hsm.FindAdaptiveMom(image, use_sky_coords=True).observed_shape
    sky = pachon.to_sky([[in_pixels.g1, in_pixels.g2]], wcs, 800.0, 1300.0)
    # Drawn without pixels and sampled at 4 pixels a sigma: HSM's convergence is 1e-6.
    assert np.allclose([sky.g1_sky[0], sky.g2_sky[0]], [0.15, -0.2], rtol=0, atol=1e-5)
    assert np.allclose([sky.g1_sky[0], sky.g2_sky[0]], [on_sky.g1, on_sky.g2], rtol=0, atol=1e-5)


def test_ours_and_astropys_coordinates_agree(lsst_r):
    camera = pachon.load_camera("lsst")
    fitted = pachon.ccd_wcs(lsst_r.with_rotator(0.3), camera, "R34_S20", pointing=(1.0, -0.5), position_angle=0.4)
    x, y = np.random.default_rng(1).uniform(0.0, 4000.0, (2, 20))
    e = np.random.default_rng(2).normal(0.0, 0.1, (20, 2))
    ours, theirs = (pachon.to_sky(e, wcs, x, y) for wcs in (fitted, fitted.astropy()))
    assert np.array_equal(ours.g1_sky, theirs.g1_sky)
    assert ours.to_table().colnames == ["ra", "dec", "g1_sky", "g2_sky"]
    # The telescope distorts by less than 1e-3 there.
    assert np.hypot(ours.g1_sky, ours.g2_sky) == pytest.approx(np.hypot(*e.T), abs=2e-3)


def test_bad_arguments_are_one_line():
    wcs = image_wcs(0.0, mirrored=False)
    with pytest.raises(DomainError, match="2 and 2 components of shapes at 1 places: expected one length"):
        pachon.to_sky(np.zeros((2, 2)), wcs, 1.0, 1.0)
    with pytest.raises(DomainError, match=r"expected g1 and g2, e1 and e2, or an array of shape \[n, 2\]"):
        pachon.to_sky(np.zeros((2, 3)), wcs, [1.0, 2.0], [1.0, 2.0])
    with pytest.raises(DomainError, match="expected a WCS of astropy"):
        pachon.to_sky(np.zeros((1, 2)), "header", 1.0, 1.0)
    wcs.wcs.ctype = "GLON-TAN", "GLAT-TAN"
    with pytest.raises(DomainError, match="'GLON-TAN', 'GLAT-TAN': expected two axes, right ascension"):
        pachon.to_sky(np.zeros((1, 2)), wcs, 1.0, 1.0)
