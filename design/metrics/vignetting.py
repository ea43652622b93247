"""Vignetting: fraction of the entrance pupil whose light reaches the detector, against field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE, figure_at, figure_of, styled
from ...core.units import require_count
from ...models.telescope import Telescope
from ...raytrace.rays import Projection
from ...wavefront.request import Request
from ..drawing import draw_field_map, finish_axes, spread_in_field
from ..result import FieldResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Rings of field points where none are given.
_RINGS = 14
#: Spokes of field points where none are given.
_SPOKES = 24
#: Largest lower end of the plots [%], so that the scatter of a telescope without vignetting is no structure.
_LEAST = 95.0


@dataclass(frozen=True)
class Vignetting(FieldResult):
    """Fraction of the entrance pupil whose light reaches the detector.

    Attributes
    ----------
    lit_fraction : ndarray, shape [n_field]
        Fraction of the area of the entrance pupil, the annulus of its diameter and obscuration, whose light reaches the
        detector. The cosine of the field angle, with which the light of a field also goes, is not in it.
    error : ndarray, shape [n_field]
        Estimated standard error of `lit_fraction` from the finite number of rays.
    axis_fraction : float
        Lit fraction on the axis.
    """

    _table = ("fields", "off_axis_angle", "lit_fraction", "error", "relative")

    lit_fraction: np.ndarray
    error: np.ndarray
    axis_fraction: float

    @property
    def relative(self) -> np.ndarray:
        """Light relative to the axis, shape [n_field]."""
        return self.lit_fraction / self.axis_fraction

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; lists run over the fields."""
        return {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelength * 1e9,
            "axis_fraction": self.axis_fraction,
            "smallest_relative": float(self.relative.min()),
            "largest_error": float(self.error.max()),
            **self.field_items(),
            "radius_deg": np.rad2deg(self.off_axis_angle),
            "fraction": self.lit_fraction,
            "error": self.error,
            "relative": self.relative,
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw the light relative to the axis against the distance from it and, where fields suffice, as a map."""
        with_map = spread_in_field(self.fields)
        with styled():
            figure = figure_at(ax, 11.0 if with_map else 6.5, 4.6)
            panels = figure.subplots(1, 2 if with_map else 1, squeeze=False)[0]
            _draw_profile(panels[0], self)
            if with_map:
                _draw_map(panels[1], self)
            lit = f"on the axis {100 * self.axis_fraction:.1f} % of the annular pupil is lit"
            return self._titled(figure, f"vignetting at {self._nanometres()}; {lit}")


@check_arguments
def vignetting(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelength: ArrayLike | None = None,
    *,
    n_pupil: int = 16384,
    projection: Projection | None = None,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Vignetting:
    """Trace the lit fraction of the entrance pupil, field by field.

    Points of equal weight fill the annulus of the pupil. Every fourth of them is a sampling of its own; half the
    standard deviation of the four estimates is the error.

    Parameters
    ----------
    telescope, fields, wavelength, projection, threads
        As in :meth:`pachon.Request.of`; by default fields lie on rings and spokes over the field of view.
    n_pupil : int
        Rays of each field, at least 16.
    progress : callable, optional
        Called with the number of fields done since the last call; the axis counts as one.

    Raises
    ------
    DomainError
        If the number of rays is out of range, or no light reaches the detector on the axis.
    """
    n_pupil = require_count(n_pupil, "n_pupil", 16)
    # A multiple of four, so that the four parts are equally large.
    count = 4 * (n_pupil // 4)
    request = Request.of(
        telescope,
        fields,
        wavelength,
        sampling="spiral",
        n_pupil=count,
        projection=projection,
        threads=threads,
        one_wavelength=True,
        default_fields=field_disc,
    )
    telescope = request.telescope
    with_axis = request.at_fields(np.concatenate([np.zeros((1, 2)), request.fields]))
    if request.vignetting is not None:
        with_axis = replace(with_axis, vignetting=np.pad(request.vignetting, ((1, 0), (0, 0))))
    quarters = np.empty((len(with_axis.fields), 4))
    for rows, batch in with_axis.parts():
        lit = batch.bundles(request.wavelength).lit
        quarters[rows] = batch.pupil_areas[:, None] * lit.reshape(len(lit), -1, 4).mean(axis=1)
        if progress is not None:
            progress(len(lit))
    fraction = quarters.mean(axis=1)
    if not fraction[0] > 0:
        raise DomainError(f"telescope {telescope.name}: expected one with light on the axis; all of it is vignetted")
    return Vignetting(request, fraction[1:], 0.5 * quarters[1:].std(axis=1, ddof=1), float(fraction[0]))


def field_disc(telescope: Telescope, rings: int = _RINGS, spokes: int = _SPOKES) -> np.ndarray:
    """Return the axis and rings of equal spacing out to the edge of the field of view [rad], shape [n, 2]."""
    radius = telescope.field_radius * np.arange(1, rings + 1)[:, None] / rings
    angle = 2.0 * np.pi * np.arange(spokes) / spokes
    disc = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)
    return np.concatenate([np.zeros((1, 2)), disc])


def _draw_profile(axes: Axes, result: Vignetting) -> None:
    radius, label = result.axis_distances()
    percent = 100.0 * result.relative
    axes.errorbar(
        radius,
        percent,
        100.0 * result.error / result.axis_fraction,
        fmt=".",
        color=BLUE,
        ecolor="0.6",
        elinewidth=0.7,
        markersize=3.5,
        label="field points, with their errors",
    )
    rounded = np.round(radius, 6)
    rings = np.unique(rounded)
    if len(rings) < len(radius):
        axes.plot(rings, [percent[rounded == r].mean() for r in rings], color=BLUE, linewidth=1.3, label="mean")
    axes.axhline(100.0, color="0.6", linewidth=0.7)
    finish_axes(
        axes,
        xlim=(0.0, None),
        ylim=(min(_LEAST, float(percent.min())) - 1.0, max(100.0, float(percent.max())) + 1.0),
        xlabel=label,
        ylabel="light relative to the axis [%]",
    )
    axes.legend(loc="lower left")


def _draw_map(axes: Axes, result: Vignetting) -> None:
    places, name, unit = result.field_places()
    percent = 100.0 * result.relative
    lowest, highest = min(_LEAST, float(percent.min())), max(100.0, float(percent.max()))
    image = draw_field_map(axes, places, percent, cmap="viridis", vmin=lowest, vmax=highest)
    axes.set(xlabel=f"{name} x [{unit}]", ylabel=f"{name} y [{unit}]")
    figure_of(axes).colorbar(image, ax=axes, fraction=0.046, pad=0.02).set_label("light relative to the axis [%]")
