"""Visits by processes and by a cluster, one of which is killed."""

import pytest
from drivers import kill_a_worker, seconds_that_children_outlive, start, wait_for, workers

from pachon.commands.cli import main
from pachon.studies.visits.visits import SUMS_NAME, stack_visits

pytestmark = pytest.mark.slow


def content(folder):
    # Pictures have fewer dots an inch in the process of the tests.
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.suffix != ".png"}


@pytest.fixture
def settings_and_content(visits_config, tmp_path):
    """File of a configuration of six visits, and what one process leaves of it."""
    config = visits_config(count=6)
    path = tmp_path / "visits.yaml"
    path.write_text(config.to_yaml())
    stack_visits(config, tmp_path / "one")
    return path, content(tmp_path / "one")


def start_visits(folder, *options):
    return start(folder, "visits", "visits.yaml", "-o", "visits", *options)


def test_processes_of_which_one_is_killed_and_visits_resumed(settings_and_content, tmp_path):
    path, wanted = settings_and_content
    driver = start_visits(tmp_path, "--processes", "2")
    wait_for((tmp_path / "visits" / SUMS_NAME).exists, driver)
    kill_a_worker(driver)
    said = driver.communicate()[1]
    assert driver.returncode == 2
    assert "a worker process died" in said.strip().splitlines()[-1]
    assert main(["visits", str(path), "-o", str(tmp_path / "visits"), "--resume", "--quiet"]) == 0
    assert content(tmp_path / "visits") == wanted


def test_workers_end_with_their_driver(settings_and_content, tmp_path):
    driver = start_visits(tmp_path, "--processes", "2")
    wait_for(lambda: len(workers(driver)) == 2, driver)
    assert seconds_that_children_outlive(driver) < 2.0


def test_a_cluster_that_loses_a_worker_leaves_the_same_bytes(settings_and_content, tmp_path, cluster):
    _, wanted = settings_and_content
    driver = start_visits(tmp_path, "--scheduler", cluster["address"])
    wait_for((tmp_path / "visits" / SUMS_NAME).exists, driver)
    cluster["workers"][0].kill()
    said = driver.communicate()[1]
    assert driver.returncode == 0, said
    assert content(tmp_path / "visits") == wanted
