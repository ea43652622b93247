"""Base of the results of design studies: telescope, field points and wavelengths of the computation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ..core.docstrings import Description
from ..core.plotting import plain_text
from ..core.result import Result
from ..core.units import angular, arcseconds
from ..raytrace.rays import object_points
from ..wavefront.request import Request
from .drawing import field_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class FieldResult(Result):
    """Base of results over field points: telescope, field points, wavelengths and pupil points of the computation."""

    _table: ClassVar[tuple[str, ...]] = ("fields",)
    #: Attributes that are lengths on the image; angles [rad] where the image is at infinity.
    _on_image: ClassVar[tuple[str, ...]] = ()

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

    @property
    def on_sky(self) -> bool:
        """Whether the object is at infinity, so that field points and sizes are angles."""
        return bool(np.isinf(self.request.telescope.object_distance))

    def field_items(self) -> dict[str, np.ndarray]:
        """Return the field angles for a summary; with the heights of an object at a finite distance."""
        angles = {"field_deg": np.rad2deg(self.fields)}
        return angles if self.on_sky else angles | {"object_mm": 1e3 * self.object_heights}

    @property
    def object_heights(self) -> np.ndarray:
        """Places x, y of the field points on an object at a finite distance [m], shape [n_field, 2]."""
        return object_points(self.request.telescope, self.request.directions)[:, :2] + 0.0

    def field_places(self) -> tuple[np.ndarray, str, str]:
        """Return the field points [n_field, 2] in degrees or millimetres of the object, with their name and unit."""
        if self.on_sky:
            return np.rad2deg(self.fields), "field", "deg"
        return 1e3 * self.object_heights, "object", "mm"

    def axis_distances(self) -> tuple[np.ndarray, str]:
        """Return distances of the field points from the axis, in degrees or millimetres of the object, and a label."""
        if self.on_sky:
            return np.rad2deg(self.off_axis_angle), "distance from the axis [deg]"
        return 1e3 * np.linalg.norm(self.object_heights, axis=-1), "distance of the object from the axis [mm]"

    def field_labels(self) -> list[str]:
        """Return the field points as plots name them: in degrees, or millimetres of the object."""
        if self.on_sky:
            return [field_text(field) for field in self.fields]
        return [f"({x:.4g}, {y:.4g}) mm" if x else f"{y:.4g} mm" for x, y in 1e3 * self.object_heights]

    @property
    def in_angles(self) -> bool:
        """Whether the image is at infinity, so that sizes of it are angles: a metre stands for a radian."""
        return self.request.telescope.design_data.afocal

    def _described(self, name: str) -> Description:
        description = super()._described(name)
        if not (self.in_angles and name in self._on_image):
            return description
        return description._replace(
            unit={"m": "rad", "rad / m": "", "1 / m": "1 / rad"}.get(description.unit, description.unit)
        )

    def on_image(self, items: dict[str, Any]) -> dict[str, Any]:
        """Return entries of a summary, lengths on the image, under names of angles where it is at infinity."""
        return {angular(name): value for name, value in items.items()} if self.in_angles else items

    def image_text(self, text: str) -> str:
        """Return a text with units of lengths on the image, with those of angles where it is at infinity."""
        return angular(text) if self.in_angles else text

    def image_unit(self, unit: str) -> str:
        """Return a unit of lengths on the image, um or mm, or that of angles where it is at infinity."""
        return {"um": "urad", "mm": "mrad"}[unit] if self.in_angles else unit

    def of_sky(self, items: dict[str, Any]) -> dict[str, Any]:
        """Return entries of a summary that are angles on the sky: nothing where there is none."""
        return items if self.on_sky else {}

    def size_text(self, size: float, plate_scale: Any) -> str:
        """Return a size on the detector [m] as text: in micrometres and, on the sky, in arc seconds."""
        text = self.image_text(f"{size * 1e6:.3g} µm")
        return f'{text} = {size * arcseconds(plate_scale):.3g}"' if self.on_sky and not self.in_angles else text

    def _nanometres(self) -> str:
        """Return the wavelengths as titles of plots give them."""
        return ", ".join(f"{w * 1e9:.4g}" for w in self.wavelengths) + " nm"

    def _titled(self, figure: Figure, text: str) -> Figure:
        """Return a figure with a title that begins with the name of the telescope."""
        figure.suptitle(f"{plain_text(self.telescope)}: {text}", fontsize=11)
        return figure
