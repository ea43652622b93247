"""Kinds of PSF models among which the stars of an image choose, by how well each predicts stars that were held out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ...core.errors import ConfigError, DomainError
from ..psf_model.pixels import Pixels
from ..psf_model.polynomial_fit import Polynomial
from ..psf_model.principal_components import PrincipalComponents
from ..psf_model.recipe import Recipe
from ..psf_model.shape_noise import ShapeNoise

#: Options of :meth:`~.PsfModel.fit` by name, the one that is preferred first: the default recipe, which needs no choice
#: and nearly always is the best (docs/psf_models.md).
CANDIDATES: dict[str, dict[str, Any]] = {
    "kriging of pixels": {},
    **{f"pixels, order {n}": {"recipe": Recipe(Pixels(), Polynomial(n), "noise")} for n in range(3)},
    "principal components": {"recipe": Recipe(PrincipalComponents("auto"), Polynomial("auto"))},
}
# Standard errors by which another kind must be better. With one, chance alone would choose a worse one too often.
_ERRORS = 2.0


def choose_candidate(
    predict: Callable[[Mapping[str, Any]], np.ndarray],
    stars: np.ndarray,
    gain: float,
    masked: np.ndarray | None = None,
) -> tuple[str, np.ndarray]:
    """Return the name of the kind of model that predicts held-out stars best, and what it predicts.

    The preferred kind stays unless another has smaller squares of residuals of the shape numbers, weighted by what each
    star can tell, by two standard errors of the difference.

    Parameters
    ----------
    predict : callable
        From options of a model to its predictions of each star by others, [n, ny, nx]. It may raise ConfigError or
        DomainError for kinds that the stars do not determine.
    stars : array
        [n, ny, nx], in units of `gain` electrons.
    masked : array, optional
        Pixels without weight, bool [n, ny, nx]; they hold what they are filled with.
    """
    kinds = iter(CANDIDATES.items())
    best_name, options = next(kinds)
    best = predict(options)
    unit = (stars / stars.sum(axis=(1, 2), keepdims=True)).reshape(len(stars), -1)
    mean = best.mean(axis=0)
    shapes = ShapeNoise.of(stars, unit - mean.ravel(), mean, gain, masked)

    def residuals(predicted: np.ndarray) -> np.ndarray:
        deviations = unit - predicted.reshape(len(stars), -1)
        if masked is not None:
            deviations = np.where(masked.reshape(len(stars), -1), 0.0, deviations)
        return deviations @ shapes.filters.T

    reference = residuals(best)
    weight = (shapes.model_variance(reference) + shapes.noise) ** -2
    least = 0.0
    for name, options in kinds:
        try:
            predicted = predict(options)
        except (ConfigError, DomainError):  # too few stars for its terms
            continue
        excess = weight * (residuals(predicted) ** 2 - reference**2).mean(axis=1)
        if excess.sum() < min(least, -_ERRORS * np.sqrt(len(excess)) * excess.std(ddof=1)):
            best_name, best, least = name, predicted, excess.sum()
    return best_name, best
