r"""Patterns of residuals that a field makes, in independent combinations, and its strength by their amplitudes.

Amplitudes have the variance of noise and of other fields, and :math:`\theta w` of this one. Air has most in the few of
large w. What has as much in all of them, a rim elsewhere for example, is taken for noise of a larger variance, a level,
in the unknowns too. The strength is the mean by its likelihood and a wide prior: of few amplitudes the likeliest one is
often none, and then nothing of air where there is some.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.special import logsumexp

#: Rms of the wavefront of air of unit strength, Z4 to Z22 together [m].
AIR_UNIT = 1e-7
#: Logarithms of the rms of the field at which its likelihood is computed, in units of itself: 3 nm to 1 um of air.
RMS_LOGARITHMS = np.linspace(math.log(0.03), math.log(10.0), 30)
#: Logarithm of the rms about which its prior lies, that of air in 15 s under median seeing, and its standard deviation.
_USUAL = math.log(1.1)
_WIDE = 1.0
#: Probability beforehand that there is next to none: images of telescopes in space, or made without air.
_NONE = 0.2
#: Parts of the power that telescopes are expected to have in further terms: of well figured ones there is next to none.
_PARTS = (0.0, 0.2, 1.0)
#: Loss of the logarithm of the likelihood by a level that is fitted.
_WORTH = 2.0
#: Levels that are tried.
_LEVELS = 9
#: Variance of a combination of patterns over the largest one below which it says nothing.
_FAINTEST = 1e-6


class PatternSizes(NamedTuple):
    """Strength of a field, surplus of the variance in all combinations alike, and losses of the rms of the field."""

    strength: float
    level: float
    losses: np.ndarray


@dataclass(frozen=True)
class Patterns:
    """Patterns of residuals that no unknown makes, in independent combinations.

    Attributes
    ----------
    columns : ndarray, shape [n_pixel, m]
        The combinations.
    amplitudes : ndarray, shape [m]
        Their amplitudes in the residuals, of unit variance by noise.
    variances : ndarray, shape [m]
        Further variances of these by a field of unit strength.
    """

    columns: np.ndarray
    amplitudes: np.ndarray
    variances: np.ndarray

    @classmethod
    def of(cls, patterns: np.ndarray, columns: np.ndarray, pulls: np.ndarray) -> Patterns:
        """Return what patterns [n_pixel, m] have beside the columns of the unknowns, and their amplitudes in pulls."""
        beside = patterns - columns @ (columns.T @ patterns)
        variances, vectors = np.linalg.eigh((patterns.T @ beside).astype(np.float64))
        shown = variances > _FAINTEST * variances[-1]
        vectors = vectors[:, shown] / np.sqrt(variances[shown])
        amplitudes = vectors.T @ (patterns.T @ pulls)
        return cls(beside @ vectors.astype(np.float32), amplitudes, variances[shown])

    def power_of(self, patterns: np.ndarray) -> np.ndarray:
        """Return the covariance of the amplitudes by a field of patterns [n_pixel, k], shape [m, m]."""
        amplitudes = self.columns.T @ patterns
        return np.asarray(amplitudes @ amplitudes.T, dtype=np.float64)

    def sizes(self, others: np.ndarray, expected: np.ndarray) -> PatternSizes:
        """Return the strength of the field, the surplus of the variance in all combinations alike, and losses.

        Strength and surplus are means over all rms of the field, without a level and with the best one, for all of what
        is expected: one donut hardly tells less of it from air. Losses, which several tell together, are over parts of
        it, too: twice the negative logarithm of the likelihood at :data:`RMS_LOGARITHMS`.

        Parameters
        ----------
        others : ndarray, shape [m, m]
            Power of other fields in the amplitudes.
        expected : ndarray, shape [m, m]
            The same of what a telescope is expected to have, or less.
        """
        strengths = np.exp(2.0 * RMS_LOGARITHMS)
        if not len(self.variances):
            return PatternSizes(0.0, 0.0, np.zeros(len(strengths)))
        trials = [self._losses(others + share * expected) for share in _PARTS]
        of_all, surplus = trials[-1]
        prior = np.exp(-0.5 * ((RMS_LOGARITHMS - _USUAL) / _WIDE) ** 2)
        prior[0] += _NONE / (1.0 - _NONE) * prior.sum()
        posterior = prior * np.exp(of_all.min() - of_all)
        posterior /= posterior.sum()
        losses = -2.0 * logsumexp([-of_trial for of_trial, _ in trials], axis=(0, 1))
        return PatternSizes(float((posterior * strengths).sum()), float((posterior * surplus).sum()), losses)

    def _losses(self, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return losses without and with a level by the rms of the field, and the level, each [2, n_rms]."""
        count, strengths = len(self.variances), np.exp(2.0 * RMS_LOGARITHMS)
        base = np.eye(count) + power
        variances, vectors = eigh(np.diag(self.variances), base)
        energies = (vectors.T @ self.amplitudes) ** 2
        # Up to beyond the logarithm of their mean square, where the field lowers the level.
        levels = np.exp(np.linspace(0.0, math.log(max(float(energies.mean()), 1.0)) + 1.0, _LEVELS))
        of_field = strengths[:, None] * variances
        total = levels[:, None, None] + of_field
        losses = 0.5 * ((np.log(total) + energies / total).sum(axis=2) + np.linalg.slogdet(base)[1])
        # What lies far out is part of the level.
        surplus = np.maximum((energies - of_field).mean(axis=1) - 1.0, 0.0)
        return np.stack([losses[0], losses[1:].min(axis=0) + _WORTH]), np.stack([np.zeros(len(strengths)), surplus])
