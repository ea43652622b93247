"""Imports point backwards only: the order of LAYERS.

Between files there are no circles either, imports inside functions and for types counted.
"""

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LAYERS = [
    "core",
    "models",
    "raytrace",
    "wavefront",
    "design",
    "sky",
    "sensing",
    "measure",
    "reconstruction",
    "pipeline",
    "imaging",
    "studies",
    "desk",
    "commands",
]
FILES = [path for layer in LAYERS for path in sorted((ROOT / layer).rglob("*.py"))]
#: A longer file holds two subjects.
MOST_LINES = 500


def module_of(path):
    """Dotted name of a file inside the package; that of a folder for its ``__init__.py``."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in FILES}


def statements_of(node):
    """Statements in a node and in its own, which alone import."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.stmt, ast.ExceptHandler, ast.match_case)):
            yield child
            yield from statements_of(child)


@cache
def imports_of(path):
    """Modules of pachon that a file imports, wherever in it."""
    return set(_imports_of(path))


def _imports_of(path):
    package = path.relative_to(ROOT).parent.parts
    for node in statements_of(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level:
            start = package[: len(package) - node.level + 1]
            module = ".".join([*start, *([node.module] if node.module else [])])
            for alias in node.names:
                name = f"{module}.{alias.name}" if module else alias.name
                yield name if name in MODULES else module
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "pachon":
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "pachon")


def test_there_are_files_in_every_layer():
    assert {path.relative_to(ROOT).parts[0] for path in FILES} == set(LAYERS)


@pytest.mark.parametrize("layer", LAYERS)
def test_imports_point_backwards(layer):
    allowed = set(LAYERS[: LAYERS.index(layer) + 1])
    wrong = {
        f"{path.relative_to(ROOT)} imports {name}"
        for path in FILES
        if path.relative_to(ROOT).parts[0] == layer
        for name in imports_of(path)
        if name.split(".")[0] not in allowed
    }
    assert wrong == set()


@pytest.mark.long
def test_there_are_no_circles_between_files():
    graph = {name: {n for n in imports_of(path) if n in MODULES} - {name} for name, path in MODULES.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_files_are_short():
    long = {
        str(path.relative_to(ROOT)): n
        for path in FILES
        if (n := len(path.read_text("utf-8").splitlines())) > MOST_LINES
    }
    assert long == {}


def test_models_import_no_warp():
    for path in FILES:
        if path.relative_to(ROOT).parts[0] == "models":
            tree = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            names = [a.name for n in tree if isinstance(n, ast.Import) for a in n.names]
            assert not any(name.split(".")[0] == "warp" for name in names), path
