r"""Pixels of the PSF over a CCD: how they follow its shape, and what they vary by besides.

The deviation of a star from the mean PSF is written as

.. math:: d_p = \sum_k B_{pk} s_k + r_p

with its three shape numbers s (:func:`~.kriging.shape_numbers`). The response B is the change of the mean PSF by
stretching and magnifying it, corrected as far as the stars show it. What is left, r, has no shape numbers and no flux.
Numbers and residuals are kriged apart: most pixels have no signal of their own, and what the shape needs to follow a
field would bring the noise of a few stars into them.

Corrections and residuals are Gaussian fields whose variance in a pixel is in proportion to its light or to the square
of that, times one factor; both have the largest evidence by all pixels (empirical Bayes); where the stars show none it
is zero, and a pixel is the mean of all stars, each with the inverse variance of its noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.errors import DomainError
from .covariance import PROCESS_COLUMNS, pair_distances, trend_variances
from .pixel_response import shape_response, without_noise
from .pixel_sums import log_powers_and_variances

# Shape numbers to which pixels respond as to a stretch and a magnification; they come first.
_SHAPE_NUMBERS = 3
# Variance of a pixel is that of a pixel with at least this fraction of the light of the brightest one.
_FAINTEST = 1e-4
# Powers of the light of a pixel that its variance may be in proportion to: that with the larger evidence is taken.
_POWERS = (1.0, 2.0)
# Least variance of the noise of a pixel over that of the noisiest: stars without sky noise have dark pixels without.
_LEAST_NOISE = 1e-6
# Factors of the variance of signal over that of noise, in the mean of all stars, of the pixel where it is largest:
# from what a thousand stars would not show to stars without noise.
_FACTORS = 4.0 ** np.arange(-8.0, 13.0)
# Logarithm of the odds from which on evidence counts: pixels count as independent, and the noise of two in three may
# be that of their neighbours.
_LEAST_EVIDENCE = 10.0
# Stars whose evidence is taken at most, the brightest: the axes cost the cube of their number.
_MOST_STARS = 300


@dataclass(frozen=True, eq=False)
class PixelFields:
    """Split of the pixels' deviations into what follows the shape numbers and residuals."""

    filters: np.ndarray  #: shape numbers of the pixels, [m, n_pixels]: three, and those under other weights
    response: np.ndarray  #: of the pixels to the shape numbers, [m, n_pixels]
    profile: np.ndarray  #: direction along which residuals are made to sum to zero, of unit sum, [n_pixels]
    variances: np.ndarray  #: of residuals, in units of the kernel of the shape numbers, [n_pixels]; 0 for a constant

    def rows(self) -> np.ndarray:
        """Return filters, response, profile and variances as rows of a file, [2 m + 2, n_pixels]."""
        return np.concatenate([self.filters, self.response, self.profile[None], self.variances[None]])

    @classmethod
    def of_rows(cls, rows: np.ndarray) -> PixelFields:
        """Return the fields in the rows of a file."""
        filters, response = np.split(rows[:-2], 2)
        return cls(filters, response, rows[-2], rows[-1])

    def split(self, deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return shape numbers [n, m] and residuals [n, n_pixels] of deviations [n, n_pixels]."""
        numbers = deviations @ self.filters.T
        return numbers, deviations - numbers @ self.response

    def shapeless(self, values: np.ndarray) -> np.ndarray:
        """Return images [n, n_pixels] without what they have of flux and shape numbers."""
        dark = values - values.sum(axis=1, keepdims=True) * self.profile
        return np.asarray(dark - (dark @ self.filters.T) @ self.response)


@dataclass(frozen=True, eq=False)
class SignalCovariance:
    """Covariance of stars by a kernel, without noise and without the constant, which is unknown."""

    terms: np.ndarray  #: of the trend, [n, n_terms]
    trend_variances: np.ndarray  #: of these terms, 0 for the constant, [n_terms]
    covariance: np.ndarray  #: [n, n]

    @classmethod
    def of(cls, kernel: np.ndarray, points: np.ndarray, terms: np.ndarray, colour_count: int = 0) -> SignalCovariance:
        """Return it for a kernel (:data:`~.covariance.COLUMNS`), points [n, 2] and terms [n, n_terms].

        The last `colour_count` terms are those of the colours of the stars.
        """
        variance, length, _ = kernel[:PROCESS_COLUMNS]
        count = terms.shape[1]
        variances = np.where(np.arange(count) == 0, 0.0, trend_variances(kernel, count, colour_count))
        covariance = variance * np.exp(-pair_distances(points, points) / length) + (terms * variances) @ terms.T
        return cls(terms, variances, covariance)

    def of_stars(self, chosen: np.ndarray) -> SignalCovariance:
        """Return that of some of the stars."""
        return SignalCovariance(self.terms[chosen], self.trend_variances, self.covariance[np.ix_(chosen, chosen)])


@dataclass(frozen=True, eq=False)
class Contrasts:
    """Axes of a covariance of stars, in units of their noise and without the constant, and the variances along them."""

    axes: np.ndarray  #: [n, n - 1]: values of stars times these have unit noise, and are zero for a constant
    variances: np.ndarray  #: [n - 1]

    @classmethod
    def of(cls, covariance: np.ndarray, noise: np.ndarray) -> Contrasts:
        """Return them for a covariance of the signal [n, n] and variances of the noise [n]."""
        root = np.sqrt(noise)
        without_constant = np.linalg.qr((1.0 / root)[:, None], mode="complete")[0][:, 1:] / root[:, None]
        variances, rotation = np.linalg.eigh(without_constant.T @ covariance @ without_constant)
        return cls(without_constant @ rotation, np.maximum(variances, 0.0))

    def dual(self, values: np.ndarray, scales: np.ndarray) -> np.ndarray:
        """Return the weights of the best predictions of values [n, k] for covariances scaled by `scales` [k], [n, k].

        The prediction is the scaled covariance with the stars times these, plus the constant.
        """
        shrinkage = 1.0 / (1.0 + scales * self.variances[:, None])
        return np.asarray(self.axes @ (shrinkage * (self.axes.T @ values)))

    def precision(self, scales: np.ndarray) -> np.ndarray:
        """Return the diagonals of the matrices of :meth:`dual`, [n, k]."""
        return np.asarray(self.axes**2 @ (1.0 / (1.0 + scales * self.variances[:, None])))

    def differences(self, values: np.ndarray, scales: np.ndarray) -> np.ndarray:
        """Return values [n, k] less their prediction by the other stars, [n, k] (Dubrule 1983)."""
        return self.dual(values, scales) / self.precision(scales)

    def scale_of(self, values: np.ndarray, relative: np.ndarray, unit: np.ndarray) -> tuple[float, float]:
        """Return the factor of variances of values [n, k] that has the largest evidence, and that over that of none.

        The variances `relative` [k] are 1 at most; all are in units of variances [k]. The variance of the noise of
        each column is unknown. Zeros where no factor has the evidence that counts.
        """
        mean_variance = float(self.variances.mean()) if len(self.variances) else 0.0
        if not mean_variance > 0.0:
            return 0.0, 0.0
        squares = (self.axes.T @ values) ** 2 / unit
        factors = np.concatenate([[0.0], _FACTORS])
        log_powers, log_variances = log_powers_and_variances(squares, self.variances / mean_variance, relative, factors)
        evidence = -0.5 * (log_variances + len(squares) * log_powers)
        best = int(np.argmax(evidence))
        gain = float(evidence[best] - evidence[0])
        return (float(factors[best]) / mean_variance, gain) if gain > _LEAST_EVIDENCE else (0.0, 0.0)


def fit_pixel_fields(
    mean: np.ndarray,
    deviations: np.ndarray,
    filters: np.ndarray,
    noise: np.ndarray,
    pixel_noise: np.ndarray,
    shapes: np.ndarray,
    signal: SignalCovariance,
) -> PixelFields:
    """Return the split that the stars of a CCD show.

    Parameters
    ----------
    mean, deviations, filters : array
        Mean PSF [ny, nx] of unit sum, the stars' deviations from it [n, n_pixels], and the filters of their shape
        numbers [m, n_pixels].
    noise : array
        Variance of each star's noise, in units of the middle star's, [n].
    pixel_noise : array
        Variance of the noise of the middle star's pixels, [n_pixels].
    shapes : array
        Shape numbers of the model at the stars, [n, m].
    signal : SignalCovariance
        Of the shape numbers of the stars.
    """
    weights = 1.0 / noise
    star = mean + (weights @ deviations / weights.sum()).reshape(mean.shape)
    noise_floor = np.maximum(pixel_noise, max(_LEAST_NOISE * pixel_noise.max(), np.finfo(float).tiny))
    light = without_noise(star, (noise_floor / weights.sum()).reshape(star.shape))
    bright = np.maximum(light / light.max(), _FAINTEST).ravel()
    shares = [bright**power / noise_floor for power in _POWERS]
    shares = [share / share.max() for share in shares]
    response = shape_response(light)
    shape, further = filters[:_SHAPE_NUMBERS], filters[_SHAPE_NUMBERS:]
    try:
        # What the further filters see beside the shape is as broad as they are.
        beside_shape = (further - (np.linalg.solve(response @ shape.T, response @ further.T)).T @ shape) * noise_floor
        beside_shape -= beside_shape.sum(axis=1, keepdims=True) * star.ravel()
        response = np.concatenate([response, beside_shape])
        response = np.linalg.solve(response @ filters.T, response)
    except np.linalg.LinAlgError:
        raise DomainError("stamps: expected stars; these have no light, or the same in all pixels") from None
    fields = PixelFields(filters, response, star.ravel(), np.zeros(star.size))
    brightest = np.sort(np.argsort(noise, kind="stable")[:_MOST_STARS])

    def contrasts_of(covariance: np.ndarray) -> Contrasts:
        """Return the contrasts of the brightest stars."""
        return Contrasts.of(covariance[np.ix_(brightest, brightest)], noise[brightest])

    def variances_of(residuals: np.ndarray, contrasts: Contrasts, largest: float) -> np.ndarray:
        """Return the variances that residuals show; in no pixel are they more than `largest` [pixel units squared]."""
        chosen = residuals if len(brightest) == len(residuals) else residuals[brightest]
        scales = [contrasts.scale_of(chosen, share, noise_floor) for share in shares]
        best = int(np.argmax([evidence for _, evidence in scales]))
        share, scale = shares[best], scales[best][0]
        with np.errstate(over="ignore"):  # stars without any noise have no limit
            return share * min(scale, largest / float((share * noise_floor).max()))

    residuals = fields.split(deviations)[1]
    shapes = shapes[:, :_SHAPE_NUMBERS]
    shape_covariance = shapes @ shapes.T
    contrasts = contrasts_of(shape_covariance)
    # Shape numbers of smooth fields may lie near a line, across which stars show nothing: no correction is larger than
    # the response itself.
    most = float((response[:_SHAPE_NUMBERS] ** 2).max())
    variances = variances_of(residuals, contrasts, most)
    if variances.any():
        if len(brightest) < len(noise):
            contrasts = Contrasts.of(shape_covariance, noise)
        response[:_SHAPE_NUMBERS] += fields.shapeless(variances * (shapes.T @ contrasts.dual(residuals, variances)))
        fields = PixelFields(filters, response, star.ravel(), fields.variances)
        residuals = fields.split(deviations)[1]
    variances = variances_of(residuals, contrasts_of(signal.covariance), np.inf)
    return PixelFields(filters, fields.response, fields.profile, variances)


def krige_residuals(
    residuals: np.ndarray, fields: PixelFields, signal: SignalCovariance, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return trend [n_terms, n_pixels] and dual coefficients [n, n_pixels] of residuals [n, n_pixels].

    Both are those of :func:`~.covariance.krige_mean`; `noise` [n] is in units of the middle star's.
    """
    weights, dual = 1.0 / noise, np.zeros(residuals.shape)
    if fields.variances.any():
        dual = Contrasts.of(signal.covariance, noise).dual(residuals, fields.variances)
        dual = fields.shapeless(fields.variances * dual)
    trend = signal.trend_variances[:, None] * (signal.terms.T @ dual)
    trend[0] = fields.shapeless((weights @ (residuals - signal.covariance @ dual) / weights.sum())[None])[0]
    return trend, dual


def residuals_left_out(
    residuals: np.ndarray, fields: PixelFields, signal: SignalCovariance, noise: np.ndarray
) -> np.ndarray:
    """Return residuals [n, n_pixels] less their prediction by the other stars (Dubrule 1983)."""
    contrasts = Contrasts.of(signal.covariance, noise)
    return fields.shapeless(contrasts.differences(residuals, fields.variances))
