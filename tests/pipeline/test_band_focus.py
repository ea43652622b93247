import numpy as np
import pytest

import pachon
from pachon.pipeline.config import Configuration, with_options
from pachon.pipeline.experiment import Experiment


def resolved(telescope, **options):
    return Experiment.from_config(with_options(Configuration(telescope=telescope), **options))


@pytest.mark.parametrize(("telescope", "band", "before", "after"), [("hsc", "g", 8.0, 5.5), ("decam", "z", 7.5, 6.6)])
def test_another_band_is_in_focus(telescope, band, before, after):
    # With the prescription's own focus HSC in g had PSFs of 0.558 in place of 0.545 arcsec in the middle of the field.
    experiment = resolved(telescope, band=band)
    assert list(experiment.config.changes) == ["Detector.dz_um"]
    field = np.deg2rad([[0.0, 0.0], [0.0, 0.3], [0.0, 0.5]])
    rms = [
        pachon.spots(model, field, experiment.wavelengths).rms_radius.mean() * 1e6
        for model in (pachon.load_telescope(telescope), experiment.telescope)
    ]
    assert rms[0] > before
    assert rms[1] < after
    # A configuration without open values stays as it is.
    assert Experiment.from_config(experiment.config).config == experiment.config


def test_own_bands_and_mirrors_stay_as_they_are(tmp_path):
    for telescope, band in (("hsc", "i"), ("decam", "r"), ("lsst_v3.3_g", "g"), (None, "u")):
        assert resolved(telescope, band=band).config.changes == {}
    mirrors = tmp_path / "mirrors.yaml"
    pachon.save_telescope(pachon.new_telescope("ritchey-chretien", diameter=1.0), mirrors)
    assert (
        resolved(str(mirrors), camera="decam", band="g", ccds=("N4",), atmosphere__enabled=False).config.changes == {}
    )


def test_a_detector_that_changes_move_stays_there():
    for changes in ({"Detector.dz_um": 0.0}, {"DECam.dz_um": 5.0}):
        assert resolved("decam", band="z", changes=changes).config.changes == changes
    moved = resolved("decam", band="z", changes={"PM.dz_um": 5.0}).config.changes
    assert set(moved) == {"PM.dz_um", "Detector.dz_um"}


def test_a_detector_behind_a_fold_moves_along_its_normal():
    # A shift along z of the telescope moves AuxTel's detector sideways and leaves its spots as they are.
    experiment = resolved("auxtel", band="y")
    assert list(experiment.config.changes) == ["Detector.dy_um"]
    before, after = (
        pachon.spots(model, np.deg2rad([[0.0, 0.05]]), experiment.wavelengths).rms_radius[0] * 1e6
        for model in (pachon.load_telescope("auxtel"), experiment.telescope)
    )
    assert after < 0.85 * before
    moved = {"Detector.dy_um": 1.0}
    assert resolved("auxtel", band="y", changes=moved).config.changes == moved
