"""Solid things in the light's way: triangle meshes of a camera body, spider vanes or a whole top end."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import PrescriptionError, error_context

if TYPE_CHECKING:
    import trimesh

#: Endings of files that meshes are read from: those that trimesh reads with nothing else installed.
MESH_SUFFIXES = (".stl", ".glb", ".gltf", ".obj", ".ply", ".off")


@dataclass(frozen=True, eq=False)
class Obstruction:
    """A mesh that blocks every ray which meets one of its triangles on the stated parts of its way.

    Any soup of triangles will do, open or closed: light does not pass a triangle from either side, and what lies inside
    does not matter. Triangles are kept in single precision, and rays are tested in it: what is blocked is good to some
    micrometres. The last 10 um before and after a surface are not looked at, so a mount may touch its mirror; the
    mirrors and lenses themselves do not belong into the mesh.

    Parameters
    ----------
    name : str
        Name, unique within its telescope.
    triangles : ndarray, shape [n_triangle, 3, 3]
        Corners (x, y, z) of each triangle [m], telescope frame.
    before : tuple of str, optional
        Names of mirrors, lens surfaces or detectors: only the light on its way to these is blocked, baffle planes in
        between included. By default, all ways from the sky to the last surface that do not lie inside a lens.

    Raises
    ------
    PrescriptionError
        If the mesh is empty, or a corner is not finite.
    """

    name: str
    triangles: np.ndarray
    before: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        triangles = np.array(self.triangles, dtype=np.float32)
        if triangles.ndim != 3 or triangles.shape[1:] != (3, 3) or len(triangles) == 0:
            raise PrescriptionError(
                f"obstruction {self.name!r}: mesh of shape {triangles.shape}: expected at least one triangle, [n, 3, 3]"
            )
        bad = int(np.count_nonzero(~np.isfinite(triangles).all(axis=(1, 2))))
        if bad:
            raise PrescriptionError(
                f"obstruction {self.name!r}: {bad} of {len(triangles)} triangles: expected finite corners"
            )
        if self.before is not None and not self.before:
            raise PrescriptionError(f"obstruction {self.name!r}: before = []: expected names of surfaces, or no list")
        triangles.flags.writeable = False
        object.__setattr__(self, "triangles", triangles)

    @classmethod
    def from_mesh(
        cls,
        name: str,
        mesh: trimesh.Trimesh | trimesh.Scene,
        *,
        scale: float = 1.0,
        before: tuple[str, ...] | None = None,
    ) -> Obstruction:
        """Return the obstruction that a mesh, or all meshes of a scene, make in the telescope frame.

        Parameters
        ----------
        name : str
            Name of the obstruction.
        mesh : trimesh.Trimesh or trimesh.Scene
            The mesh, in the telescope frame but for its unit.
        scale : float
            Metres in one unit of the mesh: 1e-3 for a drawing in millimetres.
        before : tuple of str, optional
            As for the class.
        """
        if not (np.isfinite(scale) and scale > 0):
            raise PrescriptionError(f"obstruction {name!r}: scale = {scale!r}: expected a positive number")
        # Only where it is needed: to load it takes as long as everything else that a telescope needs.
        import trimesh

        solid = mesh.to_mesh() if isinstance(mesh, trimesh.Scene) else mesh
        triangles = np.asarray(solid.vertices, dtype=np.float64)[np.asarray(solid.faces, dtype=np.int64)]
        return cls(name, scale * triangles, before)

    @classmethod
    def from_file(
        cls,
        path: str | os.PathLike[str],
        *,
        name: str | None = None,
        scale: float = 1.0,
        before: tuple[str, ...] | None = None,
    ) -> Obstruction:
        """Return the obstruction in an STL, GLB, OBJ, PLY or OFF file; arguments as for :meth:`from_mesh`.

        Raises
        ------
        PrescriptionError
            If the file cannot be read as a mesh, is empty, or holds numbers that are not finite.
        """
        import trimesh

        path = Path(path)
        if path.suffix.lower() not in MESH_SUFFIXES:
            raise PrescriptionError(f"expected a mesh that ends in one of {', '.join(MESH_SUFFIXES)}", file=path)
        if not path.is_file():
            raise PrescriptionError("no such file", file=path)
        try:
            # Unprocessed: trimesh would drop what is not finite and join corners.
            scene = trimesh.load_scene(path, process=False)
        except Exception as error:  # trimesh's readers raise whatever their parsers do
            reason = " ".join(str(error).split())[:120]
            raise PrescriptionError(f"cannot be read as a mesh ({reason or type(error).__name__})", file=path) from None
        if not any(len(getattr(g, "faces", ())) for g in scene.geometry.values()):
            raise PrescriptionError("expected a mesh with at least one triangle", file=path)
        with error_context(file=path):
            return cls.from_mesh(name or path.stem, scene, scale=scale, before=before)

    @property
    def mesh(self) -> trimesh.Trimesh:
        """The triangles as a mesh [m], telescope frame, for pictures."""
        import trimesh

        corners = self.triangles.astype(np.float64).reshape(-1, 3)
        return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)

    @property
    def height(self) -> float:
        """Height of the highest corner [m], telescope frame."""
        return float(self.triangles[..., 2].max())

    @cached_property
    def _content(self) -> tuple[Any, ...]:
        return self.name, self.before, hashlib.sha256(self.triangles.tobytes()).digest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Obstruction) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)
