"""Transfer function of the light that is diffracted at the rims of the pupil, and its derivatives, on a grid."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..wavefront.psf.pupil_rims import PupilRims

#: Transfer of air and detector below which diffraction is left out.
_DARK = 2e-3
#: The same below which its derivatives are left out.
_DIM = 2e-2
#: Fraction of the strength of the turbulence that this transfer is computed for, so that a little less of it fits too.
_SHARPER = 0.9
#: Distance by which landing points may move before the transfer function is computed again [side of a pixel]. Images
#: that are 0.05 pixels off at the rims made 25 nm of coma in a joint fit.
_MOVED = 2e-3
#: The same where derivatives follow the points: their second order is then a thousandth of the light of the rims.
_BENT = 0.07


@dataclass(frozen=True)
class RimsAt:
    """Rims on the detector.

    Attributes
    ----------
    landing : ndarray, shape [n_rim, 2]
        Landing points from that of the chief ray [m].
    inward : ndarray, shape [n_rim, 2]
        Their change per metre of the pupil towards the lit side.
    response, inward_response : ndarray, shape [2, n_rim, n_wave]
        Derivatives of both with respect to the unknowns of the wavefront.
    """

    landing: np.ndarray
    inward: np.ndarray
    response: np.ndarray
    inward_response: np.ndarray


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
        self._last: _Expansion | None = None
        #: Frequencies of the grid where something of the diffracted light is left, and their wave vectors [n, 2].
        self.where, self.wave = np.zeros(lattice.shape, dtype=bool), np.zeros((0, 2))
        self._bright = np.zeros(0, dtype=bool)

    def of(self, rims: PupilRims) -> RimLight:
        """Return the same for other rims."""
        light = copy(self)
        light.rims = rims
        light.release()
        return light

    def transfer(self, strength: float, at: RimsAt) -> tuple[np.ndarray, np.ndarray]:
        """Return the transfer function about the chief ray, and its derivatives by the unknowns of the wavefront.

        At :attr:`where`, shapes [n] and [n, n_wave], for turbulence of a strength. Rims that moved little since the
        last time are followed by the derivatives of then.
        """
        if strength < self._strength:
            self._strength = _SHARPER * strength
            passed = np.abs(self._filter(self._strength))
            self.where = passed > _DARK
            self._bright = passed[self.where] > _DIM
            self.wave = self._at_where(self._grid[1])
            self._last = None
        last = self._last
        follows = None if last is None else last.change(at, self._side)
        if last is None or follows is None:
            baseline, wave, bright = self._at_where(self._grid[0]), self.wave, self._bright
            places, count = (at.landing, at.inward), at.response.shape[2]
            values = np.empty(len(wave), dtype=np.complex64)
            slopes = np.zeros((len(wave), count), dtype=np.complex64)
            if count:
                values[bright], slopes[bright] = self.rims.transfer_slopes(
                    baseline[bright], wave[bright], *places, at.response, at.inward_response
                )
            dim = ~bright if count else np.ones(len(wave), dtype=bool)
            values[dim] = self.rims.transfer(baseline[dim], wave[dim], *places)
            over = self._lattice[self.where].astype(np.float32)
            values, slopes = values / over, slopes / over[:, None]
            last = self._last = _Expansion(at, values, slopes)
            follows = np.zeros(count)
        if not follows.any():
            return last.values, last.slopes
        return last.values + last.slopes @ follows.astype(np.float32), last.slopes

    def release(self) -> None:
        """Free the transfer function and its derivatives."""
        self._last = None

    def _at_where(self, values: np.ndarray) -> np.ndarray:
        return np.asarray(values[:, self.where].T)


class _Expansion:
    """Transfer function [n] of rims at one place, and its derivatives [n, n_wave] by the unknowns of the wavefront."""

    def __init__(self, at: RimsAt, values: np.ndarray, slopes: np.ndarray) -> None:
        self.values, self.slopes, self._at = values, slopes, at

    @cached_property
    def _inverse(self) -> np.ndarray:
        """Unknowns by the shifts of the landing points."""
        response = self._at.response
        return np.linalg.pinv(response.reshape(-1, response.shape[2]), rcond=1e-6)

    def change(self, at: RimsAt, side: float) -> np.ndarray | None:
        """Return the unknowns [n_wave] that lead from here to other rims; None where these are too far for that."""
        count = self._at.response.shape[2]
        if at.landing.shape != self._at.landing.shape or at.response.shape[2] not in (0, count):
            return None
        shift = (at.landing - self._at.landing).T
        if np.abs(shift).max() <= (_MOVED * side if not count else 0.0):
            return np.zeros(count)
        if not count or np.abs(shift).max() > _BENT * side:
            return None
        unknowns = np.asarray(self._inverse @ shift.ravel())
        unexplained = shift.ravel() - self._at.response.reshape(-1, count) @ unknowns
        return unknowns if np.abs(unexplained).max() <= _MOVED * side else None
