"""Drawings of reproduced figures that a run's report has no use for; the others are the report's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.patches import Circle, Rectangle

from ...core.plotting import new_figure, png_bytes, styled
from ...models.camera.camera import Camera
from ...models.camera.focal_plane import FocalPlane
from ...pipeline.report.focal_plane_axes import (
    OBSERVED,
    RESIDUAL,
    TRUTH,
    draw_field_circle,
    draw_key_whisker,
    draw_outlines,
    draw_whiskers,
    frame_axes,
    key_ellipticity,
    whiskers,
)
from ...pipeline.report.focal_plane_plots import draw_heights, height_range

_BANDS = {"u": "#7b3294", "g": "#2166ac", "r": "#1a9850", "i": "#d9a400", "z": "#d95f02", "y": "#a50026"}
_TIMES = ("#b8b8b8", "#7fa8d1", "#1f6fbf", "#0b2a55")
#: Above this the layout is cut off [m]: light comes in from there.
_TOP = 8.5


def layout_figure(
    profiles: Mapping[str, np.ndarray], rays: Mapping[float, np.ndarray], camera: Camera, field_radius: float
) -> bytes:
    """Draw the telescope in section with its rays, and the CCD mosaic (Jee & Tyson 2011, Fig. 1).

    Parameters
    ----------
    profiles : mapping of str to ndarray, shape [n, 2]
        Points (y, z) of each surface in section [m]; NaN breaks the line.
    rays : mapping of float to ndarray, shape [n_ray, n_point, 2]
        Points (y, z) along the rays [m], by field angle [deg].
    camera : Camera
        The mosaic.
    field_radius : float
        Radius of the field of view on the detector [m].
    """
    with styled():
        figure = new_figure(12.0, 6.0)
        left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.0))
        for (angle, paths), color in zip(rays.items(), (OBSERVED, TRUTH, RESIDUAL), strict=False):
            left.add_collection(LineCollection(list(paths), colors=color, linewidths=0.5, alpha=0.75))
            left.plot([], [], color=color, linewidth=1.0, label=f"field {angle:+.2f}°" if angle else "on the axis")
        for points in profiles.values():
            left.plot(points[:, 0], points[:, 1], color="black", linewidth=1.6)
        for name, place, ha in (
            ("M1", (-4.3, 0.75), "right"),
            ("M2", (1.85, 6.4), "left"),
            ("M3", (0.0, -0.75), "center"),
            ("L1, L2, filter, L3, detector", (0.95, 3.6), "left"),
        ):
            behind = {"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85}
            left.annotate(name, place, ha=ha, va="center", fontsize=8, bbox=behind)
        left.set_xlim(-5.2, 5.2)
        left.set_ylim(-1.2, _TOP)
        left.set_aspect("equal")
        left.set_xlabel("y [m]")
        left.set_ylabel("z from the vertex of M1, towards the sky [m]")
        left.set_title("section x = 0 with traced rays; light comes from above", loc="left")
        left.legend(loc="lower right", fontsize=7)
        draw_outlines(right, camera, range(len(camera)), "0.25", 0.6)
        _draw_corner_rafts(right, camera)
        draw_field_circle(right, field_radius * 1e3, "")
        edge = 1.1e3 * float(np.abs(camera.centers).max() + camera.half_size)
        frame_axes(right, (-edge, edge, -edge, edge))
        right.set_title(f"{len(camera)} CCDs; dashed: field of view of 3.5°, {2e3 * field_radius:.0f} mm", loc="left")
        return png_bytes(figure)


def _draw_corner_rafts(axes: Axes, camera: Camera) -> None:
    """Draw where the rafts of the wavefront sensors stand: at the corners of the square around the mosaic."""
    raft = 3.0 * camera.ccd_size * 1e3
    reach = float(np.abs(camera.centers).max() + camera.half_size) * 1e3 - raft
    for x in (-reach - raft, reach):
        for y in (-reach - raft, reach):
            axes.add_patch(Rectangle((x, y), raft, raft, fill=False, edgecolor="0.6", linestyle=":", linewidth=0.9))
            axes.annotate(
                "wavefront and\nguide sensors\n(not modelled)",
                (x + 0.5 * raft, y + 0.5 * raft),
                ha="center",
                va="center",
                fontsize=6,
                color="0.5",
            )


def encircled_energy_figure(
    radius: np.ndarray,
    curves: Mapping[float, np.ndarray],
    field: np.ndarray,
    radius80: np.ndarray,
    stamps: Mapping[float, np.ndarray],
    pixel: float,
) -> bytes:
    """Draw encircled energy at some places, its 80 % radius over the field, and PSFs (Jee & Tyson 2011, Fig. 2).

    Parameters
    ----------
    radius : ndarray
        Radii of the curves [arcsec].
    curves : mapping of float to ndarray
        Encircled energy by field angle [deg].
    field, radius80 : ndarray
        Field angles [deg] and the radii that hold 80 % of the light there [arcsec].
    stamps : mapping of float to ndarray
        Images by field angle [deg].
    pixel : float
        Side of their pixels [arcsec].
    """
    with styled():
        figure = new_figure(10.5, 6.6)
        top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=(1.0, 0.5))).ravel()
        left, right = top.subplots(1, 2)
        for color, (angle, curve) in zip(("black", *_TIMES[1:], RESIDUAL), curves.items(), strict=False):
            left.plot(radius, 100.0 * curve, color=color, label=f"{angle:g}°")
        left.axhline(80.0, color="0.6", linewidth=0.7, linestyle=(0, (4, 3)))
        left.set_xlim(0.0, 0.4)
        left.set_ylim(0.0, 102.0)
        left.set_xlabel("radius [arcsec]")
        left.set_ylabel("encircled energy [%]")
        left.legend(title="field angle", loc="lower right")
        right.plot(field, radius80, "o-", color=OBSERVED, markersize=3.5)
        inner = float(radius80[field <= 1.4 + 1e-9].mean())
        right.axhspan(0.93 * inner, 1.07 * inner, color="0.92", zorder=0, label="±7 % of the mean to 1.4°")
        right.set_ylim(0.0, 1.35 * float(radius80.max()))
        right.set_xlabel("field angle [deg]")
        right.set_ylabel("radius of 80 % of the light [arcsec]")
        right.legend(loc="lower right")
        panels = list(np.atleast_1d(bottom.subplots(1, len(stamps))))
        for axes, (angle, stamp) in zip(panels, stamps.items(), strict=True):
            half = 0.5 * pixel * len(stamp)
            offsets = (np.arange(len(stamp)) + 0.5) * pixel - half
            x, y = (stamp.sum(axis=axis) @ offsets / stamp.sum() for axis in (0, 1))
            image = axes.imshow(
                np.maximum(stamp / stamp.max(), 1e-4),
                extent=(-half - x, half - x, -half - y, half - y),
                cmap="magma",
                norm=LogNorm(1e-3, 1.0),
            )
            axes.set_xlim(-0.3, 0.3)
            axes.set_ylim(-0.3, 0.3)
            axes.set_title(f"{angle:g}°", fontsize=8)
            axes.set_xlabel("from the centroid [arcsec]")
        bar = bottom.colorbar(image, ax=panels, fraction=0.02, pad=0.01)
        bar.set_label("over the peak (log)")
        return png_bytes(figure)


def budget_figure(rows: Sequence[str], values: Mapping[str, np.ndarray], units: Sequence[str]) -> bytes:
    """Draw the terms of the height budget: allowed, and what was drawn of it (Jee & Tyson 2011, Table 1).

    Parameters
    ----------
    rows : sequence of str
        Terms.
    values : mapping of str to ndarray
        For each label a value a term, in its unit.
    units : sequence of str
        Unit of each term.
    """
    colors = ("0.8", "0.55", "#9cc3e6", OBSERVED)
    with styled():
        figure = new_figure(9.0, 4.4)
        axes = figure.add_subplot()
        height = 0.8 / len(values)
        place = np.arange(len(rows))
        for k, ((label, bars), color) in enumerate(zip(values.items(), colors, strict=True)):
            shift = place + (k - 0.5 * (len(values) - 1)) * height
            axes.barh(shift, bars, height, color=color, label=label)
            for y, value in zip(shift, bars, strict=True):
                axes.annotate(
                    f"{value:.2f}", (value, y), xytext=(3, 0), textcoords="offset points", va="center", size=7
                )
        axes.set_yticks(place, [f"{row} [{unit}]" for row, unit in zip(rows, units, strict=True)])
        axes.invert_yaxis()
        axes.set_xlim(0.0, 1.15 * max(float(v.max()) for v in values.values()))
        axes.set_xlabel("peak to valley, in the unit of each row")
        axes.legend(loc="lower right")
        return png_bytes(figure)


def field_whiskers_figure(
    positions: np.ndarray, e: np.ndarray, focal_plane: FocalPlane, field_radius: float, title: str
) -> bytes:
    """Draw whiskers over the whole focal plane (Jee & Tyson 2011, Fig. 8).

    Parameters
    ----------
    positions : ndarray, shape [n, 2]
        Detector positions [m].
    e : ndarray, shape [n]
        Complex ellipticities.
    focal_plane : FocalPlane
        Heights, drawn behind.
    field_radius : float
        Radius of the field of view on the detector [m].
    title : str
        What they are.
    """
    camera = focal_plane.camera
    edge = 1.04e3 * float(np.abs(camera.centers).max() + camera.half_size)
    limits = (-edge, edge, -edge, edge)
    per_side = np.sqrt(len(e) / len(camera))
    key = key_ellipticity(np.abs(e))
    scale = 0.85 * camera.ccd_size * 1e3 / max(per_side, 1.0) / key
    with styled():
        figure = new_figure(8.6, 7.6)
        axes = figure.add_subplot()
        image = draw_heights(axes, focal_plane, limits, 700, alpha=0.4, bounds=height_range(focal_plane))
        draw_outlines(axes, camera, range(len(camera)), "0.55", 0.4)
        draw_field_circle(axes, field_radius * 1e3, "")
        draw_whiskers(axes, whiskers(positions[:, 0] * 1e3, positions[:, 1] * 1e3, e.real, e.imag, scale), TRUTH, 0.9)
        frame_axes(axes, limits)
        axes.set_title(title, loc="left")
        draw_key_whisker(axes, key, scale, 1.0)
        bar = figure.colorbar(image, ax=axes, fraction=0.045, pad=0.02)
        bar.set_label("CCD height [µm]")
        return png_bytes(figure)


def dispersion_figure(zenith: np.ndarray, spread: Mapping[str, np.ndarray]) -> bytes:
    """Draw the dispersion across each band [arcsec] against the zenith angle [deg] (Jee & Tyson 2011, Fig. 3)."""
    with styled():
        figure = new_figure(6.4, 4.6)
        axes = figure.add_subplot()
        for band, values in spread.items():
            # In u and g it is nearly the same, so that one would hide the other.
            axes.plot(zenith, values, color=_BANDS[band], label=band, linestyle="--" if band == "g" else "-")
        axes.axvline(45.0, color="0.6", linewidth=0.7, linestyle=(0, (4, 3)))
        axes.axhline(0.3, color="0.6", linewidth=0.7, linestyle=(0, (4, 3)))
        axes.annotate('0.3"', (59.5, 0.3), ha="right", va="bottom", fontsize=8, color="0.35")
        axes.set_xlim(0.0, float(zenith.max()))
        axes.set_ylim(0.0, None)
        axes.set_xlabel("zenith angle [deg]")
        axes.set_ylabel("dispersion between the band's edges [arcsec]")
        axes.legend(title="band", loc="upper left")
        return png_bytes(figure)


def screens_figure(path: np.ndarray, side: float, altitudes: np.ndarray, weights: np.ndarray, diameter: float) -> bytes:
    """Draw a piece of the screens of all layers (Jee & Tyson 2011, Fig. 4).

    Parameters
    ----------
    path : ndarray, shape [n, size, size]
        Path [um].
    side : float
        Side of the piece [m].
    altitudes, weights : ndarray
        Altitudes of the layers [m] and their parts of the turbulence.
    diameter : float
        Diameter of the pupil [m], drawn to show the scale.
    """
    with styled():
        figure = new_figure(10.5, 6.4)
        panels = figure.subplots(2, 3, sharex=True, sharey=True).ravel()
        for i, (axes, screen) in enumerate(zip(panels, path, strict=True)):
            # Each on its own scale: the highest layers would be blank on that of the ground.
            edge = 3.0 * float(screen.std())
            image = axes.imshow(screen, extent=(0.0, side, 0.0, side), cmap="RdBu_r", vmin=-edge, vmax=edge)
            axes.add_patch(Circle((0.07 * side, 0.07 * side), 0.5 * diameter, fill=False, edgecolor="black"))
            axes.set_title(f"{altitudes[i] / 1e3:g} km, weight {weights[i]:.3f}", loc="left")
            if i >= 3:
                axes.set_xlabel("x [m]")
            if i % 3 == 0:
                axes.set_ylabel("y [m]")
            bar = figure.colorbar(image, ax=axes, fraction=0.045, pad=0.02)
            bar.set_label("path [µm]")
        figure.suptitle("a piece of each screen; circle: the pupil", fontsize=10)
        return png_bytes(figure)


def speckles_figure(
    images: np.ndarray, times: Sequence[float], width: np.ndarray, e: np.ndarray, pixel: float
) -> bytes:
    """Draw one star after some exposure times, each over its peak, with its FWHM and |e| (Fig. 5).

    Parameters
    ----------
    images : ndarray, shape [n, ny, nx]
        Images.
    times : sequence of float
        Exposure times [s].
    width, e : ndarray
        FWHM [arcsec] and complex ellipticity of each.
    pixel : float
        Side of a pixel [arcsec].
    """
    half = 0.5 * pixel * images.shape[1]
    with styled():
        figure = new_figure(10.2, 7.0)
        panels = figure.subplots(2, -(-len(images) // 2), sharex=True, sharey=True).ravel()
        for i, (axes, stamp) in enumerate(zip(panels, images, strict=False)):
            image = axes.imshow(
                stamp / stamp.max(), extent=(-half, half, -half, half), cmap="magma", vmin=0.0, vmax=1.0
            )
            size = f'FWHM {width[i]:.2f}", ' if np.isfinite(width[i]) else ""
            time = f"{times[i]:g} s" if times[i] else "one moment"
            axes.set_title(f"{time}: {size}|e| {100 * abs(e[i]):.1f} %", loc="left", fontsize=9)
            if i >= len(panels) // 2:
                axes.set_xlabel("x [arcsec]")
            if i % (len(panels) // 2) == 0:
                axes.set_ylabel("y [arcsec]")
        bar = figure.colorbar(image, ax=list(panels), fraction=0.02, pad=0.01, aspect=40)
        bar.set_label("over the peak of each")
        return png_bytes(figure)


def atmosphere_figure(
    positions: np.ndarray, e: np.ndarray, r: np.ndarray, xi: Mapping[float, tuple[np.ndarray, ...]]
) -> bytes:
    """Draw whiskers by the atmosphere alone on one CCD, and correlations against exposure time (Fig. 6).

    Parameters
    ----------
    positions : ndarray, shape [n, 2]
        Field angles [arcmin].
    e : ndarray, shape [n]
        Complex ellipticities of the longest time that a visit has.
    r : ndarray
        Separations [arcmin].
    xi : mapping of float to (xi_plus, its error, xi_minus)
        Correlations by exposure time [s].
    """
    with styled():
        figure = new_figure(12.0, 5.6)
        left, right = figure.subplots(1, 2)
        edge = 7.2
        key = key_ellipticity(np.abs(e))
        scale = 0.5 / key
        draw_whiskers(left, whiskers(positions[:, 0], positions[:, 1], e.real, e.imag, scale), TRUTH, 0.7)
        left.set_xlim(-edge, edge)
        left.set_ylim(-edge, edge)
        left.set_aspect("equal")
        left.set_xlabel("x [arcmin]")
        left.set_ylabel("y [arcmin]")
        left.set_title(f"15 s, atmosphere alone: mean |e| {100 * np.abs(e).mean():.2f} %", loc="left")
        draw_key_whisker(left, key, scale, 1.0)
        for (time, (plus, error, minus)), color in zip(xi.items(), _TIMES, strict=True):
            right.errorbar(r, plus, error, fmt="o-", color=color, markersize=3, linewidth=1.2, capsize=2)
            right.plot(r, minus, "--", color=color, linewidth=1.0)
            right.plot([], [], "o-", color=color, markersize=3, label=f"{time:g} s")
        right.plot([], [], "-", color="0.3", label="ξ+")
        right.plot([], [], "--", color="0.3", label="ξ-")
        right.axhline(0.0, color="0.7", linewidth=0.6)
        right.set_xscale("log")
        right.set_yscale("symlog", linthresh=1e-5)
        right.set_xticks([0.3, 0.5, 1, 2, 5, 10], ["0.3", "0.5", "1", "2", "5", "10"])
        right.minorticks_off()
        right.set_xlabel("separation [arcmin]")
        right.set_ylabel("correlation of the ellipticity")
        right.set_title("mean of the exposures, with the error of that mean", loc="left")
        figure.legend(*right.get_legend_handles_labels(), ncols=6, loc="outside lower right")
        return png_bytes(figure)
