"""Parts of a Zemax lens file (.zmx): header, surfaces, and the keywords that are ignored.

A file is a list of lines "KEYWORD words". The header is followed by one block for each surface, which begins with SURF
and whose lines are indented, by merit function and tolerances, which are not read, and by `configurations`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from ....core.errors import PrescriptionError, cut_short
from ....core.files import text_lines
from ...media.medium import Medium
from ..lens.source import Findings
from ..lens.text import Record, read_text, records

#: Keywords of the header without effect on rays: notes, names of other files, analysis and display settings,
#: weights. Vignetting factors (VDXN...) and ray aiming (RAIM) select the rays that Zemax launches, not their paths.
_HEADER = """
VERS MODE NAME AUTH NOTE IWDP PFIL LANG GFAC GCAT RAIM PUSH SDMA OMMA ROPD HYPR PICB FWGN FWGT FCOM VDXN VDYN VCXN
VCYN VANN ZVDX ZVDY ZVCX ZVCY ZVAN VDSX VDSY WWGT WWGN POLS GLRS GSTD NSCD COFN LUID EERA OPDX PUPD EFFL DMFS CONF
PMAG TOTR TRAC TOLE TCOM MNCA MNEA MNCG MNEG MXCA MXCG RGLA TCMM ISNA STAG SSAG XPIX YPIX FTIT DFLT RSCE DBDT STUD
"""
#: Keywords of a surface without effect on rays: comments, coatings, scatter, drawing and tolerancing settings,
#: automatic semi-diameters, and solves, variables and pick-ups, whose solution stands in the file.
_SURFACE = """
COMM SSID SLAB HIDE MIRR POPS COAT FIMP SCAT STRE MEMA DIAM EDGE TCED TCEC TCMM EXPN LBLK CHZN BORE PICK CCOM VCUR
VDSZ VPAR VCON VGLA VXDT VDIA PZUP PCUP PPAR PXDT PCOP PDIA PGLA PKUP CPKP MAZH MARG CHAZ CHAA POSI COMP CURF GLCZ
TCOM TOLE RSCE TRAC FNOT BRKS SPAC ROWC SCOL STUD OEMA
"""
#: Keywords that only stand after the surfaces, for files without indentation.
TRAILER = ("BLNK", "TOL", "MNUM", "MOFF")
IGNORED_HEADER = frozenset(_HEADER.split())
IGNORED_SURFACE = frozenset(_SURFACE.split())


@dataclass
class Block:
    """Lines that belong together: the header, or a surface.

    `file` is its name and `place` the part of it (``"surface 3"``, empty for a header), for messages. `used` holds
    the keywords that have been read.
    """

    file: str
    place: str = ""
    lines: list[Record] = field(default_factory=list)
    used: set[str] = field(default_factory=set)

    def problem(self, text: str) -> PrescriptionError:
        """Return an error of this block."""
        return PrescriptionError(text, file=self.file, place=self.place or None)

    def all(self, keyword: str) -> list[Record]:
        """Return every line with a keyword."""
        self.used.add(keyword)
        return [line for line in self.lines if line.keyword == keyword]

    def last(self, keyword: str) -> Record | None:
        """Return the last line with a keyword, or None."""
        records = self.all(keyword)
        return records[-1] if records else None

    def number(self, keyword: str, default: float, position: int = 0, *, infinite: bool = False) -> float:
        """Return a number of the last line with a keyword, or a default where there is no such line."""
        line = self.last(keyword)
        return default if line is None else line.number(position, infinite=infinite)

    def text(self, keyword: str) -> str:
        """Return what follows a keyword on its last line; empty where there is no such line."""
        line = self.last(keyword)
        return "" if line is None else line.text.strip('" ')

    def table(self, keyword: str) -> dict[int, float]:
        """Return the numbers of lines "KEYWORD position number", by position."""
        return {line.integer(0): line.number(1) for line in self.all(keyword)}

    def report_rest(self, ignored: frozenset[str], findings: Findings) -> None:
        """Report every keyword that was neither read nor is among those to ignore."""
        for line in self.lines:
            if line.keyword not in self.used and line.keyword not in ignored:
                findings.report(line.problem(f"{line.shown}: this keyword is not understood"))


@dataclass
class ZemaxFile:
    """Parts of a lens file: lines before the surfaces, surfaces from the object to the image, lines after.

    `glasses` are those of catalogues packed with it, by name in capitals. The thickness of surfaces with a number in
    `solved` is that at which the paraxial marginal ray meets the axis, and not the one that is stated.
    """

    path: Path
    header: Block
    surfaces: list[Block]
    trailer: Block
    glasses: Mapping[str, Medium] = field(default_factory=dict)
    solved: frozenset[int] = frozenset()


def read_zemax_file(path: Path) -> ZemaxFile:
    """Return the parts of a lens file; PrescriptionError if it is not sequential or has fewer than three surfaces."""
    return parse_zemax_file(read_text(path), path)


def parse_zemax_file(text: str, path: Path) -> ZemaxFile:
    """Return the parts of the text of a lens file, as :func:`read_zemax_file` does; `path` is for messages."""
    source = str(path)
    indented = {i for i, line in enumerate(text_lines(text), start=1) if line[:1].isspace()}
    header = trailer = Block(source)
    current = header
    surfaces: list[Block] = []
    for record in records(text, source):
        if record.keyword == "SURF":
            if record.integer(0) != len(surfaces):
                raise record.error(f"surface {len(surfaces)} here")
            current = Block(source, f"surface {len(surfaces)}")
            surfaces.append(current)
        elif surfaces and (record.keyword in TRAILER or (indented and record.line not in indented)):
            # Lines at the margin after the surfaces belong to none of them.
            current = trailer = Block(source) if trailer is header else trailer
            current.lines.append(replace(record, place=""))
        else:
            current.lines.append(record)
    mode = header.text("MODE")
    if mode and mode.upper() != "SEQ":
        raise header.problem(f"MODE {mode}: expected SEQ, a sequential lens")
    if len(surfaces) < 3:
        raise header.problem(f"{len(surfaces)} surfaces (SURF): expected an object, an image and one between")
    file = ZemaxFile(path, header, surfaces, trailer)
    if trailer is header:
        file.trailer = Block(source)
    return file


def set_word(
    block: Block,
    keyword: str,
    place: int,
    word: str,
    filler: str = "0",
    matches: Callable[[Record], bool] | None = None,
) -> None:
    """Put a word in its place in the last line with a keyword that matches, or in a new line where there is none."""
    places = [i for i, line in enumerate(block.lines) if line.keyword == keyword and (matches is None or matches(line))]
    if place < 0 or (matches is not None and not places):
        raise block.problem(f"{keyword}: {cut_short(word)}: expected a field or wavelength that the file has")
    if not places:
        block.lines.append(Record(block.file, block.place, keyword))
        places = [len(block.lines) - 1]
    line = block.lines[places[-1]]
    words = [*line.words, *[filler] * (place + 1 - len(line.words))]
    words[place] = word
    block.lines[places[-1]] = replace(line, words=tuple(words), text=" ".join(words))
