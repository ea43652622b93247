"""Gratings of a Zemax file: grooves along the local x axis of a conic (DGRATING)."""

from __future__ import annotations

from dataclasses import replace

from ....core.errors import PrescriptionError, error_context
from ...aperture import Annulus, Circle
from ...rotation import rotation_matrix
from ...shapes.shape import Conic, Plane, Sphere
from ..lens.description import LensSurface
from ..lens.text import number_text, scaled
from .shapes import shape_lines


def with_grooves_along_x(surface: LensSurface) -> LensSurface:
    """Return the same surface with its own axes rotated about z such that its grooves are along x.

    PrescriptionError for an aperture that does not look the same in these axes.
    """
    grating = surface.grating
    if grating is None or grating.groove_angle == 0.0:
        return surface
    aperture = surface.aperture
    centred = isinstance(aperture, Circle | Annulus) and aperture.x == aperture.y == 0
    if aperture is not None and not centred:
        with error_context(subject=f"surface {surface.name}"):
            text = "grating: a Zemax file has grooves along x; expected a centred disc or ring as aperture"
            raise PrescriptionError(text)
    axes = surface.axes @ rotation_matrix([0.0, 0.0, grating.groove_angle])
    return replace(surface, axes=axes, grating=replace(grating, groove_angle=0.0))


def grating_lines(surface: LensSurface, unit: float) -> list[str]:
    """Return the lines TYPE, CURV, CONI and PARM of a grating; PrescriptionError unless it is a conic."""
    if not isinstance(surface.shape, Plane | Sphere | Conic) or surface.grating is None:
        raise PrescriptionError(f"grating on {type(surface.shape).__name__}: a Zemax file has gratings on conics alone")
    _, *conic = shape_lines(surface.shape, unit)
    numbers = f"PARM 1 {number_text(scaled(surface.grating.lines_per_mm, -3))}", f"PARM 2 {surface.grating.order}"
    return ["TYPE DGRATING", *conic, *numbers]
