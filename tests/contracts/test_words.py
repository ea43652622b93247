"""Locals are named by what they hold, constants stand one a line, and the architecture page names files that exist."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = [
    path.name for path in ROOT.iterdir() if (path / "__init__.py").is_file() and path.name not in ("tests", "pachon")
]
#: Pronouns, participles and the like, which say nothing of what a local holds.
WORDS = frozenset(
    re.findall(
        r"\w+",
        """found own left known part rest chosen here there some asked told said seen kept given taken made wanted
        missing other others both each every any all none this that these those what which whole much more most few one
        ones again then now new old""",
    )
)
#: Largest share of functions that assign such a local; that of other codebases of the field is 0.002 to 0.01.
LARGEST_SHARE = 0.02


#: A line of a module such as ``A, B = 1.0, 2.0``.
SEVERAL = re.compile(r"^\w+(?:, *\w+)+ *=", re.MULTILINE)


def product_files():
    """Path and text of each file of the product."""
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*.py")):
            yield path, path.read_text(encoding="utf-8")


def functions_of(node):
    """Functions in the statements of a node, and in theirs."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield child
        if isinstance(child, (ast.stmt, ast.ExceptHandler, ast.match_case)):
            yield from functions_of(child)


@pytest.mark.long
def test_locals_are_named_by_what_they_hold():
    functions, pronouns = 0, []
    for path, text in product_files():
        tree = ast.parse(text)
        stored = [(n.lineno, n.id) for n in ast.walk(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)]
        stored = [(line, word) for line, word in stored if word in WORDS]
        for node in functions_of(tree):
            functions += 1
            if words := {word for line, word in stored if node.lineno <= line <= node.end_lineno}:
                pronouns.append(f"{path.relative_to(ROOT)}:{node.lineno} {node.name}: {', '.join(sorted(words))}")
    assert functions > 4000
    assert len(pronouns) <= LARGEST_SHARE * functions, "\n".join(pronouns)


def test_constants_stand_one_a_line():
    """A line such as ``A, B = 1.0, 2.0`` leaves no place for the unit and the reason of each."""
    packed = [
        f"{path.relative_to(ROOT)}:{node.lineno} {value.value}"
        for path, text in product_files()
        if SEVERAL.search(text)
        for node in ast.parse(text).body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)
        for value in node.value.elts
        if isinstance(value, ast.Constant) and isinstance(value.value, (int, float))
    ]
    assert packed == []


@pytest.mark.parametrize("page", ["docs/explanation/architecture.md", "docs/images/architecture.svg"])
def test_files_of_the_architecture_exist(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    named = set(re.findall(r"[a-z_/]+\.py\b", text))
    assert len(named) > 20
    folders = (*ROOMS, "pachon", "tests")
    files = {path.relative_to(ROOT).as_posix() for folder in folders for path in (ROOT / folder).rglob("*.py")}
    assert {name for name in named if not any(f"/{file}".endswith(f"/{name}") for file in files)} == set()
