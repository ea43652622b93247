"""Layout of the telescope and CCD mosaic (Jee & Tyson 2011, Fig. 1)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Rectangle

from ...core.plotting import new_figure, png_bytes, styled
from ...design.layout.sections import outer_radius, ray_paths, surface_section
from ...models.camera.camera import Camera
from ...models.first_order import first_order
from ...models.surface import Surface
from ...models.telescope import Telescope
from ...pipeline.report.focal_plane_axes import OBSERVED, RESIDUAL, TRUTH, draw_field_circle, draw_outlines, frame_axes
from .bench import Bench
from .figure import EcsvData, Reproduced, figure

_LAYOUT_FIELDS = (-1.75, 0.0, 1.75)
_LAYOUT_RAYS = 9
#: Height above which light comes in, and the layout is cut off [m].
_TOP = 8.5
#: Surfaces without a rim, the detector, are drawn to here [m].
_DETECTOR = 0.32


@figure(
    "fig1",
    "optical layout and CCD mosaic",
    'f/1.23, focal length 10.3 m, 0.0197"/µm, 35 m² of collecting area, 189 CCDs, field 64 cm across',
    minutes=(0.05, 0.05),
)
def layout(bench: Bench) -> Reproduced:
    """Draw the telescope in section with traced rays, and the CCD mosaic (Fig. 1)."""
    telescope, camera = bench.telescope, bench.camera
    profiles = {surface.name: _profile(surface) for surface in telescope.surfaces}
    rays = {angle: _ray_paths(telescope, angle) for angle in _LAYOUT_FIELDS}
    figures = first_order(telescope)
    scale = abs(figures.arcsec_per_um)
    measured = {
        "focal_length_m": figures.focal_length,
        "f_number": figures.f_number,
        "plate_scale_arcsec_per_um": scale,
        "collecting_area_m2": figures.effective_area,
        "field_diameter_mm": 2e3 * bench.field_radius,
        "ccds": len(camera),
    }
    columns = {
        name: (np.concatenate(values), unit, text)
        for name, values, unit, text in (
            ("field_deg", [np.full(p[..., 0].size, a) for a, p in rays.items()], "deg", "field angle along y"),
            ("ray", [_numbers(p, 0) for p in rays.values()], "", "ray of that field"),
            ("point", [_numbers(p, 1) for p in rays.values()], "", "0 where it comes in, then surface by surface"),
            ("y_m", [p[..., 0].ravel() for p in rays.values()], "m", "telescope y"),
            ("z_m", [p[..., 1].ravel() for p in rays.values()], "m", "telescope z from the vertex of M1"),
        )
    }
    agrees = abs(figures.focal_length - 10.3) < 0.05 and abs(figures.f_number - 1.23) < 0.01 and len(camera) == 189
    return Reproduced(
        {"": _layout_plot(profiles, rays, camera, bench.field_radius)},
        {"": EcsvData(columns, {"what": f"rays through {telescope.name}, section x = 0", **measured})},
        f'f/{figures.f_number:.3f}, {figures.focal_length:.2f} m, {scale:.4f}"/µm, {figures.effective_area:.1f} m²,'
        f" {len(camera)} CCDs, {0.2 * bench.field_radius * 1e3:.1f} cm",
        agrees,
        'but for the plate scale: 206265"/10.3 m is 0.0200"/µm, so the paper\'s 0.0197 does not go with its own focal'
        " length. The four corner rafts of wavefront sensors are not modelled",
        measured,
    )


def _numbers(paths: np.ndarray, axis: int) -> np.ndarray:
    return np.indices(paths.shape[:2])[axis].ravel()


def _profile(surface: Surface) -> np.ndarray:
    """Return points (y, z) of a surface in section [m], from rim to rim, with NaN in a central hole."""
    return surface_section(surface, outer_radius(surface.aperture) if surface.aperture else _DETECTOR)[:, 1:]


def _ray_paths(telescope: Telescope, angle: float) -> np.ndarray:
    """Return points (y, z) along the rays that arrive [m], shape [n_ray, n_point, 2]."""
    outer = 0.5 * telescope.pupil_diameter
    arm = np.linspace(telescope.pupil_obscuration * outer * 1.01, 0.999 * outer, _LAYOUT_RAYS)
    y = np.concatenate([-arm[::-1], arm])
    field = (0.0, float(np.deg2rad(angle)))
    return ray_paths(telescope, field, telescope.default_wavelength, (np.zeros_like(y), y), _TOP)[..., 1:]


def _layout_plot(
    profiles: Mapping[str, np.ndarray], rays: Mapping[float, np.ndarray], camera: Camera, field_radius: float
) -> bytes:
    """Draw the telescope in section with its rays, and the CCD mosaic."""
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
        left.set(
            xlim=(-5.2, 5.2),
            ylim=(-1.2, _TOP),
            aspect="equal",
            xlabel="y [m]",
            ylabel="z from the vertex of M1, towards the sky [m]",
        )
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
    """Draw the rafts of the wavefront sensors, at the corners of the square around the mosaic."""
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
