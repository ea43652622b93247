"""Tables of Zernike coefficients of the heights of sensors, one row a sensor, as imSim (LSST DESC) has them.

Columns: DET_NAME; ORIGIN_X, ORIGIN_Y and R_OUTER, the circle of Noll's circular Zernikes; MIN_X, MAX_X, MIN_Y, MAX_Y,
the measured rectangle, outside which the polynomials do not hold; ZK, coefficients of index 0, 1, 2..., of which the
first means nothing. Each column has a unit of length.

A table without a frame (:mod:`~.columns`) is in that of imSim's, CCS.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from astropy.table import Table

from ....core.arguments import check_arguments
from ....core.errors import PrescriptionError, unknown_name
from ...camera.sensor_heights import CornerSensor, SensorHeights
from ...camera.zernike_surfaces import ZernikeSurfaces
from .columns import frame_of, lengths

COLUMNS = ("DET_NAME", "ORIGIN_X", "ORIGIN_Y", "MIN_X", "MAX_X", "MIN_Y", "MAX_Y", "R_OUTER", "ZK")
#: Cameras as built: the model of the camera, and the file of its heights.
AS_MEASURED = {"lsstcam": ("lsst", "lsstcam_heights.ecsv")}
_DATA = Path(__file__).parents[2] / "data"
_KINDS = {"SW": "wavefront", "SG": "guider"}


def zernike_heights(table: Table, file: str | Path) -> SensorHeights:
    """Return the heights of a table of Zernike coefficients, in the telescope frame.

    Raises
    ------
    PrescriptionError
        If a column or its unit is missing, a value is not finite, a name occurs twice, a radius is not positive, or the
        frame is unknown.
    """
    for name in COLUMNS:
        if name not in table.colnames:
            raise PrescriptionError(f"column {name} is missing: expected {', '.join(COLUMNS)}", file=file)
    names = tuple(str(name).strip() for name in table["DET_NAME"])
    column = {name: lengths(table, name, file, names) for name in COLUMNS[1:]}
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
    wrong = np.flatnonzero(radius <= 0.0)
    if wrong.size:
        name = names[wrong[0]]
        raise PrescriptionError(f"column R_OUTER, {name}: expected a positive radius of the Zernike circle", file=file)
    surfaces = ZernikeSurfaces.from_noll(zernikes[:, 1:], radius, np.zeros_like(center), limits)
    if frame_of(table.meta, "CCS", file) == "CCS":
        surfaces = ZernikeSurfaces(radius, surfaces.origin, -surfaces.coefficients, limits)
    return SensorHeights(names, center, surfaces)


@cache
def bundled_heights(name: str) -> SensorHeights:
    """Return the heights of a camera as built, of :data:`AS_MEASURED`; UnknownNameError where there is none."""
    if name not in AS_MEASURED:
        raise unknown_name("camera as built", name, AS_MEASURED)
    path = _DATA / AS_MEASURED[name][1]
    return zernike_heights(Table.read(path, format="ascii.ecsv"), path)


@check_arguments
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
