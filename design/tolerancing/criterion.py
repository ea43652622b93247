"""Criteria of tolerances: numbers of a telescope, with the merit whose derivatives set the compensators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import PachonError
from ...models.telescope import Telescope
from ...raytrace.rays import field_angles
from ..images.mtf import tangential_angle
from ..metrics.principal_rays import principal_rays_of
from ..metrics.spots import spot_diagram
from ..optimize.merit import Beams, Merit, SpotMerit, WavefrontMerit
from ..optimize.ray_operands import WavefrontMtf

#: Fraction of the rays within the radius of the criterion "ee80".
_ENERGY = 0.8
#: Directions of the modulation transfer: along the field, and across it, from the former [rad].
_DIRECTIONS = np.array([0.0, 0.5 * np.pi])
_RMS_OVER_RAYS = "rms over fields, wavelengths and pupil"


@dataclass(frozen=True)
class Criterion:
    """A number of telescopes that tolerances are to keep good.

    Attributes
    ----------
    name : str
        "spots", "wavefront", "ee80", "mtf", or "own" for a function.
    title : str
        Name in plots.
    unit : str
        Unit of numbers in files and plots.
    scale : float
        Factor from SI to that unit.
    larger : bool
        Whether larger numbers are better.
    definition : str
        What the number is, as reports state it.
    judge : Merit
        Merit with derivatives, which the compensators minimise.
    function : callable, optional
        Function of a telescope that returns the number; by default the root of the sum of squares of `judge`.
    """

    name: str
    title: str
    unit: str
    scale: float
    larger: bool
    definition: str
    judge: Merit
    function: Callable[[Telescope], float] | None = None

    @classmethod
    def of(
        cls,
        name: str,
        telescope: Telescope,
        beams: Beams,
        *,
        frequency: float | None = None,
        function: Callable[[Telescope], float] | None = None,
    ) -> Criterion:
        """Return a criterion by name for rays that are lit in a telescope, or that of a function.

        The `frequency` [cycles/m, of afocal telescopes cycles/rad] is that of "mtf".
        """
        unit = "urad" if telescope.design_data.afocal else "um"
        if function is not None:
            judge = SpotMerit(telescope, beams)
            return cls("own", "own merit", "", 1.0, False, "a function of one's own", judge, function)
        if name == "wavefront":
            definition = "path of the rays without piston and tilt of each field, " + _RMS_OVER_RAYS
            return cls(name, "rms wavefront", "nm", 1e9, False, definition, WavefrontMerit(telescope, beams))
        if name == "mtf":
            frequency = float(frequency or 0.0)
            title = f"mean MTF at {1e-3 * frequency:g} per {'mrad' if telescope.design_data.afocal else 'mm'}"
            definition = "contrast of waves along the field and across it, mean over fields and wavelengths"
            transfer = _MeanTransfer.of(telescope, beams, frequency)
            return cls(name, title, "", 1.0, True, definition, WavefrontMerit(telescope, beams), transfer)
        judge = SpotMerit(telescope, beams)
        if name == "ee80":
            definition = "radius about the centroid of a field that holds 80 % of its rays, rms over the fields"
            radius = _EnergyRadius(beams)
            return cls(name, "radius of 80 % of the rays", unit, 1e6, False, definition, judge, radius)
        definition = "distance of the rays from the centroid of their field, " + _RMS_OVER_RAYS
        return cls("spots", "rms spot radius", unit, 1e6, False, definition, judge)

    def measure(self, telescope: Telescope) -> float:
        """Return the number of a telescope, in SI; NaN where its light is lost."""
        try:
            if self.function is not None:
                return float(self.function(telescope))
            return float(np.linalg.norm(self.judge.residuals(telescope)))
        except PachonError:
            return np.nan

    def loss(self, value: np.ndarray, nominal: float) -> np.ndarray:
        """Return by how much numbers are worse than the nominal one."""
        return nominal - value if self.larger else value - nominal


@dataclass(frozen=True)
class _EnergyRadius:
    """Radius of 80 % of the rays about the centroid, rms over the fields."""

    beams: Beams

    def __call__(self, telescope: Telescope) -> float:
        radii = spot_diagram(replace(self.beams.request, telescope=telescope)).radius_holding(_ENERGY)
        return float(np.sqrt(self.beams.field_weights @ radii**2))


@dataclass(frozen=True)
class _MeanTransfer:
    """Modulation transfer from differences of the wavefront, mean over fields, wavelengths and two directions."""

    operands: tuple[WavefrontMtf, ...]
    weights: np.ndarray

    @classmethod
    def of(cls, telescope: Telescope, beams: Beams, frequency: float) -> _MeanTransfer:
        request = beams.request
        along_field = tangential_angle(telescope, principal_rays_of(replace(request, telescope=telescope)))
        operands = tuple(
            WavefrontMtf((float(x), float(y)), frequency, float(angle), float(wavelength), value=1.0).bound(telescope)
            for (x, y), tangential in zip(field_angles(request.slopes), along_field, strict=True)
            for wavelength in request.wavelengths
            for angle in tangential + _DIRECTIONS
        )
        weights = np.outer(beams.field_weights, request.weights).ravel()
        return cls(operands, np.repeat(weights, len(_DIRECTIONS)) / len(_DIRECTIONS))

    def __call__(self, telescope: Telescope) -> float:
        return float(self.weights @ [operand.measure(telescope) for operand in self.operands])
