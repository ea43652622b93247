"""Reading of measured heights: tables of points or of Zernike coefficients (ECSV, FITS), and FITS images.

Points and pixels are fitted by :func:`~pachon.models.camera.height_fit.fit_heights`, each CCD by itself, so steps from
CCD to CCD stay; Zernike coefficients are taken as they are.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning

from ....core.errors import HeightWarning, PrescriptionError, error_context
from ....core.files import parsing, require_file, text_lines
from ....core.fits_files import open_fits
from ...camera.camera import Camera
from ...camera.ccd_surfaces import CcdSurfaces
from ...camera.height_fit import fit_heights
from .columns import frame_of, in_telescope_frame, lengths
from .images import image_points
from .zernike_table import COLUMNS, zernike_heights

#: Endings of files with heights.
ENDINGS = (".ecsv", ".fits", ".fit")
# Less of a CCD than this is a gap: rims without metrology are a few per cent.
_COVERED = 0.9
# Larger heights [m] than this are no heights of a focal plane, but another unit.
_LARGEST = 0.2e-3
# Cells a side into which a CCD is divided to find gaps.
_MOST_CELLS = 16
# Points that a cell should have.
_POINTS_PER_CELL = 4


@dataclass(frozen=True, eq=False)
class MeasuredHeights:
    """Height functions of the CCDs of a camera, and how well they were measured."""

    surfaces: CcdSurfaces
    measured: np.ndarray  #: which CCDs have heights, [n_ccd] bool
    residual: np.ndarray  #: rms of the measurements about their fit [m], [n_ccd]; NaN without points


def read_heights(path: str | Path, camera: Camera) -> MeasuredHeights:
    """Read measured heights of a camera's CCDs.

    A :class:`~pachon.HeightWarning` names CCDs without heights, with gaps, and with heights of an unlikely size.

    Raises
    ------
    PrescriptionError
        If the file cannot be read, has neither heights nor Zernike coefficients, units that are no lengths or an
        unknown frame.
    DomainError
        If none of it lies on a CCD, or a CCD has too few points.
    """
    path = Path(path)
    content = _content(path)
    with error_context(file=path):
        if isinstance(content, Table):
            if any(name in content.colnames for name in ("DET_NAME", "ZK")):
                surfaces, measured = zernike_heights(content, path).on(camera)
                heights = MeasuredHeights(surfaces, measured, np.full(len(camera), np.nan))
                covered = _measured_fraction(heights, camera)
            else:
                points = _table_points(content, path)
                if "ccd" in content.colnames:
                    _check_names(np.array([str(name).strip() for name in content["ccd"]]), points, camera)
                heights, covered = _fitted(points, camera)
        else:
            # Names of FITS extensions are the same in capitals, in which astropy writes them.
            ccd_names = {name.upper(): name for name in camera.ccd_names}
            images = {ccd_names[name.upper()]: xyz for name, xyz in content.items() if name.upper() in ccd_names}
            if not images:
                first = ", ".join(list(content)[:3])
                raise PrescriptionError(f"images {first}: expected names such as {camera.ccd_names[0]}", file=path)
            _warn_of_others(path, [name for name in content if name.upper() not in ccd_names])
            _check_places("image {}: has pixels", images, camera)
            heights, covered = _fitted(np.concatenate(list(images.values()), axis=1), camera)
    _warn(path, camera, heights, covered)
    return heights


def _content(path: Path) -> Table | dict[str, np.ndarray]:
    """Return the table of a file, or the points of its images by name."""
    if path.suffix.lower() not in ENDINGS:
        raise PrescriptionError(f"expected a file of heights that ends in {', '.join(ENDINGS)}", file=path)
    require_file(path, PrescriptionError)
    with parsing(path, "cannot be read", PrescriptionError):
        if path.suffix.lower() == ".ecsv":
            return Table.read(text_lines(path.read_text(encoding="utf-8")), format="ascii.ecsv")
        with warnings.catch_warnings(), open_fits(path, PrescriptionError, memmap=False) as hdus:
            warnings.filterwarnings("error", ".*truncated", AstropyUserWarning)
            images = [hdu for hdu in hdus if hdu.is_image and np.ndim(hdu.data) == 2]
            if not images:
                return Table.read(hdus)
            return image_points(images, hdus[0].header, path)


def _table_points(table: Table, path: Path) -> np.ndarray:
    for name in "xyz":
        if name not in table.colnames:
            expected_columns = f"expected x, y, z, or {', '.join(COLUMNS)}"
            raise PrescriptionError(f"columns {', '.join(table.colnames)}: {expected_columns}", file=path)
    points = [lengths(table, name, path) for name in "xyz"]
    return in_telescope_frame(points, frame_of(table.meta, "telescope", path))


def _fitted(points: np.ndarray, camera: Camera) -> tuple[MeasuredHeights, np.ndarray]:
    """Return the heights fitted to points [3, n], and the fraction of each CCD that they cover."""
    x, y, z = points
    surfaces, measured = fit_heights(camera, x, y, z)
    ccd = camera.ccd_at(x, y)
    on = ccd >= 0
    ccd, z = ccd[on], z[on]
    local = np.stack(camera.to_local(ccd, x[on], y[on]), axis=-1)
    count = np.bincount(ccd, minlength=len(camera))
    square = (z - surfaces.height(ccd, *local.T)) ** 2
    with np.errstate(invalid="ignore"):
        residual = np.sqrt(np.bincount(ccd, square, minlength=len(camera)) / count)
    cells = np.clip(np.sqrt(count / _POINTS_PER_CELL).astype(int), 1, _MOST_CELLS)
    place = np.floor((0.5 * local / camera.half_sizes[ccd] + 0.5) * cells[ccd, None]).astype(int)
    place = np.clip(place, 0, cells[ccd, None] - 1)
    filled = np.zeros((len(camera), _MOST_CELLS, _MOST_CELLS), dtype=bool)
    filled[ccd, place[:, 0], place[:, 1]] = True
    covered = filled.sum(axis=(1, 2)) / cells**2
    return MeasuredHeights(surfaces, measured, residual), covered


def _measured_fraction(found: MeasuredHeights, camera: Camera) -> np.ndarray:
    """Return the fraction of each CCD within the measured rectangle of its Zernikes."""
    zernikes = found.surfaces.zernikes
    assert zernikes is not None
    half = camera.half_sizes
    limits = np.clip(zernikes.limits + zernikes.origin[:, :, None], -half[:, :, None], half[:, :, None])
    return np.prod(np.diff(limits, axis=2)[..., 0] / (2.0 * half), axis=1)


def _check_names(ccds: np.ndarray, points: np.ndarray, camera: Camera) -> None:
    """Raise where points [3, n] with names of CCDs [n] are those of another camera, or lie on others of its CCDs."""
    by_name = {name: points[:, ccds == name] for name in camera.ccd_names if name in set(ccds)}
    if not by_name and len(ccds):
        raise PrescriptionError(
            f"column ccd, {ccds[0]}: expected names of {camera.name}, such as {camera.ccd_names[0]}; are the heights of"
            " another camera?"
        )
    _check_places("points of {}: some lie", by_name, camera)


def _check_places(what: str, points: dict[str, np.ndarray], camera: Camera) -> None:
    """Raise where points [3, n] by the name of their CCD lie on another one; ``what`` has a place for the name."""
    for name, (x, y, _) in points.items():
        named_ccd = camera.ccd_index(name)
        elsewhere = (ccd := camera.ccd_at(x, y)) != named_ccd
        if np.any(elsewhere & (ccd >= 0)):
            other_ccd = camera.ccd_names[int(ccd[elsewhere & (ccd >= 0)][0])]
            raise PrescriptionError(f"{what.format(name)} on {other_ccd}; are coordinates and frame right?")


def _warn_of_others(path: Path, names: Sequence[str]) -> None:
    if names:
        warnings.warn(f"{path}: left out, not on the camera: {_some(names)}", HeightWarning, stacklevel=4)


def _warn(path: Path, camera: Camera, found: MeasuredHeights, covered: np.ndarray) -> None:
    names = np.array(camera.ccd_names)
    if not found.measured.all():
        unmeasured_names = list(names[~found.measured])
        warnings.warn(f"{path}: no heights, taken as zero: {_some(unmeasured_names)}", HeightWarning, stacklevel=4)
    gaps = np.flatnonzero(found.measured & (covered < _COVERED))
    if gaps.size:
        parts = [f"{names[i]} ({100 * covered[i]:.0f} % measured)" for i in gaps]
        warnings.warn(f"{path}: gaps, across which heights are continued: {_some(parts)}", HeightWarning, stacklevel=4)
    axis = np.linspace(-0.9, 0.9, 5)
    ccd, v, u = (a.ravel() for a in np.meshgrid(np.arange(len(camera)), axis, axis, indexing="ij"))
    a, b = camera.half_sizes[ccd].T
    largest = np.abs(found.surfaces.height(ccd, a * u, b * v)).reshape(len(camera), -1).max(axis=1)
    if np.any(largest > _LARGEST):
        parts = [f"{names[i]} ({1e3 * largest[i]:.3g} mm)" for i in np.flatnonzero(largest > _LARGEST)]
        text = f"heights of more than {_LARGEST * 1e3:g} mm; is the unit right? {_some(parts)}"
        warnings.warn(f"{path}: {text}", HeightWarning, stacklevel=4)


def _some(names: Sequence[Any]) -> str:
    return ", ".join(map(str, names[:12])) + (f" and {len(names) - 12} more" if len(names) > 12 else "")
