"""Covariances of the shapes of stars without optics, and the stars that do not contradict them."""

from __future__ import annotations

import numpy as np

from .field import ShapeField
from .fit import ShapeData
from .kriging import map_on_threads
from .likelihood import CovarianceFit, fit_covariance
from .mosaic import Mosaic

#: Fewest stars of a fit.
LEAST_STARS = 30
# Typical deviations beyond which a star is none. Optics alone make 6 to 12 at the rims of bent CCDs out of focus.
_CLIP_SIGMA = 15.0
# Part of the stars that are kept at least, whatever the others say.
_LEAST_PART = 0.7


def fit_statistics(
    mosaic: Mosaic, data: ShapeData, steps: int, threads: int | None
) -> tuple[list[CovarianceFit], np.ndarray]:
    """Fit covariances of the shapes of stars, without optics, and return the stars that do not contradict them [n].

    A galaxy scatters tenfold as much as a star, and would be taken for scatter of all stars.
    """
    consistent = np.ones(len(data), dtype=bool)
    while True:
        stars = data.chosen(consistent)

        def of_shape(shape: int, stars: ShapeData = stars) -> CovarianceFit:
            values, noise = stars.values[:, shape], stars.noise[:, shape]
            return fit_covariance(stars.places, values, noise, with_ccds=True, max_iterations=steps)

        fits: list[CovarianceFit] = map_on_threads(of_shape, range(3), threads)
        field = ShapeField(mosaic, stars, stars.values, tuple(f.covariance for f in fits))
        good = field.inliers(threads, sigma=_CLIP_SIGMA, least=0.0)
        if good.all() or good.sum() < max(LEAST_STARS, _LEAST_PART * len(data)):
            break
        consistent[np.flatnonzero(consistent)[~good]] = False
    left_out = np.flatnonzero(~consistent)
    if len(left_out):
        # Neighbours of galaxies seemed to be wrong, too.
        consistent[left_out] = field.agrees_with(data.chosen(left_out), threads)
    return fits, consistent
