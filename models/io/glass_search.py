"""Glasses by name in all catalogues: the bundled ones, then those that the user has configured."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from ...core.errors import nearest
from ..media.medium import Medium
from .glass_catalogue import MAKERS, SUBSTANCES, GlassCatalogue


def find_glass(name: str, first: Iterable[GlassCatalogue] = ()) -> Medium | None:
    """Return the glass of that name, which may lack its hyphens, or None.

    Searched are `first`, the common glasses, the catalogues of makers and of substances, and those of the user, which
    are read only where none before has the glass.
    """
    for catalogue in _all(first):
        spelled_name = catalogue.spelling(name)
        if spelled_name is not None:
            return catalogue[spelled_name]
    return None


def glass_hint(name: str, first: Iterable[GlassCatalogue] = ()) -> str:
    """Return what to do about a glass of no catalogue: the nearest names, and where its data may come from."""
    names = dict.fromkeys(glass for catalogue in _all(first) for glass in catalogue)
    near = nearest(name, names, n=3)
    return f"expected the catalogue of its maker (--glass-catalogue FILE.agf){f'; {near}' if near else ''}"


def _all(first: Iterable[GlassCatalogue]) -> Iterator[GlassCatalogue]:
    yield from first
    yield GlassCatalogue.bundled()
    yield from map(GlassCatalogue.of_maker, (*MAKERS, SUBSTANCES))
    # The section of the configuration takes time to make, and few glasses are in none of those above.
    from .user_glasses import user_catalogues

    yield from map(GlassCatalogue.read, user_catalogues())
