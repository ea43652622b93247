"""Picture of a telescope before and after an optimisation: sections, and spots on a scale of their own each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...models.telescope import Telescope
from ...wavefront.request import Request
from ..drawing import bare_frame, field_text, wavelength_colors
from ..layout.layout import draw_section, layout
from ..metrics.spots import spot_diagram

if TYPE_CHECKING:
    from matplotlib.figure import SubFigure

#: Field points whose spots are drawn.
_SPOTS = 5
#: Rings of pupil points of a spot.
_RINGS = 8


def draw_before_after(
    figure: SubFigure,
    telescopes: tuple[Telescope, Telescope],
    fields: np.ndarray,
    wavelengths: np.ndarray,
    vignetting: np.ndarray | None = None,
) -> None:
    """Draw the sections of two telescopes side by side, and below them their spots at some field points."""
    field_indices = np.unique(np.linspace(0, len(fields) - 1, _SPOTS).astype(int))
    shown, factors = fields[field_indices], None if vignetting is None else vignetting[field_indices]
    parts: Any = figure.subfigures(2, 1)
    sections, spots = parts
    middle = float(wavelengths[len(wavelengths) // 2])
    for axes, telescope, name in zip(sections.subplots(1, 2), telescopes, ("before", "after"), strict=True):
        draw_section(axes, layout(*with_fields(telescope, shown, factors), middle))
        # A title would stand among the names of the surfaces.
        axes.set_ylabel(f"{name}\n{axes.get_ylabel()}")
    stated = [with_fields(t, shown, factors) for t in telescopes]
    diagrams = [spot_diagram(Request.of(*args, wavelengths, sampling="rings", n_pupil=_RINGS)) for args in stated]
    # Rings are to look at: their rms is one to two per cent off that of the analysis of spots.
    measured = [spot_diagram(Request.of(*args, wavelengths)) for args in stated]
    panels = spots.subplots(2, len(shown), squeeze=False)
    for row, diagram, numbers, name in zip(panels, diagrams, measured, ("before", "after"), strict=True):
        half = 1.1e6 * float(np.nanmax(diagram.geometric_radius, initial=1e-9))
        colors = wavelength_colors(wavelengths)
        for i, axes in enumerate(row):
            centered = (diagram.displacement[i] - diagram.centroid[i]) * 1e6
            for xy, weight, color in zip(centered, diagram.weight[i], colors, strict=True):
                axes.plot(*xy[weight > 0].T, ".", markersize=1.6, markeredgewidth=0.0, color=color)
            bare_frame(axes, half)
            axes.set_title(field_text(shown[i]), fontsize=8)
            axes.set_xlabel(diagram.image_text(f"rms {numbers.rms_radius[i] * 1e6:.3g} µm"), fontsize=7.5)
        row[0].set_ylabel(diagram.image_text(f"{name}, ±{half:.3g} µm"), fontsize=7.5)


def with_fields(
    telescope: Telescope, fields: np.ndarray, vignetting: np.ndarray | None
) -> tuple[Telescope, np.ndarray | None]:
    """Return a telescope and field points; its own if they have vignetting factors, which others have not."""
    if vignetting is None or telescope.design_data.telecentric:
        return telescope, fields
    rows = tuple(map(tuple, vignetting.tolist()))
    points = tuple(map(tuple, fields.tolist()))
    stated = telescope.with_design(field_type="angle", fields=points, field_weights=(), vignetting=rows)
    return stated, None
