"""Masked and rejected pixels of stars, filled from the other pixels and the other stars."""

from __future__ import annotations

import numpy as np

from ...core.errors import DomainError
from ...measure.star_flux import median_star, pixel_noise, star_fluxes

# Passes end when no pixel, or flux, changes by more than this fraction of the greatest.
_CONVERGED = 1e-12
_MOST_PASSES = 100
# Passes that change more than the least by this factor do not converge.
_DIVERGED = 10.0
# Passes of means and fluxes where pixels are rejected.
_FLUX_PASSES = 20
# Stars in which a pixel is masked are predicted only along the directions that the others determine: an eigenvalue of
# 1 - H under this would enlarge noise by more than seven.
_LEAST_ROOM = 0.02
# Least mean square of a star's scatter over that of the middle star: a star that counted alone would have no room.
_LEAST_SCATTER = 0.25
# Light of a pixel over that of the brightest, at least, that tells its signal.
_FAINTEST = 1e-4
# Pixels that tell the noise, of those in which the fewest stars are masked.
_CLEAN_PIXELS = 50
# Variance of the noise over that of light, at least; over that before, if it was not the first guess of masked pixels.
_LEAST_NOISE = 1e-24
_LESS_NOISE = 0.5
# Variance of the signal on the slopes of a star, over that in proportion to light.
_ON_SLOPES = 10.0


def mean_and_flux(pixels: np.ndarray, rejected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean PSF [n_pixels], of unit sum, and the flux of each star [n_stars].

    The flux of a star is that of its good pixels over the mean PSF's sum there, as :func:`~.star_fluxes` has it. The
    mean depends on the fluxes in turn, so both are iterated.
    """
    if rejected.any():
        used = ~rejected
        used[:, rejected.all(axis=0)] = True  # a pixel that is bad in all stars has no better mean
        passes, count = _FLUX_PASSES, used.sum(axis=0)
    else:
        used, passes, count = None, 1, len(pixels)
    profile = median_star(pixels, used)
    noise = pixel_noise(pixels, used, profile)
    flux = star_fluxes(pixels, used, profile, noise)
    for i in range(passes + 1):
        unit = pixels / np.where(flux > 0.0, flux, np.inf)[:, None]
        mean = (unit if used is None else np.where(used, unit, 0.0)).sum(axis=0) / count
        if used is None:
            mean += (1.0 - mean.sum()) / len(mean)  # noise of all pixels, as in stars
        else:
            mean /= mean.sum()
        if i < passes:
            before, flux = flux, star_fluxes(pixels, used, mean, noise)
            if np.abs(flux - before).max() <= _CONVERGED * np.abs(flux).max():
                break
    if not np.all(flux > 0.0):
        raise DomainError(f"stamps[{(flux > 0.0).argmin()}] has no flux left outside its outliers")
    return mean, flux


def fill_masked(stars: np.ndarray, missing: np.ndarray, replaced: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Fill masked pixels of stars [n_stars, n_pixels] with the polynomial through the stars in which they are good.

    A filled pixel then has no influence on the interpolation over the CCD: with the hat matrix H of all stars, the
    values f of the stars b in which a pixel is masked lie on the polynomial of the others, g, if f = H_bb f + H_bg y.
    Each star counts by the inverse square of its own scatter about the mean: faint ones would fill the bright ones'.
    The polynomial is shrunk to a constant as far as the pixel is noise: that of few stars would enlarge it. Stars have
    unit sum before, with a first guess in the masked pixels, and after; pixels in `replaced` hold the mean of all stars
    instead. The polynomial terms at the stars [n_stars, n_terms] are linearly independent.
    """
    bad = missing[:, missing.any(axis=0)]
    weights = _inverse_scatter(stars, missing | replaced)
    signal, noise = _signal_and_noise(stars, missing, terms, weights)
    while True:
        predictors = _predictors(terms, bad, weights, (signal / noise)[missing.any(axis=0)])
        stars = _filled_by(predictors, stars, missing, replaced, weights)
        before, noise = noise, _signal_and_noise(stars, missing, terms, weights)[1]
        # Part of it was the first guess.
        if noise > _LESS_NOISE * before:
            return stars


def _filled_by(
    predictors: np.ndarray, stars: np.ndarray, missing: np.ndarray, replaced: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Return stars with masked pixels filled by factors [n_bad, n_stars] of the others; arguments as above.

    Filling changes the sum of a star, and so its flux and the mean, so all are iterated, as long as that converges:
    where half of the pixels are masked, what a star lacks may come back larger from those that it fills.
    """
    pixels = np.flatnonzero(missing.any(axis=0))
    bad, at_mean = missing[:, pixels], replaced[:, pixels]
    pixel, star = np.nonzero(bad.T)
    # Good pixels change with the flux of their star alone: the sum over stars is a product with the fluxes.
    clean = np.where(bad | at_mean, 0.0, stars[:, pixels])
    predictions_by_star = predictors * clean[:, pixel].T
    of_middle = 1.0 - predictors.sum(axis=1)
    beside_replaced = np.flatnonzero(np.asarray(at_mean.any(axis=0))[pixel])
    good_weights = np.where(bad, 0.0, weights[:, None])
    good_weights /= np.maximum(good_weights.sum(axis=0), np.finfo(float).tiny)
    scale, steadiest, least_change = np.ones(len(stars)), stars, np.inf
    for _ in range(_MOST_PASSES):
        filled, values = stars.copy(), stars[:, pixels]
        middle = (good_weights * values).sum(axis=0)
        # A star that the others do not determine gets their mean.
        predicted = of_middle * middle[pixel] + predictions_by_star @ scale
        if len(beside_replaced):
            means = np.where(at_mean, values, 0.0)[:, pixel[beside_replaced]].T
            predicted[beside_replaced] += (predictors[beside_replaced] * means).sum(axis=1)
        filled[star, pixels[pixel]] = predicted
        filled = np.where(replaced, filled.mean(axis=0), filled)
        flux = filled.sum(axis=1)
        filled /= flux[:, None]
        scale /= flux
        change = np.abs(filled - stars).max()
        stars = filled
        if change < least_change:
            steadiest, least_change = filled, change
        if change <= _CONVERGED * stars.max() or change > _DIVERGED * least_change:
            break
    return steadiest


def _inverse_scatter(stars: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return the inverse mean squares of the stars' deviations from their mean in bright, good pixels, [n_stars]."""
    mean = np.where(bad, 0.0, stars).sum(axis=0) / np.maximum((~bad).sum(axis=0), 1)
    light = np.where(bad, 0.0, np.maximum(mean, 0.0))
    light_sum = light.sum(axis=1)
    squares = (light * (stars - mean) ** 2).sum(axis=1) / np.where(light_sum > 0.0, light_sum, 1.0)
    middle = float(np.median(squares))
    return 1.0 / np.maximum(squares, _LEAST_SCATTER * middle) if middle > 0.0 else np.ones(len(stars))


def _signal_and_noise(
    stars: np.ndarray, missing: np.ndarray, terms: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the variance of the coefficients of each pixel's polynomial, [n_pixels], and that of the noise.

    Coefficients are those of orthonormal terms without the constant, of stars with weights. Their variance is in
    proportion to light, times what bright pixels show, and larger on slopes.
    """
    n_stars, n_terms = terms.shape
    if not 1 < n_terms < n_stars:
        return np.zeros(stars.shape[1]), 1.0
    root = np.sqrt(weights)[:, None]
    q, _ = np.linalg.qr(terms * root)
    squares = (q.T @ (root * stars)) ** 2
    noise = np.maximum(weights @ stars**2 - squares.sum(axis=0), 0.0) / (n_stars - n_terms)
    light = stars.mean(axis=0)
    light = np.maximum(light, _FAINTEST * light.max())
    signal = float(light @ (squares[1:].mean(axis=0) - noise) / (light**2).sum())
    # What masked pixels hold so far is no noise.
    clean = np.argsort(missing.sum(axis=0), kind="stable")[:_CLEAN_PIXELS]
    least = _LEAST_NOISE * float((squares[0] / n_stars).max())
    return _ON_SLOPES * max(signal, 0.0) * light, max(float(noise[clean].mean()), least)


def _predictors(terms: np.ndarray, bad: np.ndarray, weights: np.ndarray, signal_to_noise: np.ndarray) -> np.ndarray:
    """Return factors of the good stars in the prediction of each bad pixel, [n_bad, n_stars], pixel after pixel.

    `bad` is [n_stars, n_pixels] bool, `weights` [n_stars] those of the stars, `signal_to_noise` [n_pixels] those of
    :func:`_signal_and_noise`: faint pixels get the mean of the good stars. Pixels with as many bad stars are solved
    together.
    """
    root = np.sqrt(weights)
    q, _ = np.linalg.qr(terms * root[:, None])
    shrinkage = np.ones((bad.shape[1], q.shape[1]))
    shrinkage[:, 1:] = (1.0 / (1.0 + 1.0 / np.maximum(signal_to_noise, np.finfo(float).tiny)))[:, None]
    predictors = np.zeros((int(bad.sum()), len(bad)))
    count = bad.sum(axis=0)
    first = np.cumsum(count) - count
    order = np.argsort(~bad, axis=0, kind="stable")  # bad stars first
    for bad_count in np.unique(count[count > 0]):
        columns = np.flatnonzero(count == bad_count)
        bad_terms = q[order[:bad_count, columns].T]  # [n_columns, bad_count, n_terms]
        smoothed_terms = bad_terms * shrinkage[columns][:, None]
        room, axes = np.linalg.eigh(np.eye(bad_count) - smoothed_terms @ bad_terms.transpose(0, 2, 1))
        enlarged = axes * np.where(room > _LEAST_ROOM, 1.0 / np.maximum(room, _LEAST_ROOM), 0.0)[:, None]
        rows = first[columns][:, None] + np.arange(bad_count)
        scaled = enlarged @ (axes.transpose(0, 2, 1) @ (smoothed_terms @ q.T)) * root
        scaled /= root[order[:bad_count, columns].T][:, :, None]
        predictors[rows] = np.where(bad[:, columns].T[:, None, :], 0.0, scaled)
    return predictors
