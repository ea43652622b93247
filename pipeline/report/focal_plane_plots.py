"""Plots over the focal plane: heights of the CCDs, whiskers of the ellipticity, residuals of each CCD."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from ...core.plotting import new_figure, png_bytes, styled
from ...measure.focal_plane_axes import (
    AWAY,
    OBSERVED,
    RESIDUAL,
    RESIDUAL_TITLES,
    TRUTH,
    around_field_circle,
    ccd_corners,
    draw_field_circle,
    draw_key_whisker,
    draw_outlines,
    draw_whiskers,
    frame_axes,
    key_ellipticity,
    whiskers,
)
from ...models.camera.camera import Camera
from ...models.camera.focal_plane import FocalPlane
from ...reconstruction.ccd_product import CcdStars, Stars
from ..summary import ellipticities

#: More CCDs than this are many: each is small on the page.
_MANY = 30
#: Whiskers on one CCD, and a fifth of them where CCDs are many: more make one dark mass.
_MOST_WHISKERS = 200
#: Width over height from which on CCDs lie in a row along x; its inverse for y.
_ROW = 1.6
#: Letters of a title on an inch of a narrow panel, at most.
_LETTERS_OF_AN_INCH = 17.0
#: Fewest letters of a line of a title.
_SHORTEST_LINE = 12
#: Height of panels of residuals of CCDs in a row along y [inch].
_TALL_PANEL = 6.0
#: What colours and whiskers of the residuals are.
_RESIDUAL_NOTE = (
    "Of e: colour, rms of one component; whisker, mean residual of the CCD.\n"
    "Of size: mean of $(T - T_{model})/T$, $T = Q_{11} + Q_{22}$."
)
#: Height of a row of a close-up over the width of its panels, least and most.
_TALL = (0.6, 1.6)


def heights_plot(focal_plane: FocalPlane, used: Sequence[str], field_radius: float) -> bytes:
    """Draw the heights of all CCDs, the used ones framed and named (Jee & Tyson 2011, Fig. 7).

    `field_radius` is the radius of the field of view on the detector [m].
    """
    camera = focal_plane.camera
    indices = [camera.ccd_index(name) for name in used]
    with styled():
        figure = new_figure(8.8, 7.2)
        axes = figure.add_subplot()
        edge = 1.04e3 * camera.reach
        limits = around_field_circle((-edge, edge, -edge, edge), field_radius * 1e3)
        image = draw_heights(axes, focal_plane, limits, 900)
        draw_outlines(axes, camera, range(len(camera)), "0.55", 0.3)
        draw_outlines(axes, camera, indices, "black", 1.4)
        draw_field_circle(axes, field_radius * 1e3)
        frame_axes(axes, limits)
        framed = f"; framed: the {len(used)} CCD{'s' * (len(used) != 1)} of this run" if used else ""
        heading = "CCDs, without heights" if is_flat(focal_plane) else "CCD heights"
        axes.set_title(f"{heading}{framed}; dashed: edge of the field of view")
        if not is_flat(focal_plane):
            figure.colorbar(image, ax=axes, fraction=0.045, pad=0.02, label="height along +z, towards the sky [µm]")
        return png_bytes(figure)


def whiskers_plot(
    products: Sequence[CcdStars], focal_plane: FocalPlane, field_radius: float, kinds: Sequence[str] | None = None
) -> bytes:
    """Draw whiskers over the CCDs of the run, all on one scale, CCD heights faintly behind (Figs. 8, 11, 12).

    Panels are `kinds` of ``truth``, ``observed``, ``residual``, ``away``, by default the first three; `field_radius` is
    the radius of the field of view on the detector [m].
    """
    kinds = ("truth", "observed", "residual") if kinds is None else kinds
    camera = focal_plane.camera
    half = 0.5 * camera.shortest_side * 1e3
    pad = 0.25 * half
    corners = ccd_corners(camera, (camera.ccd_index(p.name) for p in products))
    low, high = corners.min(axis=(0, 1)) - pad, corners.max(axis=(0, 1)) + pad
    limits = around_field_circle((low[0], high[0], low[1], high[1]), field_radius * 1e3)
    sides = limits[1] - limits[0], limits[3] - limits[2]
    key = _common_key(products)
    # The key is a third of the half side of a CCD long, but never too short to be legible.
    scale = max(0.33 * half, 0.012 * max(sides)) / key
    across = sides[0] / sides[1]
    with styled():
        # Panels go under each other where CCDs lie in a row along x or are many, beside each other where they do not.
        stacked = across > _ROW or len(products) > _MANY
        tall = not stacked and across < 1.0 / _ROW
        wide = 9.0 if len(products) > _MANY else 12.0
        panel_width = (wide - 1.6) * across
        if tall:
            figure = new_figure(len(kinds) * (panel_width + 0.35) + 1.6, wide, "compressed")
            panels = figure.subplots(1, len(kinds), sharey=True, squeeze=False)[0]
        elif stacked:
            figure = new_figure(wide, len(kinds) * ((wide - 1.4) / across + 0.45) + 0.3, "compressed")
            panels = figure.subplots(len(kinds), 1, sharex=True, squeeze=False)[:, 0]
        else:
            figure = new_figure(wide + 1.5, (wide + 1.5) / len(kinds) / across + 0.9, "compressed")
            panels = figure.subplots(1, len(kinds), sharey=True, squeeze=False)[0]
        bounds = height_range(focal_plane)
        whisker_limit = _MOST_WHISKERS if len(products) <= _MANY else _MOST_WHISKERS // 5
        for i, (axes, kind) in enumerate(zip(panels, kinds, strict=True)):
            image = draw_heights(axes, focal_plane, limits, 700, alpha=0.35, bounds=bounds)
            draw_outlines(axes, focal_plane.camera, range(len(focal_plane.camera)), "0.5", 0.5)
            draw_field_circle(axes, field_radius * 1e3)
            for product in products:
                _draw_kind(axes, product, kind, scale, 0.8 if len(products) <= _MANY else 0.5, whisker_limit)
            frame_axes(axes, limits, x_label=not stacked or i == len(kinds) - 1, y_label=stacked or i == 0)
            title = _title_with_count(_TITLES[kind], products, kind, whisker_limit)
            if tall:
                _set_title_above_key(axes, title, panel_width)
            else:
                axes.set_title(title, loc="left")
            draw_key_whisker(axes, key, scale, 1.0)
        _add_height_scale(figure, image, panels, focal_plane, 30)
        return png_bytes(figure)


def _set_title_above_key(axes: Axes, title: str, width: float) -> None:
    """Write a title above the key whisker of a narrow panel of `width` inches, in as many lines as it takes."""
    letters = max(int(_LETTERS_OF_AN_INCH * width), _SHORTEST_LINE)
    axes.set_title(textwrap.fill(title, letters), loc="left", fontsize=8.0, pad=20.0)


def close_up_plot(products: Sequence[CcdStars], focal_plane: FocalPlane) -> bytes:
    """Draw whiskers of some CCDs large, one a row: noise-free, observed, residuals at stars and holdout positions."""
    camera = focal_plane.camera
    kinds = ("truth", "observed", "residual", "away")
    key = _common_key(products)
    scale = 0.2 * 0.5 * camera.shortest_side * 1e3 / key
    outlines = [ccd_corners(camera, [camera.ccd_index(p.name)])[0] for p in products]
    sides = np.array([np.ptp(corners, axis=0) for corners in outlines])
    tall = np.clip(np.round(sides[:, 1] / sides[:, 0], 6), *_TALL)
    with styled():
        figure = new_figure(13.0, 3.35 * float(tall.sum()) + 0.4)
        panels = figure.subplots(len(products), len(kinds), squeeze=False, height_ratios=tall)
        bounds = height_range(focal_plane)
        for last, row, product, corners in zip(
            range(len(products) - 1, -1, -1), panels, products, outlines, strict=True
        ):
            low, high = corners.min(axis=0), corners.max(axis=0)
            rim = 0.02 * (high - low)
            limits = (low[0] - rim[0], high[0] + rim[0], low[1] - rim[1], high[1] + rim[1])
            for i, (axes, kind) in enumerate(zip(row, kinds, strict=True)):
                image = draw_heights(axes, focal_plane, limits, 200, alpha=0.35, bounds=bounds)
                _draw_kind(axes, product, kind, scale, 1.2, _MOST_WHISKERS)
                draw_outlines(axes, camera, [camera.ccd_index(product.name)], "0.4", 0.7)
                frame_axes(axes, limits, x_label=last == 0, y_label=i == 0)
                name = f"{product.name}: " if i == 0 else ""
                title = name + _SHORT_TITLES[kind]
                axes.set_title(
                    _title_with_count(title, [product], kind, _MOST_WHISKERS) if i == 0 else title, loc="left"
                )
                draw_key_whisker(axes, key, scale, 1.2)
        _add_height_scale(figure, image, panels, focal_plane, 40)
        return png_bytes(figure)


def _add_height_scale(
    figure: Figure, image: ScalarMappable, panels: np.ndarray, focal_plane: FocalPlane, aspect: float
) -> None:
    """Add the colour scale of the heights behind whiskers to panels, where there are heights."""
    if not is_flat(focal_plane):
        label = "CCD height [µm]"
        figure.colorbar(image, ax=list(panels.flat), fraction=0.02, pad=0.01, aspect=aspect, label=label)


_TITLES = {
    "truth": "noise-free PSFs",
    "observed": "observed stars",
    "residual": "residual at the stars: observed - model",
    "away": "residual at the holdout positions: noise-free - model",
}
_SHORT_TITLES = {
    "truth": "noise-free",
    "observed": "observed",
    "residual": "residual at stars",
    "away": "residual, holdout",
}
_COLORS = {"truth": TRUTH, "observed": OBSERVED, "residual": RESIDUAL, "away": AWAY}


def _title_with_count(title: str, products: Sequence[CcdStars], kind: str, limit: int) -> str:
    """Return a title, with a note where not every star has a whisker."""
    step = max(_whisker_stride(product.stars(kind), limit) for product in products)
    return title if step == 1 else f"{title} (one star in {step})"


def _whisker_stride(stars: Stars, limit: int) -> int:
    return max(1, -(-len(stars) // limit))


def _draw_kind(axes: Axes, product: CcdStars, kind: str, scale: float, width: float, limit: int) -> None:
    stars = product.stars(kind)
    ends = whiskers(stars.x * 1e3, stars.y * 1e3, *product.ellipticity(kind), scale)
    draw_whiskers(axes, ends[:: _whisker_stride(stars, limit)], _COLORS[kind], width)


def _common_key(products: Sequence[CcdStars]) -> float:
    """Return the ellipticity of the key whisker, from noise-free PSFs and observed stars together."""
    return key_ellipticity(np.concatenate([np.hypot(*ellipticities(products, k)) for k in ("truth", "observed")]))


def height_range(focal_plane: FocalPlane) -> float:
    """Return the largest height, sign left off [um], rounded up; 1 where all is flat.

    Where a few heights are more than twice those of 98 % of the area, as at the rims of measured CCDs, those of 98 %.
    """
    heights = _absolute_heights(focal_plane)
    largest, usual = float(np.nanmax(heights)), float(np.nanpercentile(heights, 98.0))
    if largest > 2.0 * usual > 0.0:
        largest = usual
    return float(np.ceil(largest)) if largest > 0 else 1.0


def is_flat(focal_plane: FocalPlane) -> bool:
    """Return whether all heights are zero."""
    return not np.nan_to_num(_absolute_heights(focal_plane)).any()


def _absolute_heights(focal_plane: FocalPlane) -> np.ndarray:
    """Return heights on a grid over every CCD, sign left off [um]."""
    camera = focal_plane.camera
    nodes = np.linspace(-1.0, 1.0, 9) * (1.0 - 1e-9)
    uv = np.stack(np.meshgrid(nodes, nodes), axis=-1)
    xy = camera.from_uv(np.arange(len(camera))[:, None, None], uv)
    return np.abs(focal_plane.height(xy[..., 0], xy[..., 1])) * 1e6


def draw_heights(
    axes: Axes,
    focal_plane: FocalPlane,
    limits: tuple[float, float, float, float],
    samples: int,
    alpha: float = 1.0,
    bounds: float | None = None,
) -> AxesImage:
    """Draw the heights within limits [mm] as an image, gaps left white; the scale is that of the whole focal plane."""
    bounds = height_range(focal_plane) if bounds is None else bounds
    height, extent = _height_map(focal_plane, limits, samples)
    return axes.imshow(height, extent=extent, cmap="RdBu_r", vmin=-bounds, vmax=bounds, alpha=alpha, aspect="equal")


@lru_cache(maxsize=1)
def _height_map(
    focal_plane: FocalPlane, limits: tuple[float, float, float, float], samples: int
) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Return heights within limits [um] and the extent of the image; kept, since the panels of a row have the same."""
    x_low, x_high, y_low, y_high = (float(limit) for limit in limits)
    step = max(x_high - x_low, y_high - y_low) / samples
    x = np.arange(x_low + 0.5 * step, x_high, step)
    y = np.arange(y_low + 0.5 * step, y_high, step)
    height = focal_plane.height(x[None, :] * 1e-3, y[:, None] * 1e-3) * 1e6
    return height, (x[0] - 0.5 * step, x[-1] + 0.5 * step, y[0] - 0.5 * step, y[-1] + 0.5 * step)


def residual_plot(camera: Camera, columns: Mapping[str, np.ndarray]) -> bytes:
    """Draw the residuals of each CCD: rms and mean ellipticity above, mean size below; the same scale across a row.

    `columns` are those of the table of CCDs of :class:`~.Diagnostics`.
    """
    indices = [camera.ccd_index(str(name)) for name in columns["ccd"]]
    corners = ccd_corners(camera, indices)
    low, high = corners.min(axis=(0, 1)) - 8.0, corners.max(axis=(0, 1)) + 8.0
    limits = (low[0], high[0], low[1], high[1])
    across = float((high[0] - low[0]) / (high[1] - low[1]))
    means = np.concatenate([np.hypot(columns[f"mean_e1_{k}"], columns[f"mean_e2_{k}"]) for k in RESIDUAL_TITLES])
    key = key_ellipticity(means)
    scale = 0.35 * camera.shortest_side * 1e3 / key
    worst = _robust_maximum(np.concatenate([columns[f"rms_e_{k}"] for k in RESIDUAL_TITLES]))
    sizes = _robust_maximum(np.abs(np.concatenate([columns[f"mean_dt_{k}"] for k in ("residual", "away")])))
    tall = across < 1.0 / _ROW
    panel_width = _TALL_PANEL * across if tall else 3.0
    with styled():
        # Panels of CCDs in a row along y stand beside each other.
        if tall:
            figure = new_figure(5 * (panel_width + 0.6) + 2.6, _TALL_PANEL + 1.6, "compressed")
            panels = figure.subplots(1, 5, sharey=True)
            e_panels, size_panels = panels[:3], panels[3:]
            figure.supxlabel(_RESIDUAL_NOTE, fontsize=8.5)
        else:
            figure = new_figure(12.5, min(max(2 * 3.6 / across, 2.6) + 1.4, 9.5))
            panels = figure.subplots(2, 3)
            e_panels, size_panels = panels[0], panels[1, [0, 2]]
            panels[1, 1].set_axis_off()
            note = {"xycoords": "axes fraction", "ha": "center", "va": "center", "fontsize": 8.5}
            panels[1, 1].annotate(_RESIDUAL_NOTE, (0.5, 0.5), **note)

        e_shades = ScalarMappable(Normalize(0.0, worst), "viridis")
        for axes, kind in zip(e_panels, RESIDUAL_TITLES, strict=True):
            _draw_ccds(axes, camera, indices, columns[f"rms_e_{kind}"], e_shades)
            ends = whiskers(
                columns["x_mm"], columns["y_mm"], columns[f"mean_e1_{kind}"], columns[f"mean_e2_{kind}"], scale
            )
            draw_whiskers(axes, ends, "white", 2.6)
            draw_whiskers(axes, ends, "black", 1.2)
            frame_axes(axes, limits, x_label=kind == "left_out", y_label=axes is e_panels[0])
            _set_title_above_key(axes, RESIDUAL_TITLES[kind], panel_width)
            draw_key_whisker(axes, key, scale, 1.0)
        size_shades = ScalarMappable(Normalize(-sizes, sizes), "RdBu_r")
        for axes, kind in zip(size_panels, ("residual", "away"), strict=True):
            _draw_ccds(axes, camera, indices, columns[f"mean_dt_{kind}"], size_shades)
            first = axes is size_panels[0]
            frame_axes(axes, limits, x_label=first or not tall, y_label=first and not tall)
            _set_title_above_key(axes, RESIDUAL_TITLES[kind], panel_width)
        scales = ((e_panels, e_shades, "max", "rms of e"), (size_panels, size_shades, "both", "mean $\\delta T/T$"))
        for row, shades, extend, label in scales:
            figure.colorbar(shades, ax=list(row), fraction=0.03, pad=0.01, extend=extend, label=label)
        return png_bytes(figure)


def _robust_maximum(values: np.ndarray) -> float:
    """Return the 98th percentile of finite values, or one where it is zero."""
    finite = values[np.isfinite(values)]
    largest = float(np.quantile(finite, 0.98)) if finite.size else 0.0
    return largest if largest > 0.0 else 1.0


def _draw_ccds(axes: Axes, camera: Camera, indices: list[int], values: np.ndarray, shades: ScalarMappable) -> None:
    corners = ccd_corners(camera, indices)
    axes.add_collection(PolyCollection(list(corners), facecolors=shades.to_rgba(values), edgecolors="none"))
    draw_outlines(axes, camera, range(len(camera)), "0.75", 0.4)
