"""Square grid over the entrance pupil, and the part of it that is pupil."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..core.units import require_count
from ..models.telescope import Telescope
from ..raytrace.rays import RayStatus
from ..raytrace.trace import trace
from .pupil_sampling import CHIEF_RAY, annulus_contains
from .request import Request

#: Distance of the probes from the stated rims, of their radius: farther than perturbed surfaces move the light.
_BEYOND = 0.02
_PROBES = 16
#: Most points along a side of a map.
_MOST_ACROSS = 8192


def pupil_grid(telescope: Telescope, across: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a square grid over the entrance pupil.

    Parameters
    ----------
    telescope : Telescope
        Prescription.
    across : int
        Cells across the diameter of the pupil.

    Returns
    -------
    x, y : ndarray, shape [across, across]
        Centres of the cells [m], in [y, x] order.
    inside : ndarray of bool, shape [across, across]
        Mask of the cells of the pupil. A rim of the pupil is where the surfaces of the telescope stop the light on the
        axis; where they do not, it is a circle of the stated radius.

    Raises
    ------
    DomainError
        If ``across`` is not a whole number of at least 2.
    """
    across = require_count(across, "grid", 2, _MOST_ACROSS)
    radius, obscuration = 0.5 * telescope.pupil_diameter, telescope.pupil_obscuration
    u = ((np.arange(across) + 0.5) / across - 0.5) * telescope.pupil_diameter
    x, y = np.meshgrid(u, u)
    stated_outer, stated_inner = _stated_rims(telescope)
    inner, outer = obscuration if stated_inner else 0.0, 1.0 if stated_outer else np.inf
    return x, y, annulus_contains(x / radius, y / radius, inner, outer)


@lru_cache(maxsize=64)
def _stated_rims(telescope: Telescope) -> tuple[bool, bool]:
    """Return whether the outer and the inner rim are the stated ones, and not where surfaces stop the light.

    A surface is the rim where light on the axis passes on one side of the stated rim and not on the other.
    """
    if not telescope.obstructions and all(s.aperture is None for s in telescope.surfaces):
        return True, True
    request = Request.of(telescope, (0.0, 0.0), sampling=CHIEF_RAY, threads=1, one_wavelength=True)
    # Not along the axes, where spider vanes lie.
    angle = (np.arange(_PROBES) + 0.25) * (2.0 * np.pi / _PROBES)
    circle = 0.5 * telescope.pupil_diameter * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rims = np.array([1.0, telescope.pupil_obscuration])[:, None]
    points = (rims * [1.0 + _BEYOND, 1.0 - _BEYOND])[..., None, None] * circle
    end = trace(telescope, request.launch(request.wavelength, points.reshape(-1, 2)), threads=1)
    (beyond, inside), (around, hole) = (end.status == RayStatus.OK).reshape(2, 2, _PROBES).any(axis=-1)
    return bool(beyond or not inside), bool(hole or not around)
