"""Rims that vignette near the image: how the light of the pupil changes where they stand aside by an unknown amount.

A rim of a lens near the image cuts a narrow beam, so that its shadow on the pupil shifts many times as far as the rim
does. Half a millimetre of misalignment is then a part of a pixel along one side of the donut, which a fit would take
for wavefront. Such shifts are unknowns beside the wavefront, with Gaussian priors about zero; where degrees of freedom
of the telescope are fitted, the shifts follow from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..models.aperture import shifted
from ..models.telescope import Telescope
from ..raytrace.rays import RayStatus, parallel_rays
from ..raytrace.trace import TraceResult, trace
from .pupil_cells import PupilCells, pupil_cells

#: Rms of the shift of a rim along each axis over the diameter of the pupil: 0.5 mm for the LSST.
_SHIFT = 6e-5
#: Least rms of the shift over the diameter of the beam at the rim: a twentieth of a pixel across a donut of 120.
_LEAST = 4e-4
#: Shift for differences, in the image of a cell at the rim.
_STEP = 0.3


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
    telescope: Telescope, direction: np.ndarray, wavelength: float, across: int, rims: Sequence[MovableRim]
) -> PupilCells:
    """Return the cells of a pupil with their rates of change by shifts of rims along x and y of their surfaces."""
    cells = pupil_cells(telescope, direction, wavelength, across)
    cell_sets, columns = [cells], []
    for rim in rims:
        step = _STEP * rim.diameter / across
        for axis in np.eye(2):
            ends = [
                pupil_cells(
                    _with_shifted_rim(telescope, rim.name, *(sign * step * axis)), direction, wavelength, across
                )
                for sign in (1.0, -1.0)
            ]
            cell_sets += ends
            columns.append(step)
    if not columns:
        return cells
    sizes = [len(cell_set) for cell_set in cell_sets]
    starts = np.cumsum([0, *sizes])
    rates = np.zeros((starts[-1], len(columns)))
    for k, step in enumerate(columns):
        for sign, index in ((1.0, 2 * k + 1), (-1.0, 2 * k + 2)):
            rates[starts[index] : starts[index + 1], k] = sign * cell_sets[index].weights / (2.0 * step)
    weights = np.concatenate([cells.weights, np.zeros(starts[-1] - sizes[0])])
    points = np.concatenate([cell_set.points for cell_set in cell_sets])
    moments = np.concatenate([cell_set.moments for cell_set in cell_sets])
    # Cells that no shift changes stand in all sets.
    keys = np.concatenate([points, moments.reshape(-1, 4)], axis=1)
    _, first, place = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    place = place.ravel()
    joined = np.zeros((len(first), 1 + len(columns)))
    np.add.at(joined, place, np.column_stack([weights, rates]))
    significant = (np.abs(joined) > 1e-9 * np.abs(joined).max(axis=0)).any(axis=1)
    first, joined = first[significant], joined[significant]
    return replace(cells, points=points[first], weights=joined[:, 0], moments=moments[first], rates=joined[:, 1:])


def _with_shifted_rim(telescope: Telescope, name: str, x: float, y: float) -> Telescope:
    surfaces = tuple(
        replace(s, aperture=shifted(s.aperture, x, y)) if s.name == name and s.aperture is not None else s
        for s in telescope.surfaces
    )
    return replace(telescope, surfaces=surfaces)
