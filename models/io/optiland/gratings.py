"""Gratings of optiland: an order, a period [um] and the angle of the grooves from the x axis [rad].

They are geometries of their own, `PlaneGrating` and `StandardGratingGeometry`, with a `DiffractiveInteractionModel`; or
a plane with a linear phase profile, whose period is in millimetres and whose angle is that of the vector across.
"""

from __future__ import annotations

import math
from typing import Any

from ....core.errors import PrescriptionError
from ...grating import Grating
from ...shapes.shape import Conic, Plane, Shape, Sphere
from ..json_items import JsonObject

#: Geometries with grooves.
GRATINGS = ("PlaneGrating", "StandardGratingGeometry")
#: Keys of the grooves.
GROOVES = ("order", "period", "angle")
#: Interaction of light with grooves.
MODEL = "DiffractiveInteractionModel"
#: Interaction of light with a phase profile.
PHASE_MODEL = "PhaseInteractionModel"


def grating_of(geometry: JsonObject) -> Grating | None:
    """Return the grooves of a geometry; None of order 0 or without them."""
    if geometry.text("type") not in GRATINGS:
        return None
    return _grating(geometry, 1e-3, geometry.number("angle"))


def phase_grating(profile: JsonObject) -> Grating | None:
    """Return the grooves of a linear phase profile; PrescriptionError of another profile."""
    kind = profile.text("phase_type", "")
    if kind != "linear_grating":
        raise profile.problem(f"phase profile {kind}: expected linear_grating")
    return _grating(profile, 1.0, profile.number("angle", 0.0) - 0.5 * math.pi)


def _grating(items: JsonObject, unit: float, angle: float) -> Grating | None:
    """Return the grooves of a period in a unit [mm]."""
    order = items.whole("order")
    if order == 0:
        return None
    period = items.number("period", infinite=True)
    if math.isinf(period):
        return None
    if not period > 0:
        items.refuse("period", "a positive number")
    return Grating(order, 1.0 / (period * unit), angle + 0.0)


def grating_items(grating: Grating, shape: Shape, unit: float) -> dict[str, Any]:
    """Return the dictionary of the geometry of a grating, lengths in a unit [m]; PrescriptionError unless a conic."""
    if not isinstance(shape, Plane | Sphere | Conic):
        raise PrescriptionError(f"grating on {type(shape).__name__}: optiland has gratings on conics alone")
    period = 1e3 / grating.lines_per_mm
    grooves = {"order": float(grating.order), "period": period, "angle": grating.groove_angle}
    if isinstance(shape, Plane):
        return {"type": "PlaneGrating", "radius": math.inf, **grooves}
    return {"type": "StandardGratingGeometry", "radius": shape.radius / unit, "conic": shape.conic, **grooves}
