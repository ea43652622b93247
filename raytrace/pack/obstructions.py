"""The obstructions of a telescope as meshes for the trace kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ...core.warp_arrays import warp_array
from ...models.surface import Interaction
from ...models.telescope import Telescope
from ..kernels.obstruction import PackedObstructions
from .meshes import warp_mesh
from .sequence import SurfaceSequence


def obstruction_table(telescope: Telescope | SurfaceSequence) -> np.ndarray:
    """Return the obstructions on the path of light to each surface, bool [n_surface, n_obstruction].

    Light on its way to a mirror, a lens surface or the detector crosses the baffle planes before it, which go with
    that surface. Space inside a lens, where the medium is not that in front of the telescope, is left out unless an
    obstruction names the surface behind it.
    """
    surfaces, obstructions = telescope.surfaces, telescope.obstructions
    blocked = np.zeros((len(surfaces), len(obstructions)), dtype=bool)
    goals = [s.name for s in surfaces]
    for row in reversed(range(len(surfaces) - 1)):
        if surfaces[row].interaction == Interaction.PASS:
            goals[row] = goals[row + 1]
    media = [telescope.medium_before, *(s.medium_after for s in surfaces)]
    for column, obstruction in enumerate(obstructions):
        for row in range(len(surfaces)):
            if obstruction.before is None:
                blocked[row, column] = media[row] == telescope.medium_before
            else:
                blocked[row, column] = goals[row] in obstruction.before
    return blocked


def pack_obstructions(telescope: Telescope | SurfaceSequence, device: str = "cpu") -> Any:
    """Return the telescope's obstructions as a :class:`PackedObstructions` struct on a device."""
    corners = [obstruction.triangles.reshape(-1, 3) for obstruction in telescope.obstructions]
    meshes = [warp_mesh(points, np.arange(len(points)), device) for points in corners]
    packed = PackedObstructions()
    packed.meshes = warp_array([mesh.id for mesh in meshes], wp.uint64, device=device)
    # Kernels refer to meshes by number only: the array of numbers owns the meshes.
    packed.meshes.meshes = meshes
    packed.blocks = warp_array(obstruction_table(telescope), wp.int32, device=device)
    return packed
