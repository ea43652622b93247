"""Glass catalogues that the user has named once, by a variable or a configuration."""

import os
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError
from pachon.models.io.user_glasses import user_catalogues

LENS = Path(__file__).parents[2] / "data" / "zmx" / "lens1.zmx"
#: A glass by Schott's formula, n^2 = 2.25 + 0.01 / w^2.
AGF = "CC mine\nNM MYGLASS 1 0 1.5 60 0 0\nCD 2.25 0 0.01 0 0 0\nLD 0.3 2.5\n"


@pytest.fixture
def lens(tmp_path, monkeypatch):
    """A lens with a glass of the user's, and a home without settings."""
    monkeypatch.delenv("PACHON_GLASS_PATH", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    (tmp_path / "config" / "pachon").mkdir(parents=True)
    (tmp_path / "glasses").mkdir()
    (tmp_path / "glasses" / "mine.AGF").write_text(AGF)
    text = LENS.read_text().replace("GLAS N-SF2 1 0 1.6476432085037231 33.838470458984375", "GLAS MYGLASS 0 0 1.5 40")
    assert "MYGLASS" in text
    path = tmp_path / "lens.zmx"
    path.write_text(text)
    return path


def check(lens):
    telescope = pachon.load_telescope(lens)
    (glass,) = {s.medium_after for s in telescope.surfaces if s.medium_after.name == "MYGLASS"}
    # Relative to air, as Zemax uses it.
    assert float(glass.index(0.5e-6)) == pytest.approx(np.sqrt(2.25 + 0.01 / 0.5**2), abs=1e-6)


def test_a_folder_named_by_the_variable(lens, monkeypatch):
    with pytest.raises(PrescriptionError, match="in no catalogue"):
        pachon.load_telescope(lens)
    monkeypatch.setenv("PACHON_GLASS_PATH", str(lens.parent / "glasses"))
    check(lens)


def test_a_file_named_by_the_configuration(lens):
    settings = lens.parent / "config" / "pachon" / "config.yaml"
    settings.write_text(f"glass_path: {lens.parent / 'glasses' / 'mine.AGF'}\n")
    check(lens)


def test_a_changed_catalogue_is_read_again(lens, monkeypatch):
    monkeypatch.setenv("PACHON_GLASS_PATH", str(lens.parent / "glasses"))
    assert [list(c) for c in user_catalogues()] == [["MYGLASS"]]
    (lens.parent / "glasses" / "mine.AGF").write_text(AGF.replace("MYGLASS", "OTHER"))
    os.utime(lens.parent / "glasses" / "mine.AGF", ns=(1, 1))
    assert [list(c) for c in user_catalogues()] == [["OTHER"]]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("glass_path: [/nowhere/at/all]", "/nowhere/at/all': expected a folder"),
        ("glass_path: 3", "glass_path = 3: expected a path"),
        ("glasspath: x", "unknown key glasspath"),
    ],
)
def test_settings_that_cannot_be_followed(lens, text, problem):
    (lens.parent / "config" / "pachon" / "config.yaml").write_text(text)
    with pytest.raises(PrescriptionError, match=problem):
        pachon.load_telescope(lens)


def test_bundled_glasses_need_no_settings(lens, monkeypatch):
    monkeypatch.setenv("PACHON_GLASS_PATH", "/nowhere/at/all")
    assert pachon.load_telescope(LENS) == pachon.load_telescope(LENS)
