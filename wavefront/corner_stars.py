"""Stars on the wavefront sensors and guiders of a camera: field angles, heights, and the telescope of each star."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.point_plots import draw_points
from ..core.result import Result
from ..core.units import length, require_count
from ..models.camera.corner_rafts import CornerHeights, CornerKind, corner_focal_plane
from ..models.camera.focal_plane import FocalPlane
from ..models.telescope import Telescope
from .chief_rays import fields_at

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Most stars on a sensor: all of them are traced together.
_MOST = 100_000
# Least distance of stars from the rims of a sensor [m]: donuts are 0.6 mm wide to either side.
_MARGIN = 2e-3


@dataclass(frozen=True, eq=False)
class CornerStars(Result):
    """Stars on the sensors in the corners of the focal plane.

    Attributes
    ----------
    telescope : Telescope
        The telescope, with its detector in focus.
    focal_plane : FocalPlane
        The sensors, which carry the heights.
    sensors : tuple of str
        Name of the sensor of each star.
    positions : ndarray, shape [n_star, 2]
        Places on the detector [m].
    fields : ndarray, shape [n_star, 2]
        Field angles [rad], zemax projection.
    """

    _table = ("sensors", "positions", "fields", "heights")

    telescope: Telescope
    focal_plane: FocalPlane
    sensors: tuple[str, ...]
    positions: np.ndarray
    fields: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the places of the stars, coloured by the heights of the sensors there."""
        x, y = 1e3 * self.positions.T
        labels, height = ("x [mm]", "y [mm]"), 1e3 * self.heights
        return draw_points(ax, x, y, labels, color=height, color_label="height [mm]", equal=True)

    def __len__(self) -> int:
        return len(self.sensors)

    @property
    def heights(self) -> np.ndarray:
        """Heights of the sensors under the stars [m], positive behind the focus, shape [n_star]."""
        return self.focal_plane.height(*self.positions.T)

    def telescope_of(self, star: int) -> Telescope:
        """Return the telescope with its detector in the tangent plane of the sensor at a star.

        It images that star as the telescope with the focal plane of the sensors does.
        """
        detector = self.telescope.surfaces[-1]
        x, y = self.positions[star]
        slope_x, slope_y = self.focal_plane.gradient(x, y)
        point = detector.to_telescope([x, y, 0.0])
        shift = detector.matrix @ [0.0, 0.0, float(self.focal_plane.height(x, y))]
        tilt = (np.arctan(slope_y), -np.arctan(slope_x), 0.0)
        return self.telescope.perturbed(detector.name, shift=shift, tilt=tilt, about=point)


@check_arguments
def corner_stars(
    telescope: Telescope,
    *,
    kind: CornerKind = "wavefront",
    heights: CornerHeights = "nominal",
    n: int = 1,
    wavelength: ArrayLike | None = None,
) -> CornerStars:
    """Place stars on the wavefront sensors or guiders of the LSST camera.

    Parameters
    ----------
    telescope : Telescope
        Telescope with the detector in focus; its camera is the LSST's.
    kind : {"wavefront", "guider"}
        Kind of the sensors: eight of each. Wavefront sensors stand 1.5 mm behind (SW0) and in front of (SW1) the focus.
    heights : {"nominal", "lsstcam"}
        Heights of the sensors: nominal, or as measured.
    n : int
        Stars on each sensor: one at its middle, or ``n`` evenly along its diagonal, 2 mm and more from its rims.
    wavelength : float or Quantity, optional
        Vacuum wavelength of the chief rays [m]; the telescope's default if not given.

    Returns
    -------
    CornerStars
        Sensor by sensor, R00_SW0, R00_SW1, R04_SW0 and so on.

    Raises
    ------
    ConfigError
        If the kind or the heights are unknown.
    DomainError
        If ``n`` is not a whole number from 1 to 100 000, the wavelength is not positive, or a sensor lies outside the
        field of the telescope.
    """
    n = require_count(n, "n", 1, _MOST)
    light = telescope.default_wavelength if wavelength is None else length(wavelength, "wavelength")
    plane = corner_focal_plane(kind, heights)
    camera = plane.camera
    along = np.linspace(-1.0, 1.0, n)[:, None] if n > 1 else np.zeros((1, 1))
    inner = (camera.half_sizes[:, None] - _MARGIN) * along
    positions = np.stack(camera.from_local(np.arange(len(camera))[:, None], *np.moveaxis(inner, -1, 0)), axis=-1)
    positions = positions.reshape(-1, 2)
    sensors = tuple(name for name in camera.ccd_names for _ in range(n))
    fields = fields_at(telescope, positions, light)
    distance = float(np.hypot(*fields.T).max())
    if distance > telescope.field_limit * (1.0 + 1e-12):
        raise DomainError(
            f"sensors of the LSST camera up to {np.rad2deg(distance):.4g} deg from the axis: expected a telescope of "
            f"such a field; that of {telescope.name} ends at {np.rad2deg(telescope.field_limit):.4g} deg"
        )
    return CornerStars(telescope, plane, sensors, positions, fields)
