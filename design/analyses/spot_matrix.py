"""Spot matrices: spots of each field against the focus, or against the wavelength."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE, round_length
from ...core.units import metres, require_count
from ...models.telescope import Telescope
from ...raytrace.rays import Projection
from ...wavefront.bundles import Bundles
from ...wavefront.pupil_sampling import PupilSampling, SamplingName
from ...wavefront.request import Request
from .. import drawing
from ..metrics.principal_rays import principal_rays_of
from .analysis import Analysis, Columns, band_wavelengths, require_focus

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Heights of the detector where none are given.
_HEIGHTS = 5
#: Most heights of the detector.
_MOST_HEIGHTS = 1000
#: Default rings of rays.
_RINGS = 10
#: Most rays along the radius or the side of the pupil, and on a spiral.
_MOST_ALONG = 1000
_MOST_ON_SPIRAL = 10**6
#: Largest of these heights, in depths of focus.
_DEPTHS = 2.0


@dataclass(frozen=True)
class SpotMatrix(Analysis):
    """Spots in rows of fields and columns of heights of the detector, or of wavelengths.

    Attributes
    ----------
    against : {"focus", "wavelength"}
        What the columns are.
    columns : ndarray, shape [n_column]
        Heights of the detector above its place along its own z axis, or vacuum wavelengths [m].
    displacement : ndarray, shape [n_field, n_column, n_wave, n_pupil, 2]
        Landing points [m] relative to the centroid of each field's light of all wavelengths, at that height; x and y of
        the detector. Against the wavelength each column has one wavelength. NaN where a ray does not arrive.
    weight : ndarray, shape [n_field, n_column, n_wave, n_pupil]
        Light of each ray; zero where it is vignetted.
    airy_radius : ndarray, shape [n_field]
        Radius of the first dark ring at the middle wavelength [m].
    """

    against: Literal["focus", "wavelength"]
    columns: np.ndarray
    displacement: np.ndarray
    weight: np.ndarray
    airy_radius: np.ndarray

    @property
    def rms_radius(self) -> np.ndarray:
        """Root mean square radius of each spot about its own centroid [m], shape [n_field, n_column]; NaN if dark."""
        lit_displacement = np.where(self.weight[..., None] > 0, self.displacement, 0.0)
        light = self.weight.sum(axis=(2, 3))
        with np.errstate(invalid="ignore"):
            mean = np.einsum("fcwp,fcwpi->fci", self.weight, lit_displacement) / light[..., None]
            square = np.einsum("fcwp,fcwpi->fc", self.weight, (lit_displacement - mean[:, :, None, None]) ** 2) / light
        return np.sqrt(square)

    @property
    def _title(self) -> str:
        return f"spots against {self.against}, about the centroid of each field"

    @property
    def _panels(self) -> tuple[int, int, float, float]:
        return len(self.fields), len(self.columns), 0.6 + 1.6 * len(self.columns), 0.9 + 1.75 * len(self.fields)

    def _table_columns(self) -> Columns:
        nm = self.against == "wavelength"
        scale, unit = (1e9, "nm") if nm else (1e6, "um")
        return {
            **self._field_columns(1),
            "wavelength" if nm else "defocus": (
                self.columns * scale,
                unit,
                "vacuum wavelength" if nm else "displacement of the detector",
            ),
            "rms_radius": (self.rms_radius * 1e6, self.image_unit("um"), "rms radius of the spot"),
        }

    def _values(self) -> dict[str, Any]:
        focus = self.against == "focus"
        return {
            "against": self.against,
            **({"defocus_um": self.columns * 1e6} if focus else {"columns_nm": self.columns * 1e9}),
            **self.on_image({"rms_radius_um": self.rms_radius * 1e6, "airy_radius_um": self.airy_radius * 1e6}),
        }

    def _draw(self, panels: Sequence[Axes]) -> None:
        n = len(self.columns)
        distance = np.linalg.norm(np.where(self.weight[..., None] > 0, self.displacement, 0.0), axis=-1)
        half = 1.08e6 * max(float(distance.max()), float(np.nanmax(self.airy_radius)))
        waves = self.displacement.shape[2]
        single = drawing.wavelength_colors(self.columns) if self.against == "wavelength" else [BLUE] * n
        rms = self.rms_radius * 1e6
        for k, axes in enumerate(panels):
            i, c = divmod(k, n)
            colors = [single[c]] if waves == 1 else drawing.wavelength_colors(self.wavelengths)
            for w, color in enumerate(colors):
                lit = self.weight[i, c, w] > 0
                points = self.displacement[i, c, w, lit] * 1e6
                axes.plot(*points.T, ".", markersize=1.5, markeredgewidth=0.0, color=color)
            drawing.draw_circle(axes, float(self.airy_radius[i]) * 1e6, color="black")
            drawing.bare_frame(axes, half)
            axes.set_xlabel(self.image_text(f"{rms[i, c]:.3g} µm rms"), fontsize=7, labelpad=1)
            if c == 0:
                axes.set_ylabel(self.field_labels()[i], fontsize=8.5)
            if i == 0:
                value = self.columns[c]
                axes.set_title(f"{value * 1e9:.4g} nm" if self.against == "wavelength" else f"{value * 1e6:+.4g} µm")
        bar = round_length(0.7 * half)
        drawing.draw_scale_bar(panels[-n], bar, self.image_text(f"{bar:g} µm"))


@check_arguments
def spot_matrix(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    against: Literal["focus", "wavelength"] = "focus",
    defocus: ArrayLike | None = None,
    sampling: SamplingName | PupilSampling = "rings",
    n_pupil: int | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
) -> SpotMatrix:
    """Trace spots of each field against the focus, or against the wavelength.

    Parameters
    ----------
    telescope, fields, sampling, n_pupil, projection, threads
        As in :meth:`pachon.Request.of`, but for 10 rings by default.
    wavelengths : array_like or Quantity, shape [n_wave], optional
        Vacuum wavelengths [m]. Against the wavelength five across the band by default, where the file has no list.
    against : {"focus", "wavelength"}
        Columns: heights of the detector, with all wavelengths together in each, or wavelengths.
    defocus : array_like or Quantity, shape [n_height], optional
        Heights of the detector above its place along its own z axis [m]; five to two depths of focus
        (2 wavelengths times the focal ratio squared) by default.

    Raises
    ------
    ConfigError
        If `against` is another word.
    DomainError
        If the heights are not a list of finite lengths, or given against the wavelength, or light without a focus
        is to be studied against it.
    """
    if against == "wavelength":
        if defocus is not None:
            raise DomainError("defocus: expected none with against = 'wavelength'")
        wavelengths = band_wavelengths(telescope, wavelengths)
    rays = _RINGS if n_pupil is None and sampling == "rings" else n_pupil
    if rays is not None:
        rays = require_count(rays, "n_pupil", 1, _MOST_ON_SPIRAL if sampling == "spiral" else _MOST_ALONG)
    request = Request.of(
        telescope, fields, wavelengths, sampling=sampling, n_pupil=rays, projection=projection, threads=threads
    )
    telescope = request.telescope
    bundles = [request.bundles(float(w)) for w in request.wavelengths]
    principal = principal_rays_of(request)
    ratio = principal.mean_f_number
    if against == "focus" or not telescope.design_data.afocal:
        require_focus(telescope, np.nan_to_num(principal.f_number, posinf=np.inf))
    if against == "wavelength":
        heights = np.zeros(1)
    elif defocus is None:
        depth = 2.0 * request.middle * float(np.nanmin(ratio)) ** 2
        heights = depth * np.linspace(-_DEPTHS, _DEPTHS, _HEIGHTS)
    else:
        heights = np.atleast_1d(metres(defocus, "defocus"))
    if heights.size > _MOST_HEIGHTS:
        raise DomainError(f"defocus: {heights.size} heights, expected at most {_MOST_HEIGHTS}")
    if heights.ndim != 1 or not (len(heights) and np.isfinite(heights).all()):
        raise DomainError(f"defocus = {defocus!r}: expected finite heights of the detector in metres")
    weight = np.stack([np.where(b.lit, request.pupil.weights, 0.0) for b in bundles], axis=1)
    weight = weight * request.weights[:, None]
    spots = np.stack([_centered(bundles, weight, height) for height in heights], axis=1)
    shape = (len(request.fields), len(heights), *weight.shape[1:])
    weights = np.broadcast_to(weight[:, None], shape)
    if against == "wavelength":
        spots, weights = np.moveaxis(spots, 1, 2), np.moveaxis(weights, 1, 2)
    columns = request.wavelengths if against == "wavelength" else heights
    return SpotMatrix(request, against, columns, spots, weights, 1.22 * request.middle * ratio)


def _centered(bundles: list[Bundles], weight: np.ndarray, height: float) -> np.ndarray:
    """Return landing points at a height [m] about the centroid of all wavelengths, [n_field, n_wave, n_pupil, 2]."""
    landing = [b.landing() + height * b.direction[..., :2] / b.direction[..., 2:] for b in bundles]
    points = np.stack(landing, axis=1)
    lit_points = np.where(weight[..., None] > 0, points, 0.0)
    with np.errstate(invalid="ignore"):
        centroid = np.einsum("fwp,fwpi->fi", weight, lit_points) / weight.sum(axis=(1, 2))[:, None]
    return points - centroid[:, None, None]
