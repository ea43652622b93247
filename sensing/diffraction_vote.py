r"""Whether images of donuts have light that is diffracted at the rims of the pupil, from the images themselves.

A fit of rays tells how much chi-square would fall by an amount a of the diffracted light, 0 for rays and 1 for waves:
with its image r, the derivatives A of all else, their prior P, the residuals d and the variance V, the best amount is
:math:`\hat a = \tilde r^T V^{-1} d / \tilde r^T V^{-1} r` with :math:`\tilde r` the part of r that A does not explain.
Chi-square with a = 1 is lower than with a = 0 where :math:`\hat a > 1/2`.

Where much of the seeing of a fit by rays stands for diffracted light, that fit is no start: donuts of a 1.2 m telescope
of f/2.5 have 1.8 arcsec for 0.6. Neither is it where images are small, nor does an amount between those of rays and of
waves decide, nor a small one where rays leave more than noise, as of caustics. Then fits of both kinds are compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..wavefront.psf.pupil_rims import pupil_rims
from .first_search import FEW_WIDTHS
from .fit_star import StarFit
from .image_model import STRENGTH, LandedLight
from .light import Instrument, diffracting_pieces
from .likelihood import linearized, pixel_variance
from .sides import CONTRADICTED
from .stamps import central_slices
from .star_fitter import StarSolution

#: Donuts that are asked.
_VOTERS = 3
#: Chi-square by which rays have to fit better: twice the logarithm of the odds that light is diffracted, as that of
#: stars is, by which faint images are decided.
_BEFOREHAND = 2.0 * math.log(10.0)
#: Part of the strength of the turbulence that stands for diffracted light, from which on derivatives at the seeing of a
#: fit by rays say nothing of one by waves: LSST, DECam and HSC have 0.1 to 0.23, 1.2 m at f/2.5 0.34 to 0.42.
_MUCH = 0.3
#: Amount of diffracted light from which on it is not that of rays: these leave 0, waves 0.97 to 1.6 in 60 donuts, and
#: 0.34 where AuxTel has 100 nm in terms up to Z22, whose fit by rays is far off.
_NOT_OF_RAYS = 0.2
#: Standard deviations of chi-square from which on rays leave more than noise.
_DEVIATIONS = 5.0


@dataclass(frozen=True)
class _RimAmplitude:
    """Amount of diffracted light in an image, 1 for waves and 0 for rays, and the inverse of its variance."""

    value: float
    precision: float
    seeing: float  #: part of the strength of the turbulence that stands for this light in a fit by rays
    explained: bool  #: whether the fit by rays leaves no more than noise


def _rim_amplitude(instrument: Instrument, star: StarSolution) -> _RimAmplitude | None:
    """Return how much diffracted light an image has; None for small images and those without air.

    Parameters
    ----------
    instrument : Instrument
        Telescope and model of the images, of rays.
    star : StarSolution
        Best model by rays.
    """
    stamp, solution, light = star.stamp, star.solution, star.light
    unknowns, wave = solution.stars[0], solution.waves[0]
    blur = float(instrument.seeing.fwhm(unknowns[STRENGTH])) * light.scale
    if not _has_air(star) or not instrument.is_donut(light) or light.diameter < FEW_WIDTHS * blur:
        return None
    pieces = diffracting_pieces(light.diameter / stamp.grid.pixel)
    rims = pupil_rims(light.telescope, light.direction, instrument.middle, pieces)
    point = linearized(stamp, unknowns, wave)
    if point is None:
        return None
    landing = stamp.rays.landing(wave)
    at_rims = stamp.rays.at_rims(rims, landing, None)
    waves = LandedLight(landing, stamp.rays.weights(wave), stamp.rays.spread(landing), at_rims)
    diffracted = stamp.grid.diffracting(rims).image(unknowns, waves) - point.model
    columns, scales = point.columns, point.scales.copy()
    if instrument.known_seeing:
        scales[STRENGTH] = 0.0
    light_column, residual = point.over_noise(diffracted[..., None].astype(np.float32))[:, 0], point.pulls
    prior, deviation = instrument.prior(light, unknowns, wave, solution.prior_weight)
    curvature = columns.T @ columns * np.outer(scales, scales) + np.diag(prior)
    scale = np.sqrt(np.maximum(np.diag(curvature), 1e-300))
    cross = scales * (columns.T @ light_column) / scale
    gradient = (scales * (columns.T @ residual) - prior * deviation) / scale
    solved = np.linalg.pinv(curvature / np.outer(scale, scale), rcond=1e-12, hermitian=True) @ np.stack(
        [cross, gradient], axis=1
    )
    information = float(light_column @ light_column - cross @ solved[:, 0])
    if not information > 0.0:
        return None
    amplitude = float(light_column @ residual - cross @ solved[:, 1]) / information
    seeing = float(solved[STRENGTH, 0] / scale[STRENGTH]) / unknowns[STRENGTH]
    n_pixels = int(stamp.used.sum())
    explained = float(solution.loss) < n_pixels + _DEVIATIONS * math.sqrt(2.0 * n_pixels)
    return _RimAmplitude(amplitude, information, seeing, explained)


def _has_air(star: StarSolution) -> bool:
    """Return whether an image has air: diffraction alone is none of a model of donuts."""
    return bool(star.solution.stars[0][STRENGTH] > 0.0)


def _waves_fit_better(amplitudes: Sequence[_RimAmplitude]) -> bool | None:
    """Return whether donuts together have diffraction, unless rays fit better; None where they do not say."""
    if not amplitudes:
        return None
    if sum((2.0 * a.value - 1.0) * a.precision for a in amplitudes) > -_BEFOREHAND:
        return True
    linear = np.mean([a.seeing for a in amplitudes]) < _MUCH
    amount = np.average([a.value for a in amplitudes], weights=[a.precision for a in amplitudes])
    explained = all(a.explained for a in amplitudes)
    return False if linear and explained and amount < _NOT_OF_RAYS else None


def _chi2_fall(rays: StarFit, waves: StarFit) -> float:
    """Return by how much chi-square is lower by a fit with diffraction than by one of rays, with the noise of this.

    A fit that failed is worse by half of what decides; two have no difference.
    """
    if rays.usable is None or waves.usable is None:
        return 0.5 * CONTRADICTED * ((waves.usable is not None) - (rays.usable is not None))
    by_rays, by_waves = rays.usable, waves.usable
    shape = (min(rows) for rows in zip(by_rays.model.shape, by_waves.model.shape, strict=True))
    stamp, middle = by_rays.full, central_slices(by_rays.model.shape, inner := tuple(shape))
    middle_of_waves = central_slices(by_waves.model.shape, inner)
    # In the unit of the rays' fit.
    model = (by_waves.model[middle_of_waves] * waves.unit + waves.level - rays.level) / rays.unit
    residuals = (stamp.image[middle] - values for values in (by_rays.model[middle], model))
    before, after = (residual**2 / pixel_variance(stamp, by_rays.model)[middle] for residual in residuals)
    return float((before - after)[stamp.used[middle] & by_waves.full.used[middle_of_waves]].sum())


class DiffractionVote(NamedTuple):
    """Whether light is diffracted, by the first stars: fits of these by rays where others may begin, or with waves."""

    diffraction: bool
    by_rays: Mapping[int, StarFit] = MappingProxyType({})
    by_waves: Mapping[int, StarFit] = MappingProxyType({})

    def fit_of(self, star: int, instrument: Instrument, alone: Callable[..., StarFit]) -> StarFit:
        """Return the fit of a star by itself, where there is one by rays begun from that; arguments as of the vote."""
        if star in self.by_waves:
            return self.by_waves[star]
        if star not in self.by_rays:
            return alone(instrument, star)
        rays = self.by_rays[star]
        if not (self.diffraction or rays.preliminary):
            return rays
        begun = replace(rays.with_light(instrument), searched=not self.diffraction)
        return alone(instrument, star, begun)


def vote_on_diffraction(
    instrument: Instrument, alone: Callable[..., StarFit], count: int, pool: Executor
) -> DiffractionVote:
    """Return whether the first stars have diffraction: it lowers chi-square, or they hardly tell.

    Parameters
    ----------
    instrument : Instrument
        Telescope and model of the images, of rays.
    alone : callable
        Fit of one star by itself, for an instrument, its number and ``preliminary``.
    count : int
        Number of stars.
    pool : Executor
        Where they are fitted.
    """
    by_rays: dict[int, StarFit] = {}
    amplitudes: list[_RimAmplitude] = []
    for first in range(0, count, _VOTERS):
        indices = range(first, min(first + _VOTERS, count))
        by_rays.update(zip(indices, pool.map(partial(alone, instrument, preliminary=True), indices), strict=True))
        usable = [by_rays[i].usable for i in indices]
        votes = [_rim_amplitude(instrument, star) for star in usable if star is not None]
        amplitudes += [vote for vote in votes if vote is not None]
        if len(amplitudes) >= _VOTERS:
            break
    diffraction = _waves_fit_better(amplitudes)
    if diffraction is None:
        waves, fall = replace(instrument, model=replace(instrument.model, diffraction=True)), 0.0
        by_waves: dict[int, StarFit] = {}
        for i, star in by_rays.items():
            if len(by_waves) < _VOTERS and abs(fall) < CONTRADICTED and (star.usable is None or _has_air(star.usable)):
                by_waves[i] = alone(waves, i)
                fall += _chi2_fall(star, by_waves[i])
        return DiffractionVote(True, by_waves=by_waves) if fall > 0.0 else DiffractionVote(False, by_rays)
    return DiffractionVote(diffraction, by_rays)
