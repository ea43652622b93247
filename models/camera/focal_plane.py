"""The focal plane: the height of every CCD's surface, drawn from a budget, measured, or flat.

Heights are positive along +z of the telescope frame, which is the direction that light travels when it meets the LSST
detector. Camera teams often use the opposite sign: change it before a table or mesh enters here.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arguments import check_arguments
from ...core.errors import DomainError, UnknownNameError
from ...core.number_text import counted
from ...core.units import metres, plane_points, radians, require_count
from .camera import Camera
from .cameras import load_camera
from .ccd_surfaces import CcdSurfaces
from .height_budget import (
    BUDGET_KEYS,
    TERMS,
    BudgetName,
    HeightBudget,
    chosen_terms,
    draw_heights,
    load_budget,
)
from .height_fit import fit_heights, table_column
from .height_map import HeightMap

if TYPE_CHECKING:
    import trimesh
    from astropy.table import Table

# [m], by which rims of tiles of files may lie outside: 0.34 m in a float32 STL are good to 15 nm.
_MESH_MARGIN = 1e-7
#: Most cells along a side of a CCD.
_MOST_CELLS = 1024


@check_arguments
@dataclass(frozen=True, eq=False)
class FocalPlane(HeightMap):
    """Height of the CCD surfaces over the nominal focal plane.

    Made by `from_budget`, `flat`, `as_measured`, `from_file`, `from_heights` or `from_mesh`.

    Parameters
    ----------
    camera : Camera
        Names and places of the CCDs.
    surfaces : CcdSurfaces
        Height function of each CCD.
    measured : ndarray of bool, shape (n_ccd,)
        CCDs with measured heights; all False for a drawn or flat focal plane.
    terms : tuple of str
        Terms of the height budget that are on.
    budget : HeightBudget, optional
        Height budget of the draw.
    seed : int, optional
        Seed of the draw.
    residual : ndarray, shape (n_ccd,), optional
        Rms of the measurements of a file about their fit [m]; NaN without points.
    """

    camera: Camera
    surfaces: CcdSurfaces
    measured: NDArray[np.bool_]
    terms: tuple[str, ...] = ()
    budget: HeightBudget | None = None
    seed: int | None = None
    residual: np.ndarray | None = None

    def __repr__(self) -> str:
        measured = f", heights of {self.measured.sum()} measured" if self.measured.any() else ""
        drawn = "" if self.seed is None else f", seed {self.seed}"
        return f"<FocalPlane of {self.camera.name}: {counted(len(self.camera), 'CCD')}{measured}{drawn}>"

    @classmethod
    def from_budget(
        cls,
        camera: str | Camera = "lsst",
        *,
        seed: int,
        terms: str | Iterable[str] | None = None,
        budget: BudgetName | HeightBudget = "simulated",
    ) -> FocalPlane:
        """Draw heights from the budget of Jee & Tyson 2011, Table 1.

        Parameters
        ----------
        camera : str or Camera
            Camera, or its name.
        seed : int
            Seed, not negative. Every term has its own random streams.
        terms : iterable of str, optional
            Terms to include, of "global", "raft", "ccd", "tilt", "potato_chip"; all by default.
        budget : str or HeightBudget
            "simulated" (the paper's simulation), "specification", or sizes of your own.

        Raises
        ------
        UnknownNameError
            If the camera or a term does not exist.
        ConfigError
            If there is no such budget.
        DomainError
            If the seed is not a whole number of zero or more.
        """
        camera = load_camera(camera)
        budget = load_budget(budget) if isinstance(budget, str) else budget
        if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
            raise DomainError(f"seed = {seed!r}: expected a whole number of zero or more")
        ordered_terms = chosen_terms(terms)
        surfaces = draw_heights(camera, budget, int(seed), ordered_terms)
        return cls(camera, surfaces, np.zeros(len(camera), dtype=bool), ordered_terms, budget, int(seed))._placed()

    @classmethod
    def flat(cls, camera: str | Camera = "lsst") -> FocalPlane:
        """Return a focal plane of flat CCDs where the camera has them, which is at height zero for most."""
        camera = load_camera(camera)
        return cls(camera, CcdSurfaces.level(camera.half_sizes), np.zeros(len(camera), dtype=bool))._placed()

    @classmethod
    def as_measured(cls, name: str = "lsstcam") -> FocalPlane:
        """Return the focal plane of a camera as built.

        Parameters
        ----------
        name : str
            "lsstcam": cold metrology of Rubin's LSSTCam (Document-37242), circular Zernikes to Noll index 28 of each
            CCD, from imSim (LSST DESC, BSD-3-Clause). Outside the measured part of a CCD, usually 0.2 to 0.6 mm at its
            rims, the heights go on along their tangents.

        Raises
        ------
        UnknownNameError
            If there is no such camera.
        """
        from ..io.heights.zernike_table import AS_MEASURED, bundled_heights

        heights, camera = bundled_heights(name), load_camera(AS_MEASURED[name][0])
        return cls(camera, *heights.on(camera))

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], camera: str | Camera = "lsst") -> FocalPlane:
        """Read measured heights from a file.

        A :class:`~pachon.HeightWarning` names CCDs without heights, which lie at zero, CCDs with gaps, and heights of
        an unlikely size.

        Parameters
        ----------
        path : str or path
            Table (.ecsv, .fits) with columns x, y, z of points, or with Zernike coefficients of each CCD as imSim has
            them (DET_NAME, ORIGIN_X..., ZK); or FITS images, one extension a CCD. Units must be stated. The frame is
            the entry ``frame`` of the metadata: ``telescope`` (ours, heights along +z) or ``CCS`` (Rubin's camera: z
            reversed), by default CCS for Zernike coefficients and ``telescope`` for all else.
        camera : str or Camera
            Camera, or its name.

        Returns
        -------
        FocalPlane
            `residual` is what the fit of points or pixels leaves; Zernike coefficients are taken as they are.

        Raises
        ------
        PrescriptionError
            If the file cannot be read, or lacks columns, units or a known frame.
        DomainError
            If none of it lies on a CCD, or a CCD has too few points.
        """
        camera = load_camera(camera)
        from ..io.heights.file import read_heights

        heights = read_heights(Path(path), camera)
        return cls(camera, heights.surfaces, heights.measured, residual=heights.residual)

    @classmethod
    def from_heights(cls, table: Any, camera: str | Camera = "lsst") -> FocalPlane:
        """Fit measured heights.

        Parameters
        ----------
        table : Table, structured array or mapping
            Columns x, y, z of scattered points, z positive along +z of the telescope frame. Units of the columns
            are honoured; columns without a unit are metres. Points off every CCD are left aside.
        camera : str or Camera
            Camera, or its name.

        Returns
        -------
        FocalPlane
            `measured` is True for CCDs with points; the others lie at height zero.

        Raises
        ------
        DomainError
            If a column is missing or not finite, no point lies on a CCD, or a CCD has points but fewer than three
            or all on one line.
        """
        camera = load_camera(camera)
        x, y, z = (table_column(table, name) for name in "xyz")
        if not x.shape == y.shape == z.shape or x.ndim != 1:
            raise DomainError(f"heights: columns of shape {x.shape}, {y.shape}, {z.shape}: expected one length")
        surfaces, measured = fit_heights(camera, x, y, z)
        return cls(camera, surfaces, measured)

    @classmethod
    def from_mesh(cls, mesh: trimesh.Trimesh, camera: str | Camera = "lsst") -> FocalPlane:
        """Fit the vertices of a surface mesh as `from_heights` does: metres, z positive along +z of the telescope."""
        camera = load_camera(camera)
        x, y, z = np.asarray(mesh.vertices, dtype=np.float64).T
        return cls(camera, *fit_heights(camera, x, y, z, margin=_MESH_MARGIN))

    def with_terms(self, terms: str | Iterable[str]) -> FocalPlane:
        """Return the focal plane of the same seed and budget with only these terms.

        Raises
        ------
        UnknownNameError
            If a term does not exist.
        DomainError
            If the heights were not drawn from a budget.
        """
        if self.budget is None or self.seed is None:
            raise DomainError(f"terms = {terms!r}: expected a focal plane drawn from a height budget")
        return FocalPlane.from_budget(self.camera, seed=self.seed, terms=terms, budget=self.budget)

    @check_arguments
    def scaled(self, factors: float | Mapping[str, float]) -> FocalPlane:
        """Return the focal plane with scaled heights, without drawing them again.

        Parameters
        ----------
        factors : float or mapping of str to float
            Factor of all heights; or factors, not negative, by which terms of the budget are larger than now, 1 for
            terms that are left out. The result is that of :meth:`from_budget` with the larger budget.

        Raises
        ------
        UnknownNameError
            If a term does not exist.
        DomainError
            If a factor is not finite, that of a term is negative, or the heights were not drawn from a budget.
        """
        by_term: Mapping[str, float] = factors if isinstance(factors, Mapping) else {}
        values = by_term if isinstance(factors, Mapping) else {"factors": factors}
        for name, value in values.items():
            if not np.isfinite(value) or (by_term and value < 0):
                raise DomainError(f"{name} = {value!r}: expected a finite factor{', not negative' if by_term else ''}")
        if not isinstance(factors, Mapping):
            residual = None if self.residual is None else abs(factors) * self.residual
            surfaces = self.surfaces.scaled(factors)
            return replace(self, surfaces=surfaces, residual=residual, terms=(), budget=None, seed=None)
        try:
            chosen_terms(by_term)
        except UnknownNameError as error:
            raise error.within(key="factors") from None
        if self.budget is None or self.seed is None:
            raise DomainError("factors of terms: expected a focal plane drawn from a height budget")
        parts = [
            draw_heights(self.camera, self.budget, self.seed, (term,)).scaled(by_term.get(term, 1.0))
            for term in self.terms
        ]
        nothing = CcdSurfaces.level(self.camera.half_sizes)
        polynomial = sum((part.polynomial for part in parts), nothing.polynomial)
        # One term at most has waves.
        waves = sum((part.waves for part in parts), nothing.waves)
        sizes = {BUDGET_KEYS[term]: by_term.get(term, 1.0) * getattr(self.budget, BUDGET_KEYS[term]) for term in TERMS}
        surfaces = CcdSurfaces(self.camera.half_sizes, polynomial, waves)
        return replace(self, surfaces=surfaces, budget=replace(self.budget, **sizes))._placed()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the CCDs."""
        return self.camera.ccd_names

    @property
    def polynomial(self) -> np.ndarray:
        """Coefficients [m] of 1, u, v, u^2, uv, v^2, u^3, u^2 v, u v^2, v^3, shape (n_ccd, 10)."""
        return self.surfaces.polynomial

    @property
    def waves(self) -> np.ndarray:
        """Amplitude [m], kx, ky [rad/m] and phase [rad] of two waves a CCD, shape (n_ccd, 2, 4)."""
        return self.surfaces.waves

    @property
    def grid(self) -> np.ndarray | None:
        """Coefficients [m] of uniform cubic B-splines, index order CCD, y, x, shape (n_ccd, m, m), or None."""
        return self.surfaces.grid

    def ccd_at(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return the index of the CCD at (x, y) [m]; -1 in a gap or outside."""
        return self.camera.ccd_at(x, y)

    def ccd_index(self, name: str) -> int:
        """Return the index of the CCD of that name."""
        return self.camera.ccd_index(name)

    def with_moved(self, name: str, *, dz: ArrayLike = 0.0, rx: ArrayLike = 0.0, ry: ArrayLike = 0.0) -> FocalPlane:
        """Return the focal plane with one CCD, or all CCDs of a raft, moved as a rigid body.

        Angles are small: the surface is sheared by their tangents, which for 1e-3 rad is right to 1e-6 of its height.

        Parameters
        ----------
        name : str
            Name of a CCD or a raft.
        dz : float or Quantity
            Displacement along +z of the telescope frame [m].
        rx, ry : float or Quantity
            Rotation about the axes through the centre of the CCD or raft [rad], right-handed: a positive rx lifts the
            side at larger y, a positive ry lowers that at larger x.

        Raises
        ------
        UnknownNameError
            If there is no such CCD or raft.
        DomainError
            If an argument is not one finite number.
        """
        camera = self.camera
        members = np.array(camera.members(name))
        lift, turn_x, turn_y = metres(dz, "dz"), radians(rx, "rx"), radians(ry, "ry")
        for label, value in (("dz", lift), ("rx", turn_x), ("ry", turn_y)):
            if value.ndim or not np.isfinite(value):
                raise DomainError(f"{name} {label} = {value.tolist()}: expected one finite number")
        x, y = (camera.centers[members] - camera.centers[members].mean(axis=0)).T
        along_x, along_y = np.broadcast_arrays(-np.tan(turn_y), np.tan(turn_x), x)[:2]
        slope_u, slope_v = camera.frame(members).along_ccd(along_x, along_y)
        polynomial = self.surfaces.polynomial.copy()
        polynomial[members, 0] += lift + y * np.tan(turn_x) - x * np.tan(turn_y)
        polynomial[members, 1] += camera.half_sizes[members, 0] * slope_u
        polynomial[members, 2] += camera.half_sizes[members, 1] * slope_v
        return replace(self, surfaces=replace(self.surfaces, polynomial=polynomial))

    def _placed(self) -> FocalPlane:
        """Return the focal plane with each CCD at its nominal height and tilt besides."""
        plane, placement = self, self.camera.placement
        for name, (lift, turn_x, turn_y) in zip(self.names, () if placement is None else placement, strict=False):
            plane = plane.with_moved(name, dz=lift, rx=turn_x, ry=turn_y)
        return plane

    def height(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return the height of the CCD surface.

        Parameters
        ----------
        x, y : float, array or Quantity
            Position on the focal plane [m].

        Returns
        -------
        ndarray
            Height [m], positive along +z of the telescope frame; NaN in a gap or outside.
        """
        return self._on_ccds(self.surfaces.height, x, y)

    def gradient(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return the slopes (dh/dx, dh/dy) of the CCD surface [rad], shape (..., 2); arguments as for `height`."""
        return self._on_ccds(self.slopes_on, x, y, 2)

    def measured_at(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return whether (x, y) [m] lies on the measured part of a CCD, which for most heights is all of it."""
        return self._on_ccds(self.surfaces.measured_at, x, y) == 1.0

    def slopes_on(self, ccd: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
        """Return the slopes along the axes of the focal plane at places on CCDs [m], shape [n, 2]."""
        return np.stack(self.camera.frame(ccd).along_focal_plane(*self.surfaces.gradient(ccd, dx, dy).T), axis=-1)

    def _on_ccds(self, function: Callable[..., np.ndarray], x: ArrayLike, y: ArrayLike, *values: int) -> np.ndarray:
        """Return a function of CCD index and local position [m], with an axis of values, at x, y; NaN off the CCDs."""
        px, py = plane_points(x, y)
        ccd = self.camera.ccd_at(px, py)
        lit = ccd >= 0
        dx, dy = self.camera.to_local(ccd, px, py)
        out = np.full((*lit.shape, *values), np.nan)
        out[lit] = function(ccd[lit], dx[lit], dy[lit])
        return out

    def to_mesh(self, cells_per_ccd: int = 32) -> trimesh.Trimesh:
        """Return the CCD surfaces as triangles, one tile for each CCD.

        Parameters
        ----------
        cells_per_ccd : int
            Cells along the side of a CCD; each is two triangles.

        Returns
        -------
        Trimesh
            Vertices [m], z the height; normals along +z. Tiles follow the order of `names` with
            ``2 * cells_per_ccd**2`` faces each. Between vertices it departs from the surface by up to `facet_error`.
        """
        import trimesh  # half a second

        cells = require_count(cells_per_ccd, "cells_per_ccd", 1, _MOST_CELLS)
        vertices = np.stack(self._nodes(cells)[1:], axis=-1)
        index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
        tile = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=2).reshape(-1, 3)
        faces = tile + (np.arange(len(self.camera)) * index.size)[:, None, None]
        return trimesh.Trimesh(vertices, faces.reshape(-1, 3), process=False)

    def facet_error(self, cells_per_ccd: int = 32) -> np.ndarray:
        """Return an upper bound of the distance between mesh and surface.

        On a right triangle with two sides of one cell, linear interpolation is off by at most the largest second
        derivative in any direction times the square of the cell's diagonal over 8.

        Parameters
        ----------
        cells_per_ccd : int
            As for `to_mesh`.

        Returns
        -------
        ndarray, shape (n_ccd,)
            Upper bound of ``|mesh height - height|`` [m] on each CCD.
        """
        cell = 2.0 * self.camera.half_sizes / require_count(cells_per_ccd, "cells_per_ccd", 1, _MOST_CELLS)
        return 0.125 * self.surfaces.curvature_bound() * (cell**2).sum(axis=1)

    def to_table(self, cells_per_ccd: int = 32) -> Table:
        """Return heights on a grid of each CCD, as a table that `from_heights` reads.

        Parameters
        ----------
        cells_per_ccd : int
            Cells along the side of a CCD; there are ``(cells_per_ccd + 1)**2`` points on it, strictly inside.

        Returns
        -------
        Table
            Columns ccd (name), x, y, z [m].
        """
        from astropy.table import Table

        # A part in 1e9 inside the rim, so that no point is lost to rounding when the table is read back.
        ccd, *points = self._nodes(require_count(cells_per_ccd, "cells_per_ccd", 1, _MOST_CELLS), scale=1.0 - 1e-9)
        return Table([np.array(self.names)[ccd], *points], names=("ccd", "x", "y", "z"), units=(None, "m", "m", "m"))

    def _nodes(self, cells: int, scale: float = 1.0) -> tuple[np.ndarray, ...]:
        """Return CCD index, x, y and height [m] of the nodes of a grid on every CCD."""
        ccd, dx, dy = self.camera.nodes(cells, scale)
        return ccd, *self.camera.from_local(ccd, dx, dy), self.surfaces.height(ccd, dx, dy)
