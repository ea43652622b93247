"""Stars far from focus under the mean of all turbulence: rays of the optics, and the atmosphere as a filter.

The sums of :mod:`.long_exposure` over few points of the pupil are right where the phase varies slowly from one point to
the next. Far from focus, a dense bundle of rays is binned as in :mod:`.fast`, and filtered by the mean transfer
function of the atmosphere and of diffraction. The strips along the rims of the pupil, which that module treats apart,
are here part of the filter: light diffracted at the rims, some 1e-3 of all, is spread evenly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..atmosphere.turbulence import structure_function
from ..pupil_optics import PupilOptics
from ..pupil_sampling import spiral_annulus
from .engine import PsfInputs
from .far_from_focus import blur_radii
from .fast import FastPsfEngine
from .image_plane import square_transfer

#: Cells of the fine grid per pixel.
OVERSAMPLING = 4
#: Rms radius of the blur by the optics from which a star counts as far from focus [m]: 0.15 mm of defocus at f/1.23,
#: where the default points of the long-exposure engine begin to fail, by 3 % of the peak.
FAR = 50e-6
# Rays in the square of the rms radius of the blur: a donut of 1.2 mm is drawn to 6e-4 of its light (rms).
_RAYS = 70.0


def ray_counts(optics: PupilOptics, pixel_size: float) -> np.ndarray:
    """Return the rays of each star for :class:`MeanRaysEngine`, 0 for stars near focus, shape [n_star] int.

    ``pixel_size`` is in metres.
    """
    return np.where(blur_radii(optics) > FAR, wanted_rays(optics, pixel_size), 0)


def wanted_rays(optics: PupilOptics, pixel_size: float) -> np.ndarray:
    """Return the rays that draw each star, shape [n_star] int; ``pixel_size`` is in metres."""
    # Powers of two, so that a batch has few different numbers.
    count = 2 ** np.ceil(np.log2(_RAYS * np.maximum(blur_radii(optics) / pixel_size, 1.0) ** 2))
    return np.asarray(count, dtype=np.int64)


class MeanRaysEngine(FastPsfEngine):
    """Rays of the optics alone, blurred as the mean of all turbulence blurs.

    Pupil points stand on a spiral, which lines up with no rim. Rays are shared among the four cells around them: in
    the nearest cell alone, rows of rays that line up with rows of cells would show, by 1 %.
    """

    def __init__(self, inputs: PsfInputs, rays: int) -> None:
        self._air = inputs.atmosphere
        super().__init__(replace(inputs, atmosphere=None, n_pupil=rays, oversampling=OVERSAMPLING))

    def _place_pupil(self, n_pupil: float) -> None:
        self._points = spiral_annulus(0.5 * self._diameter, self._obscuration, int(n_pupil)).points
        self._weights = np.ones(len(self._points))

    def _make_grid(self) -> None:
        super()._make_grid()
        # The share of a cell falls linearly: averaged over a square twice, of which the engine takes back one.
        self._detector /= square_transfer(self._kx, self._ky[:, None], self._cell).astype(np.float32)

    def _deposit(self, optics: PupilOptics, light: np.ndarray) -> np.ndarray:
        channels, side = self._channels, self._grid_size
        place = channels.displacement(optics).astype(np.float64) / self._cell + side // 2
        # Rays that were lost have no place to land; light beyond the grid is left out.
        lit = light[:, channels.wave] * ((place >= 0.0) & (place < side - 1)).all(axis=-1)

        def share(star: int) -> np.ndarray:
            return np.stack([_shared(*ray, side) for ray in zip(place[star], lit[star], strict=True)])

        return np.stack(self._map(share, range(len(place))))

    def _rest(self, baseline: np.ndarray) -> np.ndarray | None:
        return None if self._air is None else structure_function(baseline, self._air.r0, self._air.outer_scale)


def _shared(place: np.ndarray, light: np.ndarray, side: int) -> np.ndarray:
    """Return light [n] of rays at places [n, 2] in cells, shared linearly among the cells, [side, side] float32."""
    shining = light > 0.0
    place, light = place[shining], light[shining]
    corner = place.astype(np.int64)
    x, y = (place - corner).T
    first = corner[:, 1] * side + corner[:, 0]
    shares = (((1.0 - x) * (1.0 - y), 0), (x * (1.0 - y), 1), ((1.0 - x) * y, side), (x * y, side + 1))
    cells = sum(np.bincount(first + step, part * light, minlength=side * side) for part, step in shares)
    return np.asarray(cells, dtype=np.float32).reshape(side, side)
