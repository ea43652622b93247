r"""Whether images of donuts have light that is diffracted at the rims of the pupil, from the images themselves.

A fit of rays tells how much chi-square would fall by an amount a of the diffracted light, 0 for rays and 1 for waves:
with its image r, the derivatives A of all else, their prior P, the residuals d and the variance V, the best amount is
:math:`\hat a = \tilde r^T V^{-1} d / \tilde r^T V^{-1} r` with :math:`\tilde r` the part of r that A does not explain.
Chi-square with a = 1 is lower than with a = 0 where :math:`\hat a > 1/2`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..wavefront.psf.pupil_rims import pupil_rims
from .image_model import STRENGTH, LandedLight
from .light import Instrument, diffracting_pieces
from .likelihood import linearized
from .star_fitter import SMALLEST_DONUT, StarSolution

#: Donuts that are asked.
VOTERS = 3


@dataclass(frozen=True)
class RimAmplitude:
    """Amount of diffracted light in an image, 1 for waves and 0 for rays, and the inverse of its variance."""

    value: float
    precision: float


def rim_amplitude(instrument: Instrument, star: StarSolution) -> RimAmplitude | None:
    """Return how much diffracted light an image has; None for stars in focus and images without air.

    Parameters
    ----------
    instrument : Instrument
        Telescope and model of the images, of rays.
    star : StarSolution
        Best model by rays.
    """
    stamp, solution, light = star.stamp, star.solution, star.light
    unknowns, wave = solution.stars[0], solution.waves[0]
    if unknowns[STRENGTH] == 0.0 or light.diameter < SMALLEST_DONUT * instrument.pixel:
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
    prior = np.zeros(len(scales))
    precision = np.concatenate([instrument.terms.precision, light.shift_precision])
    prior[len(unknowns) :] = precision
    state = np.concatenate([np.zeros(len(unknowns)), wave])
    curvature = columns.T @ columns * np.outer(scales, scales) + np.diag(prior)
    scale = np.sqrt(np.maximum(np.diag(curvature), 1e-300))
    cross = scales * (columns.T @ light_column) / scale
    gradient = (scales * (columns.T @ residual) - prior * state) / scale
    solved = np.linalg.pinv(curvature / np.outer(scale, scale), rcond=1e-12, hermitian=True) @ np.stack(
        [cross, gradient], axis=1
    )
    information = float(light_column @ light_column - cross @ solved[:, 0])
    if not information > 0.0:
        return None
    return RimAmplitude(float(light_column @ residual - cross @ solved[:, 1]) / information, information)


def waves_fit_better(amplitudes: Sequence[RimAmplitude]) -> bool:
    """Return whether donuts together have less chi-square with diffraction than without."""
    return sum((2.0 * a.value - 1.0) * a.precision for a in amplitudes) > 0.0
