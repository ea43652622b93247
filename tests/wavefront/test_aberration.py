"""Residual wavefronts of active optics: signs and sizes against the ray trace of a moved camera, and statistics."""

import re

import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.core.errors import DomainError
from pachon.models.zernike_polynomials import annular_zernikes
from pachon.wavefront.aberration import LINEAR_FRACTION, PAPER_RMS, ResidualWavefront
from pachon.wavefront.psf.psf import make_psfs
from pachon.wavefront.pupil_optics import trace_pupils

WAVELENGTH = np.array([620e-9])
FIELDS = np.radians([[0.0, 0.0], [0.8, 0.9], [-1.2, 0.3]])
EPS = 0.612
# 22 terms would leave out a picometre of the wavefront of a moved camera, and 3e-4 of its slopes at the rim.
JMAX = 37


@pytest.fixture(scope="module")
def pupil(annulus_points):
    return np.stack(annulus_points(1500, 5), axis=-1)


def fitted(pupil, lit, opd):
    """Coefficients of an OPD [n_pupil], and residuals over the lit points."""
    terms = annular_zernikes(JMAX, *(pupil.T / 4.18), EPS)
    coefficients, *_ = np.linalg.lstsq(terms[:, lit].T, opd[lit], rcond=None)
    return coefficients, opd[lit] - coefficients @ terms[:, lit]


def test_the_opd_gains_a_planted_aberration(lsst_r, pupil):
    planted = np.random.default_rng(2).normal(0.0, 1e-7, JMAX - 3)
    aberration = ResidualWavefront(planted, 8.36, EPS)
    without, with_it = (trace_pupils(lsst_r, FIELDS, WAVELENGTH, pupil, aberration=a) for a in (None, aberration))
    for star in range(3):
        gained = without.path[star, 0] - with_it.path[star, 0]
        coefficients, left = fitted(pupil, without.lit[star, 0], gained)
        # The OPD is minus the path. No piston and no tilt; rounding of 1e-6 m of path held beside 30 m.
        np.testing.assert_allclose(coefficients, [0.0, 0.0, 0.0, *planted], atol=1e-13)
        assert np.abs(left).max() < 1e-13
    for same in ("lit", "jacobian", "reference_points"):
        np.testing.assert_array_equal(getattr(without, same), getattr(with_it, same))


@pytest.mark.long
@pytest.mark.parametrize("element", ["Camera", "M2"])
def test_defocus_is_that_of_a_moved_camera_or_mirror(lsst_r, pupil, element):
    """Path and landing points of rays through a shifted element, and of the nominal telescope with its Zernikes."""
    shifted = lsst_r.perturbed(element, shift=(0.0, 0.0, 6.7e-6))
    nominal, moved = (trace_pupils(t, FIELDS, WAVELENGTH, pupil) for t in (lsst_r, shifted))
    for star in range(3):
        lit = nominal.lit[star, 0] & moved.lit[star, 0]
        change = (nominal.path - moved.path)[star, 0]
        coefficients, left = fitted(pupil, lit, change)
        # Mostly 0.1 um of Noll's defocus, and nothing beyond the terms.
        assert abs(coefficients[3]) == pytest.approx(0.1e-6, rel=0.1)
        assert np.abs(left).max() < 1e-12
        aberration = ResidualWavefront(coefficients[3:], 8.36, EPS)
        ours = trace_pupils(lsst_r, FIELDS[star : star + 1], WAVELENGTH, pupil, aberration=aberration)
        expected = (moved.displacement - nominal.displacement)[star, 0, lit]
        got = (ours.displacement[0] - nominal.displacement[star])[0, lit]
        # A shift of all rays together is the tilt that is left out here. The rest: the exit pupil is the image of the
        # entrance pupil to 1e-4.
        off = (got - got.mean(axis=0)) - (expected - expected.mean(axis=0))
        assert np.abs(off).max() < 1e-4 * np.abs(expected).max()


def test_noll_defocus_of_a_moved_camera_in_closed_form(lsst_r, pupil):
    """Light that converges on a point a distance d behind the detector gains d (1 - cos), and sin = p / f."""
    shift = 6.7e-6
    nominal, moved = (
        trace_pupils(t, FIELDS[:1], WAVELENGTH, pupil)
        for t in (lsst_r, lsst_r.perturbed("Camera", shift=(0, 0, shift)))
    )
    coefficients, _ = fitted(pupil, nominal.lit[0, 0], (nominal.path - moved.path)[0, 0])
    nodes, weights = np.polynomial.legendre.leggauss(20)
    square = 0.5 * (1.0 - EPS**2) * nodes + 0.5 * (1.0 + EPS**2)
    gained = shift * (1.0 - np.sqrt(1.0 - square * (4.18 / 10.31) ** 2))
    term = np.sqrt(3.0) * (2.0 * square - 1.0 - EPS**2) / (1.0 - EPS**2)
    # Lenses and filter move with the camera, weak but thick glass in a converging beam: a few per cent.
    assert coefficients[3] == pytest.approx(0.5 * np.sum(weights * gained * term), rel=0.03)


def test_displacement_is_the_gradient_of_the_path(lsst_r, pupil):
    """Changes of landing points against finite differences over the pupil of the change of path."""
    rng = np.random.default_rng(4)
    aberration = ResidualWavefront(rng.normal(0.0, 1e-7, 19), 8.36, EPS, rng.normal(0.0, 3e-6, (19, 2)))
    h = 1e-3
    steps = h * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    points = (pupil[:200, None] + steps).reshape(-1, 2)
    without, with_it = (trace_pupils(lsst_r, FIELDS, WAVELENGTH, points, aberration=a) for a in (None, aberration))
    added = (with_it.path - without.path).reshape(3, 200, 5)
    gradient = np.stack([added[..., 1] - added[..., 2], added[..., 3] - added[..., 4]], axis=-1) / (2.0 * h)
    expected = np.einsum("sij,spj->spi", without.jacobian, gradient)
    moved = (with_it.displacement - without.displacement).reshape(3, 200, 5, 2)[:, :, 0]
    lit = without.lit.reshape(3, 200, 5).all(axis=2)
    assert lit.sum() > 300
    # Third derivatives over 1 mm: 1e-6. Landing points are in single precision: 4e-12 m of 50 um.
    assert np.abs(moved - expected)[lit].max() < 1e-5 * np.abs(expected[lit]).max()
    assert np.ptp(moved[0] - moved[1], axis=0).max() > 1e-7


def test_terms_linear_in_the_field_hold_what_misalignment_does(lsst_r, pupil):
    """A shifted and tilted camera and secondary, at field points that were not fitted."""
    moved = lsst_r.perturbed("M2", shift=(30e-6, -10e-6, 2e-6), tilt=(1e-5, -2e-5, 0.0))
    moved = moved.perturbed("Camera", shift=(-20e-6, 40e-6, 0.0), tilt=(-1e-5, 1e-5, 0.0))
    angle = np.arange(12) * np.pi / 6
    at = np.deg2rad(1.5) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    fields = np.concatenate([at, 0.5 * at[::3], np.zeros((1, 2))])
    change = -np.subtract(*(trace_pupils(t, fields, WAVELENGTH, pupil).path[:, 0] for t in (moved, lsst_r)))
    lit = trace_pupils(lsst_r, fields, WAVELENGTH, pupil).lit[:, 0]
    coefficients = np.array([fitted(pupil, lit[s], change[s])[0] for s in range(len(fields))])[:, 3:]
    design = np.concatenate([np.ones((len(fields), 1)), np.tan(fields)], axis=1)
    even = np.arange(len(fields)) % 2 == 0
    plane, *_ = np.linalg.lstsq(design[even], coefficients[even], rcond=None)
    aberration = ResidualWavefront(plane[0], 8.36, EPS, plane[1:].T)
    rest = coefficients[~even] - aberration.at(np.tan(fields[~even]))
    size = np.sqrt(np.mean(np.sum(coefficients[~even] ** 2, axis=1)))
    constant = np.sqrt(np.mean(np.sum((coefficients[~even] - plane[0]) ** 2, axis=1)))
    # Terms that are constant over the field are not enough; the residuals of linear ones are small.
    assert size > 1e-7
    assert constant > 0.5 * size
    assert np.sqrt(np.mean(np.sum(rest**2, axis=1))) < 0.1 * size


@pytest.mark.long
def test_rms_over_pupil_field_and_exposures(lsst_r, annulus_points):
    x, y = annulus_points(400, 1)
    rng = np.random.default_rng(6)
    radius, angle = lsst_r.field_radius * np.sqrt(rng.random(60)), rng.uniform(0.0, 2.0 * np.pi, 60)
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    squares = [
        np.mean(ResidualWavefront.draw(lsst_r, 0.2 * u.um, seed=3, epoch=e).opd(x, y, places) ** 2) for e in range(300)
    ]
    # Some three of the 57 numbers hold most of the variance, so that of one exposure scatters by about its own size:
    # 5 % for 300, and 2 % for 400 points of the pupil; 4 sigma.
    assert np.mean(squares) == pytest.approx(0.2e-6**2, rel=0.2)
    # Over the pupil the mean square is the sum of the squared coefficients: an orthonormal basis.
    aberration = ResidualWavefront.draw(lsst_r, seed=3)
    x, y = annulus_points(40000, 2)
    expected = np.sum(aberration.at(places[0]) ** 2)
    # Random points: the square of a wavefront scatters by about itself, so 0.5 %; 4 sigma.
    assert np.mean(aberration.opd(x, y, places[0]) ** 2) == pytest.approx(expected, rel=0.02)


@pytest.mark.slow
def test_amplitudes_fall_with_the_degree_and_half_the_variance_is_linear_in_the_field(lsst_r):
    drawn = [ResidualWavefront.draw(lsst_r, PAPER_RMS, seed=1, epoch=e) for e in range(2000)]
    constant = np.mean([a.coefficients**2 for a in drawn], axis=0)
    slopes = np.mean([a.field_gradient**2 for a in drawn], axis=0) * lsst_r.field_radius**2 / 4.0
    degrees = np.array([2] * 3 + [3] * 4 + [4] * 5 + [5] * 6 + [6])
    total = constant + slopes.sum(axis=1)
    law = degrees ** (-11.0 / 3.0)
    # Variances of 2000 normal numbers: 3 %; 4 sigma, and 19 of them.
    np.testing.assert_allclose(total / total.sum(), law / law.sum(), rtol=0.15)
    assert slopes.sum() / total.sum() == pytest.approx(LINEAR_FRACTION, rel=0.06)
    np.testing.assert_allclose(slopes.sum(axis=0), 0.25 * total.sum(), rtol=0.1)


def test_linear_fraction_is_that_of_four_sensors_in_the_corners():
    """Least squares of a plane through four readings of equal error: variances of its mean and of its slopes."""
    corners = np.sqrt(0.5) * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    covariance = np.linalg.inv((design := np.column_stack([np.ones(4), corners])).T @ design)
    # Mean squares of x and y over the disc: a quarter.
    linear = 0.25 * (covariance[1, 1] + covariance[2, 2])
    assert linear / (linear + covariance[0, 0]) == pytest.approx(LINEAR_FRACTION)


def test_exposures_seeds_and_terms_are_independent(lsst_r):
    first = ResidualWavefront.draw(lsst_r, seed=5, epoch=2)
    again = ResidualWavefront.draw(lsst_r, seed=5, epoch=2)
    np.testing.assert_array_equal(first.coefficients, again.coefficients)
    np.testing.assert_array_equal(first.field_gradient, again.field_gradient)
    for other in (ResidualWavefront.draw(lsst_r, seed=5, epoch=3), ResidualWavefront.draw(lsst_r, seed=6, epoch=2)):
        assert np.all(other.coefficients != first.coefficients)
    fewer = ResidualWavefront.draw(lsst_r, seed=5, epoch=2, terms=(8, 4))
    assert fewer.coefficients.shape == (5,)
    np.testing.assert_array_equal(fewer.coefficients[1:4], 0.0)
    # The same normal numbers, scaled to the rms.
    ratio = first.coefficients[[0, 4]] / fewer.coefficients[[0, 4]]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-12)
    still = ResidualWavefront.draw(lsst_r, seed=5, epoch=2, linear_fraction=0.0)
    assert not still.field_gradient.any()
    np.testing.assert_allclose(still.coefficients, np.sqrt(2.0) * first.coefficients, rtol=1e-12)
    assert not ResidualWavefront.draw(lsst_r, 0.0).coefficients.any()


def test_a_star_does_not_depend_on_its_neighbours(lsst_r, pupil):
    aberration = ResidualWavefront.draw(lsst_r, seed=2)
    together = trace_pupils(lsst_r, FIELDS, WAVELENGTH, pupil, aberration=aberration)
    for star in range(3):
        alone = trace_pupils(lsst_r, FIELDS[star : star + 1], WAVELENGTH, pupil, threads=1, aberration=aberration)
        for name in ("displacement", "path"):
            np.testing.assert_array_equal(getattr(alone, name)[0], getattr(together, name)[star])


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"rms": -1e-9}, "rms = -1e-09: expected 0 to 2e-06 m"),
        ({"rms": 3 * u.um}, "rms = "),
        ({"rms": np.nan}, "rms = nan"),
        ({"rms": [1e-7, 1e-7]}, "rms = "),
        ({"rms": 0.2 * u.s}, "rms = 0.2 s: expected a unit that converts to m"),
        ({"seed": -1}, "seed = -1"),
        ({"epoch": 1.5}, "epoch = 1.5"),
        ({"terms": (2, 4)}, "terms = [2, 4]"),
        ({"terms": ()}, "terms = []"),
        ({"linear_fraction": 1.5}, "linear_fraction = 1.5"),
    ],
)
def test_bad_draws_are_named(lsst_r, options, named):
    with pytest.raises(DomainError, match=re.escape(named)):
        ResidualWavefront.draw(lsst_r, **options)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (([[1e-7]], 8.36, EPS), "coefficients of shape (1, 1)"),
        (([np.nan], 8.36, EPS), "coefficients"),
        (([1e-7], 8.36, EPS, [[1e-7, 0.0], [0.0, 0.0]]), "field_gradient of shape (2, 2)"),
        (([1e-7], 0.0, EPS), "pupil_diameter = 0.0"),
        (([1e-7], 8.36, 1.0), "pupil_obscuration = 1.0"),
    ],
)
def test_bad_coefficients_are_named(arguments, named):
    with pytest.raises(DomainError, match=re.escape(named)):
        ResidualWavefront(*arguments)


def moments(image):
    """Ellipticities (a-b)/(a+b) and centroid [pixels] under a Gaussian weight, of FWHM 5 pixels, that follows it."""
    grid = np.arange(len(image)) - len(image) // 2
    x, y = np.meshgrid(grid, grid)
    cx = cy = 0.0
    for _ in range(50):
        light = image * np.exp(-0.5 * ((x - cx) ** 2 + (y - cy) ** 2) / (5.0 / 2.3548) ** 2)
        light = light / light.sum()
        cx, cy = (light * x).sum(), (light * y).sum()
    xx, xy, yy = ((light * a * b).sum() for a, b in ((x - cx, x - cx), (x - cx, y - cy), (y - cy, y - cy)))
    scale = xx + yy + 2 * np.sqrt(xx * yy - xy * xy)
    return np.array([(xx - yy) / scale, 2 * xy / scale, cx, cy])


@pytest.mark.long
@pytest.mark.parametrize(
    ("coefficients", "signs"),
    [
        # W = (a + b cos 2t) r^2 has slopes 2 (a + b) x and 2 (a - b) y: longer along x where a and b have one sign.
        ([0.3e-6, 0.3e-6, 0.0], [0, 1, 0, 0]),
        pytest.param([0.3e-6, 0.0, -0.3e-6], [-1, 0, 0, 0], marks=pytest.mark.slow),
        pytest.param([-0.3e-6, 0.0, -0.3e-6], [1, 0, 0, 0], marks=pytest.mark.slow),
        # The mean slope of a positive coma is positive, and light lands at minus the focal length times the slope.
        ([0.0, 0.0, 0.0, 0.3e-6, -0.5e-6], [None, None, 1, -1]),
    ],
)
def test_engines_agree_with_an_aberration(lsst_r, coefficients, signs):
    """Geometric spots against diffraction, on the axis and at 1 deg: 0.1 arcsec pixels."""
    aberration = ResidualWavefront(coefficients, 8.36, EPS)
    options = {"stamps": pachon.Stamps(29, pixel_size=5e-6), "threads": 2, "aberration": aberration}
    fast, wave = (
        np.array(
            [
                moments(image.astype(float))
                for image in make_psfs(lsst_r, [[0.0, 0.0], [0.01, -0.015]], WAVELENGTH, engine=e, **options).image
            ]
        )
        for e in ("fast", "wave")
    )
    # A filter is not diffraction at an aberrated pupil: half a hundredth in ellipticity and 2 mas.
    np.testing.assert_allclose(fast[:, :2], wave[:, :2], atol=6e-3)
    np.testing.assert_allclose(fast[:, 2:], wave[:, 2:], atol=0.025)
    for value, sign in zip(wave[0], signs, strict=True):
        # Ellipticity of a tenth, or half a pixel.
        assert sign is None or (abs(value) < 1e-6 if sign == 0 else sign * value > 0.1)
