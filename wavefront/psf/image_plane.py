r"""Detector of the PSF engines: grid of a stamp, and transfer functions of pixels, diffusion and jitter.

An image :math:`I(X)` on the focal plane has the transform :math:`\tilde I(k) = \int I(X) e^{-i k \cdot X} dX`, with k
in radians per metre of the focal plane. A pupil baseline b belongs to :math:`k = (2 \pi / \lambda) J^{-T} b`, where J
is the Jacobian of the position on the focal plane with respect to the direction of the incoming light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...core.errors import DomainError
from ...core.units import require_count


@dataclass(frozen=True)
class ImagePlane:
    """The pixels of a stamp and the detector behind them."""

    size: int  #: pixels on a side of a stamp
    pixel_size: float  #: side of a square pixel [m]
    diffusion: float  #: rms along each axis of the charge diffusion [m]
    jitter: float = 0.0  #: rms along each axis of how far the telescope's pointing moves images during an exposure [m]
    room: int = 0  #: pixels of a side that will be cut off

    def __post_init__(self) -> None:
        require_count(self.size, "size", 3, 4096)
        require_count(self.room, "room", 0, self.size - 1)
        if not (math.isfinite(self.pixel_size) and self.pixel_size > 0.0):
            raise DomainError(f"pixel_size = {self.pixel_size!r}: expected a positive length in metres")
        for name, rms in (("diffusion", self.diffusion), ("jitter", self.jitter)):
            if not (math.isfinite(rms) and rms >= 0.0):
                raise DomainError(f"{name} = {rms!r}: expected a length in metres from 0")

    @property
    def side(self) -> float:
        """Side of the stamp [m]."""
        return self.size * self.pixel_size

    @property
    def middle(self) -> int:
        """Index of the middle pixel, where a star without an offset has its reference point."""
        return self.size // 2

    @property
    def pixel_centers(self) -> np.ndarray:
        """Coordinates of the pixel centres along an axis from the middle pixel [m]."""
        return (np.arange(self.size) - self.middle) * self.pixel_size

    def transfer(self, kx: np.ndarray, ky: np.ndarray) -> np.ndarray:
        """Return the transfer function of a square pixel, Gaussian charge diffusion and Gaussian pointing jitter.

        It is real, and 1 at zero; wavenumbers on the focal plane [rad/m] are broadcast against each other.
        """
        variance = self.diffusion**2 + self.jitter**2
        return square_transfer(kx, ky, self.pixel_size) * np.exp(-0.5 * variance * (kx * kx + ky * ky))


def square_transfer(kx: np.ndarray, ky: np.ndarray, side: float) -> np.ndarray:
    """Return the transfer function of averaging over a square of given side [m] at wavenumbers [rad/m]."""
    scale = 0.5 * side / np.pi
    return np.sinc(kx * scale) * np.sinc(ky * scale)


def focal_length(jacobian: np.ndarray) -> np.ndarray:
    """Return the effective focal length [m] of Jacobians [..., 2, 2]: the geometric mean of the two principal ones."""
    return np.sqrt(np.abs(np.linalg.det(jacobian)))
