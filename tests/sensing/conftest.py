import pytest

import pachon


@pytest.fixture(scope="session")
def focused():
    return pachon.load_telescope("lsst_v3.3_r")


@pytest.fixture(scope="session")
def behind_focus(focused):
    return focused.perturbed("Detector", shift=(0.0, 0.0, 1.5e-3))
