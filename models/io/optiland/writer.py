"""Write a telescope as a file of optiland (.json).

The axes are rotated as by the reader of Zemax files: light enters along +z, the first surface is at z = 0. Where stop
and aperture of the design data do not make the entrance pupil, a plane of its own in front carries the stop, so that
the entrance pupil is that of the telescope; the reader takes it off again.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from ....core.errors import PrescriptionError, error_context
from ...aperture import Annulus, Aperture, Circle, Complement, Ellipse, Rectangle
from ...design_data import DesignData
from ...paraxial import stop_states_rays, with_true_aperture
from ...rotation import rotation_angles
from ...surface import Interaction
from ...telescope import Telescope
from ..lens.apertures import report_aperture
from ..lens.description import LensSurface
from ..lens.sequence import lens_surfaces, stated_wavelengths
from ..lens.source import Findings
from ..lens.text import scaled
from ..writable import report_obscuration, report_pupil_plane, report_unheld, require_sequential, with_formulas
from .gratings import MODEL, grating_items
from .media import material_items
from .reader import APERTURES, FIELD_TYPES, THIN_LENS_MODEL
from .shapes import geometry_items

MM = 1e-3
#: What surfaces of optiland have, as messages say.
_HELD_APERTURES = "discs, rings, obscuring discs, ellipses and rectangles along x"
#: Keys of the aperture by that of the design data; a working focal ratio has none.
_APERTURES = {kind: key for key, kind in APERTURES.items()}


def telescope_to_optiland(telescope: Telescope, *, lenient: bool = False) -> str:
    """Return the text of a file of optiland.

    PrescriptionError, with surface and part, if a part of the telescope has no counterpart in optiland; pickups, solves
    and apertures without one are left out with a warning where `lenient`.
    """
    t, findings = with_optiland_aperture(with_true_aperture(telescope)), Findings(lenient)
    with error_context(subject=t.name):
        require_sequential(t, "a file of optiland")
        t = with_formulas(t, material_items, findings)
        data = t.design_data
        flags = ["afocal"] if data.afocal else []
        report_unheld(t, (*data.pickups, *data.solves), "a file of optiland", lenient=lenient, others=flags)
        stop, system = own_stop(t), system_items(t, findings)
        report_pupil_plane(t, findings, own_stop=stop is not None)
        first = -t.surfaces[0].vertex[2]
        before = material_items(t.medium_before)
        surfaces: list[dict[str, Any]] = [
            {
                "type": "ObjectSurface",
                "geometry": {"type": "Plane", "cs": _system(-t.object_distance - first), "radius": math.inf},
                "material_post": before,
                "comment": "",
            }
        ]
        for surface in lens_surfaces(t, stop):
            with error_context(subject=f"surface {surface.name}"):
                items = _surface_items(surface, first)
            if surface.aperture is not None:
                items["aperture"] = _aperture_items(surface.aperture)
                if items["aperture"] is None:
                    report_aperture(surface.name, surface.aperture, "a file of optiland", _HELD_APERTURES, findings)
            surfaces.append(items)
        report_obscuration(t, findings, "a file of optiland")
    heights = [s["geometry"]["cs"]["z"] for s in surfaces]
    for items, height, next_height in zip(surfaces[1:], heights[1:], [*heights[2:], heights[-1]], strict=True):
        items["thickness"] = (next_height - height) / MM
    for items in surfaces:
        _in_millimetres(items["geometry"]["cs"])
    content = {
        "version": 1.0,
        "name": t.description or t.name,
        **system,
        "apodization": None,
        "pickups": [],
        "solves": {"solves": []},
        "surface_group": {"surfaces": surfaces},
    }
    return json.dumps(content, indent=1) + "\n"


def _system(z: float, x: float = 0.0, y: float = 0.0, axes: np.ndarray | None = None) -> dict[str, Any]:
    """Return a coordinate system [m] [rad]: rotations about x, then the old y, then the old z."""
    turn = np.eye(3) if axes is None else axes
    # The transpose is the product of the opposite rotations in the order of rotation_angles.
    angles = tuple(-v for v in rotation_angles(turn.T))
    places = dict(zip(("x", "y", "z", "rx", "ry", "rz"), (x, y, z, *(v + 0.0 for v in angles)), strict=True))
    return {**places, "reference_cs": None}


def _in_millimetres(system: dict[str, Any]) -> None:
    for key in "xyz":
        system[key] /= MM


def _surface_items(surface: LensSurface, first: float) -> dict[str, Any]:
    x, y, z = map(float, surface.position)
    grating = surface.grating
    geometry = geometry_items(surface.shape, MM) if grating is None else grating_items(grating, surface.shape, MM)
    return {
        "type": "Surface",
        "thickness": 0.0,
        "geometry": {**geometry, "cs": _system(z - first, x, y, surface.axes)},
        "material_post": material_items(surface.after),
        "is_stop": surface.stop,
        "aperture": None,
        "comment": surface.name,
        "interaction_model": {
            **_model(surface),
            "is_reflective": surface.interaction == Interaction.MIRROR,
            "coating": None,
            "bsdf": None,
        },
    }


def _model(surface: LensSurface) -> dict[str, Any]:
    """Return the type of interaction of light with a surface, and the focal length of a thin lens."""
    if surface.thin_lens is not None:
        return {"type": THIN_LENS_MODEL, "focal_length": surface.thin_lens.focal_length / MM}
    return {"type": "RefractiveReflectiveModel" if surface.grating is None else MODEL}


def _aperture_items(aperture: Aperture) -> dict[str, Any] | None:
    """Return the entries of a clear region, or None where optiland has no such aperture."""
    region = aperture.part if isinstance(aperture, Complement) else aperture
    if isinstance(region, Rectangle) and region is aperture and region.angle == 0:
        ends = {
            f"{axis}_{end}": (centre + sign * 0.5 * size) / MM
            for axis, centre, size in (("x", region.x, region.width), ("y", region.y, region.height))
            for end, sign in (("min", -1), ("max", 1))
        }
        return {"type": "RectangularAperture", **ends}
    if isinstance(region, Ellipse) and region is aperture and region.angle == 0:
        sizes = {"a": region.semi_x, "b": region.semi_y, "offset_x": region.x, "offset_y": region.y}
        return {"type": "EllipticalAperture", **{key: value / MM for key, value in sizes.items()}}
    if isinstance(region, Circle) or (isinstance(region, Annulus) and region is aperture):
        inner, outer = (0.0, region.radius) if isinstance(region, Circle) else (region.inner, region.outer)
        if region is not aperture:
            inner, outer = outer, math.inf
        radii = {"r_max": outer / MM, "r_min": inner / MM}
        if region.x or region.y:
            return {"type": "OffsetRadialAperture", **radii, "offset_x": region.x / MM, "offset_y": region.y / MM}
        return {"type": "RadialAperture", **radii}
    return None


def with_optiland_aperture(t: Telescope) -> Telescope:
    """Return a telescope whose working focal ratio, which optiland has not, is the aperture at the object instead."""
    if t.design_data.aperture != "working_f_number" or not math.isfinite(t.object_distance):
        return t
    half_angle = math.atan(0.5 * t.pupil_diameter / abs(t.object_distance - t.stop_z))
    index = float(t.medium_before.index(t.default_wavelength))
    return t.with_design(aperture="object_na", aperture_value=index * math.sin(half_angle))


def own_stop(t: Telescope) -> str | None:
    """Return the surface that is the stop in a file of optiland, None where a plane in front has to be it.

    PrescriptionError for a telecentric object space without a stop and the aperture that optiland has for it.
    """
    data = t.design_data
    stop = data.stop if data.aperture in _APERTURES and stop_states_rays(t) else None
    if data.telecentric and (stop is None or data.aperture != "object_na"):
        raise PrescriptionError("a telecentric object space needs its stop, and object_na as aperture, in optiland")
    return stop


def system_items(t: Telescope, findings: Findings) -> dict[str, Any]:
    """Return the entries of aperture, fields, wavelengths and ray aiming.

    PrescriptionError for vignetting factors that optiland has not; if lenient, all are left out with a warning.
    """
    data, stop = t.design_data, own_stop(t)
    aperture: dict[str, Any] = {"type": "EPD", "value": t.pupil_diameter / MM}
    if stop is not None and data.aperture is not None and data.aperture_value is not None:
        kind = _APERTURES[data.aperture]
        size = {"EPD": 1 / MM, "float_by_stop_size": 2 / MM}.get(kind, 1.0)
        aperture = {"type": kind, "value": data.aperture_value * size}
    items = {"aperture": aperture, "fields": _fields(t, findings), "wavelengths": _wavelengths(t)}
    if stop is not None and data.aiming != "off":
        if data.aiming == "paraxial":
            problem = PrescriptionError("aiming = paraxial: optiland aims at the radius of the real marginal ray alone")
            findings.note(problem, "read back it is real")
        items["ray_tracer"] = {"ray_aiming_config": {"mode": "robust", "max_iter": 100, "tol": 1e-10}}
    return items


def _fields(t: Telescope, findings: Findings) -> dict[str, Any]:
    data, kind = t.design_data, "angle"
    edge = math.degrees(t.field_radius)
    rows = [(0.0, fraction * edge, 0.0, 0.0, 1.0) for fraction in (0.0, 0.7, 1.0)]
    if data.fields:
        kind = data.field_type
        size = math.degrees(1.0) if kind == "angle" else 1 / MM
        weights = data.field_weights or (1.0,) * len(data.fields)
        factors = [(x, y) for _, _, x, y, _ in data.vignetting] or [(0.0, 0.0)] * len(data.fields)
        moved = next((row for row in data.vignetting if row[0] or row[1] or row[4]), None)
        if moved is not None:
            problem = f"vignetting = {list(moved)}: optiland has compressions alone, no decentre and no angle"
            # Compressions without their decentres would let other light through.
            findings.report(PrescriptionError(problem), "the factors of all fields are left out")
            factors = [(0.0, 0.0)] * len(data.fields)
        rows = [
            (-x * size + 0.0, y * size, *compression, weight)
            for (x, y), compression, weight in zip(data.fields, factors, weights, strict=True)
        ]
    keys = ("x", "y", "vx", "vy", "weight")
    definition = next(name for name, field_type in FIELD_TYPES.items() if field_type == kind)
    return {
        "fields": [dict(zip(keys, row, strict=True)) for row in rows],
        "telecentric": data.telecentric,
        "field_definition": {"field_type": definition},
    }


def _wavelengths(t: Telescope) -> dict[str, Any]:
    """Return the stated wavelengths, or the default and the edges of the band."""
    data: DesignData = t.design_data
    lengths = stated_wavelengths(t)
    weights = data.wavelength_weights or (1.0,) * len(lengths)
    rows = [
        {"value": scaled(length, 6), "is_primary": length == t.default_wavelength, "unit": "um", "weight": weight}
        for length, weight in zip(lengths, weights, strict=True)
    ]
    return {"wavelengths": rows, "polarization": "ignore"}
