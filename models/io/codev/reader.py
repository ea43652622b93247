"""Read a CODE V lens file (.seq) as the description of a lens.

Supported commands: RDM, DIM, TITLE, EPD, FNO, NAO, WL, WTW, REF, AFO, TEM (deg C), PRE (mm of mercury), XAN YAN, XOB
YOB, XIM YIM, XRI YRI, WTF, VUX VLX VUY VLY, before or after the surfaces SO S SI (curvature or radius, thickness,
glass), RDY CUY THI GLA, STO, SLB, SPH CON ASP with K and A to J (r^4 to r^20), XDE YDE ZDE ADE BDE CDE with DAR, BEN
and REV, CIR (OBS, HOL, EDG) REX REY and ELX ELY with ADX ADY, linear gratings GRT with GRO, GRS and GRX GRY GRZ (order,
spacing, vector across the grooves), pick-ups PIK, private glasses PRV PWL END. ADE and BDE are left-handed, CDE is
right-handed (CODE V reference manual, "Decentered surfaces"). A glass is a name (NBK7_SCHOTT), REFL, or a number
(517642). Solves are passed over where their solution is given. Rays are aimed at the stop, as CODE V's chief rays are.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np

from ....core.errors import PrescriptionError
from ....core.files import text_lines
from ...aperture import Aperture, Circle, Complement
from ...design_data import BeamAperture
from ...media.medium import Medium
from ...media.tabulated import TabulatedIndex
from ...rotation import rotation_matrix
from ...telescope import VACUUM
from ..lens.apertures import ellipse, rectangle, ring
from ..lens.description import Format, LensDescription, LensSurface
from ..lens.glasses import Glasses, numbered_glass
from ..lens.shapes import even_asphere
from ..lens.source import Findings, Source
from ..lens.text import FileSurface, Record, read_text, scaled
from .gratings import GROOVES, grating_of

FORMAT = Format("CODE V", "EPD, FNO or NAO", "WL", "STO")
UNITS = {"M": 1e-3, "MM": 1e-3, "C": 1e-2, "CM": 1e-2, "I": 0.0254, "IN": 0.0254}
#: Types of field points by the ending of the command, whose first letter is the axis.
FIELDS = {"AN": "angle", "OB": "object_height", "IM": "paraxial_image_height", "RI": "real_image_height"}
#: Commands of field points.
POINTS = tuple(f"{axis}{ending}" for axis in "XY" for ending in FIELDS)
#: System apertures, the first of which counts.
APERTURES = ("EPD", "FNO", "NAO")
#: Millimetres of mercury in an atmosphere.
MMHG = 760.0
#: Vignetting factors: the parts by which the upper and lower halves of the pupil shrink, along x and y.
VIGNETTING = ("VUX", "VLX", "VUY", "VLY")
#: Commands of the whole system with numbers.
NUMERIC = ("WL", "WTW", "WTF", "TEM", "PRE", "REF", *VIGNETTING, *APERTURES, *POINTS)
SYSTEM = frozenset(("RDM", "DIM", "TIT", "AFO", "PRV", *NUMERIC))
LONG_NAMES = {"TITLE": "TIT", "STOP": "STO"}
POWERS = "ABCDEFGHJ"
#: Numbers of surfaces.
NUMBERS = {*["THI", "K", "XDE", "YDE", "ZDE", "ADE", "BDE", "CDE", "REX", "REY", "ELX", "ELY", "ADX", "ADY"], *POWERS}
NUMBERS |= {*GROOVES}
#: Surfaces that are not read.
REFUSED = {
    "DIF": "diffractive surfaces", "HOE": "holograms", "XTO": "toroids", "YTO": "toroids",
    "CYL": "cylinders", "RDX": "surfaces of two radii", "NSS": "non-sequential parts", "GRD": "gradient-index media",
    "ZOO": "zoom positions",
    "GRN": "gradient-index media", "GRC": "gradient-index media", "BIR": "birefringent media",
}  # fmt: skip
#: Values that may be solved for, and what they are, by the command of the solve.
SOLVED = {
    "CUY": ("CURV", "curvature"),
    "RDY": ("CURV", "radius"),
    "THI": ("THI", "thickness"),
    "PIM": ("THI", "thickness"),
}
#: Commands without effect on rays: names, variables and couplings, weights, solves, whose solution stands in the file,
#: and drawing.
_IGNORED = """
LEN NEW DER INI GO CA CCY THC KC AC BC CC DC EC FC GC HC IC JC ADC BDC CDC XDC YDC ZDC CUM UMY SPH CON ASP RDM
WTX WTY VIE DRA COM CUX THM GLC CRA POL CLS WID UID DOR
"""
IGNORED = frozenset(_IGNORED.split())
#: Distance of the object from which it is at infinity [lens unit].
INFINITE = 1e10
#: Values of surfaces that other surfaces may pick up, by command.
PICKED = {k: k for k in ("THI", "K", "XDE", "YDE", "ZDE", "ADE", "BDE", "CDE", *POWERS)}
PICKED |= {"CUY": "CURV", "RDY": "CURV"}
#: Length of glass behind a surface over its radius, beyond which that is no radius; rod lenses have 30.
_LONGEST = 100.0


class LacksRadiusModeError(PrescriptionError):
    """A file without RDM whose surfaces cannot have the curvatures that it states."""


def read_codev_file(path: Path, findings: Findings, glasses: Glasses) -> LensDescription:
    """Return the description of a CODE V lens file."""
    try:
        return _Reader(path, findings, glasses).lens()
    except LacksRadiusModeError as error:
        findings.report(error, "the surfaces have radii")
        return _Reader(path, findings, glasses, assumed_radii=True).lens()


def _commands(path: Path) -> Iterator[Record]:
    """Yield the commands of a file: parted by line ends and semicolons, carried on by &, comments from ! to the end."""
    carried, first = "", 1
    for number, line in enumerate(text_lines(read_text(path)), start=1):
        first = first if carried else number
        text = carried + line.split("!")[0].rstrip()
        if text.endswith("&"):
            carried = text[:-1] + " "
            continue
        carried = ""
        for statement in re.split(r";(?=(?:[^']*'[^']*')*[^']*$)", text):
            words = statement.split()
            if words:
                after = statement.strip()[len(words[0]) :].strip()
                key = LONG_NAMES.get(words[0].upper(), words[0].upper())
                yield Record(str(path), "", key, line=first, words=tuple(words[1:]), text=after)


def _largest(records: list[Record], default: Source) -> Source:
    """Return the command with the number that is farthest from zero."""
    return max(records, key=lambda record: max(map(abs, record.numbers()), default=0.0), default=default)


@dataclass
class _Surface(FileSurface):
    """Commands of one surface, the name of its glass, whether it is the stop, and the solves of its values."""

    glass_name: str = ""
    stop: bool = False
    solves: list[Record] = field(default_factory=list)

    @property
    def mirror(self) -> bool:
        """Whether it reflects."""
        return self.glass_name.upper() in ("REFL", "MIRROR")


class _Reader:
    """System data and surfaces of a file, collected from its commands."""

    def __init__(self, path: Path, findings: Findings, glasses: Glasses, *, assumed_radii: bool = False) -> None:
        self.path, self.findings, self.glasses = path, findings, glasses
        self.description = LensDescription(path, FORMAT, findings)
        self.surfaces: list[_Surface] = []
        self.stop: _Surface | None = None
        #: Last command of each kind of the whole system.
        self.system: dict[str, Record] = {}
        self.radii = assumed_radii
        self.pick_ups: list[Record] = []
        self.private: dict[str, Medium] = {}
        self.private_waves: tuple[float, ...] | None = None

    def lens(self) -> LensDescription:
        """Return the description of the lens."""
        commands = list(_commands(self.path))
        # CODE V takes curvatures unless RDM says otherwise, wherever it stands.
        modes = [c.words for c in commands if c.keyword == "RDM"]
        self.radii |= bool(modes) and not (modes[-1] and modes[-1][0].upper().startswith("N"))
        imaged = self._read(commands)
        if self.surfaces and not imaged:
            # A lens that ends without SI has its image at the thickness of the last surface.
            self._append()
        if len(self.surfaces) < 3:
            problem = f"{len(self.surfaces)} surfaces: expected SO, one S or more, and SI"
            raise self.description.problem(problem)
        self._check_curvatures()
        for command in self.pick_ups:
            self._pick_up(command)
        self._check_solves()
        # The last command counts; where a file names no stop, it is the first surface.
        (self.stop or self.surfaces[1]).stop = True
        self._state_system()
        self._place()
        return self.description

    def _read(self, commands: list[Record]) -> bool:
        """Read all commands; return whether the last surface is the image."""
        current, imaged = -1, False
        for command in commands:
            if self.private_waves is not None:
                self._private(command)
            elif command.keyword in ("SO", "SI") or re.fullmatch(r"S\d*", command.keyword):
                self._append()
                current, imaged = len(self.surfaces) - 1, command.keyword == "SI"
                self._start(replace(command, place=f"surface {current}"))
            elif command.keyword in SYSTEM or not self.surfaces:
                self._system(command)
            elif command.keyword == "PIK":
                self.pick_ups.append(command)
            else:
                number = current
                if command.words and re.fullmatch(r"[Ss](\d+|[OoIi])", command.words[0]):
                    number = self._number(command)
                    command = replace(command, words=command.words[1:])
                self._surface(replace(command, place=f"surface {number}"), self.surfaces[number])
        return imaged

    def _append(self) -> None:
        self.surfaces.append(_Surface(len(self.surfaces)))

    def _number(self, command: Record) -> int:
        word = command.words[0][1:].upper()
        number = {"O": 0, "I": len(self.surfaces) - 1}.get(word)
        number = int(word) if number is None else number
        if number >= len(self.surfaces):
            raise command.error(f"a surface from 0 to {len(self.surfaces) - 1}")
        return number

    def _system(self, command: Record) -> None:
        key = command.keyword
        if key == "PRV":
            self.private_waves = ()
        elif key in SYSTEM:
            if key in NUMERIC:
                # Faults are those of the first line with them.
                command.numbers()
            self.system.pop(key, None)
            self.system[key] = command
        elif key in REFUSED:
            self.findings.report(command.problem(f"{command.shown}: {REFUSED[key]} are not read"))
        elif key not in IGNORED:
            self.findings.report(command.problem(f"{command.shown}: this command is not understood"))

    def _start(self, command: Record) -> None:
        """Read the line that begins a surface: radius or curvature, thickness, glass."""
        surface = self.surfaces[-1]
        surface.commands["CURV"] = surface.commands["THI"] = command
        surface.values["CURV"] = self._curvature(command, radius=self.radii) if command.words else 0.0
        surface.values["THI"] = command.number(1, 0.0, infinite=len(self.surfaces) == 1)
        if len(command.words) > 2:
            surface.glass, surface.glass_name = command, command.words[2]

    def _curvature(self, command: Record, *, radius: bool) -> float:
        value = command.number(0)
        return (1.0 / value if value else 0.0) if radius else value

    def _surface(self, command: Record, surface: _Surface) -> None:
        key, words = command.keyword, command.words
        if key in SOLVED and words and words[0].isalpha():
            # The solve of a value, whose solution stands at the beginning of the surface: CUY UMY -0.1.
            surface.solves.append(command)
        elif key in ("RDY", "CUY"):
            surface.commands["CURV"] = command
            surface.values["CURV"] = self._curvature(command, radius=key == "RDY")
        elif key == "GLA":
            surface.glass, surface.glass_name = command, (words or ("AIR",))[0]
        elif key == "STO":
            self.stop, surface.commands[key] = surface, command
        elif key == "SLB":
            surface.name = command.text.strip("'\" ")
        elif key in NUMBERS:
            surface.commands[key], surface.values[key] = command, command.number(0)
        elif key == "GRT" or (key == "DIF" and [w.upper() for w in words] == ["GRT"]):
            surface.commands["GRT"] = command
        elif key in ("DAR", "BEN", "REV"):
            surface.commands[key], surface.values[key] = command, 1.0
        elif key == "CIR":
            self._circle(command, surface)
        elif key == "CUF":
            if command.number(0):
                self.findings.report(command.problem(f"{command.shown}: Fresnel surfaces are not read"))
        elif key in REFUSED:
            self.findings.report(command.problem(f"{command.shown}: {REFUSED[key]} are not read"))
        elif key == "PIM":
            surface.solves.append(command)
        elif key not in IGNORED:
            self.findings.report(command.problem(f"{command.shown}: this command is not understood"))

    def _circle(self, command: Record, surface: _Surface) -> None:
        # Labels (L'A') tell several apertures of a kind apart; one of each kind is read.
        names = [w.upper() for w in command.words if w.isalpha() or w[:2].upper() in ("L'", 'L"')]
        radius = replace(command, words=command.words[len(names) :]).number(0)
        kinds = [n for n in names if n.isalpha()] or ["CLR"]
        if kinds[0] not in ("CLR", "OBS", "HOL", "EDG") or kinds[1:]:
            raise command.error("CIR with one of CLR, OBS, HOL, EDG")
        # An edge is where the glass ends and stops nothing; light that falls into a hole is lost.
        key = {"CLR": "CLEAR", "EDG": "EDGE"}.get(kinds[0], "OBSCURED")
        if key in surface.values and (kinds[0] == "HOL" or not all(n.isalpha() for n in names)) and key != "EDGE":
            text = f"{command.shown}: one aperture and one obscuration of a surface are read"
            self.findings.report(command.problem(text))
        surface.commands[key], surface.values[key] = command, radius

    def _private(self, command: Record) -> None:
        """Read a line of the private catalogue: wavelengths PWL [nm], then a name and indices, up to END."""
        assert self.private_waves is not None
        if command.keyword == "END":
            self.private_waves = None
            return
        numbers = command.numbers()
        if command.keyword == "PWL":
            self.private_waves = tuple(scaled(v, -9) for v in numbers)
            return
        if len(numbers) != len(self.private_waves):
            raise command.error(f"{len(self.private_waves)} indices, one for each wavelength of PWL")
        name = command.keyword.strip("'")
        table = sorted(zip(self.private_waves, numbers, strict=True))
        waves, indices = zip(*table, strict=True) if table else ((), ())
        try:
            self.private[name] = TabulatedIndex(waves, indices, name=name)
        except PrescriptionError as error:
            raise command.problem(f"glass {name}: {error}") from None

    def _pick_up(self, command: Record) -> None:
        """Take over a value of another surface: ``PIK THI S3 Z1 THI S2 Z1 scale offset``."""
        words = [w.upper() for w in command.words if not re.fullmatch(r"[Zz]\d+", w)]
        if len(words) < 4 or words[0] != words[2] or words[0] not in PICKED:
            self.findings.report(command.problem(f"{command.shown}: only pick-ups of the same value are read"))
            return
        numbers = (self._number(replace(command, words=(words[i],))) for i in (1, 3))
        target, source = (self.surfaces[number] for number in numbers)
        factors = replace(command, words=tuple(words[4:]))
        scale, offset, key = factors.number(0, 1.0), factors.number(1, 0.0), PICKED[words[0]]
        value = source.get(key)
        target.commands[key] = command
        if words[0] == "RDY" and (scale != 1.0 or offset):
            radius = scale / value + offset if value else 0.0
            target.values[key] = 1.0 / radius if radius else 0.0
        else:
            target.values[key] = scale * value + offset

    def _check_curvatures(self) -> None:
        """Refuse a file whose first curved surface would not reach the rim of the pupil: radii that lack RDM."""
        stated = self.system.get("EPD")
        diameter = 0.0 if stated is None else stated.number(0)
        curvature = next((s.get("CURV") for s in self.surfaces[1:] if s.get("CURV")), 0.0)
        small = f"the entrance pupil of {diameter:g}" if 0.5 * diameter * abs(curvature) > 1.0 else ""
        for surface in self.surfaces[1:]:
            glass = not surface.mirror and surface.glass_name.upper() not in ("", "AIR")
            if not small and glass and abs(surface.get("CURV") * surface.get("THI")) > _LONGEST:
                small, curvature = f"a hundredth of its glass of {surface.get('THI'):g}", surface.get("CURV")
        if small and not self.radii:
            raise LacksRadiusModeError(
                f"curvature {curvature:g}: a sphere smaller than {small}; expected RDM where surfaces have radii",
                file=str(self.path),
            )

    def _check_solves(self) -> None:
        """Refuse a solve whose solution does not stand in the file: PIM is that of a thickness."""
        for surface in self.surfaces[:-1]:
            for command in surface.solves:
                key, name = SOLVED[command.keyword]
                if not surface.get(key):
                    solve = command.keyword if command.keyword == "PIM" else command.shown
                    raise command.problem(f"{solve}: expected the {name} of the solve in the file; it is 0")

    def _state_system(self) -> None:
        lens, system = self.description, self.system
        unit = system.get("DIM", Record(str(self.path), words=("M",)))
        name = (unit.words or ("M",))[0].upper()
        if name not in UNITS:
            raise unit.error(f"one of {', '.join(UNITS)}")
        lens.state_unit(UNITS[name])
        lens.title = system["TIT"].text.strip("'\" ") if "TIT" in system else ""
        distance = self.surfaces[0].get("THI")
        lens.object_distance = math.inf if abs(distance) >= INFINITE else distance * lens.unit
        self._state_spectrum()
        self._state_fields()
        for key in APERTURES:
            if key in system:
                value = system[key].number(0)
                # The f-number is that of the image space at the conjugates of the lens.
                focal_ratio: BeamAperture = "working_f_number" if math.isfinite(lens.object_distance) else "f_number"
                kinds: dict[str, BeamAperture] = {"EPD": "entrance_pupil", "NAO": "object_na"}
                kind = kinds.get(key, focal_ratio)
                lens.state_aperture(system[key], kind, value * lens.unit if key == "EPD" else value)
        # Chief rays pass the middle of the stop.
        lens.state(Source(str(self.path)), aiming="paraxial")
        if "AFO" in system:
            words = system["AFO"].words
            lens.state(system["AFO"], afocal=not (words and words[0].upper().startswith("N")))
        air = [system.get("TEM"), system.get("PRE")]
        celsius, pressure = (v.number(0, usual) if v else usual for v, usual in zip(air, (20.0, MMHG), strict=True))
        for command in [v for v in air if v][:1]:
            lens.state_air(command, celsius, pressure / MMHG)

    def _numbers(self, key: str) -> list[float]:
        return self.system[key].numbers() if key in self.system else []

    def _state_spectrum(self) -> None:
        if "WL" not in self.system:
            return
        waves = [scaled(v, -9) for v in self._numbers("WL")]
        reference = self.system.get("REF")
        primary = 1 if reference is None else reference.integer(0)
        if reference is not None and waves and not 1 <= primary <= len(waves):
            raise reference.error(f"1 to {len(waves)}")
        self.description.state_wavelengths(self.system["WL"], waves, self._numbers("WTW"), primary - 1)

    def _state_fields(self) -> None:
        lens = self.description
        stated = [record for key, record in self.system.items() if key in POINTS]
        columns = {record.keyword[0]: record.numbers() for record in stated}
        points = list(zip_longest(columns.get("X", ()), columns.get("Y", ()), fillvalue=0.0)) or [(0.0, 0.0)]
        kind = FIELDS[stated[-1].keyword[1:]] if stated else "angle"
        lens.state_fields(_largest(stated, Source(str(self.path), keyword="YAN")), kind, points)
        if "WTF" in self.system:
            lens.state_field_weights(self.system["WTF"], self._numbers("WTF"))
        factors = [self.system[key] for key in VIGNETTING if key in self.system]
        lens.state_vignetted_ends(_largest(factors, Source(str(self.path))), *map(self._numbers, VIGNETTING))

    def _medium(self, surface: _Surface) -> Medium:
        name, command = surface.glass_name, surface.glass
        if command is None or surface.mirror or name.upper() == "AIR":
            return VACUUM
        digits = re.fullmatch(r"(\d{3})\.?(\d{3})|(\d{6})\.(\d{6})", name)
        numbers = re.fullmatch(r"(\d\.\d+):(\d+\.?\d*)", name)
        if digits:
            # A number: the digits of nd - 1, then the Abbe number times ten, each with three digits or six.
            index, abbe = (digits[1], digits[2]) if digits[1] else (digits[3], digits[4])
            nd, vd = 1 + float(f"0.{index}"), float(abbe) / 10 ** (len(abbe) - 2)
            return numbered_glass(nd, vd, 0.0, name, command)
        if numbers:
            # Index and Abbe number as they are.
            return numbered_glass(float(numbers[1]), float(numbers[2]), 0.0, name, command)
        name = name.strip("'").upper()
        if name in self.private:
            return self.private[name]
        name, *makers = name.split("_")
        return self.glasses.named(name, command, makers)

    def _aperture(self, surface: _Surface) -> Aperture | None:
        unit = self.description.unit
        x, y = surface.get("ADX") * unit, surface.get("ADY") * unit
        regions: list[tuple[Record, Aperture]] = []
        inner = surface.get("OBSCURED") * unit
        if "CLEAR" in surface.values:
            command, outer = surface.commands["CLEAR"], surface.get("CLEAR") * unit
            if "OBSCURED" in surface.values and not 0 <= inner < outer:
                raise surface.commands["OBSCURED"].error(f"a radius below that of {command.shown}")
            regions.append((command, ring(command, inner, outer, x, y)))
        elif inner:
            with surface.commands["OBSCURED"].context():
                regions.append((surface.commands["OBSCURED"], Complement(Circle(inner, x, y))))
        for keys, region in ((("REX", "REY"), rectangle), (("ELX", "ELY"), ellipse)):
            stated = next((surface.commands[key] for key in keys if key in surface.values), None)
            if stated is not None:
                half_x, half_y = (surface.get(key) * unit for key in keys)
                regions.append((stated, region(stated, half_x, half_y, x, y)))
        if len(regions) > 1:
            raise regions[1][0].error(f"one aperture of a surface, not {regions[0][0].keyword} as well")
        return regions[0][1] if regions else None

    def _place(self) -> None:
        """Add the surfaces one after the other, with the local frame of the light."""
        lens, unit = self.description, self.description.unit
        first, *surfaces_behind = self.surfaces
        lens.medium = self._medium(first)
        for key in ("XDE", "YDE", "ZDE", "ADE", "BDE", "CDE", *POWERS):
            if first.get(key):
                shown = first.commands[key].shown
                self.findings.report(first.commands[key].problem(f"{shown}: expected a flat object on the axis"))
        # The thickness of the image is a defocus: it counts from where the surface before it leads.
        surfaces_behind[-2].values["THI"] = surfaces_behind[-2].get("THI") + surfaces_behind[-1].get("THI")
        surfaces_behind[-1].values["THI"] = 0.0
        origin, axes, distance = np.zeros(3), np.eye(3), 0.0
        for number, surface in enumerate(surfaces_behind, start=1):
            # The first two angles are left-handed.
            angles = (-surface.get("ADE"), -surface.get("BDE"), surface.get("CDE"))
            shift = np.array([surface.get("XDE"), surface.get("YDE"), surface.get("ZDE")]) * unit
            turn, moved = rotation_matrix(np.radians(angles)), any(angles) or bool(np.any(shift))
            basis = origin, axes
            if moved and not surface.get("REV"):
                origin, axes, distance = origin + axes @ shift, axes @ turn, distance + float(shift[2])
            self._add(surface, number, origin, axes, distance)
            gap = surface.get("THI") * unit
            distance = gap
            if moved and (surface.get("DAR") or surface.get("REV")):
                # The surface that undoes a decentre stands in the frame before it.
                back = turn.T @ (0.0 - shift)
                origin, axes = (origin + axes @ back, axes @ turn.T) if surface.get("REV") else basis
                distance = gap - float(shift[2])
            elif moved and surface.get("BEN"):
                if angles[2]:
                    raise surface.commands["BEN"].problem(f"BEN with CDE {angles[2]:g}: not understood")
                axes = axes @ turn
            origin = origin + axes[:, 2] * gap

    def _add(self, surface: _Surface, number: int, origin: np.ndarray, axes: np.ndarray, distance: float) -> None:
        lens, unit = self.description, self.description.unit
        stated = [surface.commands[key] for key in ("CURV", "K", *POWERS) if key in surface.commands]
        place = Source(str(self.path), surface.place)
        command = max(reversed(stated), key=lambda record: record.line) if stated else place
        powers = [0.0, *(surface.get(p) * unit ** (1 - 2 * i) for i, p in enumerate(POWERS, start=2))]
        with command.context():
            shape = even_asphere(surface.get("CURV") / unit, surface.get("K"), powers)
        placed = LensSurface(
            surface.commands.get("STO", place) if surface.stop else place,
            shape,
            origin,
            axes,
            name=surface.name,
            after=self._medium(surface),
            aperture=self._aperture(surface),
            grating=grating_of(surface, unit, self.findings),
            semi_diameter=surface.get("EDGE") * unit,
            stop=surface.stop,
            distance=distance,
        )
        lens.add(placed, mirror=surface.mirror)
