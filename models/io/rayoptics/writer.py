"""Write a telescope as a file of ray-optics (.roa).

The JSON holds what ray-optics rebuilds its model from: system, surfaces with their profiles, gaps, pupil, fields and
wavelengths; its elements and its paraxial model are made anew on opening. Every surface stands on the axis of the
object space, decentred and tilted by itself ("dec and return"); its local z axis is along the light in front of an even
number of mirrors and against it in front of an odd one, by which ray-optics chooses between two intersections.
"""

from __future__ import annotations

import json
import math
from typing import Any

from ....core.errors import PrescriptionError, error_context
from ...aperture import Circle, Ellipse, Rectangle
from ...surface import Interaction
from ...telescope import Telescope
from ..lens.description import LensSurface
from ..lens.sequence import LensSequence
from ..lens.text import scaled
from ..profile import Profile
from .gratings import grating_items
from .items import array, instance
from .media import Media
from .reader import FIELDS, MMHG
from .shapes import profile_items

FILE = "a ray-optics file"
UNITS = {1e-3: "mm", 1e-2: "cm", 1.0: "m", 0.0254: "in"}
APERTURES = {
    "entrance_pupil": ("object", "epd"), "object_na": ("object", "NA"), "f_number": ("image", "f/#"),
    "working_f_number": ("image", "f/#"),
}  # fmt: skip
#: Version of ray-optics whose form of the file this is.
VERSION = "0.9.8"
#: Distance of an object at infinity in ray-optics [lens unit].
FAR = 1e10


def telescope_to_rayoptics(telescope: Telescope, *, lenient: bool = False) -> str:
    """Return the text of a file of ray-optics.

    PrescriptionError, with surface and part, if a part of the telescope has no counterpart in it; if lenient, links,
    coatings and formulas of glasses are left out with a warning.
    """
    sequence = LensSequence.of(telescope, FILE, tuple(UNITS), lenient=lenient, along_light=True)
    with error_context(subject=telescope.name):
        model = {
            "ro_version": VERSION,
            "radius_mode": True,
            "specsheet": None,
            "system_spec": _system_items(sequence),
            **_sequence_items(sequence),
            "optical_spec": _optical_items(sequence),
        }
    items = instance("rayoptics.optical.opticalmodel", "OpticalModel", model)
    return json.dumps({"optical_model": items}, indent=1) + "\n"


def _system_items(sequence: LensSequence) -> dict[str, Any]:
    celsius, atmospheres = sequence.celsius, sequence.atmospheres
    values = {
        "title": sequence.title,
        "initials": "",
        "_dimensions": UNITS[sequence.unit],
        "temperature": 20.0 if celsius is None else celsius,
        "pressure": MMHG if atmospheres is None else atmospheres * MMHG,
    }
    return instance("rayoptics.optical.opticalmodel", "SystemSpec", values)


def _sequence_items(sequence: LensSequence) -> dict[str, Any]:
    unit, surfaces = sequence.unit, sequence.surfaces
    media = Media(sequence)
    profiles = {"0": profile_items(Profile(0.0, 0.0))}
    radius = 0.5 * sequence.telescope.pupil_diameter
    items = [_surface_items("Obj", "dummy", "0", radius / unit)]
    distance = sequence.distance / unit if math.isfinite(sequence.distance) else FAR
    gaps, directions = [_gap(distance, media.items(surfaces[0].before))], [1]
    for number, surface in enumerate(surfaces, start=1):
        with error_context(subject=f"surface {surface.name}"):
            profiles[str(number)] = profile_items(Profile.of(surface.shape, unit))
        mode = {Interaction.MIRROR: "reflect", Interaction.REFRACT: "transmit"}.get(surface.interaction, "dummy")
        written_surface = _surface_items(surface.name, mode, str(number), (surface.semi_diameter or radius) / unit)
        written_surface["attributes"]["clear_apertures"] = _aperture_items(sequence, surface)
        written_surface["attributes"]["decenter"] = _decenter_items(surface, unit)
        if surface.grating is not None:
            with error_context(subject=f"surface {surface.name}"):
                element = grating_items(surface.grating, surface.shape, mode)
            written_surface["attributes"]["phase_element"] = element
        items.append(written_surface)
        if surface.interaction != Interaction.DETECTOR:
            gaps.append(_gap(sequence.thickness(surface), media.items(surface.after)))
            directions.append(-directions[-1] if mode == "reflect" else directions[-1])
    values = {
        "ifcs": items,
        "gaps": gaps,
        "z_dir": directions,
        # Its own apertures would take the place of those that are stated.
        "do_apertures": not any(s.aperture or s.semi_diameter for s in surfaces),
        "stop_surface": 1 + next(i for i, s in enumerate(surfaces) if s.stop),
        "cur_surface": 1,
    }
    return {"seq_model": instance("rayoptics.seq.sequential", "SequentialModel", values), "profile_dict": profiles}


def _gap(thickness: float, medium: dict[str, Any]) -> dict[str, Any]:
    return instance("rayoptics.seq.gap", "Gap", {"thi": thickness, "medium": medium})


def _surface_items(name: str, mode: str, profile: str, radius: float) -> dict[str, Any]:
    values = {
        "interact_mode": mode,
        "delta_n": 0.0,
        "decenter": None,
        "max_aperture": radius,
        "label": name,
        "clear_apertures": [],
        "edge_apertures": [],
        "profile_id": profile,
    }
    return instance("rayoptics.elem.surface", "Surface", values)


def _aperture_items(sequence: LensSequence, surface: LensSurface) -> list[dict[str, Any]]:
    region, unit = surface.aperture, sequence.unit
    sizes: dict[str, float]
    if isinstance(region, Circle):
        kind, sizes = "Circular", {"radius": region.radius}
    elif isinstance(region, Rectangle) and region.angle == 0:
        kind, sizes = "Rectangular", {"x_half_width": 0.5 * region.width, "y_half_width": 0.5 * region.height}
    elif isinstance(region, Ellipse) and region.angle == 0:
        kind, sizes = "Elliptical", {"x_half_width": region.semi_x, "y_half_width": region.semi_y}
    else:
        if region is not None:
            sequence.leave_out_aperture(surface, "discs, and ellipses and rectangles along x")
        return []
    sizes |= {"x_offset": region.x, "y_offset": region.y}
    values = {key: value / unit for key, value in sizes.items()}
    return [instance("rayoptics.elem.surface", kind, values | {"rotation": 0.0})]


def _decenter_items(surface: LensSurface, unit: float) -> dict[str, Any] | None:
    if not surface.off_axis:
        return None
    # The first two angles are left-handed.
    angles = [sign * math.degrees(v) + 0.0 for sign, v in zip((-1.0, -1.0, 1.0), surface.tilt, strict=True)]
    shift = [*(v / unit for v in surface.position[:2]), 0.0]
    values = {"_dtype": "dec and return", "dec": array(shift), "euler": array(angles), "rot_pt": array([0.0] * 3)}
    return instance("rayoptics.elem.surface", "DecenterData", values | {"rot_mat": None})


def _optical_items(sequence: LensSequence) -> dict[str, Any]:
    module = "rayoptics.raytr.opticalspec"
    waves = {
        "wavelengths": [scaled(wave, 9) for wave in sequence.wavelengths],
        "spectral_wts": list(sequence.wavelength_weights),
        "render_colors": [],
        "reference_wvl": sequence.primary,
        "coating_wvl": 550.0,
    }
    # Its f-number is that of the image space, at the conjugates of the lens.
    wrong = "f_number" if math.isfinite(sequence.distance) else ""
    kind, value = sequence.stated_aperture([name for name in APERTURES if name != wrong])
    if kind == "object_na":
        # Its numerical aperture is the slope of the marginal ray.
        value = math.tan(
            math.asin(value / float(sequence.surfaces[0].before.index(sequence.telescope.default_wavelength)))
        )
    key = ["aperture", *APERTURES[kind]]
    pupil = {"_key": key, "value": value / sequence.unit if kind == "entrance_pupil" else value}
    pupil["pupil_rays"] = [[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]
    pupil["ray_labels"] = ["00", "+X", "-X", "+Y", "-Y"]
    return instance(
        module,
        "OpticalSpecs",
        {
            "spectral_region": instance(module, "WvlSpec", waves),
            "pupil": instance(module, "PupilSpec", pupil),
            "field_of_view": instance(module, "FieldSpec", _field_items(sequence)),
            "defocus": instance(module, "FocusRange", {"focus_shift": 0.0, "defocus_range": 0.0}),
        },
    )


def _field_items(sequence: LensSequence) -> dict[str, Any]:
    if sequence.field_type not in FIELDS.values():
        raise PrescriptionError(f"field_type = {sequence.field_type}: {FILE} has none of that kind")
    if any(row[4] for row in sequence.vignetting):
        raise PrescriptionError(f"vignetting: {FILE} has no angle of the pupil")
    kind = next(words for words, field_type in FIELDS.items() if field_type == sequence.field_type)
    size = 1.0 if sequence.field_type == "angle" else sequence.unit
    points = []
    rows = zip(sequence.fields, sequence.field_weights, sequence.vignetting, strict=True)
    for (x, y), weight, (dx, dy, cx, cy, _) in rows:
        # Decentre and compression, from the fractions that are cut off at both ends.
        ends = {"vux": cx - dx, "vuy": cy - dy, "vlx": cx + dx, "vly": cy + dy}
        values = {"_x": x / size, "_y": y / size, **ends, "wt": weight, "aim_info": None, "_max_field": None}
        points.append(instance("rayoptics.raytr.opticalspec", "Field", values))
    return {
        "_key": ["field", *kind],
        "_value": max(math.hypot(*field) for field in sequence.fields) / size,
        "is_relative": False,
        "is_wide_angle": False,
        "fields": points,
        "index_labels": [],
        "index_label_type": "auto",
    }
