"""Translate a file of optiland (.json) into the terms of a Zemax file.

The file is the dictionary of an ``Optic`` of optiland 0.5 and later, as ``save_optiland_file`` writes it: lengths in
millimetres, wavelengths with a unit, angles of fields in degrees, rotations in radians about z, then y, then x of the
frame around. Places are absolute. Values of pick-ups and solves stand in the file.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ..json_items import JsonObject
from ..lens.source import Findings
from ..zemax.file import ZemaxFile
from ..zemax.placed import Line, PlacedSurfaces
from .media import glass_lines
from .shapes import shape_lines

#: Keys of the file without effect on the paths of rays.
IGNORED = ("version", "pickups", "solves")
APERTURES = {"EPD": "ENPD", "imageFNO": "FNUM", "objectNA": "OBNA", "float_by_stop_size": "FLOA"}
FIELD_TYPES = {"AngleField": 0, "ObjectHeightField": 1, "ParaxialImageHeightField": 2, "RealImageHeightField": 3}
#: Ray aiming of Zemax by that of optiland; "paraxial" aims at the paraxial entrance pupil, as Zemax does without.
AIMING = {"paraxial": 0, "iterative": 2, "robust": 2, "cached": 2}
#: Micrometres of a unit of wavelength.
WAVE_UNITS = {"nm": 1e-3, "um": 1.0, "mm": 1e3, "cm": 1e4, "m": 1e6}


def read_optiland_file(path: Path, findings: Findings) -> ZemaxFile:
    """Return the parts of a file of optiland in the terms of a Zemax file."""
    root = JsonObject.read(path)
    if "surface_group" not in root:
        raise root.problem("expected the JSON file of an optiland Optic, with a surface_group")
    surfaces = list(root.child("surface_group").children("surfaces", "surface"))
    if len(surfaces) < 3:
        raise root.problem(f"{len(surfaces)} surfaces: expected an object, an image and one between")
    found = PlacedSurfaces(path, "optiland")
    found.head("UNIT", "MM")
    found.head("NAME", root.text("name", ""))
    stop_radius = _system(root, found, findings)
    _object(surfaces[0], surfaces[1], found, findings)
    for surface in surfaces[1:]:
        _surface(surface, found, stop_radius, findings)
    root.report_rest(findings, IGNORED)
    return found.file()


def _system(root: JsonObject, found: PlacedSurfaces, findings: Findings) -> float:
    """Add aperture, fields and wavelengths to the header; return the semi-diameter of the stop, 0 if not stated."""
    aperture = root.child("aperture", "aperture")
    kind = aperture.text("type")
    if kind not in APERTURES:
        aperture.refuse("type", f"one of {', '.join(APERTURES)}")
    value = aperture.number("value")
    if APERTURES[kind] == "FLOA":
        found.head("FLOA")
    else:
        found.head(APERTURES[kind], value, "0")
    fields = root.child("fields", "fields")
    points = list(fields.children("fields", "field"))
    definition = fields.child("field_definition")
    kind_of_field = definition.text("field_type")
    if kind_of_field not in FIELD_TYPES:
        definition.refuse("field_type", f"one of {', '.join(FIELD_TYPES)}")
    waves = list(root.child("wavelengths").children("wavelengths", "wavelength"))
    head = (FIELD_TYPES[kind_of_field], int(fields.flag("telecentric")), len(points), len(waves))
    found.head("FTYP", *map(str, head))
    for keyword, key, default in (
        *(("XFLN", "x", None), ("YFLN", "y", None), ("FWGN", "weight", 1.0)),
        *(("VCXN", "vx", 0.0), ("VCYN", "vy", 0.0)),
    ):
        found.head(keyword, *(point.number(key, default) for point in points))
    for point in points:
        point.report_rest(findings)
    primary = 1
    for number, wave in enumerate(waves, start=1):
        unit = wave.text("unit", "um")
        if unit not in WAVE_UNITS:
            wave.refuse("unit", f"one of {', '.join(WAVE_UNITS)}")
        found.head("WAVM", str(number), wave.number("value") * WAVE_UNITS[unit], wave.number("weight", 1.0))
        primary = number if wave.flag("is_primary") else primary
    found.head("PWAV", str(primary))
    _aiming(root, found)
    return 0.5 * value if APERTURES[kind] == "FLOA" else 0.0


def _aiming(root: JsonObject, found: PlacedSurfaces) -> None:
    if "ray_tracer" not in root:
        return
    tracer = root.child("ray_tracer", "ray_tracer")
    if "ray_aiming_config" in tracer:
        mode = tracer.child("ray_aiming_config").text("mode", "paraxial")
        if mode not in AIMING:
            raise tracer.problem(f"ray_aiming_config.mode = {mode!r}: expected one of {', '.join(AIMING)}")
        found.head("RAIM", "0", str(AIMING[mode]))


def _object(surface: JsonObject, first: JsonObject, found: PlacedSurfaces, findings: Findings) -> None:
    geometry = surface.child("geometry")
    height = geometry.child("cs").number("z", infinite=True)
    place, _ = _frame(first.child("geometry").child("cs"))
    lines = glass_lines(surface.child("material_post"), found, findings)
    found.object(math.inf if math.isinf(height) else float(place[2]) - height, lines)
    if geometry.text("type") != "Plane":
        findings.report(geometry.problem("geometry: curved objects are not read"))


def _surface(surface: JsonObject, found: PlacedSurfaces, stop_radius: float, findings: Findings) -> None:
    geometry, interaction = surface.child("geometry"), surface.child("interaction_model")
    kind = interaction.text("type")
    if kind != "RefractiveReflectiveModel":
        findings.report(interaction.problem(f"interaction_model {kind}: expected RefractiveReflectiveModel"))
    if "bsdf" in interaction:
        findings.report(interaction.problem("interaction_model.bsdf: scattering is not read"))
    mirror = interaction.flag("is_reflective")
    offset, lines = shape_lines(geometry, findings)
    position, axes = _frame(geometry.child("cs"))
    position = position + offset * axes[:, 2]
    name = surface.text("comment", "")
    lines += [("COMM", name)] if name else []
    lines += [("STOP",)] if surface.flag("is_stop") else []
    lines += [("DIAM", stop_radius, "1")] if surface.flag("is_stop") and stop_radius else []
    lines += _aperture_lines(surface.child("aperture"), findings) if "aperture" in surface else []
    medium = surface.child("material_post")
    lines += [("GLAS", "MIRROR")] if mirror else glass_lines(medium, found, findings)
    found.surface(surface.place, lines, position, axes, mirror=mirror)
    surface.report_rest(findings, ("type", "thickness", "surface_type", "material_post"))


def _frame(system: JsonObject) -> tuple[np.ndarray, np.ndarray]:
    """Return the origin [mm] and the axes of a coordinate system in the global one."""
    origin = np.array([system.number(key, 0.0) for key in "xyz"])
    axes = np.eye(3)
    for key, (i, j) in (("rz", (0, 1)), ("ry", (2, 0)), ("rx", (1, 2))):
        angle = system.number(key, 0.0)
        if angle:
            turn = np.eye(3)
            turn[i, i] = turn[j, j] = math.cos(angle)
            turn[j, i] = math.sin(angle)
            turn[i, j] = -turn[j, i]
            axes = axes @ turn
    if "reference_cs" not in system:
        return origin, axes
    outer_origin, outer_axes = _frame(system.child("reference_cs"))
    return outer_origin + outer_axes @ origin, outer_axes @ axes


def _aperture_lines(aperture: JsonObject, findings: Findings) -> list[Line]:
    kind = aperture.text("type")
    if kind in ("RadialAperture", "OffsetRadialAperture"):
        inner, outer = aperture.number("r_min", 0.0), aperture.number("r_max", infinite=True)
        lines: list[Line] = [("OBSC", 0.0, inner) if math.isinf(outer) else ("CLAP", inner, outer)]
        x, y = aperture.number("offset_x", 0.0), aperture.number("offset_y", 0.0)
    elif kind == "RectangularAperture":
        (left, right), (low, high) = ([aperture.number(f"{a}_{end}") for end in ("min", "max")] for a in "xy")
        lines = [("SQAP", 0.5 * (right - left), 0.5 * (high - low))]
        x, y = 0.5 * (left + right), 0.5 * (low + high)
    elif kind == "EllipticalAperture":
        lines = [("ELAP", aperture.number("a"), aperture.number("b"))]
        x, y = aperture.number("offset_x", 0.0), aperture.number("offset_y", 0.0)
    else:
        known = "RadialAperture, OffsetRadialAperture, RectangularAperture or EllipticalAperture"
        findings.report(aperture.problem(f"aperture {kind}: expected {known}"), "taken as none")
        return []
    aperture.report_rest(findings)
    return [*lines, ("OBDC", x, y)] if x or y else lines
