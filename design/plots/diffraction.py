"""The picture of diffraction images: a panel for each field on one logarithmic scale, and cuts through them."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from ...core.plotting import new_figure, styled
from ..drawing import draw_circle, draw_scale_bar, field_colors, field_label, round_length
from ..images.diffraction import DiffractionPsf

#: Decades below the brightest pixel that the images show.
_DECADES = 4.0
#: Panels in a row; cuts are drawn of one row.
_MOST = 5


def diffraction_figure(psf: DiffractionPsf) -> Figure:
    """Draw diffraction images, each over its own brightest pixel, and below them cuts along x and y."""
    count = len(psf.fields)
    rows = -(-count // _MOST)
    columns = -(-count // rows)
    with styled():
        figure = new_figure(max(2.3 * columns + 0.9, 6.4), 2.95 * rows + 2.9)
        parts: Any = figure.subfigures(2, 1, height_ratios=[2.8 * rows + 0.4, 2.6])
        above, below = parts
        panels = above.subplots(rows, columns, squeeze=False).ravel()
        for axes in panels[count:]:
            axes.set_axis_off()
        image: Any = None
        for i, axes in enumerate(panels[:count]):
            image = _draw_image(axes, psf, i)
        half = 0.5e6 * psf.pixel * psf.image.shape[-1]
        bar = round_length(0.6 * half)
        draw_scale_bar(panels[0], bar, f'{bar:g} µm = {_arcsec(psf, 0) * bar * 1e-6:.3g}"')
        _whiten(panels[0])
        key = above.colorbar(image, ax=list(panels), shrink=0.85, pad=0.015, aspect=30)
        key.set_label("light over that of\nthe brightest pixel")
        waves = ", ".join(f"{w * 1e9:.4g}" for w in psf.wavelengths)
        way = "Fourier sum" if psf.method == "fft" else "Huygens' wavelets"
        figure.suptitle(f"{psf.telescope}: diffraction images, {waves} nm ({way})", fontsize=11)
        _draw_cuts(below.subplots(1, 2, sharey=True), psf)
        return figure


def _draw_image(axes: Axes, psf: DiffractionPsf, i: int) -> Any:
    image = psf.image[i] / psf.image[i].max()
    low, high = (psf.axis[k] * 1e6 + s * 0.5e6 * psf.pixel for k, s in ((0, -1.0), (-1, 1.0)))
    shown = axes.imshow(
        np.maximum(image, 10.0**-_DECADES),
        extent=(low, high, low, high),
        cmap="inferno",
        norm=LogNorm(10.0**-_DECADES, 1.0),
    )
    draw_circle(axes, psf.airy_radius[i] * 1e6, color="white", style=(0, (3, 2)))
    axes.set(xticks=[], yticks=[])
    axes.set_title(field_label(psf.fields[i]), fontsize=9.5)
    fwhm = psf.fwhm[i]
    lit = "" if psf.light[i] > 0.995 else f"lit {100 * psf.light[i]:.1f} % of the pupil"
    axes.set_xlabel(
        f'Strehl {psf.strehl[i]:.3g}\nFWHM {fwhm * 1e6:.3g} µm = {fwhm * _arcsec(psf, i):.2g}"\n{lit}', fontsize=7.5
    )
    return shown


def _draw_cuts(panels: Any, psf: DiffractionPsf) -> None:
    colors = field_colors(min(len(psf.fields), _MOST))
    for axes, name in zip(panels, "xy", strict=True):
        for i, color in enumerate(colors):
            density = psf.image[i] / psf.pixel**2 * 1e-12
            row, column = np.unravel_index(int(np.argmax(density)), density.shape)
            cut = density[row] if name == "x" else density[:, column]
            axes.plot(psf.axis * 1e6, cut, color=color, linewidth=1.2, label=field_label(psf.fields[i]))
        axes.set_xlabel(f"{name} on the detector from the middle of the image [µm]")
        axes.set_xlim(psf.axis[0] * 1e6, psf.axis[-1] * 1e6)
        axes.set_ylim(bottom=0.0)
        axes.grid(True, color="0.92", linewidth=0.6)
    panels[0].set_ylabel("part of the light per µm²\n(through the brightest pixel)")
    panels[1].legend(loc="upper right")


def _whiten(axes: Axes) -> None:
    """Make the scale bar and its label readable on a dark image."""
    for line in axes.lines:
        line.set_color("white")
    for text in axes.texts:
        text.set_color("white")


def _arcsec(psf: DiffractionPsf, i: int) -> float:
    """Return arc seconds per metre on the detector."""
    return float(np.rad2deg(psf.plate_scale[i])) * 3600.0
