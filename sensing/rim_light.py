"""Transfer function of the light that is diffracted at the rims of the pupil, and its derivatives, on a grid."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np

from ..wavefront.psf.pupil_rims import PupilRims

#: Transfer of air and detector below which diffraction is left out.
_DARK = 2e-3
#: Fraction of the strength of the turbulence that this transfer is computed for, so that a little less of it fits too.
_SHARPER = 0.9
#: Distance by which landing points may move before the transfer function is computed again [side of a pixel]. Images
#: that are 0.05 pixels off at the rims made 25 nm of coma in a joint fit.
_MOVED = 2e-3
#: The same for its derivatives [side of a pixel].
_BENT = 0.2


@dataclass(frozen=True)
class RimsAt:
    """Rims on the detector.

    Attributes
    ----------
    landing : ndarray, shape [n_rim, 2]
        Landing points from that of the chief ray [m].
    inward : ndarray, shape [n_rim, 2]
        Their change per metre of the pupil towards the lit side.
    response : ndarray, shape [2, n_rim, n_wave]
        Derivatives of the landing points with respect to the unknowns of the wavefront [m].
    """

    landing: np.ndarray
    inward: np.ndarray
    response: np.ndarray


class RimLight:
    """Diffraction at the rims of a pupil on the frequencies of a grid of images.

    Parameters
    ----------
    rims : PupilRims
        The rims.
    side : float
        Side of a pixel of the detector [m].
    wave, baseline : ndarray, shape [2, ny, nx]
        Wave vectors of the image [rad/m] and baselines in the pupil [m] of the grid.
    lattice : ndarray, shape [ny, nx]
        Factor of the grid's filter that light of the rims does not have.
    air_and_detector : callable
        Transfer function of air and detector at a strength of the turbulence [1/m], shape [ny, nx].
    """

    def __init__(
        self,
        rims: PupilRims,
        side: float,
        wave: np.ndarray,
        baseline: np.ndarray,
        lattice: np.ndarray,
        air_and_detector: Callable[[float], np.ndarray],
    ) -> None:
        self.rims = rims
        self._side, self._grid, self._lattice, self._filter = side, (baseline, wave), lattice, air_and_detector
        self._strength = np.inf
        self._landing, self._bent = np.full((1, 2), np.inf), np.full((1, 2), np.inf)
        #: Frequencies of the grid where something of the diffracted light is left, and their wave vectors [n, 2].
        self.where, self.wave = np.zeros(lattice.shape, dtype=bool), np.zeros((0, 2))
        self._transfer, self._slopes = np.zeros(0, dtype=np.complex64), np.zeros((0, 0), dtype=np.complex64)

    def of(self, rims: PupilRims) -> RimLight:
        """Return the same for other rims."""
        light = copy(self)
        light.rims = rims
        light.release()
        return light

    def transfer(self, strength: float, at: RimsAt) -> np.ndarray:
        """Return the transfer function about the chief ray at :attr:`where`, shape [n]; turbulence of a strength."""
        if strength < self._strength:
            self._strength = _SHARPER * strength
            self.where = np.abs(self._filter(self._strength)) > _DARK
            self.wave = self._at_where(self._grid[1])
            self._landing, self._bent = np.full((2, 1, 2), np.inf)
        if self._far(at.landing, self._landing, _MOVED):
            diffracted = self.rims.transfer(self._at_where(self._grid[0]), self.wave, at.landing, at.inward)
            self._transfer, self._landing = self._over_lattice(diffracted[:, None])[:, 0], at.landing
        return self._transfer

    def slopes(self, at: RimsAt) -> np.ndarray:
        """Return derivatives of the last :meth:`transfer` by the unknowns of the wavefront, shape [n, n_wave]."""
        if self._far(at.landing, self._bent, _BENT) or self._slopes.shape[1] != at.response.shape[2]:
            frequencies = self._at_where(self._grid[0])
            derivatives = self.rims.transfer_slopes(frequencies, self.wave, at.landing, at.inward, at.response)
            self._slopes, self._bent = self._over_lattice(derivatives), at.landing
        return self._slopes

    def release(self) -> None:
        """Free the transfer function and its derivatives."""
        self._landing, self._bent = np.full((2, 1, 2), np.inf)
        self._transfer, self._slopes = np.zeros(0, dtype=np.complex64), np.zeros((0, 0), dtype=np.complex64)

    def _at_where(self, values: np.ndarray) -> np.ndarray:
        return np.asarray(values[:, self.where].T)

    def _over_lattice(self, values: np.ndarray) -> np.ndarray:
        return np.asarray((values / self._lattice[self.where, None]).astype(np.complex64))

    def _far(self, landing: np.ndarray, last: np.ndarray, distance: float) -> bool:
        return landing.shape != last.shape or bool(np.abs(landing - last).max() > distance * self._side)
