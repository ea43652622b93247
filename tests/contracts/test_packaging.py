"""Files beside the package: citation and version agree, workflows are valid YAML."""

import re
import tomllib
from pathlib import Path

import yaml

from pachon.core.version import VERSION

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_citation_project_and_package_agree():
    assert PROJECT["project"]["version"] == VERSION
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert str(citation["version"]) == PROJECT["project"]["version"]
    assert citation["license"] == PROJECT["project"]["license"]
    assert citation["references"][0]["doi"] in (ROOT / "README.md").read_text(encoding="utf-8")


def test_workflows_run_what_is_there():
    for path in (ROOT / ".github" / "workflows").glob("*.yml"):
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        steps = [step for job in content["jobs"].values() for step in job["steps"]]
        assert steps
        for command in (step["run"] for step in steps if step.get("run", "").startswith((".ci/", "pytest"))):
            target = command.split()[-1] if command.startswith("pytest") else command
            assert (ROOT / target).exists(), command
    read_the_docs = yaml.safe_load((ROOT / ".readthedocs.yaml").read_text(encoding="utf-8"))
    assert (ROOT / read_the_docs["sphinx"]["configuration"]).is_file()


def test_the_install_page_lists_the_extras():
    page = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    table = page[page.index("## Extras") : page.index("## Without a network")]
    rows = re.findall(r"^\| (`.+?) \|", table, flags=re.M)[1:]
    listed = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert listed == set(PROJECT["project"]["optional-dependencies"])
