import pytest

from pachon.pipeline.config import configuration_of
from pachon.studies.visits.config import VisitsConfig, VisitsSection


@pytest.fixture(scope="session")
def visits_config():
    """Configuration of two visits of the central CCD under the mean of all turbulence."""

    def config(**visits):
        run = {
            "ccds": ["R22_S11"],
            "wavelengths_nm": [620.0],
            "psf": {"engine": "long_exposure", "n_pupil": 300},
            "focal_plane": {"raft_um": 0.0, "ccd_um": 20.0},
            "active_optics": {"residual_um": 0.3},
            "reconstruction": {"recipe": "paper", "basis": "pixels", "order": 1, "weights": "snr"},
        }
        settings = {"count": 2, "stars": 20, "places": 8, "snapshots": (1,)} | visits
        return VisitsConfig(run=configuration_of(run, "test"), visits=VisitsSection(**settings))

    return config
