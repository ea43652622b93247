"""Glasses by name in all catalogues: the bundled ones, then those that the user has configured."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np

from ...core.errors import PrescriptionError, nearest
from ..media.medium import LINE_C, LINE_D, LINE_F, Medium
from .glass_catalogue import CATALOGUES, FURTHER_MAKERS, MAKERS, OBSOLETE, SUBSTANCES, GlassCatalogue
from .lens.source import Findings

#: Words in the names of catalogues, as lens files state them, by the bundled catalogue: Nikon's glasses are Hikari's.
_WORDS = {
    "NIKON": "hikari", "SCHO": "schott", "CORN": "corning", "INFRARED": SUBSTANCES,
    **{maker.upper(): maker for maker in (*MAKERS, *FURTHER_MAKERS)},
}  # fmt: skip
#: Difference of the indices of one glass in two editions of its maker's catalogue.
_SAME = 1e-8
#: Catalogues of users that are kept in memory.
_MOST_CATALOGUES = 64


def find_glass(name: str, first: Iterable[GlassCatalogue] = (), makers: Iterable[str] = ()) -> Medium | None:
    """Return the glass of that name, which may lack its hyphens, or None.

    Searched are `first`, the catalogues of the `makers` that a lens file states, the common glasses, the catalogues of
    all makers and of substances, and those of the user, which are read only where none before has the glass.
    """
    common = GlassCatalogue.bundled()
    for catalogue in first:
        if (spelled_name := catalogue.spelling(name)) is not None:
            return catalogue[spelled_name]
    for catalogue in map(GlassCatalogue.of_maker, makers):
        if (spelled_name := catalogue.spelling(name)) is not None:
            medium = catalogue[spelled_name]
            is_common = spelled_name in common and _same_index(common[spelled_name], medium)
            return common[spelled_name] if is_common else medium
    for catalogue in _all():
        if (spelled_name := catalogue.spelling(name)) is not None:
            return catalogue[spelled_name]
    return None


def makers_in(words: Iterable[str]) -> tuple[str, ...]:
    """Return the bundled catalogues that the names of catalogues in a lens file stand for, in their order."""
    makers = dict.fromkeys(maker for word in words for key, maker in _WORDS.items() if key in word.upper())
    return tuple(catalogue for maker in makers for catalogue in ((maker, OBSOLETE) if maker == MAKERS[0] else (maker,)))


def maker_of(medium: Medium) -> str | None:
    """Return the maker whose bundled catalogue has a glass under its name; None if none has."""
    names = [c for c in CATALOGUES[:-1] if medium.name in GlassCatalogue.of_maker(c)]
    equal = (c for c in names if find_glass(medium.name, makers=(c,)) == medium)
    catalogue = next(equal, None)
    return MAKERS[0] if catalogue == OBSOLETE else catalogue


def glass_hint(name: str, first: Iterable[GlassCatalogue] = ()) -> str:
    """Return what to do about a glass of no catalogue: the nearest names, and where its data may come from."""
    names = dict.fromkeys(glass for catalogue in (*first, *_all()) for glass in catalogue)
    near = nearest(name, names, n=3)
    return f"expected the catalogue of its maker (--glass-catalogue FILE.agf){f'; {near}' if near else ''}"


def _same_index(first: Medium, second: Medium) -> bool:
    lines = np.array([LINE_D, LINE_F, LINE_C]) * 1e-6
    return bool(np.allclose(first.index(lines), second.index(lines), rtol=0.0, atol=_SAME))


def readable_catalogues(paths: Iterable[Path]) -> list[GlassCatalogue]:
    """Return the catalogues of files; of a file that cannot be read there is a warning."""
    catalogues = []
    for path in paths:
        try:
            catalogues.append(_catalogue(path, path.stat().st_mtime_ns))
        except (OSError, PrescriptionError) as error:
            problem = error if isinstance(error, PrescriptionError) else PrescriptionError(str(error), file=path)
            Findings().note(problem, "this glass catalogue is left out")
    return catalogues


@lru_cache(maxsize=_MOST_CATALOGUES)
def _catalogue(path: Path, modified: int) -> GlassCatalogue:
    """Return the catalogue of a file as it was at a time [ns]: warnings of its lines come once."""
    return GlassCatalogue.read(path)


def _all() -> Iterator[GlassCatalogue]:
    yield GlassCatalogue.bundled()
    yield from map(GlassCatalogue.of_maker, CATALOGUES)
    # The section of the configuration takes time to make, and few glasses are in none of those above.
    from .user_glasses import user_catalogues

    yield from readable_catalogues(user_catalogues())
