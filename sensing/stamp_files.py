"""Stamps of donuts from FITS files: a cube with a table, one extension each, or a CCD's image and positions.

Field angles stand in columns ``field_x`` and ``field_y`` [deg] of the first table of the file or of a file of
positions, one row a stamp, or in keywords ``FIELD_X`` and ``FIELD_Y`` of each image. ``defocus_um`` (keyword
``DEFOC_UM``) is the shift along z of the body that ``moved`` (keyword ``MOVED``) names, by default the detector; pixels
``x`` and ``y``, from 0, are the donuts' places on an image.
Without field angles, detector and pixel are those of the headers of observatories (:mod:`.stamp_headers`). Extensions
with masks, variances or weights go with the images in their order.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import Table

from ..core.errors import ProductError
from ..core.files import parsing, require_file
from ..core.fits_files import open_fits
from ..core.mask_planes import bad_bits
from ..core.noise_planes import MASK_NAMES, NoiseKind, noise_kind
from ..core.number_text import counted
from ..core.table_files import text_table
from .inputs import SMALLEST_STAMP
from .stamp_headers import (
    HeaderValues,
    corner_of,
    defocus_of,
    detector_of,
    gain_of,
    header_values,
    pixel_of,
    stamp_header,
)

#: Numbers behind the names of extensions of planes, as in VARIANCE_2.
_NUMBER = re.compile(r"[_ ]?\d*$")
#: Units of the columns that make a table one of stamps or positions; those of columns with other units are converted.
_COLUMNS = {"field_x": u.deg, "field_y": u.deg, "x": u.pixel, "y": u.pixel, "defocus_um": u.um}


@dataclass(frozen=True)
class DonutStamps:
    """Stamps with their places in the field or on the camera.

    Attributes
    ----------
    images : list of ndarray
        Stamps as the file has them.
    fields : ndarray, shape [n, 2], or None
        Field angles [rad]; None where the file has none.
    defocus : ndarray, shape [n]
        Shifts of the body that moves [m]; 0 where the file has none.
    masks : list of ndarray of bool
        Pixels to leave out.
    variances : list of ndarray, or None
        Variance planes, in the square of the images' unit; None where the file has none.
    detectors : list of str, int or None
        Names or numbers of the detectors.
    pixels : ndarray, shape [n, 2]
        Pixels of the detector, from 0, in the middles of the stamps; NaN where the file does not say.
    has_defocus : ndarray of bool, shape [n]
        Whether the file says how far the body was moved.
    header : HeaderValues
        What its headers say of the exposure.
    moved : str, optional
        Surface or group that moves, of all stamps; None where the file does not name it.
    gains : list of float or None
        Electrons of a unit of each image; None where its header does not say, NaN for another unit without a gain.
    """

    images: list[np.ndarray]
    fields: np.ndarray | None
    defocus: np.ndarray
    masks: list[np.ndarray]
    variances: list[np.ndarray] | None
    detectors: list[str | int | None]
    pixels: np.ndarray
    has_defocus: np.ndarray
    header: HeaderValues = field(default_factory=HeaderValues)
    moved: str | None = None
    gains: list[float | None] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.images)


@dataclass(frozen=True)
class _Image:
    """Image of one stamp or CCD with its mask, variance and header."""

    data: np.ndarray
    mask: np.ndarray
    variance: np.ndarray | None
    header: fits.Header

    def plane(self) -> _Image:
        """Return the only image of a cube of one, or the image as it is."""
        if self.data.ndim != 3 or len(self.data) != 1:
            return self
        variance = None if self.variance is None else self.variance[0]
        return _Image(self.data[0], self.mask[0], variance, self.header)


def read_stamps(
    path: Path,
    positions: Path | None = None,
    size: int = 180,
    *,
    mask: Path | None = None,
    variance: Path | None = None,
) -> DonutStamps:
    """Read the stamps of a FITS file.

    Parameters
    ----------
    path : Path
        The file.
    positions : Path, optional
        Table (ECSV, CSV or FITS) of donuts: of their places on one image, or of the stamps of a cube.
    size : int
        Side of the stamps cut out of an image [pixels].
    mask, variance : Path, optional
        FITS files with masks, pixels other than 0 left out, and variances of the images, in their order.

    Raises
    ------
    ProductError
        If a file cannot be read, has no images, a plane does not go with the images, or a table lacks a column or has
        another number of rows.
    """
    # Values of damaged headers fail where they are read.
    with parsing(path, "cannot be read as FITS", ProductError):
        return _stamps_of(_units(path), path, positions, size, (mask, variance))


def _stamps_of(
    units: Sequence[tuple[fits.Header, np.ndarray | Table | None]],
    path: Path,
    positions: Path | None,
    size: int,
    planes: tuple[Path | None, Path | None],
) -> DonutStamps:
    """Return the stamps of the units of a file, with files of masks and variances; see :func:`read_stamps`."""
    primary = units[0][0] if units else fits.Header()
    images = _with_planes(units, path, primary, *planes)
    tables = [data for _, data in units if isinstance(data, Table) and _names(data) & set(_COLUMNS)]
    table = _table(positions) if positions is not None else tables[0] if tables else None
    if table is not None:
        _require_pairs(table, positions or path)
    expected = f"a cube [n, ny, nx], stamps, or one image of a CCD, of at least {SMALLEST_STAMP} pixels a side"
    if not images:
        raise ProductError(f"no images: expected {expected}", file=path)
    for image in images:
        if image.data.ndim not in (2, 3) or min(image.data.shape[-2:]) < SMALLEST_STAMP:
            raise ProductError(f"image of shape {list(image.data.shape)}: expected images: {expected}", file=path)
    values = header_values([image.header for image in images], path)
    named = [str(image.header["MOVED"]).strip() for image in images if "MOVED" in image.header]
    moved = one_body([*named, *(_texts(table, "moved") if table is not None else ())], path)
    if len(images) == 1 and table is not None and {"x", "y"} <= _names(table) and len(table) != 1:
        images = [images[0].plane()]
    if len(images) == 1 and images[0].data.ndim == 2 and table is not None and {"x", "y"} <= _names(table):
        return replace(_cut_stamps(images[0], table, size, positions or path, values, path), moved=moved)
    single = [stamp for image in images for stamp in _split(image)]
    described = [(defocus_of(i.header, path), _field_of(i.header, path)) for i in single]
    shifts = np.array([shift for shift, _ in described])
    fields = np.array([place for _, place in described])
    known_fields = None if np.isnan(fields).any() else np.deg2rad(fields)
    if table is not None:
        known_fields, table_shifts = _places(table, len(single), positions or path)
        shifts = shifts if table_shifts is None else table_shifts
    return DonutStamps(
        images=[i.data for i in single],
        fields=known_fields,
        defocus=np.nan_to_num(shifts),
        masks=[i.mask for i in single],
        variances=_all_variances(single),
        detectors=[detector_of(i.header) for i in single],
        pixels=np.array([pixel_of(i.header, i.data.shape, path) for i in single]),
        has_defocus=np.isfinite(shifts),
        header=values,
        moved=moved,
        gains=[gain_of(i.header, path) for i in single],
    )


def one_body(names: Iterable[str], file: Path) -> str | None:
    """Return the one body that stamps name as moved, None without any; ProductError where they name several."""
    bodies = sorted({name for name in names if name})
    if len(bodies) > 1:
        raise ProductError(f"moved = {', '.join(bodies)}: expected one body for all stamps", file=file)
    return bodies[0] if bodies else None


def _cut_stamps(
    image: _Image, table: Table, size: int, positions: Path, values: HeaderValues, path: Path
) -> DonutStamps:
    """Return stamps cut out of the image of a CCD about the places of a table."""
    centers = np.stack([_column(table, name, positions) for name in ("x", "y")], axis=-1)
    fields, shifts = _places(table, len(centers), positions)
    if shifts is None:
        shifts = np.full(len(centers), defocus_of(image.header, path))

    def cut(plane: np.ndarray, outside: float | bool) -> list[np.ndarray]:
        return [_cut(plane, float(x), float(y), size, outside) for x, y in centers]

    middles = np.round(centers) + 0.5 * (size - 1) - size // 2 + np.array(corner_of(image.header, path))
    return DonutStamps(
        images=cut(image.data, np.nan),
        fields=fields,
        defocus=np.nan_to_num(shifts),
        masks=cut(image.mask, False),
        variances=None if image.variance is None else cut(image.variance, np.nan),
        detectors=[detector_of(image.header)] * len(centers),
        pixels=middles,
        has_defocus=np.isfinite(shifts),
        header=values,
        gains=[gain_of(image.header, path)] * len(centers),
    )


def _units(path: Path) -> list[tuple[fits.Header, np.ndarray | Table | None]]:
    """Return headers and contents of the units of a FITS file: images, tables, or nothing."""
    require_file(path, ProductError)
    if path.suffix.lower() in (".npy", ".npz"):
        text = "expected FITS files of images; pachon.fit_donuts takes arrays"
        raise ProductError(f"{_arrays_text(path)}: {text}", file=path)
    contents: list[tuple[fits.Header, np.ndarray | Table | None]] = []
    with parsing(path, "cannot be read as FITS", ProductError), open_fits(path, ProductError, memmap=False) as units:
        for unit in units:
            if unit.is_image:
                data = None if unit.data is None else np.asarray(unit.data)
                while data is not None and data.ndim > 3 and len(data) == 1:
                    data = data[0]
                contents.append((unit.header, data))
            elif isinstance(unit, fits.BinTableHDU) and not unit.header.get("EXTNAME", "").startswith("ARCHIVE"):
                contents.append((unit.header, Table.read(unit)))
    return contents


def _arrays_text(path: Path) -> str:
    """Return shapes and types of the arrays of a NumPy file, in words."""
    try:
        content = np.load(path, mmap_mode="r", allow_pickle=False)
        arrays = {"array": content} if isinstance(content, np.ndarray) else dict(content)
    except (OSError, ValueError, EOFError, BadZipFile):
        return "no file of plain NumPy arrays"
    return ", ".join(f"{name} of shape {list(array.shape)} and type {array.dtype}" for name, array in arrays.items())


def _with_planes(
    units: Sequence[tuple[fits.Header, np.ndarray | Table | None]],
    path: Path,
    primary: fits.Header,
    mask: Path | None,
    variance: Path | None,
) -> list[_Image]:
    """Return the images of a file with their masks and variances, those of files of their own before its own."""
    kinds = ("image", "mask", *(kind.value for kind in NoiseKind))
    planes: dict[str, list[tuple[fits.Header, np.ndarray]]] = {kind: [] for kind in kinds}
    for header, data in units:
        if isinstance(data, np.ndarray):
            planes[_kind_of(header)].append((header, data))
    for kind, file in (("mask", mask), ("variance", variance)):
        if file is not None:
            planes[kind] = [(header, data) for header, data in _units(file) if isinstance(data, np.ndarray)]
    images = planes["image"]
    for kind, listed in planes.items():
        file = {"mask": mask, "variance": variance}.get(kind) or path
        if kind != "image" and listed and [d.shape for _, d in listed] != [d.shape for _, d in images]:
            shapes, expected = ([list(d.shape) for _, d in units_of[:1]] for units_of in (listed, images))
            counts = f"{len(listed)} of shape {shapes[0]} for {counted(len(images), 'image')}" + (
                f" of {expected[0]}" if expected else ""
            )
            raise ProductError(f"planes of {kind}: {counts}: expected one for each image, as large", file=file)
    out = []
    for k, (header, data) in enumerate(images):
        own_mask = _bad_pixels(*planes["mask"][k], mask or path) if planes["mask"] else np.zeros(data.shape, bool)
        own_variance = None
        if planes["variance"]:
            own_variance = np.asarray(planes["variance"][k][1], dtype=np.float64)
        elif planes["rms"]:
            own_variance = np.asarray(planes["rms"][k][1], dtype=np.float64) ** 2
        elif planes["weight"]:
            weight = np.asarray(planes["weight"][k][1], dtype=np.float64)
            own_variance = np.where(weight > 0.0, 1.0 / np.where(weight > 0.0, weight, 1.0), np.nan)
        noisy = None if own_variance is None else np.isfinite(own_variance) & (own_variance > 0.0)
        if noisy is not None and noisy.any():
            own_mask = own_mask | ~noisy
        else:
            # A plane of zeros, as ts_wep writes it without variances, says nothing.
            own_variance = None
        merged = stamp_header(primary, header, k) if header is not primary else header
        out.append(_Image(np.asarray(data, dtype=np.float64), own_mask, own_variance, merged))
    return out


def _kind_of(header: fits.Header) -> str:
    """Return what the pixels of an image are: image, mask, variance, rms or weight."""
    name = _NUMBER.sub("", str(header.get("EXTNAME", "")).strip().upper())
    if name in MASK_NAMES:
        return "mask"
    kind = noise_kind(name, header)
    return "image" if kind is None else kind.value


def _bad_pixels(header: fits.Header, values: np.ndarray, path: Path) -> np.ndarray:
    """Return pixels to leave out: bad planes of masks where the header names planes, else all but 0."""
    if values.dtype.kind not in "iu":
        return np.asarray(values != 0)
    return np.asarray((values.astype(np.int64) & bad_bits(header, path)) != 0)


def _split(image: _Image) -> list[_Image]:
    """Return the stamps of a cube, or the image itself."""
    if image.data.ndim == 2:
        return [image]
    variances = [None] * len(image.data) if image.variance is None else list(image.variance)
    return [
        _Image(data, mask, variance, image.header)
        for data, mask, variance in zip(image.data, image.mask, variances, strict=True)
    ]


def _all_variances(images: Sequence[_Image]) -> list[np.ndarray] | None:
    variances = [i.variance for i in images if i.variance is not None]
    return variances if len(variances) == len(images) else None


def _field_of(header: fits.Header, file: Path) -> tuple[float, float]:
    """Return the field angles of a stamp [deg]; NaN where its header has none."""
    try:
        return tuple(float(header[key]) if key in header else float("nan") for key in ("FIELD_X", "FIELD_Y"))  # type: ignore[return-value]
    except (TypeError, ValueError):
        raise ProductError("FIELD_X, FIELD_Y: expected numbers [deg]", file=file, key="FIELD_X") from None


def sky_of_variance(variance: np.ndarray, masked: np.ndarray) -> float:
    """Return the variance of sky and readout of a stamp: the median of its variance plane along the edge.

    The star's own photons, which a variance plane has in it too, are those of the model. Where all of the edge is
    masked, the median of the least quarter of the other pixels.
    """
    edge = np.zeros(variance.shape, dtype=bool)
    edge[:2], edge[-2:], edge[:, :2], edge[:, -2:] = True, True, True, True
    usable = ~masked & np.isfinite(variance)
    if (edge & usable).any():
        return float(np.median(variance[edge & usable]))
    values = np.sort(variance[usable])
    return float(np.median(values[: -(-len(values) // 4)])) if len(values) else 0.0


def _table(path: Path) -> Table:
    """Return a table of FITS, ECSV or CSV, spreadsheets' among them."""
    require_file(path, ProductError)
    with parsing(path, "cannot be read as a table", ProductError):
        if path.suffix.lower() in (".csv", ".ecsv", ".txt"):
            return text_table(path.read_bytes())
        return Table.read(path)


def _names(table: Table) -> set[str]:
    return {name.lower() for name in table.colnames}


def _require_pairs(table: Table, file: Path) -> None:
    """Raise a ProductError for a table without rows, without a known column, or with one of two that go together."""
    names = _names(table)
    pairs = [{"x", "y"}, {"field_x", "field_y"}]
    if not names & set(_COLUMNS) or any(len(names & pair) == 1 for pair in pairs):
        columns = ", ".join(table.colnames[:8]) or "none"
        raise ProductError(f"columns {columns}: expected x and y [pixels], field_x and field_y [deg]", file=file)
    if not len(table):
        raise ProductError("table of 0 rows: expected one row a stamp", file=file)


def _column(table: Table, name: str, file: Path, *, may_lack: bool = False) -> np.ndarray:
    """Return a column of numbers by its name in any case, in the unit that it should have; ProductError otherwise.

    A number that is missing, or not finite, is an error too unless columns may lack some, which are NaN then.
    """
    column = table[next(n for n in table.colnames if n.lower() == name)]
    values = np.ma.asarray(column)
    if values.ndim != 1 or values.dtype.kind not in "iuf":
        text = f"column {name} of shape {values.shape} and type {values.dtype}: expected a number a row"
        raise ProductError(text, file=file, key=name)
    numbers = np.ma.filled(values.astype(np.float64), np.nan)
    lacking = np.flatnonzero(~np.isfinite(numbers))
    if lacking.size and not may_lack:
        text = f"{name} = {numbers[lacking[0]]} in row {lacking[0] + 1}: expected a finite number"
        raise ProductError(text, file=file, key=name)
    unit = getattr(column, "unit", None) or u.dimensionless_unscaled
    if unit == u.dimensionless_unscaled:
        return numbers
    try:
        return numbers * float(unit.to(_COLUMNS[name]))
    except (u.UnitsError, ValueError, TypeError):
        raise ProductError(f"column {name} in {unit}: expected {_COLUMNS[name]}", file=file, key=name) from None


def _texts(table: Table, name: str) -> list[str]:
    """Return a column of texts by its name in any case; none where there is no such column."""
    columns = [column for column in table.colnames if column.lower() == name]
    return [str(text).strip() for text in table[columns[0]]] if columns else []


def _places(table: Table, count: int, file: Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return field angles [rad] and shifts of the body that moves [m]; None without columns."""
    names = _names(table)
    if len(table) != count:
        rows, stamps = counted(len(table), "row"), counted(count, "stamp")
        raise ProductError(f"table of {rows} for {stamps}: expected one row a stamp", file=file)
    fields = None
    if {"field_x", "field_y"} <= names:
        fields = np.deg2rad(np.stack([_column(table, name, file) for name in ("field_x", "field_y")], axis=-1))
    # Of sensors that stand out of focus a table need not say how far.
    defocus = 1e-6 * _column(table, "defocus_um", file, may_lack=True) if "defocus_um" in names else None
    return fields, defocus


def _cut(image: np.ndarray, x: float, y: float, size: int, outside: float | bool) -> np.ndarray:
    """Return a stamp about a place, with a value of its own for pixels beside the image."""
    stamp = np.full((size, size), outside)
    first = np.array([round(y), round(x)]) - size // 2
    low, high = np.maximum(first, 0), np.minimum(first + size, image.shape)
    if (high > low).all():
        inside = tuple(slice(a, b) for a, b in zip(low - first, high - first, strict=True))
        stamp[inside] = image[low[0] : high[0], low[1] : high[1]]
    return stamp
