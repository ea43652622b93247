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
_NONE = 0.4
#: Rms of the telescope's further terms over what is expected: of well figured ones there is next to nothing.
_FIGURES = np.geomspace(0.1, 5.0, 8)
#: Standard deviation of the logarithm of that ratio.
_FIGURES_WIDE = 1.0
#: Probability beforehand of the least one.
_WELL_FIGURED = 0.1
#: Loss of the logarithm of the likelihood from which on nothing is said of larger ones.
_HOPELESS = 20.0
#: Least variance by noise of an amplitude that fitted terms take up, over that by noise alone: derivatives are as good.
_LEAST_NOISE = 5e-3
#: Part of the largest power that is rounding, in single precision.
_ROUNDING = 1e-6
#: Loss of the logarithm of the likelihood by a level that is fitted.
_WORTH = 2.0
#: The same without air: a cheap level would take what the telescope has of large terms, and claims would be too small.
_WORTH_AIRLESS = 8.0
#: Levels that are tried.
_LEVELS = 9
#: Variance of a combination of patterns over the largest one below which it says nothing.
_FAINTEST = 1e-6


class PatternSizes(NamedTuple):
    """Strength of a field, that of the telescope's, surplus of the variance in all alike, and losses of both rms."""

    strength: float
    figure: float
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

    def sizes(
        self, others: np.ndarray, telescope: np.ndarray, fitted: np.ndarray, absent: bool = False
    ) -> PatternSizes:
        """Return the strengths of the field and of the telescope's, the surplus of the variance in all, and losses.

        They are means over all rms of both fields, without a level and with the best one. Losses, which several donuts
        tell together, are twice the negative logarithm of the likelihood, by the telescope's rms and at
        :data:`RMS_LOGARITHMS`.

        Parameters
        ----------
        others : ndarray, shape [m, m]
            Power of other fields in the amplitudes.
        telescope : ndarray, shape [m, m]
            The same of what telescopes are expected to have.
        fitted : ndarray, shape [m, m]
            What the priors of fitted terms among it have of the unit variance of the amplitudes.
        absent : bool
            Whether there is none of the field, as without air.
        """
        strengths = np.exp(2.0 * RMS_LOGARITHMS)
        if not len(self.variances):
            return PatternSizes(0.0, 1.0, 0.0, np.zeros((1, len(strengths))))
        values, vectors = np.linalg.eigh(np.eye(len(fitted)) - fitted)
        noise = others + vectors * np.maximum(values, _LEAST_NOISE) @ vectors.T
        figures = _FIGURES if telescope.any() else np.ones(1)
        losses = np.full((len(figures), 2, len(strengths)), np.inf)
        surplus = np.zeros_like(losses)
        # The least rms is next to none.
        sizes = slice(1 if absent else None)
        for k, size in enumerate(figures):
            losses[k], surplus[k] = self._losses(noise + size**2 * telescope, _WORTH_AIRLESS if absent else _WORTH)
            if losses[k, :, sizes].min() > losses[..., sizes].min() + _HOPELESS:
                break
        of_rms, allowed = _prior((RMS_LOGARITHMS - _USUAL) / _WIDE, _NONE)[sizes], losses[..., sizes]
        posterior = _figure_prior(len(figures))[:, None, None] * of_rms * np.exp(allowed.min() - allowed)
        posterior /= posterior.sum()
        return PatternSizes(
            0.0 if absent else float((posterior * strengths).sum()),
            float((posterior.sum(axis=(1, 2)) * figures**2).sum()),
            float((posterior * surplus[..., sizes]).sum()),
            -2.0 * logsumexp(-losses, axis=1),
        )

    def _losses(self, base: np.ndarray, worth: float) -> tuple[np.ndarray, np.ndarray]:
        """Return losses without and with a level by the rms of the field, and the level, each [2, n_rms].

        ``base`` is the covariance of the amplitudes without the field, ``worth`` the loss by a level.
        """
        strengths = np.exp(2.0 * RMS_LOGARITHMS)
        try:
            variances, vectors = eigh(np.diag(self.variances), base)
        except np.linalg.LinAlgError:
            # What the telescope has outweighs the noise of very bright images by more than the digits of its power.
            base = base + _ROUNDING * np.diag(base).max() * np.eye(len(base))
            variances, vectors = eigh(np.diag(self.variances), base)
        energies = (vectors.T @ self.amplitudes) ** 2
        # Up to beyond the logarithm of their mean square, where the field lowers the level.
        levels = np.exp(np.linspace(0.0, math.log(max(float(energies.mean()), 1.0)) + 1.0, _LEVELS))
        of_field = strengths[:, None] * variances
        total = levels[:, None, None] + of_field
        losses = 0.5 * ((np.log(total) + energies / total).sum(axis=2) + np.linalg.slogdet(base)[1])
        # What lies far out is part of the level.
        surplus = np.maximum((energies - of_field).mean(axis=1) - 1.0, 0.0)
        return np.stack([losses[0], losses[1:].min(axis=0) + worth]), np.stack([np.zeros(len(strengths)), surplus])


def losses_of_field(losses: np.ndarray) -> np.ndarray:
    """Return losses by the rms of the field alone, [n_rms], of those by the telescope's, too, [n_figure, n_rms]."""
    prior = _figure_prior(len(losses))
    return np.asarray(-2.0 * logsumexp(-0.5 * losses, axis=0, b=prior[:, None]))


def figure_strength(losses: np.ndarray, rms: float) -> float:
    """Return the mean strength of what the telescope has, with a field of an rms, by losses [n_figure, n_rms]."""
    if len(losses) == 1:
        return 1.0
    at_rms = np.array([np.interp(math.log(rms), RMS_LOGARITHMS, row) for row in losses])
    return float(np.average(_FIGURES**2, weights=_figure_prior(len(losses)) * np.exp(0.5 * (at_rms.min() - at_rms))))


def _figure_prior(count: int) -> np.ndarray:
    """Return the prior of the rms of the telescope's further terms, of unit sum; of one alone, 1."""
    return _prior(np.log(_FIGURES) / _FIGURES_WIDE, _WELL_FIGURED) if count > 1 else np.ones(1)


def _prior(deviations: np.ndarray, of_first: float) -> np.ndarray:
    """Return a normal prior by deviations, and the first one more probable by so much, of unit sum."""
    prior = np.exp(-0.5 * deviations**2)
    prior *= (1.0 - of_first) / prior.sum()
    prior[0] += of_first
    return np.asarray(prior)
