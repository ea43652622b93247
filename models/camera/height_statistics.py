"""Statistics of the heights of a focal plane, of all CCDs and of those of each vendor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.point_plots import draw_bars
from ...core.result import Values
from .focal_plane import FocalPlane

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Cells along the side of a CCD, at whose centres heights are taken.
_CELLS = 24
# Ends of the interval that holds 95 % of the heights.
_TAILS = (2.5, 97.5)


@dataclass(frozen=True)
class HeightStatistics(Values):
    """Heights of a group of CCDs, each point of their measured surface counted alike.

    Attributes
    ----------
    n_ccd : int
        Number of CCDs.
    mean, rms : float
        Mean height, and rms about it [m].
    width95 : float
        Width of the interval between 2.5 % and 97.5 % of the heights [m].
    peak_to_valley : float
        Highest less lowest [m].
    ccd_mean_rms : float
        Rms of the mean heights of the CCDs about their own mean [m].
    within_rms : float
        Rms about the mean of each CCD [m].
    within_width95 : float
        Width that holds 95 % of the heights of one CCD, median over the CCDs [m].
    tilt_rms : float
        Rms of the best plane of each CCD about its mean [m].
    shape_rms : float
        Rms about the best plane of each CCD [m].
    """

    n_ccd: int
    mean: float
    rms: float
    width95: float
    peak_to_valley: float
    ccd_mean_rms: float
    within_rms: float
    within_width95: float
    tilt_rms: float
    shape_rms: float

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the heights and their parts as bars."""
        named = {
            k.replace("_", " "): 1e6 * v for k, v in self._values().items() if k not in ("n_ccd", "peak_to_valley")
        }
        return draw_bars(ax, list(named), np.array(list(named.values())), "height [um]")


@check_arguments
def height_statistics(focal_plane: FocalPlane) -> dict[str, HeightStatistics]:
    """Compute statistics of the CCDs with measured heights, of all of them where none is measured.

    Parameters
    ----------
    focal_plane : FocalPlane
        The heights. Parts of a CCD that were not measured are left out.

    Returns
    -------
    dict of str to HeightStatistics
        Of ``"all"`` and of each vendor of the camera.

    Raises
    ------
    DomainError
        If a CCD has fewer than three measured points on the grid.
    """
    camera, (u, v, heights) = focal_plane.camera, sampled_heights(focal_plane)
    ccds = np.flatnonzero(focal_plane.measured if focal_plane.measured.any() else np.ones(len(camera), dtype=bool))
    heights = heights[ccds]
    planes = np.stack([_plane(u, v, row, camera.ccd_names[i]) for i, row in zip(ccds, heights, strict=True)])
    groups = {"all": np.ones(len(ccds), dtype=bool)}
    for vendor in dict.fromkeys(camera.vendors):
        groups[vendor] = np.array([camera.vendors[i] == vendor for i in ccds])
    return {name: _statistics(heights[of], planes[of]) for name, of in groups.items() if of.any()}


def sampled_heights(focal_plane: FocalPlane) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a grid over a CCD, u and v from -1 to 1, [n], and the heights of all CCDs there [m], [n_ccd, n].

    They are NaN where a CCD was not measured.
    """
    camera = focal_plane.camera
    axis = 2.0 * ((np.arange(_CELLS) + 0.5) / _CELLS - 0.5)
    v, u = (a.ravel() for a in np.meshgrid(axis, axis, indexing="ij"))
    at = np.moveaxis(camera.from_uv(np.arange(len(camera))[:, None], np.stack([u, v], axis=-1)), -1, 0)
    return u, v, np.where(focal_plane.measured_at(*at), focal_plane.height(*at), np.nan)


def _plane(u: np.ndarray, v: np.ndarray, height: np.ndarray, name: str) -> np.ndarray:
    """Return the best plane of one CCD, at all points."""
    finite = np.isfinite(height)
    if finite.sum() < 3:
        raise DomainError(f"{name}: {finite.sum()} measured points: expected 3 or more")
    design = np.stack([np.ones_like(u), u, v], axis=1)
    return design @ np.linalg.lstsq(design[finite], height[finite], rcond=None)[0]


def _statistics(heights: np.ndarray, planes: np.ndarray) -> HeightStatistics:
    means = np.nanmean(heights, axis=1, keepdims=True)
    within, tilt = heights - means, np.where(np.isfinite(heights), planes - means, np.nan)
    return HeightStatistics(
        n_ccd=len(heights),
        mean=float(np.nanmean(heights)),
        rms=float(np.nanstd(heights)),
        width95=float(np.ptp(np.nanpercentile(heights, _TAILS))),
        peak_to_valley=float(np.nanmax(heights) - np.nanmin(heights)),
        ccd_mean_rms=float(np.std(means)),
        within_rms=_rms(within),
        within_width95=float(np.median(np.ptp(np.nanpercentile(within, _TAILS, axis=1), axis=0))),
        tilt_rms=_rms(tilt),
        shape_rms=_rms(heights - planes),
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
