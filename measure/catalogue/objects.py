"""Objects detected on an image: positions, fluxes, sizes, shapes, flags."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from typing import TYPE_CHECKING

import numpy as np
from astropy.table import QTable, Table

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.number_text import counted
from ...core.point_plots import draw_points
from ...core.products import Columns, described_table
from ...core.result import Result
from ...core.version import VERSION

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class ObjectFlag(IntFlag):
    """Defects of a detected object; zero for a good one.

    ``EDGE``: its pixels or its aperture reach the edge of the image. ``SATURATED``: it has saturated pixels.
    ``BLENDED``: deblended from another object. ``MASKED``: masked pixels with few good neighbours within its aperture,
    or in most of its core; others are filled.
    """

    GOOD = 0
    EDGE = 1
    SATURATED = 2
    BLENDED = 4
    MASKED = 8


@dataclass(frozen=True, eq=False)
class DetectedObjects(Result):
    """Objects of one image.

    Parameters
    ----------
    x, y : array
        Windowed centroids, of blended objects barycentres of the isophote, pixel centres at integers [pixel], [n].
    flux, flux_error : array
        Flux in the elliptical Kron aperture, and its standard error, in the unit of the image.
    half_light_radius : array
        Of the circle with half of that flux [pixel]; NaN where there is none.
    fwhm : array
        Full width at half maximum of the image as it is [pixel], as :func:`~.shapes.fwhm` defines it.
    a, b, theta : array
        rms lengths of the axes of the isophote [pixel], and direction of the longer one from x towards y [rad], on the
        filtered image: the filter makes them longer, and rounder.
    peak : array
        Highest pixel.
    neighbour_distance : array
        Distance to the nearest other object [pixel], infinite where there is none.
    flags : array of int
        :class:`ObjectFlag` bits.
    segmentation : array of int
        [ny, nx], 0 for sky, i + 1 for pixels of object i.
    background : array
        Level of the sky that was subtracted, [ny, nx].
    """

    _images = ("segmentation", "background")

    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray
    flux_error: np.ndarray
    half_light_radius: np.ndarray
    fwhm: np.ndarray
    a: np.ndarray
    b: np.ndarray
    theta: np.ndarray
    peak: np.ndarray
    neighbour_distance: np.ndarray
    flags: np.ndarray
    segmentation: np.ndarray
    background: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the objects on the image, coloured by the logarithm of their S/N."""
        with np.errstate(invalid="ignore", divide="ignore"):
            snr = np.log10(self.snr)
        labels = "x [pixel]", "y [pixel]"
        return draw_points(ax, self.x, self.y, labels, color=snr, color_label="log10 of S/N", equal=True)

    def __len__(self) -> int:
        return len(self.x)

    @property
    def snr(self) -> np.ndarray:
        """Flux over its standard error."""
        return self.flux / self.flux_error

    @property
    def ellipticity(self) -> np.ndarray:
        """(a - b)/(a + b) of the isophote."""
        return (self.a - self.b) / (self.a + self.b)

    @property
    def e1(self) -> np.ndarray:
        """Ellipticity of the isophote along x."""
        return self.ellipticity * np.cos(2.0 * self.theta)

    @property
    def e2(self) -> np.ndarray:
        """Ellipticity of the isophote along the diagonal x = y."""
        return self.ellipticity * np.sin(2.0 * self.theta)

    def _label(self) -> str:
        ny, nx = self.segmentation.shape
        return f"{counted(len(self), 'object')} of an image of {nx} x {ny} pixels"

    def to_table(self) -> QTable:
        """Return the catalogue of :meth:`table`, without magnitudes."""
        return QTable(self.table())

    @check_arguments
    def magnitude(self, zero_point: float) -> np.ndarray:
        """Return magnitudes for that of unit flux; NaN where the flux is not positive."""
        return zero_point - 2.5 * np.log10(np.where(self.flux > 0.0, self.flux, np.nan))

    @check_arguments
    def table(self, zero_point: float | None = None) -> Table:
        """Return the catalogue as a table with units and descriptions, with magnitudes where a zero point is given.

        Raises
        ------
        DomainError
            If the zero point is not finite.
        """
        columns: Columns = {
            "number": (np.arange(1, len(self) + 1), "", "value of its pixels in the segmentation map"),
            "x": (self.x, "pix", "windowed centroid, pixel centres at integers"),
            "y": (self.y, "pix", "windowed centroid, pixel centres at integers"),
            "flux": (self.flux, "", "in the Kron aperture, in the unit of the image"),
            "flux_error": (self.flux_error, "", "standard error"),
            "half_light_radius": (self.half_light_radius, "pix", "PSF included"),
            "fwhm": (self.fwhm, "pix", "PSF included"),
            "a": (self.a, "pix", "longer rms axis of the isophote"),
            "b": (self.b, "pix", "shorter rms axis of the isophote"),
            "theta": (self.theta, "rad", "direction of the longer axis from x towards y"),
            "e1": (self.e1, "", "(a - b)/(a + b) of the isophote along x"),
            "e2": (self.e2, "", "(a - b)/(a + b) of the isophote along the diagonal x = y"),
            "peak": (self.peak, "", "highest pixel"),
            "neighbour_distance": (self.neighbour_distance, "pix", "distance to the nearest other object"),
            "flags": (self.flags, "", "1 edge, 2 saturated, 4 blended, 8 masked"),
        }
        if zero_point is not None:
            if not np.isfinite(zero_point):
                raise DomainError(f"zero_point = {zero_point}: expected the magnitude of unit flux")
            columns["magnitude"] = (self.magnitude(zero_point), "mag", f"zero point {zero_point:g}")
        return described_table(columns, {"what": "objects detected on an image", "pachon": VERSION})
