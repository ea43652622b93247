"""A telescope as kernels read it: a row of numbers and of kinds for each surface, and the frames of surfaces."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .aperture import PackedApertures
from .mesh import PackedMeshes
from .obstruction import PackedObstructions
from .packet import lanes
from .shape import PackedDeformations

wp.set_module_options(FORWARD_OPTIONS)

MIRROR = wp.constant(0)
REFRACT = wp.constant(1)
PHASE = wp.constant(4)
THIN_LENS = wp.constant(5)
#: What grooves do in place of reflection or refraction.
DIFFRACT = wp.constant(-1)


# Columns of the table of numbers, a row per surface: curvature [1/m], conic constant, vertex [m] (3), rotation (9,
# row by row), clear aperture: centre x, y, inner and outer radius [m] (0 of one that is neither disc nor ring, but an
# outer radius of FAR where it is unbounded); the curvature of the conic that the search for a landing starts from,
# another one where the surface has no conic of its own; the direction cosine w, 0 or close to it, at which rays change
# from one intersection with that conic to the other; the path that the grooves of a grating add along x and y, for each
# metre of wavelength [1/m]; the power of a thin lens, and one over the distance of the object for which paths through
# it are equal [1/m]; the largest direction cosine, of either sign, at which both intersections may lie on the sheet
# within the rim.
CURVATURE = wp.constant(0)
CONIC = wp.constant(1)
VERTEX = wp.constant(2)
ROTATION = wp.constant(5)
APERTURE = wp.constant(14)
FIRST_CURVATURE = wp.constant(18)
SIGN_CHANGE = wp.constant(19)
GROOVES = wp.constant(20)
POWER = wp.constant(22)
VERGENCE = wp.constant(23)
TWO_CROSSINGS = wp.constant(24)
NUMBERS = 25
# Columns of the table of kinds: interaction, number of aspheric coefficients, whether rotated, whether stopped down
# (0 no, 1 by a disc or ring, 2 by another aperture), whether obstructions lie on the way to it, whether its shape has
# parts besides the conic and its even powers (1) or is a mesh (2), which of the distinct media lies before and after,
# whether grooves are ruled on it, whether its aperture says which of two crossings is meant (1), and of a conic at
# grazing incidence (2).
INTERACTION = wp.constant(0)
TERMS = wp.constant(1)
ROTATED = wp.constant(2)
STOPPED = wp.constant(3)
OBSTRUCTED = wp.constant(4)
DEFORMED = wp.constant(5)
MEDIUM_BEFORE = wp.constant(6)
MEDIUM_AFTER = wp.constant(7)
RULED = wp.constant(8)
CHOSEN = wp.constant(9)
KINDS = 10


@wp.struct
class PackedSurfaces:
    """A telescope as tables, a row per surface; see :mod:`pachon.raytrace.pack.surfaces`.

    ``special`` tells whether the loop over its surfaces needs more than the plain one has.
    """

    special: wp.bool
    numbers: wp.array2d(dtype=wp.float64)
    kinds: wp.array2d(dtype=wp.int32)
    coefficients: wp.array2d(dtype=wp.float64)
    deformations: PackedDeformations
    meshes: PackedMeshes
    apertures: PackedApertures
    obstructions: PackedObstructions


@wp.func
def to_local(surfaces: PackedSurfaces, s: wp.int32, x: lanes, y: lanes, z: lanes):
    """Components along the axes of surface ``s``, the columns of its rotation, of vectors of the telescope frame."""
    table = surfaces.numbers
    return (
        table[s, ROTATION] * x + table[s, ROTATION + 3] * y + table[s, ROTATION + 6] * z,
        table[s, ROTATION + 1] * x + table[s, ROTATION + 4] * y + table[s, ROTATION + 7] * z,
        table[s, ROTATION + 2] * x + table[s, ROTATION + 5] * y + table[s, ROTATION + 8] * z,
    )


@wp.func
def to_telescope(surfaces: PackedSurfaces, s: wp.int32, x: lanes, y: lanes, z: lanes):
    """Components in the telescope frame of vectors along the axes of surface ``s``."""
    table = surfaces.numbers
    return (
        table[s, ROTATION] * x + table[s, ROTATION + 1] * y + table[s, ROTATION + 2] * z,
        table[s, ROTATION + 3] * x + table[s, ROTATION + 4] * y + table[s, ROTATION + 5] * z,
        table[s, ROTATION + 6] * x + table[s, ROTATION + 7] * y + table[s, ROTATION + 8] * z,
    )
