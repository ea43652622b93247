"""Lens files in Windows' own characters, and with glasses that cannot be made."""

from pathlib import Path

import pytest

import pachon

LENSES = Path(__file__).parents[2] / "data" / "lenses"


def test_a_file_in_windows_own_characters(tmp_path):
    """Quotation marks and dashes of Windows-1252 are control characters in ISO 8859-1, which no name may have."""
    path, name = tmp_path / "lens.zmx", "Objektiv \u2013 \u201eWei\u00df\u201c"
    text = (LENSES / "singlet.zmx").read_text().replace("COMM front", f"COMM {name}")
    path.write_bytes(text.encode("cp1252"))
    assert pachon.load_telescope(path).surfaces[0].name == name


def test_a_glass_of_negative_thickness_is_said(tmp_path):
    path = tmp_path / "lens.zmx"
    path.write_text((LENSES / "singlet.zmx").read_text().replace("DISZ 5\n", "DISZ -5\n"))
    with pytest.warns(pachon.errors.PrescriptionWarning, match=r"lens.zmx: surface front: N-BK7 of thickness -5 mm"):
        pachon.load_telescope(path)
    (problem,) = pachon.validate_file(path).problems
    assert "N-BK7 of thickness -5 mm: expected from 0" in str(problem)


def test_negative_distances_in_air_and_behind_mirrors_are_none(tmp_path):
    """A virtual image is a design; the glass of a Mangin mirror is crossed backwards."""
    singlet = (LENSES / "singlet.zmx").read_text()
    for number, (old, new) in enumerate({"DISZ 93\n": "DISZ -93\n", "GLAS N-BK7": "GLAS MIRROR"}.items()):
        path = tmp_path / f"lens{number}.zmx"
        text = singlet.replace(old, new)
        path.write_text(text.replace("DISZ 5\n", "DISZ -5\n") if "MIRROR" in new else text)
        pachon.load_telescope(path)
    mangin = singlet.replace(
        "CLAP 0 13 0\n  DISZ 93", "GLAS MIRROR 0 0 1.5 40\n  DISZ -5\nSURF 3\n  TYPE STANDARD\n  CURV 0\n  DISZ -80"
    )
    path = tmp_path / "mangin.zmx"
    path.write_text(mangin.replace("SURF 3\n  COMM", "SURF 4\n  COMM"))
    assert len(pachon.load_telescope(path).surfaces) == 4
