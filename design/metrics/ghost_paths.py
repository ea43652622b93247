"""Ghost paths: light that two surfaces reflect, as telescopes with the surfaces in the order of the light.

A surface that transmits light also reflects a little of it, and so does the detector. Light that is reflected at a
surface, goes back, and is reflected again at an earlier one, arrives at the detector out of focus. The list of surfaces
in the order in which the light meets them is a telescope like any other, for the ordinary trace.
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
    """One path with two reflections: at `first`, then at `second`, which stands before it in the telescope."""

    first: str
    second: str
    telescope: Telescope  #: surfaces in the order of the light; those that it meets again are named "#2", "#3"
    source: tuple[int, ...]  #: index of each of them in the real telescope
    reflecting: tuple[bool, ...]  #: whether each reflects the light without being a mirror


def ghost_pairs(telescope: Telescope) -> list[tuple[int, int]]:
    """Return the pairs (first, second) of indices of surfaces that can make a ghost.

    The first is a lens surface or the detector, the second a lens surface before it.
    """
    lenses = [i for i, s in enumerate(telescope.surfaces) if s.interaction == Interaction.REFRACT]
    last = len(telescope.surfaces) - 1
    ends = [*lenses, last] if telescope.surfaces[last].interaction == Interaction.DETECTOR else lenses
    return [(j, i) for j in ends for i in lenses if i < j]


def ghost_path(telescope: Telescope, first: int, second: int) -> GhostPath:
    """Return the path of light that is reflected at two surfaces, by their indices; the first may be the detector."""
    surfaces = telescope.surfaces
    if not 0 <= second < first < len(surfaces):
        raise DomainError(
            f"first = {first}, second = {second}: expected 0 <= second < first < {len(surfaces)}, places of surfaces"
        )
    for place in (first, second):
        if surfaces[place].interaction not in (Interaction.REFRACT, Interaction.DETECTOR):
            raise DomainError(f"surface {surfaces[place].name!r}: expected a lens surface or the detector for a ghost")
    before = [telescope.medium_before, *(s.medium_after for s in surfaces)]
    turn = 2 * first - second
    source = (*range(first), *range(first, second, -1), *range(second, len(surfaces)))
    path: list[Surface] = []
    for k, place in enumerate(source):
        surface, times = surfaces[place], source[: k + 1].count(place)
        path.append(
            replace(
                surface,
                name=surface.name + (f"#{times}" if times > 1 else ""),
                interaction=Interaction.MIRROR if k in (first, turn) else surface.interaction,
                # From the first reflection to the second, light goes back: into the medium in front of a surface.
                medium_after=before[place] if first <= k < turn else before[place + 1],
            )
        )
    return GhostPath(
        first=surfaces[first].name,
        second=surfaces[second].name,
        telescope=replace(telescope, surfaces=tuple(path), groups={}, group_frames={}),
        source=source,
        reflecting=tuple(k in (first, turn) for k in range(len(path))),
    )


def fresnel_reflectivity(cosine: np.ndarray, before: float, after: float) -> np.ndarray:
    """Return the reflectivity of a bare interface for unpolarised light (Fresnel's equations); 1 at total reflection.

    The refractive indices are those on the side of the light and on the other.
    """
    cosine = np.abs(np.asarray(cosine, dtype=np.float64))
    square = 1.0 - (before / after) ** 2 * (1.0 - cosine**2)
    within = np.sqrt(np.maximum(square, 0.0))
    s = (before * cosine - after * within) / (before * cosine + after * within)
    p = (after * cosine - before * within) / (after * cosine + before * within)
    return np.where(square > 0, 0.5 * (s**2 + p**2), 1.0)


class Coatings:
    """Reflectivity of every surface that is not a mirror."""

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
        """Return the reflectivity for light from one refractive index to another."""
        if place in self._fixed:
            return np.full_like(cosine, self._fixed[place])
        return fresnel_reflectivity(cosine, before, after)


@dataclass(frozen=True)
class GhostLight:
    """Rays of one path on the detector: positions and directions in its own frame, and their light."""

    path: GhostPath
    position: np.ndarray
    direction: np.ndarray
    weight: np.ndarray


def follow(path: GhostPath, start: Rays, coatings: Coatings, threads: int | None) -> GhostLight:
    """Trace rays along one path, with the light that each surface reflects or transmits."""
    telescope = path.telescope
    met = trace(telescope, start, "all", threads=threads)
    index = refractive_indices(telescope, start.wavelength)
    weight = (met[-1].status == RayStatus.OK).astype(np.float64)
    coming = start.direction
    for k, (surface, place) in enumerate(zip(telescope.surfaces, path.source, strict=True)):
        going = met[k].direction
        if path.reflecting[k]:
            # A mirror changes a direction by twice the cosine of incidence along the normal.
            cosine = 0.5 * np.linalg.norm(going - coming, axis=-1)
            weight *= coatings.at(place, cosine, index[k], _other_index(path, k, index))
        elif surface.interaction == Interaction.REFRACT:
            normal = index[k + 1] * going - index[k] * coming
            length = np.linalg.norm(normal, axis=-1)
            with np.errstate(invalid="ignore", divide="ignore"):
                # Between media of equal index the normal is undefined, and nothing is reflected.
                cosine = np.where(length > 1e-12, (coming * normal).sum(axis=-1) / length, 1.0)
            weight *= 1.0 - coatings.at(place, cosine, index[k], index[k + 1])
        coming = going
    detector = telescope.surfaces[-1]
    lit = weight > 0
    return GhostLight(
        path, detector.to_local(met[-1].position[lit])[:, :2], met[-1].direction[lit] @ detector.matrix, weight[lit]
    )


def _other_index(path: GhostPath, k: int, index: np.ndarray) -> float:
    """Return the index behind a reflecting surface, from where the path crosses that surface."""
    place = path.source[k]
    for other, met in enumerate(path.source):
        if met == place and other != k:
            return float(index[other + 1] if other > k else index[other])
    return float(index[k])
