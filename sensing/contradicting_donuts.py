"""Donuts that the others of an exposure contradict: a second star, a mirrored stamp or a search that went wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .hierarchy import Basis, ExposureAir, Hierarchy, Observations, chi2_by_the_others, fit_hierarchy

#: Fewest stars of which one may contradict the others, and the largest part of all donuts that may. Of 5 donuts, one of
#: which is off by 1.5 um, half are found, of 8 all; of 885 in air of up to 300 nm none was left out for nothing.
_FEWEST = 5
_MOST = 0.25
#: Chi-square of a donut about what the others say, over that of a typical one, from which on it may be one of these.
_FAR = 2.0
#: Chi-square a term with which it is one, by a fit of the others.
_CONTRADICTED = 9.0
#: Error of a wavefront that says nothing [m].
_UNKNOWN = 30e-6


@dataclass(frozen=True)
class Consistent:
    """Wavefronts of telescope and air by donuts that do not contradict each other.

    Attributes
    ----------
    hierarchy : Hierarchy
        The wavefronts, at all donuts.
    left_out : ndarray of bool, shape [n]
        Donuts that say nothing of them.
    """

    hierarchy: Hierarchy
    left_out: np.ndarray


def fit_consistently(observations: Observations, basis: Basis, air: ExposureAir) -> Consistent:
    """Return :func:`fit_hierarchy` of all donuts but those that the others contradict; arguments are the same."""
    left_out = np.zeros(len(observations.zernikes), dtype=bool)
    hierarchy = fit_hierarchy(observations, basis, air)
    while (suspect := _farthest(without(observations, left_out), basis, air, left_out)).any():
        trial = fit_hierarchy(without(observations, left_out | suspect), basis, air)
        if _chi2(trial, observations, air, suspect) < _CONTRADICTED:
            break
        hierarchy, left_out = trial, left_out | suspect
    return Consistent(hierarchy, left_out)


def _farthest(observations: Observations, basis: Basis, air: ExposureAir, left_out: np.ndarray) -> np.ndarray:
    """Return the donuts of the star that is farthest from what the others say, if far more so than these, [n] bool."""
    stars = np.unique(observations.star[~left_out])
    if len(stars) < _FEWEST or left_out.sum() + 1 > _MOST * len(left_out):
        return np.zeros_like(left_out)
    chi2 = np.where(left_out, 0.0, chi2_by_the_others(observations, basis, air))
    far = chi2.max() > _FAR * np.median(chi2[~left_out])
    return far & ~left_out & (observations.star == observations.star[chi2.argmax()])


def without(observations: Observations, left_out: np.ndarray) -> Observations:
    """Return the observations with some that say nothing."""
    nothing = _UNKNOWN**2 * np.eye(observations.zernikes.shape[1])
    covariance = observations.covariance + left_out[:, None, None] * nothing
    return replace(observations, covariance=covariance)


def _chi2(hierarchy: Hierarchy, observations: Observations, air: ExposureAir, donuts: np.ndarray) -> float:
    """Return the mean chi-square a term of donuts about what the others say of them."""
    sizes = hierarchy.sizes
    difference = (observations.zernikes - hierarchy.telescope)[donuts]
    expected = hierarchy.telescope_covariance[donuts] + sizes.noise * observations.covariance[donuts]
    expected = expected + (sizes.air**2 + sizes.local**2) * air.shape
    return float(np.mean(difference * np.linalg.solve(expected, difference[..., None])[..., 0]))
