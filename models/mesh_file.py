"""Triangle meshes from files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, cast

from ..core.errors import PrescriptionError
from ..core.files import require_file

if TYPE_CHECKING:
    import trimesh

#: Suffixes of mesh files that trimesh reads without further packages.
MESH_SUFFIXES = (".stl", ".glb", ".gltf", ".obj", ".ply", ".off")


def load_mesh(path: str | os.PathLike[str], *, merged: bool) -> trimesh.Trimesh:
    """Return the content of an STL, GLB, OBJ, PLY or OFF file, in the unit of the file.

    If ``merged``, all meshes of the file become one, with equal vertices merged; otherwise nothing is changed. A
    PrescriptionError names a file that cannot be read as a mesh, or has no triangles.
    """
    # Imported here: loading trimesh takes as long as everything else that a telescope needs.
    import trimesh

    path = Path(path)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise PrescriptionError(f"expected a mesh file that ends in {', '.join(MESH_SUFFIXES)}", file=path)
    require_file(path, PrescriptionError)
    try:
        # Unless merged, unprocessed: processing drops vertices that are not finite and joins corners.
        mesh = trimesh.load(path, force="mesh") if merged else trimesh.load_scene(path, process=False)
    except Exception as error:  # trimesh's readers raise whatever their parsers do
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise PrescriptionError(f"cannot be read as a mesh ({reason})", file=path) from None
    parts = mesh.geometry.values() if isinstance(mesh, trimesh.Scene) else [mesh]
    if not any(len(getattr(part, "faces", ())) for part in parts):
        raise PrescriptionError("expected a mesh with at least one triangle", file=path)
    return cast("trimesh.Trimesh", mesh.to_mesh() if isinstance(mesh, trimesh.Scene) else mesh)
