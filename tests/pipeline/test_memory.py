"""Memory of a run: the estimate, and refusals before anything is computed."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from pachon.commands.cli import main
from pachon.core.errors import ConfigError
from pachon.core.long_work import Execution
from pachon.pipeline import memory as run_memory
from pachon.pipeline import run as run_module
from pachon.pipeline.config import Configuration, with_options
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.memory import check_memory, needed_bytes
from pachon.pipeline.star_list import StarList

GB = 1_000_000_000


def experiment(**options):
    return Experiment.from_config(with_options(Configuration(), ccds=("R22_S11",), **options))


def test_screens_are_most_of_what_is_needed():
    # Of six screens of 8192^2 samples of four bytes the rows that light of the CCDs crosses.
    whole = 6 * 8192**2 * 4
    every = Experiment.from_config(with_options(Configuration(), ccds=("all",)))
    default = needed_bytes(experiment())
    assert 0.4 * whole < default < needed_bytes(every) < 1.6 * whole
    larger = needed_bytes(replace(every, atmosphere=replace(every.atmosphere, screen_size=16384)))
    assert larger - needed_bytes(every) > 1.2 * whole
    wave = [needed_bytes(experiment(psf__engine="wave"), threads) for threads in (1, 5)]
    assert default < wave[0] < wave[1]
    # Silicon keeps the intensities of ten more channels, at least, of some 500 x 500 complex numbers.
    deep = needed_bytes(experiment(psf__engine="wave", detector__silicon=True), 5)
    assert deep - wave[1] > 5 * 10 * 500**2 * 8
    # Without an atmosphere there are no screens.
    assert needed_bytes(experiment(atmosphere__enabled=False)) < GB
    # A stamp of 31 x 31 pixels in single precision, at least.
    more = needed_bytes(experiment(stars__truth=1_000_000, atmosphere__enabled=False))
    assert more > 1_000_000 * 61 * 61 * 4


def test_models_of_single_pixels_store_each_star_of_a_catalogue():
    drawn = Experiment.from_config(with_options(Configuration(), ccds=("R22", "R32"), atmosphere__enabled=False))
    stars = {name: np.zeros((3000, 3)) for name in drawn.config.ccds}
    listed = replace(drawn, star_list=StarList("stars.csv", stars, {}))
    # The stamp of a star and its weight in kriging, both in double precision.
    assert needed_bytes(listed) > 18 * 3000 * 16 * drawn.stamp_size**2


def test_what_does_not_fit_names_the_key_and_what_would(monkeypatch):
    large = Experiment.from_config(with_options(Configuration(), ccds=("all",), atmosphere__screen_size=65536))
    monkeypatch.setattr(run_memory, "available_bytes", lambda: 21 * GB)
    with pytest.raises(ConfigError) as caught:
        check_memory(large)
    expected = r"atmosphere.screen_size = 65536: needs about \d\d GB of memory, 21 GB are free; 32768 would do with "
    assert re.match(expected + r"[\d.]+ GB$", str(caught.value))
    check_memory(replace(large, atmosphere=replace(large.atmosphere, screen_size=32768)))
    monkeypatch.setattr(run_memory, "available_bytes", lambda: None)
    check_memory(large)
    monkeypatch.setattr(run_memory, "available_bytes", lambda: 2 * GB)
    with pytest.raises(ConfigError, match=r"^stars.truth = 1000000, stars.observed = 40: needs about \d+ GB of"):
        check_memory(experiment(stars__truth=1_000_000))


def test_a_run_that_does_not_fit_leaves_nothing_and_a_finished_one_is_reported_again(
    monkeypatch, capsys, tmp_path, tiny, finished_run
):
    monkeypatch.setattr(run_memory, "available_bytes", lambda: 1000)
    folder = tmp_path / "out"
    assert main(["run", str(finished_run / "config.yaml"), "--out", str(folder)]) == 2
    err = capsys.readouterr().err
    assert err.startswith("pachon: error: stars.truth = 14, stars.observed = 12: needs about ")
    assert err.count("\n") == 1
    assert not folder.exists()
    monkeypatch.setattr("pachon.pipeline.report.pictures.draw_pictures", lambda *_: [])
    monkeypatch.setattr(run_module, "build_report", lambda *_: "")
    shutil.copytree(finished_run, folder)
    assert run_module.run(tiny(), folder, execution=Execution(resume=True)).computed == ()


def test_a_damaged_product_counts_as_one_to_be_computed(monkeypatch, tmp_path, tiny, finished_run):
    folder = tmp_path / "out"
    shutil.copytree(finished_run, folder)
    product = folder / "ccd_R24_S12.fits"
    product.write_bytes(product.read_bytes()[:-2880])
    before = product.read_bytes()
    monkeypatch.setattr(run_memory, "available_bytes", lambda: 1000)
    with pytest.raises(ConfigError, match="needs about"):
        run_module.run(tiny(), folder, execution=Execution(resume=True))
    assert product.read_bytes() == before


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="counts kibibytes, as Linux does")
@pytest.mark.parametrize(
    "options",
    [
        {"atmosphere__screen_size": 4096, "atmosphere__screen_length_m": 650.0},
        {"atmosphere__screen_size": 8192},
        {"atmosphere__screen_size": 4096, "psf__engine": "wave", "atmosphere__time_step_s": 7.5, "stars__truth": 41},
    ],
)
def test_the_estimate_is_near_the_peak_of_a_run(options, tmp_path):
    """Whole runs of one CCD in a process of their own; the report's pictures included."""
    code = (
        "import json, sys; from pathlib import Path; from pachon.pipeline.run import run;"
        "from pachon.core.long_work import Execution;"
        "from pachon.pipeline.config import Configuration, with_options;"
        "options = json.loads(sys.argv[1]);"
        "run(with_options(Configuration(), ccds=('R22_S11',), **options), Path(sys.argv[2]),"
        "execution=Execution(threads=2));"
        # The peak of getrusage would be that of the process that began this one, where that is larger.
        "print(*(1024 * int(line.split()[1]) for line in open('/proc/self/status') if line.startswith('VmHWM')))"
    )
    arguments = [sys.executable, "-c", code, json.dumps(options), str(tmp_path / "out")]
    peak = int(subprocess.run(arguments, capture_output=True, text=True, check=True).stdout)
    # Never less than what is needed, nor so much more that a run that fits is refused.
    assert 1.0 <= np.divide(needed_bytes(experiment(**options), threads=2), peak) < 1.25
