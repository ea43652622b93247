"""Names of operands as in Zemax and CODE V, each with its definition, unit and class.

``target`` of a name that ends in GT (LT), or that is a least (largest) thickness, is a minimum (a maximum).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, UnknownNameError, unknown_name
from .geometry_operands import (
    BackFocus,
    CenterThickness,
    ConicConstant,
    Curvature,
    EdgeThickness,
    OverallLength,
    ThicknessLimit,
    ThicknessSum,
    TotalTrack,
)
from .image_operands import Contrast, FieldFocus, PathDifference, TransverseAberration
from .operand import OPERANDS, PERCENT, GoalOperand, StatedName
from .paraxial_operands import (
    AngularMagnification,
    AxialColor,
    EntrancePupilDiameter,
    EntrancePupilPosition,
    ExitPupilDiameter,
    ExitPupilPosition,
    Magnification,
    ParaxialImageHeight,
    ParaxialLateralColor,
    SeidelWavefront,
    WorkingFNumber,
)
from .ray_operands import ExitAngle, IncidenceAngle, RayCoordinate, RayCosine, RmsSpot
from .targets import FNumber, FocalLength, RelativeDistortion

#: Units of numbers in files, by the unit of the class, and their sizes; the first is that of names without one.
NAMED_UNITS: dict[str, dict[str, float]] = {
    "m": {"mm": 1e-3, "um": 1e-6, "cm": 1e-2, "m": 1.0},
    "rad": {"deg": 0.017453292519943295, "rad": 1.0},
    "1/m": {"per_mm": 1e3, "per_m": 1.0},
    "waves": {"waves": 1.0},
    "1": {"": 1.0},
}


@dataclass(frozen=True)
class OperandName:
    """A name of an operand.

    Attributes
    ----------
    name : str
        The name.
    kind : type
        Class of the operand.
    definition : str
        What number it is.
    implied : dict of str to str or None
        Fields of the class that the name implies.
    target : {"value", "minimum", "maximum"}
        What a target is.
    """

    name: str
    kind: type[GoalOperand]
    definition: str
    implied: Mapping[str, str | None] = field(default_factory=dict)
    target: Literal["value", "minimum", "maximum"] = "value"

    @property
    def units(self) -> dict[str, float]:
        """Units of the number in files with their sizes, the usual one first."""
        return dict([PERCENT]) if self.kind.in_percent else NAMED_UNITS[self.kind.unit]

    @property
    def unit(self) -> str:
        """Unit of the number where none is named, empty of a pure number."""
        return next(iter(self.units))

    def stated(self, unit: str) -> StatedName:
        """Return the name in a unit, as operands have it."""
        return StatedName(self.name, unit, self.units[unit], tuple(self.implied))


def _bounded(
    stem: str, kind: type[GoalOperand], definition: str, implied: Mapping[str, str | None] | None = None
) -> list[OperandName]:
    """Return the three names of a number that end in VA, GT and LT."""
    ends: tuple[tuple[str, str, Literal["value", "minimum", "maximum"]], ...] = (
        ("VA", definition, "value"),
        ("GT", f"{definition}, at least the target", "minimum"),
        ("LT", f"{definition}, at most the target", "maximum"),
    )
    return [OperandName(stem + end, kind, text, implied or {}, target) for end, text, target in ends]


def _thickness_limits() -> list[OperandName]:
    """Return the names of least and largest thicknesses."""
    extremes: tuple[tuple[str, str, Literal["minimum", "maximum"]], ...] = (
        ("MN", "least", "minimum"),
        ("MX", "largest", "maximum"),
    )
    media = (("A", "air", "air"), ("G", "glass", "glass"), ("T", "any", "glass and air"))
    places = (("C", "center", "on the axis"), ("E", "edge", "at the edge"))
    names = []
    for prefix, extreme, target in extremes:
        for letter, place, where in places:
            for end, medium, content in media:
                implied: dict[str, str | None] = {"extreme": extreme, "place": place, "medium": medium}
                text = f"{extreme} thickness of {content} {where}, of the surfaces first to last"
                names.append(OperandName(prefix + letter + end, ThicknessLimit, text, implied, target))
    return names


#: Fields of a focal length of all surfaces.
_WHOLE = dict.fromkeys(("meridian", "first", "last"))
_LISTED = [
    OperandName("EFFL", FocalLength, "effective focal length, paraxial, of all surfaces", _WHOLE),
    OperandName(
        "EFLX", FocalLength, "focal length in the plane of x and z, of the surfaces first to last", {"meridian": "x"}
    ),
    OperandName(
        "EFLY", FocalLength, "focal length in the plane of y and z, of the surfaces first to last", {"meridian": "y"}
    ),
    OperandName("ISFN", FNumber, "paraxial focal ratio: EFFL over the diameter of the entrance pupil"),
    OperandName("WFNO", WorkingFNumber, "working focal ratio 1 / (2 n sin u) of the real marginal rays of the axis"),
    OperandName(
        "PIMH", ParaxialImageHeight, "paraxial image height of the edge of the field, in the paraxial image plane"
    ),
    OperandName("PMAG", Magnification, "paraxial magnification of an object at a finite distance"),
    OperandName("AMAG", AngularMagnification, "angular magnification of the paraxial chief ray"),
    OperandName("ENPP", EntrancePupilPosition, "place of the entrance pupil behind the first surface"),
    OperandName("EPDI", EntrancePupilDiameter, "diameter of the entrance pupil"),
    OperandName("EXPP", ExitPupilPosition, "place of the exit pupil behind the image surface"),
    OperandName("EXPD", ExitPupilDiameter, "diameter of the exit pupil"),
    OperandName("SPHA", SeidelWavefront, "third-order spherical aberration W040", {"aberration": "spherical"}),
    OperandName("COMA", SeidelWavefront, "third-order coma W131", {"aberration": "coma"}),
    OperandName("ASTI", SeidelWavefront, "third-order astigmatism W222", {"aberration": "astigmatism"}),
    OperandName("FCUR", SeidelWavefront, "third-order field curvature W220P (Petzval)", {"aberration": "Petzval"}),
    OperandName("DIST", SeidelWavefront, "third-order distortion W311", {"aberration": "distortion"}),
    OperandName("DISG", RelativeDistortion, "distortion of the real chief ray against f tan(theta)"),
    OperandName("AXCL", AxialColor, "axial colour: paraxial focus of the first less that of the second wavelength"),
    OperandName(
        "LACL", ParaxialLateralColor, "lateral colour: paraxial chief ray on the image, first less second wavelength"
    ),
    OperandName("REAX", RayCoordinate, "x of a real ray on a surface", {"axis": "x"}),
    OperandName("REAY", RayCoordinate, "y of a real ray on a surface", {"axis": "y"}),
    OperandName("REAZ", RayCoordinate, "z of a real ray on a surface", {"axis": "z"}),
    OperandName("REAR", RayCoordinate, "distance of a real ray on a surface from its axis", {"axis": "r"}),
    OperandName("REAA", RayCosine, "x direction cosine of a real ray behind a surface", {"axis": "x"}),
    OperandName("REAB", RayCosine, "y direction cosine of a real ray behind a surface", {"axis": "y"}),
    OperandName("REAC", RayCosine, "z direction cosine of a real ray behind a surface", {"axis": "z"}),
    OperandName("RAID", IncidenceAngle, "angle of incidence of a real ray on a surface"),
    OperandName("RAED", ExitAngle, "angle of a real ray to the normal of a surface behind it"),
    OperandName("TRAX", TransverseAberration, "x of a real ray on the image less that of the chief ray", {"axis": "x"}),
    OperandName("TRAY", TransverseAberration, "y of a real ray on the image less that of the chief ray", {"axis": "y"}),
    OperandName("TRAR", TransverseAberration, "distance of a real ray on the image from the chief ray", {"axis": "r"}),
    OperandName("OPDC", PathDifference, "optical path difference of a real ray against the chief ray"),
    OperandName("RSCE", RmsSpot, "rms spot radius about the centroid"),
    OperandName(
        "FCGS", FieldFocus, "sagittal field curvature: focus behind the image surface", {"direction": "sagittal"}
    ),
    OperandName(
        "FCGT", FieldFocus, "tangential field curvature: focus behind the image surface", {"direction": "tangential"}
    ),
    OperandName("MTFA", Contrast, "diffraction MTF, mean of sagittal and tangential", {"direction": "mean"}),
    OperandName("MTFS", Contrast, "diffraction MTF, sagittal", {"direction": "sagittal"}),
    OperandName("MTFT", Contrast, "diffraction MTF, tangential", {"direction": "tangential"}),
    OperandName("TOTR", TotalTrack, "total track: along z, from the first surface to the image"),
    OperandName("TTHI", ThicknessSum, "sum of the thicknesses of the surfaces first to last, both included"),
    *_bounded("CT", CenterThickness, "thickness on the axis behind a surface"),
    *_bounded("ET", EdgeThickness, "thickness at the edge behind a surface, or at a radius"),
    *_bounded("CV", Curvature, "curvature of a surface, positive with its centre behind it"),
    *_bounded("CO", ConicConstant, "conic constant of a surface"),
    *_thickness_limits(),
    OperandName("EFL", FocalLength, "CODE V: EFFL", _WHOLE),
    OperandName("EFX", FocalLength, "CODE V: EFLX", {"meridian": "x"}),
    OperandName("EFY", FocalLength, "CODE V: EFLY", {"meridian": "y"}),
    OperandName("BFL", BackFocus, "CODE V: from the last surface to the paraxial focus"),
    OperandName("OAL", OverallLength, "CODE V: along z, from the first to the last mirror or lens surface"),
    OperandName("CT", CenterThickness, "CODE V: CTVA"),
    OperandName("ET", EdgeThickness, "CODE V: ETVA"),
    OperandName(
        "MNT", ThicknessLimit, "CODE V: MNCG", {"extreme": "least", "place": "center", "medium": "glass"}, "minimum"
    ),
    OperandName(
        "MXT", ThicknessLimit, "CODE V: MXCG", {"extreme": "largest", "place": "center", "medium": "glass"}, "maximum"
    ),
    OperandName(
        "MNE", ThicknessLimit, "CODE V: MNEG", {"extreme": "least", "place": "edge", "medium": "glass"}, "minimum"
    ),
]
#: Operands by their names in Zemax and CODE V.
NAMES: dict[str, OperandName] = {entry.name: entry for entry in _LISTED}


@check_arguments
def operand(
    name: str,
    value: float | None = None,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    weight: float = 1.0,
    **numbers: Any,
) -> GoalOperand:
    """Return the operand of a name as in Zemax or CODE V, such as "EFFL".

    Parameters
    ----------
    name : str
        One of the names that ``pachon operands`` lists.
    value : float, optional
        Target in SI (m, rad, waves); of a name such as CTGT or MNCG (CTLT, MXCG) a minimum (a maximum).
    minimum, maximum : float, optional
        Limits, in place of a target.
    weight : float
        A deviation of 1, in SI, counts as `weight` times 1 m of rms spot or wavefront.
    numbers
        What the number is of: surface, field, pupil, wavelength...

    Returns
    -------
    GoalOperand
        An operand for the `targets` of :func:`pachon.optimize`.

    Raises
    ------
    UnknownNameError
        If there is no operand of the name, or it has no such number.
    ConfigError
        If a target is given beside a limit, or a number that the operand needs is missing.
    """
    if name not in NAMES:
        raise unknown_operand(name)
    entry = NAMES[name]
    keys = entry_fields(entry)
    for key in numbers:
        if key not in keys:
            raise unknown_name(f"number of operand {name}", key, keys)
    for key, required in keys.items():
        if required and key not in numbers:
            raise ConfigError(f"operand {name}: {key} is missing")
    fields: dict[str, Any] = {**goal_of(entry, value, minimum, maximum), **entry.implied, **numbers}
    return entry.kind(**fields, weight=weight, stated=entry.stated(entry.unit))


def entry_fields(entry: OperandName) -> dict[str, bool]:
    """Return the fields of a named operand that say which number it is, and whether they are required."""
    goals = ("value", "minimum", "maximum", "weight", *entry.implied)
    return {
        f.name: f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        for f in dataclasses.fields(entry.kind)
        if f.repr and f.name not in goals
    }


def goal_of(
    entry: OperandName, value: float | None, minimum: float | None, maximum: float | None
) -> dict[str, float | None]:
    """Return the goal of a named operand, whose target may be a limit."""
    goal = {"value": None, "minimum": minimum, "maximum": maximum}
    if value is not None:
        if goal[entry.target] is not None:
            raise ConfigError(f"operand {entry.name}: target and {entry.target} are given: expected one of them")
        goal[entry.target] = value
    return goal


def unknown_operand(text: str) -> UnknownNameError:
    """Return the error for an unknown kind or name of an operand, with the nearest ones."""
    spellings = [
        kind if cls.unit == "1" else f"{kind}_{'mm' if cls.unit == 'm' else 'deg'}" for kind, cls in OPERANDS.items()
    ]
    return unknown_name("operand", text, [*spellings, *NAMES])
