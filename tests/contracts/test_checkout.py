"""A checkout imports from its own root, and what is installed is complete."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder

ROOT = Path(__file__).parents[2]
BUILD = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]
#: Folders of the package that stand at the top level.
TOP = [ROOT / name for name in BUILD["targets"]["wheel"]["only-include"]]


@pytest.fixture
def checkout(tmp_path):
    """A copy of the folders of the package, as a clone has them."""
    for folder in TOP:
        shutil.copytree(folder, tmp_path / folder.name, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


@pytest.mark.long
def test_a_checkout_imports_from_its_root(checkout):
    # The metadata of the distribution are those of the installed pachon; all code is that of the copy.
    code = (
        "import pachon, sys; print(pachon.load_telescope('hsc').name, pachon.__version__);"
        "print(*(m.__file__ for n, m in sys.modules.items() if n.split('.')[0] == 'pachon'), sep='\\n')"
    )
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=checkout, env=environment, capture_output=True, text=True, check=True
    )
    first, *files = done.stdout.splitlines()
    assert first.split()[0] == "hsc"
    assert {Path(file).relative_to(checkout).parts[0] for file in files} >= {"pachon", "core", "models"}


def test_every_file_is_installed():
    built = {file.relative_path: file.distribution_path for file in WheelBuilder(str(ROOT)).recurse_included_files()}
    product = [
        path.relative_to(ROOT).as_posix()
        for folder in TOP
        for path in folder.rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    ]
    assert len(product) > 500
    expected = {path: path if path.startswith("pachon/") else f"pachon/{path}" for path in product}
    assert built == expected


def test_the_source_archive_is_whole():
    archived = {file.relative_path for file in SdistBuilder(str(ROOT)).recurse_included_files()}
    for folder in ("tests", "docs", "benchmarks", ".ci", ".github", "commands"):
        assert any(path.startswith(f"{folder}/") for path in archived), folder
    assert archived >= {"CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", ".readthedocs.yaml"}
    assert not any(path.startswith(("docs/_build", ".venv")) or path.endswith(".pyc") for path in archived)
