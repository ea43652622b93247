"""One surface alone: intersection, reflection and refraction of rays, by the kernel that traces telescopes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..models.shapes.shape import Shape
from ..models.surface import Interaction, Surface
from ..models.telescope import VACUUM
from .kernels.packet import from_packets
from .pack.sequence import SurfaceSequence
from .pack.surfaces import pack_surfaces
from .rays import Rays, RayStatus
from .trace import TraceResult, launch_trace


@check_arguments
def intersect(surface: Surface | Shape, rays: Rays | TraceResult, *, n: float = 1.0) -> TraceResult:
    """Return rays at their intersections with one surface, directions unchanged.

    Parameters
    ----------
    surface : Surface or Shape
        The surface at its place in the telescope frame, whatever its own interaction; a shape alone has its vertex at
        the origin. A phase screen is its plane; a grating is a surface without its grooves.
    rays : Rays or TraceResult
        Rays in the telescope frame; those at another surface, from this function or :func:`~pachon.trace`, go on from
        there and keep their status.
    n : float
        Refractive index of the medium that the rays travel in; it counts in the optical path.

    Returns
    -------
    TraceResult
        Rays at the surface. Those outside its aperture have status VIGNETTED, those that do not meet it MISSED.

    Raises
    ------
    DomainError
        If an index is not a positive number.
    """
    return _at_surface(surface, Interaction.PASS, rays, n, n)


@check_arguments
def reflect(surface: Surface | Shape, rays: Rays | TraceResult, *, n: float = 1.0) -> TraceResult:
    """Return rays after reflection from one surface.

    With N the unit normal, ``d' = d - 2 (d.N) N``. Arguments and errors are those of :func:`intersect`.
    """
    return _at_surface(surface, Interaction.MIRROR, rays, n, n)


@check_arguments
def refract(surface: Surface | Shape, rays: Rays | TraceResult, n1: float, n2: float) -> TraceResult:
    """Return rays after refraction at one surface, from index `n1` to `n2`.

    Snell's law in vectors, ``n1 d x N = n2 d' x N``. A totally reflected ray has status TOTAL_REFLECTION and a
    direction of NaN. Other arguments, and errors, are those of :func:`intersect`.
    """
    return _at_surface(surface, Interaction.REFRACT, rays, n1, n2)


def _at_surface(
    surface: Surface | Shape, interaction: Interaction, rays: Rays | TraceResult, n1: float, n2: float
) -> TraceResult:
    for index in (n1, n2):
        if not 0.0 < index < np.inf:
            raise DomainError(f"refractive index = {index!r}: expected a positive number")
    if isinstance(surface, Shape):
        surface = Surface(type(surface).__name__, interaction, surface, (0.0, 0.0, 0.0), VACUUM)
    surface = replace(
        surface, interaction=interaction, shape=surface.meeting_shape, coating=None, grating=None, thin_lens=None
    )
    packed = pack_surfaces(SurfaceSequence((surface,)))
    # Without grooves the rays depend on no wavelength.
    end = launch_trace(packed, np.array([n1, n2, np.nan]), rays, 1).end
    count = len(rays.path_length)
    position, direction = (from_packets(vectors, count)[0].T for vectors in (end.position, end.direction))
    path, status = (from_packets(numbers, count)[0] for numbers in (end.path, end.status))
    if isinstance(rays, TraceResult):
        # A ray that was lost before stays so; one that was only vignetted may be lost here.
        earlier = rays.status
        status = np.where((earlier > RayStatus.VIGNETTED) | (status == RayStatus.OK), earlier, status)
    return TraceResult(surface.name, position, direction, path, status)
