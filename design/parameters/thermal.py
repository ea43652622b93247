"""What a change of temperature does, to first order: a linear combination of parameters, and so a degree of freedom."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from ...core.errors import DomainError
from ...models.surface import Interaction
from ...models.telescope import Telescope
from .degrees_of_freedom import Freedom
from .surface_deformation import figure_unit


def thermal(
    telescope: Telescope, expansion: float | Mapping[str, float], dn_dt: Mapping[str, float] | None = None
) -> Freedom:
    """Return temperature as a degree of freedom, in K.

    Every length of a surface's figure, a quantity in m^p, changes by p times the expansion; a surface moves away from
    the telescope's origin, the vertex of the primary, as if held by a structure that expands like the surface. Rims of
    apertures, nodes of grids and the radii that Zernike terms are over stay as they are: they do not bend light. A
    telescope that is one material throughout keeps its shape and becomes larger.

    Parameters
    ----------
    telescope : Telescope
        The telescope at the temperature that its prescription holds at.
    expansion : float or mapping of str to float
        Relative expansion per K [1/K]: of everything, or by surface; surfaces that are not named do not change.
    dn_dt : mapping of str to float, optional
        Change of the refractive index per K [1/K] of the media that begin behind surfaces, by surface.

    Returns
    -------
    Freedom
        Named "temperature"; for ``DegreesOfFreedom((thermal(...),))``.

    Raises
    ------
    UnknownNameError
        If no surface has a name.
    DomainError
        If a figure is not finite, or a medium does not begin behind a surface.
    """
    by_surface = (
        dict(expansion) if isinstance(expansion, Mapping) else dict.fromkeys(telescope.surface_names, expansion)
    )
    of: dict[str, float] = {}
    for name, rate in by_surface.items():
        surface = telescope.surface(name)
        if not np.isfinite(rate):
            raise DomainError(f"expansion of {name} = {rate!r}: expected a finite number per K")
        for axis, place in zip(("dx", "dy", "dz"), surface.vertex, strict=True):
            of[f"{name}.{axis}"] = rate * place
        for figure, value in surface.shape.parameters.items():
            if not re.search(r"node\[|curvature", figure) and np.isfinite(value):
                of[f"{name}.{figure}"] = rate * _power(figure_unit(surface.shape, figure)) * value
    for name, rate in (dn_dt or {}).items():
        if telescope.surface(name).interaction != Interaction.REFRACT or not np.isfinite(rate):
            raise DomainError(f"dn_dt of {name} = {rate!r}: expected a number per K, behind a refracting surface")
        of[f"{name}.n"] = float(rate)
    return Freedom("temperature", "K", {address: change for address, change in of.items() if change})


def _power(unit: str) -> int:
    """Return the power of metres that a unit of a figure is."""
    return {"": 0, "m": 1, "1/m": -1}[unit] if unit in ("", "m", "1/m") else int(unit.removeprefix("m^"))
