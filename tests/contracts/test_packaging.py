"""Files beside the package: citation and version agree, workflows are valid YAML."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.version import Version

from pachon.core.version import VERSION

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
#: Requirements by extra; "" are those of the package itself.
REQUIREMENTS = {
    group: [Requirement(text) for text in texts]
    for group, texts in {
        "build": PROJECT["build-system"]["requires"],
        "": PROJECT["project"]["dependencies"],
        **PROJECT["project"]["optional-dependencies"],
    }.items()
}


def test_citation_project_and_package_agree():
    source = PROJECT["tool"]["hatch"]["version"]
    assert re.findall(source["pattern"], (ROOT / source["path"]).read_text(encoding="utf-8")) == [VERSION]
    assert version("pachon") == VERSION
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert str(citation["version"]) == VERSION
    assert citation["license"] == PROJECT["project"]["license"]
    assert citation["references"][0]["doi"] in (ROOT / "README.md").read_text(encoding="utf-8")


def test_workflows_run_what_is_there():
    for path in (ROOT / ".github" / "workflows").glob("*.yml"):
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        jobs = content["jobs"].values()
        assert all((ROOT / job["uses"]).is_file() for job in jobs if "uses" in job)
        steps = [step for job in jobs for step in job.get("steps", [])]
        assert steps
        for command in (step["run"] for step in steps if step.get("run", "").startswith((".ci/", "pytest"))):
            target = command.split()[-1] if command.startswith("pytest") else command
            assert (ROOT / target).exists(), command
    read_the_docs = yaml.safe_load((ROOT / ".readthedocs.yaml").read_text(encoding="utf-8"))
    assert (ROOT / read_the_docs["sphinx"]["configuration"]).is_file()


def test_the_install_page_lists_the_extras():
    page = (ROOT / "docs" / "howto" / "install.md").read_text(encoding="utf-8")
    table = page[page.index("## Extras") : page.index("## Without a network")]
    rows = re.findall(r"^\| (`.+?) \|", table, flags=re.M)[1:]
    listed = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert listed == set(PROJECT["project"]["optional-dependencies"])


def _bound(requirement):
    """Return the lower bound of a requirement, or None."""
    return next((Version(s.version) for s in requirement.specifier if s.operator == ">="), None)


@pytest.mark.parametrize("group", REQUIREMENTS)
def test_every_dependency_has_a_lower_bound_that_is_installed(group):
    for requirement in REQUIREMENTS[group]:
        bound = _bound(requirement)
        assert bound is not None, requirement
        try:
            installed = Version(version(requirement.name))
        except PackageNotFoundError:
            continue  # of an extra that the tests do not need
        # The build requirement is installed where the package is built.
        assert group == "build" or bound <= installed, requirement


def test_a_dependency_has_one_bound_in_all_extras():
    bounds = {}
    for requirement in (r for requirements in REQUIREMENTS.values() for r in requirements):
        assert bounds.setdefault(requirement.name, _bound(requirement)) == _bound(requirement), requirement


@pytest.mark.parametrize(
    ("name", "lowest"),
    [
        ("numpy", "2.0.1"),  # inverse of np.unique(axis=None) has another shape in 2.0.0
        ("scipy", "1.15"),  # rng of its optimisers and statistics
        ("pydantic", "2.12"),  # load_telescope: TypeError
        ("typer", "0.20"),  # before 0.15.4 prints the version in place of the command, before 0.20 suggests no name
        ("trimesh", "4.6.1"),  # load_scene; corners that are not finite are kept
        ("matplotlib", "3.10"),  # the report fails after all CCDs are done
        ("h5py", "3.11"),  # wheels for NumPy 2
        ("pytest-xdist", "3.8"),  # --no-loadscope-reorder
        ("pyarrow", "16"),  # wheels for NumPy 2
    ],
)
def test_nothing_is_claimed_below_what_was_found_to_work(name, lowest):
    requirements = [r for group in REQUIREMENTS.values() for r in group if r.name == name]
    assert requirements
    assert all(_bound(r) >= Version(lowest) for r in requirements)


def test_the_lowest_versions_are_tested_by_the_documented_commands():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = page[page.index("**Lowest versions.**") :]
    documented = [line.strip() for line in re.findall(r"^ {4}(.+)$", section, flags=re.M)[:3]]
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8"))
    steps = workflow["jobs"]["lowest"]["steps"]
    assert "\n".join(step["run"] for step in steps if "run" in step).splitlines() == documented
    assert any("--resolution lowest-direct" in line for line in documented)
    python = next(step["with"]["python-version"] for step in steps if "python-version" in step.get("with", {}))
    assert PROJECT["project"]["requires-python"] == f">={python}"


def test_releases_are_built_from_pinned_and_hashed_packages():
    lines = (ROOT / ".github" / "requirements" / "build.txt").read_text(encoding="utf-8")
    entries = re.findall(
        r"^([\w.\[\]-]+)==(\S+) \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)", lines, flags=re.M
    )
    pinned = {name: Version(number) for name, number, _ in entries}
    assert len(pinned) == len(re.findall(r"^\w\S*==", lines, flags=re.M))
    asked = (ROOT / ".github" / "requirements" / "build.in").read_text(encoding="utf-8").splitlines()
    assert {line for line in asked if line and not line.startswith("#")} <= set(pinned)
    assert all(pinned[requirement.name] >= _bound(requirement) for requirement in REQUIREMENTS["build"])
    workflow = (ROOT / ".github" / "workflows" / "build.yml").read_text(encoding="utf-8")
    assert "--require-hashes -r .github/requirements/build.txt" in workflow
    assert "build --no-isolation" in workflow


def test_the_recipe_for_conda_asks_for_what_the_package_asks_for():
    recipe = yaml.safe_load((ROOT / "release" / "recipe.yaml").read_text(encoding="utf-8"))
    names = {"matplotlib": "matplotlib-base", "lazy_loader": "lazy-loader"}
    asked = {f"{names.get(r.name, r.name)} {r.specifier}" for r in REQUIREMENTS[""]}
    assert asked == {line for line in recipe["requirements"]["run"] if not line.startswith("python ")}
    assert recipe["context"]["version"] == VERSION


def test_the_source_archive_keeps_the_pictures_of_the_readme():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    kept = {line[1:] for line in PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["exclude"] if line[0] == "!"}
    assert set(re.findall(r"\((docs/images/\S+?)\)", readme)) == kept
