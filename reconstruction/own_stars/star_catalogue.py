"""Stars from a user's own table: positions, and cutouts in a column or in an image cube."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits
from astropy.table import Table
from numpy.typing import NDArray

from ...core.arguments import check_arguments
from ...core.errors import ProductError
from ...core.files import parsing, read_bytes, text_lines
from ...core.fits_files import unpacked_bytes
from ...core.number_text import counted
from .lsst_stamps import is_stamp_file, read_stamp_file
from .stamp_weights import without_weightless

#: Names that SExtractor, Piff and the LSST pipelines have for columns, in lower case.
OTHER_NAMES = {
    "x": ("xwin_image", "x_image", "xpsf_image", "slot_centroid_x", "base_sdsscentroid_x"),
    "y": ("ywin_image", "y_image", "ypsf_image", "slot_centroid_y", "base_sdsscentroid_y"),
    "stamp": ("vignet", "image", "deblended"),
    "weight": ("vignet_weight", "weights"),
    "variance": ("vignet_variance",),
    "mask": ("vignet_mask", "masks", "badpix"),
}

#: Bits of SExtractor's FLAGS that leave a star out, as in PSFEx: all but 1, neighbours that bias photometry.
FLAG_MASK = 0xFE
#: Bits of SExtractor's FLAGS, in words.
FLAG_WORDS = {
    1: "with neighbours",
    2: "blended",
    4: "saturated",
    8: "cut by an edge",
    16: "with incomplete apertures",
    32: "with incomplete isophotes",
    64: "out of memory in deblending",
    128: "out of memory in extraction",
}

# Names of images that are no stamps.
_QUALITY_NAMES = {name for kind in ("weight", "variance", "mask") for name in (kind, *OTHER_NAMES[kind])}


class _Cutouts(NamedTuple):
    stamps: np.ndarray
    positions: np.ndarray


class StarCutouts(_Cutouts):
    """Stars to fit a PSF model to, to be unpacked as stamps and positions.

    Parameters
    ----------
    stamps : ndarray
        As they stand in the file, NaN where a pixel has no weight, [n, ny, nx].
    positions : ndarray
        In the unit of the table, [n, 2].
    colour : ndarray or None
        Colours, NaN where a row has none, [n]; None where no column is named.
    flags : ndarray or None
        Column FLAGS, bits as of SExtractor, int [n]; None without one.
    """

    colour: np.ndarray | None
    flags: np.ndarray | None

    def __new__(
        cls,
        stamps: np.ndarray,
        positions: np.ndarray,
        colour: np.ndarray | None = None,
        flags: np.ndarray | None = None,
    ) -> StarCutouts:
        """Return stamps and positions with colours and flags."""
        cutouts = super().__new__(cls, stamps, positions)
        cutouts.colour = colour
        cutouts.flags = flags
        return cutouts

    def unflagged(self, flag_mask: int = FLAG_MASK) -> NDArray[np.bool_]:
        """Return the stars without any of the bits of a mask in their flags, [n]; all where there are no flags."""
        if self.flags is None:
            return np.ones(len(self.stamps), dtype=bool)
        return np.asarray(self.flags & flag_mask == 0)

    def part(self, chosen: NDArray[np.bool_]) -> StarCutouts:
        """Return some of the stars, those of a mask [n]."""
        colour, flags = (None if values is None else values[chosen] for values in (self.colour, self.flags))
        return StarCutouts(self.stamps[chosen], self.positions[chosen], colour, flags)


@check_arguments
def load_stars(
    catalogue: str | Path,
    *,
    x: str = "x",
    y: str = "y",
    stamp: str = "stamp",
    weight: str | None = None,
    mask: str | None = None,
    images: str | Path | None = None,
    colour: str | None = None,
) -> StarCutouts:
    """Read stars from a FITS or ECSV table, or a file of LSST stamps.

    Nothing is subtracted, shifted or left out: :func:`~pachon.measure.stamps.center_stamps` centres stars,
    :func:`~pachon.measure.star_selection.flag_stars` finds those to leave out.

    Parameters
    ----------
    catalogue : str or Path
        The table; of a FITS file its first one with a position, the only one that has stamps too. The names of columns
        may be in any case. A table of one row, each column of which holds all stars, is read too (Piff's test data). A
        FITS file without such a table may hold stamps one by one, in extensions IMAGE, MASK and VARIANCE with EXTVER,
        as the LSST pipelines write them.
    x, y : str
        Columns of the positions, in any unit; for "x" and "y" names of SExtractor and of LSST stand in,
        :data:`OTHER_NAMES`.
    stamp : str
        Column of the stamps, [ny, nx] in every row; VIGNET of SExtractor, IMAGE and DEBLENDED stand in for "stamp".
        Where a FITS file has none, its first image of three axes is taken.
    weight, mask : str, optional
        Columns of weights (zero for pixels to ignore) and masks (not zero or True for them; where the header has
        cards such as MP_BAD, the bits of all planes but :data:`~.mask_planes.HARMLESS`). Where nothing is said,
        columns WEIGHT, VIGNET_WEIGHT, VARIANCE, MASK and so on (:data:`OTHER_NAMES`), and images of three axes whose
        EXTNAME is one of these.
    images : str or Path, optional
        FITS file whose first image of three axes, [n, ny, nx], holds the stamps in the order of the table.
    colour : str, optional
        Column of the colours of the stars, such as g_i.

    Returns
    -------
    StarCutouts
        Stamps and positions, to be unpacked, ``colour`` where a column is named, and ``flags`` where there is a column
        FLAGS of whole numbers. Pixels without weight, and bad ones (:mod:`~pachon.measure.pixel_masks`), are NaN.

    Raises
    ------
    ProductError
        If a file is missing, cut short, of another kind, has tables of several images, or lacks a column, or no pixel
        has weight; one line that names it.
    """
    path = Path(catalogue)
    data = read_bytes(path, ProductError)
    hdus: fits.HDUList | None = None
    header: Mapping[str, Any] = {}
    if data.startswith(b"SIMPLE"):
        hdus = _read_fits_parts(path, data)
        tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU) and not isinstance(hdu, fits.CompImageHDU)]
        with parsing(path, "damaged or not FITS", ProductError):
            # SExtractor's LDAC files have a table of the image's header before that of the objects.
            table = next((t for t in tables if _find_column(x, t.columns.names)), tables[0] if tables else None)
            with_stamps = [t for t in tables if all(_find_column(name, t.columns.names) for name in (x, y, stamp))]
        if len(with_stamps) > 1:
            raise ProductError(
                f"has {len(with_stamps)} tables of stars, such as those of several CCDs: expected that of one image",
                file=path,
            )
        if (table is None or not _find_column(x, table.columns.names)) and is_stamp_file(hdus):
            if colour is not None:
                raise ProductError(f"has stamps without a table, expected one with a column {colour!r}", file=path)
            return StarCutouts(*read_stamp_file(hdus, path))
        if table is None:
            raise ProductError(
                f"has no table, expected one of stars with columns {x}, {y} and their stamps, {stamp}", file=path
            )
        with parsing(path, "damaged or not FITS", ProductError):
            columns = {name: np.asarray(table.data[name]) for name in table.columns.names}
        header = table.header
    elif data.lstrip().startswith(b"# %ECSV"):
        columns = _read_ecsv_columns(path, data)
    else:
        raise ProductError("neither FITS nor ECSV, expected a table of stars", file=path)

    cube_hdus = hdus if images is None else _read_fits_parts(Path(images), read_bytes(Path(images), ProductError))
    cube = None if images is None else _first_cube(cube_hdus)
    if images is not None and cube is None:
        raise ProductError("has no image of three axes, expected the stamps [n, ny, nx]", file=images)
    x, y, stamp = (_find_column(name, columns) or name for name in (x, y, stamp))
    names = {name.lower(): name for name in columns}
    if cube is None and stamp.lower() not in names and hdus is not None:
        cube = _first_cube(hdus)
    needed_columns = [x, y] if cube is not None else [x, y, stamp]
    absent = [name for name in needed_columns if name.lower() not in names]
    absent += [name for name in (weight, mask, colour) if name is not None and name.lower() not in names]
    if absent:
        also = " and no image of three axes" if stamp in absent and hdus is not None else ""
        raise ProductError(
            f"{path}: no column {', '.join(map(repr, absent))}{also}"
            f"; its columns are {', '.join(columns) or 'none'}"
            + "".join(f"; looked for {name}: {', '.join(OTHER_NAMES[name])}" for name in absent if name in OTHER_NAMES)
            + "; stamps are images [n, ny, nx]" * (stamp in absent)
        )
    columns = _one_row_a_star(columns, names[x.lower()])
    positions = np.stack([_checked_column(path, name, columns[names[name.lower()]], 1) for name in (x, y)], axis=1)
    stamps = _checked_column(path, stamp, columns[names[stamp.lower()]], 3) if cube is None else cube
    if len(stamps) != len(positions):
        stars, images = counted(len(positions), "star"), counted(len(stamps), "stamp")
        raise ProductError(f"{stars} in the table, {images} in the images", file=path)
    finite = np.isfinite(positions).all(axis=1)
    if not finite.all():
        row = int(finite.argmin())
        at = ", ".join(f"{value:g}" for value in positions[row])
        raise ProductError(f"{x}, {y} of row {row + 1} are {at}: expected numbers", file=path)
    quality: dict[str, np.ndarray | None] = {}
    for kind, column in (("weight", weight), ("variance", None), ("mask", mask)):
        name = _find_column(kind if column is None else column, columns)
        if name is not None and (column is not None or columns[name].ndim == 3):
            values = columns[name]
            quality[kind] = _checked_column(path, name, values.astype(np.uint8) if values.dtype == bool else values, 3)
        else:
            image = None if cube is None else _image_named(cube_hdus, (kind, *OTHER_NAMES[kind]))
            quality[kind] = None if image is None else np.asarray(image.data, dtype=np.float64)
            if image is not None and kind == "mask":
                header = image.header
    return StarCutouts(
        without_weightless(
            stamps,
            quality["weight"],
            quality["mask"],
            header,
            path,
            variances=quality["variance"],
            names=(weight or "weight", mask or "mask"),
        ),
        positions,
        None if colour is None else _checked_column(path, colour, columns[names[colour.lower()]], 1),
        _flags_column(columns),
    )


def _flags_column(columns: dict[str, np.ndarray]) -> np.ndarray | None:
    """Return a column FLAGS of one whole number in every row, 0 where there is none; None without such a column."""
    values = next((values for name, values in columns.items() if name.lower() == "flags"), None)
    if values is None or values.dtype.kind not in "iuf" or values.ndim != 1:
        return None
    if values.dtype.kind == "f":  # of a table in which some are masked
        values = np.nan_to_num(values, nan=0.0)
        if not (np.isfinite(values).all() and (values == np.rint(values)).all()):
            return None
    return values.astype(np.int64)


def _one_row_a_star(columns: dict[str, np.ndarray], x: str) -> dict[str, np.ndarray]:
    """Return columns with a row for each star, also where they stand in one row: positions [1, n]."""
    if columns[x].ndim == 2 and len(columns[x]) == 1:
        return {name: values[0] if values.ndim > 1 else values for name, values in columns.items()}
    return columns


def _find_column(name: str, columns: Iterable[str]) -> str | None:
    """Return the column of a name, or of another one that programs have for it; None without one."""
    names = {column.lower(): column for column in columns}
    return next((names[synonym] for synonym in (name.lower(), *OTHER_NAMES.get(name, ())) if synonym in names), None)


def _read_fits_parts(path: Path, data: bytes) -> fits.HDUList:
    """Return the parts of a FITS file in memory; the warning that it is cut short is an error, others are dropped."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with parsing(path, "damaged or not FITS", ProductError):
            hdus = fits.open(io.BytesIO(unpacked_bytes(path, data, ProductError)), lazy_load_hdus=False)
            for hdu in hdus:
                hdu.data  # noqa: B018 - reads it now, within the checks
    cut = [str(w.message) for w in caught if "truncated" in str(w.message).lower()]
    if cut:
        raise ProductError(f"cut short ({' '.join(cut[0].split())})", file=path)
    return hdus


def _read_ecsv_columns(path: Path, data: bytes) -> dict[str, np.ndarray]:
    """Return the columns of an ECSV table; values left empty are NaN."""
    with parsing(path, "damaged or no ECSV table", ProductError):
        table = Table.read(text_lines(data.decode()), format="ascii.ecsv")
    columns = {}
    for name in table.colnames:
        values = table[name]
        if hasattr(values, "filled"):
            values = values.astype(float).filled(np.nan) if values.dtype.kind in "fiu" else values.filled()
        columns[name] = np.asarray(values)
    return columns


def _first_cube(hdus: fits.HDUList | None) -> np.ndarray | None:
    """Return the first image of three axes, or None."""
    for hdu in hdus or ():
        if hdu.is_image and hdu.data is not None and hdu.data.ndim == 3 and hdu.name.lower() not in _QUALITY_NAMES:
            return np.asarray(hdu.data, dtype=np.float64)
    return None


def _image_named(hdus: fits.HDUList | None, names: Iterable[str]) -> fits.ImageHDU | None:
    """Return the image of three axes with one of these extension names, or None."""
    for hdu in hdus or ():
        if hdu.is_image and hdu.data is not None and hdu.data.ndim == 3 and hdu.name.lower() in names:
            return hdu
    return None


def _checked_column(path: Path, name: str, values: Any, axes: int) -> np.ndarray:
    """Return a column as float64 in the machine's byte order, with the axes it must have."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiu" or array.ndim != axes:
        shape = "one number" if axes == 1 else "an image [ny, nx]"
        raise ProductError(
            f"{path}: column {name!r} has shape {array.shape} and type {array.dtype}, expected {shape} in every row"
        )
    return array.astype(np.float64)
