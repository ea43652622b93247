"""Models of several CCDs at once."""

import dataclasses

import numpy as np
import pytest

from pachon.core.errors import DomainError
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate.ccd_exposure import expose_ccd
from pachon.pipeline.simulate.ccd_model import CcdFit, fit_ccds, model_ccd, model_ccds
from pachon.reconstruction.psf_model.model import PsfModel

NAMES = ("R22_S11", "R41_S21", "R24_S12")


@pytest.mark.long
def test_ccds_modelled_together_have_the_bytes_of_each_alone(tiny):
    experiment = Experiment.from_config(
        tiny(
            ccds=NAMES,
            psf__engine="long_exposure",
            rotator_deg=30.0,
            reconstruction={"recipe": "kriging", "truth_order": 2},
            pointing={"ra_deg": 50.0, "dec_deg": -30.0, "position_angle_deg": 0.0},
        )
    )
    exposures = [expose_ccd(experiment, name, threads=1) for name in NAMES]
    dark = dataclasses.replace(exposures[1].observed, image=np.full_like(exposures[1].observed.image, np.nan))
    exposures[1] = dataclasses.replace(exposures[1], observed=dark)
    first, failed, third = model_ccds(experiment, exposures)
    assert isinstance(failed, DomainError)
    for product, exposure in ((first, exposures[0]), (third, exposures[2])):
        alone = model_ccd(experiment, exposure)
        assert product.name == exposure.name
        assert np.array_equal(product.model.at(exposure.positions.holdout), alone.model.at(exposure.positions.holdout))
        for table in ("holdout", "observed"):
            for name, values in vars(getattr(alone, table)).items():
                together = getattr(getattr(product, table), name)
                equal_nan = values is not None and np.asarray(values).dtype.kind == "f"
                assert together is values or np.array_equal(together, values, equal_nan=equal_nan), (table, name)
        assert product.holdout.g1_sky is not None
    fits = fit_ccds(experiment, exposures)
    assert str(fits[1]) == str(failed)
    for fit, product in ((fits[0], first), (fits[2], third)):
        of_product = CcdFit.of(product)
        assert (fit.name, fit.pixel_scale) == (of_product.name, of_product.pixel_scale)
        assert len(fit.observed.sigma) == product.observed.used.sum()
        for moments, expected in ((fit.holdout, of_product.holdout), (fit.observed, of_product.observed)):
            np.testing.assert_array_equal(moments, expected)


@pytest.mark.long
def test_a_ccd_whose_psfs_or_model_have_no_shape_cannot_be_modelled(tiny, monkeypatch):
    """The correlations of the whole run failed, after all was computed."""
    blurred = tiny(psf__engine="long_exposure", atmosphere__r0_m=0.02, atmosphere__zenith_angle_deg=75.0)
    experiment = Experiment.from_config(blurred)
    name = experiment.config.ccds[0]
    with pytest.raises(DomainError, match=r"no noise-free PSF has a shape on \d+ x \d+ pixels \(psf.stamp\)"):
        model_ccd(experiment, expose_ccd(experiment, name, threads=1))
    experiment = Experiment.from_config(tiny(psf__engine="long_exposure"))
    exposure = expose_ccd(experiment, name, threads=1)
    monkeypatch.setattr(PsfModel, "at", lambda _, places, **__: np.full((len(places), 31, 31), -1.0))
    with pytest.raises(DomainError, match="the PSF model has no shape, faint stars are lost in the noise of"):
        model_ccd(experiment, exposure)
