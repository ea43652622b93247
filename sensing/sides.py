"""Which side of focus donuts are on: a single one may fit both, the donuts of an exposure decide it together."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

#: Twice the logarithm of the likelihood ratio from which on one side is right: five standard deviations.
DECIDED = 25.0
#: The same for a side that contradicts the one that is given.
CONTRADICTED = 100.0
#: Largest wavefront on the other side that a telescope may have, Z4 on, root of the summed squares [m].
MOST_WAVEFRONT = 2e-6


@dataclass(frozen=True)
class SideFit:
    """Fit of a donut on one side of focus: loss, Zernikes [m] and their covariance [m^2]."""

    loss: float
    zernikes: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class BothSides:
    """Coarse fits of a donut on the side of focus that is given, and as far on the other one.

    Attributes
    ----------
    given, mirrored : SideFit
        The fits. Losses are in units of what the better fit leaves, where that is more than noise.
    depth : float
        Distance from the detector to the best focus, where it is given to be [m].
    """

    given: SideFit
    mirrored: SideFit
    depth: float

    @property
    def ambiguous(self) -> bool:
        """Whether the image does not tell the sides from each other."""
        plausible = float(np.linalg.norm(self.mirrored.zernikes)) < MOST_WAVEFRONT
        return plausible and self.mirrored.loss - self.given.loss < DECIDED


@dataclass(frozen=True)
class SideDecision:
    """Sides of focus of the donuts of an exposure.

    Attributes
    ----------
    wrong : ndarray of bool, shape [n]
        Donuts that stand on the other side than given.
    decided : ndarray of bool, shape [n]
        Donuts whose side is decided, one way or the other.
    """

    wrong: np.ndarray
    decided: np.ndarray


def decide_sides(
    donuts: Sequence[BothSides | None], smoothness: Callable[[np.ndarray, Sequence[SideFit]], float]
) -> SideDecision:
    """Return on which side of focus donuts stand, all of those on one side of it alike.

    Parameters
    ----------
    donuts : sequence of BothSides or None
        Fits on both sides; None where there are none.
    smoothness : callable
        Twice the negative logarithm of the likelihood of wavefronts of one telescope, for numbers of donuts and fits.
    """
    count = len(donuts)
    fitted = np.array([i for i, donut in enumerate(donuts) if donut is not None], dtype=np.int64)
    wrong, decided = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    pairs = [donut for donut in donuts if donut is not None]
    if len(pairs) < 2:
        return SideDecision(wrong, decided)
    if all(donut.mirrored.loss - donut.given.loss > CONTRADICTED for donut in pairs):
        # Each image decides by itself.
        decided[fitted] = True
        return SideDecision(wrong, decided)
    behind = np.array([donut.depth > 0.0 for donut in pairs])
    groups = [members for members in (behind, ~behind) if members.any()]
    combinations = list(itertools.product((False, True), repeat=len(groups)))
    losses = []
    for flips in combinations:
        flipped = np.logical_or.reduce([members & flip for members, flip in zip(groups, flips, strict=True)])
        fits = [donut.mirrored if flip else donut.given for donut, flip in zip(pairs, flipped, strict=True)]
        loss = sum(fit.loss for fit in fits)
        losses.append(loss + smoothness(fitted, fits) if np.isfinite(loss) else np.inf)
    for k, members in enumerate(groups):
        # The best combination that has this group on either side.
        sides = [
            min(loss for loss, flips in zip(losses, combinations, strict=True) if flips[k] is f) for f in (False, True)
        ]
        excess = sides[1] - sides[0]
        wrong[fitted[members]] = excess < -CONTRADICTED
        decided[fitted[members]] = excess > DECIDED or excess < -CONTRADICTED
    return SideDecision(wrong, decided)


@dataclass(frozen=True)
class SideAgreement:
    """How well donuts behind and in front of focus agree on the wavefront.

    Attributes
    ----------
    n_pairs : int
        Stars with donuts on both sides; 0 where sides are compared through the wavefront over the field.
    rms : float
        Root of the summed squares of the difference, Z4 on; root mean square over the pairs [m].
    chi2_claimed : float
        Chi-square of the differences by the errors of the fits, a term; NaN without pairs.
    chi2 : float
        The same by the errors that the scatter of the donuts says, with the air's part.
    """

    n_pairs: int
    rms: float
    chi2_claimed: float
    chi2: float

    def __str__(self) -> str:
        """Return the agreement in a line."""
        pairs = f"{self.n_pairs} pairs" if self.n_pairs else "as seen through the wavefront over the field"
        claimed = f", {self.chi2_claimed:.2f} by the errors of each fit" if np.isfinite(self.chi2_claimed) else ""
        return (
            f"both sides of focus ({pairs}) differ by {1e9 * self.rms:.0f} nm rms, chi-square {self.chi2:.2f} a term "
            f"by the errors of the exposure{claimed}"
        )


def pair_agreement(
    zernikes: np.ndarray,
    covariance: np.ndarray,
    star: np.ndarray,
    behind: np.ndarray,
    scale: float,
    air: np.ndarray,
) -> SideAgreement | None:
    """Return the agreement of donuts of the same stars on both sides; None without such pairs.

    Parameters
    ----------
    zernikes, covariance : ndarray, shapes [n, n_noll], [n, n_noll, n_noll]
        Wavefronts of single fits [m] and their covariances.
    star : ndarray of int, shape [n]
        Numbers of the stars.
    behind : ndarray of bool, shape [n]
        Whether the detector is behind focus.
    scale : float
        Variance of the fits' errors over that claimed.
    air : ndarray, shape [n_noll, n_noll]
        Covariance of the air's wavefront in an exposure [m^2].
    """
    squares, claimed, found_air = [], [], []
    for number in np.unique(star):
        sides = [np.flatnonzero((star == number) & side) for side in (behind, ~behind)]
        if not all(len(side) for side in sides):
            continue
        difference = zernikes[sides[0]].mean(axis=0) - zernikes[sides[1]].mean(axis=0)
        noise = sum(covariance[side].sum(axis=0) / len(side) ** 2 for side in sides)
        squares.append(float(difference @ difference))
        claimed.append(float(difference @ np.linalg.solve(noise, difference)))
        found_air.append(float(difference @ np.linalg.solve(scale * noise + 2.0 * air, difference)))
    if not squares:
        return None
    n_term = zernikes.shape[1]
    return SideAgreement(
        len(squares), float(np.sqrt(np.mean(squares))), np.mean(claimed) / n_term, np.mean(found_air) / n_term
    )
