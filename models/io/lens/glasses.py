"""Media of a lens file: glasses that it names, and those that it describes by numbers."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from ....core.errors import PrescriptionError
from ...media.dispersion import model_glass
from ...media.medium import LINE_D, Medium, abbe_number, with_index_change
from ..glass_catalogue import GlassCatalogue
from ..glass_search import find_glass, glass_hint, makers_in, readable_catalogues
from .source import Source


class Glasses:
    """Catalogues in which the glasses of a lens file are looked up: stated ones, and one beside the file, first."""

    def __init__(self, path: Path, catalogues: Iterable[GlassCatalogue | str | os.PathLike[str]]) -> None:
        self.first = [c if isinstance(c, GlassCatalogue) else GlassCatalogue.read(c) for c in catalogues]
        beside = path.with_suffix(".agf")
        self.first += readable_catalogues([beside]) if beside.is_file() else []

    def get(self, name: str, catalogues: Iterable[str] = ()) -> Medium | None:
        """Return the glass of a name, or None; `catalogues` are the names of those that the file states."""
        return find_glass(name.upper(), self.first, makers_in(catalogues))

    def named(self, name: str, source: Source, catalogues: Iterable[str] = ()) -> Medium:
        """Return the glass of a name; PrescriptionError of the statement if no catalogue has it."""
        medium = self.get(name, catalogues)
        if medium is None:
            raise self.missing(name, source)
        return medium

    def missing(self, name: str, source: Source) -> PrescriptionError:
        """Return the error of a glass that no catalogue has."""
        hint = glass_hint(name.upper(), self.first)
        return source.problem(f"{source.shown}: the glass is in no catalogue: {hint}")


def numbered_glass(nd: float, vd: float, deviation: float, name: str, source: Source) -> Medium:
    """Return the model glass of an index, an Abbe number and a deviation; PrescriptionError of the statement."""
    with source.context():
        return replace(model_glass(nd, vd, deviation), name=name)


def offset_glass(medium: Medium, index_change: float, abbe_change: float, source: Source) -> Medium:
    """Return a glass with another index and Abbe number at the d line; PrescriptionError of the statement."""
    if not (index_change or abbe_change):
        return medium
    with source.context():
        nd, abbe = float(medium.index(LINE_D * 1e-6)), abbe_number(medium)
        if not abbe + abbe_change > 0:
            raise source.error("an Abbe number above 0")
        # The Abbe number is that of the changed index.
        dispersion = (nd - 1.0 + index_change) / (nd - 1.0) * abbe / (abbe + abbe_change)
        return with_index_change(medium, index_change, dispersion)
