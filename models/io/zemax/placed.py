"""Surfaces with known places, translated into the blocks of a Zemax file.

Other formats state where each surface is and how it is rotated, in a frame in which light enters along +z. Here the
places become thicknesses along the axis, and coordinate breaks about surfaces that are tilted or decentred. The axis
starts along z and is reflected by each mirror; thicknesses are negative behind an odd number of mirrors, as in Zemax.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from ...media.medium import ConstantIndex, Medium
from ...rotation import rotation_angles
from ..lens.text import Record, number_text
from .file import Block, ZemaxFile

#: Lines of a surface: a keyword and its words.
Line = tuple[str | float, ...]
#: Offsets [lens unit] and components of unit vectors that are rounding.
_ROUNDING = 1e-12
#: Distance [lens unit] from which the object is at infinity.
INFINITE = 1e9


class PlacedSurfaces:
    """Header, glasses and surfaces of a lens file; surfaces are added in the order of the light.

    Lengths are in the unit of the file, which `program` wrote; `glasses` are media by their names in lines ``GLAS``.
    """

    def __init__(self, path: Path, program: str) -> None:
        self.path, self.program = path, program
        self.header = Block(str(path))
        self.glasses: dict[str, Medium] = {}
        self._blocks: list[Block] = []
        #: Blocks that are no coordinate breaks, from the first behind the object on.
        self._surfaces: list[Block] = []
        self._origin = np.zeros(3)
        #: Columns are the local axes; their third is the axis of the light, or its opposite behind a mirror.
        self._frame, self._sign = np.eye(3), 1.0
        #: Direction of the axis of the light.
        self._axis = np.array([0.0, 0.0, 1.0])
        #: Lines of the break that undoes the tilt of the last surface.
        self._undo: list[Line] = []

    def head(self, keyword: str, *words: str | float) -> None:
        """Add a line to the header."""
        self.header.lines.append(made_record(self.path, "", (keyword, *words)))

    def constant_glass(self, index: float) -> list[Line]:
        """Return the line of a medium of constant index, or none for air."""
        return [] if index == 1.0 else self.glass(f"INDEX {index!r}", ConstantIndex(index))

    def glass(self, name: str, medium: Medium) -> list[Line]:
        """Return the line of a glass that the file itself defines."""
        self.glasses[name.upper()] = medium
        return [("GLAS", name)]

    def object(self, distance: float, lines: Iterable[Line] = ()) -> None:
        """Add the object, at a distance from the first surface along z; infinite from 1e9 units on."""
        far = abs(distance) >= INFINITE
        self._add("surface 0", [*lines, ("TYPE", "STANDARD"), ("DISZ", "INFINITY" if far else distance)])

    def surface(
        self, place: str, lines: Iterable[Line], position: np.ndarray, axes: np.ndarray, *, mirror: bool = False
    ) -> None:
        """Add a surface by the position of its vertex and the matrix whose columns are its axes."""
        if len(self._blocks) == 1:
            self._origin = np.array([0.0, 0.0, position[2]])
        else:
            self._finish(place, position)
        offset = self._frame.T @ (position - self._origin)
        tilt = self._frame.T @ axes
        values = _clean([offset[0], offset[1], *np.degrees(rotation_angles(tilt))])
        if any(values):
            self._add(place, [*_break(values, 0), ("DISZ", 0.0)])
            self._undo = _break([-v for v in values], 1)
        self._add(place, lines)
        self._surfaces.append(self._blocks[-1])
        if mirror:
            self._reflect(axes[:, 2])

    def file(self) -> ZemaxFile:
        """Return the parts of the lens file; PrescriptionError if it has fewer than three surfaces."""
        if len(self._blocks) < 3:
            raise self.header.problem(f"{len(self._blocks)} surfaces: expected an object, an image and one between")
        for number, block in enumerate(self._surfaces[:-1], start=1):
            if block.last("COMM") is None:
                # Names count surfaces and no coordinate breaks; the last is the image.
                block.lines.append(made_record(self.path, block.place, ("COMM", f"S{number}")))
        return ZemaxFile(self.path, self.header, self._blocks, Block(str(self.path)), self.glasses, self.program)

    def _finish(self, place: str, position: np.ndarray) -> None:
        """Give the last surface its thickness: up to the plane across the axis through the next position."""
        axis = self._frame[:, 2]
        if self._undo:
            self._last(("DISZ", 0.0))
            self._add(place, self._undo)
            self._undo = []
        if np.linalg.norm(axis - self._sign * self._axis) > _ROUNDING:
            turn = _rotation(axis, self._sign * self._axis)
            angles = np.degrees(rotation_angles(self._frame.T @ turn @ self._frame))
            self._last(("DISZ", 0.0))
            self._add(place, _break([0.0, 0.0, *_clean(angles)], 0))
            self._frame = turn @ self._frame
            axis = self._frame[:, 2]
        thickness = float(axis @ (position - self._origin))
        self._last(("DISZ", thickness))
        self._origin = self._origin + thickness * axis

    def _reflect(self, normal: np.ndarray) -> None:
        self._axis = self._axis - 2.0 * (self._axis @ normal) * normal
        self._sign = -self._sign

    def _add(self, place: str, lines: Iterable[Line]) -> None:
        self._blocks.append(Block(str(self.path), place, [made_record(self.path, place, line) for line in lines]))

    def _last(self, line: Line) -> None:
        self._blocks[-1].lines.append(made_record(self.path, self._blocks[-1].place, line))


def numbered(keyword: str, values: Mapping[int, float] | Iterable[float]) -> list[Line]:
    """Return lines "KEYWORD position number" of values by position, or from position 1 on, without zeros."""
    items = values.items() if isinstance(values, Mapping) else enumerate(values, start=1)
    return [(keyword, i, v) for i, v in items if v]


def made_record(path: Path, place: str, line: Line) -> Record:
    """Return a line of a translated file; `place` is that of its block."""
    words = tuple(number_text(v) if isinstance(v, float) else str(v) for v in line)
    return Record(str(path), place, words[0], line=1, words=words[1:], text=" ".join(words[1:]))


def _break(values: list[float], order: int) -> list[Line]:
    return [("TYPE", "COORDBRK"), *numbered("PARM", [*values, float(order)])]


def _clean(values: Iterable[float]) -> list[float]:
    return [float(v) if abs(v) > _ROUNDING else 0.0 for v in values]


def _rotation(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the smallest rotation between two unit vectors (Rodrigues's formula)."""
    x, y, z = np.cross(start, end)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + start @ end)
