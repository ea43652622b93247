"""Two-mirror telescopes and the Newtonian, from first-order layout and third-order conditions.

With m the focal ratio over that of the primary (negative for a Gregorian), the back focus b in focal lengths f1 of the
primary, behind its vertex, and the ratio k of the beam on the secondary to that on the primary::

    k = (1 + b) / (m + 1),   separation = (1 - k) f1,   R2 = R1 m k / (m - 1)

and the conic constants (Schroeder, Astronomical Optics, 2nd ed., section 6.2)::

    classical:        K1 = -1,                              K2 = -((m + 1) / (m - 1))^2
    Ritchey-Chretien: K1 = -1 - 2 (1 + b) / (m^2 (m - b)),  K2 = K2_classical - 2 m (m + 1) / ((m - b) (m - 1)^3)
    Dall-Kirkham:     K1 = -1 + k (m - 1) (m + 1)^2 / m^3,  K2 = 0
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ..aperture import Annulus, Circle, Complement
from ..first_order import footprints
from ..shapes.shape import Conic, Plane
from ..surface import Interaction, Surface
from ..telescope import VACUUM, Telescope
from .centred import CLEAR, centred, cleared, detector, focused, mirror, require_design

SOURCE = "third-order formulas of Schroeder, Astronomical Optics (2nd ed.), section 6.2"
Kind = Literal["ritchey-chretien", "cassegrain", "dall-kirkham", "gregorian"]
KINDS: tuple[Kind, ...] = ("ritchey-chretien", "cassegrain", "dall-kirkham", "gregorian")
_TITLES = {
    "ritchey-chretien": "Ritchey-Chretien telescope, without spherical aberration and coma of third order",
    "cassegrain": "Classical Cassegrain telescope",
    "dall-kirkham": "Dall-Kirkham telescope, its secondary a sphere",
    "gregorian": "Aplanatic Gregorian telescope, without spherical aberration and coma of third order",
}


@check_arguments
def two_mirror(
    kind: Kind = "ritchey-chretien",
    diameter: float = 1.0,
    f_number: float = 8.0,
    *,
    field_radius: float = math.radians(0.2),
    primary_f_number: float = 2.5,
    back_focus: float | None = None,
) -> Telescope:
    """Design a two-mirror telescope.

    Parameters
    ----------
    kind : {"ritchey-chretien", "cassegrain", "dall-kirkham", "gregorian"}
        Third-order condition; the Gregorian is aplanatic, as the Ritchey-Chretien.
    diameter : float
        Diameter of the primary, which is the stop [m].
    f_number, primary_f_number : float
        Focal ratio of the telescope and of its primary, which is the faster one.
    field_radius : float
        Radius of the field that the mirrors are sized for [rad].
    back_focus : float, optional
        Distance of the focus behind the vertex of the primary [m]; a quarter of the diameter by default.

    Returns
    -------
    Telescope
        Prescription with M1, M2 and a flat Detector.

    Raises
    ------
    DomainError
        If a number is out of range, or the mirrors leave nothing of the primary.
    """
    require_design(diameter, f_number, field_radius, primary_f_number=primary_f_number)
    if not primary_f_number < f_number:
        raise DomainError(f"primary_f_number = {primary_f_number!r}: expected below f_number = {f_number:g}")
    f1, radius = primary_f_number * diameter, 0.5 * diameter
    b = (0.25 * diameter if back_focus is None else back_focus) / f1
    m = f_number / primary_f_number * (-1.0 if kind == "gregorian" else 1.0)
    if not -1.0 < b < abs(m):
        raise DomainError(f"back_focus = {back_focus!r}: expected a distance behind the primary that the light reaches")
    k = (1.0 + b) / (m + 1.0)
    r1, r2, z2 = 2.0 * f1, 2.0 * f1 * m * k / (m - 1.0), (1.0 - k) * f1
    k1, k2 = -1.0, -(((m + 1.0) / (m - 1.0)) ** 2)
    if kind in ("ritchey-chretien", "gregorian"):
        k1 -= 2.0 * (1.0 + b) / (m**2 * (m - b))
        k2 -= 2.0 * m * (m + 1.0) / ((m - b) * (m - 1.0) ** 3)
    elif kind == "dall-kirkham":
        k1, k2 = -1.0 + k * (m - 1.0) * (m + 1.0) ** 2 / m**3, 0.0
    bare = centred(
        kind.replace("-", "_"),
        f"{_TITLES[kind]}, {diameter:g} m, f/{f_number:g}",
        SOURCE,
        (mirror("M1", Conic(r1, k1), 0.0), mirror("M2", Conic(r2, k2), z2), detector(-b * f1)),
        # The plane of the primary's rim, so that a point of the pupil is a point of the mirror's rim.
        stop_z=radius**2 / (2.0 * r1),
        pupil_diameter=diameter,
        field_radius=field_radius,
    )
    inner = CLEAR * float(footprints(bare, field_radius)[1])
    if inner >= radius:
        raise DomainError(
            f"field_radius = {field_radius!r}: the secondary needs {inner:.4g} m, the primary has {radius:g} m"
        )
    telescope = cleared(focused(bare), M1=Annulus(inner, radius))
    return replace(telescope, pupil_obscuration=inner / radius)


@check_arguments
def newtonian(diameter: float = 0.2, f_number: float = 5.0, *, field_radius: float = math.radians(0.5)) -> Telescope:
    """Design a Newtonian: a paraboloid, its focus unfolded, with the shadow of the flat mirror in front.

    Parameters
    ----------
    diameter : float
        Diameter of the primary, which is the stop [m].
    f_number : float
        Focal ratio.
    field_radius : float
        Radius of the field [rad].

    Returns
    -------
    Telescope
        Prescription with Diagonal (the shadow of the flat), M1 and a flat Detector at the prime focus.

    Raises
    ------
    DomainError
        If a number is out of range, or the flat covers the primary.
    """
    require_design(diameter, f_number, field_radius)
    f, radius = f_number * diameter, 0.5 * diameter
    # The focus stands a tenth of the diameter outside the tube.
    before = 0.6 * diameter
    half = before / (2.0 * f_number) + f * math.tan(field_radius)
    if half >= 0.9 * radius or before >= f:
        raise DomainError(f"f_number = {f_number!r}, field_radius = {field_radius!r}: the flat covers the primary")
    shadow = Surface("Diagonal", Interaction.PASS, Plane(), (0.0, 0.0, f - before), VACUUM, Complement(Circle(half)))
    telescope = centred(
        "newtonian",
        f"Newtonian telescope, {diameter:g} m, f/{f_number:g}, its path unfolded",
        "a paraboloid has no spherical aberration",
        (shadow, mirror("M1", Conic(2.0 * f, -1.0), 0.0, Circle(radius)), detector(f)),
        stop_z=radius**2 / (4.0 * f),
        pupil_diameter=diameter,
        field_radius=field_radius,
        pupil_obscuration=half / radius,
        launch_distance=f + diameter,
    )
    return focused(telescope)
