"""Files beside the package: citation and version agree, workflows are valid YAML."""

import re
import runpy
import subprocess
import tarfile
import tomllib
import zipfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
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
            target = command.split()[-1] if command.startswith("pytest") else command.split()[0]
            assert (ROOT / target).exists(), command
    read_the_docs = yaml.safe_load((ROOT / ".readthedocs.yaml").read_text(encoding="utf-8"))
    assert (ROOT / read_the_docs["sphinx"]["configuration"]).is_file()


def test_the_install_page_lists_the_extras():
    page = (ROOT / "docs" / "howto" / "install.md").read_text(encoding="utf-8")
    extras = page[page.index("## Extras") : page.index("## Without a network")]
    rows = re.findall(r"^- (`.+?):", extras, flags=re.M)
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
        ("astropy", "7.2"),  # before, no import of pachon with NumPy 2.4: np.in1d is gone
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


def test_both_ends_of_the_dependencies_are_tested_by_the_documented_script():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    script = (ROOT / ".ci" / "versions").read_text(encoding="utf-8")
    job = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8"))["jobs"]["versions"]
    pythons = {ends["versions"]: ends["python"] for ends in job["strategy"]["matrix"]["include"]}
    newest = max((c.rpartition(" ")[2] for c in PROJECT["project"]["classifiers"] if ":: 3." in c), key=Version)
    assert pythons == {"lowest": PROJECT["project"]["requires-python"].removeprefix(">="), "newest": newest}
    for end, resolution in (("lowest", "lowest-direct"), ("newest", "highest")):
        assert f"    .ci/versions {end}" in page
        assert f"{end}) python=python{pythons[end]} resolution={resolution} " in script
    assert ".ci/versions ${{ matrix.versions }}" in [step.get("run") for step in job["steps"]]
    assert subprocess.run([ROOT / ".ci" / "versions", "oldest"], capture_output=True).returncode == 2


def test_archives_that_lack_a_file_or_have_one_too_many_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    check = runpy.run_path(str(ROOT / ".ci" / "check_archives.py"))
    tracked, info = ["core/version.py", "pachon/__init__.py", "tests/x.py", "docs/images/big.png"], "pachon-1.dist-info"
    whole = ["pachon/core/version.py", "pachon/__init__.py"]
    whole += [f"{info}/{name}" for name in ("METADATA", "RECORD", "entry_points.txt", "licenses/LICENSE")]
    for names, problems in (
        (whole, []),
        (whole[1:], ["lacks pachon/core/version.py"]),
        (whole[:-1], ["lacks licenses/LICENSE of its metadata"]),
        ([*whole, "pachon/tests/x.py"], ["has pachon/tests/x.py, which is not tracked"]),
    ):
        with zipfile.ZipFile(tmp_path / "a.whl", "w") as wheel:
            for name in names:
                wheel.writestr(name, "")
        assert check["wheel_problems"](tmp_path / "a.whl", tracked) == [f"a.whl: {p}" for p in problems]
    (tmp_path / "noise").write_bytes(np.random.default_rng(1).bytes(5_100_000))
    for names, problems in (
        (["a"], ["a.tar.gz: lacks b"]),
        (["a", "b", "c"], ["a.tar.gz: has c, which is not tracked"]),
    ):
        with tarfile.open(tmp_path / "a.tar.gz", "w:gz", compresslevel=1) as source:
            for name in names:
                source.addfile(tarfile.TarInfo(f"pachon-1/{name}"))
        assert check["source_problems"](tmp_path / "a.tar.gz", ["a", "b", "docs/images/big.png"]) == problems
    with tarfile.open(tmp_path / "a.tar.gz", "w:gz", compresslevel=1) as source:
        source.add(tmp_path / "noise", "pachon-1/a")
    assert "expected at most 5000000" in check["source_problems"](tmp_path / "a.tar.gz", ["a"])[0]


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
    script = (ROOT / ".ci" / "archives").read_text(encoding="utf-8")
    assert "run: .ci/archives" in workflow
    for step in (
        "--require-hashes -r .github/requirements/build.txt",
        "build --no-isolation",
        "twine",
        "check_archives",
    ):
        assert step in script


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


def test_the_newest_section_of_the_changelog_is_that_of_the_version():
    headings = re.findall(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.M)
    assert re.fullmatch(r"\[" + re.escape(VERSION) + r"\] - (unreleased|\d{4}-\d{2}-\d{2})", headings[0])
