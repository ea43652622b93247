"""The classical Paul-Baker telescope, from its first-order layout and the third-order conditions.

A concave paraboloid M1 and a convex M2 that shares its focus make the light parallel again, in a beam narrower by
``m = R2 / R1``. A concave sphere M3, with its centre of curvature at the vertex of M2, brings it to a focus half-way
between M3 and M2. With positive radii and focal length ``f`` four Seidel sums vanish (see
docs/explanation/paul_baker.md)::

    f1 = f (1 - m),   R1 = 2 f1,   R2 = m R1,   R3 = R1 R2 / (R1 - R2) = 2 f1 m / (1 - m)
    k1 = -1,          k2 = -1 + (R2/R3)^3,      k3 = 0
    M1 to M2: f1 (1 - m),   M2 to M3: R3,   so M3 stands at z3 = f1 (1 - m) - R3

By default ``m = 2 - sqrt(3)``, which makes z3 = 0: primary and tertiary share their vertex, as the LSST's nearly do.

Sources: Paul, Revue d'Optique 14, 169 (1935); Baker, IEEE Trans. Aerosp. Electron. Syst. 5, 261 (1969); Willstrop,
MNRAS 216, 411 (1985); Wilson, Reflecting Telescope Optics I (2nd ed.), section 3.6.
"""

from __future__ import annotations

import math
from dataclasses import replace

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.units import require_within
from .aperture import Annulus, Circle
from .first_order import footprints
from .shapes.shape import Conic, Plane, Sphere
from .surface import Aperture, Interaction, Shape, Surface
from .telescope import VACUUM, Telescope

#: Least radius of the beam at the secondary over that at the primary.
_LEAST_COMPRESSION = 1e-3

COPLANAR = 2.0 - math.sqrt(3.0)


@check_arguments
def paul_baker(
    diameter: float = 8.4,
    focal_ratio: float = 4.0,
    *,
    beam_compression: float = COPLANAR,
    field_radius: float = math.radians(0.5),
) -> Telescope:
    """Design a flat-field Paul-Baker telescope with no third-order aberration but distortion.

    The derivation is in docs/explanation/paul_baker.md. Third order is all that is corrected: the fifth-order spherical
    aberration that is left goes as ``focal_ratio**-5``.

    Parameters
    ----------
    diameter : float
        Diameter of the primary, which is the stop [m].
    focal_ratio : float
        Focal length over diameter.
    beam_compression : float
        Ratio of beam heights on M2 and M1, between 0 and 1/2.
    field_radius : float
        Radius of the field that the mirrors are sized for [rad]. Light of every field that leaves the primary's annulus
        is caught; the hole of the primary clears the tertiary and the shadow of the secondary. Shadows that move with
        the field (of the detector, in the beam from M2 to M3) are not part of the model.

    Returns
    -------
    Telescope
        Prescription with M1, M2, M3 and a flat Detector.

    Raises
    ------
    DomainError
        If an argument is out of range, or the mirrors leave nothing of the primary.
    """
    require_within(diameter, "diameter", 1e-6, 1e3, "m")
    require_within(focal_ratio, "focal_ratio", 0.1, 1e6)
    require_within(field_radius, "field_radius", 1e-9, 1.5, "rad")
    if not _LEAST_COMPRESSION <= beam_compression < 0.5:
        raise DomainError(f"beam_compression = {beam_compression!r}: expected {_LEAST_COMPRESSION:g} to 0.5")
    m = beam_compression
    focal_length = focal_ratio * diameter
    f1 = focal_length * (1 - m)
    r1, r2, r3 = 2 * f1, 2 * m * f1, 2 * f1 * m / (1 - m)
    # R2/R3 = 1 - m.
    k2 = -1 + (1 - m) ** 3
    z2 = f1 * (1 - m)
    # In the default layout this is zero; the subtraction would leave rounding errors.
    z3 = 0.0 if m == COPLANAR else z2 - r3
    radius = 0.5 * diameter

    def mirror(name: str, shape: Shape, z: float, aperture: Aperture | None = None) -> Surface:
        return Surface(name, Interaction.MIRROR, shape, (0.0, 0.0, z), VACUUM, aperture)

    bare = Telescope(
        name="paul_baker",
        description=f"Classical three-mirror Paul-Baker telescope with a flat field, {diameter:g} m, f/{focal_ratio:g}",
        source="derived from the third-order conditions; derivation in docs/explanation/paul_baker.md",
        version="1",
        surfaces=(
            mirror("M1", Conic(r1, -1.0), 0.0),
            # Light comes from below: its centre of curvature is on the far, upper side, so R > 0.
            mirror("M2", Conic(r2, k2), z2),
            mirror("M3", Sphere(r3), z3),
            Surface("Detector", Interaction.DETECTOR, Plane(), (0.0, 0.0, z3 + 0.5 * r3), VACUUM),
        ),
        # The plane of the primary's rim, so that a point of the pupil is a point of the mirror's rim.
        stop_z=radius**2 / (2 * r1),
        pupil_diameter=diameter,
        pupil_obscuration=0.0,
        launch_distance=z2 + diameter,
        reference_sphere_radius=0.5 * r3,
        field_radius=field_radius,
        field_limit=2 * field_radius,
        wavelength_range=(0.3e-6, 1.2e-6),
        default_wavelength=0.6e-6,
    )
    # Mirrors are 2 % larger than the paraxial footprint, for the aberrations of real rays.
    _, on_m2, on_m3 = (1.02 * float(r) for r in footprints(bare, field_radius))
    inner = max(on_m2, on_m3)
    if inner >= radius:
        raise DomainError(
            f"field_radius = {field_radius!r}: the tertiary needs {inner:.3f} m, the primary has {radius} m"
        )
    apertures: dict[str, Aperture] = {
        "M1": Annulus(inner, radius),
        "M2": Circle(on_m2),
        "M3": Circle(on_m3),
        "Detector": Circle(focal_length * math.tan(2 * field_radius)),
    }
    surfaces = tuple(replace(s, aperture=apertures[s.name]) for s in bare.surfaces)
    return replace(bare, surfaces=surfaces, pupil_obscuration=inner / radius)
