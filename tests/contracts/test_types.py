"""The type checker passes on the package, and refuses words that a call does not know."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

pytest.importorskip("mypy")

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_mypy(tmp_path):
    # The folders stand at the top level and become one package only when installed. mypy cannot follow
    # the path that `pachon` adds in a checkout.
    package = tmp_path / "pachon"
    package.mkdir()
    for entry in (ROOT / "pachon").iterdir():
        if entry.name != "__pycache__":
            (package / entry.name).symlink_to(entry)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    sources = project["tool"]["hatch"]["build"]["targets"]["wheel"]["sources"]
    for layer in sources:
        (package / layer).symlink_to(ROOT / layer, target_is_directory=True)
    # Its comments silence the errors of wrong words; one that silences nothing is an error.
    (tmp_path / "words.py").symlink_to(Path(__file__).parent / "typed" / "words.py")
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--config-file",
        str(ROOT / "pyproject.toml"),
        "-p",
        "pachon",
        "-m",
        "words",
    ]
    done = subprocess.run(
        [*command, "--cache-dir", str(tmp_path / "cache")], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
