"""A telescope as arrays for the trace kernels, made once per telescope."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from ...core.launch import start_warp
from ...core.warp_arrays import warp_array
from ...models.aperture import Annulus, Aperture, Circle, Complement
from ...models.media.medium import Medium
from ...models.shapes.mesh import MeshSurface
from ...models.surface import Interaction, Surface
from ...models.telescope import Telescope
from ..kernels.surface import FAR
from ..kernels.trace import (
    DEFORMED,
    INTERACTION,
    KINDS,
    NUMBERS,
    OBSTRUCTED,
    PHASE,
    RULED,
    STOPPED,
    THIN_LENS,
    PackedSurfaces,
)
from .apertures import pack_apertures
from .meshes import pack_meshes
from .obstructions import obstruction_table, pack_obstructions
from .sequence import SurfaceSequence
from .shapes import SplitShape, pack_deformations, split_shape

#: Rays are nearly perpendicular to the axis of a mirror when their direction cosine along it is below this (6 degrees).
PERPENDICULAR = 0.1
#: Vertices are at one height when they differ in it by less than this fraction of their distance.
ROUNDING = 1e-9


def clear_annulus(aperture: Aperture | None) -> tuple[float, float, float, float] | None:
    """Return centre x, y, inner and outer radius [m] of a clear region; None where it is neither a disc nor a ring."""
    if aperture is None:
        return (0.0, 0.0, 0.0, np.inf)
    if isinstance(aperture, Circle):
        return (aperture.x, aperture.y, 0.0, aperture.radius)
    if isinstance(aperture, Annulus):
        return (aperture.x, aperture.y, aperture.inner, aperture.outer)
    if isinstance(aperture, Complement) and isinstance(aperture.part, Circle):
        # The complement of a disc is a ring of infinite outer radius.
        return (aperture.part.x, aperture.part.y, aperture.part.radius, float(FAR))
    return None


def sign_change(mirror: Surface, behind: Sequence[Surface], shape: SplitShape) -> float:
    """Return the direction cosine w at which rays change between the two intersections with a conic.

    ``behind`` are the surfaces after the mirror. A ray nearly perpendicular to the axis of a mirror, as on an off-axis
    paraboloid that turns light by 90 degrees, meets the sheet at the vertex twice, once from each side, and the sign of
    w does not tell which side reflects. Light leaves towards the next surface, so it is that of the next vertex.
    """
    if mirror.interaction != Interaction.MIRROR or shape.first_curvature == 0.0:
        return 0.0
    # Within 1 / sqrt(-k) both intersections with a hyperboloid are on one of its two sheets.
    size = PERPENDICULAR / math.sqrt(max(1.0, abs(shape.base.conic)))
    for surface in behind:
        offset = np.subtract(surface.vertex, mirror.vertex)
        height = offset @ mirror.matrix[:, 2]
        if abs(height) > ROUNDING * np.linalg.norm(offset):
            return math.copysign(size, height)
    return 0.0


@lru_cache(maxsize=64)
def pack_surfaces(telescope: Telescope | SurfaceSequence, device: str = "cpu") -> Any:
    """Return the telescope's surfaces as a :class:`PackedSurfaces` struct on a device."""
    start_warp()
    surfaces = telescope.surfaces
    numbers = np.empty((len(surfaces), NUMBERS))
    kinds = np.empty((len(surfaces), KINDS), dtype=np.int32)
    shapes = [split_shape(s.shape, screen=s.interaction == Interaction.PHASE) for s in surfaces]
    coefficients = np.zeros((len(surfaces), max([1, *(len(shape.base.coefficients) for shape in shapes)])))
    blocked = obstruction_table(telescope)
    general: list[Aperture | None] = []
    media = list(distinct_media(telescope))
    before = telescope.medium_before
    for row, s in enumerate(surfaces):
        base, terms = shapes[row].base, shapes[row].base.coefficients
        rotated = not np.array_equal(s.matrix, np.eye(3))
        coefficients[row, : len(terms)] = terms
        ring = clear_annulus(s.aperture)
        general.append(s.aperture if ring is None else None)
        stopped = 2 if ring is None else int(s.aperture is not None)
        frame = (*s.vertex, *s.matrix.ravel())
        first = shapes[row].first_curvature, sign_change(s, surfaces[row + 1 :], shapes[row])
        grooves = (0.0, 0.0) if s.grating is None else s.grating.path_gradient
        thin = s.thin_lens
        lens = (0.0, 0.0) if thin is None else (1.0 / thin.focal_length, 1.0 / thin.object_distance)
        numbers[row] = [base.curvature, base.conic, *frame, *(ring or (0.0,) * 4), *first, *grooves, *lens]
        kinds[row] = [
            int(s.interaction),
            len(terms),
            rotated,
            stopped,
            bool(blocked[row].any()),
            2 if isinstance(s.shape, MeshSurface) else int(bool(shapes[row].parts)),
            media.index(before),
            media.index(s.medium_after),
            s.grating is not None,
        ]
        before = s.medium_after
    packed = PackedSurfaces()
    unusual = kinds[:, [DEFORMED, OBSTRUCTED, RULED]].any() or np.any(kinds[:, STOPPED] == 2)
    packed.special = int(unusual or np.isin(kinds[:, INTERACTION], (PHASE, THIN_LENS)).any())
    packed.numbers = warp_array(numbers, device=device)
    packed.kinds = warp_array(kinds, wp.int32, device=device)
    packed.coefficients = warp_array(coefficients, device=device)
    packed.deformations = pack_deformations(shapes, device)
    packed.meshes = pack_meshes(surfaces, device)
    packed.apertures = pack_apertures(general, device)
    packed.obstructions = pack_obstructions(telescope, device)
    return packed


def leading_surfaces(packed: Any, count: int) -> Any:
    """Return a :class:`PackedSurfaces` of the first surfaces alone, sharing all tables."""
    struct: Any = PackedSurfaces
    front = struct()
    for name in struct.vars:
        setattr(front, name, getattr(packed, name))
    # Kernels pass as many surfaces as there are rows of kinds.
    front.kinds = packed.kinds[:count]
    return front


def distinct_media(telescope: Telescope | SurfaceSequence) -> tuple[Medium, ...]:
    """Return the media of a telescope, each once."""
    return tuple(dict.fromkeys([telescope.medium_before, *(s.medium_after for s in telescope.surfaces)]))


def refractive_indices(telescope: Telescope, wavelength: float) -> np.ndarray:
    """Return the index before the first surface and after each, [n_surface + 1]: [-2] is that before the detector."""
    telescope.check_wavelength(wavelength)
    media = [telescope.medium_before, *(s.medium_after for s in telescope.surfaces)]
    return np.array([_medium_index(medium, float(wavelength)) for medium in media], dtype=np.float64)


def indices_and_wavelength(telescope: Telescope, wavelength: float) -> np.ndarray:
    """Return :func:`refractive_indices` and the wavelength [m] behind them, as kernels read them, [n_surface + 2]."""
    return np.append(refractive_indices(telescope, wavelength), float(wavelength))


@lru_cache(maxsize=256)
def _medium_index(medium: Medium, wavelength: float) -> float:
    return float(medium.index(wavelength))
