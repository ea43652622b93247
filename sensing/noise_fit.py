"""Fit of one star with its known noise, or with noise and sky level that are measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from .fit_star import StarFit, fit_star
from .image_model import BACKGROUND
from .inputs import ObservedStar
from .light import Instrument, StarLight
from .noise import AssumedElectron, PixelNoise, faint_level, measured_noise, smoothed
from .stamps import Pixels
from .star_fitter import StarSolution

#: Ratio of the noise that a fit leaves to that which it assumed, up to which its search holds.
_NOISE_AGREES = 2.0
#: Most fits of a star whose noise is measured.
_NOISE_FITS = 3
#: Change of the level of a star's background over the variance of its sky, up to which weights of pixels hold.
_LEVEL_CHANGE = 0.05


def fit_with_noise(
    instrument: Instrument,
    light: StarLight,
    star: ObservedStar,
    begun: StarFit | None,
    *,
    used: np.ndarray,
    strength: float,
    wavefront: bool,
    preliminary: bool,
) -> StarFit:
    """Fit the used pixels of one star with its known noise, or with noise and sky level that are measured."""
    fit = partial(fit_star, instrument, light, strength=strength, wavefront=wavefront, preliminary=preliminary)
    image = np.where(used, star.image, 0.0)
    if star.known_noise:
        return _fit_with_known_noise(fit, image, star.variance, used, begun)
    smooth = smoothed(image, used)
    level = faint_level(smooth, used)
    image = np.where(used, star.image - level, 0.0)
    if begun is None or begun.usable is None:
        noise = measured_noise(image, smooth - level, used, level)
    else:
        noise = _noise_of(begun.usable, begun.unit)
    brightest = float((smooth - level)[used].max(initial=0.0))
    for _ in range(_NOISE_FITS):
        unit = noise.photon
        pixels = Pixels(image / unit, np.full(image.shape, noise.sky / unit**2), used)
        fitted = fit(pixels, electron=AssumedElectron(unit, level / unit), begun=begun)
        if fitted.usable is None:
            break
        assumed, noise, begun = noise, _noise_of(fitted.usable, unit * fitted.unit), None
        if 1.0 / _NOISE_AGREES < noise.variance(brightest) / assumed.variance(brightest) < _NOISE_AGREES:
            break
    return replace(fitted, unit=unit * fitted.unit, level=level)


def _fit_with_known_noise(
    fit: Callable[..., StarFit], image: np.ndarray, variance: np.ndarray, used: np.ndarray, begun: StarFit | None
) -> StarFit:
    """Fit one star, and again where the level of its background is that of a sky left in, or of one taken off twice."""
    # The level beside a donut is that of the sky or above it.
    level = min(faint_level(smoothed(image, used), used), 0.0)
    least_change = _LEVEL_CHANGE * float(np.median(variance))

    def at_level(level: float, begun: StarFit | None) -> StarFit:
        # The variance is that of the level, whose light has it already.
        return fit(Pixels(image, np.maximum(variance - level, 0.0), used), begun=begun)

    fitted = at_level(level, begun)
    for _ in range(_NOISE_FITS - 1):
        before, level = level, light_level(fitted)
        if fitted.usable is None or abs(level - before) <= least_change:
            break
        again = at_level(level, replace(fitted, searched=True))
        fitted = fitted if again.usable is None else again
    return fitted


def _noise_of(solution: StarSolution, unit: float) -> PixelNoise:
    """Return the noise that a solution in a unit left [units of the image]."""
    return PixelNoise(float(solution.full.variance.mean()) * unit**2, unit)


def light_level(fitted: StarFit) -> float:
    """Return the level of a stamp above which there is light of the star by its fit [units of the image]."""
    usable = fitted.usable
    return fitted.level + (0.0 if usable is None else fitted.unit * float(usable.solution.stars[0][BACKGROUND]))
