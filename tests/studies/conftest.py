import pickle

import pytest

from pachon.core.workers import Workers


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
