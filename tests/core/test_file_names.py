"""Names of files from any names: one part of a path, of bounded length, unlike that of any other name."""

from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np
import pytest

from pachon.core.file_names import MAX_BYTES, file_name
from pachon.models.io.bundled import BUNDLED

HOSTILE = [
    "", " ", ".", "..", "...", "/", "\\", "~", "-rf", "--out", ".hidden", "x/../../pwned", "/etc/passwd", "C:\\x",
    "c:x", "a\0b", "a\nb", "\x1b[31m", "a\u202eb", "a\u2028b", "\ud800", "a" * 300, "ü" * 300, "望" * 81,
    "b" * 255 + "/", "con", "NUL.txt", "Com1", "lpt9.a.b", "end.", "end ", "a*b?", 'a"b', "<script>", "a|b", "a:b",
    "a/b", "a_b", "a\\b", "Newton f/5", "Newton f_5",
]  # fmt: skip
ORDINARY = ["Newton f5", "Télescope de 1 m", "望遠鏡", "M2 [red]", "a-b_c.d", "~tilde", "lens1 (copy)", "100 %"]
#: Names that Windows keeps for devices, whatever ending they have.
DEVICES = [f"{port}{number}" for port in ("com", "lpt") for number in range(1, 10)]


@pytest.mark.parametrize(
    "name",
    [*BUNDLED, "Newton f5", "Télescope de 1 m", "望遠鏡", "M2 [red]", "a-b_c.d", "~tilde", "lens1 (copy)", "100 %"],
)
def test_ordinary_names_stay_as_they_are(name):
    assert file_name(name) == name


@pytest.mark.parametrize("name", HOSTILE)
def test_the_file_is_in_its_folder_on_every_system(name, tmp_path):
    text = file_name(name)
    assert 0 < len(text.encode()) <= MAX_BYTES
    assert text.isprintable()
    assert PurePosixPath(text).name == PureWindowsPath(text).name == text
    assert text[0] not in ".-"
    assert text[-1] not in ". "
    assert text.partition(".")[0].lower() not in {"con", "prn", "aux", "nul", *DEVICES}
    (tmp_path / f"spots_{text}.png").write_text(name, errors="replace")
    (tmp_path / text).write_text("")
    assert {path.parent for path in tmp_path.rglob("*")} == {tmp_path}


def test_no_two_names_have_one_file():
    # Beside the above, 2000 words of four letters of which most are replaced.
    rng = np.random.default_rng(5)
    words = ["".join(rng.choice(list("a/._:-\\ \x07"), 4)) for _ in range(2000)]
    names = {*HOSTILE, *words}
    assert len({file_name(name) for name in names}) == len(names)


def test_long_names_keep_their_beginning():
    name = file_name("Große Linse " * 40)
    assert name.startswith("Große Linse Große Linse ")
    assert len(Path(name).name.encode()) == MAX_BYTES
    # A letter of three bytes is not cut in two.
    assert file_name("望" * 81)[: 71 // 3] == "望" * (71 // 3)
