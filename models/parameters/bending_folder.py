"""Bending modes of Rubin's mirrors in the files of batoid_rubin: ``bend.yaml`` and FITS images beside it.

A mode of a mirror is a sum of Zernike polynomials, ``zk`` [mode, j] with j from 0, which does nothing, and of a map,
``grid`` [4, mode, row, column] on nodes ``coords`` [2, node] [m]; both in metres per micrometre of the mode. The first
of the four maps is the sag; the others, its slopes, follow here from the sag by central differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import PrescriptionError, error_context
from ...core.schema import Section, Whole, validated
from ..io.grid_file import fits_image
from ..io.yaml.values import Number, PositiveNumber, Text
from ..shapes.grid import GridSag
from ..shapes.modes import GridModes
from ..shapes.polynomial import ZernikeSag
from .degrees_of_freedom import DegreeOfFreedom, DegreesOfFreedom, SurfaceDeformation

#: Key by which a file is known as one of bending modes.
CHOICE = "use_m1m3_modes"
#: Modes are in metres per micrometre.
_PER_METRE = 1e6


class ZernikeFile(Section):
    """Zernike coefficients of the modes of a mirror."""

    file: Text
    R_outer: PositiveNumber
    R_inner: Number = 0.0


class GridFile(Section):
    """Maps of the modes of a mirror, and their nodes."""

    file: Text
    coords: Text


class MirrorSection(Section):
    """Bending modes of a mirror."""

    zk: ZernikeFile
    grid: GridFile


class BendingFile(Section):
    """Bending modes of the three mirrors, and those to use, in order; M1 and M3 bend as one."""

    M1: MirrorSection
    M2: MirrorSection
    M3: MirrorSection
    use_m1m3_modes: tuple[Whole, ...]
    use_m2_modes: tuple[Whole, ...]


def bending_modes(content: dict[str, Any], path: Path, before: Sequence[DegreeOfFreedom] = ()) -> DegreesOfFreedom:
    """Return the bending modes of a folder as degrees of freedom [um], after others.

    They are M1M3_B1, M1M3_B2... and M2_B1, M2_B2..., in the order of the file. PrescriptionError with file, key, value
    and expected value.
    """
    file = validated(BendingFile, content, str(path), PrescriptionError)
    members, deformations = list(before), []
    for name, mirrors, key in (("M1M3", ("M1", "M3"), CHOICE), ("M2", ("M2",), "use_m2_modes")):
        modes: tuple[int, ...] = getattr(file, key)
        of: list[dict[str, float]] = [{} for _ in modes]
        for mirror in mirrors:
            with error_context(file=path, key=mirror):
                zernikes, maps = _read(getattr(file, mirror), path.parent, modes, key)
            section = getattr(file, mirror).zk
            rims = section.R_outer, section.R_inner
            nothing = ZernikeSag((0.0,) * (zernikes.shape[1] - 1), *rims)
            deformations.append(SurfaceDeformation(f"{mirror}_zernike", (mirror,), nothing))
            deformations.append(SurfaceDeformation(f"{mirror}_map", (mirror,), GridModes(maps)))
            for k, addresses in enumerate(of):
                terms = enumerate(zernikes[k])
                addresses |= {f"{mirror}_zernike.Z{j}": float(a) for j, a in terms if j > 0 and a != 0}
                addresses[f"{mirror}_map.B{k + 1}"] = 1.0
        members += [DegreeOfFreedom(f"{name}_B{k + 1}", "um", addresses) for k, addresses in enumerate(of)]
    return DegreesOfFreedom(tuple(members), tuple(deformations), path.parent.name, source=f"batoid_rubin, {path}")


def _read(
    section: MirrorSection, folder: Path, modes: tuple[int, ...], key: str
) -> tuple[np.ndarray, dict[str, GridSag]]:
    """Return Zernike coefficients [mode, j] and maps of chosen modes of a mirror, per metre of the mode."""
    _, zernikes = fits_image(folder / section.zk.file, 2)
    _, grids = fits_image(folder / section.grid.file, 4)
    _, nodes = fits_image(folder / section.grid.coords, 2)
    count = min(len(zernikes), grids.shape[1])
    for mode in modes:
        if mode >= count:
            raise PrescriptionError(f"{key} = {mode}: expected modes from 0 to {count - 1}, as many as the files have")
    maps = {}
    for number, mode in enumerate(modes, start=1):
        with error_context(file=folder / section.grid.file):
            maps[f"B{number}"] = GridSag(nodes[0], nodes[1], _PER_METRE * grids[0, mode])
    return _PER_METRE * zernikes[list(modes)], maps
