"""What the donuts of an exposure say together: their light's own wavefronts, the air, both sides of focus."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ..core.number_text import counted
from ..core.plotting import BLUE, figure_at, styled
from ..core.result import Result
from ..design.metrics.field_zernikes import name_terms
from .sides import SideAgreement

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class ExposureWavefront(Result):
    """What the donuts of an exposure say together, beside the telescope's wavefront of each.

    Attributes
    ----------
    noll : ndarray of int, shape [n_noll]
        Noll indices.
    total : ndarray, shape [n, n_noll]
        Wavefront of the light of each donut, of telescope and air [m]; NaN where a donut has no result.
    total_covariance : ndarray, shape [n, n_noll, n_noll]
        Its covariance [m^2].
    own : ndarray, shape [n, n_noll]
        What each donut has beside the telescope's wavefront: `total` less the `zernikes` of the fit [m].
    air_rms : float
        Rms of the air's wavefront, Z4 to Z22 together, by the scatter of the donuts [m].
    shared_air : float
        Part of its variance that all donuts share, by their scatter, their residuals and the winds of the site.
    noise_scale : float
        Variance of the errors of the single fits over that claimed by them, by the scatter of the donuts.
    sides : SideAgreement or None
        How well both sides of focus agree; None where all donuts are on one.
    notices : tuple of str
        What a user should know of the exposure, in sentences.
    """

    _table: ClassVar[tuple[str, ...]] = ("total", "own")

    noll: np.ndarray
    total: np.ndarray
    total_covariance: np.ndarray
    own: np.ndarray
    air_rms: float
    shared_air: float
    noise_scale: float
    sides: SideAgreement | None
    notices: tuple[str, ...]

    def _label(self) -> str:
        return f"{counted(len(self.total), 'donut')}, air {1e9 * self.air_rms:.0f} nm rms"

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit, of plain numbers and lists."""
        sides = self.sides
        return {
            "noll": self.noll,
            "total_nm": 1e9 * self.total,
            "total_error_nm": 1e9 * np.sqrt(np.diagonal(self.total_covariance, axis1=1, axis2=2)),
            "own_nm": 1e9 * self.own,
            "air_rms_nm": 1e9 * self.air_rms,
            "shared_air": self.shared_air,
            "noise_scale": self.noise_scale,
            "sides": None
            if sides is None
            else {
                "n_pairs": sides.n_pairs,
                "rms_nm": 1e9 * sides.rms,
                "chi2": sides.chi2,
                "chi2_claimed": sides.chi2_claimed,
            },
            "notices": list(self.notices),
        }

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw what each donut has beside the telescope's wavefront, with the errors of its light's wavefront."""
        errors = np.sqrt(np.diagonal(self.total_covariance, axis1=1, axis2=2))
        with styled():
            figure = figure_at(ax, 8.0, 4.0)
            bars = figure.subplots()
            width = 0.8 / max(len(self.own), 1)
            for k, (own, error) in enumerate(zip(self.own, errors, strict=True)):
                place = self.noll + (k - 0.5 * (len(self.own) - 1)) * width
                bars.errorbar(place, own * 1e9, error * 1e9, fmt=".", color=BLUE, markersize=3, linewidth=0.7)
            bars.axhline(0.0, color="0.3", linewidth=0.7)
            name_terms(bars, self.noll)
            bars.set_ylabel("donut less telescope [nm]")
            return figure

    def at(self, rows: np.ndarray, count: int) -> ExposureWavefront:
        """Return the same with NaN for the donuts of an exposure of so many that are not among some rows."""
        n = len(self.noll)
        total, own, covariance = (
            np.full((count, n), np.nan),
            np.full((count, n), np.nan),
            np.full((count, n, n), np.nan),
        )
        total[rows], own[rows], covariance[rows] = self.total, self.own, self.total_covariance
        return replace(self, total=total, own=own, total_covariance=covariance)
