"""Tables of Zernike coefficients of the heights of sensors, one row a sensor, as imSim (LSST DESC) has them.

Columns: DET_NAME; ORIGIN_X, ORIGIN_Y and R_OUTER, the circle of Noll's circular Zernikes; MIN_X, MAX_X, MIN_Y, MAX_Y,
the measured rectangle, outside which the polynomials do not hold; ZK, coefficients of index 0, 1, 2..., of which the
first means nothing. Each column has a unit of length.

The frame of a file is the entry ``frame`` of its metadata (the card FRAME in FITS). ``telescope`` is pachon's. ``CCS``
is the coordinate system of Rubin's camera: its x is our y, its y our x, and its z runs against ours.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from astropy import units as u
from astropy.table import Table

from ....core.errors import PrescriptionError, unknown_name
from ...camera.sensor_heights import CornerSensor, SensorHeights
from ...camera.zernike_surfaces import ZernikeSurfaces

COLUMNS = ("DET_NAME", "ORIGIN_X", "ORIGIN_Y", "MIN_X", "MAX_X", "MIN_Y", "MAX_Y", "R_OUTER", "ZK")
Frame = Literal["telescope", "CCS"]
FRAMES = ("telescope", "CCS")
#: Cameras as built: the model of the camera, and the file of its heights.
AS_MEASURED = {"lsstcam": ("lsst", "lsstcam_heights.ecsv")}
_DATA = Path(__file__).parents[2] / "data"
_KINDS = {"SW": "wavefront", "SG": "guider"}


def zernike_heights(table: Table, file: str | Path) -> SensorHeights:
    """Return the heights of a table of Zernike coefficients, in the telescope frame.

    Raises
    ------
    PrescriptionError
        If a column or its unit is missing, a value is not finite, a name occurs twice, or the frame is unknown.
    """
    for name in COLUMNS:
        if name not in table.colnames:
            raise PrescriptionError(f"column {name} is missing: expected {', '.join(COLUMNS)}", file=file)
    names = tuple(str(name).strip() for name in table["DET_NAME"])
    column = {name: _lengths(table, name, names, file) for name in COLUMNS[1:]}
    zernikes = column["ZK"]
    if zernikes.ndim != 2 or zernikes.shape[1] < 2:
        raise PrescriptionError(
            f"ZK has the shape {zernikes.shape}: expected a row of coefficients a sensor", file=file
        )
    for name in names:
        if names.count(name) > 1:
            raise PrescriptionError(f"{name} occurs more than once: expected one row a sensor", file=file)
    center = np.stack([column["ORIGIN_X"], column["ORIGIN_Y"]], axis=1)
    limits = np.stack(
        [
            np.stack([column[f"MIN_{axis}"], column[f"MAX_{axis}"]], axis=1) - center[:, i, None]
            for i, axis in enumerate("XY")
        ],
        axis=1,
    )
    wrong = np.flatnonzero(np.any(limits[:, :, 0] >= limits[:, :, 1], axis=1))
    if wrong.size:
        raise PrescriptionError(f"{names[wrong[0]]}: expected MIN_X below MAX_X and MIN_Y below MAX_Y", file=file)
    radius = column["R_OUTER"]
    surfaces = ZernikeSurfaces.from_noll(zernikes[:, 1:], radius, np.zeros_like(center), limits)
    if frame_of(table.meta, "CCS", file) == "CCS":
        # Swapping x and y swaps the powers of x and y.
        center, limits = center[:, ::-1].copy(), limits[:, ::-1].copy()
        coefficients = -surfaces.coefficients.transpose(0, 2, 1).copy()
        surfaces = ZernikeSurfaces(radius, surfaces.origin, coefficients, limits)
    return SensorHeights(names, center, surfaces)


def frame_of(metadata: Any, default: Frame, file: str | Path) -> Frame:
    """Return the frame that the metadata of a table or the header of an image name; PrescriptionError if unknown."""
    given = next((metadata[key] for key in ("frame", "FRAME") if key in metadata), default)
    if given not in FRAMES:
        raise PrescriptionError(f"frame = {given!r}: expected one of {', '.join(FRAMES)}", file=file, key="frame")
    return cast(Frame, given)


@cache
def bundled_heights(name: str) -> SensorHeights:
    """Return the heights of a camera as built, of :data:`AS_MEASURED`; UnknownNameError where there is none."""
    if name not in AS_MEASURED:
        raise unknown_name("camera as built", name, AS_MEASURED)
    path = _DATA / AS_MEASURED[name][1]
    return zernike_heights(Table.read(path, format="ascii.ecsv"), path)


def corner_sensors(name: str = "lsstcam") -> tuple[CornerSensor, ...]:
    """Return the wavefront sensors and guiders of a camera as built, with their measured heights.

    Parameters
    ----------
    name : str
        Name of the camera as built: "lsstcam".

    Raises
    ------
    UnknownNameError
        If there is no such camera.
    """
    heights = bundled_heights(name)
    sensors = []
    for i, sensor in enumerate(heights.names):
        kind = _KINDS.get(sensor.split("_")[1][:2])
        if kind is not None:
            x, y = heights.center[i]
            half_x, half_y = 0.5 * np.ptp(heights.surfaces.limits[i], axis=1)
            surface = heights.surfaces.chosen(np.array([i]))
            sensors.append(CornerSensor(sensor, kind, (float(x), float(y)), (float(half_x), float(half_y)), surface))
    return tuple(sensors)


def _lengths(table: Table, name: str, sensors: tuple[str, ...], file: str | Path) -> np.ndarray:
    """Return a column in metres."""
    column = table[name]
    try:
        values = np.asarray(np.ma.filled(u.Quantity(np.ma.getdata(column), column.unit).to_value(u.m), np.nan))
        values = np.where(np.ma.getmaskarray(column), np.nan, values).astype(np.float64)
    except (TypeError, ValueError, u.UnitConversionError):
        raise PrescriptionError(
            f"column {name} in {column.unit or 'no unit'}: expected numbers with a unit of length, such as mm",
            file=file,
        ) from None
    for sensor, row in zip(sensors, values, strict=True):
        if not np.isfinite(row).all():
            raise PrescriptionError(f"{sensor}: {name} has a value that is not finite", file=file)
    return values
