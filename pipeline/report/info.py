"""Lens table and first-order properties of a telescope, as numbers and as text."""

from __future__ import annotations

import contextlib
import math
from dataclasses import asdict
from itertools import zip_longest
from typing import Any

import numpy as np

from ...core.errors import DomainError, PachonError
from ...core.number_text import CellText, NumberText
from ...core.units import ARCSEC
from ...models.aperture import Annulus, Circle, Complement
from ...models.central_obscuration import central_obscuration
from ...models.design_data import LENGTH_UNITS
from ...models.first_order import first_order
from ...models.io.yaml.apertures import aperture_items
from ...models.io.yaml.values import Turn, flow
from ...models.io.yaml.writer import INTERACTION_NAMES
from ...models.media.medium import ConstantIndex
from ...models.parabasal import parabasal_optics
from ...models.parameters.shape_terms import term_unit
from ...models.shapes.grid import GridSag
from ...models.shapes.mesh import MeshSurface
from ...models.shapes.shape import Plane, Rotational, Shape
from ...models.shapes.sum import Sum
from ...models.surface import Surface
from ...models.telescope import Telescope
from ...models.unfolding import axial_heights, unfolded_axis

#: First-order properties, which only a centred telescope has.
FIRST_ORDER_KEYS = (
    "focal_length_m",
    "f_number",
    "plate_scale_arcsec_per_um",
    "exit_pupil_z_m",
    "exit_pupil_diameter_m",
    "focus_z_m",
    "angular_magnification",
    "image_z_m",
    "magnification",
    "working_f_number",
)


def describe(telescope: Telescope) -> dict[str, Any]:
    """Return the lens table and the first-order properties of a telescope; keys end in their unit.

    Of a telescope whose surfaces do not share one axis, as built or off-axis, the first-order properties are None, and
    "parabasal" has those about the chief ray; of any other this is None.
    """
    first: dict[str, float | None] = dict.fromkeys(FIRST_ORDER_KEYS)
    folds: list[str] = []
    with contextlib.suppress(DomainError):
        folds = [s.name for s in unfolded_axis(telescope).surfaces if s.fold]
        optics = first_order(telescope)
        first = {
            "focal_length_m": optics.focal_length,
            "f_number": optics.f_number,
            "plate_scale_arcsec_per_um": abs(optics.plate_scale) / ARCSEC * 1e-6,
            "exit_pupil_z_m": optics.exit_pupil_z,
            "exit_pupil_diameter_m": optics.exit_pupil_diameter,
            "focus_z_m": optics.focus_z,
            "angular_magnification": None,
            **dict.fromkeys(("image_z_m", "magnification", "working_f_number")),
        }
        if telescope.design_data.afocal:
            # Of an image at infinity there is neither a focus nor a scale of lengths.
            first |= dict.fromkeys(("focal_length_m", "f_number", "plate_scale_arcsec_per_um", "focus_z_m"))
            first["angular_magnification"] = optics.angular_magnification
        elif math.isfinite(telescope.object_distance):
            first |= {
                "image_z_m": optics.image_z,
                "magnification": optics.magnification,
                "working_f_number": optics.working_f_number,
            }
        # What lies at infinity has no number in JSON.
        first = {key: value if value is None or math.isfinite(value) else None for key, value in first.items()}
    wavelength, obscuration = telescope.default_wavelength, central_obscuration(telescope)
    low, high = telescope.band or telescope.wavelength_range
    centred = any(value is not None for value in first.values())
    heights = axial_heights(telescope)
    return {
        "name": telescope.name,
        "description": telescope.description,
        "source": telescope.source,
        "version": telescope.version,
        "wavelength_nm": wavelength * 1e9,
        "band_nm": [low * 1e9, high * 1e9],
        **first,
        "folds": folds,
        "parabasal": None if centred else _parabasal(telescope),
        "pupil_diameter_m": telescope.pupil_diameter,
        "pupil_obscuration": obscuration,
        "effective_area_m2": 0.25 * math.pi * telescope.pupil_diameter**2 * (1.0 - obscuration**2),
        "entrance_pupil_z_m": telescope.stop_z,
        "entrance_pupil_center_m": list(telescope.pupil_center),
        "field_radius_deg": math.degrees(telescope.field_radius),
        "field_limit_deg": math.degrees(telescope.field_limit),
        "object_distance_m": telescope.object_distance if math.isfinite(telescope.object_distance) else None,
        "camera": telescope.camera,
        "groups": {name: list(members) for name, members in telescope.groups.items()},
        "length_unit": telescope.length_unit[0],
        "design": asdict(telescope.design_data),
        "surfaces": [
            _surface_entry(surface, heights[surface.name], None if name is None else heights[name], wavelength)
            for surface, name in zip_longest(telescope.surfaces, telescope.surface_names[1:])
        ],
    }


def _parabasal(telescope: Telescope) -> dict[str, list[float | None]] | None:
    """Return first-order properties about the chief ray, of two planes each; None where light stays parallel."""
    try:
        optics = parabasal_optics(telescope)
    except PachonError:
        return None
    if not np.isfinite(optics.focal_length).all():
        return None
    pairs = {
        "focal_length_m": optics.focal_length,
        "f_number": optics.f_number,
        "plate_scale_arcsec_per_um": optics.arcsec_per_um,
        "back_focus_m": optics.back_focus,
        "exit_pupil_distance_m": optics.exit_pupil_distance,
        "exit_pupil_diameter_m": optics.exit_pupil_diameter,
    }
    return {key: [float(v) if math.isfinite(v) else None for v in pair] for key, pair in pairs.items()}


def _surface_entry(surface: Surface, height: float, following: float | None, wavelength: float) -> dict[str, Any]:
    """Return a row of the lens table; the heights [m] are those of the surface and the next on the unfolded axis."""
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
        # Along the light as it comes in: negative behind an odd number of mirrors, as in lens files, but for folds.
        "thickness_m": None if following is None else height - following,
        "glass": "" if isinstance(medium, ConstantIndex) and medium.n == 1.0 else medium.name,
        "semi_diameter_m": surface.semi_diameter,
        "tilted": not np.array_equal(surface.matrix, np.eye(3)),
        "index_after": float(medium.index(wavelength)),
        "medium_after": "" if isinstance(medium, ConstantIndex) else "glass",
        "clear_m": _clear_radii(surface),
        "aperture": flow(aperture_items(surface.aperture), _degrees)[1:-1],
        "shape_terms": [] if isinstance(shape, (Plane, Rotational)) else _shape_terms(shape),
        "grating": None if surface.grating is None else str(surface.grating),
    }


def _shape_terms(shape: Shape) -> list[dict[str, Any]]:
    """Return the numbers of a shape that is not conic or even asphere, by their addresses, in SI; zeros left out.

    Grids and meshes have none; of a radius and its curvature the radius stands.
    """
    terms = []
    for name, value in shape.parameters.items():
        component, inner = shape.place(name) if isinstance(shape, Sum) else (shape, name)
        if isinstance(component, (GridSag, MeshSurface)) or inner.startswith("curvature"):
            continue
        if value and math.isfinite(value):
            terms.append({"name": name, "value": value, "unit": term_unit(component, inner)})
    return terms


def _degrees(value: float) -> str:
    """Return the text of a number, angles in degrees."""
    return f"{math.degrees(value) if isinstance(value, Turn) else value:g}"


def _clear_radii(surface: Surface) -> list[float | None] | None:
    """Return inner and outer radius [m] of a disc, a ring, or the outside of a disc; None for other apertures."""
    aperture = surface.aperture
    if isinstance(aperture, Circle):
        return [0.0, aperture.radius]
    if isinstance(aperture, Annulus):
        return [aperture.inner, aperture.outer]
    if isinstance(aperture, Complement) and isinstance(aperture.part, Circle):
        return [aperture.part.radius, None]
    return None


def _clear_text(row: dict[str, Any], unit: float) -> str:
    if row["clear_m"] is None:
        if row["aperture"]:
            return CellText("another region", {"_region": row["aperture"]})
        if row["semi_diameter_m"] is None:
            return ""
        drawn = row["semi_diameter_m"] / unit
        return CellText(f"({drawn:.6g})", {"_drawn": drawn})
    inner, outer = (math.inf if radius is None else radius / unit for radius in row["clear_m"])
    text = f"{inner:g} to {outer:g}" if math.isfinite(outer) else f"from {inner:g}"
    return CellText(text, {"": outer, "_inner": inner})


def surface_columns(description: dict[str, Any]) -> list[str]:
    """Return the headings of the lens table, with the unit that the file counts lengths in."""
    unit = description["length_unit"]
    columns = ("surface", "type", f"radius [{unit}]", "conic", f"thickness [{unit}]", "glass", "index after")
    return [*columns, f"z [{unit}]", f"clear radius [{unit}]"]


def surface_rows(description: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the lens table as text, in the columns of :func:`surface_columns`."""
    unit, stop = LENGTH_UNITS[description["length_unit"]], description["design"]["stop"]
    return [
        (
            s["name"],
            ", ".join([s["type"], *(["stop"] if s["name"] == stop else [])]) + (" (tilted)" if s["tilted"] else ""),
            CellText("flat", {"": math.inf}) if s["radius_m"] is None else NumberText(s["radius_m"] / unit, ".7g"),
            NumberText(s["conic"], "g") if s["conic"] else CellText("", {"": 0.0}),
            "" if s["thickness_m"] is None else NumberText(s["thickness_m"] / unit, ".7g"),
            s["glass"],
            NumberText(s["index_after"], ".6f") if s["medium_after"] else "",
            NumberText(s["z_m"] / unit, ".7g"),
            _clear_text(s, unit),
        )
        for s in description["surfaces"]
    ]


def coefficient_lines(description: dict[str, Any]) -> list[str]:
    """Return the coefficients of aspheres, the terms of other shapes, and the gratings, as text, a line each."""
    unit, lines = LENGTH_UNITS[description["length_unit"]], []
    for s in description["surfaces"]:
        terms = [(4 + 2 * i, c * unit ** (3 + 2 * i)) for i, c in enumerate(s["coefficients"])]
        if any(c for _, c in terms):
            lines.append(f"{s['name']}: " + ", ".join(f"{c:.9g} r^{power}" for power, c in terms if c))
        if s["shape_terms"]:
            lines.append(f"{s['name']}: " + ", ".join(_term_text(term, unit) for term in s["shape_terms"]))
        if s["grating"]:
            lines.append(f"{s['name']}: {s['grating']}")
    return lines


def _term_text(term: dict[str, Any], unit: float) -> str:
    """Return name and value of a term of a shape, lengths in a unit [m]."""
    base, _, exponent = term["unit"].partition("^")
    power = {"": 0, "m": int(exponent or 1), "1/m": -1}[base]
    return f"{term['name']} {term['value'] / unit**power:.9g}"


def figure_rows(description: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the first-order properties as text: name, and value with unit."""
    d, name = description, description["length_unit"]
    unit = LENGTH_UNITS[name]

    def length(value: float) -> str:
        return f"{value / unit:.7g} {name}"

    pupil = ("exit pupil", "at infinity")
    if d["exit_pupil_z_m"] is not None:
        pupil = ("exit pupil", f"{length(d['exit_pupil_diameter_m'])} at z = {length(d['exit_pupil_z_m'])}")
    if d["angular_magnification"] is not None:
        lens, image = [("afocal, angular magnification", f"{d['angular_magnification']:.7g}")], [pupil]
    elif d["magnification"] is not None:
        focal = "infinite" if d["focal_length_m"] is None else length(d["focal_length_m"])
        lens = [
            ("focal length", focal),
            ("magnification", f"{d['magnification']:.7g}"),
            ("working focal ratio", f"f/{d['working_f_number']:.4f}"),
        ]
        image = [pupil, ("paraxial image", f"z = {length(d['image_z_m'])}")]
    elif d["parabasal"] is not None:
        lens, image = _parabasal_rows(d["parabasal"], unit, name), []
    elif d["focal_length_m"] is None:
        why = "the chief ray is lost, or there is no focus; pachon rays has those of real rays"
        lens, image = [("first-order figures", f"none: {why}")], []
    else:
        lens = [
            ("focal length", length(d["focal_length_m"])),
            ("focal ratio", f"f/{abs(d['f_number']):.4f}"),
            ("plate scale", f'{d["plate_scale_arcsec_per_um"]:.6f}"/µm'),
        ]
        image = [pupil, ("paraxial focus", f"z = {length(d['focus_z_m'])}")]
    far, center = d["object_distance_m"], d["entrance_pupil_center_m"]
    aside = "".join(f"{axis} = {length(v)}, " for axis, v in zip("xy", center, strict=True)) if any(center) else ""
    return [
        *lens,
        ("object", "at infinity" if far is None else f"z = {length(far)}"),
        ("entrance pupil", f"{length(d['pupil_diameter_m'])} at {aside}z = {length(d['entrance_pupil_z_m'])}"),
        ("central obscuration", f"{d['pupil_obscuration']:g} of the diameter"),
        ("collecting area", f"{d['effective_area_m2'] / unit**2:.6g} {name}²"),
        *image,
        ("field of view", f"radius {d['field_radius_deg']:g}°, model good to {d['field_limit_deg']:g}°"),
        *([("heights", f"on the axis unfolded about {', '.join(d['folds'])}")] if d["folds"] else []),
        ("band", "{:g} to {:g} nm".format(*(round(w, 3) for w in d["band_nm"]))),
        ("camera", d["camera"] or "none"),
        *_stated_rows(d["design"], unit, name),
    ]


def _parabasal_rows(pairs: dict[str, list[float | None]], unit: float, name: str) -> list[tuple[str, str]]:
    """Return first-order properties about the chief ray as text."""

    def both(key: str, size: float = 1.0, digits: int = 7, prefix: str = "") -> str:
        return ", ".join("at infinity" if v is None else f"{prefix}{v / size:.{digits}g}" for v in pairs[key])

    return [
        ("about the chief ray", "in the plane of y and z, and across it"),
        ("focal lengths", f"{both('focal_length_m', unit)} {name}"),
        ("focal ratios", both("f_number", digits=5, prefix="f/")),
        ("plate scales", f'{both("plate_scale_arcsec_per_um", digits=6)} "/µm'),
        ("foci", f"{both('back_focus_m', unit)} {name} behind the last mirror or lens surface"),
        ("exit pupils", f"{both('exit_pupil_distance_m', unit)} {name} behind it"),
        ("their diameters", f"{both('exit_pupil_diameter_m', unit)} {name}"),
    ]


def _link_text(link: dict[str, Any], unit: float, name: str) -> str:
    """Return a pickup or solve as text."""
    if "kind" in link:
        at = f" at {link['radius'] / unit:.6g} {name}" if link["radius"] else ""
        return f"{link['surface']} thickness: {link['kind'].replace('_', ' ')} {link['value'] / unit:.6g} {name}{at}"
    offset = link["offset"] if link["quantity"] == "conic" else link["offset"] / unit
    factor = f"{link['scale']:.6g} times " if link["scale"] != 1.0 else ""
    offset_text = f" {'+-'[offset < 0]} {abs(offset):.6g}" if offset else ""
    return f"{link['surface']} {link['quantity']}: {factor}that of {link['source']}{offset_text}"


def _stated_rows(design: dict[str, Any], unit: float, name: str) -> list[tuple[str, str]]:
    """Return the design data as text."""
    rows = []
    if design["aperture"] is not None:
        lengths = design["aperture"] in ("entrance_pupil", "stop")
        value = f"{design['aperture_value'] / unit:.7g} {name}" if lengths else f"{design['aperture_value']:g}"
        rows.append(("aperture as stated", f"{design['aperture'].replace('_', ' ')} {value}"))
    if design["stop"] is not None:
        rows.append(("stop", f"{design['stop']}, ray aiming {design['aiming']}"))
    rows += [("follows", _link_text(link, unit, name)) for link in (*design["pickups"], *design["solves"])]
    if design["fields"]:
        angles = design["field_type"] == "angle"
        size, of = (math.radians(1.0), "°") if angles else (unit, f" {name}")
        points = "; ".join(f"{x / size + 0.0:.6g}, {y / size + 0.0:.6g}{of}" for x, y in design["fields"])
        rows.append((f"fields, {design['field_type'].replace('_', ' ')}", points))
    if design["wavelengths"]:
        rows.append(("wavelengths", ", ".join(f"{w * 1e9:.7g}" for w in design["wavelengths"]) + " nm"))
    return rows
