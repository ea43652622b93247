"""Images of heights in FITS files, one extension a CCD: EXTNAME is its name, BUNIT the unit of the heights.

Pixels have the linear coordinates of FITS, ``x_i = CRVALi + sum_j CDi_j (p_j - CRPIXj)`` in CUNITi, or CDELTi PCi_j in
place of the matrix. Pixels that are not finite have no height. Larger images are averaged to at most 64 x 64 pixels,
three for each coefficient of the fit along a side; a bowl of 5 um moves by 2 nm. The frame is the card FRAME of the
extension or of the primary header (:mod:`~.columns`), by default the telescope's.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ....core.errors import PrescriptionError, error_context
from ..grid_file import length_unit
from .columns import frame_of, in_telescope_frame

# Pixels along a side that a fit can use.
_MOST_PIXELS = 64


def image_points(images: Sequence[Any], primary: Any, file: Path) -> dict[str, np.ndarray]:
    """Return x, y and height [m] in the telescope frame, shape [3, n], of the pixels of each image, by its name.

    Raises
    ------
    PrescriptionError
        If an image has no name or one twice, no coordinates, or units that are no lengths.
    """
    points: dict[str, np.ndarray] = {}
    for number, hdu in enumerate(images, start=1):
        name = str(hdu.header.get("EXTNAME", "")).strip()
        if not name or name.upper() in {other.upper() for other in points}:
            raise PrescriptionError(f"image {number}: EXTNAME = {name!r}: expected the name of a CCD, once", file=file)
        with error_context(file=file, place=name):
            hdu_points = _points(hdu.data, hdu.header)
        frame = frame_of(hdu.header, frame_of(primary, "telescope", file), file)
        points[name] = in_telescope_frame(list(hdu_points), frame)
    return points


def _points(data: np.ndarray, header: Any) -> np.ndarray:
    index = np.indices(data.shape)
    offset = [1.0 + index[1] - _number(header, "CRPIX1"), 1.0 + index[0] - _number(header, "CRPIX2")]
    unit = length_unit(header, "BUNIT", "no unit")
    position = []
    for i in (1, 2):
        steps = _steps(header, i)
        along = _number(header, f"CRVAL{i}") + steps[0] * offset[0] + steps[1] * offset[1]
        position.append(along * length_unit(header, f"CUNIT{i}", "no unit"))
    values = np.stack([position[0], position[1], unit * data.astype(np.float64)])
    finite = np.isfinite(data)
    return _averaged(np.where(finite, values, 0.0), finite)


def _steps(header: Any, i: int) -> list[float]:
    """Return the change of a coordinate from column to column and from row to row."""
    if any(f"CD{i}_{j}" in header for j in (1, 2)):
        return [_number(header, f"CD{i}_{j}", 0.0) for j in (1, 2)]
    if header.get("CROTA2") or header.get("CROTA1"):
        raise PrescriptionError("CROTA1, CROTA2: expected a rotation as CDi_j, or CDELTi and PCi_j")
    mixed = any(f"PC{k}_{j}" in header for k in (1, 2) for j in (1, 2))
    scale = _number(header, f"CDELT{i}", 1.0 if mixed else None)
    return [scale * _number(header, f"PC{i}_{j}", float(i == j)) for j in (1, 2)]


def _averaged(values: np.ndarray, finite: np.ndarray) -> np.ndarray:
    """Return the means of x, y and height over blocks of pixels, shape [3, n], of blocks with finite pixels."""
    starts = [np.arange(0, size, -(-size // _MOST_PIXELS)) for size in finite.shape]

    def sums(array: np.ndarray) -> np.ndarray:
        along_y = np.add.reduceat(array, starts[0], axis=-2)
        return np.asarray(np.add.reduceat(along_y, starts[1], axis=-1))

    count = sums(finite.astype(np.float64))
    return np.asarray(sums(values)[:, count > 0] / count[count > 0])


def _number(header: Any, key: str, default: float | None = None) -> float:
    value = header.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        problem = "is missing" if value is None else f"= {value!r}"
        raise PrescriptionError(f"{key} {problem}: expected a number, the coordinates of the pixels")
    return float(value)
