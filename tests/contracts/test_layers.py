"""Imports point backwards only: models, raytrace, wavefront, design, pipeline, studies, commands."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LAYERS = ["models", "raytrace", "wavefront", "design", "pipeline", "studies", "commands"]
FILES = [path for layer in LAYERS for path in sorted((ROOT / layer).rglob("*.py"))]


def imported_layers(tree):
    """Names of the sub-packages that a module of one imports from, and the absolute imports of pachon itself."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level == 2:
            names = [node.module.split(".")[0]] if node.module else [alias.name for alias in node.names]
            yield from names
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and (node.module or "").split(".")[0] == "pachon":
            yield "pachon"
        elif isinstance(node, ast.Import):
            yield from ("pachon" for alias in node.names if alias.name.split(".")[0] == "pachon")


def test_there_are_files_in_every_layer():
    assert {path.relative_to(ROOT).parts[0] for path in FILES} == set(LAYERS)


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_backwards(path):
    layer = path.relative_to(ROOT).parts[0]
    allowed = set(LAYERS[: LAYERS.index(layer)])
    found = set(imported_layers(ast.parse(path.read_text(encoding="utf-8"))))
    assert found <= allowed, f"{path.relative_to(ROOT)} imports from {sorted(found - allowed)}"


@pytest.mark.parametrize("path", [p for p in FILES if p.parts[-2] == "models"], ids=lambda p: p.name)
def test_models_know_no_warp(path):
    names = {
        (node.module or "") if isinstance(node, ast.ImportFrom) else alias.name
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, (ast.Import, ast.ImportFrom))
        for alias in node.names
    }
    assert not any(name.split(".")[0] == "warp" for name in names)
