"""User-defined apertures of Zemax files (.uda) against brute force, and what is refused of them."""

from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError, PrescriptionWarning
from pachon.models.aperture import Circle, Ellipse, Polygon
from pachon.models.io.prescription import prescription_digest

LENS = (Path(__file__).parents[2] / "data" / "lenses" / "doublet.zmx").read_text()
HEXAGON = [(10 * float(np.cos(t)), 10 * float(np.sin(t))) for t in np.pi / 3 * np.arange(6)]


def aperture(folder, content, line='USAP "hole.uda" 0', name="hole.uda", **options):
    folder.mkdir(exist_ok=True)
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text(content)
    (folder / "lens.zmx").write_text(LENS.replace("  COMM crown", f"  COMM crown\n  {line}"))
    return pachon.load_telescope(folder / "lens.zmx", **options).surfaces[0].aperture


def crossings(corners, x, y):
    """Return whether points lie in a polygon by the winding of its corners about each."""
    angles = np.unwrap(
        np.arctan2(*(np.array([*corners, corners[0]]).T[::-1, :, None] - np.array([y, x])[:, None])), axis=0
    )
    return np.abs(angles[-1] - angles[0]) > np.pi


def points(size=14.0):
    return np.random.default_rng(8).uniform(-size, size, (2, 4000))


@pytest.mark.parametrize("line", ["LIN {} {}", "{}, {}", "{} {}"])
@pytest.mark.parametrize("end", ["BRK", "", "0, 0"])
def test_a_polygon(tmp_path, line, end):
    text = "! a comment\n" + "\n".join(line.format(*corner) for corner in HEXAGON) + f"\n{end}\n"
    if end == "0, 0" and line.startswith("LIN"):
        text = text.replace("0, 0", "")
    found = aperture(tmp_path, text)
    assert isinstance(found, Polygon)
    assert len(found.corners) == 6
    x, y = points()
    # Millimetres; the axes are those of the telescope, whose x is the other way round.
    assert np.array_equal(found.contains(-1e-3 * x, 1e-3 * y), crossings(HEXAGON, x, y))


def test_holes_islands_and_neighbours(tmp_path):
    """A point within an even number of outlines is outside."""
    square = [(-12, -12), (12, -12), (12, 12), (-12, 12)]
    text = "\n".join(f"LIN {x} {y}" for x, y in square) + "\nBRK\nCIR 1 0 8\nELI 2 0 3 2 30\nCIR 30 0 2\n"
    found = aperture(tmp_path, text)
    x, y = points(34.0)
    u, v = x - 2, y
    turn = np.radians(30)
    along, across = u * np.cos(turn) + v * np.sin(turn), v * np.cos(turn) - u * np.sin(turn)
    inside = [
        crossings(square, x, y),
        (x - 1) ** 2 + y**2 < 64,
        (along / 3) ** 2 + (across / 2) ** 2 < 1,
        (x - 30) ** 2 + y**2 < 4,
    ]
    expected = np.sum(inside, axis=0) % 2 == 1
    assert 0 < expected.sum() < 4000
    assert np.array_equal(found.contains(-1e-3 * x, 1e-3 * y), expected)
    hidden = aperture(tmp_path / "two", text, "USOB hole.uda")
    assert np.array_equal(hidden.contains(-1e-3 * x, 1e-3 * y), ~expected)


def test_segments_that_share_edges(tmp_path):
    """Seven hexagons of a segmented mirror: neighbours touch and do not cross."""
    centres = [
        (0.0, 0.0),
        *((np.sqrt(3) * 10 * np.cos(t), np.sqrt(3) * 10 * np.sin(t)) for t in np.pi / 6 + np.pi / 3 * np.arange(6)),
    ]
    text = "".join("".join(f"LIN {x + a} {y + b}\n" for a, b in HEXAGON) + "BRK\n" for x, y in centres)
    found = aperture(tmp_path, text)
    x, y = points(26.0)
    expected = np.any([crossings(HEXAGON, x - a, y - b) for a, b in centres], axis=0)
    assert np.array_equal(found.contains(-1e-3 * x, 1e-3 * y), expected)


def test_rays_are_stopped_and_the_aperture_decentred(tmp_path):
    (tmp_path / "Apertures").mkdir()
    circle = aperture(tmp_path, "CIR 0 0 3", 'USAP "C:\\Zemax\\HOLE.UDA"\n  OBDC 1 2', "Apertures/hole.uda")
    assert circle == Circle(3e-3, -1e-3, 2e-3)
    lens = pachon.load_telescope(tmp_path / "lens.zmx")
    rays = pachon.launch_rays(lens, (0.0, 0.0), lens.default_wavelength, ([0.0, -1e-3], [-2e-3, 2e-3]))
    assert list(pachon.trace(lens, rays).status) == [pachon.RayStatus.VIGNETTED, pachon.RayStatus.OK]


def test_the_file_is_part_of_the_digest(tmp_path):
    assert isinstance(aperture(tmp_path, "ELI 0 0 3 2"), Ellipse)
    before = prescription_digest(tmp_path / "lens.zmx")
    (tmp_path / "hole.uda").write_text("ELI 0 0 3 2.5")
    assert prescription_digest(tmp_path / "lens.zmx") != before


@pytest.mark.parametrize(
    ("content", "line", "words"),
    [
        ("CIR 0 0 3", "USAP other.uda", r"USAP other.uda: expected the file other.uda beside the lens file"),
        ("CIR 0 0 3", "UDAD hole.uda", r"UDAD hole.uda: user-defined apertures are read where USAP or USOB names"),
        ("CIR 0 0 3", "USAP 1 2", r"USAP 1 2: user-defined apertures are read where USAP or USOB names a file"),
        ("REC 0 0 1 2", "USAP hole.uda", r"hole.uda, line 1: REC: expected LIN, BRK, CIR or ELI"),
        ("ARC 0 0 90 8", "USAP hole.uda", r"hole.uda, line 1: ARC: expected LIN"),
        ("\nLIN 1 two", "USAP hole.uda", r"hole.uda, line 2: LIN 1 two: expected a number in place of 'two'"),
        ("LIN 1 1\nLIN 2 2", "USAP hole.uda", r"hole.uda.*: polygon of 2 corners: expected at least three"),
        ("CIR 0 0 3\nCIR 4 0 3", "USAP hole.uda", r"hole.uda: outlines 1 and 2 cross"),
        ("-9 -1\n9 -1\n9 1\n-9 1\n0 0\n-1 -9\n1 -9\n1 9\n-1 9", "USAP hole.uda", "outlines 1 and 2 cross"),
        ("! nothing", "USAP hole.uda", "hole.uda: expected at least one outline"),
    ],
)  # fmt: skip
def test_what_is_refused_is_one_line(tmp_path, content, line, words):
    with pytest.raises(PrescriptionError, match=words) as found:
        aperture(tmp_path, content, line)
    assert "\n" not in str(found.value)
    with pytest.warns(PrescriptionWarning, match="taken as none"):
        assert aperture(tmp_path, content, line, lenient=True) is None
