"""Singlet, cemented doublet and Cooke triplet: thin-lens starts, bent until third-order sums vanish.

The curvatures are those at which exact Seidel and chromatic sums of the thick lens vanish, found from a start:

- singlet: the focal length, and coma with the stop at the lens (thin: shape factor ``(2 n^2 - n - 1) / (n + 1)``);
- cemented doublet: the focal length, axial colour between F and C, and spherical aberration; thin powers are
  ``V1 / (V1 - V2)`` and ``-V2 / (V1 - V2)`` of the whole (Born & Wolf, Principles of Optics, section 4.7);
- triplet: the focal length, both colours, spherical aberration, coma, astigmatism, distortion and a Petzval sum of 0.35
  of the power, by six curvatures and two spaces (Kingslake & Johnson, Lens Design Fundamentals, 2nd ed., chapter 14).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ...core.arguments import check_arguments
from ..aperture import Circle
from ..first_order import chromatic_sums, first_order, footprints, seidel_sums
from ..io.glass_catalogue import GlassCatalogue
from ..media.medium import Medium
from ..shapes.shape import Plane, Sphere
from ..surface import Surface
from ..telescope import VACUUM, Telescope
from .centred import LINES, centred, cleared, detector, focused, interface, require_design, solved

SOURCE = "thin-lens start; curvatures at which sums of third order vanish"
#: Petzval sum of the triplet over its power: a flatter field needs steeper surfaces.
_PETZVAL = 0.35
#: Start of the triplet at focal length 1: a usual form with SK16 outside and F2 inside.
_TRIPLET = np.array([2.27, -0.11, -2.25, 2.46, 0.63, -2.72, 0.12, 0.095])
_TRIPLET_GLASS = (0.065, 0.02, 0.059)


def _lens(
    name: str,
    description: str,
    curvatures: Sequence[float],
    gaps: Sequence[float],
    glasses: Sequence[Medium],
    stop: int,
    *,
    diameter: float,
    field_radius: float,
) -> Telescope:
    """Return a lens: curvatures [1/m] and distances [m] along the light, medium behind each surface, and its stop.

    The stop is at a surface, counted from 0; the pupil's diameter [m] is that in front.
    """
    heights = -np.concatenate([[0.0], np.cumsum(gaps)])
    surfaces: list[Surface] = []
    for i, (c, z, medium) in enumerate(zip(curvatures, heights, glasses, strict=True)):
        surfaces.append(interface(f"S{i + 1}", Sphere(-1.0 / c) if c else Plane(), float(z), medium))
    return centred(
        name,
        description,
        SOURCE,
        (*surfaces, detector(float(heights[-1]) - 1.0)),
        stop_z=_entrance_pupil(curvatures, gaps, glasses, stop),
        pupil_diameter=diameter,
        field_radius=field_radius,
        wavelength_range=(0.4e-6, 0.8e-6),
    )


def _entrance_pupil(curvatures: Sequence[float], gaps: Sequence[float], glasses: Sequence[Medium], stop: int) -> float:
    """Return the height [m] of the image of the vertex of surface `stop` by those in front, first vertex at 0."""
    index = [1.0, *(float(g.index(LINES[1])) for g in glasses)]
    h, u = 0.0, 1.0
    for i in reversed(range(stop)):
        h -= u * gaps[i]
        u = (index[i + 1] * u + h * curvatures[i] * (index[i + 1] - index[i])) / index[i]
    return h / u


def _relative(telescope: Telescope) -> np.ndarray:
    """Return five Seidel and two chromatic sums over the largest contribution of a surface to each."""
    sums = seidel_sums(telescope), chromatic_sums(telescope, (LINES[0], LINES[2]))
    return np.concatenate([s.total / np.abs(s.contributions).max(axis=0).clip(1e-300) for s in sums])


def _finished(telescope: Telescope, stop: int) -> Telescope:
    """Return a lens in focus with clear apertures; that of the stop passes the light on the axis."""
    focused_lens = focused(telescope)
    name = f"S{stop + 1}"
    return cleared(focused_lens, **{name: Circle(1.02 * float(footprints(focused_lens, 0.0)[stop]))})


@check_arguments
def singlet(diameter: float = 0.02, f_number: float = 10.0, *, field_radius: float = math.radians(1.0)) -> Telescope:
    """Design a lens of N-BK7 without coma of third order, its stop at its front.

    Parameters
    ----------
    diameter : float
        Diameter of the entrance pupil [m].
    f_number : float
        Focal ratio.
    field_radius : float
        Radius of the field [rad].

    Raises
    ------
    DomainError
        If a number is out of range, or there is no such lens.
    """
    require_design(diameter, f_number, field_radius)
    f = f_number * diameter
    glass = GlassCatalogue.bundled()["N-BK7"]
    n = float(glass.index(LINES[1]))
    thickness = 0.05 * diameter + 0.25 * diameter**2 / f

    def built(shape: np.ndarray) -> Telescope:
        title = f"Singlet without coma, {diameter * 1e3:g} mm, f/{f_number:g}"
        options = {"diameter": diameter, "field_radius": field_radius}
        return _lens("singlet", title, list(shape / f), [thickness], [glass, VACUUM], 0, **options)

    def residuals(shape: np.ndarray) -> np.ndarray:
        telescope = built(shape)
        return np.array([first_order(telescope).focal_length / f - 1.0, _relative(telescope)[1]])

    # c1 - c2 = 1 / (f (n - 1)), and the shape factor (c1 + c2) / (c1 - c2) that makes coma vanish.
    difference, factor = 1.0 / (n - 1.0), (2.0 * n * n - n - 1.0) / (n + 1.0)
    start = [0.5 * difference * (factor + 1.0), 0.5 * difference * (factor - 1.0)]
    return _finished(built(solved(residuals, start, f"f_number = {f_number!r}")), 0)


@check_arguments
def doublet(diameter: float = 0.05, f_number: float = 8.0, *, field_radius: float = math.radians(1.0)) -> Telescope:
    """Design a cemented achromat of N-BK7 and F2, without axial colour and spherical aberration of third order.

    Parameters
    ----------
    diameter : float
        Diameter of the entrance pupil [m].
    f_number : float
        Focal ratio.
    field_radius : float
        Radius of the field [rad].

    Raises
    ------
    DomainError
        If a number is out of range, or there is no such lens.
    """
    require_design(diameter, f_number, field_radius)
    f = f_number * diameter
    glasses = [GlassCatalogue.bundled()[name] for name in ("N-BK7", "F2")]
    gaps = [0.08 * diameter + 0.35 * diameter**2 / f, 0.06 * diameter]

    def built(shape: np.ndarray) -> Telescope:
        title = f"Cemented achromat, {diameter * 1e3:g} mm, f/{f_number:g}"
        options = {"diameter": diameter, "field_radius": field_radius}
        return _lens("doublet", title, list(shape / f), gaps, [*glasses, VACUUM], 0, **options)

    def residuals(shape: np.ndarray) -> np.ndarray:
        telescope = built(shape)
        sums = _relative(telescope)
        return np.array([first_order(telescope).focal_length / f - 1.0, sums[0], sums[5]])

    (n1, v1), (n2, v2) = map(_abbe, glasses)
    # An equiconvex crown to begin with.
    c1 = 0.5 * v1 / (v1 - v2) / (n1 - 1.0)
    start = [c1, -c1, -c1 + v2 / (v1 - v2) / (n2 - 1.0)]
    return _finished(built(solved(residuals, start, f"f_number = {f_number!r}")), 0)


@check_arguments
def triplet(diameter: float = 0.01, f_number: float = 5.0, *, field_radius: float = math.radians(15.0)) -> Telescope:
    """Design a Cooke triplet of N-SK16 and F2, its stop at the back of the negative lens.

    Third-order aberrations vanish but for a Petzval sum of 0.35 of the power.

    Parameters
    ----------
    diameter : float
        Diameter of the entrance pupil [m].
    f_number : float
        Focal ratio.
    field_radius : float
        Radius of the field [rad].

    Raises
    ------
    DomainError
        If a number is out of range.
    """
    require_design(diameter, f_number, field_radius)
    f = f_number * diameter
    crown, flint = (GlassCatalogue.bundled()[name] for name in ("N-SK16", "F2"))
    media = [crown, VACUUM, flint, VACUUM, crown, VACUUM]

    def built(shape: np.ndarray, scale: float) -> Telescope:
        first, second, third = _TRIPLET_GLASS
        gaps = scale * np.array([first, shape[6], second, shape[7], third])
        title = f"Cooke triplet, {diameter * 1e3:g} mm, f/{f_number:g}"
        options = {"diameter": scale / f_number, "field_radius": field_radius}
        return _lens("triplet", title, list(shape[:6] / scale), list(gaps), media, 3, **options)

    def residuals(shape: np.ndarray) -> np.ndarray:
        telescope = built(shape, 1.0)
        sums = _relative(telescope)
        lagrange = 0.5 / f_number * math.tan(field_radius)
        petzval = float(seidel_sums(telescope).total[3]) / lagrange**2
        power = 1.0 / first_order(telescope).focal_length
        return np.array([power - 1.0, petzval - _PETZVAL, *sums[:3], *sums[4:]])

    return _finished(built(solved(residuals, list(_TRIPLET), "triplet"), f), 3)


def _abbe(glass: Medium) -> tuple[float, float]:
    """Return index at the d line and Abbe number of a glass."""
    blue, middle, red = (float(glass.index(w)) for w in LINES)
    return middle, (middle - 1.0) / (blue - red)
