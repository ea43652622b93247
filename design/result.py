"""Base of the results of design studies: telescope, field points and wavelengths of the computation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..core.plotting import plain_text
from ..wavefront.request import Request

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class FieldResult:
    """Base of results over field points: telescope, field points, wavelengths and pupil points of the computation."""

    request: Request

    @property
    def telescope(self) -> str:
        """Name of the telescope."""
        return self.request.telescope.name

    @property
    def fields(self) -> np.ndarray:
        """Field angles [rad], shape [n_field, 2]."""
        return self.request.fields

    @property
    def wavelengths(self) -> np.ndarray:
        """Vacuum wavelengths [m], shape [n_wave]."""
        return self.request.wavelengths

    @property
    def wavelength(self) -> float:
        """Vacuum wavelength [m], of results at a single one."""
        return self.request.wavelength

    @property
    def off_axis_angle(self) -> np.ndarray:
        """Distance of the field points from the axis [rad], shape [n_field]."""
        return np.linalg.norm(self.fields, axis=-1)

    def _nanometres(self) -> str:
        """Return the wavelengths as titles of plots give them."""
        return ", ".join(f"{w * 1e9:.4g}" for w in self.wavelengths) + " nm"

    def _titled(self, figure: Figure, text: str) -> Figure:
        """Return a figure with a title that begins with the name of the telescope."""
        figure.suptitle(f"{plain_text(self.telescope)}: {text}", fontsize=11)
        return figure
