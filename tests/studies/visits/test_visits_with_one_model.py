"""Visits with one PSF model for all CCDs: a CCD with one star, a few stars on each, too few stars."""

import numpy as np
import pytest

from pachon.core.errors import DomainError
from pachon.core.long_work import Execution
from pachon.core.units import ARCMIN, ARCSEC
from pachon.measure.shapes import measure_shapes
from pachon.studies.visits.config import VisitsConfig
from pachon.studies.visits.plan import Visit
from pachon.studies.visits.psf_visit import StackFrame, visit_psfs
from pachon.studies.visits.sky_points import SkyPoints
from pachon.studies.visits.visits import stack_visits

RUN = {
    "ccds": ["R22_S11", "R22_S12"],
    "wavelengths_nm": [620.0],
    "psf": {"engine": "long_exposure", "n_pupil": 200},
    "focal_plane": {"raft_um": 0.0, "ccd_um": 20.0},
    "active_optics": {"residual_um": 0.3},
    "reconstruction": {"model": "focal_plane"},
}


@pytest.mark.slow
def test_a_ccd_with_one_star_is_modelled_with_the_others():
    config = VisitsConfig.model_validate({"run": RUN})
    experiment = config.experiment()
    frame, visit = StackFrame.of(experiment, 31), Visit(0, 0)
    camera = experiment.camera
    # Places on the sky about the middle of each CCD, from those on the detector; distortion moves them by arcseconds.
    to_sky = np.linalg.inv(visit.jacobians(experiment.telescope, np.zeros((1, 2)), 620e-9)[0])
    first, second = (to_sky @ np.array(camera.from_local(camera.ccd_index(name), 0.0, 0.0)) for name in RUN["ccds"])
    rng = np.random.default_rng(3)
    offsets = rng.uniform(-6.0, 6.0, (53, 2)) * ARCMIN
    middle = np.where(np.arange(53)[:, None] < 40, first, second)
    star = np.arange(53) < 41
    points = SkyPoints(middle + offsets, star, np.where(star, rng.uniform(0.0, 0.02, 53), np.nan))
    # Of its own a CCD with one star has no model.
    seen = visit_psfs(experiment, visit, points, frame)
    assert seen.left_out == {}
    np.testing.assert_array_equal(np.sort(seen.index), np.arange(53))
    own = seen.index > 40
    true, model = (
        measure_shapes(images[own], 0.2 * ARCSEC, experiment.weight_fwhm) for images in (seen.true, seen.model)
    )
    left = np.hypot(true.e1 - model.e1, true.e2 - model.e2)
    # The 41 brightest stars leave 0.002 in e and 0.002 of the size; turbulence is its mean, heights differ.
    assert np.sqrt(np.mean(left**2)) < 0.004
    assert np.abs(model.size / true.size - 1.0).max() < 0.005
    few = SkyPoints(points.sky[:29], points.star[:29], points.quantile[:29])
    with pytest.raises(DomainError, match="29 of 29 stars have position, shape and noise: expected 30 or more"):
        visit_psfs(experiment, visit, few, frame)


@pytest.mark.slow
def test_stacks_of_few_stars_a_ccd(tmp_path):
    residuals = {}
    for model in ("ccd", "focal_plane"):
        run = RUN | {"ccds": ["R22"], "reconstruction": {"model": model}}
        visits = {"count": 2, "stars": 4, "places": 4, "snapshots": [1], "dither_deg": 0.3, "rotator_deg": "random"}
        config = VisitsConfig.model_validate({"run": run, "visits": visits})
        metrics = stack_visits(config, tmp_path / model, execution=Execution(threads=1)).summary["stacks"]
        residuals[model] = np.array([metrics[n]["rms_residual_e_places"] for n in ("1", "2")])
    # Four stars of S/N 30 and more on a CCD tell less of it than 36 of all.
    assert (residuals["focal_plane"] < 0.8 * residuals["ccd"]).all()
    content = [path.read_bytes() for path in sorted((tmp_path / "focal_plane").glob("*.fits"))]
    stack_visits(config, tmp_path / "again", execution=Execution(threads=2))
    assert [path.read_bytes() for path in sorted((tmp_path / "again").glob("*.fits"))] == content
