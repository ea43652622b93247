"""Field curvature and distortion: foci of rays close to the chief ray, and its landing point against f tan(theta).

Rays through two points of the pupil on either side of its centre, along the field or across it, come closest to each
other at the tangential or sagittal focus. With ``X`` and ``d`` position and direction of the chief ray at the detector
and primes for their change over the pupil, that is at ``X + t d`` with ``t = -(X' . d') / (d' . d')``: the limit that
Coddington's equations give (Kingslake & Johnson, Lens Design Fundamentals, 2nd ed., section 11.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE
from ...core.units import field_label
from ...models.telescope import Telescope
from ...raytrace.rays import Projection, RayStatus
from ...wavefront.bundles import Bundles
from ...wavefront.request import Request
from ..drawing import finish_axes, wavelength_colors
from ..metrics.distortion import axis_scale
from ..metrics.principal_rays import tangential_axes
from .analysis import Analysis, Columns, line_request, require_focus

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Distance of the close rays from the centre of the pupil, in units of its radius: what spherical aberration does to
#: the focus goes with the square of it, a millionth of that at the rim.
_CLOSE = 1e-3


@dataclass(frozen=True)
class FieldCurvature(Analysis):
    """Tangential and sagittal foci, and distortion, against the field.

    Attributes
    ----------
    tangential, sagittal : ndarray, shape [n_field, n_wave]
        Place of the focus [m] along the axis of the detector, positive behind the detector as light travels; of the
        rays close to the chief ray, in and across the plane of field point and axis.
    distortion : ndarray, shape [n_field, n_wave]
        Landing point of the chief ray from the axis against the scale on the axis, along the field, times the tangent
        of the field angle, less 1 [percent]; 0 on the axis. Each wavelength has a scale of its own.
    focal_length : ndarray, shape [n_wave]
        That scale [m]: length on the detector over slope; geometric mean where it differs along x and y.
    """

    tangential: np.ndarray
    sagittal: np.ndarray
    distortion: np.ndarray
    focal_length: np.ndarray

    @property
    def astigmatism(self) -> np.ndarray:
        """Tangential minus sagittal focus [m], shape [n_field, n_wave]."""
        return self.tangential - self.sagittal

    @property
    def _title(self) -> str:
        return f"field curvature and distortion, {self._nanometres()}"

    @property
    def _panels(self) -> tuple[int, int, float, float]:
        return 1, 2, 9.0, 4.8

    def _table_columns(self) -> Columns:
        return {
            **self._field_columns(1),
            "wavelength": (self.wavelengths * 1e9, "nm", "vacuum wavelength"),
            "tangential_focus": (self.tangential * 1e6, "um", "tangential focus behind the detector"),
            "sagittal_focus": (self.sagittal * 1e6, "um", "sagittal focus behind the detector"),
            "distortion": (self.distortion, "percent", "distortion of the chief ray"),
        }

    def _values(self) -> dict[str, Any]:
        return {
            "tangential_focus_um": self.tangential * 1e6,
            "sagittal_focus_um": self.sagittal * 1e6,
            "distortion_percent": self.distortion,
            "largest_distortion_percent": float(np.nanmax(np.abs(self.distortion), initial=0.0)),
            "focal_length_m": self.focal_length,
        }

    def _draw(self, panels: Sequence[Axes]) -> None:
        distance, field_label = self.axis_distances()
        colors = wavelength_colors(self.wavelengths)
        largest = max(float(np.nanmax(np.abs([self.tangential, self.sagittal]))), 1e-9)
        scale, unit = (1e6, "µm") if largest < 1e-3 else (1e3, "mm")
        order = np.argsort(distance, kind="stable")
        for w, color in enumerate(colors if len(colors) > 1 else [BLUE]):
            name = f"{self.wavelengths[w] * 1e9:.4g} nm"
            panels[0].plot(self.tangential[order, w] * scale, distance[order], color=color, label=f"tangential, {name}")
            sagittal = self.sagittal[order, w] * scale
            panels[0].plot(sagittal, distance[order], color=color, linestyle="--", label=f"sagittal, {name}")
            panels[1].plot(self.distortion[order, w], distance[order], color=color, label=name)
        for axes, label in zip(panels, (f"focus behind the detector [{unit}]", "distortion [%]"), strict=True):
            axes.axvline(0.0, color="0.5", linewidth=0.7)
            finish_axes(axes, ylim=(0.0, max(float(distance.max()), 1e-9)), xlabel=label)
        panels[1].locator_params(axis="x", nbins=5)
        panels[0].set_ylabel(field_label)
        panels[0].legend(fontsize=7)


@check_arguments
def field_curvature(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    projection: Projection | None = None,
    threads: int | None = None,
) -> FieldCurvature:
    """Trace tangential and sagittal foci, and distortion.

    Parameters
    ----------
    telescope, wavelengths, projection, threads
        As in :meth:`pachon.Request.of`.
    fields : array_like or Quantity, shape [n_field, 2], optional
        Field angles [rad]; a line from the axis along +y to the edge of the field of view by default.

    Raises
    ------
    DomainError
        If a chief ray, or a ray close to it, does not reach the detector, or the light is parallel.
    """
    request = line_request(telescope, fields, wavelengths, projection, threads)
    telescope = request.telescope
    axes = tangential_axes(request)
    steps = _CLOSE * 0.5 * telescope.pupil_diameter * np.concatenate([axes, -axes], axis=1)
    foci, distortion, scales = [], [], []
    for wavelength in map(float, request.wavelengths):
        bundles = request.bundles(wavelength, steps)
        foci.append(close_foci(request, bundles))
        origin, jacobian = axis_scale(request, wavelength)
        slope = np.linalg.norm(request.slopes, axis=-1)
        height = np.linalg.norm(bundles.chief_landing() - origin, axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            undistorted = np.linalg.norm(request.slopes @ jacobian.T, axis=-1)
            # On the axis it is zero, the limit.
            distortion.append(np.where(slope > 1e-12, 100.0 * (height / undistorted - 1.0), 0.0))
        scales.append(float(np.sqrt(np.abs(np.linalg.det(jacobian)))))
    require_focus(telescope, np.array(foci))
    tangential, sagittal = np.moveaxis(np.array(foci), 0, -1).transpose(1, 0, 2)
    return FieldCurvature(request, tangential, sagittal, np.stack(distortion, axis=-1), np.array(scales))


def close_foci(request: Request, bundles: Bundles) -> np.ndarray:
    """Return foci of pairs of rays (first half of the rays with second half), shape [n_field, n_pair].

    They are places [m] along the axis of the detector, positive behind it as light travels.
    """
    lost = (bundles.status > RayStatus.VIGNETTED).any(axis=1)
    if lost.any():
        raise DomainError(f"{field_label(request.fields[lost][0])}: rays close to the chief ray miss the detector")
    half = bundles.position.shape[1] // 2
    moved = bundles.position[:, :half] - bundles.position[:, half:]
    turned = bundles.direction[:, :half] - bundles.direction[:, half:]
    with np.errstate(invalid="ignore", divide="ignore"):
        along = -(moved * turned).sum(axis=-1) / (turned**2).sum(axis=-1)
    return along * 0.5 * np.abs(bundles.direction[:, :half, 2] + bundles.direction[:, half:, 2])
