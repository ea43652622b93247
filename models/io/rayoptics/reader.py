"""Read a file of ray-optics (.roa) as the description of a lens.

The file is JSON; objects stand in it as ``__instance_type__``, the module and name of their class, and ``attributes``.
Nothing is built from these names: the parts that describe the optics are read as plain values. Read are surfaces with
the profiles of ``shapes``, their decentres, clear apertures, gaps and media, the pupil, fields and wavelengths.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ...aperture import Aperture, Complement
from ...design_data import BeamAperture
from ...rotation import rotation_matrix
from ...telescope import VACUUM
from ..json_items import JsonObject
from ..lens.apertures import ellipse, rectangle, ring
from ..lens.description import INFINITE, Format, LensDescription, LensSurface
from ..lens.glasses import Glasses
from ..lens.source import Findings
from ..lens.text import scaled
from .gratings import grating_of
from .items import attributes, class_name, named, numbers
from .media import medium_of
from .shapes import shape_of

FORMAT = Format("ray-optics", "pupil", "wavelengths", "stop_surface")
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254, "inches": 0.0254}
#: Apertures by space and kind of the pupil; the f-number is that of the image space.
PUPILS: dict[tuple[str, str], BeamAperture] = {
    ("object", "epd"): "entrance_pupil", ("object", "NA"): "object_na", ("image", "f/#"): "f_number",
    ("image", "NA"): "f_number",
}  # fmt: skip
FIELDS = {
    ("object", "angle"): "angle", ("object", "height"): "object_height", ("image", "height"): "paraxial_image_height",
}  # fmt: skip
#: Millimetres of mercury in an atmosphere.
MMHG = 760.0
INTERACTIONS = ("transmit", "reflect", "dummy", "phantom")
#: Attributes of a surface without effect on the paths of rays.
IGNORED = ("delta_n", "edge_apertures", "z_type")
DECENTERS = ("decenter", "reverse", "dec and return", "bend")


def read_rayoptics_file(path: Path, findings: Findings, glasses: Glasses) -> LensDescription:
    """Return the description of a file of ray-optics."""
    root = JsonObject.read(path)
    if "optical_model" not in root:
        raise root.problem("expected the file of a ray-optics OpticalModel, with an optical_model")
    model = attributes(root, "optical_model")
    return _Reader(path, model, findings, glasses).lens()


class _Reader:
    """Surfaces of a model one after the other, with the local frame behind each."""

    def __init__(self, path: Path, model: JsonObject, findings: Findings, glasses: Glasses) -> None:
        self.model, self.findings, self.glasses = model, findings, glasses
        self.description = LensDescription(path, FORMAT, findings)
        self.sequence = attributes(model, "seq_model")
        self.surfaces = list(self.sequence.children("ifcs", "surface"))
        self.gaps = [attributes(gap) for gap in self.sequence.children("gaps", "gap")]
        if len(self.surfaces) < 3 or len(self.gaps) != len(self.surfaces) - 1:
            text = f"{len(self.surfaces)} surfaces (ifcs) and {len(self.gaps)} gaps: expected a gap between each two"
            raise self.sequence.problem(text)

    def lens(self) -> LensDescription:
        """Return the description of the lens."""
        lens = self.description
        self._system()
        stop = self.sequence.get("stop_surface")
        if stop is None:
            text = "stop_surface is null: ray-optics' floating stop is not read"
            self.findings.note(self.sequence.problem(text), "the first surface is the stop")
        stop = 1 if stop is None else self.sequence.whole("stop_surface")
        lens.medium = medium_of(self.gaps[0], lens, self.glasses)
        turn, shift, _, _ = self._decenter(attributes(self.surfaces[0]))
        if np.any(turn != np.eye(3)) or np.any(shift):
            self.findings.report(self.surfaces[0].problem("decenter of the object: expected none"))
        origin, axes = np.zeros(3), np.eye(3)
        for number, surface in enumerate(self.surfaces[1:], start=1):
            last = number == len(self.surfaces) - 1
            items = attributes(surface)
            before, shift, after, back = self._decenter(items)
            origin, axes = origin + axes @ shift, axes @ before
            self._surface(number, items, origin, axes, stop=number == stop)
            items.report_rest(self.findings, IGNORED)
            axes = axes @ after
            thickness = 0.0 if last else self.gaps[number].number("thi")
            origin = origin + axes @ (back + np.array([0.0, 0.0, thickness]))
        return lens

    def _surface(self, number: int, items: JsonObject, origin: np.ndarray, axes: np.ndarray, *, stop: bool) -> None:
        surface, lens = self.surfaces[number], self.description
        kind, mode = class_name(surface), items.text("interact_mode")
        if kind != "Surface" or mode not in INTERACTIONS:
            text = f"{kind}, interact_mode {mode}: expected a Surface with one of {', '.join(INTERACTIONS)}"
            self.findings.report(surface.problem(text), "taken as its profile")
        profile = self._profile(items, surface)
        with profile.part(f"profile {class_name(profile)}").context():
            shape = shape_of(profile, lens.unit, self.findings)
        radius = items.number("max_aperture", 0.0)
        mirror, grating = mode == "reflect", None
        if "phase_element" in items:
            grating = grating_of(items.child("phase_element"), shape, self.findings, mirror=mirror)
        inside = not mirror and number < len(self.gaps)
        placed = LensSurface(
            self.sequence.at("stop_surface") if stop else surface.part(""),
            shape,
            origin * lens.unit,
            axes,
            name=items.text("label", ""),
            after=medium_of(self.gaps[number], lens, self.glasses) if inside else VACUUM,
            aperture=self._aperture(items, surface),
            semi_diameter=radius * lens.unit if radius < INFINITE else 0.0,
            stop=stop,
            grating=grating,
        )
        lens.add(placed, mirror=mirror)

    def _profile(self, items: JsonObject, surface: JsonObject) -> JsonObject:
        if "profile" in items:
            return items.child("profile")
        profiles = self.model.child("profile_dict", "profile_dict")
        key = items.text("profile_id") if "profile_id" in items else ""
        if key not in profiles:
            raise surface.problem(f"profile_id = {key!r}: expected a key of profile_dict")
        return profiles.child(key, surface.place)

    def _aperture(self, items: JsonObject, surface: JsonObject) -> Aperture | None:
        apertures = list(items.children("clear_apertures", "")) if "clear_apertures" in items else []
        region: Aperture | None = None
        for aperture in apertures[:1]:
            values, kind, unit = attributes(aperture), class_name(aperture), self.description.unit
            source = surface.part(f"clear_apertures: {kind}")
            blocks = values.flag("is_obscuration")
            x, y = values.number("x_offset", 0.0) * unit, values.number("y_offset", 0.0) * unit
            if kind == "Circular":
                radius = values.number("radius") * unit
                region = ring(source, 0.0, radius, x, y) if radius or not blocks else None
            elif kind in ("Rectangular", "Elliptical") and not values.number("rotation", 0.0):
                half = values.number("x_half_width") * unit, values.number("y_half_width") * unit
                region = (rectangle if kind == "Rectangular" else ellipse)(source, *half, x, y)
            else:
                text = f"clear_apertures: {kind}: expected Circular, or Rectangular or Elliptical without rotation"
                self.findings.report(surface.problem(text), "taken as none")
            region = Complement(region) if blocks and region is not None else region
        if len(apertures) > 1:
            self.findings.report(surface.problem("clear_apertures: one aperture of a surface is read, the first"))
        return region

    def _decenter(self, items: JsonObject) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return rotation and shift in front of a surface, and rotation and shift behind it."""
        unit, no_shift = np.eye(3), np.zeros(3)
        if "decenter" not in items:
            return unit, no_shift, unit, no_shift
        values = attributes(items, "decenter")
        kind = values.text(named(values, "dtype"))
        if kind not in DECENTERS:
            raise values.problem(f"decenter {kind}: expected one of {', '.join(DECENTERS)}")
        shift, angles = np.array(numbers(values, "dec", 3)), np.radians(numbers(values, "euler", 3))
        if any(numbers(values, "rot_pt", 3)):
            self.findings.report(values.problem("decenter.rot_pt: expected zeros"))
        # Alpha and beta are left-handed, as in CODE V.
        turn = rotation_matrix(angles * np.array([-1.0, -1.0, 1.0]))
        if kind == "decenter":
            return turn, shift, unit, no_shift
        if kind == "reverse":
            return unit, no_shift, turn.T, -shift
        if kind == "dec and return":
            return turn, shift, turn.T, -shift
        return turn, shift, turn, no_shift

    def _system(self) -> None:
        lens, system = self.description, attributes(self.model, "system_spec")
        unit = system.text(named(system, "dimensions"), "mm")
        if unit.lower() not in UNITS:
            raise system.problem(f"dimensions = {unit!r}: expected one of {', '.join(UNITS)}")
        lens.state_unit(UNITS[unit.lower()])
        lens.title = system.text("title", "").strip('" ')
        distance = self.gaps[0].number("thi")
        lens.object_distance = distance * lens.unit if abs(distance) < INFINITE else math.inf
        optics = attributes(self.model, "optical_spec")
        self._pupil(attributes(optics, "pupil"))
        waves = attributes(optics, "spectral_region")
        lengths, primary = numbers(waves, "wavelengths"), waves.whole("reference_wvl")
        weights = numbers(waves, "spectral_wts") if "spectral_wts" in waves else []
        if lengths and not 0 <= primary < len(lengths):
            waves.refuse("reference_wvl", f"0 to {len(lengths) - 1}")
        lens.state_wavelengths(waves.at("wavelengths"), [scaled(v, -9) for v in lengths], weights, primary)
        self._fields(attributes(optics, "field_of_view"))
        temperature, pressure = system.number("temperature", 20.0), system.number("pressure", MMHG)
        lens.state_air(system.at("pressure"), temperature, pressure / MMHG)

    def _pupil(self, pupil: JsonObject) -> None:
        lens, (space, kind) = self.description, self._key(pupil)
        if (space, kind) not in PUPILS:
            raise pupil.problem(f"pupil {space} {kind}: expected one of {_names(PUPILS)}")
        key = named(pupil, "value")
        value, aperture = pupil.number(key), PUPILS[space, kind]
        if aperture == "f_number":
            if not value:
                pupil.refuse(key, "a number other than 0")
            aperture = "working_f_number" if math.isfinite(lens.object_distance) else "f_number"
            value = abs(value) if kind == "f/#" else 0.5 / abs(value)
        elif aperture == "object_na":
            if class_name(self.gaps[0].child("medium")) != "Air":
                self.findings.report(pupil.problem("numerical aperture of an object in a medium other than air"))
            # It is the slope of the marginal ray there.
            value = math.sin(math.atan(value))
        else:
            value *= lens.unit
        lens.state_aperture(pupil.at(key), aperture, value)

    def _fields(self, fields: JsonObject) -> None:
        space, kind = self._key(fields)
        if (space, kind) not in FIELDS:
            raise fields.problem(f"field_of_view {space} {kind}: expected one of {_names(FIELDS)}")
        points = [attributes(point) for point in fields.children("fields", "field")]
        scale = fields.number(named(fields, "value")) if fields.flag("is_relative") else 1.0
        places = [[scale * p.number(named(p, axis)) for axis in "xy"] for p in points] or [[0.0, 0.0]]
        lens, farthest = self.description, int(np.argmax(np.abs(places).max(axis=1)))
        source = points[farthest].part("x, y") if points else fields.part("fields")
        lens.state_fields(source, FIELDS[space, kind], places)
        lens.state_field_weights(fields.part("wt"), [p.number("wt", 1.0) for p in points])
        # The fractions cut off at both ends.
        ends = ([p.number(f"v{end}{axis}", 0.0) for p in points] for axis in "xy" for end in "ul")
        lens.state_vignetted_ends(fields.part("vux, vuy, vlx, vly"), *ends)

    def _key(self, items: JsonObject) -> tuple[str, str]:
        """Return space and kind of a pupil or of fields: the last two words of their key."""
        key = named(items, "key")
        words = items.get(key)
        if not isinstance(words, list) or len(words) < 2 or not all(isinstance(w, str) for w in words):
            items.refuse(key, "a list of words")
        return words[-2], words[-1]


def _names(table: Iterable[tuple[str, str]]) -> str:
    return ", ".join(" ".join(key) for key in table)
