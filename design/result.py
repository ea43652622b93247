"""Base of the results of design studies: telescope, field points and wavelengths of the computation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ..core.plotting import plain_text
from ..core.result import Result
from ..wavefront.request import Request

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class FieldResult(Result):
    """Base of results over field points: telescope, field points, wavelengths and pupil points of the computation."""

    _table: ClassVar[tuple[str, ...]] = ("fields",)

    request: Request

    def _label(self) -> str:
        count = len(self.fields)
        return f"{self.telescope}, {count} field{'s' * (count != 1)}, {self._nanometres()}"

    def _meta(self) -> dict[str, Any]:
        return {"telescope": self.telescope, "wavelength_nm": self.wavelengths * 1e9, **super()._meta()}

    def _along(self, name: str, *values: str) -> dict[str, Any]:
        """Return columns of a row for each field and value of an attribute, with others [n_field, n_value]."""
        axis = getattr(self, name)
        rows = {"fields": np.repeat(self.fields, len(axis), axis=0), name: np.tile(axis, len(self.fields))}
        return rows | {v: getattr(self, v).ravel() for v in values}

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
