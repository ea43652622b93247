"""Write a telescope as a YAML file of batoid.

Groups whose surfaces are neighbours become compound optics, as far as they lie within one another; surfaces stand in
their coordinate systems. What batoid does not have goes under the key ``pachon``, which it ignores.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import yaml

from ....core.errors import PrescriptionError, error_context
from ...media.medium import Medium
from ...rotation import rotation_angles
from ...surface import Interaction, Surface
from ...telescope import Telescope
from ..lens.source import Findings
from ..writable import report_pupil_plane, require_sequential
from ..yaml.coatings import coating_items, coating_names
from ..yaml.design import design_items
from . import ROOT
from .apertures import obscuration_items
from .media import medium_items
from .optics import Frame
from .shapes import surface_items

#: Shifts [m] and rotations [rad] that are rounding of rotation matrices.
ROUNDING = 1e-15
_TYPES = {
    Interaction.MIRROR: "Mirror",
    Interaction.REFRACT: "RefractiveInterface",
    Interaction.PASS: "Baffle",
    Interaction.DETECTOR: "Detector",
    Interaction.PHASE: "OPDScreen",
}


def telescope_to_batoid(telescope: Telescope) -> str:
    """Return the text of a batoid file.

    PrescriptionError, with surface and part, if a part of the telescope has no counterpart in batoid.
    """
    t = telescope
    with error_context(subject=t.name):
        require_sequential(t, "a batoid file")
        if math.isfinite(t.object_distance):
            raise PrescriptionError(f"object_distance = {t.object_distance!r}: a batoid file has no object but the sky")
        report_pupil_plane(t, Findings(), own_stop=True)
        nested = _nested_groups(t)
        system = {
            "type": "CompoundOptic",
            "name": t.name,
            "inMedium": medium_items(t.medium_before),
            "backDist": t.launch_distance,
            "sphereRadius": t.reference_sphere_radius,
            "pupilSize": t.pupil_diameter,
            "pupilObscuration": t.pupil_obscuration,
            "stopSurface": {
                "type": "Interface",
                "name": "stop",
                "surface": {"type": "Plane"},
                "coordSys": {"z": t.stop_z},
            },
            "items": _items(t, nested, 0, len(t.surfaces), (np.zeros(3), np.eye(3))),
        }
        content = {ROOT: system, "pachon": _extras(t, [name for name in t.groups if name not in nested])}
    return yaml.safe_dump(_plain(content), sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)


def _nested_groups(t: Telescope) -> dict[str, tuple[int, int]]:
    """Return the groups that are compound optics, outer ones first, by first surface and the one after the last."""
    spans: dict[str, tuple[int, int]] = {}
    for name, members in sorted(t.groups.items(), key=lambda group: -len(group[1])):
        places = sorted(t.surface_names.index(member) for member in set(members))
        first, end = places[0], places[-1] + 1
        apart_or_inside = all(end <= a or b <= first or (a <= first and end <= b) for a, b in spans.values())
        if end - first == len(places) and apart_or_inside:
            spans[name] = (first, end)
    return spans


def _items(t: Telescope, groups: dict[str, tuple[int, int]], first: int, end: int, frame: Frame) -> list[Any]:
    """Return the optics of the surfaces from first to end, within a compound optic of that frame."""
    items: list[Any] = []
    while first < end:
        name = next((n for n, (a, b) in groups.items() if a == first and b <= end), None)
        if name is None:
            before = t.surfaces[first - 1].medium_after if first else t.medium_before
            items.append(_optic(t.surfaces[first], before, frame))
            first += 1
            continue
        pivot, axes = t.group_frames[name]
        group_frame = np.array(pivot), np.array(axes)
        inner = {n: span for n, span in groups.items() if n != name}
        compound = {"type": "CompoundOptic", "name": name, **_coordinate_system(group_frame, frame)}
        items.append(compound | {"items": _items(t, inner, first, groups[name][1], group_frame)})
        first = groups[name][1]
    return items


def _optic(surface: Surface, before: Medium, frame: Frame) -> dict[str, Any]:
    with error_context(subject=f"surface {surface.name}"):
        if surface.grating is not None:
            raise PrescriptionError("grating: a batoid file has none")
        if surface.thin_lens is not None:
            raise PrescriptionError("thin lens: a batoid file has none")
        items: dict[str, Any] = {"type": _TYPES[surface.interaction], "name": surface.name}
        items |= _coordinate_system((np.array(surface.vertex), surface.matrix), frame)
        sag = surface_items(surface.shape)
        is_screen = surface.interaction == Interaction.PHASE
        items |= {"surface": {"type": "Plane"}, "screen": sag} if is_screen else {"surface": sag}
        items |= {"inMedium": medium_items(before), "outMedium": medium_items(surface.medium_after)}
        if surface.aperture is not None:
            items["obscuration"] = obscuration_items(surface.aperture)
    return items


def _coordinate_system(own: Frame, outer: Frame) -> dict[str, Any]:
    """Return the coordinate system of an optic within that of the one around it; empty where they are the same."""
    shift = outer[1].T @ (own[0] - outer[0])
    angles = rotation_angles(outer[1].T @ own[1])
    pairs = [*zip("xyz", shift, strict=True), *zip(("rotX", "rotY", "rotZ"), angles, strict=True)]
    steps = {key: float(value) for key, value in pairs if abs(value) > ROUNDING}
    return {"coordSys": steps} if steps else {}


def _extras(t: Telescope, groups: list[str]) -> dict[str, Any]:
    """Return the section of what batoid does not have."""
    low, high = t.band or t.wavelength_range
    coated = coating_names(t.surfaces)
    frames = {name: t.group_frames[name] for name in groups}
    extras = {
        "description": t.description,
        "source": t.source,
        "version": t.version,
        "field": {"radius": t.field_radius, "limit": t.field_limit},
        "wavelengths": {"range": list(t.wavelength_range), "default": t.default_wavelength, "band": [low, high]},
        "camera": t.camera,
        "site": t.site,
        "dispersion_corrector": t.dispersion_corrector,
        "groups": {
            name: {"surfaces": list(t.groups[name]), "pivot": list(pivot), "rotation": [list(row) for row in axes]}
            for name, (pivot, axes) in frames.items()
        },
        "design": design_items(t.design_data),
        "semi_diameters": {s.name: s.semi_diameter for s in t.surfaces if s.semi_diameter is not None},
        "coatings": {name: coating_items(coating) for coating, name in coated.items()},
        "coated": {s.name: coated[s.coating] for s in t.surfaces if s.coating is not None},
    }
    return {key: value for key, value in extras.items() if value}


def _plain(value: Any) -> Any:
    """Return lists, mappings and numbers as YAML's safe dumper takes them, without marks of units or of NumPy."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return float(value) if isinstance(value, float) else value
