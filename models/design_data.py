"""Design data of a lens file: aperture, fields, wavelengths, stop and environment, as the designer stated them.

Heights and angles are in the frame of the telescope, in metres and radians; see :doc:`prescriptions` for the file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ..core.arguments import check_prescription
from ..core.errors import PrescriptionError
from .links import Pickup, Solve, check_links

LengthUnit = Literal["m", "cm", "mm", "in"]
#: Units that a lens file counts lengths in [m].
LENGTH_UNITS: dict[LengthUnit, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
#: What the size of the beam is stated as. The value of `entrance_pupil` is its diameter [m], that of `stop` the
#: semi-diameter of the stop [m]; the others are pure numbers.
BeamAperture = Literal["entrance_pupil", "f_number", "working_f_number", "object_na", "stop"]
#: What field points are stated as; angles in radians, the others in metres.
FieldType = Literal["angle", "object_height", "paraxial_image_height", "real_image_height"]
FIELD_TYPES: tuple[FieldType, ...] = get_args(FieldType)
#: Which rays are launched: those through the paraxial entrance pupil, or those that fill the stop, whose radius is that
#: of the paraxial or of the real marginal ray.
Aiming = Literal["off", "paraxial", "real"]
AIMING: tuple[Aiming, ...] = get_args(Aiming)
#: Numbers of a row of vignetting factors: decentres and compressions along x and y, and an angle.
_FACTORS = 5


@check_prescription
@dataclass(frozen=True)
class DesignData:
    """Aperture, fields, wavelengths, stop and environment that a lens file states; empty for most telescopes.

    The primary wavelength is the telescope's `default_wavelength`, the distance of the object its `object_distance`.

    Parameters
    ----------
    length_unit : {"m", "cm", "mm", "in"}
        Unit that tables show lengths in.
    aperture : {"entrance_pupil", "f_number", "working_f_number", "object_na", "stop"}, optional
        What the size of the beam is stated as: diameter of the entrance pupil [m], focal ratio for an object at
        infinity, working focal ratio, numerical aperture at the object, or semi-diameter of the stop [m].
    aperture_value : float, optional
        Its value.
    stop : str, optional
        Name of the surface that is the aperture stop.
    aiming : {"off", "paraxial", "real"}
        "off": rays go through points of the paraxial entrance pupil. "paraxial" and "real": they go through the same
        points of the stop, in units of its radius; that is the height of the paraxial, or of the real, marginal ray.
    field_type : {"angle", "object_height", "paraxial_image_height", "real_image_height"}
        What field points are.
    fields : tuple of (x, y)
        Field points [rad] or [m]. Angles are slopes of the light's own travel, ``(tan x, tan y)``, as in "zemax".
    field_weights : tuple of float
        Their weights in a merit; equal where there are none.
    vignetting : tuple of (decentre_x, decentre_y, compression_x, compression_y, angle)
        Vignetting factors of the fields: the pupil point (px, py), in units of its radius, becomes ``(decentre_x +
        (1 - compression_x) px, decentre_y + (1 - compression_y) py)``, rotated by the angle [rad].
    wavelengths : tuple of float
        Vacuum wavelengths [m].
    wavelength_weights : tuple of float
        Their weights; equal where there are none.
    temperature, pressure : float, optional
        Temperature [K] and air pressure [Pa] of the design.
    telecentric : bool
        Whether chief rays leave the object parallel to the axis.
    afocal : bool
        Whether the image is at infinity.
    pickups : tuple of Pickup
        Radii, conic constants, thicknesses and glasses that follow those of other surfaces.
    solves : tuple of Solve
        Thicknesses that are solved for.
    remake_vignetting : bool
        Whether vignetting factors are made anew from the clear apertures of the telescope as it is, in place of those
        that are stated.

    Raises
    ------
    PrescriptionError
        If a value is not as expected.
    """

    length_unit: LengthUnit = "m"
    aperture: BeamAperture | None = None
    aperture_value: float | None = None
    stop: str | None = None
    aiming: Aiming = "off"
    field_type: FieldType = "angle"
    fields: tuple[tuple[float, float], ...] = ()
    field_weights: tuple[float, ...] = ()
    vignetting: tuple[tuple[float, float, float, float, float], ...] = ()
    wavelengths: tuple[float, ...] = ()
    wavelength_weights: tuple[float, ...] = ()
    temperature: float | None = None
    pressure: float | None = None
    telecentric: bool = False
    afocal: bool = False
    pickups: tuple[Pickup, ...] = ()
    solves: tuple[Solve, ...] = ()
    remake_vignetting: bool = False

    def __post_init__(self) -> None:
        value = self.aperture_value
        if (self.aperture is None) != (value is None) or (value is not None and not 0 < value < math.inf):
            _refuse(f"aperture_value = {value!r}: expected a positive number, with the aperture that it belongs to")
        for key in ("temperature", "pressure"):
            quantity = getattr(self, key)
            if quantity is not None and not 0 <= quantity < math.inf:
                _refuse(f"{key} = {quantity!r}: expected a number from 0")
        _check_rows("fields", self.fields, 2)
        _check_rows("vignetting", self.vignetting, _FACTORS)
        _check_count("vignetting", self.vignetting, "fields", self.fields)
        for row in self.vignetting:
            if not (row[2] < 1 and row[3] < 1):
                _refuse(f"vignetting = {list(row)}: expected compressions below 1")
        _check_weights("field_weights", self.field_weights, "fields", self.fields)
        for wavelength in self.wavelengths:
            if not 0 < wavelength < math.inf:
                _refuse(f"wavelengths: {wavelength!r} m: expected positive numbers")
        _check_weights("wavelength_weights", self.wavelength_weights, "wavelengths", self.wavelengths)
        if self.field_type == "angle" and any(abs(v) >= 0.5 * math.pi for row in self.fields for v in row):
            _refuse("fields: expected angles within 90 degrees of the axis")
        if self.telecentric and (self.aiming != "off" or (self.fields and self.field_type == "angle")):
            _refuse("telecentric: expected object or image heights as fields, and no aiming")
        if self.telecentric and self.aperture in ("entrance_pupil", "f_number"):
            _refuse(f"telecentric: expected object_na, working_f_number or stop as aperture, not {self.aperture}")

    @property
    def unit(self) -> float:
        """Unit of length [m]."""
        return LENGTH_UNITS[self.length_unit]

    def check_within(
        self,
        surface_names: Sequence[str],
        wavelength_range: tuple[float, float],
        default_wavelength: float,
        object_distance: float,
    ) -> None:
        """Raise PrescriptionError where the data do not belong to a telescope of these names, ranges and object."""
        if self.stop is not None and self.stop not in surface_names:
            _refuse(f"stop = {self.stop!r}: expected the name of a surface, such as {surface_names[0]!r}")
        if self.aiming != "off" and self.stop is None:
            _refuse(f"aiming = {self.aiming!r}: expected a surface that is the stop (stop: NAME)")
        check_links(self.pickups, self.solves, surface_names)
        low, high = wavelength_range
        for wavelength in self.wavelengths:
            if not low <= wavelength <= high:
                _refuse(f"wavelengths: {wavelength!r} m: expected within {low:g} to {high:g} m")
        if self.wavelengths and default_wavelength not in self.wavelengths:
            _refuse(f"wavelengths: expected the primary one, {default_wavelength!r} m, among them")
        finite = math.isfinite(object_distance)
        for key, needed in (
            ("field_type = 'object_height'", bool(self.fields) and self.field_type == "object_height"),
            ("aperture = 'object_na'", self.aperture == "object_na"),
            ("telecentric", self.telecentric),
        ):
            if needed and not finite:
                _refuse(f"{key}: expected an object at a finite distance")


def vignetted(points: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Return pupil points [..., n, 2], in units of the radius, that vignetting factors [..., 5] make of others."""
    decentre, compression, angle = factors[..., None, :2], factors[..., None, 2:4], factors[..., None, 4]
    x, y = np.moveaxis(decentre + (1.0 - compression) * points, -1, 0)
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([x * cos - y * sin, x * sin + y * cos], axis=-1)


def unvignetted(points: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Return the pupil points that vignetting factors move to given ones: the inverse of :func:`vignetted`."""
    decentre, compression, angle = factors[..., None, :2], factors[..., None, 2:4], factors[..., None, 4]
    x, y = np.moveaxis(points, -1, 0)
    cos, sin = np.cos(angle), np.sin(angle)
    back = np.stack([x * cos + y * sin, y * cos - x * sin], axis=-1)
    return np.asarray((back - decentre) / (1.0 - compression))


def _refuse(text: str) -> None:
    raise PrescriptionError(f"design data: {text}")


def _check_rows(key: str, rows: Sequence[Sequence[float]], size: int) -> None:
    for row in rows:
        if len(row) != size or not all(math.isfinite(v) for v in row):
            _refuse(f"{key} = {list(row)}: expected {size} finite numbers")


def _check_count(key: str, values: Sequence[object], of: str, counted: Sequence[object]) -> None:
    if values and len(values) != len(counted):
        _refuse(f"{key}: {len(values)} of them: expected {len(counted)}, as many as {of}")


def _check_weights(key: str, weights: Sequence[float], of: str, counted: Sequence[object]) -> None:
    _check_count(key, weights, of, counted)
    if weights and not (all(0 <= w < math.inf for w in weights) and sum(weights) > 0):
        _refuse(f"{key} = {list(weights)}: expected numbers from 0, not all zero")
