"""Terms of the wavefront of a donut: those asked for, those fitted beside them, their priors, and what the air adds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..models.telescope import Telescope
from ..models.zernike_polynomials import noll_to_nm
from ..wavefront.atmosphere.atmosphere import Atmosphere
from ..wavefront.atmosphere.mean_wavefront import mean_wavefront_covariance

# Terms up to the fifth radial degree, and the spherical term of the sixth.
_LOW_TERMS = 22
# Terms up to the sixth radial degree, of which misaligned optics have a little.
_LAST_TERM = 28
# Rms of terms that are not fitted over that of terms whose radial degree and number of rings add up to one less, from a
# least sum on: of LSST's mirrors, bent by 10 nm of each of their first twenty modes (donuts of danish 1.3.0's tests).
_FALL = 0.68
_LEAST = 6
#: Rms of a term of which telescopes have much [m].
_MUCH = 100e-9
# Terms up to the eleventh radial degree: what the mean wavefront of the air has beyond is lost in the seeing.
_AIR_TERMS = 78


@dataclass(frozen=True)
class WavefrontTerms:
    """Terms of a fit.

    Attributes
    ----------
    requested : ndarray of int, shape [n]
        Noll indices asked for.
    further : ndarray of int, shape [m]
        Noll indices of the terms that are fitted beside them.
    precision : ndarray, shape [n + m]
        Inverse variances of Gaussian priors about zero [1/m^2]; 0 for the terms asked for.
    figure : ndarray, shape [n + m]
        Variances of the telescope's part of these priors [m^2], which all stars have in common; the rest is the air's.
    air : ndarray, shape [n, n]
        Covariance of the terms asked for in the mean wavefront of the air [m^2].
    higher_order : float
        Rms of each term of the next radial degree [m].
    air_losses : ndarray, optional
        What residuals said of the air before its higher terms were fitted; see :mod:`.star_errors`.
    """

    requested: np.ndarray
    further: np.ndarray
    precision: np.ndarray
    figure: np.ndarray
    air: np.ndarray
    higher_order: float = 0.0
    air_losses: np.ndarray | None = None

    @classmethod
    def of(
        cls,
        requested: np.ndarray,
        left_out: float = 0.0,
        higher_order: float = 0.0,
        telescope: Telescope | None = None,
        air: Atmosphere | None = None,
    ) -> WavefrontTerms:
        """Return the terms beside those asked for by the rms of each [m], and by the turbulence of the exposure."""
        further, variance = further_terms(requested, left_out, higher_order)
        figure = np.concatenate([np.zeros(len(requested)), variance])
        added = np.zeros((len(requested), len(requested)))
        if air is not None and telescope is not None:
            noll = np.arange(4, max(_AIR_TERMS, int(requested.max()), int(further.max(initial=4))) + 1)
            pupil = telescope.pupil_diameter, telescope.pupil_obscuration
            covariance = mean_wavefront_covariance(air, [(0.0, 0.0)], noll, *pupil)[0, :, 0]
            added = covariance[np.ix_(requested - 4, requested - 4)]
            beyond = np.setdiff1d(noll, np.concatenate([requested, further]))
            variance = np.concatenate([variance, np.zeros(len(beyond))])
            further = np.concatenate([further, beyond])
            figure = np.concatenate([figure, np.zeros(len(beyond))])
            variance = variance + np.diag(covariance)[further - 4]
        precision = np.concatenate([np.zeros(len(requested)), 1.0 / variance])
        return cls(requested, further, precision, figure, added, higher_order)

    @property
    def every(self) -> np.ndarray:
        """Noll indices of all terms, shape [n + m]."""
        return np.concatenate([self.requested, self.further])

    @property
    def higher(self) -> np.ndarray:
        """Which terms are fitted with the rms of the next radial degree, of which the images say how large it is."""
        return (self.figure > 0.0) & (self.figure == self.higher_order**2)

    @property
    def first_low(self) -> int:
        """Number of the first terms up to Z22 that telescopes have much of, before any other."""
        low = (self.every <= _LOW_TERMS) & (self.precision < _MUCH**-2.0)
        return len(low) if low.all() else int(np.argmin(low))

    def spreads_beyond(self, noll: np.ndarray) -> np.ndarray:
        """Return the rms of terms that are not fitted [m].

        Beyond Z22, of which telescopes have as much as of any before, it falls with the sum of the radial degree and
        the number of rings of a term.
        """
        degree, order = np.array([noll_to_nm(int(j)) for j in noll]).reshape(-1, 2).T
        sums = degree + (degree - np.abs(order)) // 2
        return self.higher_order * _FALL ** np.where(np.asarray(noll) <= _LOW_TERMS, 0, np.maximum(sums - _LEAST, 0))


def _highest_degrees(noll: np.ndarray) -> dict[int, int]:
    """Return the highest radial degree of terms by their azimuthal order."""
    highest: dict[int, int] = {}
    for n, m in (noll_to_nm(int(j)) for j in noll):
        highest[m] = max(highest.get(m, 0), n)
    return highest


def further_terms(noll: np.ndarray, left_out: float, higher_order: float) -> tuple[np.ndarray, np.ndarray]:
    """Return terms to fit beside those asked for, and the variances of their priors [m^2].

    They are those up to Z28 where some up to Z22 are left out, and the next radial degree, each if its rms [m] is
    above 0. Misaligned and bent optics have as much of all terms up to the fifth degree, and a tenth of it beyond.
    """
    usual, candidates = np.arange(4, _LOW_TERMS + 1), np.arange(4, _LAST_TERM + 1)
    low_terms = np.setdiff1d(candidates, noll) if left_out > 0.0 and not np.isin(usual, noll).all() else noll[:0]
    spreads = np.where(low_terms <= _LOW_TERMS, left_out, 0.1 * left_out)
    following = next_terms(np.concatenate([noll, low_terms])) if higher_order > 0.0 else noll[:0]
    spreads = np.concatenate([spreads, np.full(len(following), higher_order)])
    return np.concatenate([low_terms, following]), spreads**2


def next_terms(noll: np.ndarray) -> np.ndarray:
    """Return the Noll indices of the next radial degree at every azimuthal order of some, without these."""
    highest = _highest_degrees(noll)
    degrees = {(n + 2, m) for m, n in highest.items()}
    last = (max(highest.values()) + 3) * (max(highest.values()) + 4) // 2
    return np.array([j for j in range(1, last + 1) if noll_to_nm(j) in degrees and j not in noll], dtype=np.int64)
