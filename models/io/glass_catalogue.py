"""Glasses by name, from catalogues in the AGF format of Zemax: of common glasses and of six makers with pachon, or own.

Catalogues state indices relative to air at a reference temperature (20 deg C for most) and one standard atmosphere,
by the wavelength in that air. That is how a glass is handed out, and how Zemax uses it: air then has index 1, and so
has the space between the surfaces. :meth:`GlassCatalogue.in_vacuum` gives the index against vacuum instead.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

from ...core.arguments import check_arguments
from ...core.errors import PrescriptionError, unknown_name
from ..media.air import ZERO_CELSIUS, Air
from ..media.dispersion import FORMULAS, Dispersion
from ..media.medium import Medium, RelativeToAir, Sellmeier
from .bundled import DATA
from .lens.text import Record, read_text, records

BUNDLED = DATA / "glasses.agf"
#: Makers whose catalogues come with the package, in the order in which a glass is looked up.
MAKERS = ("schott", "ohara", "hoya", "hikari", "sumita", "cdgm")
#: Catalogue of crystals, semiconductors and liquids, whose names are NAME_AUTHOR.
SUBSTANCES = "substances"
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
        self._without_hyphens = {name.replace("-", ""): name for name in self._glasses}
        self.source = source

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> GlassCatalogue:
        """Read a catalogue in AGF format, in UTF-8, UTF-16 or ISO 8859-1.

        Raises
        ------
        PrescriptionError
            If the file cannot be read or has no glass, or a line is not understood: file, line, glass and keyword.
        """
        return cls.parse(read_text(Path(path)), str(path))

    @classmethod
    def parse(cls, text: str, source: str) -> GlassCatalogue:
        """Return the catalogue of a text in AGF format; `source` is its name for messages.

        Raises
        ------
        PrescriptionError
            As those of :meth:`read`.
        """
        glasses = {g.name: g for g in _read_glasses(records(text, source))}
        if not glasses:
            raise PrescriptionError("expected a glass catalogue, with lines that begin with NM", file=source)
        return cls(glasses, source)

    @classmethod
    def bundled(cls) -> GlassCatalogue:
        """Return the catalogue of common glasses that comes with pachon."""
        return _bundled()

    @classmethod
    def of_maker(cls, maker: str) -> GlassCatalogue:
        """Return the catalogue of a maker that comes with pachon.

        Parameters
        ----------
        maker : {"schott", "ohara", "hoya", "hikari", "sumita", "cdgm", "substances"}
            The maker; "substances" are crystals, semiconductors and liquids, such as ``"CAF2_DAIMON-20"``.

        Raises
        ------
        UnknownNameError
            If there is none of that maker.
        """
        if maker not in (*MAKERS, SUBSTANCES):
            raise unknown_name("glass maker", maker, (*MAKERS, SUBSTANCES))
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
        """Return the name here of a glass, which may be written without its hyphens (CODE V: NBK7); None if unknown."""
        return name.upper() if name in self else self._without_hyphens.get(name.upper())

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
    catalogue.source = f"the catalogue of {maker}"
    return catalogue


def _read_glasses(lines: list[Record]) -> Iterator[Glass]:
    starts = [i for i, line in enumerate(lines) if line.keyword == "NM"]
    for start, end in pairwise([*starts, len(lines)]):
        yield _read_glass(lines[start:end])


def _read_glass(lines: list[Record]) -> Glass:
    head = lines[0]
    if len(head.words) < 2:
        raise head.error("a name and the number of a dispersion formula")
    name = head.words[0].upper()
    lines_by_keyword: dict[str, Record] = {}
    for line in lines[1:]:
        if line.keyword in ("CD", "TD", "LD"):
            lines_by_keyword[line.keyword] = line
        elif line.keyword not in IGNORED:
            raise line.error(f"CD, TD, LD or one of {', '.join(IGNORED)} in glass {name}")
    if "CD" not in lines_by_keyword:
        raise head.problem(f"glass {name} has no line CD with its coefficients")
    limits = lines_by_keyword.get("LD")
    low, high = (limits.number(0), limits.number(1)) if limits else DEFAULT_RANGE
    celsius = lines_by_keyword["TD"].number(6, 20.0) if "TD" in lines_by_keyword else 20.0
    try:
        medium = _medium(head, lines_by_keyword["CD"], (low / 1e6, high / 1e6))
    except PrescriptionError as error:
        raise (error if error.file else head.problem(f"glass {name}: {error}")) from None
    temperature = celsius + ZERO_CELSIUS
    if not 0 < temperature <= 1000:
        raise lines_by_keyword["TD"].error("a temperature above absolute zero and below 700 deg C as word 7")
    return Glass(name, replace(medium, name=name), _index(head, 3), _index(head, 4), temperature)


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
