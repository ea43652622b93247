"""Ghost paths: light that two surfaces reflect on its way, as telescopes whose surfaces stand in the order of that way.

A surface that transmits light also reflects a little of it, and so does the detector. Light that is reflected at a
surface, goes back, and is reflected again at an earlier one, comes to the detector out of focus. As a list of surfaces
in the order in which the light meets them this is a telescope like any other, and the normal trace serves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import DomainError
from ...models.surface import Interaction, Surface
from ...models.telescope import Telescope


@dataclass(frozen=True)
class GhostPath:
    """One way with two reflections.

    Attributes
    ----------
    first, second : str
        Surfaces that reflect the light, in that order: the second stands before the first in the telescope.
    telescope : Telescope
        The surfaces in the order of the way; those that light meets for a second and third time have "#2" and "#3"
        behind their names.
    source : tuple of int
        Which surface of the real telescope each of them is.
    reflecting : tuple of bool
        Which of them reflect the light though they are no mirrors.
    """

    first: str
    second: str
    telescope: Telescope
    source: tuple[int, ...]
    reflecting: tuple[bool, ...]


def ghost_pairs(telescope: Telescope) -> list[tuple[int, int]]:
    """Return the pairs (first, second) of surfaces, by their places, that can make a ghost.

    The first reflects light that goes towards the detector: a lens surface or the detector. The second, a lens surface
    before it, sends it there again.
    """
    lenses = [i for i, s in enumerate(telescope.surfaces) if s.interaction == Interaction.REFRACT]
    last = len(telescope.surfaces) - 1
    ends = [*lenses, last] if telescope.surfaces[last].interaction == Interaction.DETECTOR else lenses
    return [(j, i) for j in ends for i in lenses if i < j]


def ghost_path(telescope: Telescope, first: int, second: int) -> GhostPath:
    """Return the way of light that is reflected at two surfaces.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    first, second : int
        Places of the surfaces, ``second < first``; the first may be the detector.

    Raises
    ------
    DomainError
        If a place does not exist, the surfaces are the wrong way round, or one of them is a mirror or transmits all.
    """
    surfaces = telescope.surfaces
    if not 0 <= second < first < len(surfaces):
        raise DomainError(
            f"first = {first}, second = {second}: expected 0 <= second < first < {len(surfaces)}, places of surfaces"
        )
    for place in (first, second):
        if surfaces[place].interaction not in (Interaction.REFRACT, Interaction.DETECTOR):
            raise DomainError(f"surface {surfaces[place].name!r}: expected a lens surface or the detector for a ghost")
    before = [telescope.medium_before, *(s.medium_after for s in surfaces)]
    seen: dict[int, int] = {}
    way: list[Surface] = []
    source: list[int] = []

    def meet(place: int, *, reflect: bool = False, back: bool = False) -> None:
        seen[place] = seen.get(place, 0) + 1
        name = surfaces[place].name + (f"#{seen[place]}" if seen[place] > 1 else "")
        step = replace(surfaces[place], name=name)
        if reflect:
            # Light stays in the medium from which it comes: in front of the first, behind the second.
            medium = before[place] if place == first else before[place + 1]
            step = replace(step, interaction=Interaction.MIRROR, medium_after=medium)
        elif back:
            step = replace(step, medium_after=before[place])
        way.append(step)
        source.append(place)

    for place in range(first):
        meet(place)
    meet(first, reflect=True)
    for place in range(first - 1, second, -1):
        meet(place, back=True)
    meet(second, reflect=True)
    for place in range(second + 1, len(surfaces)):
        meet(place)
    reflecting = np.zeros(len(way), dtype=bool)
    reflecting[[first, 2 * first - second]] = True
    return GhostPath(
        first=surfaces[first].name,
        second=surfaces[second].name,
        telescope=replace(telescope, surfaces=tuple(way), groups={}, group_frames={}),
        source=tuple(source),
        reflecting=tuple(bool(v) for v in reflecting),
    )


def fresnel_reflectivity(cosine: np.ndarray, before: float, after: float) -> np.ndarray:
    """Return the reflectivity of a bare interface for unpolarised light (Fresnel's equations).

    Parameters
    ----------
    cosine : ndarray
        Cosines of the angles of incidence.
    before, after : float
        Refractive indices on the side of the light and on the other.

    Returns
    -------
    ndarray
        Part of the light, mean of both polarisations; 1 where all is reflected.
    """
    cosine = np.abs(np.asarray(cosine, dtype=np.float64))
    square = 1.0 - (before / after) ** 2 * (1.0 - cosine**2)
    within = np.sqrt(np.maximum(square, 0.0))
    s = (before * cosine - after * within) / (before * cosine + after * within)
    p = (after * cosine - before * within) / (after * cosine + before * within)
    return np.where(square > 0, 0.5 * (s**2 + p**2), 1.0)
