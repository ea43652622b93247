"""Spots and wavefronts against the height of the detector, and the height of best focus.

Behind the last surface rays are straight, so one trace serves all heights. The wavefront refers at each height to a
sphere about the landing point of the chief ray there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError, shown
from ...core.plotting import figure_at, styled
from ...core.threads import one_blas_thread
from ...core.units import field_label, metres
from ...models.camera.focal_plane import FocalPlane
from ...models.telescope import Telescope
from ...raytrace.ideal_lens import require_image
from ...raytrace.rays import Projection
from ...raytrace.spot_parabola import lowest_height, spot_parabola
from ...wavefront.bundles import Bundles
from ...wavefront.chief_rays import reference_rays
from ...wavefront.pupil_sampling import PupilSampling, SamplingName
from ...wavefront.request import Request
from ..drawing import FEW, field_colors, finish_axes, legend_below
from ..result import FieldResult
from .principal_rays import PARALLEL, principal_rays_of
from .wavefront_strehl import brightest_strehl

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Heights where none are given.
_HEIGHTS = 61
#: Largest defocus over the distance of the exit pupil, and in metres where that is at infinity.
_FARTHEST = 0.1
_FARTHEST_AT_INFINITY = 1e4


@dataclass(frozen=True)
class ThroughFocus(FieldResult):
    """Image quality against the height of the detector.

    Attributes
    ----------
    defocus : ndarray, shape [n_height]
        Heights above the nominal detector [m], along its own z axis.
    rms_radius : ndarray, shape [n_field, n_height]
        Root mean square radius of the spots about their centroids, all wavelengths together [m].
    rms_wavefront : ndarray, shape [n_field, n_height]
        Root mean square of the wavefront without piston and tilt, in quadrature over the wavelengths [m].
    strehl : ndarray, shape [n_field, n_height]
        Squared modulus of the mean of exp(2 pi i W / wavelength) over the lit pupil, with the tilt that makes it
        largest: the brightest point of the image. Mean over the wavelengths, each at its own point. NaN where the
        wavefront, far from focus, is too steep for so many points of the pupil.
    best_spot : ndarray, shape [n_field]
        Height of the smallest rms radius of each field [m].
    best_wavefront : ndarray, shape [n_field]
        Height of the smallest rms wavefront of each field [m]; NaN where it lies outside the heights.
    best_common : float
        Height of the smallest mean square radius of all fields [m], with the weights that the design data state.
    smallest_radius : ndarray, shape [n_field]
        Root mean square radius at `best_spot` [m].
    """

    defocus: np.ndarray
    rms_radius: np.ndarray
    rms_wavefront: np.ndarray
    strehl: np.ndarray
    best_spot: np.ndarray
    best_wavefront: np.ndarray
    best_common: float
    smallest_radius: np.ndarray

    def _columns(self) -> dict[str, Any]:
        return self._along("defocus", "rms_radius", "rms_wavefront", "strehl")

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; rows are fields, columns heights of the detector."""
        return {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelengths * 1e9,
            **self.field_items(),
            "best_focus_spot_um": self.best_spot * 1e6,
            "best_focus_wavefront_um": self.best_wavefront * 1e6,
            "best_focus_common_um": self.best_common * 1e6,
            "smallest_rms_radius_um": self.smallest_radius * 1e6,
            "defocus_um": self.defocus * 1e6,
            "rms_radius_um": self.rms_radius * 1e6,
            "rms_wavefront_nm": self.rms_wavefront * 1e9,
            "strehl": self.strehl,
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw rms radius, rms wavefront and Strehl ratio against the height of the detector."""
        wavelength = float(self.wavelengths.mean())
        waves = self.rms_wavefront / wavelength
        panels = [
            (self.rms_radius * 1e6, "rms spot radius [µm]", self.best_spot),
            (waves, f"rms wavefront [waves at {wavelength * 1e9:.4g} nm]", self.best_wavefront),
            (self.strehl, "Strehl ratio", np.full(len(waves), np.nan)),
        ]
        with styled():
            figure = figure_at(ax, 12.0, 4.4)
            row = figure.subplots(1, 3)
            for axes, (values, label, best) in zip(row, panels, strict=True):
                _draw_curves(axes, self, values, best)
                axes.set(ylabel=label, ylim=(0.0, None))
            legend_below(figure, row[0])
            common = f"{self.best_common * 1e6:+.3g} µm"
            return self._titled(figure, f"through focus; the spots of all fields together are smallest at {common}")


@check_arguments
@one_blas_thread()
def through_focus(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    defocus: ArrayLike | None = None,
    *,
    wavelength_weights: ArrayLike | None = None,
    sampling: SamplingName | PupilSampling | None = None,
    n_pupil: int | None = None,
    focal_plane: FocalPlane | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
) -> ThroughFocus:
    """Measure spots and wavefronts against the height of the detector.

    Parameters
    ----------
    telescope, fields, wavelengths, wavelength_weights, sampling, n_pupil, projection, threads
        As in :meth:`pachon.Request.of`.
    defocus : array_like or Quantity, shape [n_height], optional
        Heights above the nominal detector [m], ascending; by default about the common best focus, to where the spots
        are about three times as large.
    focal_plane : FocalPlane, optional
        CCD surfaces, as in :meth:`pachon.Request.on`; the nominal detector surface without it.

    Raises
    ------
    DomainError
        If heights do not ascend, no light of a field reaches the detector, its chief ray does not, or it arrives
        parallel.
    """
    request = Request.of(
        telescope,
        fields,
        wavelengths,
        wavelength_weights=wavelength_weights,
        sampling=sampling,
        n_pupil=n_pupil,
        projection=projection,
        threads=threads,
    ).on(focal_plane)
    require_image(request.telescope, "a focus")
    bundles = [request.bundles(float(w)) for w in request.wavelengths]
    square = _mean_squares(request, bundles)
    parallel = np.sqrt(square[:, 2]) < PARALLEL
    if parallel.any():
        raise DomainError(f"{field_label(request.fields[parallel][0])}: the light is parallel; expected a focus")
    best, common = lowest_height(square), float(lowest_height(request.field_weights @ square))
    smallest = np.sqrt(np.maximum(np.polynomial.polynomial.polyval(best, square.T, tensor=False), 0.0))
    if defocus is None:
        principal = principal_rays_of(request)
        # Behind a cylinder one of the two focal ratios is infinite, and so is their mean.
        ratios = np.where(np.isfinite(principal.mean_f_number), principal.mean_f_number, principal.f_number.min(axis=1))
        blur = max(float(smallest.max()), float((request.wavelengths.mean() * ratios).max()))
        reach = float(np.abs(best - common).max()) + 3.0 * blur / float(np.sqrt(square[:, 2].min()))
        heights = common + reach * np.linspace(-1.0, 1.0, _HEIGHTS)
    else:
        heights = np.atleast_1d(metres(defocus, "defocus"))
        farthest = min(_FARTHEST * abs(request.telescope.sphere_radius), _FARTHEST_AT_INFINITY)
        if heights.size and not np.abs(heights).max() <= farthest:
            raise DomainError(f"defocus = {shown(defocus)}: expected at most {farthest:g} m on either side")
        if heights.ndim != 1 or not (np.isfinite(heights).all() and (np.diff(heights) > 0).all() and len(heights)):
            raise DomainError(f"defocus = {defocus!r}: expected ascending heights of the detector in metres")
    wavefront, strehl = _wavefronts(request, bundles, heights)
    return ThroughFocus(
        request=request,
        defocus=heights,
        rms_radius=np.sqrt(np.maximum(np.polynomial.polynomial.polyval(heights, square.T), 0.0)),
        rms_wavefront=wavefront,
        strehl=strehl,
        best_spot=best,
        best_wavefront=np.array([_lowest(heights, row**2) for row in wavefront]),
        best_common=common,
        smallest_radius=smallest,
    )


def _mean_squares(request: Request, bundles: list[Bundles]) -> np.ndarray:
    """Return the mean square radius of each field as a parabola in the height, coefficients [n_field, 3]."""
    n_field = len(request.fields)
    lit = np.stack([b.lit for b in bundles], axis=1)
    weight = np.where(lit, request.weights[:, None] * request.pupil.weights, 0.0).reshape(n_field, -1)
    light = weight.sum(axis=1)
    if not (light > 0).all():
        raise DomainError(f"{field_label(request.fields[~(light > 0)][0])}: no light reaches the detector")
    place = np.stack([b.landing() for b in bundles], axis=1)
    slope = np.stack([b.direction[..., :2] / b.direction[..., 2:] for b in bundles], axis=1)
    return spot_parabola(place.reshape(n_field, -1, 2), slope.reshape(n_field, -1, 2), weight)


def _wavefronts(request: Request, bundles: list[Bundles], heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rms wavefront [m] and Strehl ratio, shape [n_field, n_height] each."""
    radius, weights = request.telescope.sphere_radius, request.pupil.weights
    plane = np.stack([np.ones(len(weights)), *request.unit_pupil.T], axis=-1)
    square, strehl = np.zeros((2, len(bundles[0].chief_path), len(heights)))
    for bundle, fraction in zip(bundles, request.weights, strict=True):
        reference_rays(request, bundle.wavelength)
        for i, lit in enumerate(bundle.lit):
            if not lit.any():
                continue
            weight = weights[lit] / weights[lit].sum()
            # Weighted least squares by one factorisation serves all heights.
            basis = np.linalg.qr(plane[lit] * np.sqrt(weight)[:, None])[0]
            for k, height in enumerate(heights):
                value = bundle.one(i).opd(radius, float(height))[0, lit]
                scaled = value * np.sqrt(weight)
                residual = scaled - basis @ (basis.T @ scaled)
                square[i, k] += fraction * (residual**2).sum()
                waves = residual / np.sqrt(weight) / bundle.wavelength
                strehl[i, k] += fraction * brightest_strehl(weight, request.unit_pupil[lit], waves)
    return np.sqrt(square), strehl


def _lowest(x: np.ndarray, y: np.ndarray) -> float:
    """Return where a sampled curve is lowest, by the parabola through the lowest sample and its neighbours."""
    i = int(np.argmin(y))
    if not 0 < i < len(x) - 1:
        return float("nan")
    curve = np.polynomial.Polynomial.fit(x[i - 1 : i + 2], y[i - 1 : i + 2], 2)
    return float(curve.deriv().roots()[0].real)


def _draw_curves(axes: Axes, result: ThroughFocus, values: np.ndarray, best: np.ndarray) -> None:
    heights = result.defocus * 1e6
    labelled = len(result.fields) <= FEW
    colors = field_colors(len(result.fields))
    for row, label, color, height in zip(values, result.field_labels(), colors, best * 1e6, strict=True):
        axes.plot(heights, row, color=color, linewidth=1.4, label=label if labelled else None)
        if heights[0] <= height <= heights[-1]:
            axes.plot(height, np.interp(height, heights, row), "o", color=color, markersize=4.0)
    axes.axvline(0.0, color="0.6", linewidth=0.7)
    common = result.best_common * 1e6
    axes.axvline(common, color="0.3", linewidth=0.9, linestyle=(0, (4, 3)), label="best for all together")
    finish_axes(axes, xlim=(heights[0], heights[-1]), xlabel="height above the nominal detector [µm]")
