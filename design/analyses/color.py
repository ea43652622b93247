"""Colour: lateral colour against the field, and focus against the wavelength, paraxial and of zones of the pupil."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE, GREY, ORANGE, RED
from ...core.units import pure_numbers
from ...models.telescope import Telescope
from ...raytrace.rays import Projection
from ...wavefront.pupil_sampling import CHIEF_RAY
from ...wavefront.request import Request
from ..drawing import finish_axes, wavelength_colors
from ..metrics.principal_rays import image_axes, principal_rays_of
from .analysis import Analysis, Columns, band_wavelengths, line_request, require_focus
from .field_curvature import close_foci

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Zone of the pupil, in units of its radius, whose focus counts as paraxial.
_PARAXIAL = 1e-3
#: Zones of the pupil, in units of its radius, whose foci are traced by default.
_ZONES = (0.7, 1.0)
#: Wavelengths of the curve of the focus.
_WAVELENGTHS = 33


@dataclass(frozen=True)
class LateralColor(Analysis):
    """Landing points of the chief rays against the wavelength.

    Attributes
    ----------
    shift : ndarray, shape [n_field, n_wave]
        Landing point along the field less that of the middle wavelength [m]; positive farther from the axis where the
        image is upright, and where it is inverted closer to it: signs are those of the detector's own x and y.
    airy_radius : ndarray, shape [n_field]
        Radius of the first dark ring at the middle wavelength [m]; NaN for parallel light.
    """

    shift: np.ndarray
    airy_radius: np.ndarray

    @property
    def spread(self) -> np.ndarray:
        """Largest less smallest shift [m], shape [n_field]."""
        return np.asarray(np.ptp(self.shift, axis=1))

    @property
    def _title(self) -> str:
        return f"lateral colour against {self.request.middle * 1e9:.4g} nm"

    def _table_columns(self) -> Columns:
        return {
            **self._field_columns(1),
            "wavelength": (self.wavelengths * 1e9, "nm", "vacuum wavelength"),
            "shift": (self.shift * 1e6, self.image_unit("um"), "shift of the chief ray along the field"),
        }

    def _values(self) -> dict[str, Any]:
        return {
            "reference_nm": self.request.middle * 1e9,
            **self.on_image(
                {"shift_um": self.shift * 1e6, "spread_um": self.spread * 1e6, "airy_radius_um": self.airy_radius * 1e6}
            ),
        }

    def _draw(self, panels: Sequence[Axes]) -> None:
        (axes,) = panels
        distance, label = self.axis_distances()
        order = np.argsort(distance, kind="stable")
        for w, color in enumerate(wavelength_colors(self.wavelengths)):
            name = f"{self.wavelengths[w] * 1e9:.4g} nm"
            axes.plot(self.shift[order, w] * 1e6, distance[order], color=color, label=name)
        airy = self.airy_radius[order] * 1e6
        axes.plot(airy, distance[order], ":", color=GREY, linewidth=1.0, label="Airy disc")
        axes.plot(-airy, distance[order], ":", color=GREY, linewidth=1.0)
        xlabel = self.image_text("shift of the chief ray along the field [µm]")
        finish_axes(axes, ylim=(0.0, max(float(distance.max()), 1e-9)), xlabel=xlabel, ylabel=label)
        axes.legend(fontsize=7.5)


@dataclass(frozen=True)
class ChromaticFocus(Analysis):
    """Focus on the axis against the wavelength.

    Attributes
    ----------
    zones : ndarray, shape [n_zone]
        Radii of the zones of the pupil, 1 at the rim; the first, 0, is paraxial.
    focus : ndarray, shape [n_wave, n_zone]
        Place where the rays of a zone cross the axis [m], positive behind the detector as light travels.
    reference : float
        Paraxial focus at the telescope's default wavelength, on the same scale [m].
    depth : float
        Depth of focus at the default wavelength, plus and minus: 2 wavelengths times the focal ratio squared [m].
    """

    zones: np.ndarray
    focus: np.ndarray
    reference: float
    depth: float

    @property
    def shift(self) -> np.ndarray:
        """Focus less the paraxial one at the default wavelength [m], shape [n_wave, n_zone]."""
        return self.focus - self.reference

    @property
    def _title(self) -> str:
        return f"chromatic focal shift against {self.request.telescope.default_wavelength * 1e9:.4g} nm"

    def _table_columns(self) -> Columns:
        return {
            "wavelength": (self.wavelengths[:, None] * 1e9, "nm", "vacuum wavelength"),
            "zone": (self.zones, "", "pupil zone, 0 for paraxial rays and 1 for the rim"),
            "focus": (self.focus * 1e6, "um", "focus behind the detector, along the light"),
            "shift": (self.shift * 1e6, "um", "focus relative to that of the reference wavelength"),
        }

    def _values(self) -> dict[str, Any]:
        return {
            "reference_nm": self.request.telescope.default_wavelength * 1e9,
            "zones": self.zones,
            "focus_um": self.focus * 1e6,
            "shift_um": self.shift * 1e6,
            "largest_paraxial_shift_um": float(np.ptp(self.focus[:, 0])) * 1e6,
            "depth_of_focus_um": self.depth * 1e6,
        }

    def _draw(self, panels: Sequence[Axes]) -> None:
        (axes,) = panels
        scale, unit = (1e6, "µm") if np.abs(self.shift).max() < 1e-3 else (1e3, "mm")
        nm = self.wavelengths * 1e9
        for k, (zone, color) in enumerate(zip(self.zones, (BLUE, ORANGE, RED, GREY) * 9, strict=False)):
            label = f"zone {zone:g}" if zone else "paraxial"
            axes.plot(self.shift[:, k] * scale, nm, "-" if np.ptp(nm) else "o", color=color, label=label)
        if np.isfinite(self.depth):  # of light that is parallel along one direction there is none
            axes.axvspan(-self.depth * scale, self.depth * scale, color="0.92", label="depth of focus")
        axes.axvline(0.0, color="0.5", linewidth=0.7)
        # A single wavelength has no range.
        limits = {"ylim": (nm.min(), nm.max())} if np.ptp(nm) else {}
        finish_axes(axes, **limits, xlabel=f"focal shift [{unit}]", ylabel="wavelength [nm]")
        axes.legend()


@check_arguments
def lateral_color(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    projection: Projection | None = None,
    threads: int | None = None,
) -> LateralColor:
    """Trace lateral colour along the field.

    Parameters
    ----------
    telescope, projection, threads
        As in :meth:`pachon.Request.of`.
    fields : array_like or Quantity, shape [n_field, 2], optional
        Field angles [rad]; a line from the axis along +y to the edge of the field of view by default.
    wavelengths : array_like or Quantity, shape [n_wave], optional
        Vacuum wavelengths [m]; those of the telescope's file, or five across its band, by default.

    Raises
    ------
    DomainError
        If a chief ray does not reach the detector.
    """
    request = line_request(telescope, fields, band_wavelengths(telescope, wavelengths), projection, threads)
    point = np.zeros((1, 2))
    landing = np.stack([request.bundles(float(w), point).chief_landing() for w in request.wavelengths], axis=1)
    principal = principal_rays_of(request)
    along = np.einsum("fwi,fi->fw", landing, image_axes(request)[:, 0])
    shift = along - along[:, request.wavelengths == request.middle][:, :1]
    ratio = principal.mean_f_number
    return LateralColor(request, shift, 1.22 * request.middle * np.where(np.isinf(ratio), np.nan, ratio))


@check_arguments
def chromatic_focus(
    telescope: Telescope | Request,
    wavelengths: ArrayLike | None = None,
    *,
    zones: ArrayLike = _ZONES,
    threads: int | None = None,
) -> ChromaticFocus:
    """Trace the focus on the axis against the wavelength.

    Parameters
    ----------
    telescope, threads
        As in :meth:`pachon.Request.of`; a request has the wavelengths too, and its fields are not used.
    wavelengths : array_like or Quantity, shape [n_wave], optional
        Vacuum wavelengths [m]; 33 across the band by default.
    zones : array_like, shape [n_zone]
        Radii of zones of the pupil, above 0 and up to 1 at its rim, whose real rays are traced; paraxial rays always
        are.

    Raises
    ------
    DomainError
        If a zone is out of range, its rays miss the detector, or the light has no focus.
    """
    radii = np.atleast_1d(pure_numbers(zones, "zones"))
    if radii.ndim != 1 or not ((radii > 0) & (radii <= 1)).all():
        raise DomainError(f"zones = {zones!r}: expected a list of numbers above 0 and up to 1")
    focal_plane = None
    if isinstance(telescope, Request):
        stated = Request.of(telescope, None, wavelengths, threads=threads)
        telescope, wavelengths, threads = stated.telescope, stated.wavelengths, stated.threads
        focal_plane = stated.focal_plane
    if wavelengths is None:
        wavelengths = np.linspace(*(telescope.band or telescope.wavelength_range), _WAVELENGTHS)
    request = Request.of(telescope, (0.0, 0.0), wavelengths, sampling=CHIEF_RAY, threads=threads).on(focal_plane)
    traced = np.concatenate([[_PARAXIAL], radii]) * 0.5 * telescope.pupil_diameter
    up = np.stack([np.zeros_like(traced), traced], axis=-1)
    pairs = np.concatenate([up, -up])
    all_wavelengths = np.append(request.wavelengths, telescope.default_wavelength)
    focus = np.array([close_foci(request, request.bundles(float(w), pairs))[0] for w in all_wavelengths])
    require_focus(telescope, focus)
    principal = principal_rays_of(request)
    depth = 2.0 * telescope.default_wavelength * float(principal.mean_f_number[0]) ** 2
    return ChromaticFocus(request, np.concatenate([[0.0], radii]), focus[:-1], float(focus[-1, 0]), depth)
