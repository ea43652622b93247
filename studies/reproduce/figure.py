"""Figures of Jee & Tyson (2011) that can be reproduced, and the result of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from astropy.io import fits

from ...core.files import write_bytes
from ...core.products import Card, Columns, write_ecsv, write_fits
from ...core.version import VERSION
from .bench import Bench


@dataclass(frozen=True)
class EcsvData:
    """Numbers of a figure as a table: columns as in :func:`~pachon.core.products.write_ecsv`."""

    columns: Columns
    meta: dict[str, Any]


@dataclass(frozen=True)
class FitsData:
    """Images of a figure as FITS extensions, with cards for the primary header."""

    hdus: list[fits.ImageHDU | fits.BinTableHDU]
    cards: Sequence[Card] = field(default_factory=list)


@dataclass(frozen=True)
class Reproduced:
    """One reproduced figure."""

    pictures: dict[str, bytes]  #: PNG, by the suffix of the figure's name in the file name
    data: dict[str, EcsvData | FitsData]  #: numbers of the pictures, by the same suffixes
    here: str  #: the result in words
    agrees: bool | None  #: with the paper; None where the two cannot be compared
    why: str  #: reason of the verdict
    measured: dict[str, Any]  #: metrics behind `here`; keys end in their unit

    @property
    def verdict(self) -> str:
        """The comparison with the paper in words."""
        return "cannot be compared" if self.agrees is None else "agrees" if self.agrees else "differs"

    def write(self, name: str, bench: Bench) -> list[str]:
        """Write pictures and data, each file whole or not at all; return the names of the files."""
        written = []
        origin = {"figure": name, "scale": bench.scale.name, "seed": bench.seed, "pachon": VERSION}
        for suffix, png in self.pictures.items():
            written.append(f"{name}{suffix}.png")
            write_bytes(bench.folder / written[-1], png)
        for suffix, data in self.data.items():
            if isinstance(data, EcsvData):
                written.append(f"{name}{suffix}.ecsv")
                write_ecsv(bench.folder / written[-1], data.columns, {**origin, **data.meta})
            else:
                written.append(f"{name}{suffix}.fits")
                cards = [("FIGURE", name, "of Jee & Tyson 2011"), ("SCALE", bench.scale.name, ""), *data.cards]
                write_fits(bench.folder / written[-1], data.hdus, bench.stamp, cards)
        return written


@dataclass(frozen=True)
class Figure:
    """One figure of the paper."""

    name: str  #: such as ``fig3``
    title: str
    paper: str  #: statement of the paper
    make: Callable[[Bench], Reproduced]
    #: Approximate time on two cores at the scales ``small`` and ``paper``, without the run of the pipeline.
    minutes: tuple[float, float]
    of_run: bool = False  #: needs the run of the pipeline
    of_visits: bool = False  #: needs the stacks of visits
    of_galaxies: bool = False  #: needs the galaxies in them


def figure(
    name: str, title: str, paper: str, *, minutes: tuple[float, float], **needs: bool
) -> Callable[[Callable[[Bench], Reproduced]], Figure]:
    """Return a decorator that makes a :class:`Figure` of a function; `needs` are its ``of_...``."""
    return lambda make: Figure(name, title, paper, make, minutes, **needs)
