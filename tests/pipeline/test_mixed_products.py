"""Products of two telescopes or two configurations never come into one folder."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import yaml

from pachon.core import long_work
from pachon.core.errors import ConfigError, ProductError
from pachon.core.files import _owning_process, make_folder, write_new_bytes
from pachon.core.long_work import Execution, JobResult
from pachon.core.workers import Workers
from pachon.imaging import simulate
from pachon.imaging.config import ImagesConfig
from pachon.models.io.grid_file import write_grid
from pachon.models.io.prescription import load_telescope, prescription_digest, save_telescope
from pachon.models.shapes.grid import GridSag
from pachon.pipeline.config import Configuration, load_configuration
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.run_folder import claim_run
from pachon.studies.sweep.file import load_sweep
from pachon.studies.sweep.store import PointResult, SweepStore, create_store
from pachon.studies.sweep.sweep import run_sweep
from pachon.studies.visits import visits
from pachon.studies.visits.config import VisitsConfig
from pachon.studies.visits.image_stack import stack_images
from pachon.studies.visits.image_stack.config import ImageStackConfig


def _grid(path, height):
    nodes = np.linspace(-6.0, 6.0, 5)
    write_grid(GridSag(nodes, nodes, np.full((5, 5), height)), path)


@pytest.fixture
def configuration(tmp_path):
    """Configuration of a telescope that names a FITS file."""
    _grid(tmp_path / "grid.fits", 0.0)
    telescope = load_telescope("lsst_v3.3_r")
    save_telescope(replace(telescope, description="grid.fits"), tmp_path / "mine.yaml")
    path = tmp_path / "run.yaml"
    path.write_text("telescope: mine.yaml\nccds: [R22_S11]\n")
    return path


def test_the_hash_of_a_run_is_of_the_files_that_its_prescription_names(configuration):
    folder = configuration.parent

    def hashed():
        return Experiment.from_config(load_configuration(configuration), folder).config_hash

    before, content = hashed(), (folder / "grid.fits").read_bytes()
    _grid(folder / "grid.fits", 1e-6)
    assert hashed() != before
    (folder / "grid.fits").write_bytes(content)
    assert hashed() == before
    (folder / "grid.fits").unlink()
    assert hashed() != before


def test_a_catalogue_beside_a_lens_file_counts(tmp_path):
    (tmp_path / "lens.zmx").write_text("VERS\n")
    before = prescription_digest(tmp_path / "lens.zmx")
    (tmp_path / "lens.agf").write_text("CC\n")
    assert prescription_digest(tmp_path / "lens.zmx") != before


@pytest.mark.parametrize("edited", ["mine.yaml", "grid.fits"])
def test_a_sweep_stops_where_its_telescope_is_edited(configuration, edited):
    folder = configuration.parent
    path = folder / "sweep.yaml"
    path.write_text("base: run.yaml\nparameters: {M2.dz_um: {values: [0, 1, 2]}}\ndesign: {kind: grid}\n")
    sweep = load_sweep(path)

    def results(jobs):
        for job in jobs:
            if job.number == 1:
                with open(folder / edited, "ab") as file:
                    file.write(b"\n")
            yield JobResult(job.number, PointResult(job.content.number, {"fwhm": 1.0}, None, 0.0, "here"))

    with pytest.raises(ConfigError, match="other file contents") as caught:
        run_sweep(
            sweep, folder / "s.db", folder=folder, execution=Execution(workers=lambda _: Workers("these", 1, results))
        )
    assert "\n" not in str(caught.value)
    with SweepStore(folder / "s.db") as store:
        assert store.finished() == {0}


@pytest.mark.parametrize("links", [True, False])
def test_a_new_file_is_written_once_and_whole(tmp_path, links, monkeypatch):
    if not links:
        # As on a file system without hard links.
        monkeypatch.setattr(os, "link", lambda *_: (_ for _ in ()).throw(PermissionError(1, "no links")))
    assert write_new_bytes(tmp_path / "config.yaml", b"first")
    assert not write_new_bytes(tmp_path / "config.yaml", b"other")
    assert (tmp_path / "config.yaml").read_bytes() == b"first"
    assert [p.name for p in tmp_path.iterdir()] == ["config.yaml"]


def _run(folder, seed, configuration):
    config = load_configuration(configuration).model_copy(update={"seed": seed})
    claim_run(folder, Experiment.from_config(config, configuration.parent), resume=False)


def _images(folder, seed, _):
    simulate.claim_images(folder, ImagesConfig(run=Configuration(seed=seed)), resume=False)


def _visits(folder, seed, _):
    visits.claim_visits(folder, VisitsConfig(run=Configuration(seed=seed)), resume=False)


def _stacked_images(folder, seed, _):
    stack_images.claim_stack(folder, ImageStackConfig(tiles=seed), resume=False)


CLAIMS = {"config.yaml": _run, "images.yaml": _images, "visits": _visits, "stack-images": _stacked_images}


@pytest.mark.parametrize("claim", CLAIMS.values(), ids=CLAIMS)
def test_a_run_that_comes_second_in_a_new_folder_is_refused(tmp_path, configuration, monkeypatch, claim):
    folder = tmp_path / "out"
    # The first run writes its configuration after the second has found none.
    real = long_work.write_new_bytes

    def late(path, content):
        monkeypatch.setattr(long_work, "write_new_bytes", real)
        claim(folder, 1, configuration)
        return real(path, content)

    monkeypatch.setattr(long_work, "write_new_bytes", late)
    with pytest.raises(ProductError, match=r"another configuration|holds visits already|holds images already"):
        claim(folder, 2, configuration)
    [written] = folder.iterdir()
    content = yaml.safe_load(written.read_text())
    assert 1 in (content.get("seed"), content.get("tiles"), content.get("run", {}).get("seed"))


def test_a_sweep_that_comes_second_is_refused(tmp_path, configuration, monkeypatch):
    path = configuration.parent / "sweep.yaml"
    path.write_text("base: run.yaml\nparameters: {M2.dz_um: {values: [0, 1]}}\ndesign: {kind: grid}\n")
    sweep, out = load_sweep(path), tmp_path / "s.db"
    create_store(out, sweep, [], {"folder": "first"})
    with pytest.raises(ConfigError, match="exists: go on with it by --resume"):
        create_store(out, sweep, [], {"folder": "second"})
    with SweepStore(out) as store:
        assert store.about["folder"] == "first"
    assert not [p for p in tmp_path.iterdir() if "partial" in p.name]


def test_products_without_their_configuration_are_refused(tmp_path):
    (tmp_path / "image_R22_S11.fits").write_bytes(b"")
    with pytest.raises(ProductError, match=r"holds image_R22_S11.fits but no images.yaml"):
        _images(tmp_path, 1, None)


def test_temporary_files_of_live_processes_and_other_machines_stay(tmp_path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    owners = {
        "live": _owning_process(os.getpid()),
        "ended": _owning_process(ended.pid),
        "elsewhere": f"another-machine-{ended.pid}",
    }
    for owner in owners.values():
        (tmp_path / f".ccd.fits.{owner}.partial").write_bytes(b"")
    make_folder(tmp_path)
    assert {n for n, owner in owners.items() if (tmp_path / f".ccd.fits.{owner}.partial").exists()} == {
        "live",
        "elsewhere",
    }
