"""Standard deviations of degrees of freedom that a fit of donuts takes as a prior."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.core.errors import PachonError
from pachon.design.optimize.sensitivity import sensitivity
from pachon.models.parameters.degrees_of_freedom import DegreesOfFreedom
from pachon.sensing import ExposureDonuts, TelescopeFreedoms
from pachon.sensing.degrees import annulus_response, prior_spreads

FREEDOMS = pachon.load_degrees_of_freedom("lsst").select(["M2_dz", "M2_rx"])


def uncut(telescope):
    """The telescope without apertures and obstructions."""
    surfaces = tuple(replace(surface, aperture=None) for surface in telescope.surfaces)
    return replace(telescope, surfaces=surfaces, obstructions=())


@pytest.mark.parametrize("fit", [TelescopeFreedoms, ExposureDonuts])
@pytest.mark.parametrize(
    ("prior", "message"),
    [
        # Numbers were taken out of their unit: 0.1 mm for 0.1 um.
        (0.1 * u.mm, "prior = .*: expected real numbers without a unit"),
        ([0.1 * u.mm, 1.0 * u.arcsec], "prior = .*: expected real numbers without a unit"),
        (np.ones(3), r"prior of shape \[3\]: expected 2 standard deviations"),
        ([10.0, 0.0], "prior of M2_rx = 0.0: expected a positive"),
        ([10.0, np.inf], "prior of M2_rx = inf: expected a positive"),
        ({"M2_dy": 1.0}, "prior: unknown degree of freedom"),
        ({"M2_dz": 1.0}, "prior of M2_rx = 0.0: expected a positive"),
        ([pachon.Tolerance("M2_dz", 10.0)], "prior of M2_rx = 0.0: expected a positive"),
    ],
)
def test_wrong_priors_are_refused_before_the_fit(fit, prior, message):
    with pytest.raises(PachonError, match=message):
        fit(freedoms=FREEDOMS, prior=prior)


def test_priors():
    for prior in (5.0, [5.0], [5.0, 1.0], {"M2_dz": 0.1 * u.mm, "M2_rx": 3.0 * u.arcsec}):
        TelescopeFreedoms(FREEDOMS, prior=prior)
    with pytest.raises(PachonError, match="prior: expected together with freedoms"):
        ExposureDonuts(prior=5.0)


def test_a_freedom_without_a_wavefront_has_no_default_prior():
    """A turn of M2 about its axis had an infinite prior, and errors of 4e12 arcsec or a raw error of linear algebra."""
    telescope = pachon.load_telescope("lsst_v3.3_r")
    freedoms = DegreesOfFreedom.of_parameters(telescope, ["M2.dz", "M2.rz"])
    with pytest.raises(PachonError, match=r"^M2\.rz: no change of the wavefront; expected"):
        prior_spreads(freedoms, None, telescope, 622e-9)
    assert np.isfinite(prior_spreads(freedoms.select(["M2.dz"]), None, telescope, 622e-9)).all()


@pytest.mark.parametrize("degrees", [1.75, 1.9])
def test_responses_of_vignetted_light_are_those_of_the_annulus(lsst_r, degrees):
    """By 22 terms alone that of M1M3_B20 was wrong by 0.42 and 3.1 of its size."""
    fields, wave = np.deg2rad([[0.0, degrees]]), lsst_r.default_wavelength
    freedoms = pachon.load_degrees_of_freedom("lsst").select(["M2_dz", "M1M3_B20", "M2_B19"])
    response = annulus_response(lsst_r, freedoms, fields, wave, 22, "zemax")[0, 3:]
    full = sensitivity(uncut(lsst_r), freedoms, fields, wave, n_zernike=66).matrix[0, 3:22]
    assert (np.linalg.norm(response - full, axis=0) < 0.02 * np.linalg.norm(full, axis=0)).all()
