"""The examples of the documentation run, page by page, and its pictures are there."""

import contextlib
import html
import inspect
import io
import re
import shutil
from decimal import Decimal
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from typer.testing import CliRunner

import pachon
from pachon.commands.cli import app
from pachon.models.io.bundled import DATA
from pachon.reconstruction.psf_model.model import PsfModel

DOCS = Path(__file__).parents[2] / "docs"
#: Folders of pages, by what a reader needs; the gallery has tests of its own.
FOLDERS = ("tutorials", "howto", "explanation", "evidence", "reference")
#: By the page's name; pages of evidence, named after the page that they support, by "evidence/NAME".
PATHS = {
    (f"{folder}/" if folder == "evidence" or path.name == "index.md" else "") + path.name: path
    for folder in FOLDERS
    for path in sorted((DOCS / folder).glob("*.md"))
}
#: Pages that the build makes, as seen from the folder of the reference.
GENERATED = ("commands/index.md",)
PAGES = {name: path.read_text(encoding="utf-8") for name, path in PATHS.items()}
BLOCK = re.compile(r"```python\n(.*?)```", flags=re.S)
LENSES = Path(__file__).parents[1] / "data" / "zmx"
OPTILAND = Path(__file__).parents[1] / "data" / "lensfiles" / "cooke_triplet.json"
GLASSES = DATA / "glasses.agf"
#: Pages whose examples need files of the reader's own, and run with files of ours in other tests.
WITH_FILES = {
    "psf_models.md",
    "zemax.md",
    "files.md",
    "perturbations.md",
    "focal_plane_psf.md",
    "piff_files.md",
    "first_run.md",
    "own_telescope.md",
}
#: Pages whose examples need another package, and those that take seconds.
PEERS = {"batoid.md": "batoid", "from_galsim.md": "galsim", "galsim.md": "galsim", "from_piff.md": "piff"}
SLOW = {
    "analyses.md",
    "galsim.md",
    "design_study.md",
    "measuring.md",
    "from_piff.md",
    "donuts.md",
    "statistical_engine.md",
    "design_images.md",
    "stars_to_shear.md",
    "wavefronts_from_donuts.md",
}
NUMBER = r"[+-]?\b\d+(?:\.\d*)?(?:e[+-]?\d+)?"
#: Lessons that show what each block prints.
LESSONS = ("stars_to_shear.md", "wavefronts_from_donuts.md")


def marked(names):
    return [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in names]


EXAMPLES = marked(n for n, text in PAGES.items() if BLOCK.search(text) and n not in (*WITH_FILES, *LESSONS))


def test_the_pages_that_users_begin_with_have_examples():
    assert {"design_study.md", "design_metrics.md", "derivatives.md"} <= {example.values[0] for example in EXAMPLES}


@pytest.mark.long
@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_run(name, tmp_path, monkeypatch, capsys):
    if name in PEERS:
        pytest.importorskip(PEERS[name])
    monkeypatch.chdir(tmp_path)
    names = {}
    with matplotlib.rc_context():
        for block in BLOCK.findall(PAGES[name]):
            exec(compile(block, name, "exec"), names)
    assert capsys.readouterr().out
    for picture in re.findall(r'savefig\("(.*?)"\)', PAGES[name]):
        assert (tmp_path / picture).read_bytes().startswith(b"\x89PNG")


def number_and_words(text):
    """Split text into its words, its numbers and the units of their last digits."""
    numbers = re.findall(NUMBER, text)
    last_digits = [10.0 ** Decimal(number).as_tuple().exponent for number in numbers]
    return re.sub(NUMBER, "#", text), np.array(numbers, dtype=float), np.array(last_digits)


@pytest.mark.long
@pytest.mark.parametrize("name", marked(LESSONS))
def test_lessons_print_what_they_show(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check_shown(name)
    for picture in re.findall(r'savefig\("(.*?)"\)', PAGES[name]):
        assert (tmp_path / picture).read_bytes().startswith(b"\x89PNG")


def check_shown(name):
    """Run the blocks of a page; each prints the words of the text block after it, and its numbers."""
    names = {}
    with matplotlib.rc_context():
        for block, shown in re.findall(r"```python\n(.*?)```\n(?:\n```text\n(.*?)```)?", PAGES[name], flags=re.S):
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                exec(compile(block, name, "exec"), names)
            words, numbers, _ = number_and_words(printed.getvalue())
            expected_words, expected, last_digits = number_and_words(shown)
            assert words.split() == expected_words.split()
            # Processors differ in last digits alone, and printed roundings may flip.
            assert np.all(np.abs(numbers - expected) <= 1.5 * last_digits), (numbers, expected)


@pytest.mark.long
def test_the_page_of_an_own_telescope_runs_on_its_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = re.search(r"^pachon (new .*)$", PAGES["own_telescope.md"], flags=re.M)[1]
    assert CliRunner().invoke(app, command.split()).exit_code == 0
    media, *lens = re.findall(r"^(media: .*|  - {name: C1.*)$", PAGES["own_telescope.md"], flags=re.M)
    text = (tmp_path / "corrected.yaml").read_text(encoding="utf-8").replace("surfaces:", f"{media}\nsurfaces:")
    detector = next(line for line in text.splitlines() if "Detector" in line)
    focused = detector.replace("z: -0.25,", "z: -0.252737,")
    text = text.replace(detector, "\n".join([*lens, focused]))
    (tmp_path / "corrected.yaml").write_text(text, encoding="utf-8")
    assert CliRunner().invoke(app, ["validate", "corrected.yaml"]).exit_code == 0
    check_shown("own_telescope.md")
    # The camera file that the page leads to has its CCDs where this telescope's light falls.
    camera_file = re.search(r"```yaml\n(# my_camera.yaml.*?)```", PAGES["camera.md"], flags=re.S)[1]
    (tmp_path / "my_camera.yaml").write_text(camera_file, encoding="utf-8")
    camera, telescope = pachon.load_camera("my_camera.yaml"), pachon.load_telescope("corrected.yaml")
    corners = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    pixels = (np.arange(len(camera))[:, None], (camera.pixels[:, None] - 1) * corners)
    fields = pachon.fields_at(telescope, camera.from_pixel(*pixels).reshape(-1, 2))
    assert (pachon.vignetting(telescope, fields).lit_fraction > 0.5).all()
    assert (tmp_path / "my_psfs.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_first_run_prints_what_it_shows(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pachon.run(pachon.Configuration(), "pachon_run")
    check_shown("first_run.md")
    verdict = " ".join(re.findall(r"^> (.*)$", PAGES["first_run.md"], flags=re.M))
    report = html.unescape((tmp_path / "pachon_run" / "report.html").read_text(encoding="utf-8"))
    assert verdict in " ".join(report.split())


def test_the_zemax_page_runs_on_a_lens(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(LENSES / "lens1.zmx", tmp_path / "lens.zmx")
    shutil.copy(GLASSES, tmp_path / "schott.agf")
    for block in BLOCK.findall(PAGES["zemax.md"]):
        exec(compile(block, "zemax.md", "exec"), {})
    assert (tmp_path / "again.zmx").stat().st_size > 500


def test_the_page_of_piff_runs_on_a_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copy(LENSES.parent / "piff" / "moffat.piff", tmp_path / "psf.piff")
    exec(compile(BLOCK.findall(PAGES["piff_files.md"])[0], "piff_files.md", "exec"), {})
    assert capsys.readouterr().out.startswith("<PiffPsf: 1 chip, ")


def test_the_page_of_lens_files_runs_on_lenses(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(LENSES / "lens1.zmx", tmp_path / "lens.zmx")
    shutil.copy(GLASSES, tmp_path / "schott.agf")
    shutil.copy(OPTILAND, tmp_path / "lens.json")
    zoom = (LENSES.parent / "lenses" / "triplet.zmx").read_text()
    (tmp_path / "zoom.zmx").write_text(zoom + "MNUM 3 1\nTHIC 2 3 5\n")
    (tmp_path / "lens.len").write_text(
        'LEN NEW "singlet" 100 2\nEBR 5\nANG 1\nTH 1e20\nNXT\nGLA N-BK7\nRD 50\nTH 3\nNXT\nTH 90\nNXT\nEND 3\n'
    )
    for block in BLOCK.findall(PAGES["files.md"]):
        exec(compile(block, "files.md", "exec"), {})
    assert (tmp_path / "again.roa").stat().st_size > 500


@pytest.mark.slow
def test_the_page_of_the_focal_plane_model_runs_on_a_run(tmp_path, monkeypatch, capsys, focal_plane_config):
    monkeypatch.chdir(tmp_path)
    pachon.run(focal_plane_config(reconstruction__model="ccd"), tmp_path / "my_run")
    exec(compile(BLOCK.findall(PAGES["focal_plane_psf.md"])[0], "focal_plane_psf.md", "exec"), {})
    assert "ln size" in capsys.readouterr().out
    assert (tmp_path / "focal_plane_psf.fits").stat().st_size > 10000


@pytest.mark.parametrize("name", PAGES)
def test_pictures_and_links_are_there(name):
    for target in re.findall(r"\]\(([^)#:]+)\)", PAGES[name]):
        assert target in GENERATED or (PATHS[name].parent / target).exists(), target


@pytest.mark.parametrize("name", PAGES)
def test_files_named_in_pages_exist(name):
    folders = "tests|models|raytrace|wavefront|design|sky|pipeline|imaging|studies|commands|core|benchmarks|docs"
    for path in re.findall(rf"`(?:python |pytest (?:-m slow )?)?((?:{folders})/[\w./]+)", PAGES[name]):
        assert (DOCS.parent / path).exists(), path


def test_the_page_of_psf_models_names_what_the_model_has():
    page = PAGES["psf_models.md"]
    named = re.findall(r"`(?:model\.)?(\w+)(?:\([^`]*\))?`", page.partition("## Beside Piff")[0])
    options = inspect.signature(PsfModel.fit).parameters
    known = {*dir(PsfModel), *options, "PsfModel"}
    assert set(named) <= known, set(named) - known
    for option in re.findall(r"^\| `(\w+)", page, flags=re.M):
        assert option in options


@pytest.mark.parametrize("folder", FOLDERS)
def test_every_page_is_in_the_index_of_its_folder(folder):
    index = (DOCS / folder / "index.md").read_text(encoding="utf-8")
    names = {path.name for path in PATHS.values() if path.parent.name == folder} - {"index.md"}
    assert names <= set(re.findall(r"\]\((\w+\.md)\)", index))
    # Either a list of names, or all that is there.
    listed = index.partition(":hidden:")[2]
    assert ":glob:" in listed or all(f"\n{Path(name).stem}\n" in listed for name in names)
    assert f"\n{folder}/index\n" in (DOCS / "index.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", [name for name, path in PATHS.items() if path.parent.name != "evidence"])
def test_sentences_are_short(name):
    text = re.sub(r"```.*?```", "", PAGES[name], flags=re.S)
    # Code, tables, headings and pictures are no sentences.
    text = "\n".join(line for line in text.splitlines() if not re.match(r"^( {4}|\||#|!\[)", line))
    sentences = re.split(r"(?<=[.!?])\s+|\n\s*\n|\n[*-] ", text)
    assert [s for s in sentences if len(re.findall(r"[A-Za-z][\w'-]*", s)) > 35] == []
