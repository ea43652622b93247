"""Images drawn by workers: the bytes of those of one process."""

from dataclasses import replace

import pytest

import pachon
from pachon.core.errors import ProductError
from pachon.core.long_work import Execution, JobResult
from pachon.core.workers import Workers, serial_worker
from pachon.imaging.ccd_image import image_name

SETTINGS = {
    "run": {
        "ccds": ["R22_S11", "R22_S12"],
        "wavelengths_nm": [620.0],
        "stars": {"truth": 14, "observed": 12},
        "psf": {"engine": "long_exposure"},
        "reconstruction": {"components": 4, "order": 1, "truth_order": 2},
    },
    "galaxies": {"faintest": 24.0},
    "image": {"side": 256},
}


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.slow
def test_workers_write_the_bytes_of_one_process(tmp_path, monkeypatch):
    config = pachon.imaging.ImagesConfig.model_validate(SETTINGS)
    alone = pachon.simulate_images(config, tmp_path / "one")
    shared = pachon.simulate_images(config, tmp_path / "two", execution=Execution(workers=serial_worker))
    assert contents(tmp_path / "two") == contents(tmp_path / "one")
    assert shared.objects == alone.objects
    assert shared.computed == alone.computed
    # A worker that does not see the folder sends its files.
    written = []

    def far(compute):
        return Workers("far", 0, lambda jobs: (replace(compute, mark="none")(job, 1) for job in jobs))

    def write(path, data):
        written.append(path.name)
        path.write_bytes(data)

    monkeypatch.setattr("pachon.core.long_work.write_bytes", write)
    pachon.simulate_images(config, tmp_path / "three", execution=Execution(workers=far))
    assert contents(tmp_path / "three") == contents(tmp_path / "one")
    # The image is the sign of a finished CCD.
    assert [written.index(image_name(name)) for name in shared.computed] == [2, 5]

    def failing(compute):
        def results(jobs):
            for job in jobs:
                yield JobResult(job.number, ProductError("nothing", subject=job.label))

        return Workers("failing", 0, results)

    with pytest.raises(ProductError, match="CCD R22_S11: nothing"):
        pachon.simulate_images(config, tmp_path / "four", execution=Execution(workers=failing))
