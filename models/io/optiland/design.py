"""Aperture, fields, wavelengths and ray aiming of a telescope as entries of a file of optiland.

The stop and the stated aperture are written where they make the entrance pupil; else the diameter of the pupil, with
a plane of its own for the stop. Fields are in degrees or millimetres, rotated with the axes: x changes its sign.
"""

from __future__ import annotations

import math
from typing import Any

from ....core.errors import PrescriptionError
from ...design_data import DesignData
from ...paraxial import stop_states_rays
from ...telescope import Telescope
from ..lens.sequence import stated_wavelengths
from ..lens.source import Findings
from ..lens.text import scaled
from .reader import APERTURES, FIELD_TYPES

MM = 1e-3
#: Keys of the aperture by that of the design data; a working focal ratio has none.
_APERTURES = {kind: key for key, kind in APERTURES.items()}


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
