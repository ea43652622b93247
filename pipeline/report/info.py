"""Lens table and first-order properties of a telescope, as numbers and as text."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np

from ...core.errors import DomainError
from ...core.units import ARCSEC
from ...models.aperture import Annulus, Circle, Complement
from ...models.first_order import first_order
from ...models.io.prescription import bundled_names, load_telescope
from ...models.io.yaml.apertures import aperture_items
from ...models.io.yaml.values import Turn, flow
from ...models.io.yaml.writer import INTERACTION_NAMES
from ...models.media.medium import ConstantIndex
from ...models.shapes.shape import Rotational
from ...models.surface import Surface
from ...models.telescope import Telescope

#: First-order properties, which only a centred telescope has.
FIRST_ORDER_KEYS = (
    "focal_length_m",
    "f_number",
    "plate_scale_arcsec_per_um",
    "exit_pupil_z_m",
    "exit_pupil_diameter_m",
    "focus_z_m",
)


def list_models() -> list[dict[str, Any]]:
    """Return name, description and source of each bundled model."""
    telescopes = [load_telescope(name) for name in bundled_names()]
    return [{"name": t.name, "description": t.description, "source": t.source} for t in telescopes]


def describe(telescope: Telescope) -> dict[str, Any]:
    """Return the lens table and the first-order properties of a telescope; keys end in their unit.

    The first-order properties of a telescope whose surfaces do not share one axis, as built or folded, are None.
    """
    first: dict[str, float | None] = dict.fromkeys(FIRST_ORDER_KEYS)
    with contextlib.suppress(DomainError):
        optics = first_order(telescope)
        first = {
            "focal_length_m": optics.focal_length,
            "f_number": optics.f_number,
            "plate_scale_arcsec_per_um": abs(optics.plate_scale) / ARCSEC * 1e-6,
            "exit_pupil_z_m": optics.exit_pupil_z,
            "exit_pupil_diameter_m": optics.exit_pupil_diameter,
            "focus_z_m": optics.focus_z,
        }
    wavelength = telescope.default_wavelength
    low, high = telescope.band or telescope.wavelength_range
    return {
        "name": telescope.name,
        "description": telescope.description,
        "source": telescope.source,
        "version": telescope.version,
        "wavelength_nm": wavelength * 1e9,
        "band_nm": [low * 1e9, high * 1e9],
        **first,
        "pupil_diameter_m": telescope.pupil_diameter,
        "pupil_obscuration": telescope.pupil_obscuration,
        "effective_area_m2": 0.25 * math.pi * telescope.pupil_diameter**2 * (1.0 - telescope.pupil_obscuration**2),
        "entrance_pupil_z_m": telescope.stop_z,
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
        "type": INTERACTION_NAMES[surface.interaction],
        "shape": type(shape).__name__.lower(),
        "radius_m": 1.0 / curvature if curvature else None,
        "conic": shape.conic if isinstance(shape, Rotational) else None,
        "coefficients": list(shape.coefficients) if isinstance(shape, Rotational) else [],
        "x_m": x,
        "y_m": y,
        "z_m": z,
        "tilted": not np.array_equal(surface.matrix, np.eye(3)),
        "index_after": float(medium.index(wavelength)),
        "medium_after": "" if isinstance(medium, ConstantIndex) else "glass",
        "clear_m": _clear(surface),
        "aperture": flow(aperture_items(surface.aperture), _degrees)[1:-1],
    }


def _degrees(value: float) -> str:
    """Return the text of a number, angles in degrees."""
    return f"{math.degrees(value) if isinstance(value, Turn) else value:g}"


def _clear(surface: Surface) -> list[float | None] | None:
    """Return inner and outer radius [m] of a disc, a ring, or all but a disc (no outer radius); None of all else."""
    aperture = surface.aperture
    if isinstance(aperture, Circle):
        return [0.0, aperture.radius]
    if isinstance(aperture, Annulus):
        return [aperture.inner, aperture.outer]
    if isinstance(aperture, Complement) and isinstance(aperture.part, Circle):
        return [aperture.part.radius, None]
    return None


def _clear_text(row: dict[str, Any]) -> str:
    if row["clear_m"] is None:
        return "another region" if row["aperture"] else ""
    inner, outer = row["clear_m"]
    return f"from {inner:g}" if outer is None else f"{inner:g} to {outer:g}"


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
            _clear_text(s),
        )
        for s in description["surfaces"]
    ]


def figure_rows(description: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the first-order properties as text: name, and value with unit."""
    d = description
    if d["focal_length_m"] is None:
        lens, image = [("first-order figures", "none: the surfaces do not share one axis")], []
    else:
        lens = [
            ("focal length", f"{d['focal_length_m']:.4f} m"),
            ("focal ratio", f"f/{d['f_number']:.4f}"),
            ("plate scale", f'{d["plate_scale_arcsec_per_um"]:.6f}"/µm'),
        ]
        image = [
            ("exit pupil", f"{d['exit_pupil_diameter_m']:.4f} m at z = {d['exit_pupil_z_m']:.4f} m"),
            ("paraxial focus", f"z = {d['focus_z_m']:.7f} m"),
        ]
    return [
        *lens,
        ("entrance pupil", f"{d['pupil_diameter_m']:g} m at z = {d['entrance_pupil_z_m']:g} m"),
        ("central obscuration", f"{d['pupil_obscuration']:g} of the diameter"),
        ("collecting area", f"{d['effective_area_m2']:.2f} m²"),
        *image,
        ("field of view", f"radius {d['field_radius_deg']:g}°, model good to {d['field_limit_deg']:g}°"),
        ("band", "{:g} to {:g} nm".format(*(round(w, 3) for w in d["band_nm"]))),
        ("camera", d["camera"] or "none"),
    ]
