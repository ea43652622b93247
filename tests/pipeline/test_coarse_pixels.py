"""Runs of a refractor of 10 cm, whose pixels are wider than the weight of the LSST's moments."""

import json
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits

import pachon
from pachon.core.long_work import Execution
from pachon.errors import ConfigError, DomainError
from pachon.pipeline.config import configuration_of
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.run import run

REFRACTOR = Path(__file__).parents[1] / "data" / "telescopes" / "refractor.yaml"
CAMERA = """\
name: small
source: test
pixel_um: {pixel}
pixels: [{count}, {count}]
ccds:
  - {{name: A, x_mm: 0, y_mm: 0}}
"""
RUN = {
    "telescope": str(REFRACTOR),
    "wavelengths_nm": [620],
    "stars": {"truth": 30, "observed": 40},
    "atmosphere": {"screen_length_m": 204, "exposure_s": 3},
}


def small(folder, pixel=9.0, count=300, **changes):
    path = folder / "small.yaml"
    path.write_text(CAMERA.format(pixel=pixel, count=count))
    return Experiment.from_config(configuration_of({**RUN, "camera": str(path), **changes}, "test"))


def test_the_weight_spans_pixels_that_are_coarse(tmp_path):
    """9 um at 0.8 m are 2.32 arcsec: a weight of 0.7 arcsec would take the moments of one pixel."""
    experiment = small(tmp_path)
    assert experiment.config.reconstruction.weight_fwhm_arcsec == pytest.approx(2.5 * 9e-6 / 0.8 / 4.84814e-6, rel=1e-3)
    fine = small(tmp_path, pixel=1.0)
    assert fine.config.reconstruction.weight_fwhm_arcsec == 0.7
    with pytest.raises(ConfigError, match=r"weight_fwhm_arcsec = 0.7: expected at least 2.32, a pixel, and better 5.8"):
        small(tmp_path, reconstruction={"weight_fwhm_arcsec": 0.7})


@pytest.mark.parametrize("telescope", ["lsst_v3.3_r", "comcam_r", "auxtel", "hsc", "decam"])
def test_bundled_cameras_keep_the_weight_of_the_paper(telescope):
    air = {"screen_length_m": 400} if telescope == "auxtel" else {}
    config = configuration_of({"telescope": telescope, "atmosphere": air}, "test")
    assert Experiment.from_config(config).config.reconstruction.weight_fwhm_arcsec == 0.7


def test_a_focal_plane_model_refuses_a_weight_within_a_pixel():
    rng = np.random.default_rng(1)
    table = {"ccd": ["A"] * 40, "x": rng.normal(size=40), "y": rng.normal(size=40), "snr": np.full(40, 100.0)}
    stamps = rng.random((40, 15, 15)) + 1.0
    with pytest.raises(DomainError, match=r"weight_fwhm = 0.7 arcsec: expected at least a pixel of the stamps, 2.3 "):
        pachon.FocalPlanePsf.fit(
            pachon.FocalPlaneStars.from_table(table, stamps=stamps, pixel_scale=(2.3 * u.arcsec).to_value(u.rad))
        )


@pytest.mark.slow
def test_a_focal_plane_model_of_a_refractor_predicts_its_own_errors(tmp_path):
    """Moments under the wider weight are measured, fitted and predicted alike."""
    experiment = small(tmp_path, reconstruction={"model": "focal_plane"})
    folder = tmp_path / "run"
    run(experiment, folder, execution=Execution(threads=2))
    metrics = json.loads((folder / "summary.json").read_text())["all"]
    for shape in ("e1", "e2", "size"):
        # Forty stars tell a variance to 22 %.
        assert 0.5 < metrics[f"chi2_left_out_{shape}"] < 1.6
    assert np.isfinite(fits.getdata(folder / "ccd_A.fits", "STARS")["MODEL_E1"]).all()
    read = pachon.FocalPlaneStars.read(folder)
    weight = experiment.config.reconstruction.weight_fwhm_arcsec
    assert read.weight_fwhm == pytest.approx((weight * u.arcsec).to_value(u.rad), rel=1e-12)
