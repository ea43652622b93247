"""Refractive index from a table, by interpolation in wavelength."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_prescription
from ...core.errors import PrescriptionError
from .medium import Medium, medium_label, wavelengths_within

# A third of a second to import: only where there is such a table.
if TYPE_CHECKING:
    from scipy.interpolate import PchipInterpolator

Interpolation = Literal["monotone", "linear"]


@check_prescription
@dataclass(frozen=True)
class TabulatedIndex(Medium):
    """Medium whose index is interpolated from a table.

    Parameters
    ----------
    wavelengths : tuple of float, shape (n,)
        Vacuum wavelengths [m], rising; at least two. The medium covers the wavelengths between the first and the last.
    indices : tuple of float, shape (n,)
        Refractive index at each.
    interpolation : {"monotone", "linear"}
        Between two entries: the cubic of Fritsch & Carlson (1980, SIAM J. Numer. Anal. 17, 238) in wavelength, which
        has a continuous slope and no additional extremum, or a straight line.
    name : str
        Name for messages and files; not part of equality.
    """

    wavelengths: tuple[float, ...]
    indices: tuple[float, ...]
    interpolation: Interpolation = "monotone"
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        w, n = np.array(self.wavelengths, dtype=np.float64), np.array(self.indices, dtype=np.float64)
        if w.ndim != 1 or len(w) < 2 or not (np.all(np.isfinite(w)) and w[0] > 0 and np.all(np.diff(w) > 0)):
            raise PrescriptionError(f"wavelengths = {_ends(w)}: expected at least two positive numbers, rising")
        if n.shape != w.shape or not (np.all(np.isfinite(n)) and np.all(n > 0)):
            raise PrescriptionError(f"indices = {_ends(n)}: expected {len(w)} positive numbers, one a wavelength")

    @cached_property
    def _cubic(self) -> PchipInterpolator:
        from scipy.interpolate import PchipInterpolator

        return PchipInterpolator(self.wavelengths, self.indices)

    @property
    def wavelength_range(self) -> tuple[float, float]:
        """Shortest and longest wavelength of the table [m]."""
        return self.wavelengths[0], self.wavelengths[-1]

    def index(self, wavelength: ArrayLike) -> np.ndarray:  # noqa: D102
        w = np.clip(
            wavelengths_within(wavelength, self.wavelength_range, medium_label(self.name, "table")),
            *self.wavelength_range,
        )
        if self.interpolation == "linear":
            return np.asarray(np.interp(w, self.wavelengths, self.indices))
        return np.asarray(self._cubic(w))


def _ends(values: np.ndarray) -> str:
    listed = values.ravel().tolist()
    return str(listed) if len(listed) <= 6 else f"[{listed[0]}, ..., {listed[-1]}]"
