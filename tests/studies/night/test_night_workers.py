"""Nights by processes and by a cluster, one of which is killed."""

import pytest
from drivers import kill_a_worker, start, wait_for
from visit_rows import COLUMNS, ROWS

from pachon.commands.cli import main
from pachon.studies.night.night import run_night

pytestmark = pytest.mark.slow


def content(folder):
    # Pictures of the report have fewer dots an inch in the process of the tests; a killed worker may leave a part of a
    # file, whose name is hidden.
    paths = [path for path in sorted(folder.rglob("[!.]*")) if path.is_file() and path.name != "report.html"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@pytest.fixture
def night_and_content(night_config, tmp_path):
    """File of a night of five visits, and what one process leaves of it."""
    config = night_config()
    path = tmp_path / "visits.csv"
    path.write_text("\n".join([",".join(COLUMNS), *(",".join(map(str, row)) for row in ROWS)]) + "\n")
    config = config.model_copy(update={"visits": config.visits.model_copy(update={"list": str(path)})})
    (tmp_path / "night.yaml").write_text(config.to_yaml())
    run_night(config, tmp_path / "one")
    return tmp_path / "night.yaml", content(tmp_path / "one")


def first_visit(folder):
    return lambda: any((folder / "night" / "visits").glob("visit_*.fits"))


def test_processes_of_which_one_is_killed_and_the_night_resumed(night_and_content, tmp_path):
    path, wanted = night_and_content
    driver = start(tmp_path, "visits", "night.yaml", "-o", "night", "--processes", "2")
    wait_for(first_visit(tmp_path), driver)
    kill_a_worker(driver)
    said = driver.communicate()[1]
    # The last visit may have been under way.
    if driver.returncode:
        assert driver.returncode == 2
        assert "a worker process died" in said.strip().splitlines()[-1]
    assert main(["visits", str(path), "-o", str(tmp_path / "night"), "--resume", "--quiet"]) == 0
    assert content(tmp_path / "night") == wanted


def test_a_driver_that_is_killed_leaves_a_night_to_resume(night_and_content, tmp_path):
    path, wanted = night_and_content
    driver = start(tmp_path, "visits", "night.yaml", "-o", "night")
    wait_for(first_visit(tmp_path), driver)
    driver.kill()
    driver.communicate()
    assert main(["visits", str(path), "-o", str(tmp_path / "night"), "--resume", "--quiet"]) == 0
    assert content(tmp_path / "night") == wanted


def test_a_cluster_that_loses_a_worker_leaves_the_same_bytes(night_and_content, tmp_path, cluster):
    _, wanted = night_and_content
    driver = start(tmp_path, "visits", "night.yaml", "-o", "night", "--scheduler", cluster["address"])
    wait_for(first_visit(tmp_path), driver)
    cluster["workers"][0].kill()
    said = driver.communicate()[1]
    assert driver.returncode == 0, said
    assert content(tmp_path / "night") == wanted


def test_parts_of_processes_of_their_own(night_and_content, tmp_path):
    _, wanted = night_and_content
    drivers = [start(tmp_path, "visits", "night.yaml", "-o", "night", "--part", f"{i}/2") for i in (1, 2)]
    for driver in drivers:
        said = driver.communicate()[1]
        assert driver.returncode == 0, said
    assert content(tmp_path / "night") == wanted
