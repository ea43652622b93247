"""Fitted galaxies: ellipticities and sizes with their errors, flags, and the choice of usable ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import IntFlag
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import QTable, Table
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.number_text import counted
from ...core.point_plots import draw_shapes
from ...core.products import Columns, described_table
from ...core.result import Result
from ...core.units import real_array, require_positive
from ...core.version import VERSION

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Half-light radius of a round Gaussian over its rms width along one axis.
HALF_LIGHT = float(np.sqrt(2.0 * np.log(2.0)))


class GalaxyFlag(IntFlag):
    """Failures and limits of a fit; zero for a good one.

    ``AT_BOUNDS``: centre or size at the limit of what is tried. ``UNRESOLVED``: the image is no wider than the PSF in
    some direction, so there is no ellipticity. ``EDGE``: the stamp reaches beyond the image. ``MASKED``: too many
    pixels of the inner half of the stamp are masked. ``CUT_OFF``: larger than the largest stamp. ``NO_FLUX``: the
    fitted flux is not positive.
    """

    OK = 0
    NOT_CONVERGED = 1
    AT_BOUNDS = 2
    UNRESOLVED = 4
    EDGE = 8
    MASKED = 16
    CUT_OFF = 32
    NO_FLUX = 64


@dataclass(frozen=True, eq=False)
class GalaxyFits(Result):
    """Elliptical Gaussians before the PSF, of n galaxies.

    Parameters
    ----------
    flux : array
        Total flux, in the unit of the image, [n].
    x, y : array
        Centre [pixel].
    moments : array
        Covariance Cxx, Cxy, Cyy of the Gaussian [pixel^2], [n, 3]. Of a point-like galaxy noise makes it negative as
        often as positive.
    covariance : array
        Of the errors of flux, x, y, Cxx, Cxy, Cyy, [n, 6, 6].
    chi2 : array
        Sum over the pixels of (data - model)^2 / variance, [n].
    pixels : array of int
        Pixels of the sum, [n].
    evaluations : array of int
        Models computed for each fit, [n].
    flags : array of int
        :class:`GalaxyFlag` bits, [n].
    """

    flux: np.ndarray
    x: np.ndarray
    y: np.ndarray
    moments: np.ndarray
    covariance: np.ndarray
    chi2: np.ndarray
    pixels: np.ndarray
    evaluations: np.ndarray
    flags: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the ellipticities before the PSF in their plane, coloured by the size."""
        return draw_shapes(ax, self.e1, self.e2, self.size, "rms width before the PSF [pixel]")

    def __len__(self) -> int:
        return len(self.flags)

    @property
    def size(self) -> np.ndarray:
        """(Cxx Cyy - Cxy^2)^(1/4), the rms width of a round Gaussian of the same area [pixel]; NaN where unresolved."""
        return np.sqrt(self._root)

    @property
    def half_light_radius(self) -> np.ndarray:
        """Half-light radius of a round Gaussian of the same area [pixel]; NaN where unresolved."""
        return HALF_LIGHT * self.size

    @property
    def e1(self) -> np.ndarray:
        """Ellipticity (a - b)/(a + b) along x; NaN where unresolved."""
        return (self.moments[:, 0] - self.moments[:, 2]) / self._sum

    @property
    def e2(self) -> np.ndarray:
        """Ellipticity (a - b)/(a + b) along the diagonal x = y; NaN where unresolved."""
        return 2.0 * self.moments[:, 1] / self._sum

    @property
    def flux_error(self) -> np.ndarray:
        """Standard error of the flux."""
        return np.sqrt(self.covariance[:, 0, 0])

    @property
    def x_error(self) -> np.ndarray:
        """Standard error of x [pixel]."""
        return np.sqrt(self.covariance[:, 1, 1])

    @property
    def y_error(self) -> np.ndarray:
        """Standard error of y [pixel]."""
        return np.sqrt(self.covariance[:, 2, 2])

    @property
    def size_error(self) -> np.ndarray:
        """Standard error of the size [pixel]."""
        xx, xy, yy = self.moments.T
        gradient = np.stack([yy, -2.0 * xy, xx], axis=1) / (4.0 * self.size**3)[:, None]
        return self._error(gradient)

    @property
    def e1_error(self) -> np.ndarray:
        """Standard error of e1."""
        return self._error(self._gradient(self.e1, (1.0, 0.0, -1.0)))

    @property
    def e2_error(self) -> np.ndarray:
        """Standard error of e2."""
        return self._error(self._gradient(self.e2, (0.0, 2.0, 0.0)))

    @property
    def ellipticity_error(self) -> np.ndarray:
        """Standard error of one component of the ellipticity, the root of the mean square of both."""
        return np.sqrt(0.5 * (self.e1_error**2 + self.e2_error**2))

    @property
    def snr(self) -> np.ndarray:
        """Flux over its standard error."""
        return self.flux / self.flux_error

    @property
    def chi2_per_pixel(self) -> np.ndarray:
        """Chi-square over the number of pixels less that of the parameters."""
        return self.chi2 / np.maximum(self.pixels - self.covariance.shape[1], 1)

    @property
    def good(self) -> np.ndarray:
        """Fits without a flag, [n] bool."""
        return self.flags == 0

    @property
    def _root(self) -> np.ndarray:
        """Root of the determinant of the moments [pixel^2]; NaN where they are no covariance."""
        xx, xy, yy = self.moments.T
        determinant = xx * yy - xy**2
        return np.sqrt(np.where((determinant > 0.0) & (xx > 0.0), determinant, np.nan))

    @property
    def _sum(self) -> np.ndarray:
        """Square of the sum of the axes (a + b) [pixel^2]."""
        return self.moments[:, 0] + self.moments[:, 2] + 2.0 * self._root

    def _gradient(self, e: np.ndarray, numerator: Sequence[float]) -> np.ndarray:
        """Return the derivatives of an ellipticity with respect to the moments, [n, 3]."""
        xx, xy, yy = self.moments.T
        of_sum = np.stack([1.0 + yy / self._root, -2.0 * xy / self._root, 1.0 + xx / self._root], axis=1)
        return (np.asarray(numerator) - e[:, None] * of_sum) / self._sum[:, None]

    def _error(self, gradient: np.ndarray) -> np.ndarray:
        """Return the standard error of a function of the moments from its gradient [n, 3]."""
        spread = (self.covariance[:, 3:, 3:] * gradient[:, None, :]).sum(axis=2)
        return np.sqrt((spread * gradient).sum(axis=1))

    def _label(self) -> str:
        return f"{counted(len(self), 'galaxy', 'galaxies')}, {int(self.good.sum())} without a flag"

    def to_table(self) -> QTable:
        """Return the fits of :meth:`table`."""
        return QTable(self.table())

    def table(self) -> Table:
        """Return the fits as a table with units and descriptions, a row a galaxy."""
        columns: Columns = {
            "x": (self.x, "pix", "centre, pixel centres at integers"),
            "y": (self.y, "pix", "centre, pixel centres at integers"),
            "x_error": (self.x_error, "pix", "standard error"),
            "y_error": (self.y_error, "pix", "standard error"),
            "flux": (self.flux, "", "total flux of the Gaussian, in the unit of the image"),
            "flux_error": (self.flux_error, "", "standard error"),
            "size": (self.size, "pix", "rms width before the PSF, (det C)^(1/4)"),
            "size_error": (self.size_error, "pix", "standard error"),
            "half_light_radius": (self.half_light_radius, "pix", "before the PSF"),
            "e1": (self.e1, "", "(a - b)/(a + b) along x, before the PSF"),
            "e2": (self.e2, "", "(a - b)/(a + b) along the diagonal x = y, before the PSF"),
            "e1_error": (self.e1_error, "", "standard error"),
            "e2_error": (self.e2_error, "", "standard error"),
            "cxx": (self.moments[:, 0], "pix2", "covariance before the PSF"),
            "cxy": (self.moments[:, 1], "pix2", "covariance before the PSF"),
            "cyy": (self.moments[:, 2], "pix2", "covariance before the PSF"),
            "chi2_per_pixel": (self.chi2_per_pixel, "", "chi-square over degrees of freedom"),
            "flags": (self.flags, "", _flag_meanings()),
        }
        return described_table(columns, {"what": "PSF-convolved elliptical Gaussian fits", "pachon": VERSION})


def _flag_meanings() -> str:
    """Return the meaning of the flags in words."""
    return ", ".join(f"{int(flag)} {str(flag.name).lower().replace('_', ' ')}" for flag in GalaxyFlag if flag)


def joined(parts: Sequence[GalaxyFits], places: Sequence[np.ndarray]) -> GalaxyFits:
    """Return one set of fits from parts, whose galaxies have the indices `places`."""
    order = np.argsort(np.concatenate(places))
    values: dict[str, Any] = {
        f.name: np.concatenate([getattr(fits, f.name) for fits in parts])[order] for f in fields(GalaxyFits)
    }
    return GalaxyFits(**values)


@check_arguments
def usable_galaxies(
    fits: GalaxyFits,
    half_light_radius: ArrayLike,
    star_half_light_radius: ArrayLike,
    *,
    least_ratio: float = 1.2,
    most_error: float = 0.2,
) -> np.ndarray:
    """Choose galaxies for shear: larger than stars, with a known ellipticity (Jee & Tyson 2011, sec. 4.2).

    Parameters
    ----------
    fits : GalaxyFits
        Of n galaxies; flagged ones are left out.
    half_light_radius : array
        Measured on the image with the PSF, as of :func:`~pachon.detect_objects` [pixel], [n].
    star_half_light_radius : float or array
        The same of the stars, of which the median is taken.
    least_ratio : float
        Least ratio of the two.
    most_error : float
        Largest :attr:`~GalaxyFits.ellipticity_error`.

    Returns
    -------
    array of bool
        [n].

    Raises
    ------
    DomainError
        If shapes differ, there are no stars, or a limit is not positive.
    """
    radius = real_array(half_light_radius, "half_light_radius: expected real numbers [n]")
    stars = np.atleast_1d(real_array(star_half_light_radius, "star_half_light_radius: expected real numbers"))
    if radius.shape != (len(fits),):
        raise DomainError(f"half_light_radius has shape {radius.shape}: expected ({len(fits)},), one for each fit")
    if not len(stars) or not np.isfinite(stars).all() or (stars <= 0.0).any():
        raise DomainError("star_half_light_radius: expected positive numbers of at least one star")
    least = require_positive(least_ratio, "least_ratio") * float(np.median(stars))
    with np.errstate(invalid="ignore"):
        precise = fits.ellipticity_error < require_positive(most_error, "most_error")
        return np.asarray(fits.good & precise & (radius > least))
