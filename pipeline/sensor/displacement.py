r"""Static displacements of charge within a CCD: tree rings and edge roll-off.

Transverse fields in the silicon carry charge sideways. Light that would land at :math:`b - d(b)` lands at b, so a pixel
boundary at b stands for one at :math:`b - d(b)`. Positions are those on the CCD, from its centre.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.units import length, plane_points, require_positive
from .pixel_boundaries import RIM, collect, with_rim, without_rim


class Displacement(ABC):
    """A field of displacements over a CCD."""

    @abstractmethod
    def at(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return the displacement (dx, dy) [m] of the light that lands at x, y [m] from the centre of the CCD.

        Its shape is that of x and y, broadcast, with an axis of two at the end; NaN where these are not finite.
        """


@check_arguments
@dataclass(frozen=True)
class TreeRings(Displacement):
    r"""Rings of doping about the axis of the silicon boule: radial displacement :math:`A \cos(2 \pi r/P + \varphi)`.

    ``galsim.SiliconSensor`` moves pixel boundaries: its ``treering_func`` is the negative of this displacement, in
    pixels.

    Parameters
    ----------
    amplitude : float
        Largest displacement A [m].
    period : float
        Distance of the rings P [m].
    center : tuple of float
        Axis of the rings from the centre of the CCD [m].
    phase : float
        Phase at the axis [rad].
    """

    amplitude: float
    period: float
    center: tuple[float, float]
    phase: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.amplitude, self.period, *self.center, self.phase)
        if not np.isfinite(numbers).all() or not self.period > 0.0:
            raise DomainError(f"tree rings = {numbers!r}: expected finite numbers, and a period above 0")

    def at(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return the displacement, as :meth:`Displacement.at` says; NaN where x or y is not finite."""
        along = np.stack(plane_points(x, y), axis=-1) - np.array(self.center)
        radius = np.hypot(along[..., 0], along[..., 1])[..., None]
        size = self.amplitude * np.cos(2.0 * np.pi * radius / self.period + self.phase)
        # On the axis itself there is no direction.
        return size * along / np.where(radius > 0.0, radius, 1.0)


@check_arguments
@dataclass(frozen=True)
class EdgeRolloff(Displacement):
    """Outward displacement near the edges of a CCD, which falls exponentially with the distance from each edge.

    A positive one stretches images and makes the pixels at the edge collect less of an even light: they roll off. A
    negative one makes them glow.

    Parameters
    ----------
    amplitude : float
        Displacement at the edge [m].
    length : float
        Distance over which it falls by e [m].
    half_size : float or (float, float)
        Half the side of the CCD [m], or half of each, along its own axes.
    turn : float
        Angle of these axes from x towards y [rad].
    """

    amplitude: float
    length: float
    half_size: float | tuple[float, float]
    turn: float = 0.0

    def __post_init__(self) -> None:
        halves = np.broadcast_to(self.half_size, 2)
        numbers = (self.amplitude, self.length, *halves.tolist(), self.turn)
        if not np.isfinite(numbers).all() or not (self.length > 0.0 and (halves > 0.0).all()):
            raise DomainError(f"edge roll-off = {numbers!r}: expected finite numbers, and lengths above 0")

    def at(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return the displacement, as :meth:`Displacement.at` says; NaN where x or y is not finite."""
        place = self._rotated(np.stack(plane_points(x, y), axis=-1), -self.turn)
        # Beyond an edge, where the rim of a stamp may lie, it stays that of the edge.
        upper, lower = (np.maximum(self.half_size - sign * place, 0.0) for sign in (1.0, -1.0))
        moved = self.amplitude * (np.exp(-upper / self.length) - np.exp(-lower / self.length))
        return self._rotated(moved, self.turn)

    @staticmethod
    def _rotated(vectors: np.ndarray, angle: float) -> np.ndarray:
        if angle == 0.0:
            return vectors
        cosine, sine = np.cos(angle), np.sin(angle)
        return vectors @ np.array([[cosine, sine], [-sine, cosine]])


@check_arguments
def displace_stamps(
    images: np.ndarray, effects: Sequence[Displacement], places: np.ndarray, pixel_size: float
) -> np.ndarray:
    """Return stamps of stars as the displacements distort them.

    The displacement at the middle pixel is subtracted: it moves the star as a whole, and is that of
    :meth:`Displacement.at`.

    Parameters
    ----------
    images : ndarray, shape [n, ny, nx]
        Stamps.
    effects : sequence of Displacement
        Displacements, which add up.
    places : ndarray, shape [n, 2]
        Centre of the middle pixel ``[ny // 2, nx // 2]`` of each stamp, from the centre of the CCD [m].
    pixel_size : float
        Side of a pixel [m].

    Returns
    -------
    ndarray, shape [n, ny, nx]
        Charge in the pixels. What crosses the rim of a stamp is as in its outermost pixels.

    Raises
    ------
    DomainError
        If shapes do not fit.
    """
    if images.ndim != 3 or places.shape != (len(images), 2):
        raise DomainError(f"images, places of shapes {images.shape}, {places.shape}: expected [n, ny, nx] and [n, 2]")
    if not np.isfinite(images).all() or not np.isfinite(places).all():
        raise DomainError("images, places: expected finite numbers")
    pixel_size = require_positive(length(pixel_size, "pixel_size"), "pixel_size", "metres")
    if not effects:
        return images
    padded = with_rim(images)
    x, y = (
        pixel_size * (np.arange(size) - size // 2)[None] + place[:, None]
        for size, place in zip(images.shape[:0:-1], places.T, strict=True)
    )
    wide_x, wide_y = _extended_centers(x, pixel_size), _extended_centers(y, pixel_size)
    half = 0.5 * pixel_size
    boundary_x, boundary_y = (np.concatenate([v - half, v[:, -1:] + half], axis=1) for v in (wide_x, wide_y))
    shift_x = shift_y = np.zeros(1)
    for effect in effects:
        middle_shift = effect.at(*places.T)
        shift_x = (
            shift_x + middle_shift[:, 0, None, None] - effect.at(boundary_x[:, None, :], wide_y[:, :, None])[..., 0]
        )
        shift_y = (
            shift_y + middle_shift[:, 1, None, None] - effect.at(wide_x[:, None, :], boundary_y[:, :, None])[..., 1]
        )
    return without_rim(collect(padded, shift_x / pixel_size, shift_y / pixel_size))


def _extended_centers(centers: np.ndarray, pixel_size: float) -> np.ndarray:
    """Return pixel centres [n, size] with those of the rim."""
    beyond = pixel_size * np.arange(1, RIM + 1)
    return np.concatenate([centers[:, :1] - beyond[::-1], centers, centers[:, -1:] + beyond], axis=1)
