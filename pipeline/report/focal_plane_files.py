"""The focal plane of a run as files: a mesh for any viewer, and a table of heights."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...core.files import write_bytes
from ...core.products import write_ecsv
from ..experiment import Experiment

_MESH_CELLS = 16


def write_focal_plane(experiment: Experiment, folder: Path) -> None:
    """Write the CCD surfaces as a mesh for any viewer, and heights of CCD centres and corners as a table."""
    import trimesh  # half a second
    from trimesh.exchange.gltf import export_glb

    mesh = experiment.focal_plane.to_mesh(_MESH_CELLS)
    write_bytes(folder / "focal_plane.glb", export_glb(trimesh.Scene(mesh)))
    table = experiment.focal_plane.to_table(2)
    write_ecsv(
        folder / "focal_plane.ecsv",
        {
            "ccd": (np.asarray(table["ccd"]), "", "name of the CCD"),
            "x_mm": (np.round(np.asarray(table["x"]) * 1e3, 6), "mm", "detector x"),
            "y_mm": (np.round(np.asarray(table["y"]) * 1e3, 6), "mm", "detector y"),
            "height_um": (np.round(np.asarray(table["z"]) * 1e6, 6), "um", "height along +z, towards the sky"),
        },
        {"what": "heights at the corners, edges and centre of each CCD"},
    )
