"""The layout of a telescope: its surfaces in section, cut to their apertures, and rays of some fields through it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from ..models.aperture import Annulus, Aperture, Circle, Complement, Intersection, Polygon, Rectangle, Union
from ..models.surface import Interaction, Surface
from ..models.telescope import Telescope
from ..raytrace.pack.surfaces import refractive_indices
from ..raytrace.rays import RayStatus, launch_rays
from ..raytrace.trace import trace
from ..wavefront.request import field_points, wavelength_points

if TYPE_CHECKING:
    import trimesh
    from matplotlib.figure import Figure

#: Rays of a field in section, on either side of the axis, and around the pupil in three dimensions.
_FAN, _SPOKES = 5, 12
#: Points of a surface in section.
_POINTS = 241
#: A medium of at least this index is drawn as glass.
_GLASS = 1.05
#: How far a surface without an aperture reaches beyond the light, and light beyond the telescope.
_BEYOND, _ABOVE = 1.03, 0.08
#: A baffle that blocks all around is drawn to this many times its clear radius.
_RIM = 1.12


@dataclass(frozen=True)
class Lens:
    """A piece of glass between two neighbouring surfaces.

    Attributes
    ----------
    name : str
        What the names of both surfaces have in common, or both names.
    front, back : str
        The surfaces, in the order that light meets them.
    index : float
        Refractive index of the glass.
    """

    name: str
    front: str
    back: str
    index: float


@dataclass(frozen=True)
class Layout:
    """A telescope as it is drawn.

    Attributes
    ----------
    telescope : Telescope
        The telescope.
    fields : ndarray, shape [n_field, 2]
        Field angles [rad].
    wavelength : float
        Vacuum wavelength [m].
    reach : dict of str to float
        Distance from its own z axis to which each surface is drawn [m].
    profiles : dict of str to ndarray, shape [n, 3]
        Each surface in its own section x = 0 [m], telescope frame; NaN breaks the line. Of baffles, what blocks.
    lenses : tuple of Lens
        Pieces of glass.
    fans : tuple of ndarray, shape [n_ray, n_point, 3]
        Rays of each field that arrive, through the points x = 0 of the pupil, from above the telescope on [m].
    bundles : tuple of ndarray, shape [n_ray, n_point, 3]
        The same of rays all around the pupil.
    """

    telescope: Telescope
    fields: np.ndarray
    wavelength: float
    reach: dict[str, float]
    profiles: dict[str, np.ndarray]
    lenses: tuple[Lens, ...]
    fans: tuple[np.ndarray, ...]
    bundles: tuple[np.ndarray, ...]

    @property
    def size(self) -> np.ndarray:
        """Extent along x, y and z of everything but the rays in front [m], shape [3]; x is that of y."""
        points = np.concatenate([p[np.isfinite(p).all(axis=1)] for p in self.profiles.values()])
        width, height = (float(v) for v in np.ptp(points[:, 1:], axis=0))
        return np.array([width, width, height])

    def summary(self) -> dict[str, Any]:
        """Return the figures by name, units in the names; lists run over the surfaces."""
        surfaces = self.telescope.surfaces
        return {
            "telescope": self.telescope.name,
            "wavelength_nm": self.wavelength * 1e9,
            "field_deg": np.rad2deg(self.fields),
            "extent_m": self.size,
            "surface": [s.name for s in surfaces],
            "interaction": [s.interaction.name.lower() for s in surfaces],
            "vertex_m": np.array([s.vertex for s in surfaces]),
            "drawn_radius_m": np.array([self.reach[s.name] for s in surfaces]),
            "lens": [lens.name for lens in self.lenses],
            "lens_index": np.array([lens.index for lens in self.lenses]),
            "obstruction": [o.name for o in self.telescope.obstructions],
            "rays_drawn": [len(fan) for fan in self.fans],
        }

    def plot(self) -> Figure:
        """Draw the section of the telescope with its rays and, where they are small beside it, its lenses."""
        from .plots.layout import layout_figure

        return layout_figure(self)

    def scene(self) -> trimesh.Scene:
        """Return mirrors, lenses, baffles, obstructions and rays as a scene of meshes [m], y up, for a GLB file."""
        from .layout_model import layout_scene

        return layout_scene(self)

    def glb(self) -> bytes:
        """Return the scene as a binary glTF file."""
        exported = self.scene().export(file_type="glb")
        assert isinstance(exported, bytes)
        return exported


def layout(
    telescope: Telescope,
    fields: Any = None,
    wavelength: Any = None,
    *,
    projection: str = "zemax",
    threads: int | None = None,
) -> Layout:
    """Lay a telescope out for drawing.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    fields : array_like or Quantity, shape [n_field, 2], optional
        Field angles [rad]; the axis and both edges of the field along y by default.
    wavelength : float or Quantity, optional
        Vacuum wavelength [m]; the telescope's own by default.
    projection : {"zemax", "gnomonic", "postel"}
        Meaning of the field angles.
    threads : int, optional
        Number of threads; all processors by default.

    Raises
    ------
    DomainError
        If a field or the wavelength is out of range.
    """
    edge = telescope.field_radius
    points = field_points(telescope, [[0.0, -edge], [0.0, 0.0], [0.0, edge]] if fields is None else fields)
    (w,) = wavelength_points(telescope, wavelength)
    lenses = _lenses(telescope, float(w))
    reach = _even_edges(telescope, lenses, _reaches(telescope, points, float(w), threads))
    profiles = {s.name: surface_section(s, reach[s.name]) for s in telescope.surfaces}
    heights = np.concatenate([p[:, 2] for p in profiles.values()])
    heights = np.concatenate([heights[np.isfinite(heights)], [o.height for o in telescope.obstructions]])
    top = float(heights.max() + _ABOVE * max(np.ptp(heights), 0.5 * telescope.pupil_diameter))
    outer, inner = 0.5 * telescope.pupil_diameter, 0.5 * telescope.pupil_diameter * telescope.pupil_obscuration
    arm = np.linspace(1.005 * inner, 0.998 * outer, _FAN) if inner else np.linspace(0.0, 0.998 * outer, _FAN - 1)
    across = np.unique(np.concatenate([-arm, arm]))
    angle = 2.0 * np.pi * np.arange(_SPOKES) / _SPOKES
    rings = np.multiply.outer([0.998 * outer, 1.005 * inner] if inner else [0.998 * outer, 0.5 * outer], angle * 0 + 1)
    around = (rings * np.cos(angle)).ravel(), (rings * np.sin(angle)).ravel()

    def rays(pupil: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, ...]:
        return tuple(ray_paths(telescope, f, float(w), pupil, top, projection, threads) for f in points)

    return Layout(
        telescope=telescope,
        fields=points,
        wavelength=float(w),
        reach=reach,
        profiles=profiles,
        lenses=lenses,
        fans=rays((np.zeros_like(across), across)),
        bundles=rays(around),
    )


def ray_paths(
    telescope: Telescope,
    field: Sequence[float] | np.ndarray,
    wavelength: float,
    pupil: tuple[np.ndarray, np.ndarray],
    top: float,
    projection: str = "zemax",
    threads: int | None = None,
) -> np.ndarray:
    """Return the ways of the rays that arrive, from a height in front of the telescope to the detector.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    field : (tx, ty)
        Field angles [rad].
    wavelength : float
        Vacuum wavelength [m].
    pupil : (px, py)
        Entrance-pupil coordinates [m].
    top : float
        Height that the rays come from [m].
    projection : str
        Meaning of the field angles.
    threads : int, optional
        Number of threads; all processors by default.

    Returns
    -------
    ndarray, shape [n_ray, n_surface + 1, 3]
        Where each starts and where it meets the surfaces [m], telescope frame.
    """
    rays = launch_rays(telescope, (field[0], field[1]), wavelength, pupil, projection)
    met = trace(telescope, rays, "all", threads=threads)
    back = (top - rays.position[:, 2:]) / rays.direction[:, 2:]
    points = np.stack([rays.position + back * rays.direction, *(m.position for m in met)], axis=1)
    return points[met[-1].status == RayStatus.OK]


def surface_section(surface: Surface, reach: float) -> np.ndarray:
    """Return points along a surface in its own section x = 0, cut to its aperture.

    Parameters
    ----------
    surface : Surface
        The surface; of a baffle, what blocks light is returned.
    reach : float
        Distance from its z axis to go to [m].

    Returns
    -------
    ndarray, shape [n, 3]
        Points [m], telescope frame, from -y to +y; NaN breaks the line.
    """
    blocks = surface.interaction == Interaction.PASS

    def solid(y: np.ndarray) -> np.ndarray:
        return clear_region(surface.aperture, np.zeros_like(y), y) != blocks

    y = np.linspace(-reach, reach, _POINTS)
    here = solid(y)
    # Where it begins and ends is found by halving the step in which it does.
    ends = np.flatnonzero(here[1:] != here[:-1])
    low, high = y[ends].copy(), y[ends + 1].copy()
    for _ in range(40):
        middle = 0.5 * (low + high)
        same = solid(middle) == here[ends]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    y = np.concatenate([y, low, high])
    order = np.argsort(y, kind="stable")
    y = y[order]
    keep = np.concatenate([here, here[ends], here[ends + 1]])[order]
    sag = np.zeros_like(y) if surface.interaction == Interaction.PHASE else surface.shape.sag(np.zeros_like(y), y)
    local = np.stack([np.zeros_like(y), y, np.where(keep, sag, np.nan)], axis=-1)
    return surface.to_telescope(local)


def clear_region(aperture: Aperture | None, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return True where light passes an aperture, rims included; everywhere if there is none."""
    if aperture is None:
        return np.ones(np.broadcast(x, y).shape, dtype=bool)
    # Rims of circles do not count, and surfaces are drawn just up to them.
    return aperture.contains((1.0 - 1e-9) * x, (1.0 - 1e-9) * y)


def outer_radius(region: Aperture | None) -> float:
    """Return a distance from the origin beyond which nothing of a region lies [m]; infinite where it has no end."""
    if isinstance(region, Circle):
        return region.radius + float(np.hypot(region.x, region.y))
    if isinstance(region, Annulus):
        return region.outer + float(np.hypot(region.x, region.y))
    if isinstance(region, Rectangle):
        return float(0.5 * np.hypot(region.width, region.height) + np.hypot(region.x, region.y))
    if isinstance(region, Polygon):
        return float(np.hypot(*np.array(region.corners).T).max())
    if isinstance(region, Union):
        return max(outer_radius(part) for part in region.parts)
    if isinstance(region, Intersection):
        return min(outer_radius(part) for part in region.parts)
    return float("inf")


def _even_edges(telescope: Telescope, lenses: tuple[Lens, ...], reach: dict[str, float]) -> dict[str, float]:
    """Return the reaches with surfaces that have no rim of their own going as far as the other one of their lens."""
    found = dict(reach)
    for lens in lenses:
        both = max(found[lens.front], found[lens.back])
        for name in (lens.front, lens.back):
            surface = telescope.surface(name)
            rim = np.linspace(0.0, both, _POINTS)
            if surface.aperture is None and np.isfinite(surface.shape.sag(np.zeros_like(rim), rim)).all():
                found[name] = both
    return found


def _reaches(telescope: Telescope, fields: np.ndarray, wavelength: float, threads: int | None) -> dict[str, float]:
    """Return how far each surface is drawn: to its rim, or as far as the light of all fields goes."""
    edge = telescope.field_radius * np.array([[0.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 0.0]])
    angle = 2.0 * np.pi * np.arange(16) / 16
    radius = 0.5 * telescope.pupil_diameter
    lit = np.zeros(len(telescope.surfaces))
    for field in np.concatenate([edge, fields]):
        rays = launch_rays(
            telescope, (field[0], field[1]), wavelength, (radius * np.cos(angle), radius * np.sin(angle))
        )
        for k, met in enumerate(trace(telescope, rays, "all", threads=threads)):
            local = telescope.surfaces[k].to_local(met.position)
            # Light that is stopped on its way need not be drawn, but it tells where nothing else does.
            away = np.hypot(local[:, 0], local[:, 1])
            lit[k] = max(lit[k], float(np.nanmax(away, initial=0.0)) if np.isfinite(away).any() else 0.0)
    found = {}
    for surface, light in zip(telescope.surfaces, lit, strict=True):
        bound = outer_radius(surface.aperture)
        if surface.interaction == Interaction.PASS:
            blocked = outer_radius(surface.aperture.part) if isinstance(surface.aperture, Complement) else np.inf
            bound = blocked if np.isfinite(blocked) else _RIM * (bound if np.isfinite(bound) else light)
        found[surface.name] = bound if np.isfinite(bound) else _BEYOND * max(light, 1e-3 * radius)
    return found


def _lenses(telescope: Telescope, wavelength: float) -> tuple[Lens, ...]:
    index = refractive_indices(telescope, wavelength)
    # Planes inside a lens, such as its stop, do not divide it.
    acting = [k for k, s in enumerate(telescope.surfaces) if s.interaction in (Interaction.REFRACT, Interaction.MIRROR)]
    found = []
    for front, back in pairwise(acting):
        if index[front + 1] >= _GLASS:
            names = telescope.surfaces[front].name, telescope.surfaces[back].name
            found.append(Lens(_common_name(*names), *names, float(index[front + 1])))
    return tuple(found)


def _common_name(first: str, second: str) -> str:
    """Return what two names begin with, up to a mark between words; both names where that is nothing."""
    for mark in "_- .":
        head = first.partition(mark)[0]
        if mark in first and mark in second and head and head == second.partition(mark)[0]:
            return head
    return f"{first}, {second}"
