"""Picture of a PSF model of own stars: whiskers, residuals of held-out stars against S/N, stamps, rho statistics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.plotting import BLUE, ORANGE, RED, new_figure, png_bytes, styled
from ...core.units import ARCMIN
from ..report.focal_plane_axes import draw_key_whisker, draw_whiskers, key_ellipticity, whiskers
from ..report.psf_plots import StampGallery, stretched
from .own_stars import OwnStars

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = 5


def own_stars_picture(own: OwnStars, title: str) -> bytes:
    """Draw stars, model and residuals of a PSF model as PNG."""
    used = own.used
    d1, d2, size = own.residuals()
    x, y = own.positions[used].T
    panels = (
        ("stars", own.shapes.e1[used], own.shapes.e2[used], BLUE),
        ("model without the star", own.held_out.e1[used], own.held_out.e2[used], "0.3"),
        ("difference", d1, d2, RED),
    )
    with styled():
        figure = new_figure(13.0, 12.0)
        grid = figure.add_gridspec(3, 3, height_ratios=(1.0, 0.9, 1.1))
        key = key_ellipticity(np.hypot(panels[0][1], panels[0][2]))
        scale = 0.12 * max(np.ptp(x), np.ptp(y)) / key
        for column, (name, e1, e2, color) in enumerate(panels):
            axes = figure.add_subplot(grid[0, column])
            draw_whiskers(axes, whiskers(x, y, e1, e2, scale), color, 1.2)
            axes.set(xlabel="x", ylabel="y" if column == 0 else "", aspect="equal")
            margin = 0.05 * max(np.ptp(x), np.ptp(y))
            axes.set(xlim=(x.min() - margin, x.max() + margin), ylim=(y.min() - margin, y.max() + margin))
            axes.set_title(name, loc="left")
            draw_key_whisker(axes, key, scale, 1.2)
        snr = own.snr[used]
        rising = np.argsort(snr)
        for column, (label, values, noise) in enumerate(
            (
                ("e, star - model", np.stack([d1, d2]), own.sigma_e),
                ("size, (star - model)/model", size[None], own.sigma_size),
            )
        ):
            axes = figure.add_subplot(grid[1, column])
            for row, (one, color) in enumerate(zip(values, (BLUE, ORANGE), strict=False)):
                axes.plot(snr, one, ".", color=color, label=f"e{row + 1}" if len(values) > 1 else None)
            for sign in (1.0, -1.0):
                noise_label = "noise of the stars, 1 sigma" if sign > 0.0 else None
                axes.plot(snr[rising], sign * noise[rising], "-", color="0.4", linewidth=1.0, label=noise_label)
            limit = 4.0 * float(np.nanstd(values))
            axes.set(xscale="log", xlabel="S/N", ylim=(-limit, limit))
            axes.axhline(0.0, color="0.7", linewidth=0.6)
            axes.set_title(f"{label}; stars held out", loc="left")
            axes.legend()
        axes = figure.add_subplot(grid[1, 2])
        rho = dict(own.rho_statistics().items())
        for name, color in (("rho1", RED), ("rho2", BLUE)):
            correlation = rho[name]
            theta = correlation.r / ARCMIN
            axes.errorbar(theta, correlation.xi_plus, correlation.error_plus, fmt=".-", color=color, label=name)
        axes.axhline(0.0, color="0.7", linewidth=0.6)
        axes.set(xscale="log", xlabel="separation [arcmin]")
        axes.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
        axes.set_title("rho statistics of the held-out stars", loc="left")
        axes.legend()
        _stamps(own, figure.add_subplot(grid[2, :]))
        found = own.summary()
        figure.suptitle(
            f"{title}: {found['used']} of {found['stars']} stars, FWHM {found['fwhm_arcsec']:.3g} arcsec; rms of e "
            f"held out {100 * found['rms_e_held_out']:.2g} %, noise of the stars {100 * found['rms_e_noise']:.2g} %",
            fontsize=10,
        )
        return png_bytes(figure)


def _stamps(own: OwnStars, axes: Axes) -> None:
    """Draw used stars from the brightest to the faintest, the models made without them, and the difference."""
    order = np.argsort(-own.snr[own.used], kind="stable")
    ranks = np.unique(np.linspace(0, len(order) - 1, 2 * _SHOWN).round().astype(int))
    gallery = StampGallery(axes, own.stamps.shape[1], own.pixel_scale)
    for column, star in enumerate(order[ranks]):
        top = own.predicted[star].max()
        images = (own.stamps[star], own.predicted[star], own.stamps[star] - own.predicted[star])
        for row, image in enumerate(images):
            colours: dict[str, Any] = {"cmap": "viridis", "vmin": float(stretched(np.array(-0.02))), "vmax": 1.0}
            shown = stretched(image / top)
            if row == 2:
                colours, shown = {"cmap": "RdBu_r", "vmin": -0.1, "vmax": 0.1}, image / top
            title = f"S/N {own.snr[own.used][star]:.0f}" if row == 0 else ""
            gallery.show(shown, row, column, title, **colours)
    gallery.finish(3, len(ranks), ("star (asinh)", "model without it", "difference, ±10 %"))
