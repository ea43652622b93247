"""Catalogue of galaxies from an image of a CCD: objects, stars, their PSF model, galaxy fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units as u
from astropy.table import QTable, Table

from ..core.arguments import check_arguments
from ..core.errors import ConfigError
from ..core.plotting import BLUE, ORANGE, axes_at, styled
from ..core.products import described_table
from ..core.result import Result
from ..core.units import ARCMIN
from ..core.version import VERSION
from ..measure.catalogue.fit_galaxies import fit_galaxies
from ..measure.catalogue.galaxy_fits import GalaxyFits, usable_galaxies
from ..measure.catalogue.matching import detection_rates, match_positions
from ..measure.catalogue.objects import DetectedObjects
from ..measure.catalogue.star_locus import StarSelection
from ..measure.shear.shear_shapes import ShearShapes, mean_shear
from ..reconstruction.focal_plane_psf.model import FocalPlanePsf
from ..reconstruction.psf_model.basis import Basis
from ..reconstruction.psf_model.interpolation import Interpolation
from ..reconstruction.psf_model.model import PsfModel
from ..reconstruction.psf_model.recipe import Recipe
from .image_file import CcdImage
from .image_shear import object_shears
from .image_stars import fit_image_psf, objects_and_stars, pixels_of_ccd

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
    psf : PsfModel or FocalPlanePsf
        Fitted to these stars, its positions pixels of the image; or the model of all CCDs that was given.
    galaxies : ndarray of int, shape [n]
        Objects that are no selected stars.
    fits : GalaxyFits
        Elliptical Gaussians under the PSF fitted to them.
    usable : ndarray of bool, shape [n]
        Whether each is fit for shear.
    shear : ShearShapes
        Weighted ellipticities and responses of the functionals, the sums over the peaks nearest to each object.
    """

    image: CcdImage
    objects: DetectedObjects
    stars: StarSelection
    psf: PsfModel | FocalPlanePsf
    galaxies: np.ndarray
    fits: GalaxyFits
    usable: np.ndarray
    shear: ShearShapes

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
            "shear_e1": (self.shear.e1, "", "weighted M1/(M0 + C) of the functionals, along x"),
            "shear_e2": (self.shear.e2, "", "weighted M2/(M0 + C), along x = y"),
            "shear_r11": (self.shear.r11, "", "response of shear_e1 to g1"),
            "shear_r12": (self.shear.r12, "", "mean response of shear_e1 to g2, shear_e2 to g1"),
            "shear_r22": (self.shear.r22, "", "response of shear_e2 to g2"),
            "shear_weight": (self.shear.weight, "", "sum of the weights of the peaks"),
        }
        # Names that fit FITS cards as well.
        meta: dict[str, Any] = {"CCD": self.image.name, "CREATOR": f"pachon {VERSION}"}
        if self.image.stamp is not None:
            meta |= {"CONFHASH": self.image.stamp.config_hash, "SEED": self.image.stamp.seed}
        return described_table(columns, meta)

    def metrics(self) -> dict[str, Any]:
        """Return numbers of objects and, against the truth of a simulated image, completeness and purity."""
        header, mask = self.image.header, self.image.mask
        area = float((mask == 0).sum()) * (self.image.pixel_scale / ARCMIN) ** 2
        numbers: dict[str, Any] = {
            "objects": len(self.objects),
            "stars": len(self.stars),
            "galaxies_fitted": len(self.galaxies),
            "usable": int(self.usable.sum()),
            "usable_per_arcmin2": float(self.usable.sum() / area),
            "star_half_light_radius_pixel": self.stars.half_light_radius,
        }
        if (self.shear.weight > 0.0).sum() > 1 and min(self.shear.r11.sum(), self.shear.r22.sum()) > 0.0:
            mean = mean_shear(self.shear)
            numbers |= {name: getattr(mean, name) for name in ("g1", "g1_error", "g2", "g2_error")}
        truth = self.image.objects
        if len(truth.get("X", ())):
            # The truth counts pixels of the CCD, of which the image may be a part.
            x, y = np.stack([truth["X"], truth["Y"]]) - pixels_of_ccd(self.image, np.zeros(2))[:, None]
            match = match_positions(self.objects.x, self.objects.y, x, y, _MATCH)
            real = match >= 0
            star = real & np.asarray(truth["STAR"], dtype=bool)[np.maximum(match, 0)]
            magnitude = self.objects.magnitude(header["ZEROPNT"])
            edges = np.arange(np.floor(np.nanmin(magnitude)), np.ceil(np.nanmax(magnitude)) + 0.5, 0.5)
            rates = detection_rates(magnitude, match, truth["MAG"], edges)
            half = np.flatnonzero((rates.n_true > 10) & (rates.completeness < 0.5))
            numbers |= {
                "purity": float(real.mean()),
                "magnitude_half_complete": float(edges[half[0]]) if len(half) else None,
                "star_completeness": self.stars.completeness(star),
                "star_purity": self.stars.purity(star),
            }
        return numbers


@check_arguments
def measure_image(
    image: CcdImage,
    *,
    psf: FocalPlanePsf | None = None,
    recipe: str | Recipe | None = None,
    basis: str | Basis | None = None,
    interpolation: str | Interpolation | None = None,
    weights: str | None = None,
    n_components: int | None = None,
    order: int | None = None,
    min_snr: float = 30.0,
    threads: int | None = None,
) -> ImageCatalogue:
    """Detect objects, select stars, model the PSF from them and fit all other objects.

    Parameters
    ----------
    image : CcdImage
        Image, such as one of ``pachon images``.
    psf : FocalPlanePsf, optional
        Model of all CCDs, such as one fitted to :func:`~pachon.focal_plane_stars` of the images of the exposure. By
        default a model of the CCD is fitted to the stars of the image.
    recipe : str or Recipe, optional
        Kind of the model of the CCD, as of :meth:`~pachon.PsfModel.fit`: by default every pixel by kriging, which needs
        no choice; ``paper`` for that of Jee & Tyson (2011).
    basis, interpolation, weights, n_components, order : optional
        Keys of the recipe to change: weights are equal, snr, softened or noise, the others as of
        :meth:`~pachon.PsfModel.fit`.
    min_snr : float
        Least S/N of stars.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.

    Raises
    ------
    ConfigError
        If a kind of model is chosen beside a model of all CCDs.
    DomainError
        If nothing is detected, there are too few stars for a locus or a model, or the CCD is none of `psf`.
    """
    keys = {
        "basis": basis,
        "interpolation": interpolation,
        "weights": weights,
        "n_components": n_components,
        "order": order,
    }
    if psf is not None and not all(value is None for value in (recipe, *keys.values())):
        raise ConfigError(f"recipe, {', '.join(keys)} are of models of the CCD: expected none beside psf")
    objects, stars = objects_and_stars(image, min_snr)
    rows = np.setdiff1d(np.arange(len(objects)), stars.index)
    places = np.stack([objects.x[rows], objects.y[rows]], axis=1)
    model: PsfModel | FocalPlanePsf = fit_image_psf(image, stars, Recipe.of(recipe, **keys)) if psf is None else psf

    def psfs_at(positions: np.ndarray) -> np.ndarray:
        """Return PSFs of unit sum at pixels of the image."""
        if isinstance(model, PsfModel):
            stamps = model.at(positions)
        else:
            # Centroids at the rim may lie outside by a part of a pixel.
            inside = np.clip(positions, -0.5, np.array(image.image.shape[::-1]) - 0.5)
            stamps = model.draw(image.name, *(pixels_of_ccd(image, inside).T * u.pix), threads=threads)
        return np.asarray(stamps / stamps.sum(axis=(1, 2), keepdims=True))

    fits = fit_galaxies(
        image.image - objects.background,
        np.where(image.mask == 0, image.variance, 1.0),
        places[:, 0],
        places[:, 1],
        psfs_at(places),
        half_light_radius=np.nan_to_num(objects.half_light_radius[rows], nan=stars.half_light_radius),
        mask=image.mask,
        segmentation=objects.segmentation,
        threads=threads,
    )
    shear = object_shears(image, objects, psfs_at, threads=threads).take(rows)
    radius = np.nan_to_num(objects.half_light_radius[rows])
    usable = usable_galaxies(fits, radius, stars.half_light_radius)
    return ImageCatalogue(image, objects, stars, model, rows, fits, usable, shear)
