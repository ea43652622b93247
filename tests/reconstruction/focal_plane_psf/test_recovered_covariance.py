"""Covariance and heights fitted to turbulence alone, to optics alone and to their sum, against the input values."""

import numpy as np
import pytest

from pachon.models.camera.focal_plane import FocalPlane
from pachon.reconstruction.focal_plane_psf.covariance import Places
from pachon.reconstruction.focal_plane_psf.heights import HeightPrior, project_heights
from pachon.reconstruction.focal_plane_psf.likelihood import fit_covariance
from pachon.reconstruction.focal_plane_psf.model import FocalPlanePsf
from pachon.reconstruction.focal_plane_psf.optics_prior import OpticsPrior
from pachon.reconstruction.focal_plane_psf.response import Instrument

UM = 1e-6
ARCMIN = 3e-3  # on the detector [m]
#: Bins of separation of the structure functions [m].
EDGES = np.array([1.0, 4.0, 8.0, 16.0, 24.0]) * ARCMIN


def structure(xy, values, covariance, edges):
    """Mean square differences of pairs in bins of separation: of the covariance, over those of the values."""
    i, k = np.triu_indices(len(xy), 1)
    difference = xy[i] - xy[k]
    bins = np.digitize(np.hypot(*difference.T), edges) - 1
    own = (values[i] - values[k]) ** 2
    model = np.full(len(i), 2.0 * covariance.nugget)
    for amplitude, matrix in zip(covariance.amplitude, covariance.matrix, strict=True):
        model += 2.0 * amplitude * (1.0 - np.exp(-np.linalg.norm(difference @ matrix.T, axis=1)))
    return np.array([model[bins == b].mean() / own[bins == b].mean() for b in range(len(edges) - 1)])


@pytest.mark.slow
def test_the_covariance_of_turbulence_alone_is_the_fields_own():
    # Two layers, 6 by 2 and 40 by 8 arcmin, over 84 by 84; noise of half the power of one of them. What is fitted is
    # compared with each field as it was drawn, without noise.
    ratios = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        xy = rng.uniform(0.0, 84.0 * ARCMIN, (600, 2))
        difference = (xy[:, None] - xy) / ARCMIN
        total = 1e-14 * np.eye(600)
        for along, across, angle in ((6.0, 2.0, 0.4), (40.0, 8.0, 2.0)):
            turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            total += 4e-6 * np.exp(-np.linalg.norm(difference @ (turn / np.array([[along], [across]])).T, axis=2))
        field = np.linalg.cholesky(total) @ rng.standard_normal(600)
        noise = np.full(600, 2e-6)
        here = Places(xy, np.zeros(600, dtype=int), np.zeros((600, 2)))
        found = fit_covariance(here, field + np.sqrt(noise) * rng.standard_normal(600), noise).covariance
        ratios.append(structure(xy, field, found, EDGES))
    # One field of few streaks scatters by 7 % about the covariance that makes it most likely, the mean of six by 3 %.
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1.0, atol=0.10)


@pytest.fixture(scope="module")
def camera(part):
    return part("R23", count=4)


def fitted(exposure, telescope, wavelengths):
    return FocalPlanePsf.fit(
        exposure.stars(),
        Instrument.of(telescope, wavelengths),
        camera=exposure.camera,
        prior=OpticsPrior(alignment_rms=0.0),
    )


@pytest.mark.slow
def test_of_optics_alone_heights_are_found_and_little_turbulence(exposure_of, camera, lsst_r, wavelengths):
    plane = FocalPlane.from_budget(camera, seed=5).with_moved("R23_S01", dz=5 * UM)
    exposure = exposure_of(plane, stars=40, holdout=10, noise=2e-4, turbulence=1e-9, seed=3)
    model = fitted(exposure, lsst_r, wavelengths)
    x, y = exposure.xy.T
    left, true = model.heights.height(x, y) - plane.height(x, y), plane.height(x, y)
    # Degree 4 leaves 0.6 um of potato chips of up to two cycles (heights.py: degree 6 leaves 0.3 um).
    assert (left - left.mean()).std() < 0.8 * UM
    assert true.std() > 4.0 * UM
    # They make what turbulence is taken for: less than a sixth of what the optics make of the shapes.
    scatter = exposure.truth.std(axis=0)
    assert (np.sqrt([c.variance for c in model.covariances]) < scatter / 6.0).all()


@pytest.mark.slow
def test_of_a_sum_the_covariance_is_that_of_the_turbulence(exposure_of, part, lsst_r, wavelengths):
    # Three rafts, heights unknown. Heights of a higher degree than the model's are a part of what it takes for
    # turbulence: without them in the reference the size would be 10 % high.
    camera = part("R22", "R23", "R33")
    prior = HeightPrior.from_budget(camera)
    ratios = []
    for seed in range(3):
        plane = FocalPlane.from_budget(camera, seed=5 + seed)
        exposure = exposure_of(plane, holdout=2, noise=1e-3, turbulence=4e-3, seed=seed, at=1 + seed)
        parameters = np.zeros(prior.n_parameter)
        parameters[prior.n_common :] = project_heights(plane, prior.degree).ravel()
        xy = exposure.xy[exposure.first]
        instrument = Instrument.of(lsst_r, wavelengths)
        optics = instrument.shapes(instrument.fields(xy), prior.focal_plane(parameters), None)
        field = exposure.truth[exposure.first] - optics
        model = fitted(exposure, lsst_r, wavelengths)
        ratios += [structure(xy, field[:, i], model.covariances[i], EDGES) for i in range(3)]
    # One field of few streaks scatters by 10 to 15 % about the covariance that makes it most likely.
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1.0, atol=0.10)
