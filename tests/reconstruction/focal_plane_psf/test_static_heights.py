import shutil
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from threadpoolctl import threadpool_limits

from pachon.core.errors import DomainError, ProductError
from pachon.core.progress import Reporter
from pachon.core.units import ARCSEC
from pachon.models.camera.focal_plane import FocalPlane
from pachon.reconstruction.focal_plane_psf import static_heights
from pachon.reconstruction.focal_plane_psf.fit import ExposureFit, ShapeData
from pachon.reconstruction.focal_plane_psf.heights import HeightPrior, powers
from pachon.reconstruction.focal_plane_psf.mosaic import Mosaic
from pachon.reconstruction.focal_plane_psf.optics_prior import OpticsPrior
from pachon.reconstruction.focal_plane_psf.response import Instrument
from pachon.reconstruction.focal_plane_psf.stars import places_of
from pachon.reconstruction.focal_plane_psf.static_heights import StaticHeights, fit_static_heights

STEPS = 2


@pytest.fixture(scope="module")
def two_of(exposure_of, part):
    """Two exposures of one focal plane, the stars at the same places; turbulence and noise are their own."""

    def of(ccds, stars):
        plane = FocalPlane.from_budget(part("R23", count=ccds), seed=5)
        return [exposure_of(plane, stars=stars, holdout=0, noise=5e-4, turbulence=0.001, seed=s) for s in (1, 2)]

    return of


@pytest.fixture(scope="module")
def fit_to(lsst_r, wavelengths):
    """``fit_to(exposures)([0, 1], folder=...)``"""
    instrument = Instrument.of(lsst_r, wavelengths)

    def of(exposures):
        def fit(which, telescope=instrument, **options):
            stars, aligned = [exposures[i].stars() for i in which], OpticsPrior(alignment_rms=0.0)
            return fit_static_heights(
                stars, telescope, **{"camera": exposures[0].camera, "prior": aligned, "steps": STEPS} | options
            )

        return fit

    return of


@pytest.fixture(scope="module")
def exposures(two_of):
    """Few stars: of tests of files and bytes."""
    return two_of(2, 10)


@pytest.fixture(scope="module")
def fit(exposures, fit_to):
    return fit_to(exposures)


@pytest.fixture(scope="module")
def both(fit, tmp_path_factory):
    """The heights of both exposures, and the folder that they were kept in."""
    folder = tmp_path_factory.mktemp("static") / "kept"
    return fit([0, 1], folder=folder), folder


def error(heights, truth):
    """Rms error over the CCDs [m], without the mean height, which is the focus of the exposures."""
    camera = truth.camera
    grid = np.linspace(-0.9, 0.9, 9) * (0.5 * camera.shortest_side)
    dx, dy = (a.ravel() for a in np.meshgrid(grid, grid))
    x, y = camera.centers[:, :1] + dx, camera.centers[:, 1:] + dy
    left = heights.focal_plane.height(x, y) - truth.height(x, y)
    return np.sqrt(np.mean((left - left.mean()) ** 2))


@pytest.mark.slow
def test_two_exposures_tell_the_heights_better_than_one(two_of, fit_to):
    exposures = two_of(4, 20)
    truth, fit = exposures[0].plane, fit_to(exposures)
    one, both = [fit([i]) for i in range(2)], [fit([0, 1])]
    assert error(both[0], truth) < np.mean([error(o, truth) for o in one])
    assert error(both[0], truth) < error(StaticHeights(FocalPlane.flat(truth.camera), both[0].covariance, 0), truth)
    # More data make every CCD better known; by less than sqrt(2), since there is a prior.
    assert both[0].exposures == 2
    assert (both[0].sigma < one[0].sigma).all()
    assert (both[0].sigma > one[0].sigma / 2.0).all()


@pytest.mark.slow
def test_covariances_are_those_of_the_legendre_terms(both, exposures):
    covariance = both[0].covariance
    assert covariance.shape == (2, len(powers(6)), len(powers(6)))
    for each in covariance:
        np.testing.assert_allclose(each, each.T, atol=1e-12 * np.abs(each).max())
        assert np.linalg.eigvalsh(each)[0] > 0.0
    # The sum of the variances of terms of unit rms is the mean square over the CCD.
    np.testing.assert_allclose(both[0].sigma ** 2, np.trace(covariance, axis1=1, axis2=2), rtol=1e-12)


@pytest.mark.long
def test_a_fit_that_was_stopped_goes_on(both, fit, monkeypatch):
    first, folder = both
    assert len(list(folder.iterdir())) == 2 * STEPS

    def never(self):
        raise AssertionError("computed again")

    monkeypatch.setattr(ExposureFit, "linearise", never)
    again = fit([0, 1], folder=folder)
    assert again.covariance.tobytes() == first.covariance.tobytes()
    np.testing.assert_array_equal(again.focal_plane.grid, first.focal_plane.grid)


@pytest.mark.long
def test_a_fit_goes_on_with_another_number_of_threads_of_blas(both, fit, monkeypatch):
    def never(self):
        raise AssertionError("computed again")

    monkeypatch.setattr(ExposureFit, "linearise", never)
    with threadpool_limits(2, user_api="blas"):
        fit([0, 1], folder=both[1])


@pytest.mark.long
def test_what_belongs_to_other_stars_or_is_damaged_is_computed_again(both, fit, exposures, monkeypatch, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(both[1], folder)

    def never(self):
        raise InterruptedError

    monkeypatch.setattr(ExposureFit, "linearise", never)
    with pytest.raises(InterruptedError):
        fit([1, 0], folder=folder)
    camera = exposures[0].camera
    with pytest.raises(InterruptedError):
        fit([0, 1], folder=folder, camera=replace(camera, placement=np.full((len(camera), 3), 1e-6)))
    (folder / "exposure_00000_step_0.npz").write_bytes(b"PK")
    with pytest.raises(InterruptedError):
        fit([0, 1], folder=folder)


@pytest.mark.long
def test_files_of_another_telescope_are_computed_again(both, fit, exposures, monkeypatch, lsst_r, wavelengths):
    def never(self):
        raise InterruptedError

    monkeypatch.setattr(ExposureFit, "linearise", never)
    moved = Instrument.of(lsst_r.perturbed("M2", shift=(1e-3, 0.0, 0.0)), wavelengths)
    with pytest.raises(InterruptedError):
        fit([0, 1], folder=both[1], telescope=moved)


@pytest.mark.long
def test_files_of_another_version_are_computed_again(both, fit, monkeypatch):
    def never(self):
        raise InterruptedError

    monkeypatch.setattr(ExposureFit, "linearise", never)
    monkeypatch.setattr(static_heights, "VERSION", "0.9")
    with pytest.raises(InterruptedError):
        fit([0, 1], folder=both[1])


@pytest.mark.long
def test_a_written_file_is_the_same(both, tmp_path, exposures):
    path = tmp_path / "heights.fits"
    both[0].write(path)
    read = StaticHeights.read(path, exposures[0].camera)
    x, y = exposures[0].xy.T
    np.testing.assert_array_equal(read.focal_plane.height(x, y), both[0].focal_plane.height(x, y))
    np.testing.assert_array_equal(read.covariance, both[0].covariance)
    assert read.exposures == 2
    prior = read.prior()
    assert prior.mean is read.focal_plane
    assert prior.degree == 6


def test_shapes_are_those_under_the_weight_of_the_stars(exposures, lsst_r, wavelengths, monkeypatch):
    """Under another one they were compared with those under 0.7 arcsec, and heights were wrong in proportion."""
    used = []

    def stop(self, data, instrument, *arguments):
        used.append(instrument.weight_fwhm)
        raise InterruptedError

    monkeypatch.setattr(ExposureFit, "__init__", stop)
    camera, stars = exposures[0].camera, [exposures[0].stars(weight_fwhm=0.5 * ARCSEC)]
    with pytest.raises(InterruptedError):
        fit_static_heights(stars, lsst_r, camera=camera)
    assert used == [0.5 * ARCSEC]
    stated = Instrument.of(lsst_r, wavelengths, weight_fwhm=0.6 * ARCSEC)
    with pytest.raises(
        DomainError, match=r"^exposures\[0\]: weight_fwhm of its stars is 0\.5 arcsec: expected .* 0\.6"
    ):
        fit_static_heights(stars, stated, camera=camera)
    # Stars of a table, which does not say its weight.
    with pytest.raises(InterruptedError):
        fit_static_heights([exposures[0].stars()], stated, camera=camera)
    assert used[1:] == [0.6 * ARCSEC]


def test_bad_input_gives_one_clear_line(lsst_r, tmp_path):
    with pytest.raises(DomainError, match=r"^exposures: [^\n]*$"):
        fit_static_heights([], lsst_r)
    (tmp_path / "bad.fits").write_bytes(b"SIMPLE  =")
    for name in ("bad.fits", "none.fits"):
        with pytest.raises(ProductError) as raised:
            StaticHeights.read(tmp_path / name)
        assert "\n" not in str(raised.value)


def test_an_exposure_without_stars_is_named(exposures, lsst_r, wavelengths):
    nothing = exposures[1].stars(values=np.full((20, 3), np.nan))
    camera = exposures[0].camera
    with pytest.raises(DomainError, match=r"^exposures\[0\]: 0 of 20 stars have position, shape and noise"):
        fit_static_heights([nothing, exposures[0].stars()], Instrument.of(lsst_r, wavelengths), camera=camera)


def test_turbulence_keeps_what_heights_may_still_be_off_by(exposures, lsst_r, wavelengths):
    """Heights that had taken up a part of turbulence left too little of it: claimed variances of heights of 40 stars
    on a CCD were a third of the squared errors.
    """
    stars, camera = exposures[0].stars(), exposures[0].camera
    prior = HeightPrior.from_budget(camera, degree=6)
    data = ShapeData(places_of(Mosaic.of_camera(camera), stars), stars.values, stars.noise**2)
    fit = ExposureFit(data, Instrument.of(lsst_r, wavelengths), prior, 0.0, 1, Reporter(quiet=True))
    fit.linearise()
    variances = []
    for covariance in (None, 0.25 * prior.ccd):
        fit.covariances, fit.ccd_covariance = [], covariance
        fit.fit_covariances(8)
        variances.append([c.variance + c.nugget for c in fit.covariances])
    assert (np.array(variances[1]) > np.array(variances[0])).all()
    # The same as of a covariance of all parameters.
    ccds = scipy.linalg.block_diag(np.zeros((prior.n_common,) * 2), *(0.25 * prior.ccd), np.zeros((25, 25)))
    fit.covariances, fit.covariance = [], ccds
    fit.fit_covariances(8)
    np.testing.assert_allclose([c.variance + c.nugget for c in fit.covariances], variances[1], rtol=1e-6)


def test_galaxies_say_nothing_of_heights(two_of, lsst_r, wavelengths, monkeypatch):
    """One star in a hundred, 30 % larger than stars are, made heights of nine CCDs wrong by 1.4 um for 1.1 um."""
    exposure = two_of(2, 20)[0]
    stars, seen = exposure.stars(), []
    values = stars.values.copy()
    values[[3, 30]] += np.array([0.1, -0.05, 0.3])

    def stop(self, data, *arguments):
        seen.append(data.values)
        raise InterruptedError

    monkeypatch.setattr(ExposureFit, "__init__", stop)
    with pytest.raises(InterruptedError):
        fit_static_heights(
            [replace(stars, values=values)], Instrument.of(lsst_r, wavelengths), camera=exposure.camera, threads=1
        )
    np.testing.assert_array_equal(seen[0], np.delete(values, [3, 30], axis=0))
