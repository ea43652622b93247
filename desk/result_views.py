"""Views that pages of results share: rows of images, and columns at places; nothing here draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class RowsView:
    """Rows of images, such as stars, models and residuals."""

    rows: Mapping[str, np.ndarray]  #: names of the rows from above, each [n, side, side], parts of a peak
    side_arcsec: float  #: side of an image [arcsec]
    title: str

    @property
    def image(self) -> np.ndarray:
        """All images in one, the first row at the top."""
        return np.concatenate([np.concatenate(list(row), axis=1) for row in reversed(list(self.rows.values()))])

    @property
    def columns(self) -> int:
        """Images in a row."""
        return len(next(iter(self.rows.values())))


@dataclass(frozen=True)
class PlacesView:
    """A number at places."""

    x: np.ndarray
    y: np.ndarray
    value: np.ndarray
    label: str  #: of the number, with its unit
    title: str
    diverging: bool = False  #: whether colours are those of numbers about zero


@dataclass(frozen=True)
class ErrorBarsView:
    """Numbers with standard errors at positions of an axis."""

    x: np.ndarray
    value: np.ndarray
    error: np.ndarray
    title: str


@dataclass(frozen=True)
class SkyMapView:
    """A number in pixels of the sky."""

    ra: np.ndarray  #: corners of each pixel [deg], [n, 4]
    dec: np.ndarray
    value: np.ndarray  #: [n]
    label: str  #: of the number, with its unit
    title: str
