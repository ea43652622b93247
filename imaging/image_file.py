"""FITS files of images of CCDs: image, variance, mask, world coordinates, table of objects."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

from ..core.arguments import check_arguments
from ..core.docstrings import Description
from ..core.errors import ProductError
from ..core.mask_planes import plane_card
from ..core.number_text import counted
from ..core.plotting import axes_at, plain_text, styled
from ..core.products import Columns, Stamp, column, read_fits, table_hdu, write_fits
from ..core.result import Result
from ..core.units import ARCSEC
from .exposure import MASK_BITS
from .stretch import draw_image, has_celestial, pixel_scale_of, world_coordinates

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Columns of the table of objects: unit and description.
OBJECT_COLUMNS = {
    "ID": ("", "number of the object on this CCD"),
    "X": ("pix", "place without turbulence, x, first pixel 0"),
    "Y": ("pix", "place without turbulence, y, first pixel 0"),
    "XI": ("rad", "tangent plane about the pointing, east"),
    "ETA": ("rad", "tangent plane about the pointing, north"),
    "RA": ("deg", "right ascension"),
    "DEC": ("deg", "declination"),
    "MAG": ("mag", "AB magnitude above the atmosphere"),
    "FLUX": ("", "expected electrons in all exposures"),
    "STAR": ("", "whether it is a star"),
    "RADIUS": ("arcsec", "half-light radius; 0 of a star"),
    "E1": ("", "(a - b)/(a + b) along xi; NaN where unknown"),
    "E2": ("", "the same along xi = eta"),
}


@dataclass(frozen=True, eq=False)
class CcdImage(Result):
    """Image of a CCD, or of a part of it.

    Attributes
    ----------
    name : str
        Name of the CCD.
    image : ndarray of float32, shape [ny, nx]
        ADU.
    variance : ndarray of float32, shape [ny, nx]
        Expected variance [ADU^2].
    mask : ndarray of int16, shape [ny, nx]
        Bits of :data:`~pachon.imaging.exposure.MASK_BITS`.
    header : astropy.io.fits.Header
        World coordinates and cards of the exposure, such as EXPTIME, GAIN, FILTER, ZEROPNT, SKY.
    objects : dict of str to ndarray
        Columns of :data:`OBJECT_COLUMNS`.
    stamp : Stamp or None
        Origin.
    mask_bits : dict of int to str
        Names of the bits of the mask.
    origins : dict of str to str
        Where gain, zero point, variance and others came from, of an image of another program.
    """

    name: str
    image: np.ndarray
    variance: np.ndarray
    mask: np.ndarray
    header: fits.Header
    objects: dict[str, np.ndarray] = field(default_factory=dict)
    stamp: Stamp | None = None
    mask_bits: dict[int, str] = field(default_factory=MASK_BITS.copy)
    origins: dict[str, str] = field(default_factory=dict)

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the image, binned to about a thousand pixels, with an asinh stretch, and where north and east are."""
        with styled():
            figure, axes = axes_at(ax, 7.0, 6.6)
            draw_image(axes, self.image, self.variance, self.header)
            words = [self.name]
            if self.band is not None:
                words.append(f"{self.band.split()[0]} band")
            if "EXPTIME" in self.header:
                words.append(f"{self.header['EXPTIME']:g} s")
            axes.set_title(plain_text(", ".join(words)), loc="left")
            return figure

    def _label(self) -> str:
        ny, nx = self.image.shape
        return f"{self.name}, {nx} x {ny} pixels, {counted(len(self.objects.get('X', ())), 'object')}"

    def _columns(self) -> dict[str, Any]:
        return {name: self.objects.get(name, np.empty(0)) for name in OBJECT_COLUMNS}

    def _described(self, name: str) -> Description:
        return Description(*OBJECT_COLUMNS[name])

    @property
    def wcs(self) -> WCS:
        """World coordinates as those of astropy."""
        return world_coordinates(self.header)

    @property
    def gain(self) -> float:
        """Electrons in an ADU; 1 where the header has no GAIN."""
        return float(self.header.get("GAIN", 1.0))

    @property
    def band(self) -> str | None:
        """Filter of the header; None where it has none."""
        return str(self.header["FILTER"]) if "FILTER" in self.header else None

    @property
    def zero_point(self) -> float | None:
        """Magnitude of a unit of the image; None where the header has no ZEROPNT."""
        return float(self.header["ZEROPNT"]) if "ZEROPNT" in self.header else None

    @property
    def has_sky(self) -> bool:
        """Whether the world coordinates are celestial."""
        return has_celestial(self.header)

    @property
    def has_scale(self) -> bool:
        """Whether the angle of a pixel is known."""
        return self.has_sky or "PIXSCALE" in self.header

    @property
    def pixel_scale(self) -> float:
        """Angle of a pixel at the reference point of the world coordinates, or of PIXSCALE without them [rad].

        ConfigError where the header has neither.
        """
        return pixel_scale_of(self.header) * ARCSEC

    def celestial(self, pixels: np.ndarray) -> np.ndarray:
        """Return right ascension and declination (ICRS) [deg], shape [n, 2], of pixels (x, y), shape [n, 2]."""
        wcs = self.wcs
        if wcs.wcs.lng == 0 and wcs.wcs.lngtyp.strip() == "RA" and wcs.wcs.radesys in ("ICRS", ""):
            return np.asarray(wcs.all_pix2world(pixels, 0))
        sky = wcs.celestial.pixel_to_world(*np.asarray(pixels, dtype=np.float64).T).icrs
        return np.stack([sky.ra.deg, sky.dec.deg], axis=1)

    def pixels_at(self, celestial: np.ndarray) -> np.ndarray:
        """Return pixels (x, y), shape [n, 2], of right ascension and declination (ICRS) [deg], shape [n, 2].

        NaN where the world coordinates have no inverse, and for declinations beyond a pole.
        """
        right_ascension, declination = np.asarray(celestial, dtype=np.float64).T
        declination = np.where(np.abs(declination) <= 90.0, declination, np.nan)
        sky = SkyCoord(right_ascension, declination, unit="deg")
        with warnings.catch_warnings(), np.errstate(invalid="ignore"):
            warnings.simplefilter("ignore")
            return np.stack(self.wcs.celestial.world_to_pixel(sky), axis=1)

    def pixels_of_ccd(self, positions: np.ndarray) -> np.ndarray:
        """Return pixels of the CCD of pixels of the image, which may be a part of it, both [n, 2]."""
        return np.asarray(positions + np.array([self.header.get("CCDX0", 0), self.header.get("CCDY0", 0)]))

    @check_arguments
    def write(self, path: str | Path) -> None:
        """Write a FITS file, whole or not at all, with checksums; equal images give equal bytes.

        Extensions IMAGE, VARIANCE, MASK and TRUTH. ``astropy.nddata.CCDData.read`` reads the image, and the others with
        ``hdu_uncertainty="VARIANCE", hdu_mask="MASK"``. ProductError if it cannot be written.
        """
        image = fits.ImageHDU(np.asarray(self.image, dtype=np.float32), self.header, name="IMAGE")
        variance = fits.ImageHDU(np.asarray(self.variance, dtype=np.float32), name="VARIANCE")
        variance.header["BUNIT"] = ("adu2", "expected variance")
        variance.header["UTYPE"] = "VarianceUncertainty"
        mask = fits.ImageHDU(np.asarray(self.mask, dtype=np.int16), name="MASK")
        for bit, name in self.mask_bits.items():
            mask.header.append(plane_card(name, bit))
        columns: Columns = {key: (values, *OBJECT_COLUMNS[key]) for key, values in self._columns().items()}
        cards = [("CCD", self.name, "name of the CCD")]
        write_fits(Path(path), [image, variance, mask, table_hdu("TRUTH", columns)], self.stamp, cards)

    @classmethod
    @check_arguments
    def read(cls, path: str | Path) -> CcdImage:
        """Read a file with the extensions of :meth:`write`; ProductError if it has not, or is damaged.

        Checksums may be missing, as in files that other programs have written.
        """
        hdus = read_fits(Path(path), checksums=False)
        image, variance, mask = (_plane(path, hdus, name) for name in ("IMAGE", "VARIANCE", "MASK"))
        if not image.shape == variance.shape == mask.shape:
            shapes = f"{image.shape}, {variance.shape}, {mask.shape}"
            raise ProductError(f"IMAGE, VARIANCE and MASK have shapes {shapes}; expected the same", file=path)
        if "TRUTH" not in hdus or not isinstance(hdus["TRUTH"], fits.BinTableHDU):
            raise ProductError("no image of a CCD (the table TRUTH is missing)", file=path)
        header = hdus[0].header
        try:
            objects = {key: column(hdus["TRUTH"], key) for key in OBJECT_COLUMNS}
            return cls(str(header["CCD"]), image, variance, mask, hdus["IMAGE"].header, objects, _stamp(header))
        except KeyError as error:
            raise ProductError(f"no image of a CCD ({' '.join(str(error.args[0]).split())})", file=path) from None


def _stamp(header: Any) -> Stamp | None:
    if "CONFHASH" not in header:
        return None
    return Stamp(header["CONFHASH"], header["SEED"], header["CREATOR"].removeprefix("pachon "))


def _plane(path: str | Path, hdus: fits.HDUList, name: str) -> np.ndarray:
    """Return the image of an extension in the machine's own byte order."""
    array = hdus[name].data if name in hdus else None
    if not isinstance(array, np.ndarray) or array.ndim != 2 or (array.dtype.kind not in "iu" and name == "MASK"):
        raise ProductError(f"no image of a CCD ({name} is missing, or has not two axes)", file=path)
    return array.astype(array.dtype.newbyteorder("="))
