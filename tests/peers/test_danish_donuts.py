"""The twenty donuts of danish's own tests (BSD-3-Clause): batoid's rays through an LSST with its camera moved.

They are read from the folder of danish's tests in the variable DANISH_TESTS of the environment (``danish-1.3.0/tests``
of the source distribution), and skipped without. The truth is the file's: Zernikes of the true telescope less those of
the design; bounds are what pachon is to reach, and danish's own errors on these images.
"""

import os
import pickle
from pathlib import Path

import numpy as np
import pytest

import pachon

FOLDER = Path(os.environ.get("DANISH_TESTS", "no such folder")) / "data"
NOLL = np.arange(4, 23)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not FOLDER.is_dir(), reason="DANISH_TESTS: no folder of danish's tests"),
]


@pytest.fixture(scope="module", params=["kolm", "atm"])
def donuts(request):
    with (FOLDER / f"test_{request.param}_donuts.pkl").open("rb") as file:
        return request.param, *pickle.load(file)


def errors(donuts, moved, fit):
    """Root of the sum of squares of Z4 to Z22, each donut [nm]."""
    _, head, *stars = donuts
    wavelength = head["wavelength"]
    truth = wavelength * np.array([(star["z_actual"] - star["z_ref"])[NOLL] for star in stars])
    fitted = pachon.fit_donuts(
        pachon.load_telescope("lsst_v3.3_i"),
        [star["arr"] for star in stars],
        [(star["thx"], star["thy"]) for star in stars],
        wavelength,
        sky_variance=head["sky_level"],
        moved=moved,
        model=pachon.DonutModel(detector=pachon.DonutDetector(defocus=head["defocus"])),
        fit=fit,
        projection="postel",
        threads=1,
    )
    assert fitted.usable.all()
    return 1e9 * np.linalg.norm(fitted.zernikes - truth, axis=1)


def test_one_by_one(donuts):
    single = errors(donuts, "Camera", pachon.sensing.SingleDonuts(NOLL, higher_order=10e-9))
    median, danish_worst = {"kolm": (75.0, 129.0), "atm": (155.0, 683.0)}[donuts[0]]
    assert np.median(single) < median
    assert single.max() < danish_worst
    # Another body is not what these images are of.
    wrong = errors(donuts, "Detector", pachon.sensing.SingleDonuts(NOLL, higher_order=10e-9))
    assert np.median(wrong) > 1.5 * np.median(single)


def test_degrees_of_freedom_of_all_ten(donuts):
    joint = errors(
        donuts, "Camera", pachon.sensing.TelescopeFreedoms(pachon.load_degrees_of_freedom("lsst"), noll=NOLL)
    )
    assert np.median(joint) < {"kolm": 60.0, "atm": 105.0}[donuts[0]]
    assert joint.max() < {"kolm": 100.0, "atm": 309.0}[donuts[0]]
