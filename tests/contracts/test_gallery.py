"""The gallery runs with its outputs, and the references of the documentation list every public name and command."""

import contextlib
import importlib.util
import io
import json
import re
import runpy
import subprocess
import sys
import urllib.request
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote

import matplotlib
import pytest
from public_names import public_names

import pachon
from pachon.core.stability import PROVISIONAL

DOCS = Path(__file__).parents[2] / "docs"
GALLERY = sorted((DOCS / "gallery").glob("[0-9]*.py"))
#: Examples of about a second and more; CI builds the pages, and so runs them, all the same.
LONG = {
    "03_wavefront",
    "08_psf",
    "10_ghosts",
    "11_sensitivity",
    "20_donuts",
    "22_sky_image",
    "23_results",
    "26_run",
    "27_visits",
}
#: Examples whose notebooks end with a desk: design, tolerances, focal plane, donuts, PSF model, visits.
NOTEBOOKS = {"12_optimise", "13_tolerances", "16_heights", "20_donuts", "26_run", "27_visits"}


@pytest.fixture(scope="module")
def pages():
    specification = importlib.util.spec_from_file_location("command_pages", DOCS / "_ext" / "command_pages.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_there_are_twenty_examples():
    assert len(GALLERY) >= 20


@pytest.mark.long
@pytest.mark.parametrize(
    "path", [pytest.param(p, marks=[pytest.mark.slow] * (p.stem in LONG), id=p.stem) for p in GALLERY]
)
def test_examples_run_and_show_what_they_do(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    desks, open_desk = [], pachon.open_desk
    if path.stem in NOTEBOOKS:
        pytest.importorskip("bokeh", reason="a notebook needs Bokeh: pip install 'pachon[desk]'")
    monkeypatch.setattr(pachon, "open_desk", lambda source: desks.append(open_desk(source)))
    with matplotlib.rc_context(), contextlib.redirect_stdout(io.StringIO()) as printed:
        runpy.run_path(str(path))
    assert printed.getvalue().strip()
    assert "0x" not in printed.getvalue()
    pictures = [*tmp_path.glob("*.png")]
    assert pictures
    assert all(picture.read_bytes().startswith(b"\x89PNG") for picture in pictures)
    assert [desk.document().get_model_by_name("numbers").text != "" for desk in desks] == [True] * len(desks)
    assert len(desks) == (path.stem in NOTEBOOKS)
    # An example is short, and its page has a title and says what it teaches before the code.
    text = path.read_text(encoding="utf-8")
    _, introduction, program = text.split('"""\n', 2)[:3]
    assert len(program.partition("# %%")[0].strip().splitlines()) <= 36
    title, line, blank, *sentences = introduction.splitlines()
    assert (len(line), blank) == (len(title), "")
    assert len(" ".join(sentences)) > 40


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("stem", sorted(NOTEBOOKS))
def test_notebooks_of_the_pages_run_and_end_with_a_live_desk(stem, tmp_path):
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    for package in ("bokeh", "ipykernel"):
        pytest.importorskip(package)
    gallery = pytest.importorskip("sphinx_gallery.notebook", reason="notebooks are made by sphinx-gallery")
    from sphinx_gallery.gen_gallery import DEFAULT_GALLERY_CONF
    from sphinx_gallery.py_source_parser import split_code_and_text_blocks

    # The file that the page offers, run in a kernel of its own.
    _, blocks = split_code_and_text_blocks(str(DOCS / "gallery" / f"{stem}.py"))
    written = gallery.jupyter_notebook(blocks, dict(DEFAULT_GALLERY_CONF), str(tmp_path))
    notebook = nbformat.reads(json.dumps(written), as_version=4)
    client = nbclient.NotebookClient(notebook, timeout=1200, resources={"metadata": {"path": str(tmp_path)}})
    with client.setup_kernel():
        for number, cell in enumerate(notebook.cells):
            client.execute_cell(cell, number)
        [html] = [o["data"]["text/html"] for o in notebook.cells[-1].outputs if "text/html" in o.get("data", {})]
        address = re.search(r'<iframe src="(http://127\.0\.0\.1:\d+/[-\w]{32})"', html)[1]
        # Between the cells the kernel serves the page.
        page = urllib.request.urlopen(address, timeout=300).read().decode()
    assert "<title>" in page
    assert "bokeh" in page.lower()
    assert [*tmp_path.glob("*.png")]


def test_every_public_name_is_in_the_reference_with_its_mark(settings):
    context = settings["autosummary_context"]
    listed = [
        f"{module}.{name}" for module, parts in context["names"].items() for names in parts.values() for name in names
    ]
    assert sorted(listed) == sorted(public_names())
    reference = (DOCS / "reference" / "api.md").read_text(encoding="utf-8")
    modules = re.findall(r"^   (pachon[\w.]*)$", reference, flags=re.M)
    assert sorted(modules) == sorted({*context["names"], "pachon.galsim"})
    assert context["provisional"] == PROVISIONAL
    for template in (DOCS / "_templates" / "autosummary").glob("[bc]*.rst"):
        assert "{% if fullname in provisional %}\n*provisional*" in template.read_text(encoding="utf-8")


def test_every_public_name_has_a_docstring():
    assert [name for name, value in public_names().items() if not (value.__doc__ or "").strip()] == []


def test_every_command_and_option_is_in_the_reference(pages):
    import typer

    from pachon.commands.cli import app

    text, names = pages.command_pages(), []
    sections = dict(re.findall(r"^##? (pachon .+?)\n(.*?)(?=^##? |\Z)", "\n".join(text.values()), flags=re.M | re.S))

    def check(group, name):
        for key, command in group.commands.items():
            names.append(f"{name} {key}")
            for parameter in command.params:
                shown = parameter.param_type_name == "option" and not parameter.hidden
                for option in parameter.opts if shown else ():
                    assert f"`{option}`" in sections[names[-1]] or option == "--help", (names[-1], option)
            if hasattr(command, "commands"):
                check(command, names[-1])

    commands = typer.main.get_command(app)
    check(commands, "pachon")
    assert sorted(sections) == sorted(names)
    assert len(names) > 30
    listed = re.findall(r"^- \[`pachon ([\w-]+)`\]\(\1\.md\): \S", pages.command_index(), flags=re.M)
    assert sorted(listed) == sorted(commands.commands) == sorted(text)


@pytest.fixture
def settings(monkeypatch):
    """Settings of conf.py, which adds folders to the path; numpydoc, whose links it clears, may not be there."""
    monkeypatch.setitem(sys.modules, "numpydoc", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "numpydoc.xref", SimpleNamespace(DEFAULT_LINKS={}))
    monkeypatch.setattr(sys, "path", [*sys.path])
    return runpy.run_path(str(DOCS / "conf.py"))


def test_pages_show_options_as_they_are_typed(pages, settings):
    # Texts name options outside of code too, where docutils' "smart quotes" make a dash of two hyphens.
    text = re.sub(r"```.*?```|`[^`\n]*`", "", "\n".join(pages.command_pages().values()), flags=re.S)
    assert re.search(r"(?<!\S)--\w", text)
    assert settings["smartquotes"] is False
    assert "suppress_warnings" not in settings


@pytest.mark.parametrize("path", [*DOCS.rglob("*.md")], ids=lambda path: path.stem)
def test_links_within_the_pages_lead_somewhere(path):
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.S)
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)#([^)\s]+)\)", text):
        page = (path.parent / target).resolve() if target else path
        headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.M)
        anchors = {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in headings}
        assert anchor in anchors, (target, anchor)


class Page(HTMLParser):
    """Anchors of a page of HTML, its links with their words, and its other files."""

    def __init__(self, path):
        super().__init__()
        self.anchors, self.links, self.files, self._words = set(), [], [], None
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.anchors |= {values[key] for key in ("id", "name") if values.get(key)}
        if tag == "a" and values.get("href"):
            self._words = []
            self.links.append((values["href"], self._words))
        if values.get("src"):
            self.files.append(values["src"])

    def handle_endtag(self, tag):
        if tag == "a":
            self._words = None

    def handle_data(self, data):
        if self._words is not None:
            self._words.append(data)


def wrong_links(folder):
    """Return each link of built pages to a file or an anchor that is not there, and of "shape" to Window.shape."""
    parsed = {path.resolve(): Page(path) for path in folder.rglob("*.html")}
    wrong = []
    for path, page in parsed.items():
        for link, words in [*page.links, *((file, []) for file in page.files)]:
            if re.match(r"[a-z]+:|//", link):
                continue
            target, _, anchor = unquote(link).partition("#")
            goal = (path.parent / target.partition("?")[0]).resolve() if target else path
            there = goal.is_file() and (not anchor or goal not in parsed or anchor in parsed[goal].anchors)
            if not there or ("".join(words) == "shape" and anchor.endswith("Window.shape")):
                wrong.append(f"{path.relative_to(folder.resolve())}: {link}")
    return wrong


@pytest.mark.slow
def test_the_pages_are_built_without_warnings(tmp_path):
    for package in (
        "sphinx",
        "furo",
        "myst_parser",
        "numpydoc",
        "sphinx_design",
        "sphinx_copybutton",
        "sphinx_gallery",
    ):
        pytest.importorskip(package)
    # In a process of its own: pytest makes errors of the warnings of Sphinx's own code.
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", "-d", str(tmp_path / "trees")]
    done = subprocess.run([*command, str(DOCS), str(tmp_path / "html")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    built = {path.relative_to(tmp_path / "html").as_posix() for path in (tmp_path / "html").rglob("*.html")}
    assert {"index.html", "reference/commands/run.html", "reference/api/pachon.spots.html"} <= built
    assert {f"auto_examples/{path.stem}.html" for path in GALLERY} <= built
    command_page = (tmp_path / "html" / "reference" / "commands" / "run.html").read_text(encoding="utf-8")
    assert "--resume" in command_page
    assert "\N{EN DASH}" not in command_page
    assert wrong_links(tmp_path / "html") == []
