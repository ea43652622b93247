"""Paths of ghosts: light that is reflected at two surfaces, with what each surface reflects and transmits.

A surface that transmits light also reflects a little of it, and so does the detector. Light that is reflected at a
surface, goes back, and is reflected again at an earlier one, arrives at the detector out of focus. Each stretch of such
a path is a telescope like any other, for the ordinary trace; stretches that several ghosts share are traced once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import DomainError, unknown_name
from ...core.threads import thread_count
from ...models.camera.focal_plane import FocalPlane
from ...models.media.medium import Medium
from ...models.surface import Interaction, Surface
from ...models.telescope import Telescope
from ...raytrace.pack.surfaces import refractive_indices
from ...raytrace.rays import Rays, RayStatus
from ...raytrace.trace import trace
from ..analyses.coatings import Coatings
from ..analyses.fresnel import fresnel_reflectivity, refracted_reflectivity


def ghost_pairs(telescope: Telescope) -> list[tuple[int, int]]:
    """Return the pairs (first, second) of indices of surfaces that can make a ghost.

    The first is a lens surface or the detector, the second a lens surface before it. Gratings, whose light goes into
    other orders too, are none of them.
    """
    lenses = [i for i, s in enumerate(telescope.surfaces) if s.interaction == Interaction.REFRACT and not s.grating]
    last = len(telescope.surfaces) - 1
    ends = [*lenses, last] if telescope.surfaces[last].interaction == Interaction.DETECTOR else lenses
    return [(j, i) for j in ends for i in lenses if i < j]


class Reflectivities:
    """Reflectivity of every surface that is not a mirror, at a wavelength [m].

    It is the one that is given; else what the coating of the surface does not transmit; else that of bare glass.
    """

    def __init__(
        self,
        telescope: Telescope,
        stated: float | Mapping[str, float] | None,
        detector: float,
        coatings: Coatings,
        wavelength: float,
    ) -> None:
        lenses = [s.name for s in telescope.surfaces if s.interaction == Interaction.REFRACT and not s.grating]
        if isinstance(stated, Mapping):
            for name in stated:
                if name not in lenses:
                    raise unknown_name(f"lens surface of {telescope.name}", name, lenses)
            table = {name: float(value) for name, value in stated.items()}
        else:
            table = {} if stated is None else {name: float(stated) for name in lenses}
        last = telescope.surfaces[-1]
        if last.interaction == Interaction.DETECTOR:
            table[last.name] = float(detector)
        for name in coatings.surfaces:
            if name not in telescope.surface_names:
                raise unknown_name(f"surface of {telescope.name}", name, telescope.surface_names)
        self._fixed = {i: table[s.name] for i, s in enumerate(telescope.surfaces) if s.name in table}
        self._coated = {i: s.name for i, s in enumerate(telescope.surfaces) if s.name in coatings.surfaces}
        self._coatings, self._wavelength = coatings, wavelength

    def reflected(self, place: int, turn: np.ndarray, before: float, after: float) -> np.ndarray | float:
        """Return the reflectivity for light that is reflected, from the cosine of the angle by which that turns it."""
        if place in self._fixed:
            return self._fixed[place]
        cosine = np.sqrt(np.maximum(0.5 * (1.0 - turn), 0.0))
        if place in self._coated:
            return self._coating(place, cosine, before, after)
        return fresnel_reflectivity(cosine, before, after)

    def refracted(self, place: int, turn: np.ndarray, before: float, after: float) -> np.ndarray | float:
        """Return the reflectivity for light that is refracted, from the cosine of the angle by which that turns it."""
        if place in self._fixed:
            return self._fixed[place]
        if place in self._coated:
            # As in refracted_reflectivity; without a refraction the angle of incidence cannot be told from the turn.
            length = np.sqrt(before * before + after * after - 2.0 * before * after * turn)
            return self._coating(place, np.abs(after * turn - before) / length, before, after)
        return refracted_reflectivity(turn, before, after)

    def _coating(self, place: int, cosine: np.ndarray, before: float, after: float) -> np.ndarray:
        """Return what a coating does not transmit, from the cosine of the angle of incidence."""
        name = self._coated[place]
        reflectivity = 1.0 - self._coatings.surfaces[name].efficiency(self._wavelength, cosine, before, after)
        if (np.isnan(reflectivity) & ~np.isnan(cosine)).any():
            raise DomainError(f"coating of {name}: expected a table that reaches the angles of all ghosts")
        return np.asarray(np.clip(reflectivity, 0.0, 1.0))


@dataclass(frozen=True)
class GhostLight:
    """Rays of one ghost on the detector, those that carry light.

    Attributes
    ----------
    first, second : str
        Names of the surfaces that reflect the light; empty for the star itself.
    position : ndarray, shape [n, 2]
        In the frame of the detector [m].
    direction : ndarray, shape [n, 3]
        In the same frame.
    weight : ndarray, shape [n]
        Light of each ray; that of a ray in front of the telescope is 1.
    """

    first: str
    second: str
    position: np.ndarray
    direction: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class _Beam:
    """Rays that carry light after a surface: positions [m] and directions [n, 3], telescope frame, and their light."""

    position: np.ndarray
    direction: np.ndarray
    weight: np.ndarray


class GhostTrace:
    """Light of one star along its own path and those of its ghosts."""

    def __init__(
        self,
        telescope: Telescope,
        start: Rays,
        coatings: Reflectivities,
        threads: int | None,
        focal_plane: FocalPlane | None = None,
    ) -> None:
        self._telescope, self._coatings, self._threads = telescope, coatings, threads
        self._focal_plane = focal_plane
        self._wavelength = start.wavelength
        self._media: list[Medium] = [telescope.medium_before, *(s.medium_after for s in telescope.surfaces)]
        self._index = refractive_indices(telescope, start.wavelength)
        beam = _Beam(start.position, start.direction, np.ones(len(start)))
        self._forward = list(self._through(range(len(telescope.surfaces)), beam))

    def star(self) -> GhostLight:
        """Return the light that arrives without reflections."""
        return self._landing("", "", self._forward[-1])

    def ghosts(self, pairs: Sequence[tuple[int, int]]) -> Iterator[GhostLight]:
        """Yield the ghosts of pairs of :func:`ghost_pairs`, in their order.

        Those of one first surface are a job of a thread: most of the time goes into arithmetic of NumPy on one thread.
        """
        seconds: dict[int, list[int]] = {}
        for first, second in pairs:
            seconds.setdefault(first, []).append(second)
        count = min(thread_count(self._threads), max(len(seconds), 1))
        with ThreadPoolExecutor(count) as pool:
            for lights in pool.map(self._ghosts_of, seconds.keys(), seconds.values()):
                yield from lights

    def _ghosts_of(self, first: int, of_first: Sequence[int]) -> list[GhostLight]:
        """Return the ghosts of a first surface and some second ones."""
        names = self._telescope.surface_names
        back = [*range(first, min(of_first), -1)]
        # Light behind each surface on the way back, by its index.
        behind = dict(zip(back, self._through(back, self._forward[first - 1], backward=True), strict=True))
        lights = []
        for second in of_first:
            *_, end = self._through(range(second, len(names)), behind[second + 1], reflected=True)
            lights.append(self._landing(names[first], names[second], end))
        return lights

    def _through(
        self, places: Sequence[int], beam: _Beam, *, backward: bool = False, reflected: bool = False
    ) -> Iterator[_Beam]:
        """Yield the light after each of the surfaces at these places, in the order in which the light meets them.

        The first of them reflects it, where it is to go backward or has gone backward and is to be `reflected`.
        """
        turns = backward or reflected
        behind, before = (0, 1) if backward else (1, 0)
        surfaces = [replace(self._telescope.surfaces[p], medium_after=self._media[p + behind]) for p in places]
        if turns:
            surfaces[0] = replace(surfaces[0], interaction=Interaction.MIRROR)
        lit = beam.weight > 0.0
        weight, coming = beam.weight[lit], beam.direction[lit]
        rays = Rays(beam.position[lit], coming, np.zeros(len(weight)), self._wavelength)
        stretch = self._stretch(surfaces, self._media[places[0] + (behind if turns else before)])
        # Light lands on the CCDs; the detector reflects it at its nominal surface.
        ccds = self._focal_plane if surfaces[-1].interaction == Interaction.DETECTOR else None
        for k, met in enumerate(trace(stretch, rays, "all", focal_plane=ccds, threads=1)):
            place, n, n_behind = places[k], self._index[places[k] + before], self._index[places[k] + behind]
            # Cosine of the angle by which the surface turns the ray.
            turn = np.einsum("ij,ij->j", coming.T, met.direction.T)
            if turns and k == 0:
                weight = weight * self._coatings.reflected(place, turn, n_behind, n)
            elif surfaces[k].interaction == Interaction.REFRACT and surfaces[k].grating is None:
                weight = weight * (1.0 - self._coatings.refracted(place, turn, n, n_behind))
            weight = np.where(met.status == RayStatus.OK, weight, 0.0)
            coming = met.direction
            yield _Beam(met.position, coming, weight)

    def _stretch(self, surfaces: list[Surface], medium_before: Medium) -> Telescope:
        """Return the telescope of one stretch of a path, with the obstructions that lie on it."""
        names = {s.name for s in surfaces}
        obstructions = []
        for obstruction in self._telescope.obstructions:
            if obstruction.before is None:
                obstructions.append(obstruction)
            elif met := tuple(name for name in obstruction.before if name in names):
                obstructions.append(replace(obstruction, before=met))
        return self._telescope.with_other_surfaces(surfaces, medium_before, obstructions)

    def _landing(self, first: str, second: str, beam: _Beam) -> GhostLight:
        detector, lit = self._telescope.surfaces[-1], beam.weight > 0.0
        position = detector.to_local(beam.position[lit])[:, :2]
        return GhostLight(first, second, position, detector.along(beam.direction[lit]), beam.weight[lit])
