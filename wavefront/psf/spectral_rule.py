r"""Fewer wavelengths that stand for those of flat spectra: Gauss rules over them.

The transfer function of a PSF is the mean over wavelengths of one that changes smoothly from one to the next. The n
wavelengths of a Gauss rule (:mod:`...core.gauss_rule`) have the mean of polynomials up to the order 2 n - 1, so that
two or three stand for the five of a band, unless dispersion by the air is strong.

The error is that of transfer functions of the air and of rays, at a few fields and frequencies; it is the same for all
stars of an exposure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ...core.errors import DomainError
from ...core.gauss_rule import gauss_rule
from ...models.telescope import Telescope
from ...raytrace.rays import Projection
from ..atmosphere.turbulence import coherence, fried_parameter, structure_function
from ..pupil_optics import PupilOptics, trace_pupils
from .channels import Channels
from .engine import PsfInputs

#: Largest error of the transfer function: e of the LSST is then wrong by 5e-5 (rms), its size by 1e-4; with two
#: wavelengths and no dispersion e by 1e-6.
LARGEST_ERROR = 3e-4
# Wavelengths that are tried, beside the middle one, to which fields and chief rays belong: it is dark where there are
# two.
_COUNTS = (2, 3, 5, 7)
# Fields that are looked at, over the radius of the field of view, and rings of the pupil and points on each.
_FIELDS = np.array([(0.0, 0.0), (0.6, 0.0), (-0.6, 0.7)])
_RADII = (0.75, 1.0)
_ANGLES = 6
# Baselines over the Fried parameter, beyond which the air leaves a thousandth, and directions.
_BASELINES = np.linspace(0.2, 1.4, 7)
_DIRECTIONS = 4


@dataclass(frozen=True, eq=False)
class SpectralRule:
    """Wavelengths that stand for others, and their light."""

    wavelengths: np.ndarray  #: [n_node] m
    photons: np.ndarray  #: of mean 1, [n_node]
    dispersion: np.ndarray | None  #: [n_node, 2] rad

    @classmethod
    def of(cls, wavelengths: np.ndarray, dispersion: np.ndarray | None, count: int) -> SpectralRule:
        """Return so many nodes for wavelengths [n_wave] of equal light, with their dispersion [n_wave, 2]."""
        middle, half = 0.5 * (wavelengths.max() + wavelengths.min()), 0.5 * np.ptp(wavelengths)
        places = (wavelengths - middle) / half
        nodes, weights = gauss_rule(places, np.full(len(places), 1.0 / len(places)), count)
        if count == 2:
            nodes, weights = np.insert(nodes, 1, places[len(places) // 2]), np.insert(weights, 1, 0.0)
        if dispersion is not None:
            # The polynomial through all of them.
            powers = np.linalg.solve(np.vander(places), dispersion)
            dispersion = np.vander(nodes, len(places)) @ powers
        return cls(middle + half * nodes, weights * len(nodes), dispersion)

    def inputs(self, inputs: PsfInputs) -> PsfInputs:
        """Return the inputs of a renderer with these wavelengths."""
        return replace(inputs, wavelengths=self.wavelengths, dispersion=self.dispersion)


def spectral_rule(inputs: PsfInputs, depths: int) -> SpectralRule | None:
    """Return the fewest wavelengths that stand for those of inputs of flat spectra; None where all are needed.

    `depths` are those of :class:`.Channels` for each wavelength.
    """
    wavelengths = np.asarray(inputs.wavelengths, dtype=np.float64)
    if inputs.trace is not trace_pupils or inputs.atmosphere is None or len(set(wavelengths)) < len(wavelengths):
        return None
    middle = wavelengths[len(wavelengths) // 2]
    for count in _COUNTS:
        if max(count, _COUNTS[1]) >= len(wavelengths):
            return None
        rule = SpectralRule.of(wavelengths, inputs.dispersion, count)
        if abs(rule.wavelengths[len(rule.wavelengths) // 2] - middle) > 1e-9 * middle:
            return None
        if _error(inputs, rule, depths) <= LARGEST_ERROR:
            return rule
    return None


def _error(inputs: PsfInputs, rule: SpectralRule, depths: int) -> float:
    """Return the largest error of the transfer function of atmosphere and optics."""
    try:
        all_light, nodes = (
            _transfer(part, photons, depths)
            for part, photons in ((inputs, np.ones(len(inputs.wavelengths))), (rule.inputs(inputs), rule.photons))
        )
    except DomainError:  # of fields that no light comes from
        return math.inf
    return float(np.abs(all_light - nodes).max())


def _transfer(inputs: PsfInputs, photons: np.ndarray, depths: int) -> np.ndarray:
    """Return transfer functions at the fields and frequencies, [n_field, n_frequency]."""
    air, wavelengths = inputs.atmosphere, np.asarray(inputs.wavelengths, dtype=np.float64)
    assert air is not None
    optics = _optics(inputs.telescope, tuple(wavelengths.tolist()), inputs.projection)
    channels = Channels.of(inputs.silicon, wavelengths, inputs.plane.diffusion, depths)
    # On the sky, as shifts by dispersion are.
    places = channels.displacement(optics).astype(np.float64) @ np.linalg.inv(optics.jacobian)[:, None].swapaxes(2, 3)
    if inputs.dispersion is not None:
        places += inputs.dispersion[channels.wave, None]
    middle = float(wavelengths[len(wavelengths) // 2])
    longest = 2.0 * math.pi * float(fried_parameter(air.r0, middle)) / middle
    angle = math.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    frequencies = longest * (_BASELINES[:, None, None] * directions).reshape(-1, 2)
    baselines = wavelengths[:, None] * np.hypot(*frequencies.T) / (2.0 * math.pi)
    light = coherence(structure_function(baselines, air.r0, air.outer_scale), wavelengths[:, None])
    light *= photons[:, None] / len(photons)
    waves = np.exp(-1j * (places @ frequencies.T)).mean(axis=2)
    return np.asarray(np.einsum("fck,ck->fk", waves, light[channels.wave] * channels.weight[:, None]))


@lru_cache(maxsize=16)
def _optics(telescope: Telescope, wavelengths: tuple[float, ...], projection: Projection) -> PupilOptics:
    """Return the optics of the fields."""
    radius, angle = 0.5 * telescope.pupil_diameter, 2.0 * math.pi * np.arange(_ANGLES) / _ANGLES
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inner = telescope.pupil_obscuration
    pupil = np.concatenate([(inner + (1.0 - inner) * at) * ring for at in _RADII])
    fields = telescope.field_radius * _FIELDS
    return trace_pupils(telescope, fields, wavelengths, pupil, projection=projection, threads=1)
