"""Two-point correlation of ellipticities, by TreeCorr."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError, shown
from ..core.plotting import BLUE, ORANGE, axes_at, label_log_axis, styled
from ..core.result import Result
from ..core.units import ARCMIN, angle, radians, real_array, require_count

if TYPE_CHECKING:
    import treecorr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SeparationRange = Literal["short", "long"]
#: Ranges of separation over which xi+ is averaged [arcmin]; Jee & Tyson 2011 give a residual below 1e-7 for the long.
SEPARATION_RANGES: dict[SeparationRange, tuple[float, float]] = {"short": (0.0, 10.0), "long": (10.0, 180.0)}
EXACT_LIMIT = 10_000
"""Largest number of stars whose pairs are counted exactly by default: a second on one core."""
#: Fewest patches of a run or stack of which error bars are a jackknife: of five they are good to a third.
FEWEST_PATCHES = 5
#: Largest ellipticity, or product of one and a size, that is correlated.
_LARGEST = 1e3
#: Least separation [rad], 0.2 microarcseconds. The square of 1e-200 is zero: TreeCorr ends by a segmentation fault.
LEAST_SEPARATION = 1e-12
#: Largest separation [rad]: a whole turn.
LARGEST_SEPARATION = 2.0 * np.pi
#: Largest number of bins: ten arrays of them for each of the 17 955 pairs of the LSST's CCDs, as patches, take 1.4 GB.
MOST_BINS = 1000
#: Least width of a bin, as the logarithm of the ratio of its ends: far above the rounding of a logarithm, 1e-14.
LEAST_BIN_WIDTH = 1e-6


@check_arguments
@dataclass(frozen=True)
class SeparationBins:
    """Logarithmic bins of separation, as `min_sep`, `max_sep`, `nbins` and `brute` of TreeCorr.

    Parameters
    ----------
    min_sep, max_sep : float
        Separations at which the first bin begins and the last one ends [rad], from 1e-12 to a whole turn.
    n_bins : int
        Number of bins, at most 1000.
    exact : bool, optional
        Whether to count pair by pair (time goes as the square of the number of stars) or with TreeCorr's cells, whose
        radius may blur a bin's edges by a tenth of its width (``bin_slop=0.1``). Where left out, pair by pair up to
        ``EXACT_LIMIT`` stars.

    Raises
    ------
    DomainError
        If a separation or the number of bins is out of its range, or the bins are too narrow to tell apart.
    """

    min_sep: float
    max_sep: float
    n_bins: int = 20
    exact: bool | None = None

    def __post_init__(self) -> None:
        require_count(self.n_bins, "n_bins", 1, MOST_BINS)
        low, high = angle(self.min_sep, "min_sep"), angle(self.max_sep, "max_sep")
        ends = f"min_sep = {shown(self.min_sep)}, max_sep = {shown(self.max_sep)}"
        for key, separation in (("min_sep", low), ("max_sep", high)):
            if not LEAST_SEPARATION <= separation <= LARGEST_SEPARATION:
                limits = f"{LEAST_SEPARATION:g} to {LARGEST_SEPARATION:.4g} rad"
                raise DomainError(f"{ends}: expected separations of {limits}", key=key)
        if not np.log(high / low) >= LEAST_BIN_WIDTH * self.n_bins:
            least = f"a max_sep of at least {np.exp(LEAST_BIN_WIDTH * self.n_bins):.7g} min_sep"
            raise DomainError(f"{ends}: expected {least}, for {self.n_bins} bins", key="max_sep")

    def exact_for(self, n_stars: int) -> bool:
        """Return whether pairs of a number of stars are counted one by one."""
        return n_stars <= EXACT_LIMIT if self.exact is None else self.exact


@dataclass(frozen=True)
class Correlation(Result):
    """Ellipticity correlations in logarithmic bins of separation.

    Parameters
    ----------
    r : array
        Mean separation of the pairs in each bin, the bin's logarithmic centre where it is empty [rad].
    xi_plus, xi_minus : array
        Correlations; NaN in an empty bin.
    error_plus, error_minus : array
        Standard errors. Without patches from the scatter of the ellipticities alone (TreeCorr's "shot"): pairs that
        share a star, or an exposure, are not independent, so the true ones are larger. With patches by the jackknife
        over them. NaN in an empty bin, and in one that is empty without one of the patches.
    n_pairs : array of int
        Pairs in each bin, every pair once.
    n_stars : int
        Stars used.
    n_patches : int
        Patches of the jackknife; 0 without.
    leave_one_out_plus : array, shape [n_patches, n_bins]
        xi+ without each patch in turn, from which follow errors of whatever is made of xi+; NaN where no pair is left.
    leave_one_out_pairs : array of int, shape [n_patches, n_bins]
        Pairs without each patch.
    pair_weights : array, optional
        Sums of the weights of the pairs of each bin; None of equal ones.
    leave_one_out_weights : array, shape [n_patches, n_bins], optional
        The same without each patch.
    """

    _table = ("r", "xi_plus", "error_plus", "xi_minus", "error_minus", "n_pairs")

    r: np.ndarray
    xi_plus: np.ndarray
    xi_minus: np.ndarray
    error_plus: np.ndarray
    error_minus: np.ndarray
    n_pairs: np.ndarray
    n_stars: int
    n_patches: int = 0
    leave_one_out_plus: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    leave_one_out_pairs: np.ndarray = field(default_factory=lambda: np.empty((0, 0), dtype=np.int64))
    pair_weights: np.ndarray | None = None
    leave_one_out_weights: np.ndarray | None = None

    @property
    def r_arcmin(self) -> np.ndarray:
        """Separation [arcmin]."""
        return self.r / ARCMIN

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw xi+ and xi- with their errors against separation."""
        with styled():
            figure, axes = axes_at(ax, 5.6, 4.0)
            for name, xi, error, color in (
                ("ξ+", self.xi_plus, self.error_plus, BLUE),
                ("ξ-", self.xi_minus, self.error_minus, ORANGE),
            ):
                axes.errorbar(self.r_arcmin, xi, error, fmt="o-", color=color, markersize=3, label=name)
            draw_correlation_axes(axes)
            return figure

    def as_dict(self) -> dict[str, np.ndarray]:
        """Return separations, correlations, errors and pairs by the names of the products."""
        return {
            "r_arcmin": self.r_arcmin,
            "xi_plus": self.xi_plus,
            "xi_minus": self.xi_minus,
            "error_plus": self.error_plus,
            "error_minus": self.error_minus,
            "pairs": self.n_pairs,
        }

    @check_arguments
    def within(self, separations: SeparationRange) -> np.ndarray:
        """Return the bins of a range of :data:`SEPARATION_RANGES`, the upper end excluded, [n_bins] bool."""
        return in_range(self.r_arcmin, separations)

    @check_arguments
    def mean_xi_plus(self, separations: SeparationRange) -> float:
        """Return the mean of xi+ over the pairs of a range of separations, by their weights where they have any.

        Parameters
        ----------
        separations : {"short", "long"}
            Below 10 arcmin, or from 10 to 180 arcmin.

        Returns
        -------
        float
            NaN where there are no pairs.
        """
        pairs = self.n_pairs if self.pair_weights is None else self.pair_weights
        return float(self._mean_over_pairs(separations, pairs, self.xi_plus))

    @check_arguments
    def leave_one_out_mean_xi_plus(self, separations: SeparationRange) -> np.ndarray:
        """Return :meth:`mean_xi_plus` without each patch in turn, [n_patches]."""
        pairs = self.leave_one_out_pairs if self.leave_one_out_weights is None else self.leave_one_out_weights
        return self._mean_over_pairs(separations, pairs, self.leave_one_out_plus)

    @check_arguments
    def error_mean_xi_plus(self, separations: SeparationRange) -> float:
        """Return the jackknife error of :meth:`mean_xi_plus`; NaN without patches."""
        return float(jackknife_error(self.leave_one_out_mean_xi_plus(separations))) if self.n_patches else np.nan

    def _mean_over_pairs(self, separations: SeparationRange, pairs: np.ndarray, xi: np.ndarray) -> np.ndarray:
        """Return the mean of xi [..., n_bins] over the pairs [..., n_bins] of a range."""
        inside = self.within(separations)
        return mean_over_pairs(pairs[..., inside], xi[..., inside])


def in_range(r_arcmin: np.ndarray, separations: SeparationRange) -> np.ndarray:
    """Return which separations [arcmin] are of a range of :data:`SEPARATION_RANGES`, the upper end excluded."""
    low, high = SEPARATION_RANGES[separations]
    return (r_arcmin >= low) & (r_arcmin < high)


def mean_over_pairs(pairs: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """Return the mean of xi [..., n_bins] over the pairs [..., n_bins] of all bins; NaN where there are none."""
    with np.errstate(invalid="ignore"):
        return np.asarray((np.where(pairs > 0, xi, 0.0) * pairs).sum(axis=-1) / pairs.sum(axis=-1))


def draw_correlation_axes(axes: Axes) -> None:
    """Draw zero, labels and legend of correlations against separation."""
    axes.axhline(0.0, color="0.5", linewidth=0.7)
    axes.set(xscale="log", xlabel="separation [arcmin]", ylabel="correlation of ellipticities")
    label_log_axis(axes.xaxis)
    axes.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
    axes.legend(loc="best")


@check_arguments
def shear_correlation(
    x: ArrayLike,
    y: ArrayLike,
    e1: ArrayLike,
    e2: ArrayLike,
    *,
    bins: SeparationBins,
    subtract_mean: bool = False,
    patch: Any = None,
    other: tuple[Any, Any] | None = None,
    weight: ArrayLike | None = None,
) -> Correlation:
    r"""Correlate ellipticities of star pairs (Jee & Tyson 2011, eq. 7).

    xi+ is the mean of ``Re(e e'*)`` over the pairs of a bin and xi- that of Re(e e' exp(-4 i phi)), phi being the
    direction of the pair from x towards y; flat sky. TreeCorr runs on one thread, since several would add the pairs in
    another order: the same stars give the same bytes. It keeps ellipticities in single precision, so a correlation is
    good to about 1e-7 of the mean of e squared.

    With patches, such as the CCDs, the error bars are those of the delete-one jackknife (Efron 1982; Norberg et
    al. 2009):

    .. math:: \sigma^2 = \frac{n - 1}{n} \sum_{k=1}^{n} (\xi_k - \bar\xi)^2

    where xi_k is the correlation without the stars of patch k, neither among themselves nor with others. It
    includes errors common to the stars of a CCD, such as that of its PSF model, but none common to several patches.
    The error bars of n independent patches are themselves good to 1/sqrt(2 (n - 1)): 70 % of two, a third of five.

    Parameters
    ----------
    x, y : array or Quantity
        Positions [rad], the axes to which e1 and e2 refer (e1 > 0 along x, e2 > 0 along x = y). Flipping one of them
        changes the sign of e2 and invalidates xi-.
    e1, e2 : array
        Ellipticities. A star with NaN in position or ellipticity is left out.
    bins : SeparationBins
        Bins of separation, such as ``SeparationBins(1e-4, 1e-2, 10)``: 10 from 1e-4 to 1e-2 rad.
    subtract_mean : bool
        Whether to take the mean ellipticity off first, which removes the constant part of xi+.
    patch : array of int or str, optional
        The patch of each star, such as the name of its CCD; at least two different ones. Changes the error bars, and
        the correlations only by rounding (or, counting with cells, within the blur of the bins).
    other : pair of arrays, optional
        A second ellipticity (f1, f2) of the same stars: xi+ becomes the mean of ``Re(e f'* + f e'*) / 2`` over the
        pairs, and xi- that of Re((e f' + f e') exp(-4 i phi)) / 2.
    weight : array, optional
        Weight of each star; a pair has the product of two. Stars of weight 0 are left out. Equal by default.

    Raises
    ------
    DomainError
        If shapes differ, a weight is negative or not finite, fewer than two stars are usable, or these are all of one
        patch.
    """
    columns = [radians(v, n) for v, n in ((x, "x"), (y, "y"))]
    if other is not None and len(other) != 2:
        raise DomainError(f"other: {len(other)} arrays given, expected two")
    ellipticities = (e1, e2, *(() if other is None else other))
    columns += [real_array(v, "e1, e2: expected arrays of real numbers") for v in ellipticities]
    if columns[0].ndim != 1 or any(c.shape != columns[0].shape for c in columns):
        raise DomainError(f"x, y, e1, e2 have shapes {[c.shape for c in columns]}: expected [n] four times")
    if weight is not None:
        weights = real_array(weight, "weight: expected an array of real numbers")
        if weights.shape != columns[0].shape or not (np.isfinite(weights) & (weights >= 0.0)).all():
            raise DomainError(f"weight: expected {len(columns[0])} finite numbers from 0, one for each star")
    try:
        labels = None if patch is None else np.asarray(patch)
    except ValueError:
        raise DomainError(f"patch = {shown(patch)}: expected one label for each star") from None
    if np.ma.is_masked(patch):
        raise DomainError("patch has masked labels: expected one for each star")
    if labels is not None and labels.shape != columns[0].shape:
        raise DomainError(f"patch has shape {labels.shape}: expected {columns[0].shape}, one for each star")
    usable = np.all(np.isfinite(columns), axis=0) & (True if weight is None else weights > 0.0)
    n_stars = int(usable.sum())
    if n_stars < 2:
        raise DomainError(f"e1, e2: {n_stars} of {len(usable)} stars are usable, expected at least 2")
    px, py, *g = (c[usable] for c in columns)
    if max(float(np.abs(c).max()) for c in g) > _LARGEST:
        raise DomainError(f"e1, e2: expected ellipticities of at most {_LARGEST:g}")
    of_stars: dict[str, Any] = {} if weight is None else {"w": weights[usable]}
    if subtract_mean:
        g = [c - np.average(c, weights=of_stars.get("w")) for c in g]
    if labels is not None:
        patch_labels, number = np.unique(labels[usable], return_inverse=True)
        if len(patch_labels) < 2:
            raise DomainError(f"patch: all usable stars are of patch {patch_labels[0]}, expected at least 2 patches")
        of_stars |= {"patch": number, "npatch": len(patch_labels)}
    import treecorr  # a tenth of a second

    catalogs = [treecorr.Catalog(x=px, y=py, g1=g[i], g2=g[i + 1], **of_stars) for i in range(0, len(g), 2)]
    pairs = treecorr.GGCorrelation(
        min_sep=float(bins.min_sep),
        max_sep=float(bins.max_sep),
        nbins=int(bins.n_bins),
        bin_slop=0.1,
        brute=bins.exact_for(n_stars),
        verbose=0,
    )
    pairs.process(*catalogs, num_threads=1)
    empty = pairs.npairs == 0
    if labels is None:
        leave_one_out_xi, leave_one_out_pairs = np.empty((2, 0, bins.n_bins)), np.empty((0, bins.n_bins))
        leave_one_out_weights = leave_one_out_pairs
        errors = np.sqrt(np.stack([pairs.varxip, pairs.varxim]))
        if other is not None:
            errors *= _factors_of_two(g, of_stars.get("w"))[:, None]
    else:
        leave_one_out_xi, leave_one_out_pairs, leave_one_out_weights = _leave_one_out_correlations(
            pairs, len(patch_labels)
        )
        errors = np.stack([jackknife_error(values) for values in leave_one_out_xi])
    return Correlation(
        r=np.where(empty, pairs.rnom, pairs.meanr),
        xi_plus=np.where(empty, np.nan, pairs.xip),
        xi_minus=np.where(empty, np.nan, pairs.xim),
        error_plus=np.where(empty, np.nan, errors[0]),
        error_minus=np.where(empty, np.nan, errors[1]),
        # Two catalogues of the same stars are paired in both orders.
        n_pairs=np.rint(pairs.npairs / len(catalogs)).astype(np.int64),
        n_stars=n_stars,
        n_patches=leave_one_out_xi.shape[1],
        leave_one_out_plus=leave_one_out_xi[0],
        leave_one_out_pairs=np.rint(leave_one_out_pairs / len(catalogs)).astype(np.int64),
        pair_weights=None if weight is None else pairs.weight / len(catalogs),
        leave_one_out_weights=None if weight is None else leave_one_out_weights / len(catalogs),
    )


def patches_of_jackknife(patch: np.ndarray) -> np.ndarray | None:
    """Return the labels of patches [n]; None where these are fewer than :data:`FEWEST_PATCHES`."""
    return patch if len(np.unique(patch)) >= FEWEST_PATCHES else None


def jackknife_error(leave_one_out: np.ndarray) -> np.ndarray:
    """Return standard errors from values without each patch, [n_patches, ...]; NaN where one of the values is."""
    scatter = ((leave_one_out - leave_one_out.mean(axis=0)) ** 2).sum(axis=0)
    return np.asarray(np.sqrt((1.0 - 1.0 / len(leave_one_out)) * scatter))


def _factors_of_two(g: list[np.ndarray], weight: np.ndarray | None) -> np.ndarray:
    """Return the factors of TreeCorr's errors of xi+ and xi- of two ellipticities of the same stars, [2].

    It takes e f'* and f e'* of a pair as independent. Their covariance is that of e and f squared, which of equal ones
    makes the error that of a single ellipticity.
    """
    e, f = (v - np.average(v, weights=weight) for v in (g[0] + 1j * g[1], g[2] + 1j * g[3]))
    squares = 1.0 if weight is None else weight**2
    norm = (squares * np.abs(e) ** 2).sum() * (squares * np.abs(f) ** 2).sum()
    covariance = (squares * e * f.conj()).sum()
    if not norm > 0.0:
        return np.ones(2)
    return np.asarray(np.sqrt(1.0 + np.array([(covariance**2).real, np.abs(covariance) ** 2]) / norm))


def _leave_one_out_correlations(
    pairs: treecorr.GGCorrelation, n_patches: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return xi+ and xi- without each patch in turn, [2, n_patches, n_bins], and pairs and weights that are left.

    The latter are [n_patches, n_bins].

    NaN where no pair is left. TreeCorr adds up the pairs of patches anew without each of them, which takes the third
    power of their number, 20 s for 189; here the pairs of each patch are subtracted from the sum of all.
    """
    sums = np.zeros((1 + n_patches, 4, len(pairs.npairs)))
    for (i, j), patch_pair in pairs.results.items():
        values = np.stack([patch_pair.npairs, patch_pair.weight, patch_pair.xip, patch_pair.xim])
        for row in {0, 1 + i, 1 + j}:
            sums[row] += values
    n_pairs, weight, plus, minus = np.moveaxis(sums[0] - sums[1:], 1, 0)
    # Numbers of pairs are whole and so exactly zero where none is left.
    with np.errstate(divide="ignore", invalid="ignore"):
        xi = np.where(n_pairs > 0, np.stack([plus, minus]) / weight, np.nan)
    return xi, n_pairs, np.where(n_pairs > 0, weight, 0.0)
