"""Examples import public names alone; benchmarks, which time internals too, take public names from their place."""

import ast
import inspect
import re
from pathlib import Path

import pytest
from public_names import public_names

ROOT = Path(__file__).parents[2]
PUBLIC = set(public_names()) | {"pachon.galsim.PachonOptics", "pachon.galsim.galsim_wcs", "pachon.galsim.psf_object"}
PACKAGES = {name.rpartition(".")[0] for name in PUBLIC} | {"pachon.galsim"}
#: Place of each public object, by where it is defined.
PLACES = {
    (value.__module__, name.rpartition(".")[2]): name
    for name, value in public_names().items()
    if inspect.isclass(value) or inspect.isfunction(value)
}
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BENCHMARKS = sorted((ROOT / "benchmarks").rglob("*.py"))
#: Blocks of Python, fenced or, where they import, indented.
BLOCK = re.compile(r"```python\n(.*?)```", flags=re.S)
IMPORT = re.compile(r"^ *((?:from pachon|import pachon)\b.*)$", flags=re.M)


def names_of(tree):
    """Full names of pachon that a syntax tree imports, or reads as attributes of the module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "pachon":
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("pachon."))
        elif isinstance(node, ast.Attribute):
            name = ast.unparse(node)
            if name.startswith("pachon.") and re.fullmatch(r"[\w.]+", name):
                yield name


def is_public(name):
    """Whether a dotted name is a public package, a public name or an attribute of one."""
    parts = name.split(".")
    prefixes = {".".join(parts[:count]) for count in range(1, len(parts) + 1)}
    return name in PACKAGES or name == "pachon.__version__" or not PUBLIC.isdisjoint(prefixes)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_pages_import_public_names_alone(path):
    text = path.read_text(encoding="utf-8")
    sources = BLOCK.findall(text) + IMPORT.findall(BLOCK.sub("", text))
    names = {name for source in sources for name in names_of(ast.parse(source))}
    assert {name for name in names if not is_public(name)} == set()


def test_examples_of_galsim_name_public_types():
    text = (ROOT / "docs" / "examples" / "galsim_lsst_ccd.yaml").read_text(encoding="utf-8")
    named = set(re.findall(r"\bpachon\.[\w.]+", text))
    assert named
    assert {name for name in named if not is_public(name.rstrip("."))} == set()


@pytest.mark.parametrize("path", BENCHMARKS, ids=lambda path: path.stem)
def test_benchmarks_take_public_names_from_their_public_place(path):
    names = set(names_of(ast.parse(path.read_text(encoding="utf-8"))))
    private = {tuple(name.rpartition(".")[::2]) for name in names if not is_public(name)}
    assert {f"{'.'.join(place)}: {PLACES[place]}" for place in private if place in PLACES} == set()


@pytest.mark.parametrize("path", BENCHMARKS, ids=lambda path: path.stem)
def test_benchmarks_explain_themselves_on_help(path):
    """Fourteen took --help for a number or a folder, and ended in a traceback, or began to compute."""
    text = path.read_text(encoding="utf-8")
    shared = any(f"from {path.stem} import" in other.read_text(encoding="utf-8") for other in BENCHMARKS)
    assert shared or "ArgumentParser(" in text
    assert "sys.argv" not in text
