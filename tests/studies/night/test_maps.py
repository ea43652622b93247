import numpy as np
import pytest

from pachon.studies.night.maps import NightMaps
from pachon.studies.night.visit_product import VisitProduct

NSIDE = 512
PIXEL = 1234567
SKY_NOISE = np.array([30.0, 45.0])
ZERO_POINT = np.array([31.9, 32.1])
AREA = np.array([90.0, 70.0])


def depth_of_stack(weights):
    """Limiting magnitude of the stack of two visits of these weights at a pixel."""
    maps = NightMaps(NSIDE)
    for k, weight in enumerate(weights):
        table = {"detector": [94], "expMidptMJD": [6e4 + k], "expTime": [30.0], "weight": [weight]}
        table |= {"skyNoise": [SKY_NOISE[k]], "zeroPoint": [ZERO_POINT[k]]}
        pixels = {"HPIX": PIXEL, "CCD": 94, "SIGMA": 2.4, "G1": 0.01, "G2": 0.02, "AREA": AREA[k]}
        columns = [{key: np.atleast_1d(value) for key, value in part.items()} for part in (table, pixels)]
        maps.add(VisitProduct(k, "r", *columns, {}, {}))
    return float(maps.pictured("r")[1][PIXEL])


@pytest.mark.parametrize("weights", [(1.0, 1.0), (1e9, 3e9), (2e-4, 1e-4)])
def test_depth_is_that_of_the_weighted_mean_whatever_the_unit_of_the_weights(weights):
    pytest.importorskip("healsparse")
    variance = (SKY_NOISE * 10 ** (0.4 * (31.4 - ZERO_POINT))) ** 2  # nJy^2
    shares = np.array(weights) / np.sum(weights)
    limit = 31.4 - 2.5 * np.log10(5.0 * np.sqrt((shares**2 * variance).sum() * (shares * AREA).sum()))
    assert depth_of_stack(weights) == pytest.approx(limit, abs=1e-9)
