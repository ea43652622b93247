"""Ghosts: light reflected twice inside the optics, and how bright it is on the detector beside the star itself.

Every pair of lens surfaces, and every lens surface with the detector, makes a ghost of its own
(:mod:`~.ghost_paths`). Reflectivities are Fresnel's for bare glass at the angle of each ray, mean of both
polarisations, or those of coatings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import uniform_filter

from ...core.errors import DomainError, unknown_name
from ...models.surface import Interaction
from ...models.telescope import Telescope
from ...raytrace.pack.surfaces import refractive_indices
from ...raytrace.rays import Rays, RayStatus, launch_rays
from ...raytrace.trace import trace
from ...wavefront.bundles import trace_bundles
from ...wavefront.pupil_sampling import spiral_annulus
from ...wavefront.request import field_points, wavelength_points
from .ghost_paths import GhostPath, fresnel_reflectivity, ghost_pairs, ghost_path
from .principal_rays import principal_rays

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_RAYS = 40000
#: Rays in each cell that the irradiance of a ghost is taken from, on average.
_RAYS_PER_CELL = 40
#: Share of a ghost's light that its place and size are taken from.
_CORE = 0.98
#: Cells across the map of all ghosts.
_MAP = 160
#: Field of the star where none is given, over the radius of the field of view.
_FIELD = 0.5
DETECTOR_REFLECTIVITY = 0.15


@dataclass(frozen=True)
class Ghost:
    """One ghost of a star.

    Attributes
    ----------
    first, second : str
        The surfaces that reflect it, in that order.
    flux : float
        Its light, over that of the star's own image.
    peak : float
        Largest irradiance, over the light of the star's own image [1/m^2].
    centroid : ndarray, shape [2]
        Middle of its light, x and y of the detector [m]; stray rays, the outermost 2 % of the light, left out here and
        below.
    diameter : float
        Diameter of the circle about that middle that holds its rays [m].
    focus : float
        Height above the detector at which it is smallest [m]; NaN where its rays are parallel.
    irradiance : ndarray, shape [n, n]
        Irradiance over the light of the star's own image [1/m^2], [y, x].
    edges : ndarray, shape [2, n + 1]
        Edges of its cells along x and along y [m].
    """

    first: str
    second: str
    flux: float
    peak: float
    centroid: np.ndarray
    diameter: float
    focus: float
    irradiance: np.ndarray
    edges: np.ndarray


@dataclass(frozen=True)
class Ghosts:
    """All ghosts of a star that two reflections make, the brightest irradiance first.

    Attributes
    ----------
    telescope : str
        Name of the telescope.
    field : ndarray, shape [2]
        Field angles of the star [rad].
    wavelength : float
        Vacuum wavelength [m].
    detector_reflectivity : float
        Part of the light that the detector reflects.
    ghosts : tuple of Ghost
        The ghosts.
    star : ndarray, shape [2]
        Where the star's own image is, x and y of the detector [m].
    irradiance : ndarray, shape [n, n]
        Irradiance of all ghosts together over the light of the star's own image [1/m^2], [y, x].
    edges : ndarray, shape [n + 1]
        Edges of its cells along either axis [m].
    image_radius : float
        Distance of the edge of the field of view from its middle, on the detector [m].
    plate_scale : float
        Angle on the sky over length on the detector at the star [rad/m].
    """

    telescope: str
    field: np.ndarray
    wavelength: float
    detector_reflectivity: float
    ghosts: tuple[Ghost, ...]
    star: np.ndarray
    irradiance: np.ndarray
    edges: np.ndarray
    image_radius: float
    plate_scale: float

    @property
    def flux(self) -> float:
        """Light of all ghosts together over that of the star's own image."""
        return sum(g.flux for g in self.ghosts)

    @property
    def magnitudes(self) -> np.ndarray:
        """Peak irradiance of each ghost in magnitudes per square arc second, the star's own magnitude being 0."""
        square_arcsec = (np.deg2rad(1.0 / 3600.0) / self.plate_scale) ** 2
        with np.errstate(divide="ignore"):
            return -2.5 * np.log10(np.array([g.peak for g in self.ghosts]) * square_arcsec)

    def summary(self) -> dict[str, Any]:
        """Return the figures by name, units in the names; lists run over the ghosts, the brightest first."""
        return {
            "telescope": self.telescope,
            "field_deg": np.rad2deg(self.field),
            "wavelength_nm": self.wavelength * 1e9,
            "detector_reflectivity": self.detector_reflectivity,
            "star_mm": self.star * 1e3,
            "total_flux": self.flux,
            "first": [g.first for g in self.ghosts],
            "second": [g.second for g in self.ghosts],
            "flux": np.array([g.flux for g in self.ghosts]),
            "peak_per_mm2": np.array([g.peak for g in self.ghosts]) * 1e-6,
            "peak_magnitudes_per_arcsec2": self.magnitudes,
            "diameter_mm": np.array([g.diameter for g in self.ghosts]) * 1e3,
            "centroid_mm": np.array([g.centroid for g in self.ghosts]).reshape(-1, 2) * 1e3,
            "focus_mm": np.array([g.focus for g in self.ghosts]) * 1e3,
        }

    def plot(self) -> Figure:
        """Draw the irradiance of all ghosts on the detector, and the brightest of them in order."""
        from ..plots.ghosts import ghosts_figure

        return ghosts_figure(self)


def ghosts(
    telescope: Telescope,
    field: Any = None,
    wavelength: Any = None,
    *,
    reflectivity: float | Mapping[str, float] | None = None,
    detector_reflectivity: float = DETECTOR_REFLECTIVITY,
    rays: int = _RAYS,
    projection: str = "zemax",
    threads: int | None = None,
    advance: Callable[[], None] | None = None,
) -> Ghosts:
    """Trace every ghost of a star that two reflections make.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    field : (tx, ty), optional
        Field angles of the star [rad] or Quantities; half-way to the edge of the field along +y by default.
    wavelength : float or Quantity, optional
        Vacuum wavelength [m]; the telescope's own by default.
    reflectivity : float or mapping of str to float, optional
        Reflectivity of the lens surfaces at every angle, one for all or by name; where none is given that of bare
        glass.
    detector_reflectivity : float
        Part of the light that the detector reflects.
    rays : int
        Rays of the star in the entrance pupil.
    projection : {"zemax", "gnomonic", "postel"}
        Meaning of the field angles.
    threads : int, optional
        Number of threads; all processors by default.
    advance : callable, optional
        Called after each pair of surfaces.

    Raises
    ------
    UnknownNameError
        If a reflectivity is given for a surface that does not exist.
    DomainError
        If something is out of range, no surface can make a ghost, or the star itself does not reach the detector.
    """
    if int(rays) != rays or rays < 400:
        raise DomainError(f"rays = {rays!r}: expected a whole number of at least 400")
    (point,) = field_points(telescope, [0.0, _FIELD * telescope.field_radius] if field is None else [field])
    (w,) = wavelength_points(telescope, wavelength)
    coatings = _Coatings(telescope, reflectivity, detector_reflectivity)
    pairs = ghost_pairs(telescope)
    if not pairs:
        raise DomainError(
            f"{telescope.name}: expected at least one lens surface and another, or a detector, for ghosts"
        )
    pupil = spiral_annulus(0.5 * telescope.pupil_diameter, telescope.pupil_obscuration, int(rays)).points
    start = launch_rays(telescope, (point[0], point[1]), w, (pupil[:, 0], pupil[:, 1]), projection)
    nothing = GhostPath("", "", telescope, tuple(range(len(telescope.surfaces))), (False,) * len(telescope.surfaces))
    image = _follow(nothing, start, coatings, threads)
    if not image.weight.sum() > 0:
        raise DomainError(
            f"field = ({_degrees(point)}) deg: the star does not reach the detector; expected a lit pupil"
        )
    direct = float(image.weight.sum())
    star = np.average(image.position, axis=0, weights=image.weight)
    landings = []
    for first, second in pairs:
        landings.append(_follow(ghost_path(telescope, first, second), start, coatings, threads))
        if advance is not None:
            advance()
    rim = trace_bundles(
        telescope,
        telescope.field_radius * np.array([[0.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 0.0]]),
        float(w),
        np.zeros((1, 2)),
        projection,
        threads,
    ).chief_landing()
    found = [_measure(landing, direct) for landing in landings if landing.weight.sum() > 0]
    # Where no ray from the edge of the field arrives, the map shows the ghosts whole.
    radius = float(np.nanmax(np.linalg.norm(rim, axis=-1), initial=0.0)) or max(
        (g.diameter for g in found), default=1.0
    )
    edges = np.linspace(-1.1 * radius, 1.1 * radius, _MAP + 1)
    together = np.zeros((_MAP, _MAP))
    for landing in landings:
        together += _irradiance(landing, edges, edges) / direct
    scale = principal_rays(telescope, point[None], w, projection=projection, threads=threads).mean_plate_scale
    return Ghosts(
        telescope=telescope.name,
        field=point,
        wavelength=float(w),
        detector_reflectivity=float(detector_reflectivity),
        ghosts=tuple(sorted(found, key=lambda g: (-g.peak, g.first, g.second))),
        star=star,
        irradiance=together,
        edges=edges,
        image_radius=radius,
        plate_scale=float(scale[0]),
    )


class _Coatings:
    """Reflectivity of every surface that is no mirror."""

    def __init__(self, telescope: Telescope, given: float | Mapping[str, float] | None, detector: float) -> None:
        lenses = [s.name for s in telescope.surfaces if s.interaction == Interaction.REFRACT]
        if isinstance(given, Mapping):
            for name in given:
                if name not in lenses:
                    raise unknown_name(f"lens surface of {telescope.name}", name, lenses)
            table = {name: float(value) for name, value in given.items()}
        else:
            table = {} if given is None else {name: float(given) for name in lenses}
        last = telescope.surfaces[-1]
        if last.interaction == Interaction.DETECTOR:
            table[last.name] = float(detector)
        for name, value in table.items():
            if not 0.0 <= value <= 1.0:
                raise DomainError(f"reflectivity of {name} = {value!r}: expected a number from 0 to 1")
        self._fixed = {i: table[s.name] for i, s in enumerate(telescope.surfaces) if s.name in table}

    def at(self, place: int, cosine: np.ndarray, before: float, after: float) -> np.ndarray:
        """Return the reflectivity for light on its way from one index into another."""
        if place in self._fixed:
            return np.full_like(cosine, self._fixed[place])
        return fresnel_reflectivity(cosine, before, after)


@dataclass(frozen=True)
class _Landing:
    """Rays of one way on the detector: places and directions in its own frame, and the light they bring."""

    path: GhostPath
    position: np.ndarray
    direction: np.ndarray
    weight: np.ndarray


def _follow(path: GhostPath, start: Rays, coatings: _Coatings, threads: int | None) -> _Landing:
    """Trace rays along one way, and what each surface leaves of their light."""
    telescope = path.telescope
    met = trace(telescope, start, "all", threads=threads)
    index = refractive_indices(telescope, start.wavelength)
    weight = (met[-1].status == RayStatus.OK).astype(np.float64)
    coming = start.direction
    for k, (surface, place) in enumerate(zip(telescope.surfaces, path.source, strict=True)):
        going = met[k].direction
        if path.reflecting[k]:
            # A mirror turns a ray by twice the cosine of incidence along the normal.
            cosine = 0.5 * np.linalg.norm(going - coming, axis=-1)
            # The medium on the other side is met on the other ways through this surface.
            weight *= coatings.at(place, cosine, index[k], _other_index(path, k, index))
        elif surface.interaction == Interaction.REFRACT:
            normal = index[k + 1] * going - index[k] * coming
            length = np.linalg.norm(normal, axis=-1)
            with np.errstate(invalid="ignore", divide="ignore"):
                # Between media of equal index there is no normal to be had, and nothing is reflected.
                cosine = np.where(length > 1e-12, (coming * normal).sum(axis=-1) / length, 1.0)
            weight *= 1.0 - coatings.at(place, cosine, index[k], index[k + 1])
        coming = going
    detector = telescope.surfaces[-1]
    lit = weight > 0
    return _Landing(
        path, detector.to_local(met[-1].position[lit])[:, :2], met[-1].direction[lit] @ detector.matrix, weight[lit]
    )


def _other_index(path: GhostPath, k: int, index: np.ndarray) -> float:
    """Return the index behind a surface that reflects: the way crosses the second one beforehand, the first later."""
    place = path.source[k]
    for other, met in enumerate(path.source):
        if met == place and other != k:
            # Of the two media there, the other one than that in which the light is reflected.
            return float(index[other + 1] if other > k else index[other])
    return float(index[k])


def _measure(landing: _Landing, direct: float) -> Ghost:
    # Rays that graze the detector may land anywhere: what counts is where most of the light is.
    around = np.median(landing.position, axis=0)
    core = _within(landing.position - around, landing.weight, _CORE)
    weight, position, direction = landing.weight[core], landing.position[core], landing.direction[core]
    centroid = np.average(position, axis=0, weights=weight)
    off = position - centroid
    slope = direction[:, :2] / direction[:, 2:]
    slope = slope - np.average(slope, axis=0, weights=weight)
    along, spread = (float(np.average((a * slope).sum(axis=-1), weights=weight)) for a in (off, slope))
    cells = max(3, int(np.sqrt(len(weight) / _RAYS_PER_CELL)))
    half = np.maximum(np.abs(off).max(axis=0), 1e-9 * (1.0 + np.abs(centroid))) * (1.0 + 1e-6)
    edges = centroid[:, None] + half[:, None] * np.linspace(-1.0, 1.0, cells + 1)
    irradiance = _irradiance(landing, *edges) / direct
    return Ghost(
        first=landing.path.first,
        second=landing.path.second,
        flux=float(landing.weight.sum()) / direct,
        # Of nine cells together, for a cell alone has a tenth too many or too few rays.
        peak=float(uniform_filter(irradiance, 3, mode="constant").max()),
        centroid=centroid,
        diameter=2.0 * float(np.linalg.norm(off, axis=-1).max()),
        focus=-along / spread if spread > 1e-18 else float("nan"),
        irradiance=irradiance,
        edges=edges,
    )


def _within(off: np.ndarray, weight: np.ndarray, share: float) -> np.ndarray:
    """Return which rays lie in the circle about the origin that holds a share of the light."""
    distance = np.linalg.norm(off, axis=-1)
    order = np.argsort(distance, kind="stable")
    held = np.cumsum(weight[order])
    return distance <= distance[order][np.searchsorted(held, share * held[-1])]


def _irradiance(landing: _Landing, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the light per area in cells of given edges, [y, x]."""
    light, _, _ = np.histogram2d(landing.position[:, 1], landing.position[:, 0], bins=[y, x], weights=landing.weight)
    return light / np.outer(np.diff(y), np.diff(x))


def _degrees(field: np.ndarray) -> str:
    return "{:.6g}, {:.6g}".format(*np.rad2deg(field))
