"""The gallery runs with its outputs, and the references of the documentation list every public name and command."""

import importlib.util
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from public_names import public_names

from pachon.core.stability import PROVISIONAL

DOCS = Path(__file__).parents[2] / "docs"
GALLERY = sorted((DOCS / "gallery").glob("[0-9]*.md"))
#: Examples of more than a second; CI builds the pages, and so runs them, all the same.
LONG = {"20_donuts"}


@pytest.fixture(scope="module")
def pages():
    specification = importlib.util.spec_from_file_location("pages", DOCS / "pages.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_there_are_twenty_examples():
    assert len(GALLERY) >= 20
    listed = re.findall(r"^(\d\d_\w+)$", (DOCS / "gallery" / "index.md").read_text("utf-8"), flags=re.M)
    assert listed == [path.stem for path in GALLERY]


@pytest.mark.long
@pytest.mark.parametrize(
    "path", [pytest.param(p, marks=[pytest.mark.slow] * (p.stem in LONG), id=p.stem) for p in GALLERY]
)
def test_examples_run_and_show_what_they_do(path, pages, tmp_path):
    text = path.read_text(encoding="utf-8")
    shown = pages.run_page(text, tmp_path)
    output = re.search(r"```text\n(.+?)```", shown, flags=re.S)
    assert output is not None
    assert "0x" not in output[1]
    pictures = re.findall(r"!\[.*?\]\(made/(.*?)\)", shown)
    assert pictures
    for name in pictures:
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    # An example is short, and the page says what it teaches before it.
    assert len(pages.BLOCK.findall(text)[0].splitlines()) <= 36
    assert text.index("```python") > 80


def test_every_public_name_is_in_the_reference_with_its_mark(pages):
    reference = "".join(map(pages.api_page, pages.LAYERS))
    listed = re.findall(r"^\.\. \w+:: (pachon\.[\w.]+)$", reference, flags=re.M)
    assert sorted(listed) == sorted({*public_names(), "pachon.galsim"})
    marked = re.findall(r"^\*provisional\*.*\n\n```{eval-rst}\n\.\. \w+:: (pachon\.[\w.]+)$", reference, flags=re.M)
    assert set(marked) == PROVISIONAL


def test_every_public_name_has_a_docstring():
    assert [name for name, value in public_names().items() if not (value.__doc__ or "").strip()] == []


def test_every_command_and_option_is_in_the_reference(pages):
    import typer

    from pachon.commands.cli import app

    page, names = pages.command_page(), []
    sections = dict(re.findall(r"^## (pachon .+?)\n(.*?)(?=^## |\Z)", page, flags=re.M | re.S))

    def check(group, name):
        for key, command in group.commands.items():
            names.append(f"{name} {key}")
            for parameter in command.params:
                for option in parameter.opts if parameter.param_type_name == "option" else ():
                    assert f"`{option}`" in sections[names[-1]] or option == "--help", (names[-1], option)
            if hasattr(command, "commands"):
                check(command, names[-1])

    check(typer.main.get_command(app), "pachon")
    assert sorted(sections) == sorted(names)
    assert len(names) > 30


def test_pages_show_options_as_they_are_typed(pages, monkeypatch):
    # Texts name options outside of code too, where docutils' "smart quotes" make a dash of two hyphens.
    text = re.sub(r"```.*?```|`[^`\n]*`", "", pages.command_page(), flags=re.S)
    assert re.search(r"(?<!\S)--\w", text)
    monkeypatch.setattr(sys, "path", [*sys.path])  # conf.py adds to it
    assert runpy.run_path(str(DOCS / "conf.py"))["smartquotes"] is False


@pytest.mark.parametrize("path", [*DOCS.rglob("*.md")], ids=lambda path: path.stem)
def test_links_within_the_pages_lead_somewhere(path):
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.S)
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)#([^)\s]+)\)", text):
        page = (path.parent / target).resolve() if target else path
        headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.M)
        anchors = {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in headings}
        assert anchor in anchors, (target, anchor)


@pytest.mark.slow
def test_the_pages_are_built_without_warnings(tmp_path):
    for package in ("sphinx", "furo", "myst_parser"):
        pytest.importorskip(package)
    # In a process of its own: pytest makes errors of the warnings of Sphinx's own code.
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", "-d", str(tmp_path / "trees")]
    done = subprocess.run([*command, str(DOCS), str(tmp_path / "html")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    pages = {path.name for path in (tmp_path / "html").rglob("*.html")}
    assert {"index.html", "commands.html", "api_models.html", "02_spots.html"} <= pages
    commands = (tmp_path / "html" / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "goes on by --resume" in commands
    assert "\N{EN DASH}" not in commands
    broken = []
    for page in (tmp_path / "html").rglob("*.html"):
        for link in re.findall(r'(?:href|src)="([^"#:?]+)"', page.read_text(encoding="utf-8")):
            if not (page.parent / link).exists():
                broken.append(f"{page.name}: {link}")
    assert broken == []
