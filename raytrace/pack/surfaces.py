"""A telescope as arrays for the trace kernels, made once per telescope."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from ...core.launch import start_warp
from ...core.warp_arrays import warp_array
from ...models.aperture import Annulus, Aperture, Circle, Complement, enclosing_circle
from ...models.media.medium import Medium
from ...models.shapes.mesh import MeshSurface
from ...models.shapes.shape import Rotational
from ...models.surface import Interaction, Surface
from ...models.telescope import Telescope
from ..kernels.surface import FAR
from ..kernels.surface_table import (
    CHOSEN,
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
#: A mirror is steep where the sine of its slope at the rim is beyond this: rays that cross it twice there leave or come
#: within 45 degrees of its axis, as to and from a lamp in an ellipsoid. Primary mirrors of f/0.4 are below.
STEEP = 0.55
#: Beyond this sine of the slope at the rim light parallel to the axis grazes a mirror at less than 18 degrees.
GRAZING = 0.95
#: Slopes of shapes that are no conics are sampled; they may be this much larger.
SLOPE_MARGIN = 2.0
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


@dataclass(frozen=True)
class Crossings:
    """Which of two crossings of a ray with the conic of a surface is meant."""

    #: Direction cosine w at which rays change from one crossing to the other.
    sign_change: float
    #: Largest cosine, of either sign, at which both crossings may lie on the sheet at the vertex and one in the rim.
    two_crossings: float
    #: Whether the aperture of the surface chooses between them: 0 no, 1 yes, 2 yes, of a conic at grazing incidence.
    by_aperture: int


def crossings(surfaces: Sequence[Surface], row: int, shape: SplitShape) -> Crossings:
    """Return the choice between crossings at a surface.

    By the sign of w a ray lands on the crossing nearer to the vertex. A ray that passes between two points of the sheet
    is no steeper than the sheet at the farther of them, so beyond that slope at the rim there is no choice. An aperture
    about the vertex holds the nearer crossing wherever it holds the farther one, but for rays that start or end between
    the two, which only steep mirrors have; any other aperture says which of them is meant.
    """
    surface = surfaces[row]
    flat = shape.first_curvature == 0.0 or isinstance(surface.shape, MeshSurface)
    if flat or surface.interaction == Interaction.PHASE:
        return Crossings(0.0, 0.0, by_aperture=0)
    limit = steepest_cosine(surface)
    change = sign_change(surface, surfaces[row + 1 :], shape)
    by_aperture = 0
    steep = surface.interaction == Interaction.MIRROR and limit > STEEP
    if surface.aperture is not None:
        x, y, rim = enclosing_circle(surface.aperture)
        centred = not math.isfinite(rim) or math.hypot(x, y) <= ROUNDING * rim
        by_aperture = int(not centred or (steep and math.isfinite(rim)))
    if by_aperture and steep and limit > GRAZING and not shape.parts and not shape.base.coefficients:
        by_aperture = 2
    return Crossings(math.copysign(min(abs(change), limit), change), limit, by_aperture)


def steepest_cosine(surface: Surface) -> float:
    """Return the sine of the largest slope of a surface within the rim of its aperture: the cosine w of a ray along it.

    It is 1 for a surface without a rim, or with one beyond its equator.
    """
    if surface.aperture is None:
        return 1.0
    x, y, radius = enclosing_circle(surface.aperture)
    if not math.isfinite(radius):
        return 1.0
    shape = surface.shape
    if isinstance(shape, Rotational) and not shape.coefficients:
        slope = float(np.hypot(*shape.gradient(math.hypot(x, y) + radius, 0.0)))
    else:
        # A shape may be steeper between these points, and the conic that the search starts from is another one.
        angle, size = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False), radius * np.linspace(0.0, 1.0, 9)[:, None]
        slope = SLOPE_MARGIN * float(
            np.hypot(*shape.gradient(x + size * np.cos(angle), y + size * np.sin(angle))).max()
        )
    return math.sin(math.atan(slope)) if math.isfinite(slope) else 1.0


def sign_change(mirror: Surface, behind: Sequence[Surface], shape: SplitShape) -> float:
    """Return the direction cosine w at which rays change between the two crossings where no aperture chooses.

    ``behind`` are the surfaces after the mirror. A ray nearly perpendicular to the axis of a mirror meets the sheet at
    the vertex twice, once from each side, and the sign of w does not tell which side reflects. Light leaves towards the
    next surface, so it is that of the next vertex.
    """
    if mirror.interaction != Interaction.MIRROR:
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
        rim = (0.0, 0.0, 0.0, 0.0) if ring is None else ring
        if ring is None and s.aperture is not None and not math.isfinite(enclosing_circle(s.aperture)[2]):
            rim = (0.0, 0.0, 0.0, float(FAR))
        general.append(s.aperture if ring is None else None)
        stopped = 2 if ring is None else int(s.aperture is not None)
        frame = (*s.vertex, *s.matrix.ravel())
        choice = crossings(surfaces, row, shapes[row])
        first = shapes[row].first_curvature, choice.sign_change
        grooves = (0.0, 0.0) if s.grating is None else s.grating.path_gradient
        thin = s.thin_lens
        lens = (0.0, 0.0) if thin is None else (1.0 / thin.focal_length, 1.0 / thin.object_distance)
        numbers[row] = [base.curvature, base.conic, *frame, *rim, *first, *grooves, *lens, choice.two_crossings]
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
            choice.by_aperture,
        ]
        before = s.medium_after
    packed = PackedSurfaces()
    unusual = kinds[:, [DEFORMED, OBSTRUCTED, RULED, CHOSEN]].any() or np.any(kinds[:, STOPPED] == 2)
    unusual = unusual or np.isin(kinds[:, INTERACTION], (PHASE, THIN_LENS)).any()
    packed.special = bool(unusual)
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
