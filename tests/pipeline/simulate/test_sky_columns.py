"""Ellipticities on the sky in the products of a run with a pointing, against the world coordinates of its CCDs."""

from types import SimpleNamespace

import numpy as np
import pytest

import pachon
from pachon.measure.shapes import Shapes
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate.ccd_model import _jacobians, _sky_columns
from pachon.pipeline.simulate.sky_axes import sky_jacobians

AIM = {"ra_deg": 53.1, "dec_deg": -27.8, "position_angle_deg": 40.0}


@pytest.mark.parametrize("ccd", ["R22_S11", "R34_S20"])
def test_ellipticities_are_those_of_the_pixels_carried_by_the_wcs(tiny, ccd):
    experiment = Experiment.from_config(tiny(ccds=(ccd,), pointing=AIM, rotator_deg=25.0))
    camera, rng = experiment.camera, np.random.default_rng(1)
    index, pixels = camera.ccd_index(ccd), rng.uniform(0.0, 4000.0, (10, 2))
    e1, e2 = rng.normal(0.0, 0.05, (2, 10))
    g1, g2 = rng.normal(0.0, 0.1, (2, 10))
    shapes, moments = Shapes(e1, e2, *[np.zeros(10)] * 5), SimpleNamespace(g1=g1, g2=g2)
    # Another group before it, that of another CCD, changes nothing.
    jacobians = sky_jacobians(experiment, [camera.centers[:1], camera.from_pixel(index, pixels)])[1]
    columns = _sky_columns(jacobians, shapes, moments)
    light = experiment.wavelengths[len(experiment.wavelengths) // 2]
    center, roll = np.deg2rad([AIM["ra_deg"], AIM["dec_deg"]]), np.deg2rad(AIM["position_angle_deg"])
    wcs = pachon.wcs(experiment.telescope, ccd, center, roll, wavelength=light)
    # The pixels' x and y are y and x of the focal plane: e1 changes its sign, e2 does not.
    for kind, first, second in (("e", e1, e2), ("g", g1, g2)):
        expected = pachon.to_sky(np.stack([-first, second], axis=1), wcs, *pixels.T)
        assert np.allclose(columns[f"{kind}1_sky"], expected.g1_sky, rtol=0, atol=1e-7)
        assert np.allclose(columns[f"{kind}2_sky"], expected.g2_sky, rtol=0, atol=1e-7)


def test_without_a_pointing_there_are_none(tiny):
    experiment = Experiment.from_config(tiny(ccds=("R22_S11",)))
    (jacobians,) = _jacobians(experiment, [None])
    assert _sky_columns(jacobians, Shapes(*np.zeros((7, 1))), None) == {}
