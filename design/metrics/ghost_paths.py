"""Ghost paths: light that two surfaces reflect on its way, as telescopes whose surfaces stand in the order of that way.

A surface that transmits light also reflects a little of it, and so does the detector. Light that is reflected at a
surface, goes back, and is reflected again at an earlier one, comes to the detector out of focus. As a list of surfaces
in the order in which the light meets them this is a telescope like any other, and the normal trace serves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import DomainError, unknown_name
from ...models.surface import Interaction, Surface
from ...models.telescope import Telescope
from ...raytrace.pack.surfaces import refractive_indices
from ...raytrace.rays import Rays, RayStatus
from ...raytrace.trace import trace


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


class Coatings:
    """Reflectivity of every surface that is no mirror."""

    def __init__(self, telescope: Telescope, given: float | Mapping[str, float] | None, detector: float) -> None:
        lenses = [s.name for s in telescope.surfaces if s.interaction == Interaction.REFRACT]
        if isinstance(given, Mapping):
            for name in given:
                if name not in lenses:
                    raise unknown_name(f"lens surface of {telescope.name}", name, lenses)
            table = {name: float(value) for name, value in given.items()}
        else:
            table = {} if given is None else {name: float(given) for name in lenses}
        last = telescope.surfaces[-1]
        if last.interaction == Interaction.DETECTOR:
            table[last.name] = float(detector)
        for name, value in table.items():
            if not 0.0 <= value <= 1.0:
                raise DomainError(f"reflectivity of {name} = {value!r}: expected a number from 0 to 1")
        self._fixed = {i: table[s.name] for i, s in enumerate(telescope.surfaces) if s.name in table}

    def at(self, place: int, cosine: np.ndarray, before: float, after: float) -> np.ndarray:
        """Return the reflectivity for light on its way from one index into another."""
        if place in self._fixed:
            return np.full_like(cosine, self._fixed[place])
        return fresnel_reflectivity(cosine, before, after)


@dataclass(frozen=True)
class GhostLight:
    """Rays of one way on the detector: places and directions in its own frame, and the light they bring."""

    path: GhostPath
    position: np.ndarray
    direction: np.ndarray
    weight: np.ndarray


def follow(path: GhostPath, start: Rays, coatings: Coatings, threads: int | None) -> GhostLight:
    """Trace rays along one way, and what each surface leaves of their light."""
    telescope = path.telescope
    met = trace(telescope, start, "all", threads=threads)
    index = refractive_indices(telescope, start.wavelength)
    weight = (met[-1].status == RayStatus.OK).astype(np.float64)
    coming = start.direction
    for k, (surface, place) in enumerate(zip(telescope.surfaces, path.source, strict=True)):
        going = met[k].direction
        if path.reflecting[k]:
            # A mirror turns a ray by twice the cosine of incidence along the normal.
            cosine = 0.5 * np.linalg.norm(going - coming, axis=-1)
            # The medium on the other side is met on the other ways through this surface.
            weight *= coatings.at(place, cosine, index[k], _other_index(path, k, index))
        elif surface.interaction == Interaction.REFRACT:
            normal = index[k + 1] * going - index[k] * coming
            length = np.linalg.norm(normal, axis=-1)
            with np.errstate(invalid="ignore", divide="ignore"):
                # Between media of equal index there is no normal to be had, and nothing is reflected.
                cosine = np.where(length > 1e-12, (coming * normal).sum(axis=-1) / length, 1.0)
            weight *= 1.0 - coatings.at(place, cosine, index[k], index[k + 1])
        coming = going
    detector = telescope.surfaces[-1]
    lit = weight > 0
    return GhostLight(
        path, detector.to_local(met[-1].position[lit])[:, :2], met[-1].direction[lit] @ detector.matrix, weight[lit]
    )


def _other_index(path: GhostPath, k: int, index: np.ndarray) -> float:
    """Return the index behind a surface that reflects: the way crosses the second one beforehand, the first later."""
    place = path.source[k]
    for other, met in enumerate(path.source):
        if met == place and other != k:
            # Of the two media there, the other one than that in which the light is reflected.
            return float(index[other + 1] if other > k else index[other])
    return float(index[k])
