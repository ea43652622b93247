"""Solves of lens files for the paraxial axial ray, at the primary wavelength.

OSLO's ``PU`` makes the curvature of a surface such that the slope behind it is the stated one, ``PY``, and Zemax's
``MAZH``, the thickness such that the height at the next surface is. With heights y, slopes u and indices n, negative
behind an odd number of mirrors::

    n' u' = n u - y c (n' - n)        y_next = y + u' t
"""

from __future__ import annotations

from dataclasses import dataclass

from ....core.errors import PrescriptionError


@dataclass
class AxialRay:
    """Height [lens unit] and slope of the axial ray, and the index, in front of the next surface.

    Without the scale of the beam (`scaled` False) only heights of zero can be solved for.
    """

    height: float
    slope: float
    index: float
    scaled: bool = True

    def solved_curvature(self, slope: float, index_after: float) -> float:
        """Return the curvature of a surface that gives the ray a slope behind it."""
        power = self.height * (index_after - self.index)
        if not self.scaled or power == 0:
            raise PrescriptionError(f"PU {slope:g}: expected an axial ray of known height, and another medium behind")
        return (self.index * self.slope - index_after * slope) / power

    def pass_surface(self, curvature: float, index_after: float) -> None:
        """Refract or reflect the ray."""
        power = self.height * curvature * (index_after - self.index)
        self.slope = (self.index * self.slope - power) / index_after
        self.index = index_after

    def solved_thickness(self, height: float, keyword: str = "PY") -> float:
        """Return the distance at which the ray has a height; `keyword` is that of the solve, for messages."""
        if self.slope == 0 or (height != 0 and not self.scaled):
            raise PrescriptionError(
                f"{keyword} {height:g}: expected an axial ray of known height and a slope other than 0"
            )
        return (height - self.height) / self.slope

    def advance(self, thickness: float) -> None:
        """Go on to the next surface."""
        self.height += self.slope * thickness
