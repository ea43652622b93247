"""Read a lens file of OSLO (.len) as the description of a lens.

Supported commands: LEN NEW, UNI (mm for each lens unit), EBR, NAO, FNO, NAP, ANG, OBH, GIH, TEM (deg C), PRE (atm), WV,
WW and these numbered; for surfaces, parted by NXT up to END, NOT (their name), RD, CV, CVX, TH, AP (CHK), AIR, RFL, GLA
(name, index, indices at the wavelengths, MOD), AST, CC, AD AE AF AG, ASP with ASR, ARA and ASX, DCX DCY DCZ TLA TLB TLC
with DT, TOX TOY TOZ, GC, RCO and BEN, pick-ups PK CV, TH, GLA, AP, and the solves PY and PU of the axial ray. Sources:
OSLO Program Reference and Optics Reference (Lambda Research), OSLO User's Guide ("Assignment commands"). The first
wavelength is the primary one; without AST the first surface is the stop.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from ....core.errors import PrescriptionError, error_context
from ....core.files import read_bytes, text_lines
from ...media.dispersion import model_glass
from ...media.medium import Medium
from ...media.tabulated import TabulatedIndex
from ...shapes.shape import Shape
from ...telescope import VACUUM
from ..lens import shapes
from ..lens.apertures import ring
from ..lens.axial_ray import AxialRay
from ..lens.description import Format, LensDescription, LensSurface
from ..lens.glasses import Glasses
from ..lens.shapes import polynomial_powers, radius_of
from ..lens.source import Findings, Source
from ..lens.text import FileSurface, Record, decoded, read_text, scaled
from .frames import surface_frames

FORMAT = Format("OSLO", "one of EBR, NAO, FNO, NAP", "WV", "AST")
#: Units of length [m] by their millimetres.
UNITS = {1.0: 1e-3, 10.0: 1e-2, 25.4: 0.0254, 1000.0: 1.0}
APERTURES = ("EBR", "NAO", "FNO", "NAP")
FIELDS = {"ANG": "angle", "OBH": "object_height", "GIH": "paraxial_image_height"}
#: Wavelengths [um] of a file that states none (OSLO Program Reference, "Wavelength").
WAVELENGTHS = (0.58756, 0.48613, 0.65627)
#: Distance of the object [lens unit] from which it is at infinity (OSLO Optics Reference, "Telecentric ray-aiming").
INFINITE = 1e8
#: Beginnings of texts in UTF-16.
_BYTE_ORDER_MARKS = (b"\xff\xfe", b"\xfe\xff")
#: Terms of aspheres ASR and ARA at most.
_MOST = 8
#: Fields of a lens, as fractions of the stated one.
FRACTIONS = (0.0, 0.7, 1.0)
#: Commands of a surface with one number.
_NUMBERS = "CC AD AE AF AG CVX DCX DCY DCZ TLA TLB TLC DT GC TOX TOY TOZ TH"
NUMBERS = frozenset(_NUMBERS.split())
#: Commands of the shape of a surface besides curvature and conic constant.
SHAPE = r"CVX|A[DEFG]|AS\d+"
#: Commands without effect on rays: names, notes, drawing, groups, expansion, coatings, printing.
_IGNORED = """
DES LMO LMN LME DRW LDP CBK CALLBACK GPRT TCE ELMDF1 ELMDF2 BDI BDD VX PF TLR COA CTG RDF THF TEX
"""
IGNORED = frozenset(_IGNORED.split())
#: Surfaces that are not read, where their value is not zero.
REFUSED = {
    "PFL": "perfect lenses", "GSP": "gratings", "GOR": "gratings", "DOE": "diffractive surfaces",
    "GRD": "gradient-index media", "APN": "special apertures", "ATP": "special apertures", "TELE": "telecentric beams",
    "PYC": "solves of the chief ray", "PUC": "solves of the chief ray", "EC": "edge-contact solves",
}  # fmt: skip


@dataclass
class _Surface(FileSurface):
    """Commands of one surface, wavelengths of its indices, kind of its asphere, and pick-ups."""

    waves: tuple[float, ...] = ()
    aspheric: str = "ADO"
    checked: bool = False
    pick_ups: list[Record] = field(default_factory=list)

    @property
    def mirror(self) -> bool:
        return self.glass is not None and self.glass.keyword in ("RFL", "RFH")


def read_oslo_file(path: Path, findings: Findings, glasses: Glasses) -> LensDescription:
    """Return the description of an OSLO lens file."""
    raw = read_bytes(path, PrescriptionError)
    if b"\0" in raw and not raw.startswith(_BYTE_ORDER_MARKS):
        raise PrescriptionError(
            "a binary file, as of CODE V, not one of OSLO: write the lens there as a sequence (WRL) and open the .seq",
            file=path,
        )
    if re.match(r"\s*RDM\b", decoded(raw, str(path))):
        raise PrescriptionError("a sequence of CODE V, not a file of OSLO: rename it, to end in .seq", file=path)
    return _Reader(path, findings, glasses).lens()


def _commands(path: Path) -> Iterator[Record]:
    """Yield the commands of a file: parted by line ends and semicolons, comments from // to the end."""
    for number, line in enumerate(text_lines(read_text(path)), start=1):
        # Texts in quotation marks hold semicolons and slashes.
        for statement in re.findall(r'(?:"[^"]*"|//.*|[^;])+', line):
            words = re.findall(r'"[^"]*"|//.*|[^\s,"]+', statement)
            words = words[: next((i for i, w in enumerate(words) if w.startswith("//")), len(words))]
            if words:
                yield Record(
                    str(path), "", words[0].upper(), line=number, words=tuple(words[1:]), text=" ".join(words[1:])
                )


class _Reader:
    """System data and surfaces of a file, collected from its commands."""

    def __init__(self, path: Path, findings: Findings, glasses: Glasses) -> None:
        self.path, self.findings, self.glasses = path, findings, glasses
        self.description = LensDescription(path, FORMAT, findings)
        self.surfaces = [_Surface(0)]
        self.waves: list[float] = list(WAVELENGTHS)
        self.weights: list[float] = []
        #: Last commands of the whole system.
        self.spectrum: Source = Source(str(path), keyword="WV")
        self.aperture: Record | None = None
        self.field: Record | None = None
        self.air: dict[str, Record] = {}
        self.stop = 1
        self.check_apertures = True
        #: Glasses that the file describes by indices, by name in capitals.
        self.described: dict[str, Medium] = {}

    def lens(self) -> LensDescription:
        """Return the description of the lens."""
        started = ended = False
        for command in _commands(self.path):
            if command.keyword == "LEN" and not started:
                if len(command.words) < 2 or command.words[0].upper() != "NEW":
                    raise command.error('LEN NEW "name" and two numbers')
                started, self.description.title = True, command.words[1].strip('"')
            elif not started:
                raise command.problem(f"{command.shown}: expected LEN NEW first")
            elif ended:
                if command.keyword == "CFG":
                    self.findings.report(command.problem("CFG: one configuration is read, the first"))
            elif command.keyword == "END":
                ended = True
            else:
                self._read(command)
        if len(self.surfaces) < 3:
            problem = f"{len(self.surfaces)} surfaces: expected an object, an image and one between, parted by NXT"
            raise self.description.problem(problem)
        self._state_system()
        for surface in self.surfaces:
            name, medium = self._glass(surface)
            self.described |= {name: medium} if medium is not None else {}
        self._resolve()
        self._place()
        return self.description

    def _read(self, command: Record) -> None:
        key, current = command.keyword, self.surfaces[-1]
        place = "" if key in (*APERTURES, *FIELDS, "TEM", "PRE", "UNI") else current.place
        command = replace(command, place=place)
        current.commands[key] = command
        indexed = re.fullmatch(r"(WV|WW)(\d*)", key)
        if key == "NXT":
            self.surfaces.append(_Surface(current.number + 1))
        elif key in APERTURES:
            self.aperture = command
        elif key in FIELDS:
            self.field = command
        elif key in ("TEM", "PRE"):
            self.air[key] = command
        elif key == "NOT":
            current.name = " ".join(command.text.strip('"').split())
        elif key == "UNI":
            self._unit(command)
        elif indexed:
            self._spectrum(command, indexed[1], int(indexed[2] or 0))
        elif key in ("AIR", "AIF", "RFL", "RFH", "GLA", "GLF"):
            current.glass, current.waves = command, tuple(self.waves)
        elif key in ("RD", "CV"):
            value = command.number(0)
            current.values["CV"] = value if key == "CV" else (1.0 / value if value else 0.0)
        elif key in NUMBERS or re.fullmatch(r"AS\d{1,3}", key):
            current.values[key] = command.number(0)
        elif key == "AP":
            checked = bool(command.words) and command.words[0].upper() == "CHK"
            offset = 1 if command.words and command.words[0].upper() in ("CHK", "UNC") else 0
            current.checked, current.values["AP"] = checked, command.number(offset)
        elif key == "APCK":
            self.check_apertures = command.text.upper() in ("ON", "1")
        elif key == "AST":
            self.stop = current.number
        elif key == "ASP":
            kind = (command.words or ("ADO",))[0].upper()
            current.aspheric = {"0": "ADO", "1": "ASR", "2": "ASX"}.get(kind, kind)
        elif key == "RCO":
            current.values["RCO"] = command.number(0, float(current.number))
        elif key == "BEN":
            current.values["BEN"] = 1.0
        elif key == "PK":
            current.pick_ups.append(command)
        elif key in ("PY", "PU"):
            current.values[key] = command.number(0)
        elif key in REFUSED:
            if command.text.upper() not in ("0", "0.0", "OFF"):
                self.findings.report(command.problem(f"{command.shown}: {REFUSED[key]} are not read"))
        elif key == "NOTE" or (key == "SNO" or re.fullmatch(r"SNO\d+", key)) or key in IGNORED:
            return
        else:
            self.findings.report(command.problem(f"{command.shown}: this command is not understood"))

    def _unit(self, command: Record) -> None:
        value = command.number(0)
        if value not in UNITS:
            raise command.error(f"one of {', '.join(f'{v:g}' for v in UNITS)}, millimetres for each lens unit")
        self.description.state_unit(UNITS[value])

    def _spectrum(self, command: Record, kind: str, number: int) -> None:
        values = [command.number(i) for i in range(len(command.words))]
        target = self.waves if kind == "WV" else self.weights
        self.spectrum = command if kind == "WV" else self.spectrum
        if number == 0:
            target[:] = values
        elif number <= len(target) + 1 and len(values) == 1:
            target[number - 1 : number] = values
        else:
            raise command.error("one number, and those of the wavelengths before it")

    def _resolve(self) -> None:
        """Give each surface the values that it picks up, and those that solves of the axial ray make."""
        for surface in self.surfaces:
            self._pick_up(surface)
        if not any(key in s.values for s in self.surfaces for key in ("PY", "PU")):
            return
        ray = self._axial_ray()
        for surface in self.surfaces:
            # Pick-ups of values that were solved for before.
            self._pick_up(surface)
            values = surface.values
            with error_context(file=self.path, place=surface.place):
                if surface.number:
                    after = self._index(surface, ray.index)
                    if "PU" in values:
                        values["CV"] = ray.solved_curvature(values["PU"], after)
                    ray.pass_surface(values.get("CV", 0.0), after)
                    if "PY" in values:
                        values["TH"] = ray.solved_thickness(values["PY"])
                if surface.number or math.isfinite(self.distance):
                    ray.advance(values.get("TH", 0.0))

    def _axial_ray(self) -> AxialRay:
        command, finite = self.aperture, math.isfinite(self.distance)
        key, value = (command.keyword, command.number(0)) if command else ("", 1.0)
        if not finite:
            return AxialRay(value, 0.0, 1.0, scaled=key == "EBR")
        slope = math.tan(math.asin(min(value, 0.999))) if key == "NAO" else value / abs(self.distance)
        return AxialRay(0.0, slope, 1.0, scaled=key in ("EBR", "NAO"))

    def _index(self, surface: _Surface, before: float) -> float:
        """Return the index behind a surface at the primary wavelength, negative behind an odd number of mirrors."""
        if surface.mirror:
            return -before
        return math.copysign(float(self._medium(surface).index(self.waves[0] / 1e6)), before)

    def _pick_up(self, surface: _Surface) -> None:
        """Take over values of earlier surfaces: ``PK CV n``, ``PK TH n addition``, CVM and THM with the other sign."""
        for command in surface.pick_ups:
            kind = command.words[0].upper() if command.words else ""
            number = command.integer(1) if len(command.words) > 1 else 0
            number = surface.number + number if number < 0 else number
            if not 0 <= number < surface.number:
                raise command.error(f"an earlier surface than {surface.number}")
            source = self.surfaces[number]
            sign = -1.0 if kind in ("CVM", "THM") else 1.0
            if kind in ("CV", "CVM"):
                # The whole shape goes along, the conic constant without a sign.
                shape = {k: sign * v for k, v in source.values.items() if re.fullmatch(SHAPE, k)}
                surface.values |= shape | {"CV": sign * source.values.get("CV", 0.0) + command.number(2, 0.0)}
                surface.values["CC"] = source.values.get("CC", 0.0)
                surface.aspheric = source.aspheric
            elif kind in ("TH", "THM", "AP"):
                key = kind[:2]
                surface.values[key] = sign * source.values.get(key, 0.0) + command.number(2, 0.0)
            elif kind == "GLA":
                surface.glass, surface.waves = source.glass, source.waves
            else:
                self.findings.report(command.problem(f"{command.shown}: only pick-ups CV, TH, GLA and AP are read"))

    @property
    def distance(self) -> float:
        """Distance of the object from the first surface [lens unit]."""
        value = self.surfaces[0].values.get("TH", math.inf)
        if value == 0:
            raise self.surfaces[0].commands["TH"].problem("TH 0: expected a distance of the object other than 0")
        return math.inf if abs(value) >= INFINITE else value

    def _state_system(self) -> None:
        lens = self.description
        lens.object_distance = self.distance * lens.unit
        lens.medium = self._medium(self.surfaces[0])
        self._state_aperture()
        kind, largest = (FIELDS[self.field.keyword], self.field.number(0)) if self.field else ("angle", 0.0)
        if kind == "object_height" and math.isinf(self.distance):
            # An object height at infinity stands for its angle.
            distance = abs(self.surfaces[0].values.get("TH", math.inf))
            kind, largest = "angle", math.degrees(math.atan(largest / distance))
        points = [(0.0, fraction * largest) for fraction in FRACTIONS] if largest else [(0.0, 0.0)]
        lens.state_fields(self.field or Source(str(self.path), keyword="ANG"), kind, points)
        lens.state_wavelengths(self.spectrum, [scaled(wave, -6) for wave in self.waves], self.weights)
        for command in list(self.air.values())[:1]:
            usual = {"TEM": 20.0, "PRE": 1.0}
            lens.state_air(command, *(self.air[k].number(0) if k in self.air else v for k, v in usual.items()))

    def _state_aperture(self) -> None:
        command, lens, finite = self.aperture, self.description, math.isfinite(self.distance)
        if command is None:
            raise lens.problem(f"expected the aperture: {FORMAT.aperture}")
        value = command.number(0)
        if command.keyword == "EBR" and finite:
            # The radius of the beam at the first surface.
            lens.state_aperture(command, "object_na", math.sin(math.atan(value / abs(self.distance))))
        elif command.keyword == "EBR":
            lens.state_aperture(command, "entrance_pupil", 2.0 * value * lens.unit)
        elif command.keyword == "NAO":
            lens.state_aperture(command, "object_na", value)
        elif value > 0:
            number = value if command.keyword == "FNO" else 0.5 / value
            lens.state_aperture(command, "working_f_number" if finite else "f_number", number)
        else:
            raise command.error("a positive number")

    def _place(self) -> None:
        first, *surfaces_behind = self.surfaces
        last, lens = surfaces_behind[-1], self.description
        # The thickness of the image is a defocus: it counts from where the surface before it leads.
        if last.values.get("TH"):
            before = self.surfaces[-2].values
            before["TH"] = before.get("TH", 0.0) + last.values["TH"]
        with error_context(file=self.path):
            frames = surface_frames([s.values for s in self.surfaces])
        if first.get("CV"):
            command = next(first.commands[key] for key in ("RD", "CV") if key in first.commands)
            self.findings.report(command.problem(f"{command.shown}: curved objects are not read"), "taken as a plane")
        for surface, (position, axes) in zip(surfaces_behind, frames, strict=True):
            radius, commands = surface.get("AP") * lens.unit, surface.commands
            source = Source(str(self.path), surface.place)
            checked = radius and surface.checked and self.check_apertures
            placed = LensSurface(
                commands.get("AST", source) if surface.number == self.stop else source,
                self._shape(surface),
                position * lens.unit,
                axes,
                name=surface.name,
                after=VACUUM if surface.mirror else self._medium(surface),
                aperture=ring(commands.get("AP", source), 0.0, radius, 0.0, 0.0) if checked else None,
                semi_diameter=radius,
                stop=surface.number == self.stop,
            )
            lens.add(placed, mirror=surface.mirror)

    def _shape(self, surface: _Surface) -> Shape:
        """Return the shape of a surface; errors are those of the last of its commands."""
        commands = [c for key, c in surface.commands.items() if re.fullmatch(rf"RD|CV|CC|{SHAPE}", key)]
        source: Source = max(commands, key=lambda c: c.line, default=Source(str(self.path), surface.place))
        with source.context():
            shape, bare = self._series(surface)
            if "CVX" not in surface.values:
                return shape
            if not bare:
                text = "CVX: toroids with aspheric terms are not read"
                self.findings.report(surface.commands.get("CVX", source).problem(text))
            radius_x = radius_of(surface.get("CVX")) * self.description.unit
            return shapes.toroid(radius_x, surface.get("CV") / self.description.unit, surface.get("CC"))

    def _series(self, surface: _Surface) -> tuple[Shape, bool]:
        """Return the shape of revolution, or with terms in x and y, and whether it is a conic."""
        unit, kind = self.description.unit, surface.aspheric
        base = surface.get("CV") / unit, surface.get("CC")
        general = {int(key[2:]): v for key, v in surface.values.items() if re.fullmatch(r"AS\d+", key) and v}
        count = max(general, default=0)
        terms = [general.get(i, 0.0) for i in range(1, count + 1)]
        if kind == "ADO":
            terms = [0.0, *(surface.get(key) for key in ("AD", "AE", "AF", "AG"))]
        if kind == "ADO" or (kind in ("ASR", "ARA") and count <= _MOST and 0 not in general):
            step, series = (1, shapes.odd_asphere) if kind == "ARA" else (2, shapes.even_asphere)
            powers = [a * unit ** (1 - step * i) for i, a in enumerate(terms, start=1)]
            return series(*base, powers), not any(terms)
        if kind == "ASX" and 0 not in general:
            # 1 is x, 2 y, 3 x^2, 4 xy...
            rows = [(i, j, a * unit) for (i, j), a in zip(polynomial_powers(count), terms, strict=True)]
            return shapes.polynomial(shapes.conic(*base), rows, unit), not terms
        text = f"ASP {kind}: expected ADO, ASR or ARA with AS1 to AS8, or ASX from AS1 on"
        place = surface.commands.get("ASP", Source(str(self.path), surface.place))
        self.findings.report(place.problem(text), "taken as a conic")
        return shapes.conic(*base), True

    def _medium(self, surface: _Surface) -> Medium:
        command, (name, medium) = surface.glass, self._glass(surface)
        if medium is not None or command is None or not name:
            return medium or VACUUM
        return self.described[name] if name in self.described else self.glasses.named(name, command)

    def _glass(self, surface: _Surface) -> tuple[str, Medium | None]:
        """Return the name of a glass in capitals, and the medium that its indices describe; no name for air."""
        command = surface.glass
        if command is None or command.keyword in ("AIR", "AIF") or surface.mirror:
            return "", None
        words = [w.strip('"') for w in command.words]
        model = bool(words) and words[0].upper() == "MOD"
        words = words[1:] if model else words
        named = bool(words) and not re.fullmatch(r"[-+.\d].*", words[0])
        name = words[0] if named else f"MODEL_{surface.number}"
        offset = len(command.words) - len(words) + int(named)
        indices = [command.number(i) for i in range(offset, len(command.words))]
        if not words:
            raise command.error("the name of a glass, or its indices")
        if not indices:
            return name.upper(), None
        with command.context():
            return name.upper(), self._model(indices, surface, name, pair=model and len(indices) == 2)

    def _model(self, indices: list[float], surface: _Surface, name: str, *, pair: bool) -> Medium:
        """Return the glass of indices at the wavelengths, of one index, or of index and Abbe number."""
        if pair:
            return model_glass(*indices)
        if len(set(indices)) == 1:
            return model_glass(indices[0], 0.0)
        if len(indices) != len(surface.waves):
            raise PrescriptionError(f"expected {len(surface.waves)} indices, one for each wavelength (WV)")
        table = sorted(zip((scaled(w, -6) for w in surface.waves), indices, strict=True))
        waves, values = zip(*table, strict=True)
        return TabulatedIndex(waves, values, name=name)
