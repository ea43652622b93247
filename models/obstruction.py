"""Obstructions: triangle meshes of a camera body, spider vanes or a whole top end that block light."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.arguments import check_arguments
from ..core.errors import PrescriptionError, error_context
from .content_equality import ContentEquality
from .mesh_file import load_mesh

if TYPE_CHECKING:
    import trimesh


@check_arguments
@dataclass(frozen=True, eq=False)
class Obstruction(ContentEquality):
    """A mesh that blocks every ray through one of its triangles.

    The triangles may form open or closed bodies; they block light from both sides. Triangles and rays are compared in
    single precision, good to some micrometres. The last 10 um before and after a surface are exempt, so a mount may
    touch its mirror; the mirrors and lenses themselves do not belong into the mesh.

    Parameters
    ----------
    name : str
        Name, unique within its telescope.
    triangles : ndarray, shape [n_triangle, 3, 3]
        Corners (x, y, z) of each triangle [m], telescope frame.
    before : tuple of str, optional
        Names of mirrors, lens surfaces or detectors: only the light on its way to these is blocked, baffle planes in
        between included. By default, all light from the sky to the last surface except inside lenses.

    Raises
    ------
    PrescriptionError
        If the mesh is empty, or a corner is not finite.
    """

    name: str
    triangles: np.ndarray
    before: tuple[str, ...] | None = None

    def __repr__(self) -> str:
        return f"<Obstruction {self.name}: {len(self.triangles)} triangles>"

    def __post_init__(self) -> None:
        self._freeze(triangles=np.float32)
        triangles = self.triangles
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

    @classmethod
    def from_mesh(
        cls,
        name: str,
        mesh: trimesh.Trimesh | trimesh.Scene,
        *,
        scale: float = 1.0,
        before: tuple[str, ...] | None = None,
    ) -> Obstruction:
        """Return the obstruction of a mesh, or of all meshes of a scene.

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
        scene = load_mesh(path, merged=False)
        with error_context(file=path):
            return cls.from_mesh(name or Path(path).stem, scene, scale=scale, before=before)

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
    def _content(self) -> tuple[Hashable, ...]:
        return self.name, self.before, hashlib.sha256(self.triangles.tobytes()).digest()
