"""Merits of tolerances: numbers of a telescope, with the merit whose derivatives set the compensators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import PachonError
from ...design.metrics.spots import spot_diagram
from ...design.optimize.merit import Beams, Merit, SpotMerit, WavefrontMerit
from ...design.optimize.ray_operands import WavefrontMtf
from ...models.telescope import Telescope
from .file import ToleranceFile

#: Fraction of the rays of the radius "ee80".
_ENERGY = 0.8


@dataclass(frozen=True)
class ToleranceMerit:
    """A merit of telescopes.

    Attributes
    ----------
    name : str
        Name: that of the file, or "own".
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
    own : callable, optional
        Function of a telescope that returns the number; by default the root of the sum of squares of `judge`.
    """

    name: str
    title: str
    unit: str
    scale: float
    larger: bool
    definition: str
    judge: Merit
    own: Callable[[Telescope], float] | None = None

    def measure(self, telescope: Telescope) -> float:
        """Return the number of a telescope, in SI; NaN where its light is lost."""
        try:
            if self.own is not None:
                return float(self.own(telescope))
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

    def __call__(self, telescope: Telescope) -> float:
        return float(self.weights @ [operand.measure(telescope) for operand in self.operands])


def tolerance_merit(
    file: ToleranceFile,
    telescope: Telescope,
    own: Callable[[Telescope], float] | None = None,
) -> ToleranceMerit:
    """Return the merit of a file, or a function of one's own, for a telescope; it takes one thread."""
    fields = None if file.fields_deg is None else np.deg2rad(file.fields_deg)
    waves = None if file.wavelengths_nm is None else np.array(file.wavelengths_nm) * 1e-9
    weights = None if file.field_weights is None else list(file.field_weights)
    beams = Beams.of(telescope, fields, waves, field_weights=weights, n_pupil=file.rings, threads=1)
    if own is not None:
        return ToleranceMerit(
            "own", "own merit", "", 1.0, False, "a function of one's own", SpotMerit(telescope, beams), own
        )
    if file.merit == "wavefront":
        return ToleranceMerit(
            "wavefront",
            "rms wavefront",
            "nm",
            1e9,
            False,
            "path of the rays without piston and tilt of each field, rms over fields, wavelengths and pupil",
            WavefrontMerit(telescope, beams),
        )
    if file.merit == "mtf":
        request = beams.request
        pairs = [(tuple(map(float, f)), float(w)) for f in request.fields for w in request.wavelengths]
        operands = tuple(
            WavefrontMtf((f[0], f[1]), 1e3 * float(file.frequency_per_mm or 0.0), angle, w, value=1.0).bound(telescope)
            for f, w in pairs
            for angle in (0.5 * np.pi, 0.0)
        )
        each = np.repeat(np.outer(beams.field_weights, request.weights).ravel(), 2) / 2.0
        transfer = _MeanTransfer(operands, each)
        title = f"mean MTF at {file.frequency_per_mm:g} per {'mrad' if telescope.design_data.afocal else 'mm'}"
        return ToleranceMerit(
            "mtf",
            title,
            "",
            1.0,
            True,
            "contrast of waves along the field and across it, mean over fields and wavelengths",
            WavefrontMerit(telescope, beams),
            transfer,
        )
    judge, unit = SpotMerit(telescope, beams), "urad" if telescope.design_data.afocal else "um"
    if file.merit == "ee80":
        return ToleranceMerit(
            "ee80",
            "radius of 80 % of the rays",
            unit,
            1e6,
            False,
            "radius about the centroid of a field that holds 80 % of its rays, rms over the fields",
            judge,
            _EnergyRadius(beams),
        )
    return ToleranceMerit(
        "spots",
        "rms spot radius",
        unit,
        1e6,
        False,
        "distance of the rays from the centroid of their field, rms over fields, wavelengths and pupil",
        judge,
    )
