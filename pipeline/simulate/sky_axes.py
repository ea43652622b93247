"""Axes of the sky at places on the focal plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...sky.sky_shapes import jacobians_on_sky
from ...wavefront.chief_rays import fields_of_groups
from ..experiment import Experiment
from ..resolved_values import resolved_value

#: Step on the detector of the central differences [m]: 2 arcsec of the LSST.
_STEP = 1e-4


def sky_jacobians(experiment: Experiment, groups: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return d(west, north)/d(x, y) [rad/m] at groups of places on the detector [m], [n, 2, 2] for [n, 2] each.

    No group changes a byte of another. DomainError if a place lies outside the field of the telescope; the
    configuration must have a pointing.
    """
    pointing, wavelengths = resolved_value(experiment.pointing), experiment.wavelengths
    counts = [len(group) for group in groups]
    if not sum(counts):
        return [np.empty((0, 2, 2)) for _ in groups]
    middle = float(wavelengths[len(wavelengths) // 2])

    def celestial_of(places: np.ndarray) -> np.ndarray:
        all_counts = counts * (len(places) // sum(counts))
        fields = fields_of_groups(experiment.telescope, places, all_counts, middle, threads=1)
        return pointing.to_celestial(pointing.to_sky(np.tan(fields)))

    _, jacobians = jacobians_on_sky(celestial_of, np.concatenate(groups), _STEP)
    return np.split(jacobians, np.cumsum(counts)[:-1])
