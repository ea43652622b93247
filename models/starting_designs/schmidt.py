"""The Schmidt camera: a sphere, and at its centre of curvature an aspheric plate that takes its spherical aberration.

With the stop at the centre of curvature of the mirror every chief ray is an axis of it, so there is neither coma nor
astigmatism; the image is a sphere about the same centre. The plate is flat in front, and behind it has the height
``a4 (r^4 - 3/2 r_0^2 r^2)``, whose neutral zone lies at 0.866 of its radius r_0, where it has the least colour
(Schroeder, Astronomical Optics, 2nd ed., section 7.2); a4 follows from the first Seidel sum.
"""

from __future__ import annotations

import math
from dataclasses import replace

from ...core.arguments import check_arguments
from ..aperture import Circle
from ..first_order import seidel_sums
from ..io.glass_catalogue import GlassCatalogue
from ..shapes.shape import EvenAsphere, Plane, Sphere
from ..telescope import VACUUM, Telescope
from .centred import centred, cleared, detector, focused, interface, mirror, require_design

#: Thickness of the plate over its diameter.
_THICKNESS = 0.03
_STEPS = 30


@check_arguments
def schmidt(diameter: float = 0.5, f_number: float = 2.5, *, field_radius: float = math.radians(2.5)) -> Telescope:
    """Design a Schmidt camera.

    Parameters
    ----------
    diameter : float
        Diameter of the plate, which is the stop [m].
    f_number : float
        Focal ratio.
    field_radius : float
        Radius of the field that the mirror is sized for [rad].

    Returns
    -------
    Telescope
        Prescription with Plate_front, Plate_back, M1 and a spherical Detector; the detector's shadow is left out.

    Raises
    ------
    DomainError
        If a number is out of range.
    """
    require_design(diameter, f_number, field_radius)
    f, rim = f_number * diameter, 0.5 * diameter
    thickness, center = _THICKNESS * diameter, 2.0 * f
    glass = GlassCatalogue.bundled()["N-BK7"]

    def built(a4: float) -> Telescope:
        a2 = -1.5 * rim**2 * a4
        plate = EvenAsphere(0.5 / a2 if a2 else math.inf, 0.0, (a4,))
        surfaces = (
            interface("Plate_front", Plane(), center + thickness, glass),
            interface("Plate_back", plate, center, VACUUM),
            mirror("M1", Sphere(2.0 * f), 0.0),
            detector(f),
        )
        # The stop is the back of the plate; through the front it appears nearer.
        index = float(glass.index(587.5618e-9))
        return centred(
            "schmidt",
            f"Schmidt camera, {diameter:g} m, f/{f_number:g}; its focal surface is a sphere",
            "Schroeder, Astronomical Optics (2nd ed.), section 7.2",
            surfaces,
            stop_z=center + thickness * (1.0 - 1.0 / index),
            pupil_diameter=diameter,
            field_radius=field_radius,
            wavelength_range=(0.35e-6, 1.1e-6),
        )

    # The first sum is linear in a4 but for the weak curvature of the plate.
    a4 = 0.0
    for _ in range(_STEPS):
        step = 1e-3 / (4.0 * (2.0 * f) ** 3)
        spherical, spherical_beside = (float(seidel_sums(built(a), field=1e-6).total[0]) for a in (a4, a4 + step))
        a4 -= spherical * step / (spherical_beside - spherical)
    telescope = focused(built(a4), lambda z: detector(z, Sphere(center - z)))
    return replace(cleared(telescope, Plate_back=Circle(rim * 1.001)), groups={"Plate": ("Plate_front", "Plate_back")})
