"""Frame and columns of files with heights.

The frame of a file is the entry ``frame`` of its metadata, the card FRAME in FITS. ``telescope`` is pachon's. ``CCS``
is the coordinate system of Rubin's camera: its x and y are ours, and its z runs against ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from astropy import units as u
from astropy.table import Table

from ....core.errors import PrescriptionError

Frame = Literal["telescope", "CCS"]
FRAMES = ("telescope", "CCS")


def frame_of(metadata: Any, default: Frame, file: str | Path) -> Frame:
    """Return the frame that the metadata of a table or the header of an image name; PrescriptionError if unknown."""
    frame = next((metadata[key] for key in ("frame", "FRAME") if key in metadata), default)
    if frame not in FRAMES:
        raise PrescriptionError(f"frame = {frame!r}: expected one of {', '.join(FRAMES)}", file=file, key="frame")
    return cast(Frame, frame)


def in_telescope_frame(points: Sequence[np.ndarray], frame: Frame) -> np.ndarray:
    """Return x, y and z of points in the telescope frame, shape [3, n]."""
    x, y, z = points
    return np.stack([x, y, -z if frame == "CCS" else z])


def lengths(table: Table, name: str, file: str | Path, rows: Sequence[str] = ()) -> np.ndarray:
    """Return a column in metres; `rows` are the names of its rows in messages.

    Raises
    ------
    PrescriptionError
        If the column has no unit of length, or a value is not a finite number.
    """
    column = table[name]
    try:
        values = u.Quantity(np.ma.getdata(column), column.unit).to_value(u.m)
    except (TypeError, ValueError, u.UnitConversionError):
        unit = column.unit or "no unit"
        raise PrescriptionError(f"column {name} in {unit}: expected numbers with a unit of length", file=file) from None
    values = np.where(np.ma.getmaskarray(column), np.nan, values)
    wrong = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))
    if wrong.size:
        row = rows[wrong[0]] if rows else f"row {wrong[0]}"
        raise PrescriptionError(f"column {name}, {row}: expected finite numbers", file=file)
    return values
