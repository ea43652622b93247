"""Positions of stars on an image, from a catalogue of pixels or of celestial coordinates."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import Table, vstack

from ..core.errors import DomainError, ProductError, error_context
from ..core.files import parsing, read_bytes
from ..core.fits_files import open_fits
from ..core.table_files import column_in_unit, names_in_small_letters, text_table
from .image_file import CcdImage

#: Columns of pixels, the first one's centre at (0, 0), in small letters.
_FROM_ZERO = (("x", "y"), ("slot_centroid_x", "slot_centroid_y"), ("base_sdsscentroid_x", "base_sdsscentroid_y"))
#: Columns of pixels, the first one's centre at (1, 1), as SExtractor counts them.
_FROM_ONE = (("xwin_image", "ywin_image"), ("x_image", "y_image"), ("xpsf_image", "ypsf_image"))
#: Columns of right ascension and declination, degrees where they have no unit.
_CELESTIAL = (
    ("ra", "dec"), ("alphawin_j2000", "deltawin_j2000"), ("alpha_j2000", "delta_j2000"), ("raj2000", "dej2000"),
    ("ra_icrs", "de_icrs"),
)  # fmt: skip
#: Columns of LSST's tables of sources, in radian where they have no unit.
_CELESTIAL_RADIAN = ("coord_ra", "coord_dec")
#: Columns of pixels.
_PIXELS = (*_FROM_ONE, *_FROM_ZERO)
#: Columns of places on the sky.
_SKY = (*_CELESTIAL, _CELESTIAL_RADIAN)


def read_star_positions(path: Path, image: CcdImage, among: int = 1) -> np.ndarray:
    """Return the pixels of an image, the first one's centre at (0, 0), at which a catalogue has stars, [k, 2].

    Raises
    ------
    ProductError
        If the file is no table (FITS, ECSV or CSV), or has no positions; celestial ones of an image without world
        coordinates; or pixels alone, and the image is one `among` several of a file.
    DomainError
        If no star of it lies on the image.
    """
    positions = positions_in(table_in(path), image, path, among)
    ny, nx = image.image.shape
    inside = np.isfinite(positions).all(axis=1)
    inside[inside] = ((positions[inside] >= -0.5) & (positions[inside] <= np.array([nx, ny]) - 0.5)).all(axis=1)
    if not inside.any():
        raise DomainError(f"{path}: none of its {len(positions)} stars lies on image {image.name}")
    return positions[inside]


def positions_in(table: Table, image: CcdImage, path: Path, among: int = 1) -> np.ndarray:
    """Return the pixels of an image at which the rows of a table of a file are, [n, 2]; ProductError without any.

    Pixels do not count for an image `among` several of a file: they are those of one of them.
    """
    with error_context(file=path):
        columns = names_in_small_letters(table.colnames)

    def values(names: tuple[str, str], unit: u.UnitBase | None = None) -> np.ndarray:
        with error_context(file=path):
            return np.stack([column_in_unit(table, columns[name], unit) for name in names], axis=1)

    for pairs, first in ((_FROM_ONE, 1.0), (_FROM_ZERO, 0.0)):
        for names in pairs:
            if among == 1 and set(names) <= columns.keys():
                return values(names) - first
    for names in _SKY:
        if not set(names) <= columns.keys():
            continue
        if not image.has_sky:
            raise ProductError(
                f"has {' and '.join(names)}, the image no world coordinates: expected x and y", file=path
            )
        return image.pixels_at(np.rad2deg(values(names, u.rad if names == _CELESTIAL_RADIAN else u.deg)))
    if among > 1 and _known_names(table, _PIXELS):
        raise ProductError(
            f"has pixels of one of {among} images: expected columns {' and '.join(_CELESTIAL[0])}, or one image, by "
            "its extension",
            file=path,
        )
    expected = ", ".join(" and ".join(names) for names in (*_FROM_ZERO[:1], *_FROM_ONE[:1], *_CELESTIAL[:2]))
    raise ProductError(f"has no positions of stars: expected columns {expected}", file=path)


def table_in(path: Path) -> Table:
    """Read a table; of a FITS file the one with positions, as LDAC files have others before it.

    Of several, such as of SExtractor for the CCDs of an exposure, the rows of all are returned, without pixels: which
    image these are of is unknown. ProductError where they have no celestial positions.
    """
    data = read_bytes(path, ProductError)
    with warnings.catch_warnings(), parsing(path, "no table of stars in FITS, ECSV or CSV", ProductError):
        warnings.simplefilter("ignore")
        if not data.startswith(b"SIMPLE"):
            return text_table(data)
        with open_fits(path, ProductError, content=data, lazy_load_hdus=False) as hdus:
            tables = [Table.read(hdu) for hdu in hdus if isinstance(hdu, (fits.BinTableHDU, fits.TableHDU))]
    if not tables:
        raise ProductError("has no table of stars", file=path)
    with_positions = [t for t in tables if _known_names(t, (*_PIXELS, *_SKY))]
    if len(with_positions) < 2:
        return with_positions[0] if with_positions else tables[0]
    if not all(_known_names(t, _SKY) for t in with_positions):
        raise ProductError(
            f"has {len(with_positions)} tables with pixels of images: expected one, or columns "
            f"{' and '.join(_CELESTIAL[0])}",
            file=path,
        )
    for table in with_positions:
        table.remove_columns(_known_names(table, _PIXELS))
        table.meta.clear()
    with parsing(path, "tables of different columns", ProductError):
        return vstack(with_positions)


def _known_names(table: Table, pairs: Iterable[tuple[str, str]]) -> list[str]:
    """Return the columns of a table that are among pairs of names in small letters."""
    names = {name for pair in pairs for name in pair}
    return [name for name in table.colnames if name.lower() in names]
