"""Parts of a FITS file of another program, compressed ones included, read one at a time."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from ...core.errors import ProductError
from ...core.files import parsing, require_file
from ...core.fits_files import open_fits

#: Cards that other programs write on the file, or on the compression of a part, and not on the image.
_STRUCTURE = ("CHECKSUM", "DATASUM", "ZHECKSUM", "ZDATASUM", "EXTNAME", "EXTVER", "INHERIT", "XTENSION", "EXTEND")
#: What FITS calls a sum that does not hold.
_WRONG_SUM = 0


@dataclass(frozen=True, eq=False)
class FitsPart:
    """Header and place of one part of a file."""

    index: int
    name: str  #: EXTNAME in capitals; empty where there is none
    header: fits.Header  #: of the primary part too, where the image lies in an extension
    image_shape: tuple[int, ...]  #: as NumPy has it, without first axes of length 1; empty where there is no image
    version: int = 1  #: EXTVER, which tells parts of one name apart

    @property
    def is_image(self) -> bool:
        """Whether the part is an image of two axes."""
        return len(self.image_shape) == 2 and min(self.image_shape) > 0


@dataclass(frozen=True, eq=False)
class FitsParts:
    """Parts of a file: headers now, pixels when they are asked for."""

    path: Path
    parts: tuple[FitsPart, ...]

    @classmethod
    def of(cls, path: Path) -> FitsParts:
        """Read the headers of a file; ProductError if there is none, or it is not FITS or cut short."""
        require_file(path, ProductError)
        with _opened(path) as hdus:
            primary = hdus[0].header
            parts = tuple(_part_of(index, hdu, primary) for index, hdu in enumerate(hdus))
        return cls(path, parts)

    def named(self, *names: str) -> list[FitsPart]:
        """Return the images of the first of these names that has any."""
        images = ([part for part in self.parts if part.is_image and part.name == name] for name in names)
        return next(filter(None, images), [])

    def label(self, part: FitsPart) -> str:
        """Return the name of an image; with its version, as in SCI,2, where others have it, too; else its number."""
        versions = [image.version for image in self.named(part.name)]
        if not part.name or versions.count(part.version) > 1:
            return str(part.index)
        return part.name if len(versions) == 1 else f"{part.name},{part.version}"

    def pixels(self, part: FitsPart) -> np.ndarray:
        """Return the pixels of an image in the machine's own byte order; ProductError where its checksum is wrong."""
        with _opened(self.path, disable_image_compression=True) as raw_hdus:
            raw = raw_hdus[part.index]
            if _WRONG_SUM in (raw.verify_checksum(), raw.verify_datasum()):
                raise ProductError(f"damaged ({part.name or 'image'} does not match its checksum)", file=self.path)
        with _opened(self.path) as hdus:
            array = np.asarray(hdus[part.index].data).reshape(part.image_shape)
            return np.array(array, dtype=array.dtype.newbyteorder("="))


def beside(image: FitsPart, parts: Sequence[FitsPart]) -> FitsPart | None:
    """Return the part that belongs to an image: the only one, or of its version the next one; None of none."""
    same_version = parts if len(parts) == 1 else [part for part in parts if part.version == image.version]
    return min(same_version, key=lambda part: (part.index < image.index, part.index), default=None)


@contextmanager
def _opened(path: Path, **options: Any) -> Iterator[fits.HDUList]:
    """Open a file; cards beyond the standard, which many observatories write, are no error."""
    with warnings.catch_warnings(), parsing(path, "damaged or not FITS", ProductError):
        warnings.simplefilter("ignore", AstropyWarning)
        with open_fits(path, ProductError, lazy_load_hdus=False, **options) as hdus:
            yield hdus


def _part_of(index: int, hdu: fits.hdu.base.ExtensionHDU, primary: fits.Header) -> FitsPart:
    header = hdu.header.copy()
    if index:
        for card in primary.cards:
            if card.keyword and card.keyword not in header and card.keyword not in ("COMMENT", "HISTORY", "SIMPLE"):
                header.append(card, end=True)
    is_image = isinstance(hdu, (fits.PrimaryHDU, fits.ImageHDU, fits.CompImageHDU))
    shape: tuple[int, ...] = tuple(hdu.shape) if is_image else ()
    while len(shape) > 2 and shape[0] == 1:  # NAXIS3 = 1, as of one frequency or one plane of a cube
        shape = shape[1:]
    # The first files of HSC have EXTTYPE in its place.
    name = str(hdu.header.get("EXTNAME") or hdu.header.get("EXTTYPE") or "").strip().upper()
    for keyword in _STRUCTURE:
        header.remove(keyword, ignore_missing=True, remove_all=True)
    # fpack names a nameless image so.
    name = "" if name == "COMPRESSED_IMAGE" else name
    return FitsPart(index, name, header, shape, hdu.ver)
