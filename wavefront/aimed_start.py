"""Aimed points of one telescope, from which the search for those of telescopes like it starts."""

from __future__ import annotations

import numpy as np

from ..models.telescope import Telescope
from ..raytrace.aiming import AimedPoints
from ..raytrace.launch import aimed_points


class AimedStart:
    """Points of the entrance pupil that aimed rays of some directions cross, each set computed at its first use."""

    def __init__(self, telescope: Telescope, directions: np.ndarray) -> None:
        self._telescope, self._directions = telescope, directions
        self._computed: dict[tuple[float, bytes], AimedPoints] = {}

    def at(self, wavelength: float, pupil: np.ndarray) -> AimedPoints:
        """Return those of pupil points [m], [n_pupil, 2] or [n_field, n_pupil, 2]; DomainError as `aimed_points`."""
        key = (wavelength, pupil.tobytes())
        if key not in self._computed:
            points = aimed_points(self._telescope, self._directions, wavelength, pupil)
            self._computed[key] = AimedPoints.of(self._telescope, self._directions, wavelength, pupil, points)
        return self._computed[key]
