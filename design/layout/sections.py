"""Sections of surfaces, pieces of glass and paths of rays, in metres."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ...models.aperture import Annulus, Aperture, Circle, Complement, Ellipse, Intersection, Polygon, Rectangle, Union
from ...models.surface import Interaction, Surface
from ...models.telescope import Telescope
from ...models.thickness import impossible_glasses
from ...raytrace.pack.surfaces import refractive_indices
from ...raytrace.rays import Rays, RayStatus
from ...raytrace.trace import trace
from ...wavefront.request import Request

#: Points of a surface in section.
_POINTS = 241
#: Rings, diameters and points of each, of a surface that is drawn by lines; the last ring is just inside the rim.
_LINE_RINGS = 4
_DIAMETERS = 6
_LINE_POINTS = 49
_INSIDE = 0.999
#: A medium of at least this index is drawn as glass.
_GLASS = 1.05
#: Radius of a surface without an aperture, over that of the light.
_BEYOND = 1.03
#: Outer radius of a baffle without an outer rim, over its clear radius.
_RIM = 1.12


@dataclass(frozen=True)
class Lens:
    """A piece of glass between two neighbouring surfaces, in the order of the light."""

    name: str  #: common part of the names of both surfaces, or both names
    front: str
    back: str
    index: float  #: refractive index of the glass


def ray_paths(telescope: Telescope, rays: Rays, top: float, threads: int | None = None) -> np.ndarray:
    """Return the paths of the rays that arrive [m], telescope frame, shape [n_ray, n_surface + 1, 3].

    They start at the height `top` [m] in front of the telescope, and pass the intersections with all surfaces.
    """
    met = trace(telescope, rays, "all", threads=threads)
    back = (top - rays.position[:, 2:]) / rays.direction[:, 2:]
    points = np.stack([rays.position + back * rays.direction, *(m.position for m in met)], axis=1)
    return points[met[-1].status == RayStatus.OK]


def surface_section(surface: Surface, reach: float) -> np.ndarray:
    """Return points along the section x = 0 of a surface out to a radius [m], telescope frame, shape [n, 3].

    They run from -y to +y. NaN breaks the line where the aperture cuts it; of a baffle, the blocking part counts.
    """
    blocks = surface.interaction == Interaction.PASS

    def solid(y: np.ndarray) -> np.ndarray:
        return clear_region(surface.aperture, np.zeros_like(y), y) != blocks

    y = np.linspace(-reach, reach, _POINTS)
    solid_samples = solid(y)
    # Ends by bisection.
    ends = np.flatnonzero(solid_samples[1:] != solid_samples[:-1])
    low, high = y[ends].copy(), y[ends + 1].copy()
    for _ in range(40):
        middle = 0.5 * (low + high)
        same = solid(middle) == solid_samples[ends]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    y = np.concatenate([y, low, high])
    order = np.argsort(y, kind="stable")
    y = y[order]
    keep = np.concatenate([solid_samples, solid_samples[ends], solid_samples[ends + 1]])[order]
    sag = np.zeros_like(y) if surface.interaction == Interaction.PHASE else surface.shape.sag(np.zeros_like(y), y)
    local = np.stack([np.zeros_like(y), y, np.where(keep, sag, np.nan)], axis=-1)
    return surface.to_telescope(local)


def surface_lines(surface: Surface, reach: float) -> list[np.ndarray]:
    """Return rings and diameters of a surface out to a radius [m], telescope frame, each of shape [n, 3].

    NaN breaks a line where the aperture cuts it; of a baffle, the blocking part counts.
    """
    angle = 2.0 * np.pi * np.arange(_LINE_POINTS) / (_LINE_POINTS - 1)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    lines = [_INSIDE * reach * (ring + 1) / _LINE_RINGS * circle for ring in range(_LINE_RINGS)]
    across = np.linspace(-_INSIDE * reach, _INSIDE * reach, _LINE_POINTS)
    turns = np.pi * np.arange(_DIAMETERS) / _DIAMETERS
    lines += [np.stack([across * np.cos(turn), across * np.sin(turn)]) for turn in turns]
    blocks = surface.interaction == Interaction.PASS
    drawn = []
    for x, y in lines:
        points = surface.to_telescope(np.stack([x, y, surface.shape.sag(x, y)], axis=-1))
        drawn.append(np.where((clear_region(surface.aperture, x, y) != blocks)[:, None], points, np.nan))
    return drawn


def clear_region(aperture: Aperture | None, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return True where light passes an aperture, rims included; everywhere if there is none."""
    if aperture is None:
        return np.ones(np.broadcast(x, y).shape, dtype=bool)
    # Apertures exclude their rims, to which surfaces are drawn.
    return aperture.contains((1.0 - 1e-9) * x, (1.0 - 1e-9) * y)


def outer_radius(region: Aperture | None) -> float:
    """Return the radius of a circle about the origin that holds a region [m]; infinite if there is none."""
    if isinstance(region, Circle):
        return region.radius + float(np.hypot(region.x, region.y))
    if isinstance(region, Annulus):
        return region.outer + float(np.hypot(region.x, region.y))
    if isinstance(region, Ellipse):
        return max(region.semi_x, region.semi_y) + float(np.hypot(region.x, region.y))
    if isinstance(region, Rectangle):
        return float(0.5 * np.hypot(region.width, region.height) + np.hypot(region.x, region.y))
    if isinstance(region, Polygon):
        return float(np.hypot(*np.array(region.corners).T).max())
    if isinstance(region, Union):
        return max(outer_radius(subregion) for subregion in region.parts)
    if isinstance(region, Intersection):
        return min(outer_radius(subregion) for subregion in region.parts)
    return float("inf")


def even_edges(telescope: Telescope, lenses: tuple[Lens, ...], reach: dict[str, float]) -> dict[str, float]:
    """Return radii with surfaces whose size is not stated as large as the other of their lens, if they do not cross."""
    radii = dict(reach)
    for lens in lenses:
        lens_radius = max(radii[lens.front], radii[lens.back])
        for name in (lens.front, lens.back):
            surface = telescope.surface(name)
            stated = surface.aperture is not None or surface.semi_diameter is not None
            if not stated and _apart(telescope.surface(lens.front), telescope.surface(lens.back), lens_radius):
                radii[name] = lens_radius
    return radii


def _apart(front: Surface, back: Surface, reach: float) -> bool:
    """Return whether two surfaces exist and do not cross out to a radius [m], in the section x = 0."""
    y = np.linspace(-reach, reach, _POINTS)
    front_z, back_z = (
        s.to_telescope(np.stack([np.zeros_like(y), y, s.shape.sag(np.zeros_like(y), y)], axis=-1))[:, 2]
        for s in (front, back)
    )
    gap = front_z - back_z
    return bool(np.isfinite(gap).all() and (gap * gap[len(y) // 2] > 0).all())


def drawn_radii(request: Request) -> dict[str, float]:
    """Return the radius to which each surface is drawn [m]: its rim, its semi-diameter, or the light of all fields.

    A semi-diameter smaller than the light that arrives at the detector gives way to it. The light is that of the fields
    of the request and, where the telescope states none, of the edge of its field.
    """
    telescope, threads = request.telescope, request.threads
    edge = telescope.field_radius * np.array([[0.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 0.0]])
    requests = [request] if telescope.design_data.fields else [request, request.at_fields(edge)]
    angle = 2.0 * np.pi * np.arange(16) / 16
    radius = 0.5 * telescope.pupil_diameter
    rim = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    lit, arrived = np.zeros((2, len(telescope.surfaces)))
    for field_request in requests:
        rays = field_request.launch(request.wavelength, rim)
        results = trace(telescope, rays, "all", threads=threads)
        arrives = results[-1].status == RayStatus.OK
        for k, met in enumerate(results):
            local = telescope.surfaces[k].to_local(met.position)
            # Vignetted light counts too, where there is nothing else.
            away = np.hypot(local[:, 0], local[:, 1])
            lit[k] = max(lit[k], float(np.nanmax(away, initial=0.0)) if np.isfinite(away).any() else 0.0)
            arrived[k] = max(arrived[k], float(np.max(away[arrives], initial=0.0)))
    radii = {}
    for surface, light, drawn_light in zip(telescope.surfaces, lit, arrived, strict=True):
        bound = outer_radius(surface.aperture)
        if surface.interaction == Interaction.PASS:
            blocked = outer_radius(surface.aperture.part) if isinstance(surface.aperture, Complement) else np.inf
            bound = blocked if np.isfinite(blocked) else _RIM * (bound if np.isfinite(bound) else light)
        if np.isinf(bound):
            # A semi-diameter stops no light: no ray is drawn that bends outside the glass.
            stated = max(surface.semi_diameter, drawn_light) if surface.semi_diameter else 0.0
            bound = stated or _BEYOND * max(light, 1e-3 * radius)
        radii[surface.name] = bound
    return radii


def stop_rims(request: Request) -> np.ndarray | None:
    """Return the two points of the rim of the stop in the section x = 0 [m], [2, 3]; None where none is known.

    They are where the light of the axis ends.
    """
    telescope, name = request.telescope, request.telescope.design_data.stop
    if name is None:
        return None
    axis = Request.of(telescope, [(0.0, 0.0)], request.wavelength, threads=request.threads, one_wavelength=True)
    height = 0.5 * telescope.pupil_diameter
    rays = axis.launch(request.wavelength, np.array([[0.0, -height], [0.0, height]]))
    met = trace(telescope, rays, "all", threads=request.threads)[telescope.surface_names.index(name)]
    return met.position if np.isfinite(met.position).all() else None


def find_lenses(telescope: Telescope, wavelength: float) -> tuple[Lens, ...]:
    """Return the pieces of glass between neighbouring surfaces; one of negative thickness is none."""
    impossible = impossible_glasses(telescope)
    index = refractive_indices(telescope, wavelength)
    # Planes inside a lens, such as its stop, do not divide it.
    acting = [k for k, s in enumerate(telescope.surfaces) if s.interaction in (Interaction.REFRACT, Interaction.MIRROR)]
    lenses = []
    for front, back in pairwise(acting):
        if index[front + 1] >= _GLASS and front not in impossible:
            names = telescope.surfaces[front].name, telescope.surfaces[back].name
            lenses.append(Lens(_common_name(*names), *names, float(index[front + 1])))
    return tuple(lenses)


def _common_name(first: str, second: str) -> str:
    """Return the common first word of two names; both names if there is none."""
    for mark in "_- .":
        head = first.partition(mark)[0]
        if mark in first and mark in second and head and head == second.partition(mark)[0]:
            return head
    return f"{first}, {second}"
