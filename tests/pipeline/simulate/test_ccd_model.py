"""Models of several CCDs at once."""

import dataclasses

import numpy as np
import pytest

from pachon.core.errors import DomainError
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate.ccd_exposure import expose_ccd
from pachon.pipeline.simulate.ccd_model import CcdFit, fit_ccds, model_ccd, model_ccds

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
