"""Maps in HDF5 files, such as the mirror figures of batoid_rubin: one dataset of numbers, without nodes or units."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import PrescriptionError, error_context
from ...core.files import parsing, require_file
from ...core.units import length, require_positive
from ..shapes.grid import GridSag

#: First bytes of an HDF5 file.
SIGNATURE = b"\x89HDF\r\n\x1a\n"
#: Numbers of a map, at most.
_MOST = 10**8


@check_arguments
def read_hdf5_map(
    path: str | os.PathLike[str],
    half_width: ArrayLike,
    *,
    unit: ArrayLike = 1.0,
    dataset: str | None = None,
    quarter_turns: int = 0,
) -> GridSag:
    """Read a map of sag from an HDF5 file.

    The file says neither where the nodes are nor in which unit the sag is. Values that are not finite, outside the
    mirror, become 0. Needs h5py: ``pip install 'pachon[hdf5]'``.

    Parameters
    ----------
    path : str or path
        File to read.
    half_width : float or Quantity
        The nodes run from minus to plus this, along x and y [m].
    unit : float or Quantity
        Sag of a value of 1 [m].
    dataset : str, optional
        Name of the dataset; the only one of two dimensions by default.
    quarter_turns : int
        Quarter turns of the map from +x towards +y; without any its rows run along y from below. Those of batoid_rubin
        need -1.

    Raises
    ------
    PrescriptionError
        If the file cannot be read, has no such dataset, or h5py is missing.
    DomainError
        If ``half_width`` or ``unit`` are no lengths, or not above 0.
    """
    half = require_positive(length(half_width, "half_width"), "half_width")
    scale = require_positive(length(unit, "unit"), "unit")
    values = _values(Path(path), dataset)
    turned = np.rot90(values, -quarter_turns)
    with error_context(file=path):
        x, y = (np.linspace(-half, half, n) for n in turned.shape[::-1])
        return GridSag(x, y, scale * np.where(np.isfinite(turned), turned, 0.0))


def _values(path: Path, name: str | None) -> np.ndarray:
    """Return the float64 numbers of a dataset of two dimensions."""
    require_file(path, PrescriptionError)
    try:
        import h5py
    except ImportError:
        raise PrescriptionError("HDF5 needs the package h5py: pip install 'pachon[hdf5]'", file=path) from None
    with parsing(path, "cannot be read as HDF5", PrescriptionError), h5py.File(path, "r") as file:
        datasets: dict[str, Any] = {}

        def collect(key: str, item: Any) -> None:
            # Links to other files are not followed by visititems; datasets may lie outside the file all the same.
            if isinstance(item, h5py.Dataset) and item.ndim == 2 and item.dtype.kind in "iuf":
                datasets[key] = item

        file.visititems(collect)
        if (name is None and len(datasets) != 1) or (name is not None and name not in datasets):
            names = ", ".join(datasets) or "none"
            expected = "one dataset" if name is None else f"a dataset {name!r}"
            raise PrescriptionError(
                f"expected {expected} of numbers of two dimensions; the file has {names}", file=path
            )
        data = datasets[name] if name is not None else next(iter(datasets.values()))
        if data.external or data.is_virtual:
            raise PrescriptionError(f"dataset {data.name!r} lies in another file, which is not read", file=path)
        if data.size > _MOST:
            raise PrescriptionError(f"dataset {data.name!r}: {data.size} values, expected {_MOST} or fewer", file=path)
        return np.asarray(data[()], dtype=np.float64)
