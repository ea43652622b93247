"""Read a file of optiland (.json) as the description of a lens.

The file is the dictionary of an ``Optic`` of optiland 0.5 and later, as ``save_optiland_file`` writes it: lengths in
millimetres, wavelengths with a unit, angles of fields in degrees, rotations in radians about z, then y, then x of the
frame around. Places are absolute. Values of pick-ups and solves stand in the file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...aperture import Aperture, Complement
from ...design_data import BeamAperture
from ...telescope import VACUUM
from ...thin_lens import ThinLens
from ..json_items import JsonObject
from ..lens.apertures import ellipse, rectangle, ring
from ..lens.description import INFINITE, Format, LensDescription, LensSurface
from ..lens.glasses import Glasses
from ..lens.source import Findings, Source
from ..lens.text import scaled
from .gratings import MODEL, PHASE_MODEL, grating_of, phase_grating
from .media import medium_of
from .shapes import shape_of

FORMAT = Format("optiland", "aperture", "wavelengths", "is_stop")
MM = 1e-3
#: Interaction of light with an ideal thin lens.
THIN_LENS_MODEL = "ThinLensInteractionModel"
#: Keys of the file without effect on the paths of rays.
IGNORED = ("version", "pickups", "solves")
#: Apertures by their types; the size of the stop is its diameter.
APERTURES: dict[str, BeamAperture] = {
    "EPD": "entrance_pupil",
    "imageFNO": "f_number",
    "objectNA": "object_na",
    "float_by_stop_size": "stop",
}
FIELD_TYPES = {
    "AngleField": "angle", "ObjectHeightField": "object_height", "ParaxialImageHeightField": "paraxial_image_height",
    "RealImageHeightField": "real_image_height",
}  # fmt: skip
#: Types of fields of files of versions before 0.5.
_EARLY_FIELD_TYPES = {kind: kind for kind in ("angle", "object_height", "paraxial_image_height", "real_image_height")}
#: Interaction of surfaces that is read.
_INTERACTION = "RefractiveReflectiveModel"
#: Ray aiming by that of optiland; "paraxial" aims at the paraxial entrance pupil, as others do without.
AIMING = {"paraxial": "off", "iterative": "real", "robust": "real", "cached": "real"}
#: Micrometres of a unit of wavelength.
WAVE_UNITS = {"nm": 1e-3, "um": 1.0, "mm": 1e3, "cm": 1e4, "m": 1e6}


def read_optiland_file(path: Path, findings: Findings, glasses: Glasses) -> LensDescription:
    """Return the description of a file of optiland."""
    root = JsonObject.read(path)
    if "surface_group" not in root:
        raise root.problem("expected the JSON file of an optiland Optic, with a surface_group")
    surfaces = list(root.child("surface_group").children("surfaces", "surface"))
    if len(surfaces) < 3:
        raise root.problem(f"{len(surfaces)} surfaces: expected an object, an image and one between")
    lens = LensDescription(path, FORMAT, findings, title=root.text("name", "").strip('" '))
    stop_radius = _system(root, lens)
    _object(surfaces[0], surfaces[1], lens, glasses)
    for surface in surfaces[1:]:
        _surface(surface, lens, stop_radius, glasses)
    root.report_rest(findings, IGNORED)
    return lens


def _system(root: JsonObject, lens: LensDescription) -> float:
    """State aperture, fields and wavelengths; return the semi-diameter of the stop [m], 0 if not stated."""
    aperture = root.child("aperture", "aperture")
    kind = aperture.text("type")
    if kind not in APERTURES:
        aperture.refuse("type", f"one of {', '.join(APERTURES)}")
    value = aperture.number("value")
    lens.state_aperture(aperture.at("value"), APERTURES[kind], value * MM if kind == "EPD" else value)
    _fields(root.child("fields", "fields"), lens)
    waves = list(root.child("wavelengths").children("wavelengths", "wavelength"))
    lengths, primary = [], 0
    for number, wave in enumerate(waves):
        unit = wave.text("unit", "um")
        if unit not in WAVE_UNITS:
            wave.refuse("unit", f"one of {', '.join(WAVE_UNITS)}")
        lengths.append(scaled(wave.number("value") * WAVE_UNITS[unit], -6))
        primary = number if wave.flag("is_primary") else primary
    if waves:
        shortest = waves[int(np.argmin(lengths))].at("value")
        lens.state_wavelengths(shortest, lengths, [wave.number("weight", 1.0) for wave in waves], primary)
    if "ray_tracer" in root:
        tracer = root.child("ray_tracer", "ray_tracer")
        if "ray_aiming_config" in tracer:
            mode = tracer.child("ray_aiming_config").text("mode", "paraxial")
            if mode not in AIMING:
                raise tracer.problem(f"ray_aiming_config.mode = {mode!r}: expected one of {', '.join(AIMING)}")
            lens.state(tracer.part("ray_aiming_config"), aiming=AIMING[mode])
    return 0.5 * value * MM if APERTURES[kind] == "stop" else 0.0


def _fields(fields: JsonObject, lens: LensDescription) -> None:
    points = list(fields.children("fields", "field"))
    # Before version 0.5 the fields themselves have their kind, in other words.
    early = "field_definition" not in fields
    definition = fields if early else fields.child("field_definition")
    kinds = _EARLY_FIELD_TYPES if early else FIELD_TYPES
    kind = definition.text("field_type")
    if kind not in kinds:
        definition.refuse("field_type", f"one of {', '.join(kinds)}")
    columns = {
        key: [point.number(key, default) for point in points]
        for key, default in (("x", None), ("y", None), ("weight", 1.0), ("vx", 0.0), ("vy", 0.0))
    }

    def largest(*keys: str) -> Source:
        """Return the source of the number that is farthest from zero."""
        rows = [(abs(v), point.at(key)) for key in keys for v, point in zip(columns[key], points, strict=True)]
        return max(rows, key=lambda row: row[0], default=(0.0, fields.part("fields")))[1]

    lens.telecentric = fields.flag("telecentric")
    lens.state_fields(
        largest("x", "y"), kinds[kind], zip(columns["x"], columns["y"], strict=True) if points else [(0.0, 0.0)]
    )
    lens.state_field_weights(largest("weight"), columns["weight"])
    no_decentres: Sequence[float] = ()
    lens.state_vignetting(largest("vx", "vy"), no_decentres, no_decentres, columns["vx"], columns["vy"])
    for point in points:
        point.report_rest(lens.findings, ("field_type",) if early else ())


def _object(surface: JsonObject, first: JsonObject, lens: LensDescription, glasses: Glasses) -> None:
    geometry = surface.child("geometry")
    height = geometry.child("cs").number("z", infinite=True)
    place, _ = _frame(first.child("geometry").child("cs"))
    lens.medium = medium_of(surface.child("material_post"), lens, glasses)
    distance = float(place[2]) - height
    lens.object_distance = distance * MM if abs(distance) < INFINITE else math.inf
    if geometry.text("type") != "Plane":
        lens.findings.report(geometry.problem("geometry: curved objects are not read"))


def _surface(surface: JsonObject, lens: LensDescription, stop_radius: float, glasses: Glasses) -> None:
    geometry, findings = surface.child("geometry"), lens.findings
    # Before version 0.5 the surface itself has what its interaction states.
    early = "interaction_model" not in surface
    interaction = surface if early else surface.child("interaction_model")
    kind = _INTERACTION if early else interaction.text("type")
    grating, thin_lens = grating_of(geometry), None
    if kind == PHASE_MODEL and geometry.text("type") == "Plane":
        grating = phase_grating(interaction.child("phase_profile"))
    elif kind == THIN_LENS_MODEL and geometry.text("type") == "Plane" and not interaction.flag("is_reflective"):
        thin_lens = ThinLens(interaction.number("focal_length") * MM)
    elif kind not in (_INTERACTION, MODEL):
        findings.report(interaction.problem(f"interaction_model {kind}: expected {_INTERACTION} or {MODEL}"))
    if "bsdf" in interaction:
        findings.report(interaction.problem("interaction_model.bsdf: scattering is not read"))
    mirror, stop = interaction.flag("is_reflective"), surface.flag("is_stop")
    offset, shape = shape_of(geometry, findings)
    position, axes = _frame(geometry.child("cs"))
    medium = surface.child("material_post")
    placed = LensSurface(
        surface.part("is_stop" if stop else ""),
        shape,
        position * MM + offset * axes[:, 2],
        axes,
        name=surface.text("comment", ""),
        after=VACUUM if mirror else medium_of(medium, lens, glasses),
        aperture=_aperture(surface.child("aperture"), findings) if "aperture" in surface else None,
        semi_diameter=stop_radius if stop else 0.0,
        stop=stop,
        grating=grating,
        thin_lens=thin_lens,
    )
    lens.add(placed, mirror=mirror)
    surface.report_rest(findings, ("type", "thickness", "surface_type", "material_post", "material_pre"))


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


def _aperture(aperture: JsonObject, findings: Findings) -> Aperture | None:
    kind = aperture.text("type")
    source = aperture.part(f"aperture {kind}")
    x, y = (aperture.number(f"offset_{axis}", 0.0) * MM for axis in "xy")
    region: Aperture | None
    if kind in ("RadialAperture", "OffsetRadialAperture"):
        inner, outer = aperture.number("r_min", 0.0) * MM, aperture.number("r_max", infinite=True) * MM
        if math.isinf(outer):
            region = Complement(ring(source, 0.0, inner, x, y)) if inner else None
        else:
            region = ring(source, inner, outer, x, y)
    elif kind == "RectangularAperture":
        (x_min, x_max), (y_min, y_max) = ([aperture.number(f"{a}_{end}") for end in ("min", "max")] for a in "xy")
        half = 0.5 * (x_max - x_min) * MM, 0.5 * (y_max - y_min) * MM
        region = rectangle(source, *half, 0.5 * (x_min + x_max) * MM, 0.5 * (y_min + y_max) * MM)
    elif kind == "EllipticalAperture":
        region = ellipse(source, aperture.number("a") * MM, aperture.number("b") * MM, x, y)
    else:
        expected_types = "RadialAperture, OffsetRadialAperture, RectangularAperture or EllipticalAperture"
        findings.report(aperture.problem(f"aperture {kind}: expected {expected_types}"), "taken as none")
        return None
    aperture.report_rest(findings)
    return region
