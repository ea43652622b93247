"""Stars far from focus under the mean of all turbulence: rays of the optics, and the atmosphere as a filter.

The sums of :mod:`.long_exposure` over few points of the pupil are right where the phase varies slowly from one point to
the next. Far from focus, a dense bundle of rays is binned as in :mod:`.fast`, and filtered by the mean transfer
function of the atmosphere. The strips along the rims of the pupil that diffraction takes away are those of
:mod:`.pupil_rims`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.units import ARCSEC
from ..atmosphere.turbulence import structure_function
from ..pupil_optics import PupilOptics
from ..pupil_polynomials import PupilPolynomials
from ..pupil_sampling import spiral_annulus
from .engine import PsfInputs, Stars
from .far_from_focus import blur_radii
from .fast import FastEngine, FastRenderer
from .image_plane import square_transfer
from .pupil_rims import pupil_rims, strip_overlap

#: Cells of the fine grid per pixel.
OVERSAMPLING = 4
#: Rms radius of the blur by the optics from which a star counts as far from focus [m]: 0.15 mm of defocus at f/1.23,
#: where the default points of the long-exposure engine begin to fail, by 3 % of the peak.
FAR = 50e-6
#: The same on the sky [rad], where focal lengths are shorter and the seeing on the detector is as much sharper: on a
#: Schmidt camera of 1.2 m, f/2.5, whose blur is 1.9 arcsec, the default points fail by 6 % of the peak, rays by 1 %.
FAR_ANGLE = 1.0 * ARCSEC
# Rays in the square of the rms radius of the blur: a donut of 1.2 mm is drawn to 6e-4 of its light (rms).
_RAYS = 70.0
# Rays from which the landing points of the rims are interpolated.
_SMOOTH_POINTS = 2000
# Transfer of air and detector below which the strips along the rims are left out.
_DARK = 1e-3


def ray_counts(optics: PupilOptics, pixel_size: float, focal_length: float) -> np.ndarray:
    """Return the number of rays of each star for :class:`MeanRaysRenderer`, 0 near focus, shape [n_star] int.

    ``pixel_size`` and ``focal_length`` are in metres.
    """
    far = min(FAR, FAR_ANGLE * focal_length)
    return np.where(blur_radii(optics) > far, drawing_ray_counts(optics, pixel_size), 0)


def drawing_ray_counts(optics: PupilOptics, pixel_size: float) -> np.ndarray:
    """Return the number of rays that draw each star, shape [n_star] int; ``pixel_size`` is in metres."""
    # Powers of two, so that a batch has few different numbers.
    count = 2 ** np.ceil(np.log2(_RAYS * np.maximum(blur_radii(optics) / pixel_size, 1.0) ** 2))
    return np.asarray(count, dtype=np.int64)


class MeanRaysRenderer(FastRenderer):
    """Rays of the optics alone, filtered by the mean transfer function of all turbulence.

    Pupil points stand on a spiral, which lines up with no rim. Rays are shared among the four cells around them: in
    the nearest cell alone, rows of rays that line up with rows of cells would show, by 1 %.
    """

    def __init__(self, inputs: PsfInputs, rays: int) -> None:
        self._air = inputs.atmosphere
        options = FastEngine(n_pupil=rays, oversampling=OVERSAMPLING)
        super().__init__(replace(inputs, atmosphere=None), options, far_from_focus=True)

    def _place_pupil(self, n_pupil: int) -> None:
        # Area of the points over that of the pupil.
        self._area = (1.0 - self._inner**2) / (1.0 - self._obscuration**2)
        self._points = spiral_annulus(0.5 * self._diameter, self._inner, int(self._area * n_pupil)).points
        self._weights = np.ones(len(self._points))

    def _lit_fraction(self, optics: PupilOptics, stars: Stars) -> np.ndarray:
        return np.asarray(self._area * optics.lit.mean(axis=2))

    def _make_grid(self) -> None:
        super()._make_grid()
        # Cloud-in-cell weights are a square averaged twice; the engine undoes one of the averages.
        self._detector /= square_transfer(self._kx, self._ky[:, None], self._cell).astype(np.float32)

    def _deposit(self, optics: PupilOptics, light: np.ndarray) -> np.ndarray:
        channels, side = self._channels, self._grid_size
        place = channels.displacement(optics).astype(np.float64) / self._cell + side // 2
        # Rays that were lost have no place to land; light beyond the grid is left out.
        lit = light[:, channels.wave] * ((place >= 0.0) & (place < side - 1)).all(axis=-1)

        def share(star: int) -> np.ndarray:
            return np.stack([_cloud_in_cell(*ray, side) for ray in zip(place[star], lit[star], strict=True)])

        return np.stack(self._map(share, range(len(place))))

    def _diffraction(self, baseline: np.ndarray) -> np.ndarray:
        return strip_overlap(baseline, self._diameter, self._obscuration)

    def _transforms(self, deposit: np.ndarray, optics: PupilOptics, light: np.ndarray) -> np.ndarray:
        spectra = super()._transforms(deposit, optics, light)
        directions, channels = self._direction(optics.fields), self._channels
        landing = channels.displacement(optics)
        kx, ky = np.meshgrid(self._kx, self._ky)
        thinned = slice(None, None, max(1, len(self._points) // _SMOOTH_POINTS))

        def diffract(star: int) -> None:
            for channel, wave in enumerate(channels.wave):
                wavelength = float(self._wavelengths[wave])
                # Dark rays may pass a lens far outside of what is ground.
                lit = optics.lit[star, wave, thinned]
                if not (lit.any() and light[star, wave].any()):
                    continue
                bare = landing[star, channel, thinned][lit].astype(np.float64)
                smooth = PupilPolynomials(self._points[thinned][lit], np.zeros(2), 0.0)
                # Baseline over wavelength: J^T k / 2 pi.
                jacobian = optics.jacobian[star] * wavelength / (2.0 * np.pi)
                x, y = (jacobian[0, i] * kx + jacobian[1, i] * ky for i in (0, 1))
                length = np.hypot(x, y)
                table = self._filter[wave]
                transfer = np.interp(length, self._filter_step * np.arange(len(table)), table)
                bright = np.abs(transfer * self._detector) > _DARK
                rims = pupil_rims(self._telescope, directions[star], wavelength)
                places, inward = rims.landing(smooth, bare)
                # The deposit has its origin in the first cell.
                places = places + (self._grid_size // 2) * self._cell
                k = np.stack([kx[bright], ky[bright]], axis=-1)
                strips = rims.transfer(np.stack([x[bright], y[bright]], axis=-1), k, places, inward)
                # The detector's filter undoes the cloud-in-cell average of the rays.
                strips *= square_transfer(k[:, 0], k[:, 1], self._cell) ** 2
                spectra[star, channel][bright] += float(light[star, wave].sum()) * strips

        list(self._map(diffract, range(len(spectra))))
        return spectra

    def _filter_structure(self, baseline: np.ndarray) -> np.ndarray | None:
        return None if self._air is None else structure_function(baseline, self._air.r0, self._air.outer_scale)


def _cloud_in_cell(place: np.ndarray, light: np.ndarray, side: int) -> np.ndarray:
    """Bin light [n] at positions [n, 2] [cells], linearly among four cells (cloud in cell): [side, side] float32."""
    shining = light > 0.0
    place, light = place[shining], light[shining]
    corner = place.astype(np.int64)
    x, y = (place - corner).T
    first = corner[:, 1] * side + corner[:, 0]
    shares = (((1.0 - x) * (1.0 - y), 0), (x * (1.0 - y), 1), ((1.0 - x) * y, side), (x * y, side + 1))
    cells = sum(np.bincount(first + step, fraction * light, minlength=side * side) for fraction, step in shares)
    return np.asarray(cells, dtype=np.float32).reshape(side, side)
