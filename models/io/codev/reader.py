"""Translate a CODE V lens file (.seq) into the terms of a Zemax file.

Supported commands: RDM, DIM, TITLE, EPD, FNO, NAO, WL, WTW, REF, AFO, TEM (deg C), PRE (mm of mercury), XAN YAN, XOB
YOB, XIM YIM, XRI YRI, WTF, VUX VLX VUY VLY, before or after the surfaces SO S SI (curvature or radius, thickness,
glass), RDY CUY THI GLA, STO, SLB, SPH CON ASP with K and A to G (r^4 to r^16), XDE YDE ZDE ADE BDE CDE with DAR, BEN
and REV, CIR (OBS, HOL, EDG) REX REY and ELX ELY with ADX ADY, pick-ups PIK, private glasses PRV PWL END. ADE and BDE
are left-handed, CDE is right-handed (CODE V reference manual, "Decentered surfaces"), Zemax's tilts are all right-
handed. A glass is a name (NBK7_SCHOTT), REFL, or a number (517642). Solves are passed over where their solution is
given. Rays are aimed at the stop, as CODE V's chief rays are.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

from ....core.errors import PrescriptionError
from ...media.medium import Medium
from ...media.tabulated import TabulatedIndex
from ..lens.source import Findings
from ..lens.text import Record, read_text, scaled
from ..zemax.file import Block, ZemaxFile
from ..zemax.placed import made_record

UNITS = {"M": "MM", "MM": "MM", "C": "CM", "CM": "CM", "I": "IN", "IN": "IN"}
FIELDS = {
    "XAN": ("XFLN", 0), "YAN": ("YFLN", 0), "XOB": ("XFLN", 1), "YOB": ("YFLN", 1),
    "XIM": ("XFLN", 2), "YIM": ("YFLN", 2), "XRI": ("XFLN", 3), "YRI": ("YFLN", 3),
}  # fmt: skip
#: System apertures besides the f-number (FNO), which is that of the image space at the conjugates of the lens.
APERTURES = {"EPD": "ENPD", "NAO": "OBNA"}
#: Millimetres of mercury in an atmosphere.
MMHG = 760.0
#: Vignetting factors: the parts by which the upper and lower halves of the pupil shrink, along x and y.
VIGNETTING = ("VUX", "VLX", "VUY", "VLY")
#: Lists of numbers of the whole system.
LISTS = ("WTW", "FNO", "TEM", "PRE", *VIGNETTING)
SYSTEM = frozenset(("RDM", "DIM", "TIT", "WL", "WTF", "REF", "AFO", "PRV", *LISTS, *APERTURES, *FIELDS))
LONG_NAMES = {"TITLE": "TIT", "STOP": "STO"}
POWERS = "ABCDEFG"
#: Numbers of surfaces.
NUMBERS = {*["THI", "K", "XDE", "YDE", "ZDE", "ADE", "BDE", "CDE", "REX", "REY", "ELX", "ELY", "ADX", "ADY"], *POWERS}
#: Surfaces that are not read.
REFUSED = {
    "DIF": "diffractive surfaces", "GRT": "diffractive surfaces", "XTO": "toroids", "YTO": "toroids",
    "CYL": "cylinders", "RDX": "surfaces of two radii", "NSS": "non-sequential parts", "GRD": "gradient-index media",
}  # fmt: skip
#: Commands without effect on rays: names, variables and couplings, weights, solves, whose solution stands in the file,
#: and drawing.
_IGNORED = """
LEN NEW DER INI GO CA CCY THC KC AC BC CC DC EC FC GC HC IC JC ADC BDC CDC XDC YDC ZDC CUM UMY SPH CON ASP RDM
WTX WTY VIE DRA COM CUX THM GLC CRA POL CLS WID
"""
IGNORED = frozenset(_IGNORED.split())
INFINITE = 1e10
#: Values of surfaces that other surfaces may pick up, by command.
PICKED = {k: k for k in ("THI", "K", "XDE", "YDE", "ZDE", "ADE", "BDE", "CDE", *POWERS)}
PICKED |= {"CUY": "CURV", "RDY": "CURV"}
#: Length of glass behind a surface over its radius, beyond which that is no radius; rod lenses have 30.
_LONGEST = 100.0


class LacksRadiusModeError(PrescriptionError):
    """A file without RDM whose surfaces cannot have the curvatures that it states."""


def read_codev_file(path: Path, findings: Findings) -> ZemaxFile:
    """Return the parts of a CODE V lens file in the terms of a Zemax file."""
    try:
        return _Translation(path, findings).file()
    except LacksRadiusModeError as error:
        findings.report(error, "the surfaces have radii")
        return _Translation(path, findings, assumed_radii=True).file()


def _commands(path: Path) -> Iterator[Record]:
    """Yield the commands of a file: parted by line ends and semicolons, carried on by &, comments from ! to the end."""
    carried, first = "", 1
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        first = first if carried else number
        text = carried + line.split("!")[0].rstrip()
        if text.endswith("&"):
            carried = text[:-1] + " "
            continue
        carried = ""
        for part in re.split(r";(?=(?:[^']*'[^']*')*[^']*$)", text):
            words = part.split()
            if words:
                after = part.strip()[len(words[0]) :].strip()
                yield Record(str(path), "", words[0].upper(), line=first, words=tuple(words[1:]), text=after)


class _Translation:
    """Lines of the same lens in a Zemax file, collected from the commands."""

    def __init__(self, path: Path, findings: Findings, *, assumed_radii: bool = False) -> None:
        self.assumed_radii = assumed_radii
        self.path, self.findings = path, findings
        self.header = Block(str(path))
        self.surfaces: list[Block] = []
        self.values: list[dict[str, float]] = []
        self.radii = False
        self.field_type = 0.0
        self.afocal = False
        self.waves: list[float] = []
        self.lists: dict[str, list[float]] = {}
        self.pick_ups: list[Record] = []
        self.private: dict[str, Medium] = {}
        self.private_waves: tuple[float, ...] | None = None

    def file(self) -> ZemaxFile:
        """Return the parts of the Zemax file."""
        current, imaged = -1, False
        # CODE V takes curvatures unless RDM says otherwise, wherever it stands.
        commands = [replace(c, keyword=LONG_NAMES.get(c.keyword, c.keyword)) for c in _commands(self.path)]
        modes = [c.words for c in commands if c.keyword == "RDM"]
        self.radii = self.assumed_radii or (bool(modes) and not (modes[-1] and modes[-1][0].upper().startswith("N")))
        for command in commands:
            if self.private_waves is not None:
                self._private(command)
            elif command.keyword in ("SO", "SI") or re.fullmatch(r"S\d*", command.keyword):
                self.surfaces.append(Block(str(self.path), f"surface {len(self.surfaces)}"))
                self.values.append({})
                current, imaged = len(self.surfaces) - 1, command.keyword == "SI"
                self._start(replace(command, place=f"surface {current}"))
            elif command.keyword in SYSTEM or not self.surfaces:
                self._system(command)
            elif command.keyword == "PIK":
                self.pick_ups.append(command)
            else:
                chosen = current
                if command.words and re.fullmatch(r"[Ss](\d+|[OoIi])", command.words[0]):
                    chosen = self._number(command)
                    command = replace(command, words=command.words[1:])
                self._surface(replace(command, place=f"surface {chosen}"), chosen)
        if self.surfaces and not imaged:
            # A lens that ends without SI has its image at the thickness of the last surface.
            self.surfaces.append(Block(str(self.path), f"surface {len(self.surfaces)}"))
            self.values.append({"CURV": 0.0})
        if len(self.surfaces) < 3:
            raise self.header.problem(f"{len(self.surfaces)} surfaces: expected SO, one S or more, and SI")
        self._check_curvatures()
        for command in self.pick_ups:
            self._pick_up(command)
        self._check_solves()
        if not any(line.keyword == "STOP" for block in self.surfaces for line in block.lines):
            # Where a file names no stop, it is the first surface.
            self.surfaces[1].lines.append(made_record(self.path, "surface 1", ("STOP",)))
        # Chief rays pass the middle of the stop.
        self._header_line("RAIM", 0, 1)
        for f_number in self.lists.get("FNO", [])[:1]:
            self._header_line("FNUM", f_number, int(abs(self.values[0].get("THI", 0.0)) < INFINITE))
        if "TEM" in self.lists or "PRE" in self.lists:
            celsius, pressure = (self.lists.get(key) or [usual] for key, usual in (("TEM", 20.0), ("PRE", MMHG)))
            self._header_line("ENVD", celsius[0], pressure[0] / MMHG, 0)
        weights = self.lists.get("WTW", [])
        for i, wave in enumerate(self.waves):
            amount = weights[i] if i < len(weights) else 1.0
            self._header_line("WAVM", i + 1, wave, amount)
        for axis in "XY":
            upper, lower = (self.lists.get(f"V{half}{axis}", []) for half in "UL")
            both = list(zip_longest(upper, lower, fillvalue=0.0))
            if both:
                # The pupil reaches from lower - 1 to 1 - upper.
                self._header_line(f"VD{axis}N", *(0.5 * (low - up) for up, low in both))
                self._header_line(f"VC{axis}N", *(0.5 * (low + up) for up, low in both))
        self._header_line("FTYP", self.field_type, 0, 0, len(self.waves), 0, 0, float(self.afocal))
        return ZemaxFile(self.path, self.header, self._blocks(), Block(str(self.path)), self.private, program="CODE V")

    def _header_line(self, keyword: str, *values: float) -> None:
        self.header.lines.append(made_record(self.path, "", (keyword, *values)))

    def _number(self, command: Record) -> int:
        word = command.words[0][1:].upper()
        number = {"O": 0, "I": len(self.surfaces) - 1}.get(word)
        number = int(word) if number is None else number
        if number >= len(self.surfaces):
            raise command.error(f"a surface from 0 to {len(self.surfaces) - 1}")
        return number

    def _system(self, command: Record) -> None:
        key, words = command.keyword, command.words

        def add(keyword: str, *values: object) -> None:
            self.header.lines.append(replace(command, keyword=keyword, words=tuple(map(str, values))))

        if key == "RDM":
            return
        if key == "PRV":
            self.private_waves = ()
        elif key == "DIM":
            unit = (words or ("M",))[0].upper()
            if unit not in UNITS:
                raise command.error(f"one of {', '.join(UNITS)}")
            self.header.lines.append(replace(command, keyword="UNIT", words=(UNITS[unit],), text=UNITS[unit]))
        elif key == "TIT":
            self.header.lines.append(replace(command, keyword="NAME", text=command.text.strip("'\" ")))
        elif key in APERTURES:
            add(APERTURES[key], command.number(0))
        elif key == "WL":
            self.waves = [scaled(command.number(i), -3) for i in range(len(words))]
        elif key in LISTS:
            self.lists[key] = [command.number(i) for i in range(len(words))]
        elif key == "WTF":
            add("FWGN", *(repr(command.number(i)) for i in range(len(words))))
        elif key == "REF":
            add("PWAV", command.integer(0))
        elif key == "AFO":
            self.afocal = not (words and words[0].upper().startswith("N"))
        elif key in FIELDS:
            keyword, self.field_type = FIELDS[key]
            add(keyword, *(repr(command.number(i)) for i in range(len(words))))
        elif key not in IGNORED:
            self.findings.report(command.problem(f"{command.shown}: this command is not understood"))

    def _start(self, command: Record) -> None:
        """Read the line that begins a surface: radius or curvature, thickness, glass."""
        values = self.values[-1]
        values["CURV"] = self._curvature(command, 0, radius=self.radii) if command.words else 0.0
        values["THI"] = command.number(1, 0.0, infinite=len(self.surfaces) == 1)
        if len(command.words) > 2:
            self._glass(command, command.words[2], len(self.surfaces) - 1)

    def _curvature(self, command: Record, position: int, *, radius: bool) -> float:
        value = command.number(position)
        return (1.0 / value if value else 0.0) if radius else value

    def _glass(self, command: Record, name: str, number: int) -> None:
        found = re.fullmatch(r"(\d{3})\.?(\d{3})|(\d{6})\.(\d{6})", name)
        numbers = re.fullmatch(r"(\d\.\d+):(\d+\.?\d*)", name)
        if name.upper() in ("REFL", "MIRROR"):
            words: tuple[str, ...] = ("MIRROR",)
        elif name.upper() == "AIR":
            return
        elif found:
            # A number: the digits of nd - 1, then the Abbe number times ten, each with three digits or six.
            index, abbe = (found[1], found[2]) if found[1] else (found[3], found[4])
            words = (name, "1", "0", repr(1 + float(f"0.{index}")), repr(float(abbe) / 10 ** (len(abbe) - 2)))
        elif numbers:
            # Index and Abbe number as they are.
            words = (name, "1", "0", numbers[1], numbers[2])
        else:
            words = (name.strip("'").split("_")[0],)
        self.surfaces[number].lines.append(replace(command, keyword="GLAS", words=words))

    def _surface(self, command: Record, number: int) -> None:
        key, words = command.keyword, command.words
        block, values = self.surfaces[number], self.values[number]
        if key in ("RDY", "CUY"):
            values["CURV"] = self._curvature(command, 0, radius=key == "RDY")
        elif key == "GLA":
            self._glass(command, (words or ("AIR",))[0], number)
        elif key in ("STO", "SLB"):
            keyword = {"STO": "STOP", "SLB": "COMM"}[key]
            block.lines.append(replace(command, keyword=keyword, text=command.text.strip("'\" ")))
        elif key in NUMBERS:
            values[key] = command.number(0)
        elif key in ("DAR", "BEN", "REV"):
            values[key] = 1.0
        elif key == "CIR":
            # Labels (L'A') tell several apertures of a kind apart; one of each kind is read.
            names = [w.upper() for w in words if w.isalpha() or w[:2].upper() in ("L'", 'L"')]
            radius = replace(command, words=words[len(names) :]).number(0)
            kinds = [n for n in names if n.isalpha()] or ["CLR"]
            if kinds[0] not in ("CLR", "OBS", "HOL", "EDG") or kinds[1:]:
                raise command.error("CIR with one of CLR, OBS, HOL, EDG")
            # An edge is where the glass ends and stops nothing; light that falls into a hole is lost.
            if kinds[0] == "EDG":
                values["EDGE"] = radius
            else:
                name = "CLEAR" if kinds[0] == "CLR" else "OBSCURED"
                if name in values and (kinds[0] == "HOL" or not all(n.isalpha() for n in names)):
                    text = f"{command.shown}: one aperture and one obscuration of a surface are read"
                    self.findings.report(command.problem(text))
                values[name] = radius
        elif key == "CUF":
            if command.number(0):
                self.findings.report(command.problem(f"{command.shown}: Fresnel surfaces are not read"))
        elif key in REFUSED:
            self.findings.report(command.problem(f"{command.shown}: {REFUSED[key]} are not read"))
        elif key == "PIM":
            values["PIM"] = command.line
        elif key not in IGNORED:
            self.findings.report(command.problem(f"{command.shown}: this command is not understood"))

    def _private(self, command: Record) -> None:
        """Read a line of the private catalogue: wavelengths PWL [nm], then a name and indices, up to END."""
        assert self.private_waves is not None
        if command.keyword == "END":
            self.private_waves = None
            return
        numbers = [command.number(i) for i in range(len(command.words))]
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
        target, source = (self._number(replace(command, words=(words[i],))) for i in (1, 3))
        rest = replace(command, words=tuple(words[4:]))
        scale, offset, key = rest.number(0, 1.0), rest.number(1, 0.0), PICKED[words[0]]
        value = self.values[source].get(key, 0.0)
        if words[0] == "RDY" and (scale != 1.0 or offset):
            radius = scale / value + offset if value else 0.0
            self.values[target][key] = 1.0 / radius if radius else 0.0
        else:
            self.values[target][key] = scale * value + offset

    def _check_curvatures(self) -> None:
        """Refuse a file whose first curved surface would not reach the rim of the pupil: radii that lack RDM."""
        diameter = self.header.number("ENPD", 0.0)
        curvature = next((v["CURV"] for v in self.values[1:] if v["CURV"]), 0.0)
        small = f"the entrance pupil of {diameter:g}" if 0.5 * diameter * abs(curvature) > 1.0 else ""
        for block, values in zip(self.surfaces[1:], self.values[1:], strict=True):
            glass = any(line.keyword == "GLAS" and line.words[0] != "MIRROR" for line in block.lines)
            bend = abs(values["CURV"] * values.get("THI", 0.0))
            if not small and glass and bend > _LONGEST:
                small, curvature = f"a hundredth of its glass of {values['THI']:g}", values["CURV"]
        if small and not self.radii:
            raise LacksRadiusModeError(
                f"curvature {curvature:g}: a sphere smaller than {small}; expected RDM where surfaces have radii",
                file=str(self.path),
            )

    def _check_solves(self) -> None:
        """Refuse a paraxial image solve (PIM) whose solution does not stand in the file."""
        for number, values in enumerate(self.values[:-1]):
            if "PIM" in values and not values.get("THI"):
                line = Record(str(self.path), f"surface {number}", "PIM", line=int(values["PIM"]), words=(), text="")
                raise line.problem("PIM: expected the thickness of the solve in the file; it is 0")

    def _blocks(self) -> list[Block]:
        """Return the surfaces, with coordinate breaks between them where they are tilted or decentred."""
        blocks: list[Block] = []
        carried = self.values[-1].get("THI", 0.0)
        for number, (block, values) in enumerate(zip(self.surfaces, self.values, strict=True)):
            last = number == len(self.surfaces) - 1
            thickness = 0.0 if last else values.get("THI", 0.0)
            # The thickness of the image is a defocus: it counts from where the surface before it leads.
            thickness += carried if number == len(self.surfaces) - 2 else 0.0
            kind = "EVENASPH" if any(values.get(p) for p in POWERS) else "STANDARD"
            lines: list[tuple[Any, ...]] = [("TYPE", kind), ("CURV", values["CURV"]), ("CONI", values.get("K", 0.0))]
            lines += [("PARM", i, values.get(p, 0.0)) for i, p in enumerate(POWERS, start=2) if values.get(p)]
            if "CLEAR" in values:
                lines.append(("CLAP", values.get("OBSCURED", 0.0), values["CLEAR"]))
            elif "OBSCURED" in values:
                lines.append(("OBSC", 0.0, values["OBSCURED"]))
            lines += [("DIAM", values["EDGE"])] if "EDGE" in values else []
            if "REX" in values or "REY" in values:
                lines.append(("SQAP", values.get("REX", 0.0), values.get("REY", 0.0)))
            if "ELX" in values or "ELY" in values:
                lines.append(("ELAP", values.get("ELX", 0.0), values.get("ELY", 0.0)))
            if values.get("ADX") or values.get("ADY"):
                lines.append(("OBDC", values.get("ADX", 0.0), values.get("ADY", 0.0)))
            distance = "INFINITY" if number == 0 and abs(thickness) >= INFINITE else thickness
            tilts = (-values.get("ADE", 0.0), -values.get("BDE", 0.0), values.get("CDE", 0.0))
            shift = (values.get("XDE", 0.0), values.get("YDE", 0.0))
            depth = values.get("ZDE", 0.0)
            moved = any(tilts) or any(shift) or depth
            after: list[Block] = []
            if moved and (values.get("DAR") or values.get("REV")):
                back = [*(-v for v in (*shift, *tilts)), 1]
                after = [self._break(number, back, 0.0), self._break(number, [0.0] * 6, thickness - depth)]
                distance = 0.0
            elif moved and values.get("BEN"):
                if tilts[2]:
                    raise block.problem(f"BEN with CDE {values['CDE']:g}: not understood")
                after, distance = [self._break(number, [0, 0, *tilts, 0], thickness)], 0.0
            if moved and not values.get("REV"):
                blocks += [self._break(number, [0.0] * 6, depth), self._break(number, [*shift, *tilts, 0], 0.0)]
            if not last and not block.all("COMM"):
                block.lines.append(made_record(self.path, f"surface {number}", ("COMM", f"S{number}")))
            block.lines += [made_record(self.path, f"surface {number}", line) for line in (*lines, ("DISZ", distance))]
            blocks += [block, *after]
        return blocks

    def _break(self, number: int, parameters: Iterable[float], thickness: float) -> Block:
        lines: list[tuple[Any, ...]] = [("TYPE", "COORDBRK"), ("DISZ", thickness)]
        lines += [("PARM", i, v) for i, v in enumerate(parameters, start=1)]
        return Block(
            str(self.path), f"surface {number}", [made_record(self.path, f"surface {number}", line) for line in lines]
        )
