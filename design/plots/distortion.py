"""The picture of distortion: the sky as it lands on the detector, exaggerated, and in percent."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from ...core.plotting import BLUE, ORANGE, RED, new_figure, styled
from ..metrics.distortion import Distortion


def distortion_figure(result: Distortion) -> Figure:
    """Draw the exaggerated picture [mm] beside the distortion [percent] against the distance from the axis [deg]."""
    with styled():
        figure = new_figure(11.0, 5.2)
        picture, curve = figure.subplots(1, 2)
        _draw_picture(picture, result)
        _draw_percent(curve, result)
        figure.suptitle(
            f"{result.telescope}: distortion against f tan θ, {result.wavelength * 1e9:.4g} nm; "
            f"{'chief rays' if result.reference == 'chief' else 'centroids'}",
            fontsize=11,
        )
        return figure


def _draw_picture(axes: Axes, result: Distortion) -> None:
    predicted, shift = result.predicted * 1e3, result.shift * 1e3
    largest = float(np.linalg.norm(shift, axis=-1).max())
    extent = float(np.ptp(predicted, axis=0).max())
    # A round factor that makes the largest shift some 6 % of the picture.
    factor = 10.0 ** np.floor(np.log10(0.06 * extent / max(largest, 1e-12 * extent)))
    factor *= next(m for m in (5.0, 2.0, 1.0) if m * factor * largest <= 0.06 * extent or m == 1.0)
    lines = _neighbours(result.fields)
    if len(lines):
        axes.add_collection(LineCollection(list(predicted[lines]), colors="0.75", linewidths=0.7))
        moved = predicted + factor * shift
        axes.add_collection(LineCollection(list(moved[lines]), colors=BLUE, linewidths=0.9))
    else:
        axes.plot(*predicted.T, "+", color="0.6")
    axes.plot(*(predicted + factor * shift).T, ".", color=BLUE, markersize=3.0)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_xlabel("detector x [mm]")
    axes.set_ylabel("detector y [mm]")
    axes.set_title(f"shifts drawn {factor:,.0f} times as long; the largest is {largest * 1e3:.3g} µm", loc="left")


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
    radius = np.rad2deg(np.linalg.norm(result.fields, axis=-1))
    order = np.argsort(radius)
    axes.axhline(0.0, color="0.6", linewidth=0.7)
    for percent, color, label in (
        (result.percent, BLUE, f"scale that fits best, f = {result.focal_length:.5g} m"),
        (result.percent_of_axis_scale, ORANGE, f"scale at the axis, f = {result.axis_focal_length:.5g} m"),
    ):
        axes.plot(radius[order], percent[order], ".", color=color, markersize=4.5, label=label)
    worst = float(np.nanmax(np.abs(result.percent)))
    axes.set_title(f"largest against the best scale: {worst:.3g} %", loc="left", color=RED if worst > 1.0 else "black")
    axes.set_xlabel("distance from the axis [deg]")
    axes.set_ylabel("distortion [%]")
    axes.set_xlim(left=0.0)
    axes.grid(True, color="0.92", linewidth=0.6)
    axes.legend(loc="best")
