"""Configurations of a Zemax lens file: the lines of its header and surfaces with the values of one of them.

Behind the surfaces stand ``MNUM count active`` and rows of operands, ``THIC surface configuration value ...``. The
values of the lines before them are those of the active configuration, in which the file was saved.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from ..lens.source import Findings
from ..lens.text import Record
from .file import TRAILER, Block, ZemaxFile, set_word
from .followed_links import with_links_followed

#: Operands of a surface with a number: keyword of its line, and the place of the number in it.
_SURFACE = {
    "THIC": ("DISZ", 0), "CRVT": ("CURV", 0), "CONN": ("CONI", 0), "SDIA": ("DIAM", 0), "MIND": ("GLAS", 3),
    "MABB": ("GLAS", 4), "MDPG": ("GLAS", 5),
}  # fmt: skip
#: Operands of the system with a number: keyword of the line of the header, and the place of the number in it.
_SYSTEM = {"FLTP": ("FTYP", 0), "PRWV": ("PWAV", 0), "TEMP": ("ENVD", 0), "PRES": ("ENVD", 1)}
#: Operands of a field: its list in the header, and what fields beyond its end have.
_FIELDS = {
    "XFIE": ("XFLN", "0"), "YFIE": ("YFLN", "0"), "FLWT": ("FWGN", "1"), "FVDX": ("VDXN", "0"),
    "FVDY": ("VDYN", "0"), "FVCX": ("VCXN", "0"), "FVCY": ("VCYN", "0"), "FVAN": ("VANN", "0"),
}  # fmt: skip
#: Operands of a wavelength: the place of the number in its line WAVM.
_WAVES = {"WAVE": 1, "WLWT": 2}
#: Operands without effect on rays: titles, notes, weights of configurations, their order, drawing.
_IGNORED = frozenset(("MOFF", "MCOM", "LTTL", "CWGT", "HOLD", "COTN", "LNAM"))
#: Keywords of the stated aperture, which APER changes.
_APERTURES = ("ENPD", "FNUM", "OBNA", "OBSN")
#: Catalogue glass behind its name, as OpticStudio writes it.
_GLASS = ("0", "0", "1.5", "40")


@dataclass(frozen=True)
class Configurations:
    """Number of the configurations of a file, and the one in which it was saved; both from 1."""

    count: int
    active: int

    @classmethod
    def of(cls, file: ZemaxFile) -> Configurations:
        """Return those that a file states; one where it states none."""
        line = file.trailer.last("MNUM")
        count, active = (line.integer(0, 1), line.integer(1, 1)) if line is not None and line.words else (1, 1)
        return cls(max(count, 1), active if 1 <= active <= count else 1)


def with_configuration(file: ZemaxFile, number: int | None, findings: Findings) -> ZemaxFile:
    """Return a file with the values of one configuration, by default of the one it was saved in.

    PrescriptionError if it has no such configuration, or the value of an operand is not as expected; of an operand that
    is not understood too, unless lenient or the configuration is that of the file.
    """
    stated = Configurations.of(file)
    if number is None:
        if stated.count > 1:
            text = f"MNUM {stated.count}: {stated.active} is read, in which the file was saved"
            findings.note(file.header.problem(text), "others are read with configuration = 1, 2...")
        number = stated.active
    if not 1 <= number <= stated.count:
        has = "one configuration" if stated.count == 1 else f"configurations 1 to {stated.count}"
        raise file.header.problem(f"configuration = {number}: the file has {has}")
    if stated.count == 1:
        return file
    changed = _Changes(file, findings if number != stated.active else None)
    for line in _rows(file.trailer, strict=number != stated.active):
        if line.integer(1) == number:
            changed.apply(line)
    if number == stated.active:
        return changed.file
    return with_links_followed(changed.file, file, findings)


def _rows(trailer: Block, *, strict: bool) -> Iterator[Record]:
    """Yield the operands of all configurations, which stand behind MNUM; rows that are none are errors if `strict`."""
    start = next(i for i, line in enumerate(trailer.lines) if line.keyword == "MNUM")
    for line in trailer.lines[start + 1 :]:
        if line.keyword not in (*_IGNORED, *TRAILER):
            is_row = len(line.words) > 2 and line.words[1].isdigit()
            if strict and not is_row:
                raise line.error("a number, that of a configuration, and a value")
            if is_row:
                yield line


class _Changes:
    """Changes of the lines of a file by the operands of a configuration."""

    def __init__(self, file: ZemaxFile, findings: Findings | None) -> None:
        self.file = replace(
            file,
            header=replace(file.header, lines=list(file.header.lines)),
            surfaces=[replace(block, lines=list(block.lines)) for block in file.surfaces],
        )
        #: None where values that are not understood stand in the lines before.
        self.findings = findings

    def apply(self, operand: Record) -> None:
        """Change the lines that an operand is about."""
        kind, header = operand.keyword, self.file.header
        if kind in _SURFACE:
            keyword, place = _SURFACE[kind]
            block = self._surface(operand)
            if keyword != "GLAS" or block.last("GLAS") is not None:
                set_word(block, keyword, place, operand.words[2])
        elif kind in ("GLSS", "PRAM"):
            # Glasses and parameters of the configuration of the file stand in its surfaces.
            if self.findings is not None:
                (self._glass if kind == "GLSS" else self._parameter)(operand)
        elif kind == "STPS":
            for block in self.file.surfaces:
                block.lines[:] = [line for line in block.lines if line.keyword != "STOP"]
            stop_block = self._surface(replace(operand, words=(operand.words[2], *operand.words[1:])))
            stop_block.lines.append(replace(operand, keyword="STOP", words=(), text=""))
        elif kind == "APER" and (stated := [key for key in _APERTURES if header.last(key) is not None]):
            set_word(header, stated[0], 0, operand.words[2])
        elif kind in _SYSTEM:
            set_word(header, *_SYSTEM[kind], operand.words[2])
        elif kind in _FIELDS:
            keyword, filler = _FIELDS[kind]
            older = keyword.replace("N", "D") if keyword in ("XFLN", "YFLN") else ""
            keyword = older if header.last(keyword) is None and older and header.last(older) else keyword
            set_word(header, keyword, operand.integer(0) - 1, operand.words[2], filler)
        elif kind in _WAVES:
            wave = operand.integer(0)
            if self.findings is not None or any(line.integer(0) == wave for line in header.all("WAVM")):
                set_word(header, "WAVM", _WAVES[kind], operand.words[2], matches=lambda line: line.integer(0) == wave)
        elif self.findings is not None:
            text = f"{operand.shown}: this operand of a configuration is not understood"
            self.findings.report(operand.problem(text), "the value of the configuration the file was saved in is taken")

    def _surface(self, operand: Record) -> Block:
        number = operand.integer(0)
        if not 0 <= number < len(self.file.surfaces):
            raise operand.error(f"a surface from 0 to {len(self.file.surfaces) - 1}")
        return self.file.surfaces[number]

    def _glass(self, operand: Record) -> None:
        block, name = self._surface(operand), operand.words[2].strip('"')
        block.lines[:] = [line for line in block.lines if line.keyword != "GLAS"]
        if name:
            words = (name, *_GLASS)
            block.lines.append(replace(operand, keyword="GLAS", words=words, text=" ".join(words), place=block.place))

    def _parameter(self, operand: Record) -> None:
        """Change a parameter of a surface: ``PRAM surface configuration value solve parameter``."""
        number = operand.integer(4)
        block = self._surface(operand)
        same = [line for line in block.lines if line.keyword == "PARM" and line.integer(0) == number]
        if not same:
            block.lines.append(replace(operand, keyword="PARM", words=(str(number), "0"), text="", place=block.place))
        set_word(block, "PARM", 1, operand.words[2], matches=lambda line: line.integer(0) == number)
