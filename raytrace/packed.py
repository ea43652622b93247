"""A telescope as the arrays that the trace kernels read, made once per telescope."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from ..models.errors import PrescriptionError
from ..models.surface import Annulus, Aperture, Circle
from ..models.telescope import Telescope
from .launch import start_warp
from .trace_kernels import KINDS, NUMBERS, PackedSurfaces


def _clear_region(aperture: Aperture | None) -> tuple[float, float, float, float]:
    """Return centre x, y, inner and outer radius [m] of the clear region."""
    if aperture is None:
        return (0.0, 0.0, 0.0, np.inf)
    if isinstance(aperture, Circle):
        return (aperture.x, aperture.y, 0.0, aperture.radius)
    if isinstance(aperture, Annulus):
        return (aperture.x, aperture.y, aperture.inner, aperture.outer)
    raise PrescriptionError(f"aperture {type(aperture).__name__} cannot be traced")


@lru_cache(maxsize=64)
def pack_surfaces(telescope: Telescope, device: str = "cpu") -> Any:
    """Return the telescope's surfaces as a :class:`PackedSurfaces` struct on a device."""
    start_warp()
    surfaces = telescope.surfaces
    numbers = np.empty((len(surfaces), NUMBERS))
    kinds = np.empty((len(surfaces), KINDS), dtype=np.int32)
    coefficients = np.zeros((len(surfaces), max([1, *(len(s.shape.coefficients) for s in surfaces)])))
    for row, s in enumerate(surfaces):
        terms = s.shape.coefficients
        turned = not np.array_equal(s.matrix, np.eye(3))
        coefficients[row, : len(terms)] = terms
        numbers[row] = [s.shape.curvature, s.shape.conic, *s.vertex, *s.matrix.ravel(), *_clear_region(s.aperture)]
        kinds[row] = [int(s.interaction), len(terms), turned, s.aperture is not None]
    packed = PackedSurfaces()
    packed.numbers = wp.array(numbers, dtype=wp.float64, device=device)
    packed.kinds = wp.array(kinds, dtype=wp.int32, device=device)
    packed.coefficients = wp.array(coefficients, dtype=wp.float64, device=device)
    return packed


def refractive_indices(telescope: Telescope, wavelength: float) -> np.ndarray:
    """Return the index before the first surface and after each at one wavelength, shape [n_surface + 1].

    The last but one is therefore that of the medium in which the light meets the detector.
    """
    telescope.check_wavelength(wavelength)
    media = [telescope.medium_before, *(s.medium_after for s in telescope.surfaces)]
    return np.array([medium.index(wavelength) for medium in media], dtype=np.float64)
