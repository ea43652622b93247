"""Masked and rejected pixels of stars, filled from the other pixels and the other stars."""

from __future__ import annotations

import numpy as np

from ...core.errors import DomainError
from ...measure.star_flux import median_star, pixel_noise, star_fluxes

# Passes end when no pixel, or flux, changes by more than this fraction of the greatest.
_CONVERGED = 1e-12
_MOST_PASSES = 100
# Passes of means and fluxes where pixels are rejected.
_FLUX_PASSES = 20
# Stars in which a pixel is masked are predicted only along the directions that the others determine: an eigenvalue of
# 1 - H under this would enlarge noise by more than seven.
_LEAST_ROOM = 0.02
# Least mean square of a star's scatter over that of the middle star: a star that counted alone would have no room.
_LEAST_SCATTER = 0.25


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
    Filling changes the sum of a star, and so its flux and the mean, so all are iterated. Stars have unit sum before,
    with a first guess in the masked pixels, and after; pixels in `replaced` hold the mean of all stars instead. The
    polynomial terms at the stars [n_stars, n_terms] are linearly independent.
    """
    pixels = np.flatnonzero(missing.any(axis=0))
    bad, at_mean = missing[:, pixels], replaced[:, pixels]
    pixel, star = np.nonzero(bad.T)
    weights = _inverse_scatter(stars, missing | replaced)
    predictors = _predictors(terms, bad, weights)
    # Good pixels change with the flux of their star alone: the sum over stars is a product with the fluxes.
    clean = np.where(bad | at_mean, 0.0, stars[:, pixels])
    predictions_by_star = predictors * clean[:, pixel].T
    of_middle = 1.0 - predictors.sum(axis=1)
    beside_replaced = np.flatnonzero(np.asarray(at_mean.any(axis=0))[pixel])
    good_weights = np.where(bad, 0.0, weights[:, None])
    good_weights /= np.maximum(good_weights.sum(axis=0), np.finfo(float).tiny)
    scale = np.ones(len(stars))
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
        if change <= _CONVERGED * stars.max():
            break
    return stars


def _inverse_scatter(stars: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return the inverse mean squares of the stars' deviations from their mean in bright, good pixels, [n_stars]."""
    mean = np.where(bad, 0.0, stars).sum(axis=0) / np.maximum((~bad).sum(axis=0), 1)
    light = np.where(bad, 0.0, np.maximum(mean, 0.0))
    light_sum = light.sum(axis=1)
    squares = (light * (stars - mean) ** 2).sum(axis=1) / np.where(light_sum > 0.0, light_sum, 1.0)
    middle = float(np.median(squares))
    return 1.0 / np.maximum(squares, _LEAST_SCATTER * middle) if middle > 0.0 else np.ones(len(stars))


def _predictors(terms: np.ndarray, bad: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return factors of the good stars in the prediction of each bad pixel, [n_bad, n_stars], pixel after pixel.

    `bad` is [n_stars, n_pixels] bool, `weights` [n_stars] those of the stars. Pixels with as many bad stars are solved
    together.
    """
    root = np.sqrt(weights)
    q, _ = np.linalg.qr(terms * root[:, None])
    predictors = np.zeros((int(bad.sum()), len(bad)))
    count = bad.sum(axis=0)
    first = np.cumsum(count) - count
    order = np.argsort(~bad, axis=0, kind="stable")  # bad stars first
    for bad_count in np.unique(count[count > 0]):
        columns = np.flatnonzero(count == bad_count)
        bad_terms = q[order[:bad_count, columns].T]  # [n_columns, bad_count, n_terms]
        room = np.linalg.pinv(
            np.eye(bad_count) - bad_terms @ bad_terms.transpose(0, 2, 1), rcond=_LEAST_ROOM, hermitian=True
        )
        rows = first[columns][:, None] + np.arange(bad_count)
        scaled = room @ (bad_terms @ q.T) * root / root[order[:bad_count, columns].T][:, :, None]
        predictors[rows] = np.where(bad[:, columns].T[:, None, :], 0.0, scaled)
    return predictors
