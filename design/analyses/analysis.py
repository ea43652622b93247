"""Base of the analyses of a design: pictures in given axes, tables with units, JSON-safe summaries."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import axes_at, figure_at, styled
from ...core.products import described_table
from ...models.telescope import Telescope
from ...raytrace.rays import Projection
from ...wavefront.pupil_sampling import CHIEF_RAY
from ...wavefront.request import Request
from ..result import FieldResult

if TYPE_CHECKING:
    from astropy.table import QTable
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Columns of a table by name: values, their unit, empty for names and pure numbers, and their meaning.
Columns = dict[str, tuple[ArrayLike, str, str]]
#: Points of curves along the field where none are given.
_ALONG_FIELD = 33
#: Wavelengths across the band where none are given.
_ACROSS_BAND = 5


@dataclass(frozen=True)
class Analysis(FieldResult):
    """Base of analyses: a summary, a table and a picture of one or more panels."""

    def _summary(self) -> dict[str, Any]:
        common = {"telescope": self.telescope, "wavelength_nm": self.wavelengths * 1e9, **self.field_items()}
        return common | self._values()

    def to_table(self) -> QTable:
        """Return the results as a table with units, a row for each value of the longest column."""
        from astropy.table import QTable

        columns = self._table_columns()
        arrays = np.broadcast_arrays(*(np.asarray(values) for values, _, _ in columns.values()))
        flat = {
            name: (np.array(array).ravel(), unit, meaning)
            for array, (name, (_, unit, meaning)) in zip(arrays, columns.items(), strict=True)
        }
        return QTable(described_table(flat, {"telescope": self.telescope}))

    @check_arguments
    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the result in a figure of its own, or in the place of given axes."""
        rows, columns, *size = self._panels
        with styled():
            if rows * columns == 1:
                figure, axes = axes_at(ax, *size)
                panels = [axes]
            else:
                figure = figure_at(ax, *size)
                panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
            if ax is None:
                self._titled(figure, self._title)
            self._draw(panels)
            return figure

    @property
    def _panels(self) -> tuple[int, int, float, float]:
        """Rows and columns of panels, width and height of the picture [inches]."""
        return 1, 1, 6.5, 4.6

    @property
    @abstractmethod
    def _title(self) -> str:
        """Title behind the name of the telescope."""

    @abstractmethod
    def _draw(self, panels: Sequence[Axes]) -> None:
        """Draw into panels."""

    @abstractmethod
    def _table_columns(self) -> Columns:
        """Return the columns of the table; their arrays have shapes that broadcast together."""

    @abstractmethod
    def _values(self) -> dict[str, Any]:
        """Return the entries of the summary behind telescope, wavelengths and fields."""

    def _field_columns(self, extra: int = 0) -> Columns:
        """Return the columns of the field points, with so many axes of length 1 behind that of the fields."""
        points, unit, quantity = (
            (np.rad2deg(self.fields), "deg", "field angle")
            if self.on_sky
            else (1e3 * self.object_heights, "mm", "place on the object")
        )
        x, y = (v.reshape(-1, *(1,) * extra) for v in points.T)
        return {"field_x": (x, unit, f"{quantity}, x"), "field_y": (y, unit, f"{quantity}, y")}


def field_line(telescope: Telescope) -> np.ndarray:
    """Return field points [rad] from the axis along +y to the edge of the field of view, shape [n, 2]."""
    y = np.linspace(0.0, telescope.field_radius, _ALONG_FIELD)
    return np.stack([np.zeros_like(y), y], axis=-1)


def line_request(
    telescope: Telescope | Request,
    fields: ArrayLike | None,
    wavelengths: ArrayLike | None,
    projection: Projection | None,
    threads: int | None,
) -> Request:
    """Return the request of curves along the field, with chief rays as pupil points."""
    return Request.of(
        telescope,
        fields,
        wavelengths,
        sampling=CHIEF_RAY,
        projection=projection,
        threads=threads,
        default_fields=field_line,
    )


def band_wavelengths(
    telescope: Telescope | Request, wavelengths: ArrayLike | None, count: int = _ACROSS_BAND
) -> ArrayLike | None:
    """Return wavelengths [m] to study colour at: as given, those of the telescope's file, or some across its band.

    Those of a request are its own: None.
    """
    if isinstance(telescope, Request):
        return wavelengths
    if wavelengths is None and len(Request.of(telescope, sampling=CHIEF_RAY).wavelengths) == 1:
        return np.linspace(*(telescope.band or telescope.wavelength_range), count)
    return wavelengths


def require_focus(telescope: Telescope, *values: np.ndarray) -> None:
    """Raise a DomainError where values are not finite since the light of a telescope is parallel."""
    finite = np.concatenate([np.isfinite(value).ravel() for value in values])
    if telescope.design_data.afocal or not finite.all():
        focused_in_part = finite.any() and not telescope.design_data.afocal
        extent = " at some fields or along one direction, as behind a cylinder" if focused_in_part else ""
        raise DomainError(f"telescope {telescope.name}: expected one with a focus; its light is parallel{extent}")
