"""Donuts whose light does not tell their wavefronts: faint ones, and those of pupils that are dark but for a part."""

from __future__ import annotations

import numpy as np

from .solve import Solution
from .star_fitter import Start
from .terms import WavefrontTerms

#: Signal over noise, over the root of the number of Zernikes, below which these are often those of the noise, in no
#: seeing at all: Z4 to Z22 of random donuts were wrong by what is claimed from 40 on, and by 3 to 30 times as much
#: below 25.
_TELLING = 9.0
#: Part of that below which a fit is of no donut: those left when stars in focus are clipped have a quarter.
_HIDDEN = 0.4
#: Root mean square of the errors of the Zernikes asked for [m] above which they are not determined. The LSST's are
#: where less than 0.45 of its pupil is lit: 5 to 50 um together, with which images no longer change in proportion.
_UNDETERMINED = 1e-6
#: The same by photons, of a search in coarse pixels, which tell less.
_HOPELESS = 3e-6


def is_faint(start: Start, n_term: int) -> bool:
    """Return whether noise hides what so many Zernikes do to a donut."""
    return start.match.significance < _TELLING * n_term**0.5


def is_hidden(significance: float, n_term: int) -> bool:
    """Return whether the light of a fit stands out from the noise by far too little for so many unknowns."""
    return significance < _HIDDEN * _TELLING * n_term**0.5


def is_undetermined(covariance: np.ndarray) -> bool:
    """Return whether Zernikes are undetermined by the covariance of their errors [m^2], shape [n, n]."""
    return _mean_variance(covariance) > _UNDETERMINED**2


def is_hopeless(terms: WavefrontTerms, solution: Solution) -> bool:
    """Return whether photons leave the Zernikes asked for far from determined, by a solution in coarse pixels."""
    count = min(len(terms.requested), len(solution.shared))
    return _mean_variance(solution.shared_covariance[:count, :count]) > _HOPELESS**2


def _mean_variance(covariance: np.ndarray) -> float:
    return float(np.mean(np.diag(covariance))) if len(covariance) else 0.0
