import pickle

import pytest

from pachon.core.workers import Workers
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


@pytest.fixture(scope="session")
def backwards():
    """Workers that are sent pickled jobs, and end them in the opposite order."""

    def make(compute):
        def results(jobs):
            sent = [pickle.dumps((compute, job)) for job in jobs]
            for data in reversed(sent):
                received, job = pickle.loads(data)
                yield pickle.loads(pickle.dumps(received(job, 1)))

        return Workers("backwards", 0, results)

    return make
