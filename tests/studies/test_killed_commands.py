"""Commands killed with -9 at random instants and resumed: the same bytes as of one that ran to its end."""

import multiprocessing
import os
import sqlite3
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from drivers import children, killed_again_and_again, seconds_that_children_outlive, start, wait_for, workers

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="needs a server of forks")]

ROOT = Path(__file__).parents[2]
#: Kills of each command.
KILLS = int(os.environ.get("PACHON_KILLS", "50"))
RUN = {
    "ccds": ["R22_S11", "R24_S12", "R22_S01"],
    "wavelengths_nm": [560.0, 680.0],
    "stars": {"truth": 14, "observed": 12},
    "atmosphere": {"screen_size": 1024, "screen_length_m": 560.0, "exposure_s": 2.0, "time_step_s": 0.5},
    "psf": {"n_pupil": 60},
    "reconstruction": {"components": 4, "order": 1, "truth_order": 2},
}
SWEEP = {
    "name": "small",
    "base": {
        "ccds": ["R22_S11"],
        "wavelengths_nm": [624],
        "stars": {"truth": 12},
        "psf": {"engine": "long_exposure"},
        "reconstruction": {"components": 5, "truth_order": 2},
    },
    "parameters": {"M2.dz_um": {"nominal": 0, "range": [-10, 10]}},
    "design": {"kind": "latin_hypercube", "points": 12},
    "metrics": ["fwhm", "rms_e"],
}
TOLERANCES = {
    "surfaces": {"radius_percent": 0.2},
    "tolerances": [{"name": "S1.dz_um", "size": 10}],
    "compensators": ["Image.dz_um"],
    "draws": 60,
    "rings": 3,
}
COMMANDS = {
    "run": (RUN, ["run", "{file}", "--out", "{out}", "--threads", "2", "--quiet"]),
    "sweep": (SWEEP, ["sweep", "{file}", "--out", "{out}.sweep", "--processes", "1", "--quiet"]),
    "tolerance": (
        TOLERANCES,
        ["tolerance", str(ROOT / "tests/data/zmx/lens1.zmx"), "{file}", "--out", "{out}", "--quiet"],
    ),
}


def call(arguments):
    """Run a command in a process of its own."""
    from pachon.commands.cli import main

    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os._exit(main(arguments))


def content(place):
    """Return the bytes of all files that a command leaves; of a store its figures, of which the order is free."""
    found = {}
    files = sorted(place.parent.glob(f"{place.name}*")) if not place.is_dir() else sorted(place.rglob("*"))
    for path in files:
        if not path.is_file() or path.name == "timings.json":
            continue
        data = path.read_bytes()
        if data[:15] == b"SQLite format 3":
            with sqlite3.connect(path) as connection:
                data = connection.execute("SELECT number, metrics, problem FROM results ORDER BY number").fetchall()
            connection.close()
        found[path.name.replace(place.name, "")] = data
    return found


@pytest.fixture(scope="module")
def forks():
    """Processes that have imported what the commands need, so that kills fall into the work."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["pachon.commands.cli", "pachon.pipeline.run", "pachon.studies.sweep.sweep"])
    return context


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_that_is_killed_again_and_again_leaves_the_same_bytes(name, forks, tmp_path):
    settings, command = COMMANDS[name]
    (tmp_path / "file.yaml").write_text(yaml.safe_dump(settings))

    def begin(out):
        exists = out.exists() or out.with_name(f"{out.name}.sweep").exists()
        words = [word.format(file=tmp_path / "file.yaml", out=out) for word in command]
        process = forks.Process(target=call, args=([*words, *(["--resume"] if exists else [])],))
        process.start()
        return process

    ended, seconds = killed_again_and_again(begin, content, tmp_path, KILLS)
    print(f"{name}: {KILLS} kills, {ended} commands resumed to their end, {seconds:.1f} s without kills")


#: Ways of a command to have processes of its own: workers, or the process that draws half of the report.
DRIVERS = {
    "run": ("run", ["--processes", "2"]),
    "run alone": ("run", ["--threads", "2"]),
    "sweep": ("sweep", ["--processes", "2"]),
    "tolerance": ("tolerance", ["--processes", "2"]),
}


@pytest.mark.parametrize("kind", DRIVERS)
def test_processes_end_with_the_driver_that_is_killed(kind, tmp_path):
    name, options = DRIVERS[kind]
    settings, command = COMMANDS[name]
    (tmp_path / "file.yaml").write_text(yaml.safe_dump(settings))
    words = [word.format(file="file.yaml") for word in command[: command.index("--out")]]
    began = children if "--threads" in options else workers
    rng = np.random.default_rng(5)
    for turn in range(5):
        driver = start(tmp_path, *words, "--out", f"turn{turn}.sweep", *options)
        wait_for(lambda driver=driver: began(driver), driver)
        time.sleep(rng.uniform(0.0, 1.0))
        assert seconds_that_children_outlive(driver) < 2.0
