"""The frozen layers of an atmosphere: heights, weights and winds, and where lines of sight cross them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ...core.errors import DomainError
from ...core.random_streams import stream
from ...models.site import Site


@dataclass(frozen=True, eq=False, kw_only=True)
class Layers:
    """Frozen layers and their winds; attributes as in :class:`.Atmosphere`."""

    altitudes: np.ndarray
    weights: np.ndarray
    velocities: np.ndarray
    offsets: np.ndarray

    @property
    def layer_count(self) -> int:
        """Number of layers."""
        return len(self.altitudes)

    def pupil_centers(self, direction: np.ndarray, time: ArrayLike = 0.0) -> np.ndarray:
        """Return the intersections of light through the pupil's centre with each layer, in screen coordinates.

        Parameters
        ----------
        direction : ndarray, shape [..., 3]
            Directions in which the light travels, of any length.
        time : array_like
            Times since the start of the exposure [s], broadcast against the directions.

        Returns
        -------
        ndarray, shape [..., n_layer, 2]
            Screen coordinates [m], not yet taken modulo the side.
        """
        slopes = direction[..., None, :2] / -direction[..., None, 2:]
        elapsed = np.asarray(time, dtype=np.float64)[..., None, None]
        return self.offsets - self.altitudes[:, None] * slopes - self.velocities * elapsed

    def screen_coordinates(
        self, x: ArrayLike, y: ArrayLike, layer: int, *, field: tuple[float, float] = (0.0, 0.0), time: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the intersection of light that meets the pupil at ``(x, y)`` with a layer.

        Parameters
        ----------
        x, y : array_like
            Pupil coordinates [m].
        layer : int
            Index of the layer.
        field : tuple of float
            Slopes ``(tx, ty)`` of the light's travel [rad].
        time : float
            Time since the start of the exposure [s].

        Returns
        -------
        tuple of ndarray
            Screen coordinates x and y [m], not yet taken modulo the side.
        """
        shift = self.pupil_centers(np.array([*field, -1.0]), time)[layer]
        return np.asarray(x, dtype=np.float64) + shift[0], np.asarray(y, dtype=np.float64) + shift[1]


def wind_directions(site: Site, seed: int, epoch: int) -> np.ndarray:
    """Return the directions that the wind blows to in each layer [rad], drawn from the seed where a site has none."""
    return np.array(
        [
            2.0 * math.pi * layer_random(seed, epoch, n, "wind", 1)[0] if direction is None else direction
            for n, direction in enumerate(site.wind_directions)
        ],
        dtype=np.float64,
    )


def line_of_sight(heights: np.ndarray, ground_lift: float, zenith: float) -> np.ndarray:
    """Return distances [m] of layers along a line of sight, from heights [m], of which 0 stands for ``ground_lift``."""
    return np.where(heights == 0.0, ground_lift, heights) / math.cos(zenith)


def check_drift(distances: np.ndarray, speeds: np.ndarray, exposure: float, length: float) -> None:
    """Raise an error if a layer drifts once around its periodic screen."""
    layer = int(np.argmax(speeds))
    drift = float(speeds[layer]) * exposure
    if drift >= length:
        raise DomainError(
            f"screen_length = {length:g}: expected more than {drift:g} m, which layer {layer} at {distances[layer]:g} m"
            f" drifts in {exposure:g} s: screens are periodic, and light would meet the same turbulence again ("
            "'statistical' and 'long_exposure' need none)"
        )


def layer_random(seed: int, epoch: int, layer: int, name: str, count: int) -> np.ndarray:
    """Return random numbers from 0 to 1 of the stream of one layer."""
    return stream(seed, "atmosphere", epoch, layer, name).random(count)
