"""Diffraction gratings: straight grooves that deflect light into one order.

The grooves are where parallel planes, equally spaced and along the z axis of the surface, cut its shape. With the unit
vector ``g`` across these planes, ``lines`` of them a metre and the order ``m`` (Ludwig, JOSA 63, 1105 (1973))::

    n' d' = n d + m wavelength lines g + C N      directions before and behind; C follows from the unit length of d'
    path  = m wavelength lines (g . r)            added at the point r of the surface: one wavelength and order a groove

The first is conical diffraction for any direction of the light, and gives the component along the grooves no change.
An order exists where d' can have unit length; elsewhere it is evanescent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from ..core.arguments import check_arguments
from ..core.errors import PrescriptionError


@check_arguments
@dataclass(frozen=True)
class Grating:
    """Grooves of a surface, and the order of the light behind it.

    The component of a ray's direction across the grooves, ``(-sin angle, cos angle)`` in x and y of the surface, times
    the index grows by ``order`` wavelengths times the grooves per length, for mirrors and lens surfaces alike.

    Parameters
    ----------
    order : int
        Diffraction order; 0 reflects or refracts as if there were no grooves.
    lines_per_mm : float
        Grooves along a line across them in the plane of the vertex [1/mm].
    groove_angle : float
        Direction of the grooves, from the x axis of the surface towards y [rad]; 0 is along x.

    Raises
    ------
    PrescriptionError
        If the density is not positive, or the angle not finite.
    """

    order: int
    lines_per_mm: float
    groove_angle: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.lines_per_mm < math.inf:
            raise PrescriptionError(f"lines_per_mm = {self.lines_per_mm!r}: expected a positive number")
        if not math.isfinite(self.groove_angle):
            raise PrescriptionError(f"groove_angle = {self.groove_angle!r}: expected a finite number")

    def __str__(self) -> str:
        angle = math.degrees(self.groove_angle)
        turned = f", grooves at {angle:.6g}°" if angle else ""
        return f"grating, order {self.order}, {self.lines_per_mm:.8g} lines/mm{turned}"

    @property
    def across(self) -> tuple[float, float]:
        """Unit vector across the grooves, x and y of the surface."""
        return -math.sin(self.groove_angle) + 0.0, math.cos(self.groove_angle)

    @property
    def path_gradient(self) -> tuple[float, float]:
        """Gradient of the added path along x and y for each metre of wavelength [1/m]."""
        scale = 1e3 * self.lines_per_mm * self.order
        x, y = self.across
        return scale * x + 0.0, scale * y + 0.0

    def path_derivative(self, name: str) -> tuple[float, float]:
        """Return the derivative of `path_gradient` by "lines_per_mm" or "groove_angle"."""
        x, y = self.path_gradient
        return (x / self.lines_per_mm, y / self.lines_per_mm) if name == "lines_per_mm" else (-y, x)

    def rotated(self) -> Grating:
        """Return the grating in axes turned by half a turn about y, those of a lens file."""
        return replace(self, groove_angle=0.0 - self.groove_angle)
