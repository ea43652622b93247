"""System data of a Zemax file, read and written: units, aperture, fields, wavelengths, ray aiming and environment.

The lists of the header are longer than the number of fields in old files; FTYP has the number.
"""

from __future__ import annotations

import math

import numpy as np

from ...design_data import AIMING, FIELD_TYPES, DesignData
from ...media.air import STANDARD_ATMOSPHERE, ZERO_CELSIUS
from ..lens.description import INFINITE, Format, LensDescription
from ..lens.source import Source
from ..lens.text import Record, number_text, scaled
from .file import Block

FORMAT = Format("Zemax", "a line ENPD, FNUM or FLOA", "lines WAVM", "STOP")
UNITS = {"MM": 1e-3, "CM": 1e-2, "IN": 0.0254, "INCH": 0.0254, "METER": 1.0, "METERS": 1.0, "M": 1.0}
#: Aperture lines of a header, the first of which counts.
APERTURES = ("ENPD", "FNUM", "OBNA", "OBSN", "FLOA")
#: Lists of vignetting factors in the order of :class:`DesignData`, with the older names.
_VIGNETTING = (("VDXN", "ZVDX"), ("VDYN", "ZVDY"), ("VCXN", "ZVCX"), ("VCYN", "ZVCY"), ("VANN", "ZVAN"))
#: Fields of a file at most.
_MOST_FIELDS = 200


def read_system(lens: LensDescription, header: Block) -> None:
    """State the system data of a header; PrescriptionError where they are not as expected."""
    unit = header.last("UNIT")
    name = unit.words[0].upper() if unit is not None and unit.words else "MM"
    if unit is not None and name not in UNITS:
        raise unit.problem(f"UNIT {unit.words[0]}: expected one of {', '.join(UNITS)}")
    lens.state_unit(UNITS[name])
    lens.title, lens.version = header.text("NAME"), (header.text("VERS").split() or ["1"])[0]
    _read_wavelengths(lens, header)
    _read_fields(lens, header)
    _read_apertures(lens, header)
    aiming = header.last("RAIM")
    if aiming is not None:
        if not 0 <= aiming.integer(1, 0) < len(AIMING):
            raise aiming.error("ray aiming from 0 to 2")
        lens.state(aiming, aiming=AIMING[aiming.integer(1, 0)])
    environment = header.last("ENVD")
    if environment is not None:
        air = environment.number(0), environment.number(1, 1.0)
        lens.state_air(environment, *air)
        if environment.number(2, 0.0) != 0 and air != (20.0, 1.0):
            text = f"{environment.shown}: indices are not adjusted to temperature and pressure"
            lens.findings.report(environment.problem(text))


def object_distance(block: Block, unit: float) -> float:
    """Return the distance [m] of the object, from its block, to the first surface."""
    distance = block.number("DISZ", math.inf, infinite=True) * unit
    # Lens files write "at infinity" as a distance of 1e10 units too.
    return math.inf if distance >= INFINITE * unit else distance


def _read_wavelengths(lens: LensDescription, header: Block) -> None:
    """State the wavelengths: lines WAVM, as many as FTYP counts, or the older lists WAVN and WAVL."""
    lines, primary = header.all("WAVM"), header.last("PWAV")
    lists, weight_lists = ([header.last(name) for name in names] for names in (("WAVN", "WAVL"), ("WWGN", "WWGT")))
    count = header.number("FTYP", 0.0, 3) if (kind := header.last("FTYP")) and len(kind.words) > 3 else 0.0
    if lines:
        table = {line.integer(0): line.number(1) for line in lines}
        # Files list 24 wavelengths; those beyond the count are fillers.
        numbers = range(1, int(count) + 1) if 1 <= count <= 24 else sorted(table)
        for number in numbers:
            if number not in table:
                raise header.problem(f"WAVM {number} is missing")
        values = [table[number] for number in numbers]
        amounts = {line.integer(0): line.number(2, 1.0) for line in lines}
        weights = [amounts[number] for number in numbers]
        source: Source = next((line for line in lines if not line.number(1) > 0), lines[0])
    elif (listed := lists[0] or lists[1]) is not None:
        source, values = listed, listed.numbers()
        stated = weight_lists[lists.index(listed)]
        # WAVN is as long as the longest list that there may be.
        if listed is lists[0]:
            values = values[: int(count)] if 1 <= count <= len(values) else values
            while len(values) > 1 and values[-1] == 0:
                values.pop()
        weights = [1.0 if stated is None else stated.number(i, 1.0) for i in range(len(values))]
    else:
        return
    number = 1 if primary is None else primary.integer(0)
    if primary is not None and values and not 1 <= number <= len(values):
        raise primary.error(f"1 to {len(values)}")
    lens.state_wavelengths(source, [scaled(v, -6) for v in values], weights, number - 1)


def _read_fields(lens: LensDescription, header: Block) -> None:
    """State the field points, their weights and vignetting factors, and what the image space is like."""
    line = header.last("FTYP")
    kind = round(header.number("FTYP", 0.0))
    if line is not None and not 0 <= kind < len(FIELD_TYPES):
        raise line.problem(f"FTYP {kind}: expected 0 to {len(FIELD_TYPES) - 1}")
    stated = int(line.number(2, 0.0)) if line is not None else 0
    sources = [_list(header, names) for names in (("XFLN", "XFLD"), ("YFLN", "YFLD"))]
    columns = [values for _, values in sources]
    count = stated if 1 <= stated <= _MOST_FIELDS else max(1, *map(len, columns))
    points = zip(*((values + [0.0] * count)[:count] for values in columns), strict=True)
    farthest = max(sources, key=lambda column: max(map(abs, column[1]), default=-1.0))[0]
    lens.state_fields(farthest, FIELD_TYPES[kind], points)
    lens.state_field_weights(*_list(header, ("FWGN", "FWGT")))
    factors = [_list(header, names) for names in _VIGNETTING]
    source = next((source for source, values in factors if any(values)), factors[0][0])
    lens.state_vignetting(source, *(values for _, values in factors))
    if line is not None:
        lens.telecentric = line.number(1, 0.0) == 1
        lens.state(line, afocal=line.number(6, 0.0) == 1)


def _list(header: Block, names: tuple[str, str]) -> tuple[Source, list[float]]:
    """Return the first of two lines that the header has, and its numbers; the other one is an older form of it."""
    line = next((record for record in [header.last(name) for name in names] if record is not None), None)
    return (Source(header.file, keyword=names[0]), []) if line is None else (line, line.numbers())


def _read_apertures(lens: LensDescription, header: Block) -> None:
    for keyword in APERTURES:
        line = header.last(keyword)
        if line is None:
            continue
        if keyword == "FLOA":
            lens.state_aperture(line, "stop", 0.0)
        elif keyword == "ENPD":
            lens.state_aperture(line, "entrance_pupil", line.number(0, 0.0) * lens.unit)
        elif keyword == "FNUM":
            working = line.number(1, 0.0) == 1
            lens.state_aperture(line, "working_f_number" if working else "f_number", line.number(0, 0.0))
        else:
            lens.state_aperture(line, "object_na", _object_na(line, lens))


def _object_na(line: Record, lens: LensDescription) -> float:
    """Return the numerical aperture of an object: the number itself, or of ``OBNA angle 1``, half a cone's angle."""
    value = line.number(0, 0.0)
    if line.number(1, 0.0) != 1:
        return value
    if not 0 < value < 90:
        raise line.error("an angle between the axis and the cone of the object, above 0 and below 90 degrees")
    return math.sin(math.radians(value)) * float(lens.medium.index(lens.primary_wavelength))


def design_lines(data: DesignData, unit: float) -> list[str]:
    """Return the lines of the header with fields and environment; `unit` is that of the file [m].

    Where no fields are stated, the caller has some of its own.
    """
    lines = []
    if data.fields:
        size = math.radians(1.0) if data.field_type == "angle" else unit
        x, y = (np.array(data.fields) / np.array([-size, size])).T
        weights = data.field_weights or [1.0] * len(data.fields)
        columns = [("XFLN", x), ("YFLN", y), ("FWGN", weights)]
        if data.vignetting:
            factors = (np.array(data.vignetting) * np.array([-1.0, 1.0, 1.0, 1.0, -math.degrees(1.0)])).T
            columns += [(names[0], column) for names, column in zip(_VIGNETTING, factors, strict=True)]
        lines += [f"{keyword} {' '.join(map(number_text, column))}" for keyword, column in columns]
    celsius = 20.0 if data.temperature is None else data.temperature - ZERO_CELSIUS
    atmospheres = 1.0 if data.pressure is None else data.pressure / STANDARD_ATMOSPHERE
    return [*lines, f"ENVD {number_text(celsius)} {number_text(atmospheres)} 0"]


def stop_lines(data: DesignData, unit: float) -> list[str]:
    """Return the lines of the header with the aperture as stated, and ray aiming at the stop."""
    assert data.aperture_value is not None
    value = data.aperture_value
    line = {
        "entrance_pupil": f"ENPD {number_text(value / unit)}",
        "f_number": f"FNUM {number_text(value)} 0",
        "working_f_number": f"FNUM {number_text(value)} 1",
        "object_na": f"OBNA {number_text(value)} 0",
        "stop": "FLOA",
    }[data.aperture or ""]
    return [line, f"RAIM 0 {AIMING.index(data.aiming)} 1 1 0 0 0 0 0 1"]
