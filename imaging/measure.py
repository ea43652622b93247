"""From an image of a CCD to a catalogue of galaxies: objects, stars, the PSF from these stars, fitted galaxies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import QTable, Table

from ..core.arguments import check_arguments
from ..core.errors import PachonError
from ..core.plotting import BLUE, ORANGE, axes_at, styled
from ..core.products import described_table
from ..core.result import Result
from ..core.version import VERSION
from ..pipeline.catalogue.detect import detect_objects
from ..pipeline.catalogue.fit_galaxies import fit_galaxies
from ..pipeline.catalogue.galaxy_fits import GalaxyFits, usable_galaxies
from ..pipeline.catalogue.matching import detection_rates, match_positions
from ..pipeline.catalogue.objects import DetectedObjects
from ..pipeline.catalogue.star_locus import StarSelection, select_stars
from ..pipeline.psf_model.checks import snr_weights
from ..pipeline.psf_model.model import PsfModel
from .exposure import SATURATED
from .image_file import CcdImage

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Largest distance of a detected object from a true one [pixel].
_MATCH = 3.0


@dataclass(frozen=True, eq=False)
class ImageCatalogue(Result):
    """Objects, stars, PSF and galaxies measured on one image.

    Attributes
    ----------
    image : CcdImage
        The image.
    objects : DetectedObjects
        All detected objects.
    stars : StarSelection
        Selected stars among them.
    psf : PsfModel
        Fitted to these stars; positions are pixels of the image.
    galaxies : ndarray of int, shape [n]
        Objects that are no selected stars.
    fits : GalaxyFits
        Elliptical Gaussians under the PSF fitted to them.
    usable : ndarray of bool, shape [n]
        Whether each is fit for shear.
    """

    image: CcdImage
    objects: DetectedObjects
    stars: StarSelection
    psf: PsfModel
    galaxies: np.ndarray
    fits: GalaxyFits
    usable: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw half-light radius against magnitude, selected stars in another colour."""
        magnitude, radius = self.objects.magnitude(self.image.header["ZEROPNT"]), self.objects.half_light_radius
        stars = self.stars.index
        with styled():
            figure, axes = axes_at(ax, 5.4, 4.2)
            axes.plot(magnitude, radius, ".", color=BLUE, markersize=3, label="all objects")
            axes.plot(magnitude[stars], radius[stars], ".", color=ORANGE, markersize=5, label="selected stars")
            axes.set(xlabel="magnitude", ylabel="half-light radius [pixel]")
            axes.legend(loc="upper left")
            return figure

    def _label(self) -> str:
        count, stars = len(self.objects), len(self.stars)
        return f"{self.image.name}, {count} objects, {stars} stars, {int(self.usable.sum())} usable galaxies"

    def _summary(self) -> dict[str, Any]:
        return self.metrics()

    def to_table(self) -> QTable:
        """Return the galaxies of :meth:`table`."""
        return QTable(self.table())

    def table(self) -> Table:
        """Return the galaxies as a table with sky positions, magnitudes, shapes and their errors."""
        rows, fits, header = self.galaxies, self.fits, self.image.header
        x, y = self.objects.x[rows], self.objects.y[rows]
        celestial = self.image.wcs.all_pix2world(np.stack([x, y], axis=1), 0)
        columns = {
            "number": (rows + 1, "", "number of the object"),
            "ra": (celestial[:, 0], "deg", "right ascension of the centroid"),
            "dec": (celestial[:, 1], "deg", "declination of the centroid"),
            "x": (x, "pix", "centroid, pixel centres at integers"),
            "y": (y, "pix", "centroid, pixel centres at integers"),
            "magnitude": (self.objects.magnitude(header["ZEROPNT"])[rows], "mag", "AB, in the Kron aperture"),
            "half_light_radius": (self.objects.half_light_radius[rows], "pix", "PSF included"),
            "snr": (fits.snr, "", "flux of the fit over its error"),
            "e1": (fits.e1, "", "(a - b)/(a + b) along x, before the PSF"),
            "e2": (fits.e2, "", "along the diagonal x = y, before the PSF"),
            "error": (fits.ellipticity_error, "", "standard error of a component"),
            "size": (fits.size, "pix", "rms width before the PSF"),
            "flags": (fits.flags, "", "of the fit, 0 is good"),
            "usable": (self.usable, "", "larger than stars, error of e below 0.2"),
        }
        # Names that fit FITS cards as well.
        meta: dict[str, Any] = {"CCD": self.image.name, "CREATOR": f"pachon {VERSION}"}
        if self.image.stamp is not None:
            meta |= {"CONFHASH": self.image.stamp.config_hash, "SEED": self.image.stamp.seed}
        return described_table(columns, meta)

    def metrics(self) -> dict[str, Any]:
        """Return numbers of objects and, against the truth of a simulated image, completeness and purity."""
        header, mask = self.image.header, self.image.mask
        scale = 60.0 * float(np.sqrt(abs(np.linalg.det(self.image.wcs.pixel_scale_matrix))))
        area = float((mask == 0).sum()) * scale**2
        found: dict[str, Any] = {
            "objects": len(self.objects),
            "stars": len(self.stars),
            "galaxies_fitted": len(self.galaxies),
            "usable": int(self.usable.sum()),
            "usable_per_arcmin2": float(self.usable.sum() / area),
            "star_half_light_radius_pixel": self.stars.half_light_radius,
        }
        truth = self.image.objects
        if len(truth.get("X", ())):
            # The truth counts pixels of the CCD, of which the image may be a part.
            x, y = truth["X"] - header["CCDX0"], truth["Y"] - header["CCDY0"]
            match = match_positions(self.objects.x, self.objects.y, x, y, _MATCH)
            real = match >= 0
            star = real & np.asarray(truth["STAR"], dtype=bool)[np.maximum(match, 0)]
            magnitude = self.objects.magnitude(header["ZEROPNT"])
            edges = np.arange(np.floor(np.nanmin(magnitude)), np.ceil(np.nanmax(magnitude)) + 0.5, 0.5)
            rates = detection_rates(magnitude, match, truth["MAG"], edges)
            half = np.flatnonzero((rates.n_true > 10) & (rates.completeness < 0.5))
            found |= {
                "purity": float(real.mean()),
                "magnitude_half_complete": float(edges[half[0]]) if len(half) else None,
                "star_completeness": self.stars.completeness(star),
                "star_purity": self.stars.purity(star),
            }
        return found


@check_arguments
def measure_image(
    image: CcdImage, *, order: int = 1, min_snr: float = 30.0, threads: int | None = None
) -> ImageCatalogue:
    """Detect objects, select stars, model the PSF from them and fit all other objects.

    Parameters
    ----------
    image : CcdImage
        Image, such as one of ``pachon images``.
    order : int
        Order of the polynomials of all pixels of the PSF, weighted by S/N up to about 100.
    min_snr : float
        Least S/N of stars.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.

    Raises
    ------
    DomainError
        If nothing is detected, or there are too few stars for a locus or a model.
    """
    try:
        objects = detect_objects(image.image, image.variance, image.mask, saturated=SATURATED)
        stars = select_stars(objects, image.image, mask=image.mask, min_snr=min_snr)
        stamps = stars.stamps / stars.stamps.sum(axis=(1, 2), keepdims=True)
        height, width = image.image.shape
        psf = PsfModel.fit(
            stamps,
            stars.positions,
            basis="pixels",
            order=order,
            weights=snr_weights("softened", stars.snr),
            extent=(-0.5, width - 0.5, -0.5, height - 0.5),
        )
    except PachonError as error:
        raise error.within(subject=f"CCD {image.name}") from None
    rows = np.setdiff1d(np.arange(len(objects)), stars.index)
    places = np.stack([objects.x[rows], objects.y[rows]], axis=1)
    psfs = psf.at(places)
    fits = fit_galaxies(
        image.image - objects.background,
        np.where(image.mask == 0, image.variance, 1.0),
        places[:, 0],
        places[:, 1],
        psfs / psfs.sum(axis=(1, 2), keepdims=True),
        half_light_radius=np.nan_to_num(objects.half_light_radius[rows], nan=stars.half_light_radius),
        mask=image.mask,
        segmentation=objects.segmentation,
        threads=threads,
    )
    radius = np.nan_to_num(objects.half_light_radius[rows])
    usable = usable_galaxies(fits, radius, stars.half_light_radius)
    return ImageCatalogue(image, objects, stars, psf, rows, fits, usable)
