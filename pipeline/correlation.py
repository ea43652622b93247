"""Two-point correlation of ellipticities, by TreeCorr."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import treecorr

from ..models.errors import DomainError
from ..models.units import radians
from .photometry import ARCSEC

EXACT_LIMIT = 10_000
"""Most stars whose pairs are all counted one by one unless told otherwise: a second on one core."""


@dataclass(frozen=True)
class Correlation:
    """Ellipticity correlations in logarithmic bins of separation.

    Parameters
    ----------
    r : array
        Mean separation of the pairs in each bin, the bin's logarithmic centre where it is empty [rad].
    xi_plus, xi_minus : array
        Correlations; NaN in an empty bin.
    error_plus, error_minus : array
        Standard errors from the scatter of the ellipticities alone (TreeCorr's "shot"): pairs that share a star, or an
        exposure, are not independent, so the true ones are larger. NaN in an empty bin.
    n_pairs : array of int
        Pairs in each bin, every pair once.
    n_stars : int
        Stars used.
    """

    r: np.ndarray
    xi_plus: np.ndarray
    xi_minus: np.ndarray
    error_plus: np.ndarray
    error_minus: np.ndarray
    n_pairs: np.ndarray
    n_stars: int

    @property
    def r_arcmin(self) -> np.ndarray:
        """Separation [arcmin]."""
        return self.r / (60.0 * ARCSEC)


def shear_correlation(
    x: Any,
    y: Any,
    e1: Any,
    e2: Any,
    *,
    min_sep: Any,
    max_sep: Any,
    n_bins: int = 20,
    subtract_mean: bool = False,
    exact: bool | None = None,
) -> Correlation:
    """Correlate ellipticities of star pairs (Jee & Tyson 2011, eq. 7).

    xi+ is the mean of Re(e e'*) over the pairs of a bin and xi- that of Re(e e' exp(-4 i phi)), phi being the
    direction of the pair from x towards y; equal weights, flat sky. TreeCorr runs on one thread, since several would
    add the pairs in another order: the same stars give the same bytes. It keeps ellipticities in single precision, so
    a correlation is good to about 1e-7 of the mean |e|^2.

    Parameters
    ----------
    x, y : array or Quantity
        Positions [rad], the axes to which e1 and e2 refer (e1 > 0 along x, e2 > 0 along x = y). Swapping one of them
        changes the sign of e2 and spoils xi-.
    e1, e2 : array
        Ellipticities. A star with NaN in position or ellipticity is left out.
    min_sep, max_sep : float or Quantity
        Separations at which the first bin begins and the last one ends [rad].
    n_bins : int
        Logarithmic bins.
    subtract_mean : bool
        Whether to take the mean ellipticity off first, which removes the constant part of xi+.
    exact : bool, optional
        Whether to count pair by pair (time goes as the square of the number of stars) or with TreeCorr's cells, whose
        radius may blur a bin's edges by a tenth of its width (``bin_slop=0.1``). Where left out, pair by pair up to
        ``EXACT_LIMIT`` stars.

    Raises
    ------
    DomainError
        If shapes differ, separations are not positive and rising, or fewer than two stars are usable.
    """
    columns = [np.asarray(radians(v, n), dtype=np.float64) for v, n in ((x, "x"), (y, "y"))]
    try:
        columns += [np.asarray(v, dtype=np.float64) for v in (e1, e2)]
    except (TypeError, ValueError) as error:
        raise DomainError("e1, e2: expected arrays of real numbers") from error
    if columns[0].ndim != 1 or any(c.shape != columns[0].shape for c in columns):
        raise DomainError(f"x, y, e1, e2 have shapes {[c.shape for c in columns]}: expected [n] four times")
    low, high = (float(radians(v, n)) for v, n in ((min_sep, "min_sep"), (max_sep, "max_sep")))
    if not (np.isfinite(high) and 0.0 < low < high):
        raise DomainError(f"min_sep = {min_sep}, max_sep = {max_sep}: expected 0 < min_sep < max_sep")
    if n_bins < 1:
        raise DomainError(f"n_bins = {n_bins}: expected at least 1")
    usable = np.all(np.isfinite(columns), axis=0)
    n_stars = int(usable.sum())
    if n_stars < 2:
        raise DomainError(f"e1, e2: {n_stars} of {len(usable)} stars are usable, expected at least 2")
    px, py, g1, g2 = (c[usable] for c in columns)
    if subtract_mean:
        g1, g2 = g1 - g1.mean(), g2 - g2.mean()
    if exact is None:
        exact = n_stars <= EXACT_LIMIT
    pairs = treecorr.GGCorrelation(min_sep=low, max_sep=high, nbins=n_bins, bin_slop=0.1, brute=exact, verbose=0)
    pairs.process(treecorr.Catalog(x=px, y=py, g1=g1, g2=g2), num_threads=1)
    empty = pairs.npairs == 0
    return Correlation(
        r=np.where(empty, pairs.rnom, pairs.meanr),
        xi_plus=np.where(empty, np.nan, pairs.xip),
        xi_minus=np.where(empty, np.nan, pairs.xim),
        error_plus=np.where(empty, np.nan, np.sqrt(pairs.varxip)),
        error_minus=np.where(empty, np.nan, np.sqrt(pairs.varxim)),
        n_pairs=np.rint(pairs.npairs).astype(np.int64),
        n_stars=n_stars,
    )
