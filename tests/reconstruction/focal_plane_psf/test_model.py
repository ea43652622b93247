"""The model against synthetic exposures: holdout positions, heights, uncertainties, files, bad input."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy import units as u
from threadpoolctl import threadpool_limits

from pachon.core.errors import ConfigError, DomainError, PachonError, ProductError, UnknownNameError
from pachon.core.progress import Reporter
from pachon.measure.shapes import measure_shapes
from pachon.models.camera.focal_plane import FocalPlane
from pachon.models.camera.silicon import Silicon
from pachon.reconstruction.focal_plane_psf.model import FocalPlanePsf, _fit_warnings
from pachon.reconstruction.focal_plane_psf.mosaic import Mosaic
from pachon.reconstruction.focal_plane_psf.optics_prior import OpticsPrior
from pachon.reconstruction.focal_plane_psf.response import Instrument
from pachon.wavefront.atmosphere.atmosphere import Atmosphere

UM = 1e-6
PLANTED = "R23_S11"
#: An aligned telescope and simulated heights.
ALIGNED = OpticsPrior(alignment_rms=0.0)


@pytest.fixture(scope="module")
def exposure(exposure_of, part):
    """Nine CCDs of 40 stars, one of them 8 um too high, and 15 holdout positions each."""
    return exposure_of(FocalPlane.from_budget(part("R23"), seed=5).with_moved(PLANTED, dz=8 * UM))


@pytest.fixture(scope="module")
def few(exposure):
    """Fifteen of the stars of each CCD."""
    return exposure.first & (np.arange(len(exposure.ccd)) % 55 < 15)


@pytest.fixture(scope="module")
def model(exposure, lsst_r, wavelengths):
    return FocalPlanePsf.fit(exposure.stars(), Instrument.of(lsst_r, wavelengths), camera=exposure.camera)


@pytest.fixture(scope="module")
def aligned(exposure, few, lsst_r, wavelengths):
    """Fewer stars and a telescope that is known to be aligned, on one thread."""
    return FocalPlanePsf.fit(
        exposure.stars(few), Instrument.of(lsst_r, wavelengths), camera=exposure.camera, prior=ALIGNED, threads=1
    )


@pytest.fixture(scope="module")
def blind(exposure):
    """The fit without a telescope."""
    return FocalPlanePsf.fit(exposure.stars(), camera=exposure.camera)


def values(shapes):
    return np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=1)


def at_holdout(model, exposure):
    """Prediction minus truth, and its predicted standard deviation, in e1, e2 and ln size."""
    h = ~exposure.first
    where = (list(exposure.names[h]), *exposure.xy[h].T)
    found = model.shapes(*where)
    sigma = model.uncertainty(*where)
    spread = np.stack([sigma.e1, sigma.e2, sigma.size / found.size], axis=1)
    return values(found) - exposure.truth[h], spread


def rms(array):
    return np.sqrt((array**2).mean(axis=0))


def best_possible(exposure):
    """Errors at the holdout positions of the best linear prediction where heights and covariance are known."""
    s, h = exposure.first, ~exposure.first
    total = exposure.covariance[np.ix_(s, s)] + np.diag(exposure.noise[s, 0] ** 2)
    weights = np.linalg.solve(total, exposure.covariance[np.ix_(s, h)])
    return weights.T @ (exposure.values - exposure.optics)[s] - (exposure.truth - exposure.optics)[h]


@pytest.mark.slow
@pytest.mark.parametrize("which", ["model", "blind"])
def test_holdout_positions_are_predicted(which, exposure, request):
    left, _ = at_holdout(request.getfixturevalue(which), exposure)
    uncorrected = (exposure.truth - exposure.flat)[~exposure.first]
    # Half of the scatter would be a quarter of the power. What limits it is the 6.6 mm between stars, of noise 1e-3, in
    # streaks 15 mm wide: the best linear prediction, which knows everything, leaves not much less.
    assert (rms(left) < 0.5 * rms(uncorrected)).all()
    # 25 parameters of the exposure and 15 of each CCD, of 40 stars, take their share: 30 %.
    assert (rms(left) < 1.3 * rms(best_possible(exposure))).all()


# Chi-square of 135 holdout positions, correlated within streaks: about 50 independent ones, sqrt(2 / 50) = 20 %, and
# the covariance itself is fitted. Two sigma on either side.
@pytest.mark.long
@pytest.mark.parametrize("which", [pytest.param("model", marks=pytest.mark.slow), "blind"])
@pytest.mark.parametrize("shape", range(3))
def test_predicted_uncertainties_are_those_of_the_holdout_positions(which, shape, exposure, request):
    left, sigma = at_holdout(request.getfixturevalue(which), exposure)
    assert (sigma > 0.0).all()
    assert 0.6 < np.mean((left[:, shape] / sigma[:, shape]) ** 2) < 1.6


@pytest.mark.long
@pytest.mark.parametrize("which", [pytest.param("model", marks=pytest.mark.slow), "blind"])
def test_the_fit_agrees_with_its_stars(which, exposure, request):
    fit = request.getfixturevalue(which)
    assert fit.used.all()
    assert len(fit.used) == exposure.first.sum()
    assert fit.field.data.values.shape == (360, 3)
    # 360 stars: 1 / sqrt(180) = 7 % and the fitted hyperparameters: 3 sigma are 20 %.
    assert all(0.8 < v < 1.2 for v in fit.chi2.values())
    # Predictions from the other stars differ from the star by its noise and by more; those with it by less.
    left = values(fit.leave_one_out) - exposure.values[exposure.first]
    assert (rms(left) > 1e-3).all()
    assert not any("noise" in w for w in fit.warnings)
    assert (fit.heights is None) == np.isnan(fit.evidence) == (which == "blind")


@pytest.mark.long
def test_a_planted_height_is_found(aligned, exposure):
    own = exposure.camera.ccd_index(PLANTED)
    others = np.arange(9) != own
    grid = np.linspace(-0.9, 0.9, 7) * (0.5 * exposure.camera.shortest_side)
    dx, dy = (a.ravel() for a in np.meshgrid(grid, grid))

    def above(plane):
        mean = np.array([plane.height(x + dx, y + dy).mean() for x, y in exposure.camera.centers])
        return mean[own] - mean[others].mean()

    # The mean height is the focus of the exposure, so the height above the others. Of 40 stars and of turbulence of
    # 0.4 % on a CCD of 3 x 1 streaks; 3 um is a third of what was planted.
    truth = above(exposure.plane)
    assert truth > 4 * UM
    assert above(aligned.heights) == pytest.approx(truth, abs=3 * UM)


@pytest.mark.slow
def test_known_heights_are_kept(exposure, few, lsst_r, wavelengths):
    model = FocalPlanePsf.fit(exposure.stars(few), Instrument.of(lsst_r, wavelengths), exposure.plane, prior=ALIGNED)
    x, y = exposure.xy.T
    # Coefficients are held to a nanometre, and a spline stands for the waves of the potato chips.
    np.testing.assert_allclose(model.heights.height(x, y), exposure.plane.height(x, y), atol=20e-9)


@pytest.mark.slow
def test_the_wrong_telescope_has_less_evidence(aligned, exposure, few, lsst_r, wavelengths):
    wrong = FocalPlanePsf.fit(
        exposure.stars(few),
        Instrument.of(lsst_r.perturbed("M2", shift=(2e-3, 0.0, 0.0)), wavelengths),
        camera=exposure.camera,
        prior=ALIGNED,
    )
    # A ratio of likelihoods of e^20 is beyond chance.
    assert wrong.evidence < aligned.evidence - 20.0
    assert wrong.evidence < 0.0 < aligned.evidence
    assert any("less likely with this telescope" in w for w in wrong.warnings)
    assert not any("less likely" in w for w in aligned.warnings)


@pytest.mark.parametrize(("count", "few"), [(9, True), (189, False)])
def test_few_ccds_are_no_proof_against_a_telescope(count, few):
    """Of nine CCDs simulated with this very telescope stars are less likely with it in four of five exposures."""
    places = SimpleNamespace(ccd=np.repeat(np.arange(count), 2))
    data = SimpleNamespace(places=places, noise=np.ones((2 * count, 3)))
    field = SimpleNamespace(covariances=[SimpleNamespace(nugget=0.0)] * 3, data=data, mosaic=SimpleNamespace(names=()))
    (remark,) = _fit_warnings(field, {}, SimpleNamespace(at_bounds=(), evidence=-8.0), ())
    assert "less likely with this telescope than without any (ln ratio -8): " in remark
    assert ("9 CCDs may be too few" in remark) == few


@pytest.mark.long
def test_a_telescope_whose_images_have_no_shape_gives_one_clear_line(exposure, few, lsst_r, wavelengths):
    with pytest.raises(PachonError) as raised:
        FocalPlanePsf.fit(
            exposure.stars(few),
            Instrument.of(lsst_r.perturbed("M2", shift=(5e-3, 0.0, 0.0)), wavelengths),
            camera=exposure.camera,
            prior=ALIGNED,
        )
    assert "\n" not in str(raised.value)


ELSEWHERE = (["R23_S00", "R23_S11", "R23_S11", "R23_S22"], [0.09, 0.12, 0.13, 0.16], [-0.04, 0.0, 0.01, 0.05])


@pytest.mark.slow
def test_no_byte_depends_on_the_threads(aligned, exposure, few, lsst_r, wavelengths):
    two = FocalPlanePsf.fit(
        exposure.stars(few), Instrument.of(lsst_r, wavelengths), camera=exposure.camera, prior=ALIGNED, threads=2
    )
    assert two.evidence == aligned.evidence
    assert two.chi2 == aligned.chi2
    assert two.draw(*ELSEWHERE, threads=2).tobytes() == aligned.draw(*ELSEWHERE, threads=1).tobytes()
    for way in ("shapes", "uncertainty"):
        one, other = (getattr(m, way)(*ELSEWHERE, threads=t) for m, t in ((aligned, 1), (two, 2)))
        assert values(one).tobytes() == values(other).tobytes()


@pytest.fixture(scope="module")
def of_two_threads_of_blas(exposure, few, lsst_r, wavelengths):
    """As `aligned`, which has one of them."""
    with threadpool_limits(2, user_api="blas"):
        return FocalPlanePsf.fit(
            exposure.stars(few), Instrument.of(lsst_r, wavelengths), camera=exposure.camera, prior=ALIGNED, threads=1
        )


@pytest.mark.slow
def test_no_prediction_depends_on_the_threads_of_blas(of_two_threads_of_blas, aligned):
    two = of_two_threads_of_blas
    assert two.chi2 == aligned.chi2
    assert values(two.leave_one_out).tobytes() == values(aligned.leave_one_out).tobytes()
    assert values(two.shapes(*ELSEWHERE)).tobytes() == values(aligned.shapes(*ELSEWHERE)).tobytes()


@pytest.mark.long
def test_no_evidence_depends_on_the_threads_of_blas(of_two_threads_of_blas, aligned):
    assert of_two_threads_of_blas.evidence == aligned.evidence


@pytest.fixture(scope="module")
def layered(exposure, few, lsst_r, wavelengths):
    """Turbulence by the theory of two layers, whose winds are about known."""
    whole = Atmosphere.from_site("cerro_pachon", 0)
    two = {key: getattr(whole, key)[:2] for key in ("altitudes", "weights", "velocities", "offsets")}
    instrument = Instrument.of(lsst_r, wavelengths, replace(whole, **two))
    stars = exposure.stars(few)
    return FocalPlanePsf.fit(stars, instrument, exposure.plane, prior=ALIGNED, turbulence="forecast", threads=1)


@pytest.mark.long
def test_layers_predict_about_as_well_as_exponentials(layered, exposure, few, lsst_r, wavelengths):
    # The field is drawn of exponentials: the theory is not better here, but it predicts, with an uncertainty.
    instrument = Instrument.of(lsst_r, wavelengths)
    by_exponentials = FocalPlanePsf.fit(exposure.stars(few), instrument, exposure.plane, prior=ALIGNED, threads=1)
    errors = [rms(at_holdout(m, exposure)[0]).mean() for m in (layered, by_exponentials)]
    assert errors[0] < 1.15 * errors[1]
    (covariance,) = layered.covariances
    assert np.shape(covariance.air.velocities) == (2, 2)
    assert np.isfinite(values(layered.leave_one_out)[layered.used]).all()


def test_layers_need_a_telescope(exposure):
    with pytest.raises(DomainError, match=r"^turbulence = 'layers': expected a telescope[^\n]*$"):
        FocalPlanePsf.fit(exposure.stars(), camera=exposure.camera, turbulence="layers")


@pytest.mark.long
def test_ccds_of_many_stars_are_predicted_in_parts(blind, exposure, monkeypatch):
    # Of fifteen neighbours those about each quarter of a CCD, not its middle.
    monkeypatch.setattr("pachon.reconstruction.focal_plane_psf.field.NEIGHBOURS", 15)
    residuals, variance = blind.field.leave_one_out_residuals()
    assert np.isfinite(residuals).all()
    assert (variance > 0.0).all()
    own = exposure.camera.ccd_index(PLANTED)
    corner = exposure.camera.centers[own] + 0.8 * 0.5 * exposure.camera.shortest_side
    found = blind.field.predict(blind.field.mosaic.places(PLANTED, *corner))[0]
    monkeypatch.undo()
    by_all = blind.field.predict(blind.field.mosaic.places(PLANTED, *corner))[0]
    assert found == pytest.approx(by_all, abs=3e-3)
    middle = blind.field.mosaic.places(PLANTED, *exposure.camera.centers[own])
    cells = blind.field._cells(middle)
    np.testing.assert_array_equal(cells[0][0], exposure.camera.centers[own])


@pytest.mark.long
@pytest.mark.parametrize("which", ["aligned", "blind", "layered"])
def test_a_written_model_is_the_same(which, tmp_path, request):
    model = request.getfixturevalue(which)
    path = tmp_path / "model.fits"
    model.write(path)
    read = FocalPlanePsf.read(path)
    for way in ("shapes", "uncertainty"):
        one, other = (values(getattr(m, way)(*ELSEWHERE)) for m in (model, read))
        assert one.tobytes() == other.tobytes()
    if which == "aligned":
        assert read.draw(*ELSEWHERE).tobytes() == model.draw(*ELSEWHERE).tobytes()
        np.testing.assert_array_equal(read.heights.height(0.12, 0.01), model.heights.height(0.12, 0.01))
    np.testing.assert_array_equal(read.used, model.used)
    assert values(read.leave_one_out).tobytes() == values(model.leave_one_out).tobytes()
    assert (read.chi2, read.warnings, read.weight_fwhm) == (model.chi2, model.warnings, model.weight_fwhm)
    assert read.evidence == pytest.approx(model.evidence, nan_ok=True, abs=0.0)
    read.write(tmp_path / "again.fits")
    assert (tmp_path / "again.fits").read_bytes() == path.read_bytes()


@pytest.mark.long
def test_a_written_model_has_the_axes_of_its_pixels(tmp_path, blind, exposure):
    """Of a camera of equal squares they were lost, and x and y of pixels changed places."""
    mosaic = Mosaic.of_camera(replace(exposure.camera, transposed=True))
    model = replace(blind, field=replace(blind.field, mosaic=mosaic))
    model.write(tmp_path / "model.fits")
    read = FocalPlanePsf.read(tmp_path / "model.fits")
    pixels = ("R23_S11", [100.0, 3000.0] * u.pix, [2000.0, 500.0] * u.pix)
    np.testing.assert_array_equal(read.mosaic.places(*pixels).xy, mosaic.places(*pixels).xy)


@pytest.mark.long
def test_a_written_model_has_its_silicon(tmp_path, aligned):
    optics = aligned.field.optics
    stamps = replace(optics.instrument.stamps, silicon=Silicon(80e-6, 180.0))
    instrument = replace(optics.instrument, stamps=stamps)
    model = replace(aligned, field=replace(aligned.field, optics=replace(optics, instrument=instrument)))
    model.write(tmp_path / "silicon.fits")
    assert FocalPlanePsf.read(tmp_path / "silicon.fits").field.optics.instrument.stamps.silicon == Silicon(80e-6, 180.0)


def test_files_that_are_no_models_give_one_clear_line(tmp_path):
    (tmp_path / "bad.fits").write_bytes(b"SIMPLE  =")
    for name in ("bad.fits", "none.fits"):
        with pytest.raises(ProductError) as raised:
            FocalPlanePsf.read(tmp_path / name)
        assert "\n" not in str(raised.value)
        assert name in str(raised.value)


@pytest.mark.long
def test_drawn_images_have_the_predicted_shapes(aligned):
    images = aligned.draw(*ELSEWHERE)
    found = measure_shapes(images, aligned.field.optics.pixel_scale, aligned.weight_fwhm)
    assert found.usable.all()
    # Three steps of Newton's method for changes of 1 %: 1e-5 (test_images).
    np.testing.assert_allclose(values(found), values(aligned.shapes(*ELSEWHERE)), atol=1e-5)
    np.testing.assert_allclose(images.sum(axis=(1, 2)), 1.0, rtol=1e-12)
    np.testing.assert_allclose(np.stack([found.x, found.y]), 0.0, atol=1e-3)
    spread = aligned.draw_uncertainty(*ELSEWHERE)
    assert spread.shape == images.shape
    assert (spread >= 0.0).all()
    # The centre of an image is the least certain, and by far less than itself.
    assert (spread.max(axis=(1, 2)) < 0.1 * images.max(axis=(1, 2))).all()
    assert (spread.max(axis=(1, 2)) > 0.0).all()


@pytest.mark.long
def test_stars_of_shapes_that_no_image_has_are_left_out_of_the_components(aligned, exposure, few):
    """Their singular values did not converge, or rings were the components."""
    given = exposure.stars(few)
    images = aligned.draw(given.ccd, given.x, given.y)
    stamps = images * (1.0 + 0.1 * np.sin(np.arange(len(images)))[:, None, None] * np.linspace(-1.0, 1.0, 31))
    given = replace(given, stamps=stamps, pixel_scale=aligned.field.optics.pixel_scale)
    shapes = aligned.field.data.values.copy()
    shapes[[3, 7]] += [-0.2, 0.0, -0.4]
    data = replace(aligned.field.data, values=shapes)
    model = replace(aligned, field=replace(aligned.field, data=data))._with_stamps(given, 2, None, Reporter(quiet=True))
    assert len(model.pca.coefficients) == len(images) - 2
    assert np.isfinite(model.pca.components).all()


@pytest.mark.long
def test_positions_in_pixels_and_lengths_are_the_same(blind, exposure):
    camera = exposure.camera
    own = camera.ccd_index(PLANTED)
    x, y = camera.centers[own] + 100.5 * camera.pixel_size
    metres = blind.shapes(PLANTED, x, y)
    # The centre of a CCD of 4096 pixels is at 2047.5.
    for there in (
        blind.shapes(PLANTED, 2148.0 * u.pix, 2148.0 * u.pix),
        blind.shapes(PLANTED, x * u.m, 1e3 * y * u.mm),
    ):
        np.testing.assert_allclose(values(there), values(metres), atol=1e-12)


@pytest.mark.long
def test_without_a_telescope_or_stamps_there_are_no_images(blind):
    with pytest.raises(DomainError, match=r"^draw: [^\n]*$"):
        blind.draw(*ELSEWHERE)


@pytest.mark.long
def test_few_stars_and_unknown_ccds_give_one_clear_line(blind, exposure):
    which = np.flatnonzero(exposure.first)[:29]
    with pytest.raises(DomainError, match=r"^29 of 29 stars [^\n]*30[^\n]*$"):
        FocalPlanePsf.fit(exposure.stars(which), camera=exposure.camera)
    with pytest.raises(UnknownNameError) as raised:
        blind.shapes("R23_S33", 0.12, 0.0)
    assert "R23_S33" in str(raised.value)
    assert "\n" not in str(raised.value)
    with pytest.raises(DomainError, match="finite"):
        blind.shapes(PLANTED, np.nan, 0.0)
    for rms in (-1e-7, np.nan):
        with pytest.raises(DomainError, match=r"^alignment_rms = [^\n]*$"):
            OpticsPrior(alignment_rms=rms)


@pytest.mark.parametrize(
    ("name", "replacement"),
    [
        ("wavelengths", "telescope=Instrument.of(telescope, wavelengths)"),
        ("silicon", "telescope=Instrument.of(telescope, stamps=Stamps(silicon=...))"),
        ("alignment_rms", "prior=OpticsPrior(alignment_rms=...)"),
        ("budget", "prior=OpticsPrior(budget=...)"),
    ],
)
def test_arguments_of_earlier_versions_name_their_place(name, replacement):
    with pytest.raises(ConfigError) as raised:
        FocalPlanePsf.fit([], **{name: None})
    assert str(raised.value) == f"{name}: no argument of FocalPlanePsf.fit; expected {replacement}"


@pytest.mark.long
def test_stars_on_one_ccd_are_remarked(exposure):
    own = exposure.camera.ccd_index(PLANTED)
    stars = exposure.stars(exposure.first & (exposure.ccd == own))
    model = FocalPlanePsf.fit(stars, camera=exposure.camera)
    assert any("one CCD" in w for w in model.warnings)
    empty = [w for w in model.warnings if "without stars" in w]
    assert len(empty) == 1
    assert empty[0].startswith("8 CCDs")
    # Far from them there is their mean and the scatter of turbulence, which is more than near them.
    far = model.uncertainty("R23_S00", *exposure.camera.centers[0])
    near = model.uncertainty(PLANTED, *exposure.camera.centers[own])
    assert (values(far)[0, :2] > values(near)[0, :2]).all()


@pytest.mark.long
def test_ccds_without_stars_are_predicted_and_remarked(exposure):
    gone = exposure.camera.ccd_index("R23_S02")
    model = FocalPlanePsf.fit(exposure.stars(exposure.first & (exposure.ccd != gone)), camera=exposure.camera)
    (remark,) = [w for w in model.warnings if "without stars" in w]
    assert remark.startswith("1 CCD ")
    assert "R23_S02" in remark
    h = ~exposure.first & (exposure.ccd == gone)
    where = ("R23_S02", *exposure.xy[h].T)
    left, sigma = values(model.shapes(*where)) - exposure.truth[h], model.uncertainty(*where)
    assert np.isfinite(left).all()
    # Fifteen places of one CCD err together: within 4 sigma of one.
    assert (np.abs(left[:, 0]) < 4.0 * sigma.e1).all()
    assert (np.abs(left[:, 1]) < 4.0 * sigma.e2).all()
    other = model.uncertainty(PLANTED, *exposure.camera.centers[exposure.camera.ccd_index(PLANTED)])
    assert sigma.e1.mean() > other.e1[0]


@pytest.mark.long
def test_understated_noise_is_remarked(exposure):
    model = FocalPlanePsf.fit(exposure.stars(noise=exposure.noise[exposure.first] / 3.0), camera=exposure.camera)
    # Stars of three times the stated noise: what is missing goes to the nugget, and chi-square stays at 1.
    assert any("as much in e1 as the stated noise" in w for w in model.warnings)
    # Other stars scatter about the prediction by its uncertainty and their stated noise.
    h = ~exposure.first
    where = (exposure.names[h].tolist(), *exposure.xy[h].T)
    noise = exposure.noise[h]
    seen = exposure.truth[h] + noise * np.random.default_rng(3).standard_normal((h.sum(), 3))
    left, sigma = seen - values(model.shapes(*where)), model.uncertainty(*where)
    for shape, spread in enumerate((sigma.e1, sigma.e2)):
        assert np.mean(left[:, shape] ** 2 / (spread**2 + (noise[:, shape] / 3.0) ** 2)) == pytest.approx(1.0, abs=0.2)


@pytest.mark.long
def test_stars_without_a_shape_are_left_out(exposure, few):
    changed = exposure.values[few].copy()
    noise = exposure.noise[few].copy()
    changed[[3, 40], [0, 2]] = np.nan
    noise[[5, 6], [1, 2]] = np.inf, 0.0
    model = FocalPlanePsf.fit(exposure.stars(few, values=changed, noise=noise), camera=exposure.camera)
    lost = np.array([3, 5, 6, 40])
    np.testing.assert_array_equal(np.flatnonzero(~model.used), lost)
    assert np.isnan(values(model.leave_one_out)[lost]).all()
    assert np.isfinite(values(model.leave_one_out)[model.used]).all()
    # The same as without these stars.
    keep = few.copy()
    keep[np.flatnonzero(few)[lost]] = False
    without = FocalPlanePsf.fit(exposure.stars(keep), camera=exposure.camera)
    assert values(without.shapes(*ELSEWHERE)).tobytes() == values(model.shapes(*ELSEWHERE)).tobytes()


@pytest.mark.long
def test_outliers_are_left_out(exposure, few):
    changed = exposure.values[few].copy()
    # 30 sigma of turbulence and noise together.
    changed[17, 0] += 0.15
    model = FocalPlanePsf.fit(exposure.stars(few, values=changed), camera=exposure.camera)
    np.testing.assert_array_equal(np.flatnonzero(~model.used), [17])


@pytest.mark.slow
def test_a_rotated_camera_is_fitted_as_any_other(aligned, exposure, few, lsst_r, wavelengths, tmp_path):
    # Axially symmetric optics: in the camera's own axes the stars are those of the camera that is not rotated.
    rotated = FocalPlanePsf.fit(
        exposure.stars(few),
        Instrument.of(lsst_r.with_rotator(0.5 * np.pi), wavelengths),
        camera=exposure.camera,
        prior=ALIGNED,
        threads=1,
    )
    x, y = exposure.xy.T
    # The search for the hyperparameters ends a little elsewhere.
    np.testing.assert_allclose(rotated.heights.height(x, y), aligned.heights.height(x, y), atol=5e-9)
    where = (list(exposure.names), x, y)
    np.testing.assert_allclose(values(rotated.shapes(*where)), values(aligned.shapes(*where)), atol=1e-5)
    rotated.write(tmp_path / "model.fits")
    again = FocalPlanePsf.read(tmp_path / "model.fits")
    np.testing.assert_allclose(values(again.shapes(*where)), values(rotated.shapes(*where)), atol=1e-6)
    # Not so where M2 is off its axis: its coma stays with the telescope.
    asymmetric = lsst_r.perturbed("M2", shift=(1e-3, 0.0, 0.0))
    shapes = [Instrument.of(t, wavelengths) for t in (asymmetric, asymmetric.with_rotator(0.5 * np.pi))]
    assert shapes[0].key != shapes[1].key
    e = [i.shapes(i.fields(exposure.xy[:20]), FocalPlane.flat(exposure.camera), None) for i in shapes]
    assert np.abs(e[0] - e[1]).max() > 1e-3
