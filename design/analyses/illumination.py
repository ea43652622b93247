"""Relative illumination: light on the detector against the field, by the projected solid angle of the exit pupil.

An extended source of one radiance L makes the irradiance ``L n^2 A`` on the detector, where A is the area that its rays
fill in direction cosines along the detector: the solid angle of the exit pupil, projected (Rimmer 1986, Proc. SPIE 655,
99). A is the integral of the Jacobian of the direction cosines over the lit entrance pupil. With a small pupil, a flat
image and no aberration of the pupil it goes as the fourth power of the cosine of the chief ray's angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE, GREY, ORANGE
from ...core.units import require_count
from ...models.telescope import Telescope
from ...wavefront.request import Request
from ..drawing import finish_axes
from .analysis import Analysis, Columns, field_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Distance of the rays of the Jacobian from theirs, in units of the radius of the pupil.
_STEP = 1e-4


@dataclass(frozen=True)
class RelativeIllumination(Analysis):
    """Irradiance of the detector by a uniform source, field by field.

    Attributes
    ----------
    solid_angle : ndarray, shape [n_field]
        Solid angle of the light on the detector, projected on it [sr], vignetting included.
    axis_solid_angle : float
        The same on the axis [sr].
    lit_fraction : ndarray, shape [n_field]
        Fraction of the area of the entrance pupil that is lit.
    chief_cosine : ndarray, shape [n_field]
        Cosine of the field angle.
    """

    solid_angle: np.ndarray
    axis_solid_angle: float
    lit_fraction: np.ndarray
    chief_cosine: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """Irradiance relative to the axis, shape [n_field]."""
        return self.solid_angle / self.axis_solid_angle

    @property
    def f_number(self) -> float:
        """Focal ratio in air of an unobscured cone of the solid angle on the axis."""
        return float(0.5 * np.sqrt(np.pi / self.axis_solid_angle))

    @property
    def _title(self) -> str:
        return f"relative illumination at {self._nanometres()}"

    def _columns(self) -> Columns:
        return self._field_columns() | {
            "relative_illumination": (self.relative, ""),
            "projected_solid_angle": (self.solid_angle, "sr"),
            "lit_fraction": (self.lit_fraction, ""),
        }

    def _values(self) -> dict[str, Any]:
        return {
            "relative_illumination": self.relative,
            "projected_solid_angle_sr": self.solid_angle,
            "lit_fraction": self.lit_fraction,
            "smallest_relative": float(self.relative.min()),
            "f_number_of_axis_cone": self.f_number,
        }

    def _draw(self, panels: Sequence[Axes]) -> None:
        (axes,) = panels
        angle = np.rad2deg(self.off_axis_angle)
        order = np.argsort(angle, kind="stable")
        axes.plot(angle[order], 100 * self.relative[order], color=BLUE, linewidth=1.6, label="relative illumination")
        lit = 100 * self.lit_fraction[order]
        axes.plot(angle[order], lit, "--", color=ORANGE, linewidth=1.0, label="lit part of the entrance pupil")
        fourth = 100 * self.chief_cosine[order] ** 4
        axes.plot(angle[order], fourth, ":", color=GREY, linewidth=1.0, label="cos⁴ of the field angle")
        top = max(102.0, 1.02 * float(100 * self.relative.max()))
        finish_axes(axes, xlim=(0, None), ylim=(0, top), xlabel="field [deg]", ylabel="[%]")
        axes.legend(loc="lower left")


@check_arguments
def relative_illumination(
    telescope: Telescope,
    fields: ArrayLike | None = None,
    wavelength: ArrayLike | None = None,
    *,
    n_pupil: int = 2000,
    projection: str = "zemax",
    threads: int | None = None,
) -> RelativeIllumination:
    """Trace the relative illumination of the detector.

    Parameters
    ----------
    telescope, wavelength, projection, threads
        As in :meth:`pachon.Request.of`.
    fields : array_like or Quantity, shape [n_field, 2], optional
        Field angles [rad]; a line from the axis along +y to the edge of the field of view by default.
    n_pupil : int
        Points of the pupil, at equal areas; the error of a vignetted pupil is about the inverse of it times ten.

    Raises
    ------
    DomainError
        If no light reaches the detector on the axis.
    """
    count = require_count(n_pupil, "n_pupil", 16, 10**6)
    line = field_line(telescope) if fields is None else fields
    request = Request.of(
        telescope, line, wavelength, sampling="spiral", n_pupil=count, projection=projection, threads=threads
    )
    everything = replace(request, fields=np.concatenate([np.zeros((1, 2)), request.fields]))
    solid, lit = [], []
    for field in everything.fields:
        area, fraction = _projected(replace(everything, fields=field[None]))
        solid.append(area)
        lit.append(fraction)
    if not solid[0] > 0:
        raise DomainError(f"telescope {telescope.name}: expected one with light on the axis; all of it is vignetted")
    cosine = -request.directions[:, 2]
    return RelativeIllumination(request, np.array(solid[1:]), solid[0], np.array(lit[1:]), cosine)


def _projected(request: Request) -> tuple[float, float]:
    """Return projected solid angle [sr] and lit fraction of one field."""
    telescope, sample = request.telescope, request.pupil
    radius = 0.5 * telescope.pupil_diameter
    lit = request.bundles(request.wavelength).lit[0]
    steps = _STEP * radius * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    around = (sample.points[lit, None] + steps).reshape(-1, 2)
    if not len(around):
        return 0.0, 0.0
    bundles = request.bundles(request.wavelength, around)
    cosines = bundles.direction[0, :, :2].reshape(-1, 4, 2) * bundles.index
    along_x, along_y = ((cosines[:, 2 * k] - cosines[:, 2 * k + 1]) / (2.0 * _STEP * radius) for k in range(2))
    jacobian = np.abs(along_x[:, 0] * along_y[:, 1] - along_x[:, 1] * along_y[:, 0])
    area = np.pi * radius**2 * (1.0 - telescope.pupil_obscuration**2)
    # A ray of the Jacobian beyond the rim of a steep surface has no direction: its neighbour stands in.
    known = np.isfinite(jacobian)
    fraction = float(sample.weights[lit].sum())
    mean = np.average(jacobian[known], weights=sample.weights[lit][known]) if known.any() else 0.0
    return area * fraction * float(mean), fraction
