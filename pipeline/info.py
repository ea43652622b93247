"""What a telescope is made of: its lens table and its first-order figures, as numbers and as text."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..models.first_order import first_order
from ..models.glass import ConstantIndex
from ..models.prescription import bundled_names, load_telescope
from ..models.surface import Annulus, Circle, Surface
from ..models.telescope import Telescope
from .photometry import ARCSEC


def list_models() -> list[dict[str, Any]]:
    """Return name, description and source of each bundled model."""
    telescopes = [load_telescope(name) for name in bundled_names()]
    return [{"name": t.name, "description": t.description, "source": t.source} for t in telescopes]


def describe(telescope: Telescope) -> dict[str, Any]:
    """Return the lens table and the first-order figures of a telescope; keys end in their unit."""
    figures = first_order(telescope)
    wavelength = telescope.default_wavelength
    low, high = telescope.band or telescope.wavelength_range
    return {
        "name": telescope.name,
        "description": telescope.description,
        "source": telescope.source,
        "version": telescope.version,
        "wavelength_nm": wavelength * 1e9,
        "band_nm": [low * 1e9, high * 1e9],
        "focal_length_m": figures.focal_length,
        "f_number": figures.f_number,
        "plate_scale_arcsec_per_um": abs(figures.plate_scale) / ARCSEC * 1e-6,
        "pupil_diameter_m": telescope.pupil_diameter,
        "pupil_obscuration": telescope.pupil_obscuration,
        "effective_area_m2": figures.effective_area,
        "entrance_pupil_z_m": figures.entrance_pupil_z,
        "exit_pupil_z_m": figures.exit_pupil_z,
        "exit_pupil_diameter_m": figures.exit_pupil_diameter,
        "focus_z_m": figures.focus_z,
        "field_radius_deg": math.degrees(telescope.field_radius),
        "field_limit_deg": math.degrees(telescope.field_limit),
        "camera": telescope.camera,
        "groups": {name: list(members) for name, members in telescope.groups.items()},
        "surfaces": [_row(surface, wavelength) for surface in telescope.surfaces],
    }


def _row(surface: Surface, wavelength: float) -> dict[str, Any]:
    shape, medium = surface.shape, surface.medium_after
    curvature = shape.curvature
    x, y, z = surface.vertex
    return {
        "name": surface.name,
        "type": surface.interaction.name.lower(),
        "shape": type(shape).__name__.lower(),
        "radius_m": 1.0 / curvature if curvature else None,
        "conic": shape.conic,
        "coefficients": list(shape.coefficients),
        "x_m": x,
        "y_m": y,
        "z_m": z,
        "tilted": not np.array_equal(surface.matrix, np.eye(3)),
        "index_after": float(medium.index(wavelength)),
        "medium_after": "" if isinstance(medium, ConstantIndex) else "glass",
        "clear_m": _clear(surface),
    }


def _clear(surface: Surface) -> list[float] | None:
    """Return inner and outer radius of the clear region [m]; None without an edge."""
    aperture = surface.aperture
    if isinstance(aperture, Circle):
        return [0.0, aperture.radius]
    if isinstance(aperture, Annulus):
        return [aperture.inner, aperture.outer]
    return None


SURFACE_COLUMNS = (
    "surface",
    "type",
    "radius [m]",
    "conic",
    "r^4, r^6, r^8...",
    "z [m]",
    "index after",
    "clear radius [m]",
)


def surface_rows(description: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the lens table as text, in the columns of :data:`SURFACE_COLUMNS`."""
    return [
        (
            s["name"],
            s["type"] + (" (tilted)" if s["tilted"] else ""),
            "flat" if s["radius_m"] is None else f"{s['radius_m']:.7g}",
            f"{s['conic']:g}" if s["conic"] else "",
            ", ".join(f"{c:g}" for c in s["coefficients"]),
            f"{s['z_m']:.7f}",
            f"{s['index_after']:.6f}" if s["medium_after"] else "",
            "" if s["clear_m"] is None else "{:g} to {:g}".format(*s["clear_m"]),
        )
        for s in description["surfaces"]
    ]


def figure_rows(description: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the first-order figures as text: what, and its value with unit."""
    d = description
    return [
        ("focal length", f"{d['focal_length_m']:.4f} m"),
        ("focal ratio", f"f/{d['f_number']:.4f}"),
        ("plate scale", f'{d["plate_scale_arcsec_per_um"]:.6f}"/µm'),
        ("entrance pupil", f"{d['pupil_diameter_m']:g} m at z = {d['entrance_pupil_z_m']:g} m"),
        ("central obscuration", f"{d['pupil_obscuration']:g} of the diameter"),
        ("collecting area", f"{d['effective_area_m2']:.2f} m²"),
        ("exit pupil", f"{d['exit_pupil_diameter_m']:.4f} m at z = {d['exit_pupil_z_m']:.4f} m"),
        ("paraxial focus", f"z = {d['focus_z_m']:.7f} m"),
        ("field of view", f"radius {d['field_radius_deg']:g}°, model good to {d['field_limit_deg']:g}°"),
        ("band", "{:g} to {:g} nm".format(*(round(w, 3) for w in d["band_nm"]))),
        ("camera", d["camera"] or "none"),
    ]
