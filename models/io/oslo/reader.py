"""Translate a lens file of OSLO (.len) into the terms of a Zemax file.

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
from ...media.dispersion import model_glass
from ...media.medium import Medium
from ...media.tabulated import TabulatedIndex
from ..glass_search import find_glass
from ..lens.source import Findings
from ..lens.text import Record, read_text, scaled
from ..zemax.file import ZemaxFile
from ..zemax.placed import Line, PlacedSurfaces, numbered
from .frames import surface_frames
from .solves import AxialRay

UNITS = {1.0: "MM", 10.0: "CM", 25.4: "IN", 1000.0: "METER"}
APERTURES = ("EBR", "NAO", "FNO", "NAP")
FIELDS = {"ANG": 0, "OBH": 1, "GIH": 2}
#: Wavelengths [um] of a file that states none (OSLO Program Reference, "Wavelength").
WAVELENGTHS = (0.58756, 0.48613, 0.65627)
#: Distance of the object [lens unit] from which it is at infinity (OSLO Optics Reference, "Telecentric ray-aiming").
INFINITE = 1e8
#: Fields of the header, as fractions of the stated one.
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
class _Surface:
    """Commands of one surface: numbers by command, lines of its name, medium and aperture, pick-ups and solves."""

    number: int
    values: dict[str, float] = field(default_factory=dict)
    glass: Record | None = None
    waves: tuple[float, ...] = ()
    aspheric: str = "ADO"
    checked: bool = False
    name: str = ""
    pick_ups: list[Record] = field(default_factory=list)

    @property
    def place(self) -> str:
        return f"surface {self.number}"

    @property
    def mirror(self) -> bool:
        return self.glass is not None and self.glass.keyword in ("RFL", "RFH")


def read_oslo_file(path: Path, findings: Findings) -> ZemaxFile:
    """Return the parts of an OSLO lens file in the terms of a Zemax file."""
    return _Translation(path, findings).file()


def _commands(path: Path) -> Iterator[Record]:
    """Yield the commands of a file: parted by line ends and semicolons, comments from // to the end."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        # Texts in quotation marks hold semicolons and slashes.
        for part in re.findall(r'(?:"[^"]*"|//.*|[^;])+', line):
            words = re.findall(r'"[^"]*"|//.*|[^\s,"]+', part)
            words = words[: next((i for i, w in enumerate(words) if w.startswith("//")), len(words))]
            if words:
                yield Record(
                    str(path), "", words[0].upper(), line=number, words=tuple(words[1:]), text=" ".join(words[1:])
                )


class _Translation:
    """System data and surfaces of a file, collected from its commands."""

    def __init__(self, path: Path, findings: Findings) -> None:
        self.path, self.findings = path, findings
        self.found = PlacedSurfaces(path, "OSLO")
        self.surfaces = [_Surface(0)]
        self.waves: list[float] = list(WAVELENGTHS)
        self.weights: list[float] = []
        self.aperture: Record | None = None
        self.field: Record | None = None
        self.stop = 1
        self.title = ""
        self.environment: dict[str, float] = {}
        self.check_apertures = True

    def file(self) -> ZemaxFile:
        """Return the parts of the Zemax file."""
        started = ended = False
        for command in _commands(self.path):
            if command.keyword == "LEN" and not started:
                if len(command.words) < 2 or command.words[0].upper() != "NEW":
                    raise command.error('LEN NEW "name" and two numbers')
                started, self.title = True, command.words[1].strip('"')
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
            raise self.found.header.problem(problem)
        self._header()
        self._resolve()
        self._blocks()
        return self.found.file()

    def _read(self, command: Record) -> None:
        key, current = command.keyword, self.surfaces[-1]
        place = f"surface {current.number}"
        command = replace(command, place=place)
        indexed = re.fullmatch(r"(WV|WW)(\d*)", key)
        if key == "NXT":
            self.surfaces.append(_Surface(current.number + 1))
        elif key in APERTURES:
            self.aperture = command
        elif key in FIELDS:
            self.field = command
        elif key in ("TEM", "PRE"):
            self.environment[key] = command.number(0)
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
        self.found.head("UNIT", UNITS[value])

    def _spectrum(self, command: Record, kind: str, number: int) -> None:
        values = [command.number(i) for i in range(len(command.words))]
        target = self.waves if kind == "WV" else self.weights
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
        lines = self._glass_lines(surface)
        if not lines:
            return math.copysign(1.0, before)
        name = str(lines[0][1])
        medium = self.found.glasses.get(name.upper()) or find_glass(name)
        if medium is None:
            raise PrescriptionError(f"{name}: expected a glass of the bundled or the user's catalogues, for the solves")
        return math.copysign(float(medium.index(self.waves[0] / 1e6)), before)

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
            raise self._problem(self.surfaces[0], "TH 0: expected a distance of the object other than 0")
        return math.inf if abs(value) >= INFINITE else value

    def _header(self) -> None:
        head = self.found.head
        head("NAME", self.title)
        self._aperture_line()
        kind, largest = (FIELDS[self.field.keyword], self.field.number(0)) if self.field else (0, 0.0)
        if kind == 1 and math.isinf(self.distance):
            # An object height at infinity stands for its angle.
            kind, largest = 0, math.degrees(math.atan(largest / abs(self.surfaces[0].values.get("TH", math.inf))))
        fields = [fraction * largest for fraction in FRACTIONS] if largest else [0.0]
        head("FTYP", str(kind), "0", str(len(fields)), str(len(self.waves)))
        head("XFLN", *(0.0 for _ in fields))
        head("YFLN", *fields)
        for number, wave in enumerate(self.waves, start=1):
            weight = self.weights[number - 1] if number <= len(self.weights) else 1.0
            head("WAVM", str(number), wave, weight)
        head("PWAV", "1")
        if self.environment:
            head("ENVD", self.environment.get("TEM", 20.0), self.environment.get("PRE", 1.0), "0")

    def _aperture_line(self) -> None:
        command, finite = self.aperture, math.isfinite(self.distance)
        if command is None:
            raise self.found.header.problem(f"expected the aperture: one of {', '.join(APERTURES)}")
        value = command.number(0)
        if command.keyword == "EBR" and finite:
            # The radius of the beam at the first surface.
            self.found.head("OBNA", math.sin(math.atan(value / abs(self.distance))))
        elif command.keyword == "EBR":
            self.found.head("ENPD", 2.0 * value)
        elif command.keyword == "NAO":
            self.found.head("OBNA", value)
        elif value > 0:
            number = value if command.keyword == "FNO" else 0.5 / value
            self.found.head("FNUM", number, str(int(finite)))
        else:
            raise command.error("a positive number")

    def _blocks(self) -> None:
        first, *others = self.surfaces
        last = others[-1]
        # The thickness of the image is a defocus: it counts from where the surface before it leads.
        if last.values.get("TH"):
            before = self.surfaces[-2].values
            before["TH"] = before.get("TH", 0.0) + last.values["TH"]
        with error_context(file=self.path):
            frames = surface_frames([s.values for s in self.surfaces])
        if first.values.get("CV"):
            self.findings.report(self._problem(first, "curved objects are not read"), "taken as a plane")
        self.found.object(self.distance, self._glass_lines(first))
        for surface, (position, axes) in zip(others, frames, strict=True):
            lines = [*self._shape_lines(surface), *self._glass_lines(surface)]
            lines += [("STOP",)] if surface.number == self.stop else []
            lines += [("COMM", surface.name)] if surface.name else []
            radius = surface.values.get("AP", 0.0)
            lines += [("DIAM", radius)] if radius else []
            lines += [("CLAP", 0.0, radius)] if radius and surface.checked and self.check_apertures else []
            self.found.surface(surface.place, lines, position, axes, mirror=surface.mirror)

    def _problem(self, surface: _Surface, text: str) -> PrescriptionError:
        return PrescriptionError(text, file=str(self.path), place=surface.place)

    def _shape_lines(self, surface: _Surface) -> list[Line]:
        values = surface.values
        head: list[Line] = [("CURV", values.get("CV", 0.0)), ("CONI", values.get("CC", 0.0))]
        general = {int(key[2:]): v for key, v in values.items() if re.fullmatch(r"AS\d+", key) and v}
        kind = surface.aspheric
        if kind == "ADO":
            powers = [0.0, *(values.get(key, 0.0) for key in ("AD", "AE", "AF", "AG"))]
            lines = [("TYPE", "EVENASPH" if any(powers) else "STANDARD"), *head, *numbered("PARM", powers)]
        elif kind == "ASR" and max(general, default=0) <= 8 and 0 not in general:
            lines = [("TYPE", "EVENASPH"), *head, *numbered("PARM", general)]
        elif kind == "ARA" and max(general, default=0) <= 8 and 0 not in general:
            lines = [("TYPE", "ODDASPHE"), *head, *numbered("PARM", general)]
        elif kind == "ASX" and 0 not in general:
            # 1 is x, 2 y, 3 x^2, 4 xy...: the order of Zemax's extended polynomial.
            extra = {1: float(max(general, default=0)), 2: 1.0} | {2 + i: v for i, v in general.items()}
            lines = [("TYPE", "XPOLYNOM"), *head, *numbered("XDAT", extra)]
        else:
            terms = f"ASP {kind}: expected ADO, ASR or ARA with AS1 to AS8, or ASX from AS1 on"
            self.findings.report(self._problem(surface, terms), "taken as a conic")
            lines = [("TYPE", "STANDARD"), *head]
        if "CVX" in values:
            if len(lines) > 3:
                self.findings.report(self._problem(surface, "CVX: toroids with aspheric terms are not read"))
            radius = 1.0 / values["CVX"] if values["CVX"] else 0.0
            lines = [("TYPE", "TOROIDAL"), *head, *numbered("PARM", [radius])]
        return lines

    def _glass_lines(self, surface: _Surface) -> list[Line]:
        command = surface.glass
        if command is None or command.keyword in ("AIR", "AIF"):
            return []
        if surface.mirror:
            return [("GLAS", "MIRROR")]
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
            return [("GLAS", name)]
        try:
            return self.found.glass(name, self._model(indices, surface, name, pair=model and len(indices) == 2))
        except PrescriptionError as error:
            raise command.problem(f"{command.shown}: {error}") from None

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
