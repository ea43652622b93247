"""Meshes of the layout of a telescope, for a GLB file."""

from __future__ import annotations

from itertools import count

import numpy as np
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from ...models.aperture import Annulus, Circle
from ...models.surface import Interaction, Surface
from ...models.telescope import Telescope
from .sections import Lens, clear_region

#: Points of a surface along the radius.
_RINGS = 24
#: Points of a surface around the axis.
_SPOKES = 120
#: Diameter of the tubes of rays over the largest extent of the telescope: over a pixel of a screen.
_RAY = 1.5e-3
#: Sides of the tubes of rays.
_SIDES = 5
#: Colours with opacity, how metallic and how rough.
_LOOKS: dict[str, tuple[tuple[float, float, float, float], float, float]] = {
    "mirror": ((0.80, 0.82, 0.85, 1.0), 1.0, 0.12),
    "glass": ((0.55, 0.80, 0.92, 0.35), 0.0, 0.05),
    "detector": ((0.05, 0.42, 0.24, 1.0), 0.2, 0.5),
    "baffle": ((0.16, 0.15, 0.14, 1.0), 0.0, 0.9),
}
_RAY_COLORS = (
    (0.12, 0.44, 0.75, 1.0),
    (0.30, 0.30, 0.30, 1.0),
    (0.78, 0.20, 0.17, 1.0),
    (0.88, 0.54, 0.0, 1.0),
    (0.48, 0.31, 0.71, 1.0),
    (0.16, 0.62, 0.56, 1.0),
)
#: From the telescope frame, z to the sky, to that of glTF, y up.
_UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])


def layout_scene(
    telescope: Telescope,
    lenses: tuple[Lens, ...],
    reach: dict[str, float],
    fields: np.ndarray,
    bundles: tuple[np.ndarray, ...],
    size: float,
) -> trimesh.Scene:
    """Return a telescope as a scene of named meshes [m]; y points to the sky, as viewers of glTF have it up.

    Arguments are the attributes of :class:`~.layout.Layout`; `size` is its largest extent [m].
    """
    scene = trimesh.Scene()
    glass = {name for lens in lenses for name in (lens.front, lens.back)}
    surfaces = {s.name: s for s in telescope.surfaces}

    def add(name: str, mesh: trimesh.Trimesh, look: tuple[tuple[float, float, float, float], float, float]) -> None:
        if not len(mesh.faces):
            return
        numbered = (f"{name} {number}" for number in count(2))
        while name in scene.geometry:
            name = next(numbered)
        color, metallic, rough = look
        material = PBRMaterial(
            name=name,
            baseColorFactor=color,
            metallicFactor=metallic,
            roughnessFactor=rough,
            alphaMode="BLEND" if color[3] < 1.0 else "OPAQUE",
            doubleSided=True,
        )
        mesh.visual = TextureVisuals(material=material)
        scene.add_geometry(mesh, node_name=name, geom_name=name, transform=_UPRIGHT)

    for lens in lenses:
        faces = [surface_mesh(surfaces[name], reach[name]) for name in (lens.front, lens.back)]
        edge = _wall(*(_rim(surfaces[name], reach[name]) for name in (lens.front, lens.back)))
        mirrors = [n for n in (lens.front, lens.back) if surfaces[n].interaction == Interaction.MIRROR]
        body = trimesh.util.concatenate([*faces, edge])
        assert isinstance(body, trimesh.Trimesh)
        add(lens.name, body, _LOOKS["glass"])
        glass -= set(mirrors)
    for name, surface in surfaces.items():
        if name in glass or surface.interaction == Interaction.PHASE:
            continue
        look = {Interaction.MIRROR: "mirror", Interaction.DETECTOR: "detector", Interaction.PASS: "baffle"}
        add(name, surface_mesh(surface, reach[name]), _LOOKS[look.get(surface.interaction, "glass")])
    for obstruction in telescope.obstructions:
        add(obstruction.name, obstruction.mesh, _LOOKS["baffle"])
    radius = 0.5 * _RAY * size
    for i, (field, bundle) in enumerate(zip(fields, bundles, strict=True)):
        x, y = np.rad2deg(field)
        add(f"rays {x:+.4g} {y:+.4g} deg", tubes(bundle, radius), (_RAY_COLORS[i % len(_RAY_COLORS)], 0.0, 0.8))
    return scene


def surface_mesh(surface: Surface, reach: float) -> trimesh.Trimesh:
    """Return a surface, cut to its aperture, as a mesh in the telescope frame [m]; of a baffle, the blocking part."""
    rings, spokes = _RINGS, _SPOKES
    center_x, center_y, inner, outer = _ring(surface, reach)
    plain = isinstance(surface.aperture, (Circle, Annulus)) and surface.interaction != Interaction.PASS
    if not plain and surface.aperture is not None:
        # Cells are drawn or not, so edges need fine ones.
        rings, spokes = 4 * rings, 4 * spokes
    radius = np.linspace(inner, outer, rings + 1)
    angle = 2.0 * np.pi * np.arange(spokes) / spokes
    x = center_x + np.multiply.outer(radius, np.cos(angle))
    y = center_y + np.multiply.outer(radius, np.sin(angle))
    local = np.stack([x, y, surface.shape.sag(x, y)], axis=-1).reshape(-1, 3)
    a = np.add.outer(np.arange(rings) * spokes, np.arange(spokes)).ravel()
    b = np.add.outer(np.arange(rings) * spokes, (np.arange(spokes) + 1) % spokes).ravel()
    faces = np.stack([np.stack([a, a + spokes, b], -1), np.stack([b, a + spokes, b + spokes], -1)], 1).reshape(-1, 3)
    keep = np.isfinite(local[faces]).all(axis=(1, 2))
    if not plain:
        middle = local[faces].mean(axis=1)
        blocks = surface.interaction == Interaction.PASS
        keep &= clear_region(surface.aperture, middle[:, 0], middle[:, 1]) != blocks
    corners = faces[keep]
    # The innermost ring of a disc is a point, and triangles there have no area.
    first, second, third = np.moveaxis(local[corners], 1, 0)
    area = np.linalg.norm(np.cross(second - first, third - first), axis=-1)
    points = surface.to_telescope(np.where(np.isfinite(local), local, 0.0))
    mesh = trimesh.Trimesh(points, corners[area > 0], process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def tubes(paths: np.ndarray, radius: float) -> trimesh.Trimesh:
    """Return thin tubes of a radius [m] along polylines [m], shape [n, n_point, 3]."""
    start, end = paths[:, :-1].reshape(-1, 3), paths[:, 1:].reshape(-1, 3)
    length = np.linalg.norm(end - start, axis=-1)
    solid = np.isfinite(length) & (length > 1e-9)
    start, end, length = start[solid], end[solid], length[solid]
    along = (end - start) / length[:, None]
    # Two directions across each piece, from the axis that is least along it.
    least_along = np.eye(3)[np.argmin(np.abs(along), axis=-1)]
    first = np.cross(along, least_along)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(along, first)
    angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    around = radius * (first[:, None] * np.cos(angle)[:, None] + second[:, None] * np.sin(angle)[:, None])
    points = np.stack([start[:, None] + around, end[:, None] + around], axis=1).reshape(-1, 3)
    i = np.arange(_SIDES)
    j = (i + 1) % _SIDES
    segment_faces = np.concatenate([np.stack([i, i + _SIDES, j], -1), np.stack([j, i + _SIDES, j + _SIDES], -1)])
    faces = (2 * _SIDES * np.arange(len(start))[:, None, None] + segment_faces).reshape(-1, 3)
    return trimesh.Trimesh(points, faces, process=False)


def _ring(surface: Surface, reach: float) -> tuple[float, float, float, float]:
    """Return centre, inner and outer radius [m] of the ring that a surface is drawn in."""
    aperture = surface.aperture
    if surface.interaction != Interaction.PASS:
        if isinstance(aperture, Circle):
            return aperture.x, aperture.y, 0.0, aperture.radius
        if isinstance(aperture, Annulus):
            return aperture.x, aperture.y, aperture.inner, aperture.outer
    return 0.0, 0.0, 0.0, reach


def _rim(surface: Surface, reach: float) -> np.ndarray:
    """Return points around the outer rim of a surface [m], telescope frame, shape [n, 3]."""
    center_x, center_y, _, outer = _ring(surface, reach)
    angle = 2.0 * np.pi * np.arange(_SPOKES) / _SPOKES
    x, y = center_x + outer * np.cos(angle), center_y + outer * np.sin(angle)
    return surface.to_telescope(np.stack([x, y, surface.shape.sag(x, y)], axis=-1))


def _wall(first: np.ndarray, second: np.ndarray) -> trimesh.Trimesh:
    """Return the edge of a lens, between the rims of its two surfaces."""
    n = len(first)
    i = np.arange(n)
    j = (i + 1) % n
    faces = np.concatenate([np.stack([i, j, i + n], -1), np.stack([j, j + n, i + n], -1)])
    points = np.concatenate([first, second])
    finite = np.isfinite(points[faces]).all(axis=(1, 2))
    return trimesh.Trimesh(np.where(np.isfinite(points), points, 0.0), faces[finite], process=False)
