"""Write a telescope as a lens file of OSLO (.len).

Surfaces stand on the axis of the object space, decentred and tilted by themselves (``RCO`` to themselves). The primary
wavelength is the first one. OSLO states one field, of which the reader has 0, 0.7 and 1 times. ``AP CHK`` is a clear
disc, ``AP`` a semi-diameter. Glasses that the bundled catalogues do not have are indices at wavelengths (``GLA MOD``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from ....core.errors import PrescriptionError, error_context
from ...aperture import Circle
from ...media.medium import Medium
from ...surface import Interaction
from ...telescope import VACUUM, Telescope
from ..lens.description import LensSurface
from ..lens.sequence import LensSequence, catalogue_name, quoted
from ..lens.text import number_text, scaled
from ..profile import Profile
from .reader import FIELDS, FRACTIONS, UNITS

FILE = "an OSLO file"
#: Commands of field points by their type.
_FIELDS = {kind: command for command, kind in FIELDS.items()}
#: Coefficients of a symmetric or odd asphere (``AS1``...) that the reader takes.
_MOST = 8
#: Fractions of a field height, and apertures of a surface, that are equal.
_EQUAL = 1e-9
_FORBIDDEN = '"'


def telescope_to_oslo(telescope: Telescope, *, lenient: bool = False) -> str:
    """Return the text of an OSLO file.

    PrescriptionError, with surface and part, if a part of the telescope has no counterpart in it; if lenient, links,
    coatings, fields and formulas of glasses are left out with a warning.
    """
    sequence = LensSequence.of(telescope, FILE, tuple(UNITS.values()), lenient=lenient)
    unit = sequence.unit
    with error_context(subject=telescope.name):
        names = sequence.glass_names("its indices at the stated wavelengths")
        surfaces = sequence.surfaces
        # A number that stands by itself in the name would be taken for an argument of LEN NEW.
        title = " ".join(w for w in quoted(sequence.title, _FORBIDDEN).split() if not _is_number(w))
        lines = [f'LEN NEW "{title}" 100 {len(surfaces)}', *_system_lines(sequence)]
        far = math.isinf(sequence.distance)
        lines += ["// SRF 0", *_medium_lines(sequence, surfaces[0].before, names)]
        lines.append(f"TH {'1e20' if far else number_text(sequence.distance / unit)}")
        for number, surface in enumerate(surfaces, start=1):
            lines.append(f"NXT // SRF {number}")
            with error_context(subject=f"surface {surface.name}"):
                lines += [*_surface_lines(sequence, surface, number), *_medium_lines(sequence, surface, names)]
            lines += _aperture_lines(sequence, surface)
    waves = [sequence.primary, *(i for i in range(len(sequence.wavelengths)) if i != sequence.primary)]
    lines.append(f"WV {' '.join(number_text(scaled(sequence.wavelengths[i], 6)) for i in waves)}")
    lines.append(f"WW {' '.join(number_text(sequence.wavelength_weights[i]) for i in waves)}")
    return "\n".join([*lines, f"END {len(surfaces)}"]) + "\n"


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _system_lines(sequence: LensSequence) -> Iterator[str]:
    unit, finite = sequence.unit, math.isfinite(sequence.distance)
    # EBR and FNO are at the conjugates of the lens; so is the f-number of an object at infinity.
    kinds = ["object_na", "working_f_number"] if finite else ["entrance_pupil", "f_number", "working_f_number"]
    kinds += ["entrance_pupil"] if sequence.pupil_plane else []
    beam = "numerical aperture of the object" if finite else "diameter of the entrance pupil"
    kind, value = sequence.stated_aperture(kinds, beam)
    if kind == "entrance_pupil" and finite:
        # The beam of that radius, as the numerical aperture of the object, on the axis to the pupil.
        along = abs(sequence.telescope.object_distance - sequence.telescope.stop_z)
        index = float(sequence.surfaces[0].before.index(sequence.telescope.default_wavelength))
        kind, value = "object_na", index * math.sin(math.atan(0.5 * value / along))
    if kind == "entrance_pupil":
        yield f"EBR {number_text(0.5 * value / unit)}"
    else:
        yield f"{'NAO' if kind == 'object_na' else 'FNO'} {number_text(value)}"
    yield _field_line(sequence)
    yield f"UNI {number_text(round(unit * 1e3, 12))}"
    if sequence.celsius is not None:
        yield f"TEM {number_text(sequence.celsius)}"
    if sequence.atmospheres is not None:
        yield f"PRE {number_text(sequence.atmospheres)}"


def _field_line(sequence: LensSequence) -> str:
    if sequence.field_type not in _FIELDS:
        raise PrescriptionError(f"field_type = {sequence.field_type}: {FILE} has none of that kind")
    largest = max(sequence.fields, key=lambda field: math.hypot(*field))
    size = 1.0 if sequence.field_type == "angle" else sequence.unit
    value = math.hypot(*largest) if largest[0] else largest[1]
    expected = [(0.0, fraction * value) for fraction in FRACTIONS] if value else [(0.0, 0.0)]
    met = len(sequence.fields) == len(expected) and all(
        math.dist(point, usual) <= _EQUAL * abs(value) for point, usual in zip(sequence.fields, expected, strict=False)
    )
    if not met:
        text = f"fields: {FILE} states one, and means 0, 0.7 and 1 times it along y"
        sequence.leave_out(text, "written as the largest")
    if len(set(sequence.field_weights)) > 1:
        sequence.leave_out(f"field_weights: {FILE} has no place for them", "left out")
    if any(any(row) for row in sequence.vignetting):
        sequence.leave_out(f"vignetting: {FILE} has no place for its factors", "left out")
    return f"{_FIELDS[sequence.field_type]} {number_text(value / size)}"


def _medium_lines(sequence: LensSequence, place: LensSurface | Medium, names: Mapping[Medium, str]) -> Iterator[str]:
    medium = place
    if isinstance(place, LensSurface):
        if place.interaction == Interaction.MIRROR:
            yield "RFL"
            return
        medium = VACUUM if place.interaction == Interaction.DETECTOR else place.after
    assert isinstance(medium, Medium)
    if medium == VACUUM:
        yield "AIR"
    elif catalogue_name(medium) is not None:
        yield f"GLA {names[medium]}"
    else:
        waves, indices = sequence.index_table(medium)
        # The wavelengths in front of a glass are those of its indices. Two indices of a model are n_d and V_d.
        model = "" if len(indices) == 2 else "MOD "
        yield f"WV {' '.join(number_text(scaled(wave, 6)) for wave in waves)}"
        yield f"GLA {model}{names[medium]} {' '.join(map(number_text, indices))}"


def _surface_lines(sequence: LensSequence, surface: LensSurface, number: int) -> Iterator[str]:
    unit = sequence.unit
    if surface.grating is not None:
        raise PrescriptionError(f"grating: {FILE} is written without them")
    profile = Profile.of(surface.shape, unit)
    yield f'NOT "{quoted(surface.name, _FORBIDDEN)}"'
    yield f"RD {number_text(profile.radius)}"
    yield f"TH {number_text(sequence.thickness(surface))}"
    if profile.conic:
        yield f"CC {number_text(profile.conic)}"
    yield from _asphere_lines(profile)
    if surface.stop:
        yield "AST"
    if surface.off_axis:
        x, y = (v / unit for v in surface.position[:2])
        # The first two angles are left-handed.
        a, b, c = (sign * math.degrees(v) for sign, v in zip((-1.0, -1.0, 1.0), surface.tilt, strict=True))
        for key, value in zip(("DCX", "DCY", "TLA", "TLB", "TLC"), (x, y, a, b, c), strict=True):
            yield f"{key} {number_text(value)}"
        yield f"RCO {number}"


def _asphere_lines(profile: Profile) -> Iterator[str]:
    if profile.curvature_x is not None:
        yield f"CVX {number_text(profile.curvature_x)}"
        return
    if profile.terms:
        if any(i + j == 0 for i, j, _ in profile.terms):
            raise PrescriptionError(f"polynomial of x and y with a constant term: {FILE} has none")
        # The order of the terms: x, y, x^2, xy, y^2, x^3...
        places = {(n - j, j): n * (n + 1) // 2 + j for n in range(1, 1 + max(i + j for i, j, _ in profile.terms))
                  for j in range(n + 1)}  # fmt: skip
        yield f"ASP ASX {max(places[i, j] for i, j, _ in profile.terms)}"
        yield from (f"AS{places[i, j]} {number_text(a)}" for i, j, a in profile.terms if a)
        return
    terms = profile.odd or profile.even
    if len(terms) > _MOST:
        raise PrescriptionError(f"{len(terms)} coefficients: {FILE} is written with {_MOST} at most")
    if profile.odd or any(profile.even[:1]) or len(profile.even) > 5:
        yield f"ASP {'ARA' if profile.odd else 'ASR'} {len(terms)}"
        yield from (f"AS{i} {number_text(a)}" for i, a in enumerate(terms, start=1) if a)
    else:
        keys = zip(("AD", "AE", "AF", "AG"), profile.even[1:], strict=False)
        yield from (f"{key} {number_text(a)}" for key, a in keys if a)


def _aperture_lines(sequence: LensSequence, surface: LensSurface) -> Iterator[str]:
    region, size, unit = surface.aperture, surface.semi_diameter, sequence.unit
    if isinstance(region, Circle) and not (region.x or region.y):
        if size and not math.isclose(size, region.radius, rel_tol=_EQUAL):
            text = f"surface {surface.name}: semi-diameter beside a clear aperture: {FILE} has one AP"
            sequence.leave_out(text, "left out")
        yield f"AP CHK {number_text(region.radius / unit)}"
        return
    if region is not None:
        sequence.leave_out_aperture(surface, "discs about the vertex")
    if size:
        yield f"AP {number_text(size / unit)}"
