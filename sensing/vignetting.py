"""Rims that vignette near the image: how the light of the pupil changes where they stand aside by an unknown amount.

A rim of a lens near the image cuts a narrow beam, so that its shadow on the pupil shifts many times as far as the rim
does. Half a millimetre of misalignment is then a part of a pixel along one side of the donut, which a fit would take
for wavefront. Such shifts are unknowns beside the wavefront, with Gaussian priors about zero; where degrees of freedom
of the telescope are fitted, the shifts follow from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..models.telescope import Telescope
from ..raytrace.rays import RayStatus, parallel_rays
from ..raytrace.trace import TraceResult, trace
from .moving_rims import FreeRims, PupilShadows, cells_with_lines, rim_of_surface
from .pupil_cells import PupilCells, pupil_cells
from .rim_outlines import MOTIONS

#: Rms of the shift of a rim along each axis over the diameter of the pupil: 0.5 mm for the LSST.
_SHIFT = 6e-5
#: Least rms of the shift over the diameter of the beam at the rim: a twentieth of a pixel across a donut of 120.
_LEAST = 4e-4


def shift_spread(telescope: Telescope) -> float:
    """Return the standard deviation of the shift of a rim along each axis [m]."""
    return _SHIFT * telescope.pupil_diameter


@dataclass(frozen=True, eq=False)
class MovableRim:
    """Rim near the image that vignettes a star.

    Attributes
    ----------
    name : str
        Surface that has it.
    diameter : float
        Diameter of the beam there [m].
    point : ndarray, shape [2]
        Middle of the part of the pupil that it vignettes [m].
    """

    name: str
    diameter: float
    point: np.ndarray


def movable_rims(telescope: Telescope, points: np.ndarray, ends: Sequence[TraceResult]) -> tuple[MovableRim, ...]:
    """Return the rims that matter, from rays through points of the pupil [n, 2] at all surfaces."""
    rims, before = [], np.zeros(len(ends[0].status), dtype=bool)
    lit = ends[-1].status == RayStatus.OK
    for surface, end in zip(telescope.surfaces, ends, strict=True):
        vignetted = end.status == RayStatus.VIGNETTED
        first = vignetted & ~before
        if surface.aperture is not None and first.any():
            place = surface.to_local(end.position[lit])[:, :2]
            diameter = 2.0 * float(np.hypot(*(place - place.mean(axis=0)).T).max())
            if shift_spread(telescope) > _LEAST * diameter:
                rims.append(MovableRim(surface.name, diameter, points[first].mean(axis=0)))
        before |= vignetted
    return tuple(rims)


def rim_shifts(
    moved: Sequence[tuple[Telescope, Telescope]],
    steps: np.ndarray,
    directions: np.ndarray,
    wavelength: float,
    rims: Sequence[MovableRim],
) -> np.ndarray:
    """Return how far rims stand aside of the beams by degrees of freedom, a metre per unit, shape [2 n_rim, n_freedom].

    Parameters
    ----------
    moved : sequence of pairs of Telescope
        Telescope with each degree of freedom off by a step to both sides.
    steps : ndarray, shape [n_freedom]
        The steps.
    directions : ndarray, shape [n_rim, 3]
        Direction of the light of the star of each rim.
    wavelength : float
        Vacuum wavelength [m].
    rims : sequence of MovableRim
        The rims, whose points are those of the plane of the entrance pupil.
    """
    shifts = np.zeros((len(rims), 2, len(moved)))
    points = np.array([rim.point for rim in rims]).reshape(-1, 1, 2)
    for k, (pair, step) in enumerate(zip(moved, steps, strict=True)):
        for telescope, sign in zip(pair, (1.0, -1.0), strict=True):
            ends = trace(telescope, parallel_rays(telescope, directions, wavelength, points), "all", threads=1)
            for i, rim in enumerate(rims):
                at = telescope.surface_names.index(rim.name)
                place = telescope.surfaces[at].to_local(ends[at].position[i : i + 1])[0, :2]
                # Where the light goes to one side, the rim stands to the other.
                shifts[i, :, k] -= sign * place / (2.0 * step)
    # A ray that some surface does not meet tells of no shift.
    return np.nan_to_num(shifts).reshape(-1, len(moved))


def cells_with_rims(
    telescope: Telescope,
    direction: np.ndarray,
    wavelength: float,
    across: int,
    rims: Sequence[MovableRim],
    free_rims: FreeRims | None = None,
) -> PupilCells:
    """Return the cells of a pupil with their rates of change by rims.

    Those by shifts of rims along x and y of their surfaces come first, then those by the motions of free ones, which
    the telescope has where they stand.
    """
    cells = pupil_cells(telescope, direction, wavelength, across)
    free_rims = FreeRims() if free_rims is None else free_rims
    if not (rims or free_rims.bodies):
        return cells
    bodies = [rim_of_surface(telescope, rim.name, shift_spread(telescope)) for rim in rims]
    lines = PupilShadows(telescope, direction, wavelength, cells).lines([*bodies, *free_rims.bodies])
    free = np.array([body.free for body in bodies], dtype=bool).reshape(-1, MOTIONS)
    return cells_with_lines(cells, lines, np.concatenate([free, free_rims.free]))
