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
from ...paraxial import with_true_aperture
from ...rotation import rotation_angles
from ...surface import Interaction
from ...telescope import Telescope
from ..lens.description import LensSurface
from ..lens.sequence import lens_surfaces
from ..lens.source import Findings
from ..writable import report_pupil_plane, report_unheld, require_sequential, with_formulas
from .design import MM, own_stop, system_items, with_optiland_aperture
from .media import material_items
from .shapes import geometry_items


def telescope_to_optiland(telescope: Telescope, *, lenient: bool = False) -> str:
    """Return the text of a file of optiland.

    PrescriptionError, with surface and part, if a part of the telescope has no counterpart in optiland; pickups and
    solves have none, and are left out with a warning where `lenient`.
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
            try:
                surfaces.append(_surface_items(surface, first))
            except PrescriptionError as error:
                raise PrescriptionError(f"surface {surface.name}: {error}") from None
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
    region = surface.aperture
    return {
        "type": "Surface",
        "thickness": 0.0,
        "geometry": {**geometry_items(surface.shape, MM), "cs": _system(z - first, x, y, surface.axes)},
        "material_post": material_items(surface.after),
        "is_stop": surface.stop,
        "aperture": None if region is None else _aperture_items(region),
        "comment": surface.name,
        "interaction_model": {
            "type": "RefractiveReflectiveModel",
            "is_reflective": surface.interaction == Interaction.MIRROR,
            "coating": None,
            "bsdf": None,
        },
    }


def _aperture_items(aperture: Aperture) -> dict[str, Any]:
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
    raise PrescriptionError(
        f"aperture {type(region).__name__}: expected disc, ring, obscuring disc, ellipse, rectangle"
    )
