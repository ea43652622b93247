"""Real donuts of one DECam exposure: test/input of aaronroodman/Donut, MIT; skipped where they are not at hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.commands.donut_fit import DonutWork
from pachon.commands.donut_options import FitOptions, FrameOptions, StampOptions, TelescopeOptions
from pachon.sensing import rim_search

FILES = sorted((Path(__file__).parents[3] / "shared/data/real").glob("DECam_00284696.*.stamp.fits"))
pytestmark = [pytest.mark.skipif(not FILES, reason="needs real donuts"), pytest.mark.long]


@pytest.fixture(scope="module")
def stars_of_one_ccd():
    """Stamps of four stars within 16 mm of each other on CCD S4."""
    files = [file for file in FILES if ".S4." in file.name]
    telescope = TelescopeOptions(files, defocus_um=1650.0)
    return DonutWork.of(telescope, StampOptions(), FrameOptions(), FitOptions(each_alone=True))


def test_stars_of_one_exposure_repeat(stars_of_one_ccd, monkeypatch):
    """Most of what is claimed is common to them: figure of the mirror and air, which are no rim elsewhere."""

    def tried(*_):
        raise AssertionError("a figure of the mirror was taken for a rim elsewhere")

    monkeypatch.setattr(rim_search, "_each_freed", tried)
    wavefront = pachon.sensing.SingleDonuts(range(4, 12), higher_order=10e-9)
    fit = replace(stars_of_one_ccd, wavefront=wavefront, threads=1).fit(lambda _: None)
    assert fit.usable.all()
    assert len(fit.rims) == 0
    about = fit.zernikes - fit.zernikes.mean(axis=0)
    scatter = np.sqrt((about[:, 1:] ** 2).sum() / (len(about) - 1))
    assert scatter < 70e-9
    claims = np.sqrt([np.trace(covariance[1:, 1:]) for covariance in fit.covariance])
    assert (scatter < claims).all()
    # The gain of DECam is 4 to 4.5 electrons a unit.
    np.testing.assert_allclose(1.0 / fit.photon_variance, 4.0, rtol=0.6)
