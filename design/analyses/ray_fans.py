"""Ray fans and OPD fans: transverse aberration and optical path difference along two diameters of the pupil."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE
from ...core.units import length, require_count, require_within
from ...models.telescope import Telescope
from ...raytrace.ideal_lens import require_image
from ...raytrace.rays import Projection
from ...wavefront.bundles import Bundles
from ...wavefront.pupil_sampling import CHIEF_RAY
from ...wavefront.request import Request
from ..drawing import finish_axes, wavelength_colors
from ..metrics.principal_rays import image_axes, tangential_axes
from .analysis import Analysis, Columns

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FANS = ("tangential", "sagittal")
#: Radii of reference spheres of fans, with either sign [m].
_SPHERE_RADII = (1e-6, 1e15)


@dataclass(frozen=True)
class Fans(Analysis):
    """Base of both kinds of fans.

    Attributes
    ----------
    pupil : ndarray, shape [n]
        Pupil coordinate along the diameters, -1 and 1 at the rim. The tangential diameter is along the field (y on the
        axis), the sagittal one across it.
    lit : ndarray of bool, shape [n_field, n_wave, 2, n]
        Mask of the rays that no aperture stops; the axis of two is tangential, sagittal.
    """

    pupil: np.ndarray
    lit: np.ndarray

    @property
    def _panels(self) -> tuple[int, int, float, float]:
        return len(self.fields), 2, 8.5, 0.9 + 1.8 * len(self.fields)

    def _fan_columns(self) -> Columns:
        return {
            **self._field_columns(3),
            "wavelength": (self.wavelengths[:, None, None] * 1e9, "nm", "vacuum wavelength"),
            "fan": (np.array(FANS)[:, None], "", "diameter of the pupil"),
            "pupil": (self.pupil, "", "pupil coordinate, 1 at the rim"),
            "lit": (self.lit, "", "whether light passes"),
        }

    def _draw_curves(self, panels: Sequence[Axes], values: np.ndarray, names: Sequence[str]) -> None:
        """Draw values [n_field, n_wave, 2, n] where light passes, all panels on one scale."""
        shown = np.where(self.lit, values, np.nan)
        half = 1.08 * max(float(np.nanmax(np.abs(shown), initial=0.0)), 1e-6)
        colors = wavelength_colors(self.wavelengths) if len(self.wavelengths) > 1 else [BLUE]
        for i, field in enumerate(self.field_labels()):
            for k, name in enumerate(names):
                axes = panels[2 * i + k]
                for w, color in enumerate(colors):
                    label = f"{self.wavelengths[w] * 1e9:.4g} nm"
                    axes.plot(self.pupil, shown[i, w, k], color=color, linewidth=1.2, label=label)
                axes.axhline(0.0, color="0.5", linewidth=0.6)
                axes.axvline(0.0, color="0.5", linewidth=0.6)
                finish_axes(axes, xlim=(-1, 1), ylim=(-half, half))
                axes.set_ylabel(name, fontsize=8)
                axes.set_title(f"{FANS[k]}, {field}", loc="left", fontsize=8.5)
        for axes in panels[-2:]:
            axes.set_xlabel("pupil coordinate")
        if len(colors) > 1:
            panels[0].legend(fontsize=6.5, loc="best", handlelength=1.0, labelspacing=0.2)


@dataclass(frozen=True)
class RayFans(Fans):
    """Transverse aberrations along two diameters of the pupil.

    Attributes
    ----------
    displacement : ndarray, shape [n_field, n_wave, 2, n, 2]
        Landing points relative to the chief ray of the middle wavelength [m]; the last axis is along the image
        of the field and across it, on the detector. NaN where a ray does not arrive.
    """

    displacement: np.ndarray

    @property
    def along(self) -> np.ndarray:
        """Displacement along each fan's own direction [m], shape [n_field, n_wave, 2, n]."""
        return np.stack([self.displacement[:, :, k, :, k] for k in range(2)], axis=2)

    @property
    def largest(self) -> np.ndarray:
        """Largest displacement of a lit ray along its fan, tangential and sagittal [m], shape [n_field, 2]."""
        size = np.where(self.lit, np.abs(self.along), -np.inf).max(axis=(1, 3))
        return np.where(size >= 0, size, np.nan)

    @property
    def _title(self) -> str:
        return f"ray fans, {self._nanometres()}"

    def _table_columns(self) -> Columns:
        unit = "urad" if self.in_angles else "um"
        shift = {
            "along_field": (self.displacement[..., 0] * 1e6, unit, "transverse aberration along the field"),
            "across_field": (self.displacement[..., 1] * 1e6, unit, "transverse aberration across the field"),
        }
        return self._fan_columns() | shift

    def _values(self) -> dict[str, Any]:
        return {
            "pupil": self.pupil,
            **self.on_image(
                {
                    "largest_um": self.largest * 1e6,
                    "tangential_um": self.along[:, :, 0] * 1e6,
                    "sagittal_um": self.along[:, :, 1] * 1e6,
                }
            ),
            "lit": self.lit,
        }

    def _draw(self, panels: Sequence[Axes]) -> None:
        self._draw_curves(panels, self.along * 1e6, [self.image_text(t) for t in ("along field [µm]", "across [µm]")])


@dataclass(frozen=True)
class OpdFans(Fans):
    """Optical path differences along two diameters of the pupil.

    Attributes
    ----------
    value : ndarray, shape [n_field, n_wave, 2, n]
        Path of the chief ray minus path of the ray [m], to a sphere about where the chief ray of the same wavelength
        meets the detector; NaN where a ray does not arrive.
    radius : float
        Radius of the reference sphere [m], negative where it lies in front of the detector.
    """

    value: np.ndarray
    radius: float

    @property
    def waves(self) -> np.ndarray:
        """OPD in waves of each wavelength, shape [n_field, n_wave, 2, n]."""
        return self.value / self.wavelengths[:, None, None]

    @property
    def peak_to_valley(self) -> np.ndarray:
        """Highest minus lowest OPD over the lit rays of both fans [m], shape [n_field, n_wave]; NaN without light."""
        high = np.where(self.lit, self.value, -np.inf).max(axis=(2, 3))
        low = np.where(self.lit, self.value, np.inf).min(axis=(2, 3))
        return np.where(high >= low, high - low, np.nan)

    @property
    def _title(self) -> str:
        return f"OPD fans, {self._nanometres()}"

    def _table_columns(self) -> Columns:
        return self._fan_columns() | {"opd": (self.value * 1e9, "nm", "optical path difference")}

    def _values(self) -> dict[str, Any]:
        return {
            "pupil": self.pupil,
            # A plane wave where the image is at infinity.
            "reference_sphere_m": None if self.in_angles else self.radius,
            "peak_to_valley_waves": self.peak_to_valley / self.wavelengths,
            "tangential_waves": self.waves[:, :, 0],
            "sagittal_waves": self.waves[:, :, 1],
            "lit": self.lit,
        }

    def _draw(self, panels: Sequence[Axes]) -> None:
        self._draw_curves(panels, self.waves, ("OPD [waves]", "OPD [waves]"))


@check_arguments
def ray_fans(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    n_points: int = 65,
    projection: Projection | None = None,
    threads: int | None = None,
) -> RayFans:
    """Trace ray fans, tangential and sagittal.

    Parameters
    ----------
    telescope, fields, wavelengths, projection, threads
        As in :meth:`pachon.Request.of`.
    n_points : int
        Rays along each diameter of the pupil, at least 3.

    Raises
    ------
    DomainError
        If there are too few rays.
    """
    request, pupil, bundles = _traced(telescope, fields, wavelengths, n_points, projection, threads)
    n, axes = len(request.fields), image_axes(request)
    chief = bundles[request.middle_index].chief_landing()
    landing = np.stack([b.landing() - chief[:, None] for b in bundles], axis=1).reshape(n, len(bundles), 2, -1, 2)
    return RayFans(request, pupil, _lit(bundles), np.einsum("fwkpi,fji->fwkpj", landing, axes))


@check_arguments
def opd_fans(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    n_points: int = 65,
    sphere_radius: ArrayLike | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
) -> OpdFans:
    """Trace OPD fans, tangential and sagittal.

    Parameters
    ----------
    telescope, fields, wavelengths, projection, threads
        As in :meth:`pachon.Request.of`.
    n_points : int
        Rays along each diameter of the pupil, at least 3.
    sphere_radius : float or Quantity, optional
        Radius of the reference sphere [m], which lies beyond the detector or, if negative, in front of it; the
        telescope's own by default. For the sphere through the exit pupil, as in Zemax, the distance from the detector
        to the exit pupil.

    Raises
    ------
    DomainError
        If there are too few rays, or the radius is zero or not finite.
    """
    request, pupil, bundles = _traced(telescope, fields, wavelengths, n_points, projection, threads)
    telescope = request.telescope
    radius = telescope.sphere_radius
    if sphere_radius is not None:
        require_image(telescope, "a sphere_radius")
        radius = length(sphere_radius, "sphere_radius")
        require_within(abs(radius), "sphere_radius", *_SPHERE_RADII, "metres")
    value = np.stack([b.opd(radius) for b in bundles], axis=1).reshape(len(request.fields), len(bundles), 2, -1)
    lit = _lit(bundles)
    if not np.isfinite(value[lit]).all():
        raise DomainError(f"sphere_radius = {radius:g} m: rays miss the sphere; expected a larger one")
    return OpdFans(request, pupil, lit, value, radius)


def _traced(
    telescope: Telescope | Request,
    fields: ArrayLike | None,
    wavelengths: ArrayLike | None,
    n_points: int,
    projection: Projection | None,
    threads: int | None,
) -> tuple[Request, np.ndarray, list[Bundles]]:
    """Return request, pupil coordinates [n] and bundles of both fans, tangential first."""
    count = require_count(n_points, "n_points", 3, 100_000)
    request = Request.of(telescope, fields, wavelengths, sampling=CHIEF_RAY, projection=projection, threads=threads)
    telescope = request.telescope
    pupil, axes = np.linspace(-1.0, 1.0, count), tangential_axes(request)
    points = 0.5 * telescope.pupil_diameter * pupil[:, None] * axes[:, :, None]
    points = points.reshape(len(axes), -1, 2)
    return request, pupil, [request.bundles(float(w), points) for w in request.wavelengths]


def _lit(bundles: list[Bundles]) -> np.ndarray:
    return np.stack([b.lit for b in bundles], axis=1).reshape(len(bundles[0].lit), len(bundles), 2, -1)
