"""Refractive index with a constant offset, such as that of a melt from its catalogue."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...core.errors import PrescriptionError
from .medium import Medium


@dataclass(frozen=True)
class ChangedIndex(Medium):
    """Medium with the index of another plus a constant at every wavelength.

    Parameters
    ----------
    medium : Medium
        The other medium.
    change : float
        Addition to its index.
    name : str
        Name for messages and files; not part of equality.
    """

    medium: Medium
    change: float
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if not np.isfinite(self.change):
            raise PrescriptionError(f"change = {self.change!r}: expected a finite change of the refractive index")

    def index(self, wavelength: Any) -> np.ndarray:  # noqa: D102
        return self.medium.index(wavelength) + self.change


def with_index_change(medium: Medium, change: float) -> Medium:
    """Return a medium with its index changed by a constant; successive changes add up."""
    base, before = (medium.medium, medium.change) if isinstance(medium, ChangedIndex) else (medium, 0.0)
    return ChangedIndex(base, before + change, medium.name) if before + change else base
