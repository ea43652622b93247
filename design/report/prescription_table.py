"""Prescription and first-order data as tables of text, in a unit of length and with the signs of lens design.

The z axis points along the incoming light, as in Zemax: a thickness is the distance to the next vertex along it,
negative after a mirror that is no flat fold, and a positive radius has its centre behind the surface. In the telescope
frame z points the other way.
"""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np

from ...core.errors import DomainError, PachonError
from ...core.units import ARCSEC
from ...models.central_obscuration import central_obscuration
from ...models.first_order import first_order, seidel_sums
from ...models.media.medium import ConstantIndex
from ...models.parabasal import parabasal_optics
from ...models.shapes.shape import Rotational
from ...models.surface import Interaction, Surface
from ...models.telescope import Telescope
from ...models.unfolding import axial_heights, unfolded_axis
from ..metrics.principal_rays import principal_rays

COLUMNS = ("surface", "type", "radius", "thickness", "medium", "index", "semi-diameter", "conic", "coefficients, place")
_TYPES = {
    Interaction.MIRROR: "mirror",
    Interaction.REFRACT: "lens surface",
    Interaction.DETECTOR: "detector",
    Interaction.PASS: "baffle",
    Interaction.PHASE: "phase screen",
    Interaction.THIN_LENS: "thin lens",
}


def prescription_rows(telescope: Telescope, wavelength: float, semi_diameters: dict[str, float]) -> list[list[str]]:
    """Return a row of text for each surface, in the order of :data:`COLUMNS`.

    Semi-diameters are in metres by name of the surface; the wavelength [m] is that of the indices.
    """
    _, unit = telescope.length_unit
    surfaces, heights = telescope.surfaces, axial_heights(telescope)
    rows = []
    for i, surface in enumerate(surfaces):
        shape, mirror = surface.shape, surface.interaction == Interaction.MIRROR
        following = surfaces[i + 1].name if i + 1 < len(surfaces) else None
        thickness = math.nan if following is None else (heights[surface.name] - heights[following]) / unit
        medium = surface.medium_after
        index = float(medium.index(wavelength))
        bare = isinstance(medium, ConstantIndex) and not medium.name
        name = "mirror" if mirror else medium.name or ("" if bare and index == 1.0 else "glass")
        rows.append(
            [
                surface.name,
                _TYPES[surface.interaction] + (", stop" if surface.name == telescope.design_data.stop else ""),
                _number(-1.0 / shape.curvature / unit) if shape.curvature else "flat",
                _number(thickness),
                name,
                "" if index == 1.0 else f"{index:.6f}",
                _number(semi_diameters.get(surface.name, math.nan) / unit, 6),
                f"{shape.conic:.8g}" if isinstance(shape, Rotational) and shape.conic else "",
                _more(surface, unit),
            ]
        )
    return rows


def _number(value: float, digits: int = 8) -> str:
    return f"{value:.{digits}g}" if math.isfinite(value) else ""


def _more(surface: Surface, unit: float) -> str:
    """Return coefficients, kind of shape, grating, decentre and tilt of a surface as text."""
    shape, parts = surface.shape, []
    if isinstance(shape, Rotational):
        # Lengths over powers of lengths; z has the other sign.
        powers = range(4, 4 + 2 * len(shape.coefficients), 2)
        pairs = zip(powers, shape.coefficients, strict=True)
        parts += [f"r^{n}: {-a * unit ** (n - 1):.6g}" for n, a in pairs if a]
    else:
        parts.append(type(shape).__name__)
    if surface.thin_lens is not None:
        parts.append(f"focal length {surface.thin_lens.focal_length / unit:.8g}")
    if surface.grating is not None:
        parts.append(str(surface.grating))
    x, y, _ = surface.vertex
    if x or y:
        parts.append(f"decentred by x {x / unit:.6g}, y {y / unit:.6g}")
    tilt = math.degrees(math.acos(min(1.0, float(surface.matrix[2, 2]))))
    if not np.array_equal(surface.matrix, np.eye(3)):
        parts.append(f"axis tilted by {tilt:.6g}°")
    return "; ".join(parts)


def first_order_rows(telescope: Telescope, wavelength: float) -> list[tuple[str, str]]:
    """Return names and values of the first-order data at a wavelength [m]; of centred telescopes all of them."""
    name, unit = telescope.length_unit

    def text(value: float) -> str:
        return f"{value / unit:.8g} {name}" if math.isfinite(value) else "at infinity"

    low, high = telescope.band or telescope.wavelength_range
    pupil = f"diameter {text(telescope.pupil_diameter)}, obscuration {central_obscuration(telescope):.5g}"
    rows = [
        ("wavelength", f"{wavelength * 1e9:.6g} nm; band {low * 1e9:.6g} to {high * 1e9:.6g} nm"),
        ("field of view", f"radius {math.degrees(telescope.field_radius):.6g}°"),
        ("entrance pupil", pupil),
    ]
    if math.isfinite(telescope.object_distance):
        rows.append(("object", f"{text(telescope.object_distance - telescope.stop_z)} from the entrance pupil"))
    stated = len(rows)
    with contextlib.suppress(DomainError):
        optics = first_order(telescope, wavelength)
        axis = unfolded_axis(telescope)
        detector = axis.heights[telescope.surfaces[-1].name]
        lens = [
            ("effective focal length", text(optics.focal_length)),
            ("focal ratio", f"f/{abs(optics.f_number):.6g}"),
            ("back focus", text(optics.back_focus)),
            ("plate scale", f"{abs(optics.plate_scale) / ARCSEC * unit:.6g} arcsec/{name}"),
        ]
        if math.isfinite(telescope.object_distance):
            last = [s for s in axis.surfaces if not s.fold][-1]
            lens = [
                ("effective focal length", text(optics.focal_length)),
                ("magnification", f"{optics.magnification:.8g}"),
                ("working focal ratio", f"f/{optics.working_f_number:.6g}"),
                ("paraxial image", f"{text(abs(optics.image_z - last.z))} from the last surface"),
            ]
        if telescope.design_data.afocal:
            lens = [("angular magnification", f"{optics.angular_magnification:.8g}")]
        rows += [
            *lens,
            ("exit pupil", f"{text(detector - optics.exit_pupil_z)} from the detector along the incoming light"),
            ("diameter of the exit pupil", text(optics.exit_pupil_diameter)),
            ("Petzval radius", text(_petzval_radius(telescope, wavelength))),
            ("effective area", f"{optics.effective_area / unit**2:.6g} {name}²"),
        ]
    return rows if len(rows) > stated else [*rows, *_parabasal_rows(telescope, wavelength)]


def _parabasal_rows(telescope: Telescope, wavelength: float) -> list[tuple[str, str]]:
    """Return first-order data about the chief ray, in two planes, and focal ratios of real rays; none without a focus.

    The ratios are what sets the diffraction limit.
    """
    if math.isfinite(telescope.object_distance) or telescope.design_data.afocal:
        return []
    try:
        optics = parabasal_optics(telescope, wavelength)
        rays = principal_rays(telescope, [(0.0, 0.0)], wavelength)
    except PachonError:
        return []
    name, unit = telescope.length_unit
    if not (np.isfinite(optics.focal_length).all() and np.isfinite(rays.f_number[0]).all()):
        return []

    def both(pair: np.ndarray, size: float = unit, digits: int = 8) -> str:
        return ", ".join(f"{v / size:.{digits}g}" if math.isfinite(v) else "at infinity" for v in pair)

    about = "about the chief ray of the axis, in the plane of y and z, and across it"
    return [
        ("effective focal lengths", f"{both(optics.focal_length)} {name}, {about}"),
        ("focal ratios", ", ".join(f"f/{v:.6g}" for v in optics.f_number)),
        ("working focal ratios", ", ".join(f"f/{v:.6g}" for v in rays.f_number[0])),
        ("plate scales", f"{both(optics.plate_scale, ARCSEC / unit, 6)} arcsec/{name}"),
        ("foci", f"{both(optics.back_focus)} {name} behind the last mirror or lens surface"),
        (
            "exit pupils",
            f"{both(optics.exit_pupil_distance)} {name} behind it, diameters {both(optics.exit_pupil_diameter)} {name}",
        ),
    ]


def _petzval_radius(telescope: Telescope, wavelength: float) -> float:
    """Return the radius of the Petzval surface [m]: H^2 over the fourth Seidel sum (Welford, section 8.7)."""
    total: Any = seidel_sums(telescope, wavelength, 1e-3).total[3]
    lagrange = 0.5 * telescope.pupil_diameter * math.tan(1e-3) * float(telescope.medium_before.index(wavelength))
    return abs(lagrange**2 / total) if abs(total) > 1e-12 * lagrange**2 else math.inf
