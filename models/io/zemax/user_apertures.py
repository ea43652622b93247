"""User-defined apertures of Zemax surfaces: outlines in a file (.uda) beside the lens file.

A line of the file is an entity: ``LIN x y``, or ``x y`` alone, a corner of a polygon; ``BRK``, or a corner that is the
first one or (0, 0), its end; ``CIR x y radius``; ``ELI x y semi_x semi_y angle`` (degrees from x towards y); ``!`` a
comment. A point within an even number of outlines is outside: an outline within another one is a hole. For the other
entities (``ARC``, ``POL``, ``REC``) no description is at hand; they are refused by name.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from ....core.errors import PrescriptionError, error_context
from ....core.files import read_bytes, text_lines
from ...aperture import Aperture, Circle, Complement, Ellipse, Intersection, Polygon, Union
from ..lens.text import Record, decoded, records

#: Keywords of surfaces, and whether light passes within the outlines.
KEYWORDS = {"USAP": True, "USOB": False}
#: Folder beside a lens file in which its apertures may stand.
_FOLDER = "apertures"
_NAME = re.compile(r'"([^"]*\.uda)"|(\S+\.uda)(?!\S)', re.IGNORECASE)
#: Corners of an outline at most.
_MOST_CORNERS = 20_000
#: Longest file [byte].
_MAX_BYTES = 2_000_000
#: Points of a circle by which it is told which outline stands within which.
_POINTS = 256
#: Points of an edge of a polygon for the same.
_EDGE_POINTS = 16
#: Distance of these points from the rim, over the size of the outline.
_WITHIN = 1e-7

Outline = Polygon | Circle | Ellipse


def aperture_name(line: str) -> str | None:
    """Return the name of a file of outlines in a line, without its folder, or None."""
    name_match = _NAME.search(line)
    return None if name_match is None else re.split(r"[/\\]", name_match[1] or name_match[2])[-1]


def aperture_file(lens: Path, name: str) -> Path | None:
    """Return the file of a name beside a lens file, or in a folder "Apertures" there, in any case; None without."""
    beside = sorted(lens.absolute().parent.iterdir())
    inner = [
        path for folder in beside if folder.name.lower() == _FOLDER and folder.is_dir() for path in folder.iterdir()
    ]
    return next((path for path in (*beside, *sorted(inner)) if path.name.lower() == name.lower()), None)


def named_apertures(lens: Path, text: str) -> list[Path]:
    """Return the files of outlines that the text of a lens file names and that are there."""
    names = dict.fromkeys(name for line in text_lines(text) if (name := aperture_name(line)) is not None)
    return [path for name in names if (path := aperture_file(lens, name)) is not None]


def read_user_aperture(line: Record, unit: float) -> Aperture:
    """Return the clear region [m] of a line of a surface that names a file; `unit` is the lens unit [m]."""
    name = aperture_name(line.text)
    if line.keyword not in KEYWORDS or name is None:
        raise line.problem(f"{line.shown}: user-defined apertures are read where USAP or USOB names a file NAME.uda")
    path = aperture_file(Path(line.file), name)
    if path is None:
        raise line.problem(f"{line.shown}: expected the file {name} beside the lens file")
    text = decoded(read_bytes(path, PrescriptionError, max_bytes=_MAX_BYTES), name)
    outlines = _outlines(text, str(path), unit)
    with error_context(file=path):
        region = _even_odd(outlines)
    return region if KEYWORDS[line.keyword] else Complement(region)


def _outlines(text: str, source: str, unit: float) -> list[Outline]:
    """Return the outlines of the text of a file [m]; `source` is its name for messages."""
    outlines: list[Outline] = []
    corners: list[tuple[float, float]] = []

    def end(place: int) -> None:
        if len(corners) > 1 and corners[-1] == corners[0]:
            corners.pop()
        if corners:
            with error_context(file=source, place=f"before line {place}"):
                outlines.append(Polygon(tuple((x * unit, y * unit) for x, y in corners)))
            corners.clear()

    number = 0
    for line in records(text.replace(",", " "), source):
        number = line.line
        bare = re.fullmatch(r"[-+.\d].*", line.keyword) is not None
        if line.keyword.startswith("!"):
            continue
        if bare or line.keyword == "LIN":
            line = replace(line, keyword="LIN", words=(line.keyword, *line.words)) if bare else line
            corner = line.number(0), line.number(1)
            if bare and corners and corner in ((0.0, 0.0), corners[0]):
                end(number)
            else:
                corners.append(corner)
            if len(corners) > _MOST_CORNERS:
                raise line.problem(f"expected at most {_MOST_CORNERS} corners")
            continue
        end(number)
        sizes = [line.number(i) * unit for i in range({"CIR": 3, "ELI": 4}.get(line.keyword, 0))]
        with error_context(file=source, place=f"line {number}"):
            if line.keyword == "CIR":
                outlines.append(Circle(sizes[2], sizes[0], sizes[1]))
            elif line.keyword == "ELI":
                outlines.append(Ellipse(sizes[2], sizes[3], sizes[0], sizes[1], math.radians(line.number(4, 0.0))))
            elif line.keyword != "BRK":
                raise PrescriptionError(f"{line.keyword}: expected LIN, BRK, CIR or ELI")
    end(number + 1)
    if not outlines:
        raise PrescriptionError("expected at least one outline", file=source)
    return outlines


def _even_odd(outlines: list[Outline]) -> Aperture:
    """Return the points within an odd number of outlines, none of which crosses another one."""
    within: list[set[int]] = []
    for i, outline in enumerate(outlines):
        points = _rim(outline)
        inside: set[int] = set()
        for j, second_outline in enumerate(outlines):
            if i == j:
                continue
            held = second_outline.contains(*points)
            if held.any() and not held.all():
                raise PrescriptionError(
                    f"outlines {i + 1} and {j + 1} cross: expected them beside or within each other"
                )
            inside |= {j} if held.all() else set()
        within.append(inside)
    parts: list[Aperture] = []
    for i, outline in enumerate(outlines):
        if len(within[i]) % 2 == 0:
            # Its holes are the outlines one level further in.
            holes = [outlines[j] for j in range(len(outlines)) if within[j] == within[i] | {i}]
            parts.append(Intersection((outline, *map(Complement, holes))) if holes else outline)
    return parts[0] if len(parts) == 1 else Union(tuple(parts))


def _rim(outline: Outline) -> np.ndarray:
    """Return points just within the rim of an outline, shape (2, n) [m]: neighbours may share the rim itself."""
    if isinstance(outline, Polygon):
        start = np.array(outline.corners)
        along = np.roll(start, -1, axis=0) - start
        # Inward is to the left of the edges of a polygon that is listed counterclockwise.
        turn = np.sign(np.sum(start[:, 0] * np.roll(start[:, 1], -1) - start[:, 1] * np.roll(start[:, 0], -1)))
        inward = turn * np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.hypot(*along.T)[:, None]
        places = (np.arange(_EDGE_POINTS) + 0.5)[:, None, None] / _EDGE_POINTS
        points = start + places * along + _WITHIN * np.ptp(start) * inward
        return points.reshape(-1, 2).T
    turns = np.linspace(0.0, 2.0 * math.pi, _POINTS, endpoint=False)
    sizes = (outline.radius, outline.radius) if isinstance(outline, Circle) else (outline.semi_x, outline.semi_y)
    angle = 0.0 if isinstance(outline, Circle) else outline.angle
    u, v = (1.0 - _WITHIN) * np.stack([sizes[0] * np.cos(turns), sizes[1] * np.sin(turns)])
    cos, sin = math.cos(angle), math.sin(angle)
    return np.stack([outline.x + u * cos - v * sin, outline.y + u * sin + v * cos])
