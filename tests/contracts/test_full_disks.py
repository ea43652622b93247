"""Work on a disk that is full at some byte: one line, exit status 2, nothing that was computed is lost, no half file.

``pytest -s -m slow tests/contracts/test_full_disks.py``: every disk is a small file system in memory, in a namespace
of its own, which needs no rights where the system lets users have such namespaces.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from small_work import WORK, content

#: Disks of each, as fractions of what the work writes.
ROOMS = (0.05, 0.5, 0.95)
#: Room of a disk for all of it [kB].
AMPLE = 1_000_000
NAMES = ("run", "null-test", "stack-images", "model", "donuts", "optimize", "sweep", "tolerance", "measure", "shim",
         "align", "reproduce", "fit_static_heights")  # fmt: skip


def namespaces():
    """Return whether this user may have file systems of its own."""
    if shutil.which("unshare") is None or shutil.which("mount") is None:
        return False
    return subprocess.run(["unshare", "-rm", "true"], capture_output=True, check=False).returncode == 0


def mount(disk, kilobytes, *options):
    where = ["mount", "-t", "tmpfs", "-o", ",".join([*options, f"size={kilobytes}k"]), "tmpfs", str(disk)]
    subprocess.run(where, check=True)


def kilobytes(folder):
    """Return the room that the files of a folder take on a file system in memory."""
    return sum(4 * -(-path.stat().st_size // 4096) for path in folder.rglob("*") if path.is_file())


def outcome(work, here, out, resume, said):
    """Do work in a fork; return its exit status and what it said on standard error."""
    process = os.fork()
    if not process:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
        try:
            status = work.run(here, out, resume)
        except BaseException:
            import traceback

            traceback.print_exc()
            status = 1
        os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), said.read_text()


def fill(name, here, disk, said):
    """Do work on disks of several sizes, in a namespace of its own; return what came of each."""
    work, out = WORK[name], disk / "out"
    mount(disk, AMPLE)
    work.begin(here, out)
    before, inputs = kilobytes(out) if out.exists() else 0, content(out) if out.exists() else {}
    assert outcome(work, here, out, False, said) == (0, ""), said.read_text()
    expected, written = content(out), kilobytes(out) - before
    results = []
    for room in ROOMS:
        subprocess.run(["umount", str(disk)], check=True)
        mount(disk, before + max(8, int(room * written)))
        work.begin(here, out)
        status, text = outcome(work, here, out, False, said)
        files = [path for path in out.rglob("*") if path.is_file()] if out.exists() else []
        # Where the work goes on, sums and stores are on their way.
        half = [
            str(path.relative_to(out)) for path in files
            if not work.resumes and path.read_bytes() != (expected | inputs).get(str(path.relative_to(out)))
        ]  # fmt: skip
        kept = {path: path.stat().st_mtime_ns for path in (out.glob(work.products) if work.products else ())}
        mount(disk, AMPLE, "remount")
        again, _ = outcome(work, here, out, out.exists(), said)
        lost = [path.name for path, time in kept.items() if path.stat().st_mtime_ns != time]
        results.append({
            "room": room, "status": status, "text": text, "half": half, "kept": len(kept), "lost": lost,
            "temporary": [path.name for path in files if path.name.endswith(".partial")],
            "again": again, "same": content(out) == expected,
        })  # fmt: skip
    return results


@pytest.mark.slow
@pytest.mark.skipif(not namespaces(), reason="needs namespaces of users")
@pytest.mark.parametrize("name", NAMES)
def test_work_on_a_full_disk(name, tmp_path):
    here, disk, answer = tmp_path / "here", tmp_path / "disk", tmp_path / "answer.json"
    here.mkdir()
    disk.mkdir()
    command = [sys.executable, __file__, name, str(here), str(disk), str(answer)]
    places = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    environment = {**os.environ, "PYTHONPATH": places}
    done = subprocess.run(["unshare", "-rm", *command], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    results = json.loads(answer.read_text())
    for result in results:
        lines = result["text"].splitlines()
        print(name, result["room"], result["status"], lines, f"{result['kept']} kept")
        assert result["status"] == 2
        assert len(lines) == 1
        assert lines[0].startswith("pachon: error: ")
        # Stacks and stores know beforehand what they need.
        assert any(words in lines[0] for words in ("No space left on device", "disk is full", "MB are free"))
        assert not result["half"]
        assert not result["temporary"]
        assert not result["lost"]
        assert (result["again"], result["same"]) == (0, True)


if __name__ == "__main__":
    work_name, here_text, disk_text, answer_text = sys.argv[1:]
    WORK[work_name].make(Path(here_text))
    found = fill(work_name, Path(here_text), Path(disk_text), Path(here_text) / "said.txt")
    Path(answer_text).write_text(json.dumps(found))
