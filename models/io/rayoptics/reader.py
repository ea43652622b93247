"""Translate a file of ray-optics (.roa) into the terms of a Zemax file.

The file is JSON; objects stand in it as ``__instance_type__``, the module and name of their class, and ``attributes``.
Nothing is built from these names: the parts that describe the optics are read as plain values. Read are surfaces with
the profiles of ``shapes``, their decentres, clear apertures, gaps and media, the pupil, fields and wavelengths.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ...rotation import rotation_matrix
from ..json_items import JsonObject
from ..lens.source import Findings
from ..lens.text import scaled
from ..zemax.file import ZemaxFile
from ..zemax.placed import INFINITE, Line, PlacedSurfaces
from .items import attributes, class_name, named, numbers
from .media import medium_lines
from .shapes import profile_lines

UNITS = {"mm": "MM", "cm": "CM", "m": "METER", "in": "IN", "inches": "IN"}
#: Aperture line of Zemax by space and kind of the pupil; the f-number is that of the image space.
PUPILS = {("object", "epd"): "ENPD", ("object", "NA"): "OBNA", ("image", "f/#"): "FNUM", ("image", "NA"): "FNUM"}
FIELDS = {("object", "angle"): 0, ("object", "height"): 1, ("image", "height"): 2}
#: Millimetres of mercury in an atmosphere.
MMHG = 760.0
INTERACTIONS = ("transmit", "reflect", "dummy", "phantom")
#: Attributes of a surface without effect on the paths of rays.
IGNORED = ("delta_n", "edge_apertures", "z_type")
DECENTERS = ("decenter", "reverse", "dec and return", "bend")


def read_rayoptics_file(path: Path, findings: Findings) -> ZemaxFile:
    """Return the parts of a file of ray-optics in the terms of a Zemax file."""
    root = JsonObject.read(path)
    if "optical_model" not in root:
        raise root.problem("expected the file of a ray-optics OpticalModel, with an optical_model")
    model = attributes(root, "optical_model")
    return _Translation(path, model, findings).file()


class _Translation:
    """Surfaces of a model one after the other, with the local frame behind each."""

    def __init__(self, path: Path, model: JsonObject, findings: Findings) -> None:
        self.model, self.findings = model, findings
        self.found = PlacedSurfaces(path, "ray-optics")
        self.sequence = attributes(model, "seq_model")
        self.surfaces = list(self.sequence.children("ifcs", "surface"))
        self.gaps = [attributes(gap) for gap in self.sequence.children("gaps", "gap")]
        if len(self.surfaces) < 3 or len(self.gaps) != len(self.surfaces) - 1:
            text = f"{len(self.surfaces)} surfaces (ifcs) and {len(self.gaps)} gaps: expected a gap between each two"
            raise self.sequence.problem(text)
        self.distance = self.gaps[0].number("thi")

    def file(self) -> ZemaxFile:
        """Return the parts of the Zemax file."""
        self._header()
        stop = self.sequence.get("stop_surface")
        if stop is None:
            text = "stop_surface is null: ray-optics' floating stop is not read"
            self.findings.note(self.sequence.problem(text), "the first surface is the stop")
        stop = 1 if stop is None else self.sequence.whole("stop_surface")
        self.found.object(self.distance, medium_lines(self.gaps[0], self.found, self.findings))
        origin, axes = np.zeros(3), np.eye(3)
        for number, surface in enumerate(self.surfaces):
            last = number == len(self.surfaces) - 1
            items = attributes(surface)
            before, shift, after, back = self._decenter(items)
            if number == 0:
                if np.any(before != np.eye(3)) or np.any(shift):
                    self.findings.report(surface.problem("decenter of the object: expected none"))
                continue
            origin, axes = origin + axes @ shift, axes @ before
            lines = [*self._lines(items, surface), *([("STOP",)] if number == stop else [])]
            mirror = items.text("interact_mode") == "reflect"
            if mirror:
                lines.append(("GLAS", "MIRROR"))
            elif not last:
                lines += medium_lines(self.gaps[number], self.found, self.findings)
            self.found.surface(surface.place, lines, origin, axes, mirror=mirror)
            items.report_rest(self.findings, IGNORED)
            axes = axes @ after
            thickness = 0.0 if last else self.gaps[number].number("thi")
            origin = origin + axes @ (back + np.array([0.0, 0.0, thickness]))
        return self.found.file()

    def _lines(self, items: JsonObject, surface: JsonObject) -> list[Line]:
        kind, mode = class_name(surface), items.text("interact_mode")
        if kind != "Surface" or mode not in INTERACTIONS:
            text = f"{kind}, interact_mode {mode}: expected a Surface with one of {', '.join(INTERACTIONS)}"
            self.findings.report(surface.problem(text), "taken as its profile")
        if "phase_element" in items:
            self.findings.report(surface.problem("phase_element: diffractive surfaces are not read"))
        if "profile" in items:
            profile = items.child("profile")
        else:
            profiles = self.model.child("profile_dict", "profile_dict")
            key = items.text("profile_id") if "profile_id" in items else ""
            if key not in profiles:
                raise surface.problem(f"profile_id = {key!r}: expected a key of profile_dict")
            profile = profiles.child(key, surface.place)
        lines = profile_lines(profile, self.findings)
        label = items.text("label", "")
        radius = items.number("max_aperture", 0.0)
        lines += [("COMM", label)] if label else []
        lines += [("DIAM", radius)] if 0 < radius < INFINITE else []
        return lines + self._aperture_lines(items, surface)

    def _aperture_lines(self, items: JsonObject, surface: JsonObject) -> list[Line]:
        found: list[Line] = []
        apertures = list(items.children("clear_apertures", "")) if "clear_apertures" in items else []
        for aperture in apertures[:1]:
            values, kind = attributes(aperture), class_name(aperture)
            blocks = values.flag("is_obscuration")
            x, y = values.number("x_offset", 0.0), values.number("y_offset", 0.0)
            if kind == "Circular":
                found = [("OBSC" if blocks else "CLAP", 0.0, values.number("radius"))]
            elif kind in ("Rectangular", "Elliptical") and not values.number("rotation", 0.0):
                size = values.number("x_half_width"), values.number("y_half_width")
                found = [(("SQ" if kind == "Rectangular" else "EL") + ("OB" if blocks else "AP"), *size)]
            else:
                text = f"clear_apertures: {kind}: expected Circular, or Rectangular or Elliptical without rotation"
                self.findings.report(surface.problem(text), "taken as none")
            found += [("OBDC", x, y)] if found and (x or y) else []
        if len(apertures) > 1:
            self.findings.report(surface.problem("clear_apertures: one aperture of a surface is read, the first"))
        return found

    def _decenter(self, items: JsonObject) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return rotation and shift in front of a surface, and rotation and shift behind it."""
        unit, none = np.eye(3), np.zeros(3)
        if "decenter" not in items:
            return unit, none, unit, none
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
            return turn, shift, unit, none
        if kind == "reverse":
            return unit, none, turn.T, -shift
        if kind == "dec and return":
            return turn, shift, turn.T, -shift
        return turn, shift, turn, none

    def _header(self) -> None:
        head, system = self.found.head, attributes(self.model, "system_spec")
        unit = system.text(named(system, "dimensions"), "mm")
        if unit.lower() not in UNITS:
            raise system.problem(f"dimensions = {unit!r}: expected one of {', '.join(UNITS)}")
        head("UNIT", UNITS[unit.lower()])
        head("NAME", system.text("title", ""))
        optics = attributes(self.model, "optical_spec")
        self._pupil(attributes(optics, "pupil"))
        waves = attributes(optics, "spectral_region")
        lengths = numbers(waves, "wavelengths")
        weights = numbers(waves, "spectral_wts") if "spectral_wts" in waves else []
        weights = (weights + [1.0] * len(lengths))[: len(lengths)]
        self._fields(attributes(optics, "field_of_view"), len(lengths))
        for number, (wave, weight) in enumerate(zip(lengths, weights, strict=True), start=1):
            head("WAVM", str(number), scaled(wave, -3), weight)
        head("PWAV", str(waves.whole("reference_wvl") + 1))
        head("ENVD", system.number("temperature", 20.0), system.number("pressure", MMHG) / MMHG, "0")

    def _pupil(self, pupil: JsonObject) -> None:
        space, kind = self._key(pupil)
        if (space, kind) not in PUPILS:
            raise pupil.problem(f"pupil {space} {kind}: expected one of {_names(PUPILS)}")
        value = pupil.number(named(pupil, "value"))
        keyword = PUPILS[space, kind]
        if keyword == "FNUM":
            if not value:
                pupil.refuse(named(pupil, "value"), "a number other than 0")
            finite = abs(self.distance) < INFINITE
            self.found.head("FNUM", abs(value) if kind == "f/#" else 0.5 / abs(value), str(int(finite)))
        elif keyword == "OBNA":
            if class_name(self.gaps[0].child("medium")) != "Air":
                self.findings.report(pupil.problem("numerical aperture of an object in a medium other than air"))
            # It is the slope of the marginal ray there.
            self.found.head("OBNA", math.sin(math.atan(value)))
        else:
            self.found.head(keyword, value)

    def _fields(self, fields: JsonObject, waves: int) -> None:
        space, kind = self._key(fields)
        if (space, kind) not in FIELDS:
            raise fields.problem(f"field_of_view {space} {kind}: expected one of {_names(FIELDS)}")
        points = [attributes(point) for point in fields.children("fields", "field")]
        scale = fields.number(named(fields, "value")) if fields.flag("is_relative") else 1.0
        head = self.found.head
        head("FTYP", str(FIELDS[space, kind]), "0", str(len(points)), str(waves))
        head("XFLN", *(scale * p.number(named(p, "x")) for p in points))
        head("YFLN", *(scale * p.number(named(p, "y")) for p in points))
        head("FWGN", *(p.number("wt", 1.0) for p in points))
        for axis in "xy":
            upper = np.array([p.number(f"vu{axis}", 0.0) for p in points])
            lower = np.array([p.number(f"vl{axis}", 0.0) for p in points])
            # From the fractions cut off at both ends to a decentre and a compression.
            head(f"VD{axis.upper()}N", *map(float, 0.5 * (lower - upper)))
            head(f"VC{axis.upper()}N", *map(float, 0.5 * (lower + upper)))

    def _key(self, items: JsonObject) -> tuple[str, str]:
        """Return space and kind of a pupil or of fields: the last two words of their key."""
        key = named(items, "key")
        words = items.get(key)
        if not isinstance(words, list) or len(words) < 2 or not all(isinstance(w, str) for w in words):
            items.refuse(key, "a list of words")
        return words[-2], words[-1]


def _names(table: Iterable[tuple[str, str]]) -> str:
    return ", ".join(" ".join(key) for key in table)
