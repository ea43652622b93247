"""Design data of a Zemax file: fields, vignetting factors, aperture, wavelengths, ray aiming and environment.

The lists of the header are longer than the number of fields in old files; FTYP has the number. The axes are those of
the telescope (see `frame`): x changes its sign, and so do the angles of vignetting factors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...design_data import AIMING, FIELD_TYPES, LENGTH_UNITS, DesignData
from ...media.air import STANDARD_ATMOSPHERE, ZERO_CELSIUS
from .file import Block
from .text import number_text

#: Lists of vignetting factors in the order of :class:`DesignData`, with the older names.
_VIGNETTING = (("VDXN", "ZVDX"), ("VDYN", "ZVDY"), ("VCXN", "ZVCX"), ("VCYN", "ZVCY"), ("VANN", "ZVAN"))

#: Fields of a file at most.
_MOST_FIELDS = 200


@dataclass(frozen=True)
class Fields:
    """Field points of a file: their type (index into FIELD_TYPES), values [unit of the file], weights and factors."""

    kind: int
    points: np.ndarray  #: [n, 2]
    weights: np.ndarray  #: [n]
    vignetting: np.ndarray  #: [n, 5]
    telecentric: bool
    afocal: bool  #: whether the image space is afocal

    @property
    def largest(self) -> float:
        """Largest distance of a field point from the axis."""
        return float(np.hypot(*self.points.T).max())


def read_fields(header: Block) -> Fields:
    """Return the field points; PrescriptionError where their type is none of Zemax's."""
    line = header.last("FTYP")
    kind = round(header.number("FTYP", 0.0))
    if not 0 <= kind < len(FIELD_TYPES):
        raise header.problem(f"FTYP {kind}: expected 0 to {len(FIELD_TYPES) - 1}")
    columns = [_list(header, names) for names in (("XFLN", "XFLD"), ("YFLN", "YFLD"))]
    stated = int(line.number(2, 0.0)) if line is not None else 0
    count = stated if 1 <= stated <= _MOST_FIELDS else max(1, *map(len, columns))
    weights = _list(header, ("FWGN", "FWGT"))
    factors = [_list(header, names) for names in _VIGNETTING]
    return Fields(
        kind=kind,
        points=np.stack([_filled(column, count, 0.0) for column in columns], axis=-1),
        weights=_filled(weights, count, 1.0),
        vignetting=np.stack([_filled(column, count, 0.0) for column in factors], axis=-1),
        telecentric=line is not None and line.number(1, 0.0) == 1,
        afocal=line is not None and line.number(6, 0.0) == 1,
    )


def _list(header: Block, names: tuple[str, str]) -> list[float]:
    """Return the numbers of the first of two keywords that the header has."""
    line = next((found for name in names if (found := header.last(name)) is not None), None)
    return [] if line is None else [line.number(i) for i in range(len(line.words))]


def _filled(values: list[float], count: int, filler: float) -> np.ndarray:
    return np.array((values + [filler] * count)[:count], dtype=np.float64)


def read_aiming(header: Block) -> str:
    """Return the ray aiming, the second word of RAIM."""
    line = header.last("RAIM")
    number = 0 if line is None else line.integer(1, 0)
    if line is not None and not 0 <= number < len(AIMING):
        raise line.error("ray aiming from 0 to 2")
    return AIMING[number]


def read_environment(header: Block) -> tuple[float | None, float | None]:
    """Return temperature [K] and pressure [Pa] of ENVD, which has degrees Celsius and atmospheres."""
    line = header.last("ENVD")
    if line is None:
        return None, None
    return line.number(0) + ZERO_CELSIUS, line.number(1, 1.0) * STANDARD_ATMOSPHERE


def stated_fields(fields: Fields, unit: float) -> dict[str, Any]:
    """Return the arguments of :class:`DesignData` about the fields, in the axes of the telescope."""
    scale = math.radians(1.0) if fields.kind == 0 else unit
    mirrored = fields.points * np.array([-scale, scale]) + 0.0
    vignetting = fields.vignetting * np.array([-1.0, 1.0, 1.0, 1.0, -math.radians(1.0)]) + 0.0
    return {
        "field_type": FIELD_TYPES[fields.kind],
        "fields": tuple(map(tuple, mirrored.tolist())),
        "field_weights": tuple(fields.weights.tolist()) if len(set(fields.weights.tolist())) > 1 else (),
        "vignetting": tuple(map(tuple, vignetting.tolist())) if vignetting.any() else (),
    }


def length_unit(unit: float) -> str:
    """Return the name of a unit of length [m]."""
    return next(name for name, size in LENGTH_UNITS.items() if size == unit)


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
