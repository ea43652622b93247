"""Spot diagrams: landing points of rays on the detector, and sizes of the spots."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE, RED, round_length, styled
from ...core.units import arcseconds
from ...models.camera.focal_plane import FocalPlane
from ...models.telescope import Telescope
from ...raytrace.rays import Projection
from ...wavefront.pupil_sampling import PupilSampling, SamplingName
from ...wavefront.request import Request
from .. import drawing
from ..result import FieldResult
from .principal_rays import principal_rays_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Origin of spots: centroid of the light, or landing point of the chief ray.
SpotReference = Literal["centroid", "chief"]
#: Half-width of the frame at most, in radii of 80 % of the rays: stray rays would hide the spots.
_FARTHEST = 5.0
#: Dots in one panel beyond which only every second, third... ray is drawn.
_DOTS = 6000


@dataclass(frozen=True)
class SpotDiagram(FieldResult):
    """Spots of several field points, all wavelengths together.

    Attributes
    ----------
    displacement : ndarray, shape [n_field, n_wave, n_pupil, 2]
        Landing points relative to `reference_point` [m], x and y of the detector; NaN where a ray does not arrive.
    weight : ndarray, shape [n_field, n_wave, n_pupil]
        Contribution of each ray to the light of its field: area of the pupil times weight of the wavelength, zero where
        the ray is vignetted. The sum over a field is the lit fraction of the pupil.
    reference_point : ndarray, shape [n_field, 2]
        Origin of the displacements on the detector [m]: centroid of the light, or landing point of the chief ray at the
        middle wavelength.
    plate_scale : ndarray, shape [n_field]
        Angle on the sky over length on the detector at each field [rad/m].
    airy_radius : ndarray, shape [n_field]
        Radius of the first dark ring of a clear circular pupil, 1.22 wavelengths times the focal ratio [m]; NaN for
        parallel light.
    """

    _table = (
        "fields",
        "rms_radius",
        "rms_xy",
        "geometric_radius",
        "airy_radius",
        "lit_fraction",
        "centroid",
        "reference_point",
        "plate_scale",
    )

    _on_image = (
        "displacement",
        "reference_point",
        "plate_scale",
        "airy_radius",
        "centroid",
        "rms_radius",
        "rms_xy",
        "geometric_radius",
    )

    displacement: np.ndarray
    weight: np.ndarray
    reference_point: np.ndarray
    plate_scale: np.ndarray
    airy_radius: np.ndarray

    @property
    def lit_fraction(self) -> np.ndarray:
        """Fraction of the entrance pupil that is lit, shape [n_field]."""
        return self.weight.sum(axis=(1, 2))

    @property
    def centroid(self) -> np.ndarray:
        """Centroid of the light relative to `reference_point` [m], shape [n_field, 2]."""
        return self._mean(self.displacement)

    @property
    def rms_radius(self) -> np.ndarray:
        """Root mean square distance from the centroid [m], shape [n_field]; NaN where no light arrives."""
        return np.sqrt(self.rms_xy[:, 0] ** 2 + self.rms_xy[:, 1] ** 2)

    @property
    def rms_xy(self) -> np.ndarray:
        """Root mean square distance from the centroid along x and y [m], shape [n_field, 2]."""
        return np.sqrt(self._mean(self._centered() ** 2))

    @property
    def geometric_radius(self) -> np.ndarray:
        """Largest distance of a lit ray from the centroid [m], shape [n_field]."""
        radius = np.where(self.weight > 0, np.linalg.norm(self._centered(), axis=-1), -np.inf)
        largest = radius.max(axis=(1, 2))
        return np.where(largest >= 0, largest, np.nan)

    @check_arguments
    def radius_holding(self, fraction: float = 0.8) -> np.ndarray:
        """Return the radius about the centroid that holds a fraction of the rays [m], shape [n_field].

        Diffraction is left out. In the order of their radii, rays stand in the middle of the light that they carry,
        those of equal radius together; between them the radius is interpolated.
        """
        if not 0 < fraction < 1:
            raise DomainError(f"fraction = {fraction!r}: expected a number between 0 and 1")
        radii = np.linalg.norm(self._centered(), axis=-1).reshape(len(self.fields), -1)
        weights = self.weight.reshape(len(self.fields), -1)
        quantiles = np.full(len(self.fields), np.nan)
        for i, (radius, weight) in enumerate(zip(radii, weights, strict=True)):
            order = np.argsort(radius[weight > 0], kind="stable")
            if len(order):
                distances, within = light_by_distance(radius[weight > 0][order], weight[weight > 0][order])
                quantiles[i] = np.interp(fraction, within, distances)
        return quantiles

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; lists run over the fields."""
        arcsec = arcseconds(self.plate_scale)
        sizes = {
            "rms_radius": self.rms_radius,
            "radius_80_percent": self.radius_holding(0.8),
            "geometric_radius": self.geometric_radius,
            "airy_radius": self.airy_radius,
        }
        return {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelengths * 1e9,
            "rays_per_field": int(np.prod(self.weight.shape[1:])),
            **self.field_items(),
            **self.on_image(
                {
                    "reference_mm": self.reference_point * 1e3,
                    "centroid_um": self.centroid * 1e6,
                    "rms_xy_um": self.rms_xy * 1e6,
                    **{f"{name}_um": value * 1e6 for name, value in sizes.items()},
                }
            ),
            **self.of_sky({f"{name}_arcsec": value * arcsec for name, value in sizes.items()}),
            **self.on_image(self.of_sky({"plate_scale_arcsec_per_um": arcsec * 1e-6})),
            "lit_fraction": self.lit_fraction,
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw a panel for each field, all on one scale, with the Airy disc and a scale bar."""
        radius = self.radius_holding(0.8)
        light = np.nanmax(self.geometric_radius, initial=0.0), _FARTHEST * np.nanmax(radius, initial=0.0)
        half = 1.08e6 * max(float(min(light)), float(np.nanmax(self.airy_radius, initial=1e-9)))
        with styled():
            figure, panels = drawing.panel_grid(ax, len(self.fields), 2.5, 3.0)
            for i, axes in enumerate(panels):
                _draw_spot(axes, self, i, half, radius[i])
            bar = round_length(0.7 * half)
            drawing.draw_scale_bar(panels[0], bar, self.size_text(bar * 1e-6, float(self.plate_scale[0])))
            for handle in filter(None, drawing.legend_below(figure, panels[0], markerscale=3.0).legend_handles):
                handle.set_alpha(1.0)
            return self._titled(figure, "spots about the centroid")

    def _mean(self, values: np.ndarray) -> np.ndarray:
        """Return the weighted mean of values [n_field, n_wave, n_pupil, 2] over the rays of each field."""
        lit_values = np.where(self.weight[..., None] > 0, values, 0.0)
        with np.errstate(invalid="ignore"):
            return np.einsum("fwp,fwpi->fi", self.weight, lit_values) / self.lit_fraction[:, None]

    def _centered(self) -> np.ndarray:
        return self.displacement - self.centroid[:, None, None]


@check_arguments
def spots(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    wavelength_weights: ArrayLike | None = None,
    sampling: SamplingName | PupilSampling | None = None,
    n_pupil: int | None = None,
    reference: SpotReference = "centroid",
    focal_plane: FocalPlane | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
) -> SpotDiagram:
    """Trace spot diagrams.

    Parameters
    ----------
    telescope, fields, wavelengths, wavelength_weights, sampling, n_pupil, projection, threads
        As in :meth:`pachon.Request.of`.
    reference : {"centroid", "chief"}
        Origin of the displacements: the centroid, or the chief ray of the middle wavelength.
    focal_plane : FocalPlane, optional
        CCD surfaces, as in :meth:`pachon.Request.on`; the nominal detector surface without it.

    Raises
    ------
    ConfigError
        If the reference is unknown, or a focal plane is given beside a request that has one.
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
    )
    return spot_diagram(request.on(focal_plane), reference)


def spot_diagram(request: Request, reference: SpotReference = "centroid") -> SpotDiagram:
    """Return the spot diagram of a request."""
    bundles = [request.bundles(float(w)) for w in request.wavelengths]
    principal = principal_rays_of(request)
    chief = bundles[request.middle_index].chief_landing()
    lit = np.stack([b.lit for b in bundles], axis=1)
    light = request.pupil_areas[:, None, None] * (request.weights[:, None] * request.pupil.weights)
    diagram = SpotDiagram(
        request=request,
        displacement=np.stack([b.landing() for b in bundles], axis=1) - chief[:, None, None],
        weight=np.where(lit, light, 0.0),
        reference_point=chief,
        plate_scale=principal.mean_plate_scale,
        airy_radius=1.22 * request.middle * np.where(np.isinf(ratio := principal.mean_f_number), np.nan, ratio),
    )
    if reference == "chief":
        return diagram
    centroid = diagram.centroid
    moved = diagram.displacement - centroid[:, None, None]
    return replace(diagram, displacement=moved, reference_point=chief + centroid)


def holding_radius(distance: np.ndarray, weight: np.ndarray, fraction: float) -> float:
    """Return the distance of the first ray, by distance, within which lies a fraction of the light."""
    order = np.argsort(distance, kind="stable")
    held = np.cumsum(weight[order])
    return float(distance[order][np.searchsorted(held, fraction * held[-1])])


def light_by_distance(distances: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of rays, ascending as they are given, and the fraction of the light within each.

    Rays stand in the middle of the light that they carry, those of equal distance but for rounding together.
    """
    starts = np.flatnonzero(np.diff(distances, prepend=-np.inf) > 1e-9 * distances[-1])
    held = np.add.reduceat(weights, starts)
    return distances[starts], (np.cumsum(held) - 0.5 * held) / held.sum()


def _draw_spot(axes: Axes, spots: SpotDiagram, i: int, half: float, radius: float) -> None:
    centered = (spots.displacement[i] - spots.centroid[i]) * 1e6
    names = [f"{w * 1e9:.4g} nm" for w in spots.wavelengths]
    colors = drawing.wavelength_colors(spots.wavelengths) if len(names) > 1 else [BLUE]
    step = -(-spots.weight[i].size // _DOTS)
    for xy, weight, name, color in zip(centered, spots.weight[i], names, colors, strict=True):
        lit = np.flatnonzero(weight > 0)[::step]
        axes.plot(*xy[lit].T, ".", markersize=1.6, markeredgewidth=0.0, color=color, alpha=0.7, label=name)
    drawing.draw_circle(axes, spots.airy_radius[i] * 1e6, color="black", style="-", label="Airy disc")
    drawing.draw_circle(axes, radius * 1e6, color=RED, style=(0, (4, 2)), label="80 % of the rays")
    drawing.bare_frame(axes, half)
    scale = float(spots.plate_scale[i])
    rms = spots.rms_radius[i]
    text = f"rms {spots.size_text(rms, scale)}\n80 % {spots.size_text(radius, scale)}"
    if not np.isfinite(rms):
        text = "no light arrives"
    elif spots.lit_fraction[i] < 0.995:
        text += f"\nlit {100 * spots.lit_fraction[i]:.1f} % of the pupil"
    beyond = float(spots.weight[i][np.abs(centered).max(axis=-1) > half].sum())
    if beyond > 0:
        text += f"\n{100 * beyond / spots.lit_fraction[i]:.2g} % of the rays beyond the frame"
    axes.set_title(spots.field_labels()[i], fontsize=9.5)
    axes.set_xlabel(text, fontsize=7.5)
