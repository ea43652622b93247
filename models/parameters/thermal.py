"""Temperature as a degree of freedom: its effect on all parameters, to first order."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ..surface import Interaction
from ..telescope import Telescope
from .degrees_of_freedom import DegreeOfFreedom
from .shape_terms import term_unit


@check_arguments
def thermal(
    telescope: Telescope, expansion: float | Mapping[str, float], dn_dt: Mapping[str, float] | None = None
) -> DegreeOfFreedom:
    """Return temperature as a degree of freedom, in K.

    A shape parameter in m^p changes by p times the expansion, a grating's lines per length by minus it; a surface moves
    away from the origin, the vertex of the primary, as if held by a structure that expands like the surface. Rims of
    apertures, nodes of grids and outer radii of Zernike terms stay. A telescope of one material keeps its shape and
    grows.

    Parameters
    ----------
    telescope : Telescope
        The telescope at the temperature of its prescription.
    expansion : float or mapping of str to float
        Relative expansion per K [1/K], of all surfaces or by surface; others do not change.
    dn_dt : mapping of str to float, optional
        Change of the refractive index per K [1/K] of the media behind surfaces, by surface.

    Returns
    -------
    DegreeOfFreedom
        Named "temperature"; for ``DegreesOfFreedom((thermal(...),))``.

    Raises
    ------
    UnknownNameError
        If no surface has a name.
    DomainError
        If a number is not finite, or a surface does not refract.
    """
    by_surface = (
        dict(expansion) if isinstance(expansion, Mapping) else dict.fromkeys(telescope.surface_names, expansion)
    )
    of: dict[str, float] = {}
    for name, rate in by_surface.items():
        surface = telescope.surface(name)
        if not np.isfinite(rate):
            raise DomainError(f"expansion of {name} = {rate!r}: expected a finite number per K")
        for axis, position in zip(("dx", "dy", "dz"), surface.vertex, strict=True):
            of[f"{name}.{axis}"] = rate * position
        for term, value in surface.shape.parameters.items():
            if not re.search(r"node\[|curvature", term) and np.isfinite(value):
                of[f"{name}.{term}"] = rate * _power(term_unit(surface.shape, term)) * value
        if surface.grating is not None:
            of[f"{name}.lines_per_mm"] = -rate * surface.grating.lines_per_mm
    for name, rate in (dn_dt or {}).items():
        if telescope.surface(name).interaction != Interaction.REFRACT or not np.isfinite(rate):
            raise DomainError(f"dn_dt of {name} = {rate!r}: expected a number per K, behind a refracting surface")
        of[f"{name}.n"] = float(rate)
    return DegreeOfFreedom("temperature", "K", {address: change for address, change in of.items() if change})


def _power(unit: str) -> int:
    """Return the power of metres of a unit."""
    return {"": 0, "m": 1, "1/m": -1}[unit] if unit in ("", "m", "1/m") else int(unit.removeprefix("m^"))
