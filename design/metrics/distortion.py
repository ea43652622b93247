"""Distortion: landing points of stars against a scaled gnomonic picture of the sky, ``r = f tan(theta)``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE, ORANGE, RED, figure_at, styled
from ...core.units import field_label
from ...models.telescope import Telescope
from ...raytrace.rays import Projection
from ...wavefront.pupil_sampling import PupilSampling, SamplingName
from ...wavefront.request import Request
from ..drawing import finish_axes
from ..result import FieldResult
from .spots import SpotReference, spot_diagram

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Points across the field of view where none are given.
_ACROSS = 21
#: Step of the slopes for the scale on the axis.
_NEAR_AXIS = 1e-4


@dataclass(frozen=True)
class Distortion(FieldResult):
    """Landing points against a scaled picture of the sky.

    Attributes
    ----------
    reference : {"chief", "centroid"}
        Position of a star: landing point of its chief ray, or centroid of its light.
    position : ndarray, shape [n_field, 2]
        Landing points [m], x and y of the detector.
    predicted : ndarray, shape [n_field, 2]
        Best-fitting picture [m]: scaled, rotated, shifted and mirrored where necessary, but not distorted.
    center : ndarray, shape [2]
        Position of the axis in that picture [m].
    focal_length : float
        Scale of the picture, length on the detector over slope of the light [m/rad]. Where the image is at infinity it
        is the size of the angular magnification.
    axis_focal_length : float
        Scale at the axis itself [m/rad].
    """

    _table = ("fields", "position", "predicted", "shift", "percent", "percent_of_axis_scale")

    _on_image = ("position", "predicted", "shift")

    reference: SpotReference
    position: np.ndarray
    predicted: np.ndarray
    center: np.ndarray
    focal_length: float
    axis_focal_length: float

    @property
    def shift(self) -> np.ndarray:
        """Landing point minus scaled picture [m], shape [n_field, 2]."""
        return self.position - self.predicted

    @property
    def largest_shift(self) -> float:
        """Length of the largest shift [m]."""
        return float(np.linalg.norm(self.shift, axis=-1).max())

    @property
    def rms_shift(self) -> float:
        """Root mean square length of the shifts [m]."""
        return float(np.sqrt((self.shift**2).sum(axis=-1).mean()))

    @property
    def percent(self) -> np.ndarray:
        """Distortion against the best-fitting scale [percent of the distance from the axis]; NaN on the axis."""
        return self._percent(1.0)

    @property
    def percent_of_axis_scale(self) -> np.ndarray:
        """Distortion against the scale at the axis, the usual one of lens design [percent]; NaN on the axis."""
        return self._percent(self.axis_focal_length / self.focal_length)

    def _percent(self, scale: float) -> np.ndarray:
        ray, length = self.predicted - self.center, np.linalg.norm(self.predicted - self.center, axis=-1)
        away = length > 1e-9 * length.max(initial=1e-30)
        radial = ((self.position - self.center) * ray).sum(axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(away, 100.0 * (radial / (scale * length**2) - 1.0), np.nan)

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; lists run over the fields."""
        name = "angular_magnification" if self.in_angles else "focal_length_m"
        return {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelength * 1e9,
            "reference": self.reference,
            name: self.focal_length,
            f"axis_{name}": self.axis_focal_length,
            "largest_percent": float(np.nanmax(np.abs(self.percent), initial=0.0)),
            "largest_percent_of_axis_scale": float(np.nanmax(np.abs(self.percent_of_axis_scale), initial=0.0)),
            **self.on_image({"largest_shift_um": self.largest_shift * 1e6, "rms_shift_um": self.rms_shift * 1e6}),
            **self.field_items(),
            **self.on_image({"position_mm": self.position * 1e3, "predicted_mm": self.predicted * 1e3}),
            "percent": self.percent,
            "percent_of_axis_scale": self.percent_of_axis_scale,
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw the shifts, exaggerated, and the distortion [percent] against the distance from the axis."""
        with styled():
            figure = figure_at(ax, 11.0, 5.2)
            picture, curve = figure.subplots(1, 2)
            _draw_picture(picture, self)
            _draw_percent(curve, self)
            points = "chief rays" if self.reference == "chief" else "centroids"
            return self._titled(figure, f"distortion against f tan θ, {self._nanometres()}; {points}")


@check_arguments
def distortion(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelength: ArrayLike | None = None,
    *,
    reference: SpotReference = "chief",
    sampling: SamplingName | PupilSampling | None = None,
    n_pupil: int | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
) -> Distortion:
    """Compare landing points with a scaled picture of the sky.

    Parameters
    ----------
    telescope, fields, wavelength, sampling, n_pupil, projection, threads
        As in :meth:`pachon.Request.of`, but for the fields: at least three that do not lie on a line; a square lattice
        in the field of view by default. Only centroids depend on the pupil points.
    reference : {"chief", "centroid"}
        Position of a star: landing point of its chief ray, or centroid of its light.

    Raises
    ------
    ConfigError
        If the reference is unknown.
    DomainError
        If there are too few fields, or a star does not reach the detector.
    """
    request = Request.of(
        telescope,
        fields,
        wavelength,
        sampling=sampling,
        n_pupil=n_pupil,
        projection=projection,
        threads=threads,
        one_wavelength=True,
        default_fields=partial(field_lattice, across=_ACROSS),
    )
    slopes = request.slopes
    if len(slopes) < 3 or np.linalg.matrix_rank(slopes - slopes.mean(axis=0), tol=1e-9) < 2:
        expected = "expected at least three points that are not on a line"
        raise DomainError(f"fields of shape {request.fields.shape}: {expected}")
    position = _landing(request, reference)
    if not np.isfinite(position).all():
        lost = request.fields[~np.isfinite(position).all(axis=1)][0]
        raise DomainError(f"{field_label(lost)}: no light reaches the detector")
    scale, rotation, offset = _similarity(slopes, position)
    _, jacobian = axis_scale(request, request.wavelength)
    return Distortion(
        request=request,
        reference=reference,
        position=position,
        predicted=scale * slopes @ rotation.T + offset,
        center=offset,
        focal_length=scale,
        axis_focal_length=float(np.sqrt(np.abs(np.linalg.det(jacobian)))),
    )


def axis_scale(request: Request, wavelength: float) -> tuple[np.ndarray, np.ndarray]:
    """Return where the chief ray of the axis lands [m], shape [2], and the derivatives by slopes there [m], [2, 2].

    The derivatives are those of x and y of the detector (rows) by the slopes of the light.
    """
    ends = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    slopes = _NEAR_AXIS * np.concatenate([np.zeros((1, 2)), ends, 2.0 * ends])
    beside = replace(request.at_fields(slopes), projection="gnomonic")
    origin, *landing = beside.bundles(wavelength, np.zeros((1, 2))).chief_landing()
    pairs = np.reshape(landing, (2, 2, 2, 2))
    near, far = pairs[:, :, 0] - pairs[:, :, 1]
    # Distortion of third order adds to the scale with the square of the slope, which two slopes remove.
    return origin, (4.0 * near - 0.5 * far).T / (6.0 * _NEAR_AXIS)


def field_lattice(telescope: Telescope, across: int) -> np.ndarray:
    """Return the points of a square lattice, an odd number across, in the field of view [rad], shape [n, 2]."""
    if int(across) != across or across < 3 or across % 2 == 0:
        raise DomainError(f"across = {across!r}: expected an odd whole number of at least 3")
    u = np.linspace(-1.0, 1.0, int(across)) * telescope.field_radius
    x, y = np.meshgrid(u, u)
    # Rounding must not drop the four points on the rim.
    inside = np.hypot(x, y) <= telescope.field_radius * (1 + 1e-9)
    return np.stack([x[inside], y[inside]], axis=-1)


def _landing(request: Request, reference: SpotReference) -> np.ndarray:
    if reference == "chief":
        return request.bundles(request.wavelength, np.zeros((1, 2))).chief_landing()
    return np.concatenate([spot_diagram(batch).reference_point for _, batch in request.parts()])


def _similarity(slopes: np.ndarray, position: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return scale, rotation or reflection [2, 2] and offset of the best map from slopes to positions.

    Least squares after Schoenemann (1966, Psychometrika 31, 1).
    """
    mean_slope, mean_position = slopes.mean(axis=0), position.mean(axis=0)
    a, b = slopes - mean_slope, position - mean_position
    u, singular_values, vt = np.linalg.svd(b.T @ a)
    rotation = u @ vt
    scale = float(singular_values.sum() / (a**2).sum())
    return scale, rotation, mean_position - scale * rotation @ mean_slope


def _draw_picture(axes: Axes, result: Distortion) -> None:
    from matplotlib.collections import LineCollection

    predicted, shift = result.predicted * 1e3, result.shift * 1e3
    largest = result.largest_shift * 1e3
    extent = float(np.ptp(predicted, axis=0).max())
    # A round factor that makes the largest shift some 6 % of the picture.
    factor = 10.0 ** np.floor(np.log10(0.06 * extent / max(largest, 1e-12 * extent)))
    factor *= next(m for m in (5.0, 2.0, 1.0) if m * factor * largest <= 0.06 * extent or m == 1.0)
    moved, lines = predicted + factor * shift, _neighbours(result.fields)
    if len(lines):
        axes.add_collection(LineCollection(list(predicted[lines]), colors="0.75", linewidths=0.7))
        axes.add_collection(LineCollection(list(moved[lines]), colors=BLUE, linewidths=0.9))
    else:
        axes.plot(*predicted.T, "+", color="0.6")
        axes.add_collection(LineCollection(list(np.stack([predicted, moved], axis=1)), colors=BLUE, linewidths=0.9))
    axes.plot(*moved.T, ".", color=BLUE, markersize=3.0)
    x, y = ("tan x [mrad]", "tan y [mrad]") if result.in_angles else ("detector x [mm]", "detector y [mm]")
    axes.set(aspect="equal", xlabel=x, ylabel=y)
    axes.autoscale_view()
    text = result.image_text(f"{largest * 1e3:.3g} µm")
    axes.set_title(f"shifts drawn {factor:,.0f} times as long; the largest is {text}", loc="left")


def _neighbours(fields: np.ndarray) -> np.ndarray:
    """Return pairs of indices of fields that are neighbours along x or y on a square lattice, shape [n, 2]."""
    gaps = np.linalg.norm(fields[:, None] - fields[None], axis=-1)
    step = gaps[gaps > 1e-12].min()
    first, second = np.nonzero(np.triu(np.abs(gaps - step) < 1e-6 * step))
    along = np.abs(fields[first] - fields[second]).min(axis=1) < 1e-6 * step
    pairs = np.stack([first[along], second[along]], axis=-1)
    # Points of no lattice have few neighbours at just the same distance: then no lines.
    return pairs if len(pairs) >= len(fields) else pairs[:0]


def _draw_percent(axes: Axes, result: Distortion) -> None:
    radius, distance = result.axis_distances()
    order = np.argsort(radius)
    axes.axhline(0.0, color="0.6", linewidth=0.7)
    name, unit = ("magnification", "") if result.in_angles else ("f =", " m")
    for percent, color, label in (
        (result.percent, BLUE, f"scale that fits best, {name} {result.focal_length:.5g}{unit}"),
        (result.percent_of_axis_scale, ORANGE, f"scale at the axis, {name} {result.axis_focal_length:.5g}{unit}"),
    ):
        axes.plot(radius[order], percent[order], ".", color=color, markersize=4.5, label=label)
    worst = float(np.nanmax(np.abs(result.percent)))
    axes.set_title(f"largest against the best scale: {worst:.3g} %", loc="left", color=RED if worst > 1.0 else "black")
    finish_axes(axes, xlabel=distance, ylabel="distortion [%]", xlim=(0.0, None))
    axes.legend(loc="best")
