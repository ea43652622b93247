"""Gratings of ray-optics: an order, grooves a millimetre and the normal of the planes that cut them.

Its rays have the opposite order in transmission, and on curved surfaces a constant spacing along the surface, which no
equally spaced planes cut: gratings are read and written on planes.
"""

from __future__ import annotations

import math
from typing import Any

from ....core.errors import PrescriptionError
from ...grating import Grating
from ...shapes.shape import Plane, Shape
from ..json_items import JsonObject
from ..lens.source import Findings
from .items import array, attributes, class_name, instance, numbers

_MODULE = "rayoptics.oprops.doe"
_KIND = "DiffractionGrating"


def grating_of(element: JsonObject, shape: Shape, findings: Findings, *, mirror: bool) -> Grating | None:
    """Return the grooves of a phase element; None of order 0 or, if lenient, of another element."""
    kind = class_name(element)
    if kind != _KIND:
        findings.report(element.problem(f"phase_element {kind}: expected {_KIND}"), "taken as none")
        return None
    values = attributes(element)
    order, lines = values.whole("order"), values.number("_grating_lpmm")
    x, y, z = numbers(values, "grating_normal", 3)
    if z or not (x or y):
        values.refuse("grating_normal", "a vector across the grooves along x and y")
    if not isinstance(shape, Plane):
        text = "phase_element: grooves on a curved surface, equally spaced along it"
        findings.report(element.problem(text), "taken as equally spaced on a plane across")
    if not order:
        return None
    return Grating(order if mirror else -order, lines, math.atan2(-x, y))


def grating_items(grating: Grating, shape: Shape, mode: str) -> dict[str, Any]:
    """Return the items of a grating; PrescriptionError unless it is on a plane."""
    if not isinstance(shape, Plane):
        raise PrescriptionError(f"grating on {type(shape).__name__}: a ray-optics file has those of planes")
    values = {
        "label": "",
        "grating_normal": array([*grating.across, 0.0]),
        "_grating_lpmm": grating.lines_per_mm,
        "_grating_spacing_nm": 1e6 / grating.lines_per_mm,
        "order": grating.order if mode == "reflect" else -grating.order,
        "interact_mode": mode,
        "debug_output": False,
    }
    return instance(_MODULE, _KIND, values)
