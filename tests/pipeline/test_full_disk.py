"""A disk that is full at any write, and places that cannot be written: one line, and nothing of before is lost."""

import errno
import json
import os
import subprocess
import sys

import pytest

from pachon.core import files
from pachon.core.errors import ProductError
from pachon.core.long_work import Execution, claim_folder
from pachon.pipeline.run import run
from pachon.studies.sweep.file import read_sweep
from pachon.studies.sweep.store import PointResult, SweepStore, create_store

SWEEP = read_sweep({"parameters": {"a": {"nominal": 0, "range": [0, 4]}}, "design": {"points": 3}}, "test")


class Disk:
    """Stand-in for flushing to a disk that is full after so many writes."""

    def __init__(self, room):
        self.room, self.writes = room, 0

    def __call__(self, descriptor):
        self.writes += 1
        if self.writes > self.room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def content(folder):
    left_out = ("report.html", "timings.json")
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.name not in left_out}


def test_a_claim_on_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "config.yaml"
    path.write_bytes(b"old")
    monkeypatch.setattr(files.os, "fsync", Disk(0))
    with pytest.raises(ProductError, match="No space left on device"):
        claim_folder(path, b"new", products="*.fits", noun="products", now={}, read=lambda _: {})
    assert content(tmp_path) == {"config.yaml": b"old"}


def test_a_sweep_on_a_full_disk_keeps_its_results(tmp_path):
    path = tmp_path / "s.sweep"
    create_store(path, SWEEP, [], {})
    with SweepStore(path) as store:
        store.write(PointResult(0, {"fwhm": 1.0}, None, 0.1, "here"))
        [(pages,)] = store._connection.execute("PRAGMA page_count").fetchall()
        store._connection.execute(f"PRAGMA max_page_count = {pages}")
        large = PointResult(1, {"fwhm": 1.0}, None, 0.1, "here" * 10**5)
        with pytest.raises(ProductError, match="what was computed before is kept, go on with --resume") as caught:
            store.write(large)
        assert "\n" not in str(caught.value)
    with SweepStore(path) as store:
        assert store.finished() == {0}


@pytest.mark.slow
def test_a_kernel_cache_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    command = ["-m", "pachon", "spots", "paul_baker", "--field-deg", "0", "--rays", "4", "--json", "--no-picture"]
    where = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "file" / "kernels")}
    done = subprocess.run([sys.executable, *command], env=where, capture_output=True, text=True, check=True)
    # The kernels go to a temporary folder, where they are compiled.
    assert json.loads(done.stdout)
    told = [line for line in done.stderr.splitlines() if not line.startswith("compiling ")]
    assert len(told) == 1
    assert told[0].startswith("cannot write compiled kernels to")
    assert "WARP_CACHE_PATH names another folder" in told[0]


@pytest.mark.slow
def test_a_run_goes_on_after_a_disk_that_was_full_at_any_write(tiny, tmp_path, monkeypatch):
    config = tiny(ccds=("R22_S11", "R22_S12"), psf__engine="long_exposure", wavelengths_nm=[620.0])
    run(config, tmp_path / "whole", execution=Execution(threads=1))
    expected = content(tmp_path / "whole")
    disk = Disk(10**9)
    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", disk)
        run(config, tmp_path / "counted", execution=Execution(threads=1))
    # Configuration, two CCDs, summary, heights, report, times.
    assert disk.writes >= 6
    for room in range(disk.writes):
        folder = tmp_path / f"run{room}"
        with monkeypatch.context() as patch:
            patch.setattr(files.os, "fsync", Disk(room))
            with pytest.raises(ProductError, match=r"^cannot write .*: No space left on device$"):
                run(config, folder, execution=Execution(threads=1))
        assert not list(folder.glob(".*.partial"))
        run(config, folder, execution=Execution(threads=1, resume=True))
        assert content(folder) == expected
