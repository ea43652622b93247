"""First-order properties and Seidel sums of a centred telescope, from a paraxial trace.

Flat folding mirrors cost nothing: the telescope is first unfolded about them (:mod:`pachon.models.unfolding`). Then
``s`` runs with the incoming light (``s = -z``), so a thickness is negative after an odd number of mirrors, and so is
the index ``n``. At each surface of curvature ``c`` (along ``s``)::

    n' u' = n u - h c (n' - n)        h_next = h + u' t

Seidel sums follow Welford, "Aberrations of Optical Systems" (1986), chapter 8, with ``A = n (h c + u)`` of the marginal
ray, ``B`` the same of the chief ray, ``H = n (u hb - ub h)`` and the aspheric term ``a = k c^3 + 8 a_4``. Of shapes
without symmetry of revolution the mean over azimuth counts; but the first-order properties of cylinders and toroids are
those of the plane x = 0, like Zemax's, or of the plane y = 0 where all surfaces are flat there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.plotting import BLUE, RED, axes_at, styled
from ..core.point_plots import draw_bars
from ..core.result import Result, Values
from ..core.units import ARCSEC, angle, finite, length, metres
from .central_obscuration import central_obscuration
from .paraxial import require_on_axis
from .surface import Interaction
from .telescope import Telescope
from .unfolding import AxialSurface, unfolded_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class FirstOrder(Values):
    """First-order properties of a telescope.

    Heights count in the telescope frame; behind flat folding mirrors on the axis as it would go on without them, which
    is also how lengths are measured.

    Parameters
    ----------
    wavelength : float
        Vacuum wavelength [m].
    focal_length : float
        Effective focal length [m]; infinite, as are the places of the focus, where an afocal telescope has none.
    f_number : float
        Focal length over the diameter of the entrance pupil.
    back_focus : float
        From the last mirror or lens surface that is no fold to the paraxial focus, along the light [m].
    focus_z : float
        Height of the paraxial focus [m].
    plate_scale : float
        Angle on the sky over length at the focus [rad/m].
    entrance_pupil_z, exit_pupil_z : float
        Heights of the pupils [m]; infinite where the exit pupil is.
    entrance_pupil_diameter, exit_pupil_diameter : float
        Diameters of the pupils [m].
    effective_area : float
        Area of the entrance pupil less its obscuration [m^2].
    angular_magnification : float
        Slope of the chief ray behind the telescope over that in front of it, both along the light; of an afocal
        telescope its magnifying power, negative where the image is upside down. Infinite in a telecentric object space.
    image_z : float
        Height of the paraxial image of the object [m]: the focus of an object at infinity.
    magnification : float
        Height of that image over that of the object, 0 of one at infinity.
    working_f_number : float
        Of the light that makes it, 1/(2 n u): the focal ratio of an object at infinity.
    """

    wavelength: float
    focal_length: float
    f_number: float
    back_focus: float
    focus_z: float
    plate_scale: float
    entrance_pupil_z: float
    entrance_pupil_diameter: float
    exit_pupil_z: float
    exit_pupil_diameter: float
    effective_area: float
    angular_magnification: float
    image_z: float
    magnification: float
    working_f_number: float

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw pupils and paraxial focus along the axis, in the telescope frame."""
        pupils = {
            "entrance pupil": (self.entrance_pupil_z, self.entrance_pupil_diameter),
            "exit pupil": (self.exit_pupil_z, self.exit_pupil_diameter),
        }
        with styled():
            figure, axes = axes_at(ax, 6.4, 3.4)
            for (name, (z, diameter)), style in zip(pupils.items(), ("-", "--"), strict=True):
                if math.isfinite(z) and math.isfinite(diameter):
                    half = 0.5 * abs(diameter)
                    axes.plot([z, z], [-half, half], style, color=BLUE, linewidth=2.0, label=name)
            if math.isfinite(self.image_z):
                axes.plot(self.image_z, 0.0, "x", color=RED, label="paraxial focus")
            axes.axhline(0.0, color="0.6", linewidth=0.6)
            axes.set(xlabel="z [m]", ylabel="distance from the axis [m]")
            axes.legend()
            return figure

    @property
    def arcsec_per_um(self) -> float:
        """Plate scale in arc seconds for each micrometre."""
        return self.plate_scale / ARCSEC * 1e-6


@dataclass(frozen=True)
class SeidelSums(Result):
    """Seidel sums [m] of a telescope, surface by surface.

    The wavefront of a sum ``S`` at the rim of the pupil and field is S1/8 (spherical), S2/2 (coma), S3/2
    (astigmatism), (S3 + S4)/4 (field curvature), S5/2 (distortion).

    Parameters
    ----------
    names : tuple of str
        Mirrors and lens surfaces.
    contributions : ndarray, shape (n_surface, 5)
        Spherical aberration, coma, astigmatism, Petzval sum, distortion of each [m].
    """

    _table = ("names", "contributions")

    names: tuple[str, ...]
    contributions: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the five sums of the telescope as bars."""
        names = ["spherical", "coma", "astigmatism", "Petzval", "distortion"]
        return draw_bars(ax, names, 1e6 * self.total, "Seidel sum [um]")

    @property
    def total(self) -> np.ndarray:
        """Sums over the surfaces [m], shape (5,)."""
        return self.contributions.sum(axis=0)


@dataclass(frozen=True)
class ChromaticSums:
    """Chromatic sums [m] of a telescope between two wavelengths, surface by surface.

    At the rims of pupil and field the wavefront of the shorter wavelength differs from that of the longer one by C_L/2
    (axial colour, a defocus) and C_T (lateral colour, a tilt).

    Parameters
    ----------
    names : tuple of str
        Mirrors and lens surfaces.
    contributions : ndarray, shape (n_surface, 2)
        Axial and lateral colour of each [m].
    """

    names: tuple[str, ...]
    contributions: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """Sums over the surfaces [m], shape (2,)."""
        return self.contributions.sum(axis=0)


@dataclass(frozen=True)
class _Trace:
    """The marginal and a chief ray (last axis) at each surface: heights [m], slopes and indices on either side."""

    wavelength: float
    surfaces: tuple[AxialSurface, ...]
    curvature: np.ndarray
    n: np.ndarray
    n_after: np.ndarray
    h: np.ndarray
    u: np.ndarray
    u_after: np.ndarray


@check_arguments
def first_order(telescope: Telescope, wavelength: ArrayLike | None = None) -> FirstOrder:
    """Return the first-order properties of a centred telescope.

    Parameters
    ----------
    telescope : Telescope
        Prescription; its surfaces must share one axis, which flat mirrors may fold. Of others
        :func:`~pachon.models.parabasal_optics` has focal lengths and pupils in two planes.
    wavelength : float or Quantity, optional
        Vacuum wavelength [m]; the telescope's default where not given.

    Raises
    ------
    DomainError
        If no surface acts, one is decentred or tilted, the wavelength is not covered, or there is no focus.
    """
    radius = 0.5 * telescope.pupil_diameter
    trace = _trace(telescope, wavelength, 1.0, section=True)
    last = [i for i, surface in enumerate(trace.surfaces) if not surface.fold][-1]
    last_z = trace.surfaces[last].z
    n, (h, hb), (u, ub) = float(trace.n_after[last]), map(float, trace.h[last]), map(float, trace.u_after[last])
    power = -n * u / (abs(float(trace.n[0])) * radius)
    parallel = abs(power) * radius < 1e-9
    slope = _marginal(telescope)
    if parallel and not slope and not telescope.design_data.afocal:
        raise DomainError(
            f"telescope {telescope.name}: expected one with a focus, or afocal: true in its design data; its power is "
            f"{power:.3g} 1/m"
        )
    focal_length, to_focus = (math.inf, math.inf) if parallel else (1.0 / power, -h / u)
    to_pupil = -hb / ub if ub != 0 else math.inf
    marginal_trace = _trace(telescope, wavelength, 1.0, section=True, marginal=slope)
    behind = 0.0 if parallel and not slope else float(marginal_trace.u_after[last, 0])
    height = float(marginal_trace.h[last, 0])
    return FirstOrder(
        wavelength=trace.wavelength,
        focal_length=focal_length,
        f_number=focal_length / telescope.pupil_diameter,
        back_focus=math.copysign(to_focus, to_focus * n),
        focus_z=last_z - to_focus,
        plate_scale=power,
        entrance_pupil_z=telescope.stop_z,
        entrance_pupil_diameter=telescope.pupil_diameter,
        exit_pupil_z=last_z - to_pupil,
        exit_pupil_diameter=2 * abs(height + behind * to_pupil),
        effective_area=math.pi * radius**2 * (1 - central_obscuration(telescope) ** 2),
        # The chief ray has unit slope in front; along an axis that mirrors turn, slopes change their sign with it.
        angular_magnification=math.inf if telescope.design_data.telecentric else math.copysign(1.0, n) * ub,
        image_z=last_z + height / behind if behind else math.inf,
        magnification=float(marginal_trace.n[0]) * slope / (n * behind) if behind else math.inf,
        working_f_number=0.5 / abs(n * behind) if behind else math.inf,
    )


def footprints(telescope: Telescope, field: float, wavelength: ArrayLike | None = None) -> np.ndarray:
    """Return the paraxial radius [m] of the light of a field angle [rad] on each mirror and lens surface."""
    return np.abs(_trace(telescope, wavelength, np.tan(field), marginal=_marginal(telescope)).h).sum(axis=1)


@check_arguments
def seidel_sums(telescope: Telescope, wavelength: ArrayLike | None = None, field: float | None = None) -> SeidelSums:
    """Return the Seidel sums of a centred telescope; those of flat folding mirrors are zero.

    Parameters
    ----------
    telescope, wavelength
        As for :func:`first_order`.
    field : float, optional
        Field angle [rad] of the chief ray; the radius of the field of view where not given.

    Raises
    ------
    DomainError
        If no surface acts, one is decentred or tilted, or the wavelength is not covered.
    """
    slope = np.tan(telescope.field_radius if field is None else angle(field, "field"))
    trace = _trace(telescope, wavelength, float(finite(slope, "field")), marginal=_marginal(telescope))
    c, n, n2 = trace.curvature, trace.n, trace.n_after
    h, hb = trace.h.T
    u, ub = trace.u.T
    a, b = n * (h * c + u), n * (hb * c + ub)
    lagrange = n * (u * hb - ub * h)
    change = trace.u_after[:, 0] / n2 - u / n
    flat, square = 1 / n2 - 1 / n, 1 / n2**2 - 1 / n**2
    s1, s2, s3 = -(a**2) * h * change, -a * b * h * change, -(b**2) * h * change
    s4 = -(lagrange**2) * c * flat
    # This form of the fifth sum stays finite where the marginal ray meets the surface at right angles (a = 0).
    s5 = -(b**3) * h * square + b * hb * c * (2 * h * b - hb * a) * flat
    # Aspheric term k c^3 + 8 a_4 of each surface; along s it changes sign.
    aspheric = -8 * np.array([s.fourth_order for s in trace.surfaces]) * (n2 - n)
    from_aspheric = np.stack([h**4, h**3 * hb, h**2 * hb**2, np.zeros_like(h), h * hb**3]) * aspheric
    ideal = np.array([s.thin_lens is not None for s in trace.surfaces])
    contributions = np.where(ideal, 0.0, np.stack([s1, s2, s3, s4, s5]) + from_aspheric)
    return SeidelSums(tuple(s.name for s in trace.surfaces), contributions.T)


@check_arguments
def chromatic_sums(
    telescope: Telescope, wavelengths: ArrayLike | None = None, field: float | None = None
) -> ChromaticSums:
    """Return the chromatic sums of a centred telescope: Welford's C_L and C_T (chapter 10).

    Parameters
    ----------
    telescope : Telescope
        Prescription; its surfaces must share one axis, which flat mirrors may fold.
    field : float, optional
        Field angle of the chief ray [rad]; the radius of the field by default.
    wavelengths : array_like or Quantity, shape [2], optional
        Shortest and longest vacuum wavelength [m]; the edges of the band where not given. Rays are those of the
        telescope's default wavelength.

    Raises
    ------
    DomainError
        If no surface acts, one is decentred or tilted, or there are not two wavelengths that the telescope covers.
    """
    ends = metres(telescope.band if wavelengths is None else wavelengths, "wavelengths")
    if ends.shape != (2,):
        raise DomainError(f"wavelengths of shape {ends.shape}: expected the shortest and the longest")
    telescope.check_wavelength(ends)
    slope = np.tan(telescope.field_radius if field is None else angle(field, "field"))
    trace = _trace(telescope, None, float(finite(slope, "field")), marginal=_marginal(telescope))
    media = (telescope.medium_before, *(s.medium_after for s in trace.surfaces))
    # Dispersion over index is the same for light that goes back.
    relative = np.array([float(m.index(ends[0]) - m.index(ends[1])) for m in media]) / np.abs(
        [*trace.n[:1], *trace.n_after]
    )
    a, b = (trace.n[:, None] * (trace.h * trace.curvature[:, None] + trace.u)).T
    change = trace.h[:, 0] * np.diff(relative)
    return ChromaticSums(tuple(s.name for s in trace.surfaces), np.stack([a * change, b * change], axis=-1))


def paraxial_rays(telescope: Telescope, surface: str) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return the marginal and the chief ray behind a surface: a place z [m], the height there [m] and the slope.

    Slopes are along the light that enters. The marginal ray comes from the axis of the object through the rim of the
    entrance pupil, the chief ray has the slope of the edge of the field. DomainError as for :func:`first_order`.
    """
    rim, marginal = 0.5 * telescope.pupil_diameter, _marginal(telescope)
    chief = math.tan(telescope.field_radius)
    trace = _trace(telescope, None, chief, section=True, marginal=marginal)
    for acting_surface in trace.surfaces:
        # Solves move surfaces along z, which is not the axis behind a fold.
        require_on_axis(telescope.surface(acting_surface.name), telescope.name)
    names = telescope.surface_names
    acting = [i for i, s in enumerate(trace.surfaces) if names.index(s.name) <= names.index(surface)]
    if not acting:
        return (telescope.stop_z, rim, marginal), (telescope.stop_z, 0.0, chief)
    last = acting[-1]
    z = trace.surfaces[last].z
    (h, hb), (u, ub) = map(float, trace.h[last]), map(float, trace.u_after[last])
    return (z, h, u), (z, hb, ub)


def _marginal(telescope: Telescope) -> float:
    """Return the slope of the ray from the axis of the object to the rim of the entrance pupil; 0 from infinity."""
    return 0.5 * telescope.pupil_diameter / (telescope.object_distance - telescope.stop_z)


def _trace(
    telescope: Telescope, wavelength: ArrayLike | None, slope: float, *, section: bool = False, marginal: float = 0.0
) -> _Trace:
    """Trace the ray at the rim of the pupil, of slope `marginal`, and one through its centre with a slope.

    A telecentric chief ray comes from where the slope to the middle of the pupil leads. Curvatures are means over
    azimuth, or with ``section`` those in the plane x = 0 (y = 0 where all are flat there).
    """
    w = length(telescope.default_wavelength if wavelength is None else wavelength, "wavelength")
    telescope.check_wavelength(w)
    try:
        surfaces = unfolded_axis(telescope).surfaces
    except DomainError as error:
        raise error.followed_by("parabasal_optics serves telescopes that are not centred") from None
    if all(surface.fold for surface in surfaces):
        raise DomainError(f"telescope {telescope.name}: expected at least one mirror or lens surface")
    curvature = -np.array([s.curvature for s in surfaces])
    if section:
        along_x, along_y = -np.array([s.curvatures for s in surfaces]).T
        curvature = along_y if along_y.any() else along_x
    # In a telecentric object space the chief ray is parallel to the axis, at the height of the object.
    height = -slope * (telescope.object_distance - telescope.stop_z) if telescope.design_data.telecentric else 0.0
    h, u = np.array([0.5 * telescope.pupil_diameter, height]), np.array([marginal, 0.0 if height else slope])
    z, index = telescope.stop_z, float(telescope.medium_before.index(w))
    rows = []
    for surface, c in zip(surfaces, curvature, strict=True):
        mirror = surface.interaction == Interaction.MIRROR and not surface.fold
        glass = float(surface.medium_after.index(w))
        index_after = -index if mirror else np.copysign(glass, index)
        h = h + u * (z - surface.z)
        u_after = (index * u - h * c * (index_after - index)) / index_after
        if surface.thin_lens is not None:
            u_after = u_after - h / (surface.thin_lens.focal_length * index_after)
        rows.append((index, index_after, h, u, u_after))
        index, u, z = index_after, u_after, surface.z
    return _Trace(w, surfaces, curvature, *(np.array(v, dtype=np.float64) for v in zip(*rows, strict=True)))
