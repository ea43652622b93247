"""Telescopes at the end of an optimisation, and their merit measured anew as they are saved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.errors import ConfigError, PachonError
from ...models.paraxial import following_stop, stop_makes_pupil, with_moved_pupil, with_true_aperture
from ...models.telescope import Telescope
from ..metrics.spots import spot_diagram
from .configuration import DesignConfiguration
from .merit import Beams, Merit, SpotMerit, WavefrontMerit


@dataclass(frozen=True)
class MeritOptions:
    """Merit of an optimisation by its name, or a merit itself, with the arguments of its rays."""

    merit: str | Merit
    reference: str
    goal: Any
    rays: dict[str, Any]

    def beams(self, telescope: Telescope, one: DesignConfiguration) -> Beams:
        """Return the rays of the fields and wavelengths of a configuration through a telescope."""
        weights: dict[str, Any] = dict(field_weights=one.field_weights, wavelength_weights=one.wavelength_weights)
        return Beams.of(telescope, one.fields, one.wavelengths, **weights, **self.rays)

    def of(self, telescope: Telescope, beams: Beams) -> Merit:
        """Return the merit of rays that are lit in a telescope; ConfigError where it is not known."""
        if not isinstance(self.merit, str):
            return self.merit
        if self.reference not in ("centroid", "chief"):
            raise ConfigError(f"reference = {self.reference!r}: expected 'centroid' or 'chief'")
        if self.merit == "wavefront":
            return WavefrontMerit(telescope, beams, self.goal)
        if self.merit != "spots":
            raise ConfigError(f"merit = {self.merit!r}: expected 'spots' or 'wavefront'")
        if self.goal is not None:
            raise ConfigError("goal is given: expected merit = 'wavefront' with it")
        return SpotMerit(telescope, beams, self.reference)


def final_telescope(telescope: Telescope, aiming: str) -> Telescope:
    """Return an optimised telescope with a stated aiming and its stop in its place.

    Its entrance pupil is where the stop is imaged now. Without such a pupil rays stay aimed at the stop.
    """
    if telescope.design_data.aiming == aiming:
        return with_true_aperture(telescope)
    stated = with_moved_pupil(telescope).with_design(aiming=aiming)
    return stated if stop_makes_pupil(stated) else with_true_aperture(telescope)


def remeasured(
    given: Sequence[DesignConfiguration], telescopes: Sequence[Telescope], options: MeritOptions
) -> tuple[float, float]:
    """Return the rms merit [m] of telescopes as they stand, of the light that arrives in each.

    With rays that fill the stop, and with rays as the design data of the telescopes state them; NaN without light. The
    spots are those of :func:`~pachon.design.metrics.spots.spots`.
    """
    total = sum(one.weight for one in given)
    squares = np.zeros(2)
    for one, telescope in zip(given, telescopes, strict=True):
        filled = _rms(following_stop(telescope), one, options)
        stated = filled if following_stop(telescope) is telescope else _rms(telescope, one, options)
        squares += one.weight / total * np.array([filled, stated]) ** 2
    filled, stated = np.sqrt(squares)
    return float(filled), float(stated)


def _rms(telescope: Telescope, one: DesignConfiguration, options: MeritOptions) -> float:
    try:
        beams = options.beams(telescope, one)
        if options.merit == "spots" and options.reference == "centroid":
            radii = spot_diagram(beams.request).rms_radius
            counted = beams.field_weights > 0.0
            return float(np.sqrt(beams.field_weights[counted] @ radii[counted] ** 2))
        return float(np.linalg.norm(options.of(telescope, beams).residuals(telescope)))
    except PachonError:
        return np.nan
