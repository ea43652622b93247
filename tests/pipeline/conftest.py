"""A run small enough for tests: far too few stars and steps for figures that mean anything, every stage real."""

import pytest
import yaml

from pachon.pipeline.config import Configuration, with_options
from pachon.pipeline.experiment import resolve
from pachon.pipeline.run import run

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
def tiny():
    """The small configuration, resolved: ``tiny(stars__truth=20)``."""

    def make(**options):
        flat = {}
        for key, value in SETTINGS.items():
            flat |= {f"{key}__{k}": v for k, v in value.items()} if isinstance(value, dict) else {key: value}
        return resolve(with_options(Configuration(), **(flat | options)))

    return make


@pytest.fixture
def settings_file(tmp_path):
    """The small configuration as a file."""
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(SETTINGS))
    return path


@pytest.fixture(scope="session")
def finished_run(tiny, tmp_path_factory):
    """The folder of a finished run on one thread; tests only read it."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    run(tiny(), folder, threads=1)
    return folder
