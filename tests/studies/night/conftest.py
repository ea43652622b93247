import pytest
from visit_rows import COLUMNS, ROWS

from pachon.studies.night.config import NightConfig

#: A run of which a visit takes a fraction of a second: the mean of all turbulence, one wavelength.
RUN = {
    "ccds": ["R22_S11"],
    "wavelengths_nm": [620.0],
    "psf": {"engine": "long_exposure", "n_pupil": 300},
    "stars": {"truth": 16, "observed": 15},
    "reconstruction": {"recipe": "paper", "basis": "pixels", "order": 1},
}


@pytest.fixture(scope="session")
def night_config(tmp_path_factory):
    """Function of the configuration of a night of three visits, the second of which fails: 85 deg from the zenith."""

    def config(run=None, **sections):
        path = tmp_path_factory.mktemp("list") / "visits.csv"
        altitudes = [80.0, 5.0, 70.0]
        rows = [",".join(map(str, (*row, altitude))) for row, altitude in zip(ROWS, altitudes, strict=False)]
        path.write_text("\n".join([",".join((*COLUMNS, "altitude")), *rows]) + "\n")
        visits = {"list": str(path)}
        return NightConfig.model_validate({"run": RUN | (run or {}), "visits": visits, **sections})

    return config
