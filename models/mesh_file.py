"""Triangle meshes from files."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from ..core.errors import PrescriptionError, error_context, shown
from ..core.files import parsing, read_bytes

if TYPE_CHECKING:
    import trimesh

#: Suffixes of mesh files that trimesh reads without further packages.
MESH_SUFFIXES = (".stl", ".glb", ".gltf", ".obj", ".ply", ".off")
#: Largest mesh file [byte]: five million triangles of a binary STL.
MAX_MESH_BYTES = 256_000_000


class _Beside(Mapping[str, bytes]):
    """Files that a mesh file names, by their names: from its own folder, and no devices."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __getitem__(self, name: str) -> bytes:
        parts = Path(name).parts
        if not parts or Path(name).is_absolute() or ".." in parts:
            raise PrescriptionError(f"names the file {shown(name)}: expected one in its own folder")
        return read_bytes(self._folder / name, PrescriptionError, max_bytes=MAX_MESH_BYTES)

    def __iter__(self) -> Iterator[str]:
        return (path.name for path in self._folder.iterdir())

    def __len__(self) -> int:
        return sum(1 for _ in self)


def files_of_mesh(path: Path) -> list[str]:
    """Return the files that a GLTF file names beside itself: buffers and pictures; other formats name none."""
    if path.suffix.lower() != ".gltf":
        return []
    raw = read_bytes(path, PrescriptionError, max_bytes=MAX_MESH_BYTES)
    try:
        content = json.loads(raw)
        named = [entry.get("uri") for key in ("buffers", "images") for entry in content.get(key, ())]
    except (ValueError, AttributeError, TypeError, RecursionError):
        # Not JSON, or no GLTF: what reads the mesh says so.
        return []
    return [uri for uri in named if isinstance(uri, str) and not uri.startswith("data:")]


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
    data = io.BytesIO(read_bytes(path, PrescriptionError, max_bytes=MAX_MESH_BYTES))
    # Unless merged, unprocessed: processing drops vertices that are not finite and joins corners.
    how: dict[str, Any] = {"force": "mesh"} if merged else {"process": False}
    load = trimesh.load if merged else trimesh.load_scene
    with parsing(path, "cannot be read as a mesh", PrescriptionError), error_context(file=path):
        mesh: Any = load(data, file_type=path.suffix.lower()[1:], resolver=_Beside(path.parent), **how)
    geometries = mesh.geometry.values() if isinstance(mesh, trimesh.Scene) else [mesh]
    if not any(len(getattr(geometry, "faces", ())) for geometry in geometries):
        raise PrescriptionError("expected a mesh with at least one triangle", file=path)
    return cast("trimesh.Trimesh", mesh.to_mesh() if isinstance(mesh, trimesh.Scene) else mesh)
