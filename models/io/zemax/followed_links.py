"""Pickups and solves of a Zemax file in another configuration than the one that it was saved in.

The lines of surfaces hold the solutions of that one. Pickups of curvatures, thicknesses and glasses, compensating and
total thicknesses (TCOM, TOLE) are followed here; thicknesses to the paraxial focus (MAZH, height 0) are marked, and
solved for by the reader. Other solves are reported.
"""

from __future__ import annotations

from dataclasses import replace

from ..lens.source import Findings
from ..lens.text import Record, number_text
from .file import Block, ZemaxFile, set_word

#: Lines of solves and pickups that are not followed.
_OTHERS = ("PCUP", "PPAR", "PXDT", "PCOP", "PKUP", "CPKP", "MARG", "CHAZ", "CHAA", "POSI", "COMP", "CURF", "GLCZ")
#: Kind of solve of a curvature that is picked up.
_CURVATURE = 4
#: Kind of solve of a glass that is picked up.
_GLASS = 2
#: Kinds of a curvature that is fixed, or a variable.
_FREE = (0, 1)


def with_links_followed(file: ZemaxFile, saved: ZemaxFile, findings: Findings) -> ZemaxFile:
    """Return a file whose followers have the values of its own; `saved` is the file as it was saved."""
    solved: set[int] = set()
    for number, block in enumerate(file.surfaces):
        for line in [line for line in block.lines if line.keyword in _OTHERS]:
            findings.report(line.problem(f"{line.shown}: this solve is not made anew in other configurations"))
        _follow_curvature(file, saved, number, findings)
        _follow_glass(file, block)
        height = block.last("MAZH")
        if height is None:
            _follow_thickness(file, block, number)
        elif height.number(0, 0.0) == 0 and height.number(1, 0.0) == 0:
            solved.add(number)
        else:
            text = f"{height.shown}: expected height and zone 0: others are not solved for in other configurations"
            findings.report(height.problem(text), "the thickness of the configuration the file was saved in is taken")
    return replace(file, solved=frozenset(solved))


def _source(file: ZemaxFile, line: Record, place: int) -> Block:
    number = line.integer(place)
    if not 0 <= number < len(file.surfaces):
        raise line.error(f"a surface from 0 to {len(file.surfaces) - 1}")
    return file.surfaces[number]


def _follow_curvature(file: ZemaxFile, saved: ZemaxFile, number: int, findings: Findings) -> None:
    block = file.surfaces[number]
    line = block.last("CURV")
    if line is None or line.number(1, 0.0) in _FREE:
        return
    if line.number(1) != _CURVATURE:
        findings.report(line.problem(f"{line.shown}: this solve is not made anew in other configurations"))
        return
    before, source = _source(saved, line, 2).number("CURV", 0.0), _source(file, line, 2).number("CURV", 0.0)
    # Whether the factor is one of curvatures or of radii, the values of the saved configuration tell.
    factor = saved.surfaces[number].number("CURV", 0.0) / before if before else line.number(3, 1.0)
    set_word(block, "CURV", 0, number_text(factor * source))


def _follow_glass(file: ZemaxFile, block: Block) -> None:
    line = block.last("GLAS")
    if line is not None and line.number(1, 0.0) == _GLASS:
        picked = _source(file, line, 2).last("GLAS")
        block.lines = [other_line for other_line in block.lines if other_line.keyword != "GLAS"]
        if picked is not None:
            words = (picked.words[0], *line.words[1:3], *picked.words[3:])
            block.lines.append(replace(picked, place=block.place, words=words, text=" ".join(words)))


def _follow_thickness(file: ZemaxFile, block: Block, number: int) -> None:
    """Set a thickness that follows another one, or fills up the sum of several."""
    picked, compensator, total = (block.last(keyword) for keyword in ("PZUP", "TCOM", "TOLE"))
    thickness = None
    if picked is not None:
        thickness = picked.number(1, 1.0) * _thickness(_source(file, picked, 0)) + picked.number(2, 0.0)
    elif compensator is not None:
        thickness = compensator.number(1) - _thickness(_source(file, compensator, 0))
    elif total is not None:
        thickness = total.number(1) - sum(map(_thickness, file.surfaces[total.integer(0) : number]))
    if thickness is not None:
        set_word(block, "DISZ", 0, number_text(thickness))


def _thickness(block: Block) -> float:
    return block.number("DISZ", 0.0, infinite=True)
