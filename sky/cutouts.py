"""Galaxies cut out of a mosaic: reading, detection, removal of neighbours, selection by size against the PSF."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import sep
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning
from astropy.wcs import WCS

from ..core.errors import ProductError
from ..core.files import parsing
from ..core.fits_files import open_fits
from ..core.memory import require_bytes
from ..core.random_streams import stream
from ..core.units import ARCMIN

#: Connected pixels above the rms of the sky that make an object (Jee & Tyson 2011, sec. 6.2).
LEAST_AREA = 8
#: Header keywords of an AB zero point, tried after PHOTFLAM and PHOTPLAM of the HST.
ZERO_POINT_KEYS = ("MAGZPT", "MAGZERO", "MAGZP", "ZEROPNT", "ZEROPT", "ZP", "ABZP")
#: Least signal-to-noise ratio of objects that determine the stellar locus.
LOCUS_SNR = 50.0
#: Fewest objects that determine the stellar locus.
LOCUS_COUNT = 8
#: Objects within this factor of the half-light radius of the PSF count as stars.
LOCUS_WIDTH = 1.15
# Half-light radii are measured within so many semi-major axes.
_REACH = 6.0
# Of background, noise, segmentation and the pixels of objects.
_BYTES_PER_PIXEL = 30


@dataclass(frozen=True)
class Mosaic:
    """Image of the sky."""

    path: str
    image: np.ndarray  #: [y, x], single precision
    scale: np.ndarray  #: d(xi, eta) / d(x, y) [rad/pixel], [2, 2]
    zero_point: float  #: AB magnitude of one unit of the image

    @property
    def area(self) -> float:
        """Area with data [square arcminutes]."""
        pixel = abs(np.linalg.det(self.scale)) / ARCMIN**2
        return float(np.isfinite(self.image).sum() * pixel)


@dataclass(frozen=True)
class Cutouts:
    """Squares about galaxies."""

    images: list[np.ndarray]  #: [side, side] each, background subtracted, of odd side
    center: np.ndarray  #: centroid (x, y) from the middle pixel [pixel], [n, 2]
    flux: np.ndarray  #: sum of each square
    radius: np.ndarray  #: half-light radius [pixel]
    psf_radius: float  #: that of the PSF, above which galaxies are kept [pixel]


def read_mosaic(path: str | Path, zero_point: float | str | None = None) -> Mosaic:
    """Read the first image of a FITS file, with its celestial coordinates and zero point.

    Parameters
    ----------
    path : str or Path
        FITS file; image in the primary or the first extension with one.
    zero_point : float or str, optional
        AB magnitude of one unit of the image, or the header keyword that has it. By default it is calculated from
        PHOTFLAM and PHOTPLAM, or one of the usual keywords is read.

    Raises
    ------
    ProductError
        If the file cannot be read, or has no image, celestial coordinates or zero point.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)
        with (
            parsing(path, "cannot be read as FITS", ProductError),
            open_fits(Path(path), ProductError, memmap=False) as hdus,
        ):
            first_image = next(((h.data, h.header) for h in hdus if h.is_image and np.ndim(h.data) == 2), None)
        if first_image is None:
            raise ProductError("has no image of two axes, expected a mosaic of the sky", file=path)
        data, header = first_image
        with parsing(path, "celestial coordinates", ProductError):
            coordinates = WCS(header)
            scale = np.deg2rad(coordinates.celestial.pixel_scale_matrix) if coordinates.has_celestial else None
    if scale is None or not abs(np.linalg.det(scale)) > 0.0:
        raise ProductError("has no celestial coordinates, expected CTYPE1 = 'RA---TAN' and the like", file=path)
    with parsing(path, "zero point", ProductError):
        return Mosaic(str(path), np.asarray(data, dtype=np.float32), scale, _zero_point(path, header, zero_point))


def _zero_point(path: str | Path, header: fits.Header, zero_point: float | str | None) -> float:
    """Return an AB zero point, or that of a header by keyword or by default."""
    if zero_point is None and "PHOTFLAM" in header and "PHOTPLAM" in header:
        # AB magnitude of a flux per wavelength at the pivot wavelength (ACS Data Handbook, sec. 5.1).
        with np.errstate(all="ignore"):
            value = -2.5 * np.log10(float(header["PHOTFLAM"])) - 5.0 * np.log10(float(header["PHOTPLAM"])) - 2.408
        name = "PHOTFLAM, PHOTPLAM"
    elif isinstance(zero_point, int | float | np.number):
        name, value = "zero_point", float(zero_point)
    else:
        keys = ZERO_POINT_KEYS if zero_point is None else (zero_point,)
        name = next((key for key in keys if key in header), "")
        if not name:
            text = f"has no {' or '.join(keys)} in its header, expected an AB zero point (zero_point=)"
            raise ProductError(text, file=path, key="zero_point")
        value = header[name]
    if not isinstance(value, int | float | np.number) or not np.isfinite(value):
        raise ProductError(f"{name} = {value!r}: expected a finite AB zero point", file=path, key="zero_point")
    return float(value)


def cut_galaxies(mosaic: Mosaic, *, side: float, psf_radius: float | None, seed: int) -> Cutouts:
    """Detect objects and cut out those larger than the PSF.

    Parameters
    ----------
    mosaic : Mosaic
        The image.
    side : float
        Side of the squares in semi-major axes of the objects (rms along the major axis).
    psf_radius : float or None
        Half-light radius of the PSF [pixel]; None finds the stellar locus.
    seed : int
        Seed of the noise in place of neighbours.

    Raises
    ------
    ProductError
        If there are no objects, too few to find the stars among them, or none larger than the PSF.
    """
    require_bytes(_BYTES_PER_PIXEL * mosaic.image.size, f"galaxies of {mosaic.path}")
    bad_pixels = ~np.isfinite(mosaic.image)
    if bad_pixels.all():
        raise ProductError("has no finite pixels", file=mosaic.path)
    data = np.ascontiguousarray(np.where(bad_pixels, np.float32(0.0), mosaic.image))
    background = sep.Background(data, mask=bad_pixels)
    data -= background.back(dtype=np.float32)
    noise = background.rms(dtype=np.float32)
    if not np.all(noise[~bad_pixels] > 0.0):
        raise ProductError("the sky has no noise, expected a mosaic with a measurable rms", file=mosaic.path)
    # Bright galaxies have more pixels than sep reserves room for.
    sep.set_extract_pixstack(max(300_000, data.size // 4))
    options = {"mask": bad_pixels, "minarea": LEAST_AREA, "segmentation_map": True, "filter_type": "conv"}
    objects, owner = sep.extract(data, 1.0, err=noise, **options)
    if not len(objects):
        raise ProductError(f"no objects of {LEAST_AREA} connected pixels above the rms of the sky", file=mosaic.path)
    x, y, a = objects["x"], objects["y"], objects["a"]
    ids = np.arange(1, len(objects) + 1)
    radius, _ = sep.flux_radius(
        data, x, y, _REACH * a, 0.5, normflux=objects["flux"], mask=bad_pixels, segmap=owner, seg_id=ids
    )
    snr = objects["flux"] / (noise[np.rint(y).astype(int), np.rint(x).astype(int)] * np.sqrt(objects["npix"]))
    if psf_radius is None:
        psf_radius = _stellar_locus(mosaic.path, radius[snr > LOCUS_SNR])

    images, center, fluxes, cut_indices = [], [], [], []
    for i in np.flatnonzero(radius > LOCUS_WIDTH * psf_radius):
        column, row, half = round(x[i]), round(y[i]), int(np.ceil(0.5 * side * a[i]))
        square = (slice(row - half, row + half + 1), slice(column - half, column + half + 1))
        inside = half <= column < data.shape[1] - half and half <= row < data.shape[0] - half
        if not inside or bad_pixels[square].any():
            continue
        neighbours = (owner[square] != 0) & (owner[square] != ids[i])
        sky = stream(seed, "mosaic", int(i)).normal(size=neighbours.shape) * noise[square]
        image = np.where(neighbours, sky, data[square])
        if image.sum() > 0.0:
            images.append(image)
            center.append((x[i] - column, y[i] - row))
            fluxes.append(image.sum())
            cut_indices.append(i)
    if not images:
        text = f"none of {len(objects)} objects is larger than the PSF (half-light radius {psf_radius:.2f} pixels)"
        raise ProductError(text, file=mosaic.path)
    return Cutouts(images, np.array(center), np.array(fluxes), radius[cut_indices], float(psf_radius))


def _stellar_locus(path: str, radius: np.ndarray) -> float:
    """Return the half-light radius where those of the small ones among bright objects are densest [pixel]."""
    if len(radius) < LOCUS_COUNT:
        text = f"{len(radius)} objects with S/N above {LOCUS_SNR:.0f}, expected {LOCUS_COUNT} or more to find the stars"
        raise ProductError(f"{text} (psf_radius=)", file=path, key="psf_radius")
    # Half-sample mode (Robertson & Cryer 1974) of the smaller half: stars have one size, galaxies many.
    values = np.sort(radius)[: max(LOCUS_COUNT // 2, len(radius) // 2)]
    while len(values) > 2:
        half = (len(values) + 1) // 2
        start = int(np.argmin(values[half - 1 :] - values[: len(values) - half + 1]))
        values = values[start : start + half]
    return float(values.mean())
