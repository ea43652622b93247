"""PSF models of PSFEx (Bertin 2011, ASP Conf. 442, 435), drawn at any place of an image."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import ProductError, shown
from ..core.files import parsing, require_file
from ..core.fits_files import open_fits
from ..core.units import require_count
from .psf_model.polynomial import as_positions

#: Column of the images of a model.
_COLUMN = "PSF_MASK"
#: Names of SExtractor's positions in pixels, along x and along y.
_POSITIONS = tuple(tuple(f"{axis}{kind}_IMAGE" for kind in ("", "WIN", "PSF", "PEAK")) for axis in "XY")
#: Half-width of the Lanczos kernel between the samples of a model, as in PSFEx and GalSim.
_LANCZOS = 3


@check_arguments
@dataclass(frozen=True, eq=False)
class PsfexPsf:
    """PSF model of PSFEx: images that are the coefficients of a polynomial of the position.

    Attributes
    ----------
    images : ndarray, shape [n_term, ny, nx]
        Images of the terms x^i y^j, j slower; the pixel is included.
    sampling : float
        Side of their samples [pixel of the image].
    order : int
        Total degree of the polynomial.
    zero, scale : ndarray, shape [2]
        Position (x, y) of the zero of the polynomial, the first pixel being 1, and its unit [pixel].
    """

    images: np.ndarray
    sampling: float
    order: int
    zero: np.ndarray
    scale: np.ndarray

    def __repr__(self) -> str:
        ny, nx = self.images.shape[1:]
        return f"<PsfexPsf: order {self.order}, {nx} x {ny} samples of {self.sampling:.3g} pixels>"

    @check_arguments
    def at(self, positions: ArrayLike, *, size: int = 25) -> np.ndarray:
        """Draw the PSF at positions, centred on the middle pixel of its stamp.

        Parameters
        ----------
        positions : array
            Pixels (x, y) as SExtractor counts them, the centre of the first one at (1, 1), [n, 2].
        size : int
            Pixels along a side of a stamp, odd.

        Returns
        -------
        ndarray, shape [n, size, size]
            Unit sum.
        """
        places, side = as_positions(positions), require_count(size, "size", 1, 10_000)
        x, y = ((places - self.zero) / self.scale).T
        terms = np.stack([x**i * y**j for j in range(self.order + 1) for i in range(self.order + 1 - j)], axis=1)
        ny, nx = self.images.shape[1:]
        rows, columns = (self._kernel(side, count) for count in (ny, nx))
        drawn = np.einsum("ra,tab,cb->trc", rows, self.images, columns, optimize=True)
        stamps = np.tensordot(terms, drawn, axes=1)
        return np.asarray(stamps / stamps.sum(axis=(1, 2), keepdims=True))

    def _kernel(self, side: int, count: int) -> np.ndarray:
        """Return the weights [side, count] of samples in pixels, along one axis."""
        # The middle of PSFEx's images is the sample count // 2.
        at = (np.arange(side) - side // 2)[:, None] / self.sampling - (np.arange(count) - count // 2)
        weights = np.where(np.abs(at) < _LANCZOS, np.sinc(at) * np.sinc(at / _LANCZOS), 0.0)
        # Of a constant all samples make that constant: the sum over samples without end is 1 to 0.01.
        samples = np.arange(-_LANCZOS, _LANCZOS + 1) + (at[:, :1] % 1.0)
        lanczos = np.where(np.abs(samples) < _LANCZOS, np.sinc(samples) * np.sinc(samples / _LANCZOS), 0.0)
        return weights / lanczos.sum(axis=1, keepdims=True)


@check_arguments
def load_psfex(path: str | Path) -> PsfexPsf:
    """Read a PSF model of PSFEx.

    Raises
    ------
    ProductError
        If the file is missing or none of PSFEx, has models of several images, or its polynomial is one of other things
        than positions in pixels.
    """
    file = Path(path)
    require_file(file, ProductError)
    with warnings.catch_warnings(), parsing(file, "damaged or no FITS file of PSFEx", ProductError):
        warnings.simplefilter("ignore")
        with open_fits(file, ProductError, lazy_load_hdus=False) as hdus:
            tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU) and _COLUMN in hdu.columns.names]
            if not tables:
                raise ProductError(f"no model of PSFEx (no table with {_COLUMN})", file=file)
            if len(tables) > 1:
                raise ProductError(
                    f"has {len(tables)} models of PSFEx, those of as many images: expected a file of one", file=file
                )
            return _of_header(tables[0].header, np.asarray(tables[0].data[_COLUMN][0], dtype=np.float64), file)


def _of_header(header: fits.Header, images: np.ndarray, file: Path) -> PsfexPsf:
    """Return the model of images with the polynomial that a header describes."""
    groups = _number(header, "POLNAXIS", file, 0)
    if groups not in (0, 2):
        raise ProductError(
            f"POLNAXIS = {groups:g}: expected 0, or 2 for the position in pixels", file=file, key="POLNAXIS"
        )
    if groups and (together := _number(header, "POLNGRP", file, 1)) != 1:
        raise ProductError(
            f"POLNGRP = {together:g}: expected 1, x and y in one polynomial of a total degree", file=file, key="POLNGRP"
        )
    zero, scale = np.zeros(2), np.ones(2)
    for axis in range(int(groups)):
        key = f"POLNAME{axis + 1}"
        if str(header.get(key)).strip() not in _POSITIONS[axis]:
            raise ProductError(
                f"{key} = {shown(header.get(key))}: expected {_POSITIONS[axis][0]}, the position in pixels",
                file=file,
                key=key,
            )
        zero[axis] = _number(header, f"POLZERO{axis + 1}", file)
        scale[axis] = _number(header, f"POLSCAL{axis + 1}", file, positive=True)
    order = int(_number(header, "POLDEG1", file)) if groups else 0
    count = (order + 1) * (order + 2) // 2
    if images.ndim != 3 or len(images) != count or not np.isfinite(images).all():
        raise ProductError(
            f"{_COLUMN} has shape {images.shape}: expected {count} images, those of a polynomial of order {order}",
            file=file,
        )
    return PsfexPsf(images, _number(header, "PSF_SAMP", file, positive=True), order, zero, scale)


def _number(header: Any, key: str, file: Path, default: float | None = None, *, positive: bool = False) -> float:
    value = header.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise ProductError(f"{key} = {shown(value)}: expected a number", file=file, key=key)
    if positive and not value > 0.0:
        raise ProductError(f"{key} = {shown(value)}: expected a number above 0", file=file, key=key)
    return float(value)
