r"""Correlation of the ellipticities of places as a differentiable sum over their pairs.

With ellipticities e and fractions of the area w at n positions, xi+ of a bin of separations is the mean over its pairs

.. math:: \xi_b = \frac{\sum_{ij \in b} w_i w_j \, e_i \cdot e_j}{\sum_{ij \in b} w_i w_j},

a quadratic form of e, whose derivative is twice one product of a sparse matrix and e (Jee & Tyson 2011, eq. 7).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from ...core.errors import DomainError

# Bins of a decade of separations, as in the correlations of runs.
_BINS_PER_DECADE = 6
# Fewest bins, as in the correlations of runs.
_FEWEST = 4
#: Largest number of places; the memory of their pairs grows with its square, to 1 GB.
MOST_PLACES = 6_000


def separation_edges(shortest: float, longest: float) -> np.ndarray:
    """Return the edges of logarithmic bins between two separations [rad]."""
    count = max(_FEWEST, round(_BINS_PER_DECADE * np.log10(longest / shortest)))
    return np.geomspace(shortest, longest, count + 1)


@dataclass(frozen=True, eq=False)
class PairSum:
    """Pairs of places in bins of separation.

    Attributes
    ----------
    matrix : scipy.sparse.csr_array, shape [n_bin * n, n]
        Weights of the pairs of each bin that has any, both orders of a pair, of sum 1 in each bin.
    n : int
        Number of places.
    """

    matrix: scipy.sparse.csr_array
    n: int

    @classmethod
    def of(cls, sky: np.ndarray, weight: np.ndarray, edges: np.ndarray) -> PairSum:
        """Return the pairs of places at angles [n, 2] of given weights [n], in bins between edges [rad].

        DomainError if there are more than :data:`MOST_PLACES`.
        """
        n = len(sky)
        if n > MOST_PLACES:
            raise DomainError(f"merit = 'xi': expected at most {MOST_PLACES} places, found {n}; choose fewer CCDs")
        bins = []
        for i in range(n):
            # Bins as TreeCorr has them, closed at the lower edge.
            bins.append((np.searchsorted(edges, np.hypot(*(sky - sky[i]).T), side="right") - 1).astype(np.int16))
            bins[i][i] = -1
        bin_index = np.array(bins)
        blocks = []
        for b in range(len(edges) - 1):
            row, column = np.nonzero(bin_index == b)
            if len(row):
                share = weight[row] * weight[column]
                blocks.append(scipy.sparse.csr_array((share / share.sum(), (row, column)), shape=(n, n)))
        if not blocks:
            raise DomainError(f"merit = 'xi': expected pairs of places, found none among {n}")
        return cls(scipy.sparse.csr_array(scipy.sparse.vstack(blocks, format="csr")), n)

    def xi_plus(self, e: np.ndarray) -> np.ndarray:
        """Return xi+ of ellipticities [n, 2] in each bin that has pairs."""
        return self._products(e)[0]

    def mean_square(self, e: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the mean over the bins of the square of xi+, and its derivative with respect to e, shape [n, 2]."""
        xi, products = self._products(e)
        return float((xi**2).mean()), 4.0 / len(xi) * np.einsum("b,bnk->nk", xi, products)

    def _products(self, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return xi+ [n_bin] and the sums over the partners of each place [n_bin, n, 2]."""
        products = (self.matrix @ e).reshape(-1, self.n, 2)
        return np.einsum("nk,bnk->b", e, products), products
