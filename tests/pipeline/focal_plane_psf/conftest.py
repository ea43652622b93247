import numpy as np
import pytest

from pachon.core.threads import one_blas_thread
from pachon.models.camera.camera import Camera, load_camera


@pytest.fixture(autouse=True)
def one_thread_of_linear_algebra():
    """As in the product, which runs blocks of stars side by side: threads within small matrices only wait."""
    with one_blas_thread():
        yield


@pytest.fixture(scope="session")
def part():
    """A camera of some rafts of the LSST's: ``part("R22", "R23")``."""

    def of(*rafts):
        whole = load_camera("lsst")
        keep = [i for i, raft in enumerate(whole.raft_of) if raft in rafts]
        index = np.array([rafts.index(whole.raft_of[i]) for i in keep])
        names = tuple(whole.ccd_names[i] for i in keep)
        return Camera("part", names, rafts, index, whole.centers[keep], whole.pixels, whole.pixel_size)

    return of
