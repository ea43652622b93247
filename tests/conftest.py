import numpy as np
import pytest
import yaml

import pachon
from pachon.pipeline.config import Configuration, with_options
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.run import run

# A run small enough for tests: far too few stars and steps for figures that mean anything, every stage real.
# Coarse screens, just as long as two CCDs so far apart need, two seconds of exposure, two wavelengths.
SETTINGS = {
    "ccds": ["R22_S11", "R24_S12"],
    "wavelengths_nm": [560.0, 680.0],
    "stars": {"truth": 14, "observed": 12},
    "atmosphere": {"screen_size": 1024, "screen_length_m": 560.0, "exposure_s": 2.0, "time_step_s": 0.5},
    "psf": {"n_pupil": 60},
    "reconstruction": {"components": 4, "order": 1, "truth_order": 2},
}


@pytest.fixture(scope="session")
def lsst_r():
    return pachon.load_telescope("lsst_v3.3_r")


@pytest.fixture(scope="session")
def zemax_lsst():
    """The design that the Zemax listings in tests/data/zemax belong to."""
    return pachon.load_telescope("lsst_v3.3_g_vacuum_zemax_check")


@pytest.fixture(scope="session")
def annulus_points():
    """Uniform random points of the LSST's unvignetted entrance pupil, ``points(n, seed)`` [m]."""

    def points(n, seed=0):
        rng = np.random.default_rng(seed)
        radius = np.sqrt(rng.uniform(2.558**2, 4.18**2, n))
        angle = rng.uniform(0, 2 * np.pi, n)
        return radius * np.cos(angle), radius * np.sin(angle)

    return points


@pytest.fixture(scope="session")
def slope():
    """``slope(function, step)``: central differences at 0, extrapolated from two steps, so good to step^4."""

    def of(function, step):
        near, far = ((function(h) - function(-h)) / (2 * h) for h in (step, 2 * step))
        return (4 * near - far) / 3

    return of


@pytest.fixture(scope="session")
def tiny():
    """The small configuration, resolved: ``tiny(stars__truth=20)``."""

    def make(**options):
        flat = {}
        for key, value in SETTINGS.items():
            flat |= {f"{key}__{k}": v for k, v in value.items()} if isinstance(value, dict) else {key: value}
        return Experiment.from_config(with_options(Configuration(), **(flat | options))).config

    return make


@pytest.fixture
def settings_file(tmp_path):
    """The small configuration as a file."""
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(SETTINGS))
    return path


def pytest_collection_modifyitems(items):
    # A finished run takes seconds, and every process makes its own.
    for item in items:
        if "finished_run" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.long)


@pytest.fixture(scope="session")
def finished_run(tiny, tmp_path_factory):
    """The folder of a finished run on one thread; tests only read it."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    run(tiny(), folder, threads=1)
    return folder
