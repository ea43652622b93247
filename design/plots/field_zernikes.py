"""Pictures of Zernike coefficients over the field of view."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure

from ...core.plotting import BLUE, ORANGE, figure_of, new_figure, styled
from ...models.zernike_polynomials import NOLL_NAMES
from ..drawing import FEW, draw_field_map, field_colors, field_label, spread_in_field
from ..metrics.field_zernikes import DoubleZernikes, FieldZernikes

#: Maps of single terms in one picture.
_MAPS = 8


def term_label(j: int) -> str:
    """Return Noll index and name of a term."""
    return f"{j} {NOLL_NAMES.get(j, '')}".strip()


def field_zernikes_figure(result: FieldZernikes) -> Figure:
    """Draw bars of the terms from defocus on [nm], field by field or as rms over many, and maps of the largest."""
    j = np.arange(4, result.coefficients.shape[1] + 1)
    values = result.coefficients[:, 3:] * 1e9
    with_maps = spread_in_field(result.fields) and len(j) > 0
    with styled():
        figure = new_figure(11.0, 8.6 if with_maps else 4.8)
        title = (
            f"{result.telescope}: annular Zernikes over the {result.pupil} pupil, obscuration {result.obscuration:g}, "
            f"{result.wavelength * 1e9:.4g} nm"
        )
        figure.suptitle(title, fontsize=11)
        if with_maps:
            parts: Any = figure.subfigures(2, 1, height_ratios=(1.0, 1.35))
            bars = parts[0].subplots()
            _draw_maps(parts[1], result, j)
        else:
            bars = figure.subplots()
        if len(result.fields) <= FEW:
            width = 0.85 / len(result.fields)
            colors = field_colors(len(result.fields))
            for i, (row, field, color) in enumerate(zip(values, result.fields, colors, strict=True)):
                offset = (i - 0.5 * (len(result.fields) - 1)) * width
                bars.bar(j + offset, row, width, color=color, label=field_label(field))
            bars.set_ylabel("coefficient = rms over the annulus [nm]")
            bars.legend(loc="best", ncols=2)
        else:
            bars.bar(j, np.sqrt((values**2).mean(axis=0)), 0.75, color=BLUE)
            bars.set_ylabel("rms over the fields [nm]")
        name_terms(bars, j)
        return figure


def name_terms(axes: Axes, j: np.ndarray) -> None:
    """Label an axis of Noll indices."""
    axes.axhline(0.0, color="0.3", linewidth=0.7)
    if len(j) <= 45:
        axes.set_xticks(j, [term_label(int(n)) for n in j], rotation=60, ha="right", rotation_mode="anchor")
    axes.set_xlabel("Noll index")
    axes.grid(True, axis="y", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def _draw_maps(figure: Any, result: FieldZernikes, j: np.ndarray) -> None:
    sizes = np.sqrt((result.coefficients[:, 3:] ** 2).mean(axis=0))
    largest = np.sort(j[np.argsort(-sizes, kind="stable")[:_MAPS]])
    panels = figure.subplots(2, _MAPS // 2, sharex=True, sharey=True).ravel()
    for axes in panels[len(largest) :]:
        axes.set_axis_off()
    for axes, n in zip(panels, largest, strict=False):
        nm = result.coefficients[:, n - 1] * 1e9
        edge = max(float(np.abs(nm).max()), 1e-6)
        image = draw_field_map(axes, result.fields, nm, cmap="RdBu_r", vmin=-edge, vmax=edge)
        figure.colorbar(image, ax=axes, fraction=0.046, pad=0.02).ax.tick_params(labelsize=7)
        axes.set_title(f"{term_label(int(n))} [nm]", fontsize=9)
    figure.supxlabel("field x [deg]", fontsize=9)
    figure.supylabel("field y [deg]", fontsize=9)


def double_zernikes_figure(result: DoubleZernikes) -> Figure:
    """Draw the coefficients [nm] as a picture, pupil terms across and field terms up, over the sizes of the former."""
    nm = result.coefficients[:, 3:] * 1e9
    j, k = np.arange(4, nm.shape[1] + 4), np.arange(1, nm.shape[0] + 1)
    nodes = result.at_nodes
    with styled():
        figure = new_figure(11.0, 8.8)
        table, bars = figure.subplots(2, 1, height_ratios=(1.7, 1.0), sharex=True)
        largest = max(float(np.abs(nm).max(initial=0.0)), 1e-6)
        norm = SymLogNorm(largest / 100.0, vmin=-largest, vmax=largest)
        image = table.imshow(nm, cmap="RdBu_r", norm=norm, aspect="auto", extent=(3.5, j[-1] + 0.5, 0.5, k[-1] + 0.5))
        table.set_yticks(k, [term_label(int(n)) for n in k], fontsize=7)
        table.set_ylabel("Noll index in the field")
        figure_of(table).colorbar(image, ax=table, fraction=0.03, pad=0.01).set_label("coefficient [nm]")
        bars.bar(j, np.sqrt((nm**2).sum(axis=0)), 0.75, color=BLUE, label="rms over the field")
        bars.plot(j, result.residual_rms[3:] * 1e9, "_", color=ORANGE, markersize=9, label="left by the field's terms")
        bars.set_ylabel("size of the term [nm]")
        bars.legend(loc="upper right")
        name_terms(bars, j)
        bars.set_xlabel("Noll index in the pupil")
        figure.suptitle(
            f"{nodes.telescope}: double Zernikes, pupil ({nodes.pupil}, obscuration {nodes.obscuration:g}) times field "
            f"(radius {np.rad2deg(result.field_radius):.4g}°), {nodes.wavelength * 1e9:.4g} nm",
            fontsize=11,
        )
        return figure
