"""Pupils that the light of stars over the field of view takes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class FieldPupils:
    """Pupils of stars on rings about the centre of the field, which is the first; compared by identity."""

    radius: np.ndarray  #: field slopes of the rings, rising from zero [rad], [n_ring]
    directions: int  #: of the stars of a ring, evenly from +x
    diameter: float  #: of the entrance pupil, which the grid of cells covers [m]
    #: Lit part of each cell over that of all, [n_node, side, side]: centre, then ring by ring.
    light: np.ndarray
    full: np.ndarray  #: the same of the pupil without vignetting, [side, side]

    def halved(self) -> FieldPupils:
        """Return the same on half of the cells along each side, which are even in number."""
        half = len(self.full) // 2
        light = self.light.reshape(-1, half, 2, half, 2).mean(axis=(2, 4))
        return replace(self, light=light, full=self.full.reshape(half, 2, half, 2).mean(axis=(1, 3)))

    def weights(self, slopes: np.ndarray) -> np.ndarray:
        """Return weights of the nodes at field slopes [n, 2] [rad], [n, n_node].

        They are linear in the radius, and trigonometric in the direction; beyond the last ring is what is there.
        """
        distance = np.minimum(np.hypot(*slopes.T), self.radius[-1])
        ring = np.clip(np.searchsorted(self.radius, distance, side="right") - 1, 0, len(self.radius) - 2)
        outward = (distance - self.radius[ring]) / np.diff(self.radius)[ring]
        turn = (
            np.arctan2(slopes[:, 1], slopes[:, 0])[:, None] - 2.0 * np.pi * np.arange(self.directions) / self.directions
        )
        around = _trigonometric(turn, self.directions)
        out = np.zeros((len(slopes), len(self.light)))
        for inner, factor in ((ring, 1.0 - outward), (ring + 1, outward)):
            out[:, 0] += np.where(inner == 0, factor, 0.0)
            rows = np.flatnonzero(inner > 0)
            columns = 1 + (inner[rows, None] - 1) * self.directions + np.arange(self.directions)
            out[rows[:, None], columns] += factor[rows, None] * around[rows]
        return out


def _trigonometric(angle: np.ndarray, count: int) -> np.ndarray:
    """Return the weight of a value an angle away, of so many evenly around a circle; an even number."""
    orders = np.arange(1, count // 2)
    return (1.0 + 2.0 * np.cos(orders * angle[..., None]).sum(axis=-1) + np.cos(count // 2 * angle)) / count
