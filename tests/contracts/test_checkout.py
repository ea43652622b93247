"""A checkout imports from its own root, and what is installed is complete."""

import os
import shutil
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SETUPTOOLS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
#: Folder of each package that stands at the top level.
TOP = {name: ROOT / folder for name, folder in SETUPTOOLS["package-dir"].items()}


@pytest.fixture
def checkout(tmp_path):
    """A copy of the folders of the package, as a clone has them."""
    for folder in TOP.values():
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


def package_of(path):
    """Name of the package that a file belongs to."""
    name, folder = next((n, f) for n, f in TOP.items() if f in path.parents)
    return ".".join([name, *path.parent.relative_to(folder).parts])


def test_every_data_file_is_installed():
    left_out = []
    for folder in TOP.values():
        for path in folder.rglob("*"):
            if path.is_dir() or path.suffix in (".py", ".pyc"):
                continue
            # Data lie in a package or in a folder below it.
            package, name = package_of(path), path.name
            while package not in SETUPTOOLS["packages"]:
                package, _, parent = package.rpartition(".")
                name = f"{parent}/{name}"
            if not any(fnmatch(name, pattern) for pattern in SETUPTOOLS["package-data"].get(package, [])):
                left_out.append(str(path.relative_to(ROOT)))
    assert left_out == []
