"""Write a telescope as a lens file of CODE V (.seq).

Surfaces have radii (``RDM``) and stand on the axis of the object space, decentred and tilted by themselves (``DAR``).
Glasses of the bundled catalogues are named with their maker; others are private glasses (``PRV``), tables of indices.
Semi-diameters are edges (``CIR EDG``), which stop no light. Lengths are in mm, cm or inches.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from ....core.errors import PrescriptionError, error_context
from ...aperture import Annulus, Circle, Complement, Ellipse, Rectangle
from ...media.medium import Medium
from ...surface import Interaction
from ...telescope import VACUUM, Telescope
from ..glass_search import maker_of
from ..lens.description import LensSurface
from ..lens.sequence import LensSequence, catalogue_name, quoted
from ..lens.text import number_text, scaled
from ..profile import Profile
from .reader import MMHG, POWERS

FILE = "a CODE V file"
UNITS = {1e-3: "M", 1e-2: "C", 0.0254: "I"}
APERTURES = {"entrance_pupil": "EPD", "f_number": "FNO", "working_f_number": "FNO", "object_na": "NAO"}
FIELDS = {"angle": "AN", "object_height": "OB", "paraxial_image_height": "IM", "real_image_height": "RI"}
#: Thickness that stands for an object at infinity.
_FAR = "1e13"
#: Entries of the table of a private glass at most, as of the wavelengths of a lens.
_ENTRIES = 21
#: Numbers in a line.
_A_LINE = 6
#: Characters with a meaning in the language.
_FORBIDDEN = "'\";!&"


def telescope_to_codev(telescope: Telescope, *, lenient: bool = False) -> str:
    """Return the text of a CODE V file.

    PrescriptionError, with surface and part, if a part of the telescope has no counterpart in it; if lenient, links,
    coatings and formulas of glasses are left out with a warning.
    """
    # CODE V's chief rays pass the middle of the stop.
    sequence = LensSequence.of(
        telescope, FILE, tuple(UNITS), aimed="paraxial", lenient=lenient, afocal=True, straight=True
    )
    with error_context(subject=telescope.name):
        names = sequence.glass_names("a private glass, a table of indices", "_", stated_maker=True)
        words = {medium: _glass_word(medium, name) for medium, name in names.items()}
        unit = sequence.unit
        lines = ["RDM;LEN", f"TITLE '{quoted(sequence.title, _FORBIDDEN)}'", f"DIM {UNITS[unit]}"]
        lines += [*_system_lines(sequence), *_field_lines(sequence), *_private_lines(sequence, names)]
        first = sequence.surfaces[0]
        distance = number_text(sequence.distance / unit) if math.isfinite(sequence.distance) else _FAR
        lines.append(f"SO 0.0 {distance}{_medium(first.before, words)}")
        for surface in sequence.surfaces:
            with error_context(subject=f"surface {surface.name}"):
                lines += _surface_lines(sequence, surface, words)
            lines += _aperture_lines(sequence, surface)
    return "\n".join([*lines, "GO"]) + "\n"


def _glass_word(medium: Medium, name: str) -> str:
    """Return the name of a glass without hyphens and with its maker, as CODE V has it."""
    maker = maker_of(medium) if name == medium.name else None
    return f"{name.replace('-', '')}_{maker.upper()}" if maker else name


def _medium(medium: Medium, words: Mapping[Medium, str]) -> str:
    return "" if medium == VACUUM else f" {words[medium]}"


def _system_lines(sequence: LensSequence) -> Iterator[str]:
    kind, value = sequence.stated_aperture(_apertures(sequence))
    yield f"{APERTURES[kind]} {number_text(value / sequence.unit if kind == 'entrance_pupil' else value)}"
    yield f"WL {_numbers([scaled(wave, 9) for wave in sequence.wavelengths])}"
    yield f"REF {sequence.primary + 1}"
    yield f"WTW {_numbers(sequence.wavelength_weights)}"
    if sequence.telescope.design_data.afocal:
        yield "AFO YES"
    if sequence.celsius is not None:
        yield f"TEM {number_text(sequence.celsius)}"
    if sequence.atmospheres is not None:
        yield f"PRE {number_text(sequence.atmospheres * MMHG)}"


def _apertures(sequence: LensSequence) -> list[str]:
    """Return the apertures that the file states: its f-number is at the conjugates of the lens."""
    wrong = "f_number" if math.isfinite(sequence.distance) else "working_f_number"
    return [kind for kind in APERTURES if kind != wrong]


def _field_lines(sequence: LensSequence) -> Iterator[str]:
    ending, size = FIELDS[sequence.field_type], 1.0 if sequence.field_type == "angle" else sequence.unit
    for place, axis in enumerate("XY"):
        yield f"{axis}{ending} {_numbers([row[place] / size for row in sequence.fields])}"
    yield f"WTF {_numbers(sequence.field_weights)}"
    if not any(any(row) for row in sequence.vignetting):
        return
    if any(row[4] for row in sequence.vignetting):
        raise PrescriptionError(f"vignetting: {FILE} has no angle of the pupil")
    for place, axis in enumerate("XY"):
        # Decentre and compression, from the parts that are cut off at both ends.
        yield f"VU{axis} {_numbers([row[2 + place] - row[place] for row in sequence.vignetting])}"
        yield f"VL{axis} {_numbers([row[2 + place] + row[place] for row in sequence.vignetting])}"


def _private_lines(sequence: LensSequence, names: Mapping[Medium, str]) -> Iterator[str]:
    for medium, name in names.items():
        if name == catalogue_name(medium, stated_maker=True):
            continue
        # From long wavelengths to short ones, as CODE V lists them.
        waves, indices = (row[::-1] for row in sequence.index_table(medium, _ENTRIES))
        yield "PRV"
        yield f"  PWL {_numbers([scaled(wave, 9) for wave in waves])}"
        yield f"  '{name}' {_numbers(indices)}"
        yield "END"


def _numbers(values: Sequence[float]) -> str:
    """Return numbers, carried on where the line gets long."""
    rows = [values[i : i + _A_LINE] for i in range(0, len(values), _A_LINE)]
    return " &\n  ".join(" ".join(map(number_text, row)) for row in rows)


def _surface_lines(sequence: LensSequence, surface: LensSurface, words: Mapping[Medium, str]) -> Iterator[str]:
    unit = sequence.unit
    profile = Profile.of(surface.shape, unit)
    if profile.odd or profile.terms or profile.curvature_x is not None or any(profile.even[:1]):
        raise PrescriptionError(f"shape: {FILE} is written with conics and even powers from r^4 on")
    powers = profile.even[1:]
    if len(powers) > len(POWERS):
        raise PrescriptionError(f"{len(powers)} coefficients: {FILE} has {len(POWERS)}, from r^4 to r^20")
    last = surface.interaction == Interaction.DETECTOR
    medium = " REFL" if surface.interaction == Interaction.MIRROR else _medium(surface.after, words)
    head = f"{number_text(profile.radius)} {number_text(sequence.thickness(surface))}"
    yield f"SI {head}" if last else f"S {head}{medium}"
    yield f"  SLB '{quoted(surface.name, _FORBIDDEN)}'"
    if surface.stop:
        yield "  STO"
    if any(powers):
        yield "  ASP"
        yield f"  K {number_text(profile.conic)}"
        yield from (f"  {letter} {number_text(a)}" for letter, a in zip(POWERS, powers, strict=False) if a)
    elif profile.conic:
        yield "  CON"
        yield f"  K {number_text(profile.conic)}"
    if surface.grating is not None:
        # The vector across the grooves, and their spacing.
        (x, y), spacing = surface.grating.across, 1e-3 / surface.grating.lines_per_mm / unit
        yield f"  GRT; GRO {surface.grating.order}; GRS {number_text(spacing)}"
        yield f"  GRX {number_text(x)}; GRY {number_text(y)}; GRZ 0.0"
    if surface.semi_diameter:
        yield f"  CIR EDG {number_text(surface.semi_diameter / unit)}"
    if surface.off_axis:
        x, y = (v / unit for v in surface.position[:2])
        # The first two angles are left-handed.
        a, b, c = (sign * math.degrees(v) for sign, v in zip((-1.0, -1.0, 1.0), surface.tilt, strict=True))
        values = zip(("XDE", "YDE", "ADE", "BDE", "CDE"), (x, y, a, b, c), strict=True)
        yield "  " + "; ".join(f"{key} {number_text(v)}" for key, v in values)
        if not last:
            yield "  DAR"


def _aperture_lines(sequence: LensSequence, surface: LensSurface) -> Iterator[str]:
    aperture, unit = surface.aperture, sequence.unit
    region = aperture.part if isinstance(aperture, Complement) else aperture
    clear = region is aperture
    if isinstance(region, Circle):
        yield f"  CIR {'' if clear else 'OBS '}{number_text(region.radius / unit)}"
    elif isinstance(region, Annulus) and clear:
        yield f"  CIR {number_text(region.outer / unit)}"
        yield f"  CIR OBS {number_text(region.inner / unit)}"
    elif isinstance(region, Rectangle) and clear and region.angle == 0:
        yield f"  REX {number_text(0.5 * region.width / unit)}; REY {number_text(0.5 * region.height / unit)}"
    elif isinstance(region, Ellipse) and clear and region.angle == 0:
        yield f"  ELX {number_text(region.semi_x / unit)}; ELY {number_text(region.semi_y / unit)}"
    else:
        if region is not None:
            sequence.leave_out_aperture(surface, "discs, rings, obscuring discs, ellipses and rectangles along x")
        return
    if region.x or region.y:
        yield f"  ADX {number_text(region.x / unit)}; ADY {number_text(region.y / unit)}"
