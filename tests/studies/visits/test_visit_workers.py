"""Visits by processes and by a cluster, one of which is killed."""

import os
import signal
import subprocess
import sys
import time

import pytest

from pachon.commands.cli import main
from pachon.studies.visits.visits import SUMS_NAME, stack_visits

pytestmark = pytest.mark.slow


def content(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture
def settings_and_content(visits_config, tmp_path):
    """File of a configuration of six visits, and what one process leaves of it."""
    config = visits_config(count=6)
    path = tmp_path / "visits.yaml"
    path.write_text(config.to_yaml())
    stack_visits(config, tmp_path / "one")
    return path, content(tmp_path / "one")


def start(folder, *options):
    command = [sys.executable, "-m", "pachon", "visits", "visits.yaml", "-o", "visits", *options]
    return subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True,
                            env={**os.environ, "PYTHONPATH": os.getcwd()})  # fmt: skip


def wait_for_sums(folder, driver):
    while not (folder / "visits" / SUMS_NAME).exists():
        assert driver.poll() is None, driver.stderr.read()
        time.sleep(0.02)


def test_processes_of_which_one_is_killed_and_visits_resumed(settings_and_content, tmp_path):
    path, wanted = settings_and_content
    driver = start(tmp_path, "--processes", "2")
    wait_for_sums(tmp_path, driver)
    children = subprocess.run(["pgrep", "-P", str(driver.pid)], capture_output=True, text=True, check=True).stdout
    # The last of the children are the workers; the first may be the resource tracker of multiprocessing.
    os.kill(int(children.split()[-1]), signal.SIGKILL)
    said = driver.communicate()[1]
    assert driver.returncode == 2
    assert "a worker process died" in said.strip().splitlines()[-1]
    assert main(["visits", str(path), "-o", str(tmp_path / "visits"), "--resume", "--quiet"]) == 0
    assert content(tmp_path / "visits") == wanted


def test_a_cluster_that_loses_a_worker_leaves_the_same_bytes(settings_and_content, tmp_path, cluster):
    _, wanted = settings_and_content
    driver = start(tmp_path, "--scheduler", cluster["address"])
    wait_for_sums(tmp_path, driver)
    cluster["workers"][0].kill()
    said = driver.communicate()[1]
    assert driver.returncode == 0, said
    assert content(tmp_path / "visits") == wanted
