"""Colours of stars and galaxies on an image, from a catalogue."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from ..core.arguments import check_arguments
from ..core.errors import DomainError, ProductError, error_context
from ..core.table_files import names_in_small_letters
from ..models.star_spectrum import psf_colours
from .image_file import CcdImage
from .star_positions import positions_in, table_in

#: Largest distance of an object from its entry in a catalogue [pixel].
MATCH = 3.0


@check_arguments
@dataclass(frozen=True, eq=False)
class ObjectColours:
    """Colours of objects of a catalogue, which are theirs on an image too.

    Parameters
    ----------
    positions : ndarray
        Pixels (x, y) of the image, the first one's centre at (0, 0), [k, 2].
    values : ndarray
        Colours, [k], of any kind, NaN where unknown: those of the PSF model.

    Raises
    ------
    DomainError
        If shapes differ, or a colour is infinite.
    """

    positions: np.ndarray
    values: np.ndarray

    def __post_init__(self) -> None:
        if self.values.ndim != 1 or self.positions.shape != (len(self.values), 2):
            raise DomainError(
                f"positions have shape {self.positions.shape}, values {self.values.shape}: expected [k, 2] and [k]"
            )
        if np.isinf(self.values).any():
            raise DomainError("values are infinite: expected colours, or NaN where unknown", key="values")

    @property
    def mean(self) -> float:
        """Mean of the known colours; NaN where there are none."""
        known_values = self.values[np.isfinite(self.values)]
        return float(known_values.mean()) if len(known_values) else float("nan")

    def at(self, places: np.ndarray) -> np.ndarray:
        """Return the colours of the nearest entries within :data:`MATCH` pixels of places [n, 2], NaN without one."""
        known = np.isfinite(self.values) & np.isfinite(self.positions).all(axis=1)
        if not known.any() or not len(places):
            return np.full(len(places), np.nan)
        distance, nearest = KDTree(self.positions[known]).query(places)
        return np.where(distance <= MATCH, self.values[known][nearest], np.nan)


def read_object_colours(path: Path, column: str, image: CcdImage, among: int = 1) -> ObjectColours:
    """Read the colours of objects from a column of a table with pixels or celestial coordinates.

    Temperatures (columns teff and the like) become g - i of blackbodies (:func:`~.star_spectrum.psf_colours`).

    Raises
    ------
    ProductError
        If the file is no table (FITS, ECSV or CSV), has no positions, or no such column of numbers; celestial
        positions, and the image no world coordinates; or pixels alone, and the image is one `among` several of a file.
    """
    table = table_in(path)
    with error_context(file=path):
        names = names_in_small_letters(table.colnames)
    name = names.get(column) or names.get(column.lower())
    if name is None:
        raise ProductError(f"no column {column!r}; its columns are {', '.join(table.colnames)}", file=path)
    values = np.ma.asarray(table[name])
    if values.dtype.kind not in "fiu" or values.ndim != 1:
        raise ProductError(f"column {column!r} has type {values.dtype}: expected a number in every row", file=path)
    colours = np.ma.filled(values.astype(float), np.nan)
    return ObjectColours(positions_in(table, image, path, among), psf_colours(colours, column))
