"""Shape numbers of the stars with their noise, and the variance that a model leaves of them.

Stars differ in S/N by a factor of a hundred, and most pixels have no signal: residuals of all pixels of all stars are
the noise of the faint ones, whatever the model is. So models are compared by three shape numbers
(:func:`~.kriging.shape_numbers`) of each star. The square of a residual has the variance 2 (v + N)^2 where v is the
variance that the model leaves and N the noise of the star, so it counts with the inverse of that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import kriging

# Passes after which the variance that a model leaves changes no more than matters.
_PASSES = 20
# ... and those of the weights.
_WEIGHT_PASSES = 4
# Least variance that a model leaves, over the noise of the middle star.
_LEAST = 1e-3
# Least part of a star's residual that is its own in a fit to all stars.
_LEAST_ROOM = 0.1


@dataclass(frozen=True, eq=False)
class ShapeNoise:
    """Filters of three shape numbers, in units of the noise of the middle star, and the noise of each star."""

    filters: np.ndarray  #: [3, n_pixels]
    noise: np.ndarray  #: variance of a number, mean of the three, [n]

    @classmethod
    def of(
        cls,
        electrons: np.ndarray | None,
        deviations: np.ndarray,
        mean: np.ndarray,
        masked: np.ndarray | None = None,
    ) -> ShapeNoise:
        """Return it for stars of `electrons` [n], as :func:`~.kriging.star_noise` has them."""
        _, filters = kriging.shape_numbers(mean, deviations)
        noise = kriging.star_noise(electrons, deviations, mean, filters, masked)
        unit = np.maximum(np.median(noise, axis=0), np.finfo(float).tiny)
        return cls(filters / np.sqrt(unit)[:, None], np.maximum((noise / unit).mean(axis=1), _LEAST))

    def of_stars(self, chosen: np.ndarray) -> ShapeNoise:
        """Return it for some of the stars."""
        return ShapeNoise(self.filters, self.noise[chosen])

    def model_variance(self, residuals: np.ndarray) -> float:
        """Return the variance of residuals [n, 3] beyond the noise of the stars."""
        variance, squares = 1.0, (residuals**2).mean(axis=1)
        for _ in range(_PASSES):
            weight = (variance + self.noise) ** -2
            variance = max(float(weight @ (squares - self.noise) / weight.sum()), _LEAST)
        return variance

    def star_weights(self, deviations: np.ndarray, terms: np.ndarray) -> np.ndarray:
        """Return weights of stars in polynomials with these terms, [n], 1 in the mean.

        They are the inverse of the star's noise and of the variance that polynomials leave of the stars, each left out,
        which depends on the weights in turn.
        """
        numbers = deviations @ self.filters.T
        weights = 1.0 / self.noise
        for _ in range(_WEIGHT_PASSES):
            root = np.sqrt(weights)[:, None]
            q, _ = np.linalg.qr(terms * root)
            residuals = numbers - q @ (q.T @ (root * numbers)) / root
            room = np.maximum(1.0 - (q**2).sum(axis=1), _LEAST_ROOM)
            weights = 1.0 / (self.noise + self.model_variance(residuals / room[:, None]))
        return weights / weights.mean()
