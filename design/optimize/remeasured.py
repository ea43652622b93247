"""Telescopes at the end of an optimisation, and their merit measured anew as they are saved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...core.errors import PachonError
from ...models.paraxial import following_stop, stop_makes_pupil, with_moved_pupil, with_true_aperture
from ...models.telescope import Telescope
from .configuration import DesignConfiguration
from .merit_function import MeritFunction


def final_telescope(telescope: Telescope, aiming: str) -> Telescope:
    """Return an optimised telescope with a stated aiming and its stop in its place.

    Its entrance pupil is where the stop is imaged now. Without such a pupil rays stay aimed at the stop.
    """
    if telescope.design_data.aiming == aiming:
        return with_true_aperture(telescope)
    stated = with_moved_pupil(telescope).with_design(aiming=aiming)
    return stated if stop_makes_pupil(stated) else with_true_aperture(telescope)


def remeasured(
    states: Sequence[DesignConfiguration],
    telescopes: Sequence[Telescope],
    function: MeritFunction,
    threads: int | None,
) -> tuple[float, float]:
    """Return the rms merit [m] of telescopes as they stand, of the light that arrives in each.

    With rays that fill the stop, and with rays as the design data of the telescopes state them; NaN without light. The
    spots are those of :func:`~pachon.design.metrics.spots.spots`.
    """

    def rms(state: DesignConfiguration, telescope: Telescope) -> float:
        try:
            return function.rms(telescope, state.beams(telescope, threads))
        except PachonError:
            return np.nan

    total = sum(state.weight for state in states)
    squares = np.zeros(2)
    for state, telescope in zip(states, telescopes, strict=True):
        filled = rms(state, following_stop(telescope))
        stated = filled if following_stop(telescope) is telescope else rms(state, telescope)
        squares += state.weight / total * np.array([filled, stated]) ** 2
    filled, stated = np.sqrt(squares)
    return float(filled), float(stated)
