"""The example of the page on images of a design runs, and its pictures are there."""

import re
from pathlib import Path

import matplotlib

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "design_images.md").read_text(encoding="utf-8")


def test_the_example_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with matplotlib.rc_context():
        for block in re.findall(r"```python\n(.*?)```", PAGE, flags=re.S):
            exec(compile(block, "design_images.md", "exec"), {})
    assert capsys.readouterr().out
    assert (tmp_path / "lsst.png").read_bytes().startswith(b"\x89PNG")


def test_its_pictures_are_there():
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", PAGE)
    assert len(pictures) == 4
    for picture in pictures:
        assert (ROOT / "docs" / picture).is_file()
