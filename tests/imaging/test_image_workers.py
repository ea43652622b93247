"""Images drawn by workers: the bytes of those of one process."""

from dataclasses import replace

import pytest

import pachon
from pachon.core.errors import ProductError
from pachon.core.workers import Workers, serial_worker
from pachon.imaging.ccd_image import ImageComputation, image_name
from pachon.pipeline.ccd_worker import CcdJob

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


@pytest.mark.long
def test_workers_write_the_bytes_of_one_process(tmp_path):
    config = pachon.ImagesConfig.model_validate(SETTINGS)
    alone = pachon.simulate_images(config, tmp_path / "one")
    shared = pachon.simulate_images(config, tmp_path / "two", workers=serial_worker)
    assert contents(tmp_path / "two") == contents(tmp_path / "one")
    assert shared.objects == alone.objects
    assert shared.computed == alone.computed
    # A worker that does not see the folder sends its files.
    computation = ImageComputation(config, config.experiment(), tmp_path / "three", "no mark")
    drawn = computation(CcdJob("R22_S12"), 1)
    assert dict(drawn.files) == {k: v for k, v in contents(tmp_path / "one").items() if "R22_S12" in k}
    assert drawn.files[-1][0] == image_name("R22_S12")
    lost = replace(drawn, problem="CCD R22_S12: nothing")

    def failing(compute):
        return Workers("failing", 0, lambda jobs: (lost for _ in jobs))

    with pytest.raises(ProductError, match="CCD R22_S12: nothing"):
        pachon.simulate_images(config, tmp_path / "four", workers=failing)
