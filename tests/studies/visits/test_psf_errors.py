"""Shears that errors of the PSF leave, to first order, against closed forms and measured galaxies."""

import numpy as np
import pytest

from pachon.core.units import ARCMIN, ARCSEC
from pachon.imaging.exposure import Exposure
from pachon.sky.galaxies import Galaxies
from pachon.studies.visits.galaxy_shapes import measure_galaxies
from pachon.studies.visits.null_result import galaxy_shears
from pachon.studies.visits.psf_errors import PsfAtGalaxies, PsfErrorResponse
from pachon.studies.visits.stack import PsfStack

AXES = np.array([[np.cos(0.3), np.sin(0.3)], [np.sin(0.3), -np.cos(0.3)]]) / (0.2 * ARCSEC)


def stack_of(true, model, places=9):
    """Stack of one true PSF and one model everywhere."""
    x, y = (ARCMIN * v.ravel() for v in np.meshgrid(*2 * [np.linspace(-3.0, 3.0, places)]))
    zero = np.zeros(len(x))
    images = (np.repeat(image[None], len(x), axis=0).astype(np.float32) for image in (true, model))
    sky = np.stack([x, y], axis=1) @ np.linalg.inv(AXES * 0.2 * ARCSEC).T
    return PsfStack(1, *sky.T, x, y, zero > 0, zero.astype(int) + 1, *images, *6 * [zero])


def gaussian(xx, yy, xy=0.0):
    y, x = np.mgrid[-15:16, -15:16]
    image = np.exp(-0.5 * (yy * x**2 - 2 * xy * x * y + xx * y**2) / (xx * yy - xy**2))
    return image / image.sum()


def ring_galaxies(count, radius, sersic, ellipticity=0.2, spread=0.0):
    """Galaxies at four orientations each."""
    rng = np.random.default_rng(2)
    e, places = ellipticity * rng.uniform(-1, 1, (2, count)), rng.uniform(-1.0, 1.0, (2, count)) * ARCMIN
    radii = radius * np.exp(spread * rng.normal(size=count)) * ARCSEC
    columns = {"magnitude": np.full(count, 21.0), "radius": radii, "sersic": np.full(count, sersic)}
    galaxies = Galaxies.single(xi=places[0], eta=places[1], e1=e[0], e2=e[1], **columns)
    return Galaxies.concatenate([galaxies.rotated(np.pi * k / 4) for k in range(4)])


def test_an_error_of_the_covariance_of_round_gaussians_has_the_closed_form():
    """The covariance before the PSF is off by that of the PSF, as if sheared by half the difference over its own."""
    many = ring_galaxies(5, 0.6, 0.5, ellipticity=0.0)
    # Bright: the S/N is far above the limit.
    true, model, noiseless = gaussian(2.56 + 0.02, 2.56 - 0.02, 0.01), gaussian(2.56, 2.56), Exposure(noise=False)
    stack = stack_of(true, model)
    response = PsfErrorResponse.of(stack, many, AXES, noiseless, 1, "closed form")
    variance = (0.6 / 0.2) ** 2 / (2.0 * np.log(2.0))
    # C = 4 standard errors of M0 beside M0 changes e and response alike.
    expected = (0.02 + 0.01j) / (2.0 * variance)
    assert response.shears(stack.true[:1], stack.model[:1])[0] == pytest.approx(expected, rel=0.01)
    assert abs(response.shears(stack.true[:1], stack.true[:1])[0]) < 1e-12


@pytest.mark.long
def test_it_is_what_measured_galaxies_have_and_no_multiple_of_the_error_of_g():
    many, exposure = ring_galaxies(25, 0.5, 1.5, spread=0.3), Exposure(exposures=100)
    y, x = np.mgrid[-15:16, -15:16]
    base = gaussian(2.56, 2.56)
    ratios = []
    # A shear of the core, and one of the wings.
    for scale, exponent in ((0.02, 0), (0.002, 2)):
        bump = scale * (x**2 - y**2) * np.hypot(x, y) ** exponent * base
        stack = stack_of((base + bump) / (base + bump).sum(), base)
        response = PsfErrorResponse.of(stack, many, AXES, exposure, 1, "errors")
        measured = measure_galaxies(stack, AXES, many, exposure, 1, "noise", reach=ARCMIN)
        shift = galaxy_shears(measured.shear) - galaxy_shears(measured.true_shear)
        shift = shift[np.isfinite(shift)]
        psfs = PsfAtGalaxies.of(stack, measured, response)
        assert psfs.expected_shear.std() < 1e-12
        expected = psfs.expected_shear[0]
        error = np.abs(shift - shift.mean()).std() / np.sqrt(len(shift))
        assert abs(shift.mean() - expected) < 0.03 * abs(expected) + 3.0 * error
        assert error < 0.1 * abs(expected)
        ratios.append(expected.real / (psfs.true - psfs.model)[0].real)
    assert abs(ratios[1] / ratios[0] - 1.0) > 0.1
