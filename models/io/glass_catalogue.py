"""Glasses by name, from catalogues in the AGF format of Zemax: of common glasses and of six makers with pachon, or own.

Catalogues state indices relative to air at a reference temperature (20 deg C for most) and one standard atmosphere,
by the wavelength in that air. That is how a glass is handed out, and how Zemax uses it: air then has index 1, and so
has the space between the surfaces. :meth:`GlassCatalogue.in_vacuum` gives the index against vacuum instead.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

from ...core.arguments import check_arguments
from ...core.errors import PrescriptionError, cut_short, unknown_name
from ..media.air import ZERO_CELSIUS, Air
from ..media.dispersion import FORMULAS, Dispersion
from ..media.medium import Medium, RelativeToAir, Sellmeier
from .bundled import DATA
from .lens.source import Findings
from .lens.text import Record, read_text, records, scaled

BUNDLED = DATA / "glasses.agf"
#: Makers whose catalogues come with the package, in the order in which a glass is looked up.
MAKERS = ("schott", "ohara", "hoya", "hikari", "sumita", "cdgm")
#: Catalogue of Schott's glasses that are no longer made; it is looked up behind Schott's present one.
OBSOLETE = "schott_obsolete"
#: Catalogue of crystals, semiconductors and liquids, whose names are NAME_AUTHOR.
SUBSTANCES = "substances"
#: Further makers, whose catalogues are small or old; they are looked up behind the others.
FURTHER_MAKERS = ("corning", "lzos", "heraeus")
#: Bundled catalogues, in the order in which a glass is looked up.
CATALOGUES = (MAKERS[0], OBSOLETE, *MAKERS[1:], *FURTHER_MAKERS, SUBSTANCES)
DEFAULT_RANGE = (0.3, 2.5)

#: Formula numbers of the format; 2, 6 and 11 are Sellmeier's formula with three, four and five terms.
NUMBERED = {
    1: "schott",
    3: "herzberger",
    4: "sellmeier_2",
    5: "conrady",
    7: "handbook_1",
    8: "handbook_2",
    9: "sellmeier_4",
    10: "extended",
    12: "extended_2",
    13: "extended_3",
}
SELLMEIER_TERMS = {2: 3, 6: 4, 11: 5}
#: Lines without effect on the index: comments, expansion, cost and resistance, transmission, stress, mechanics.
IGNORED = ("CC", "GC", "ED", "OD", "IT", "BD", "MD")
#: Lines with numbers: coefficients of the formula, thermal ones, limits of the wavelength.
_DATA = ("CD", "TD", "LD")
#: Number that begins a line.
_NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)(E[-+]?\d+)?"
#: Hyphens of names, and what other programs have for them.
_HYPHENS = str.maketrans("", "", "-_")
#: Temperature [K] of reference of a glass whose catalogue states none.
USUAL_TEMPERATURE = 20.0 + ZERO_CELSIUS


@dataclass(frozen=True)
class Glass:
    """An entry of a catalogue.

    Index and wavelength of the medium are relative to air; `nd` (index at the d line) and `vd` (Abbe number) are as the
    catalogue states them, 0 where it does not; `temperature` [K] is that of reference; the name is in capitals.
    """

    name: str
    medium: Medium
    nd: float
    vd: float
    temperature: float


@check_arguments
class GlassCatalogue:
    """Glasses by name; names do not depend on the case.

    Parameters
    ----------
    glasses : mapping of str to Glass
        Entries by name in capitals.
    source : str
        Name of the catalogue, for messages.
    """

    def __init__(self, glasses: Mapping[str, Glass], source: str) -> None:
        self._glasses = dict(glasses)
        self._without_hyphens = {name.translate(_HYPHENS): name for name in self._glasses}
        self.source = source

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> GlassCatalogue:
        """Read a catalogue in AGF format, in UTF-8, UTF-16 or ISO 8859-1.

        A line that cannot be read is left out, and with it its glass where it needs the line; a PrescriptionNote
        names file, line, glass and keyword.

        Raises
        ------
        PrescriptionError
            If the file cannot be read, or has no glass that can be.
        """
        return cls.parse(read_text(Path(path)), str(path))

    @classmethod
    def parse(cls, text: str, source: str) -> GlassCatalogue:
        """Return the catalogue of a text in AGF format; `source` is its name for messages.

        Of lines that cannot be read there are warnings, as in :meth:`read`.

        Raises
        ------
        PrescriptionError
            As those of :meth:`read`.
        """
        glasses, problems = _read_glasses(records(text, source))
        if not glasses:
            wrong = PrescriptionError("expected a glass catalogue, with lines that begin with NM", file=source)
            raise problems[0] if problems else wrong
        for problem in problems:
            Findings().note(problem, "left out")
        return cls({glass.name: glass for glass in glasses}, source)

    @classmethod
    def bundled(cls) -> GlassCatalogue:
        """Return the catalogue of common glasses that comes with pachon."""
        return _bundled()

    @classmethod
    def of_maker(cls, maker: str) -> GlassCatalogue:
        """Return the catalogue of a maker that comes with pachon.

        Parameters
        ----------
        maker : {"schott", "schott_obsolete", "ohara", "hoya", "hikari", "sumita", "cdgm", "corning", "lzos", ...}
            The maker, also "heraeus"; "schott_obsolete" are Schott's glasses that are no longer made, such as
            ``"SK5"``, "substances" crystals, semiconductors and liquids, such as ``"CAF2_DAIMON-20"``.

        Raises
        ------
        UnknownNameError
            If there is none of that maker.
        """
        if maker not in CATALOGUES:
            raise unknown_name("glass maker", maker, CATALOGUES)
        return _of_maker(maker)

    def __getitem__(self, name: str) -> Medium:
        """Return a glass as catalogues state it: relative to air, by wavelength in air.

        Raises
        ------
        UnknownNameError
            If the catalogue has no such glass.
        """
        return self.entry(name).medium

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and name.upper() in self._glasses

    def __iter__(self) -> Iterator[str]:
        return iter(self._glasses)

    def __len__(self) -> int:
        return len(self._glasses)

    def spelling(self, name: str) -> str | None:
        """Return the name here of a glass, whose hyphens may lack (CODE V: NBK7) or be underscores; None if unknown."""
        return name.upper() if name in self else self._without_hyphens.get(name.upper().translate(_HYPHENS))

    def entry(self, name: str) -> Glass:
        """Return the entry of a glass.

        Raises
        ------
        UnknownNameError
            If the catalogue has no such glass.
        """
        if name.upper() not in self._glasses:
            raise unknown_name(f"glass of {self.source}", name, self._glasses)
        return self._glasses[name.upper()]

    def in_vacuum(self, name: str) -> Medium:
        """Return a glass with its index against vacuum, by vacuum wavelength: for telescopes whose space is vacuum.

        The air of the catalogue is dry air at its reference temperature and one atmosphere (Ciddor 1996). Change of the
        glass with temperature is left out.
        """
        glass = self.entry(name)
        return RelativeToAir(glass.medium, Air(temperature=glass.temperature))


@cache
def _bundled() -> GlassCatalogue:
    catalogue = GlassCatalogue.read(BUNDLED)
    catalogue.source = "the bundled catalogue"
    return catalogue


@cache
def _of_maker(maker: str) -> GlassCatalogue:
    catalogue = GlassCatalogue.read(DATA / "glasses" / f"{maker}.agf")
    catalogue.source = "Schott's catalogue of obsolete glasses" if maker == OBSOLETE else f"the catalogue of {maker}"
    return catalogue


def _read_glasses(lines: list[Record]) -> tuple[list[Glass], list[PrescriptionError]]:
    """Return the glasses of a catalogue, and the problems of lines that cannot be read, which are left out."""
    starts = [i for i, line in enumerate(lines) if line.keyword == "NM"]
    glasses: list[Glass] = []
    problems: list[PrescriptionError] = []
    for start, end in pairwise([*starts, len(lines)]):
        try:
            glasses.append(_read_glass(lines[start], _data_lines(lines[start:end], problems), problems))
        except PrescriptionError as error:
            problems.append(error)
    return glasses, problems


def _data_lines(lines: list[Record], problems: list[PrescriptionError]) -> dict[str, Record]:
    """Return the lines of a glass with numbers, by keyword; of several lines with one keyword, their numbers in a row.

    A line that begins with a number goes on with the line before it.
    """
    data: dict[str, Record] = {}
    keyword = ""
    for line in lines[1:]:
        is_number = re.fullmatch(_NUMBER, line.keyword) is not None
        keyword, words = (keyword, (line.keyword, *line.words)) if is_number else (line.keyword, line.words)
        if keyword in _DATA:
            first = data.get(keyword)
            data[keyword] = line if first is None else replace(first, words=(*first.words, *words))
        elif keyword not in IGNORED:
            name = cut_short(" ".join(lines[0].words[:1]))
            # Numbers on the next lines are those of this one.
            keyword = IGNORED[0]
            problems.append(line.error(f"{', '.join(_DATA)} or one of {', '.join(IGNORED)} in glass {name}"))
    return data


def _read_glass(head: Record, data: Mapping[str, Record], problems: list[PrescriptionError]) -> Glass:
    if len(head.words) < 2:
        raise head.error("a name and the number of a dispersion formula")
    name = head.words[0].upper()
    if "CD" not in data:
        raise head.problem(f"glass {name} has no line CD with its coefficients")
    limits = data.get("LD")
    low, high = (limits.number(0), limits.number(1)) if limits else DEFAULT_RANGE
    try:
        # A wavelength at the end of the range is the same float there, also where the file has it in other units.
        medium = _medium(head, data["CD"], (scaled(low, -6), scaled(high, -6)))
    except PrescriptionError as error:
        raise (error if error.file else head.problem(f"glass {name}: {error}")) from None
    temperature = USUAL_TEMPERATURE
    try:
        temperature = _temperature(data["TD"]) if "TD" in data else temperature
    except PrescriptionError as error:
        problems.append(error)
    return Glass(name, replace(medium, name=name), _index(head, 3), _index(head, 4), temperature)


def _temperature(line: Record) -> float:
    """Return the temperature [K] of reference."""
    temperature = line.number(6, USUAL_TEMPERATURE - ZERO_CELSIUS) + ZERO_CELSIUS
    if not 0 < temperature <= 1000:
        raise line.error("a temperature above absolute zero and below 700 deg C as word 7")
    return temperature


def _index(head: Record, position: int) -> float:
    """Return an index or Abbe number for the record; catalogues have a dash where it is unknown."""
    try:
        return head.number(position, 0.0)
    except PrescriptionError:
        return 0.0


def _medium(head: Record, line: Record, limits: tuple[float, float]) -> Sellmeier | Dispersion:
    number = head.integer(1)
    coefficients = [line.number(i) for i in range(len(line.words))]
    if number in SELLMEIER_TERMS:
        size = 2 * SELLMEIER_TERMS[number]
        _check_rest(line, coefficients, size)
        padded = (coefficients + [0.0] * size)[:size]
        pairs = [(b, c) for b, c in zip(padded[::2], padded[1::2], strict=True) if b != 0] or [(0.0, 0.0)]
        b, c = zip(*pairs, strict=True)
        return Sellmeier(b, c, limits)
    if number not in NUMBERED:
        raise head.error("a dispersion formula from 1 to 13")
    formula = NUMBERED[number]
    size = FORMULAS[formula].size
    _check_rest(line, coefficients, size)
    return Dispersion(formula, tuple(coefficients[:size]), limits)


def _check_rest(line: Record, coefficients: list[float], size: int) -> None:
    if any(coefficients[size:]):
        raise line.error(f"{size} coefficients for this formula, and zeros after them")
