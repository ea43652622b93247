"""Catalogue of galaxies from an image of a CCD: objects, stars, their PSF model, galaxy fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import QTable, Table
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments, removed_arguments
from ..core.errors import ConfigError, DomainError
from ..core.number_text import counted
from ..core.plotting import BLUE, ORANGE, axes_at, styled
from ..core.products import Columns, described_table
from ..core.result import Result
from ..core.units import ARCMIN
from ..core.version import VERSION
from ..measure.catalogue.fit_galaxies import fit_galaxies
from ..measure.catalogue.galaxy_fits import GalaxyFits, usable_galaxies
from ..measure.catalogue.matching import detection_rates, match_positions
from ..measure.catalogue.objects import DetectedObjects, ObjectFlag
from ..measure.catalogue.star_locus import StarSelection
from ..measure.shapes import half_light_radii
from ..measure.shear.shear_shapes import ShearShapes, mean_shear
from ..reconstruction.focal_plane_psf.model import FocalPlanePsf
from ..reconstruction.piff.psf import PiffPsf
from ..reconstruction.psf_model.model import PsfModel
from ..reconstruction.psf_model.recipe import Recipe, RecipeName
from ..reconstruction.psfex import PsfexPsf
from ..sky.sky_shapes import STEP, SkyShapes, along_sky, jacobians_on_sky
from .image_file import CcdImage
from .image_psf import ImagePsf, psfs_on
from .image_shear import object_shears
from .image_stars import (
    MANY_STARS,
    detected_objects,
    few_or_many_stars,
    few_stars_warning,
    fit_image_psf,
    undersampled_model_warning,
    undersampled_warning,
)
from .object_colours import ObjectColours

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Arguments of the recipe that stood beside it.
_REPLACED = dict.fromkeys(
    ("basis", "interpolation", "weights", "n_components", "order"),
    "a key of recipe, such as Recipe.of('paper', order=1)",
)
# PSFs of a model whose widths say whether pixels sample it.
_WIDTHS = 9
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
    psf : PsfModel, FocalPlanePsf, PiffPsf or PsfexPsf
        Fitted to these stars, its positions pixels of the image; or the model that was given.
    galaxies : ndarray of int, shape [n]
        Objects that are no selected stars.
    fits : GalaxyFits
        Elliptical Gaussians under the PSF fitted to them.
    usable : ndarray of bool, shape [n]
        Whether each is fit for shear.
    shear : ShearShapes or None
        Weighted ellipticities and responses of the functionals, the sums over the peaks nearest to each object; None
        where the scale of the pixels is unknown, or their PSF too wide.
    warnings : tuple of str
        What makes the shapes less certain than those of other images.
    colours : ObjectColours or None
        Colours of stars and galaxies, where they were given.
    """

    image: CcdImage
    objects: DetectedObjects
    stars: StarSelection
    psf: ImagePsf
    galaxies: np.ndarray
    fits: GalaxyFits
    usable: np.ndarray
    shear: ShearShapes | None = None
    warnings: tuple[str, ...] = ()
    colours: ObjectColours | None = None

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw half-light radius against magnitude, selected stars in another colour."""
        magnitude, radius = self._magnitudes(), self.objects.half_light_radius
        stars = self.stars.index
        with styled():
            figure, axes = axes_at(ax, 5.4, 4.2)
            axes.plot(magnitude, radius, ".", color=BLUE, markersize=3, label="all objects")
            axes.plot(magnitude[stars], radius[stars], ".", color=ORANGE, markersize=5, label="selected stars")
            label = "magnitude" if self.image.zero_point is not None else "instrumental magnitude"
            axes.set(xlabel=label, ylabel="half-light radius [pixel]")
            axes.legend(loc="upper left")
            return figure

    def _magnitudes(self) -> np.ndarray:
        """Return the magnitudes of the objects; without a zero point those of flux 1 are 0."""
        return self.objects.magnitude(self.image.zero_point or 0.0)

    def _label(self) -> str:
        count, stars = len(self.objects), len(self.stars)
        galaxies = counted(int(self.usable.sum()), "usable galaxy", "usable galaxies")
        return f"{self.image.name}, {counted(count, 'object')}, {counted(stars, 'star')}, {galaxies}"

    def _summary(self) -> dict[str, Any]:
        return self.metrics()

    def to_table(self) -> QTable:
        """Return the galaxies of :meth:`table`."""
        return QTable(self.table())

    def table(self) -> Table:
        """Return the galaxies as a table with positions, fluxes, shapes and their errors.

        Right ascension, declination and shapes on the sky are of images with world coordinates, magnitudes of those
        with a zero point.
        """
        rows, fits = self.galaxies, self.fits
        x, y = self.objects.x[rows], self.objects.y[rows]
        columns: Columns = {"number": (rows + 1, "", "number of the object")}
        sky = self._sky_shapes(x, y) if self.image.has_sky else None
        if sky is not None:
            columns |= {
                "ra": (np.rad2deg(sky.ra) % 360.0, "deg", "right ascension of the centroid"),
                "dec": (np.rad2deg(sky.dec), "deg", "declination of the centroid"),
            }
        columns |= {
            "x": (x, "pix", "centroid, pixel centres at integers"),
            "y": (y, "pix", "centroid, pixel centres at integers"),
            "flux": (self.objects.flux[rows], "", "in the Kron aperture, in the unit of the image"),
            "flux_error": (self.objects.flux_error[rows], "", "standard error"),
        }
        if self.image.zero_point is not None:
            columns["magnitude"] = (self._magnitudes()[rows], "mag", "AB, in the Kron aperture")
        columns |= {
            "half_light_radius": (self.objects.half_light_radius[rows], "pix", "PSF included"),
            "snr": (fits.snr, "", "flux of the fit over its error"),
            "e1": (fits.e1, "", "(a - b)/(a + b) along x, before the PSF"),
            "e2": (fits.e2, "", "along the diagonal x = y, before the PSF"),
        }
        if sky is not None:
            columns |= {
                "g1_sky": (sky.g1_sky, "", "e on the sky, > 0 from east to west, as of GalSim and TreeCorr"),
                "g2_sky": (sky.g2_sky, "", "e on the sky, > 0 from north-west to south-east"),
            }
        columns |= {
            "error": (fits.ellipticity_error, "", "standard error of a component"),
            "size": (fits.size, "pix", "rms width before the PSF"),
            "flags": (fits.flags, "", "of the fit, 0 is good"),
            "usable": (self.usable, "", "larger than stars, error of e below 0.2, not saturated"),
        }
        if self.shear is not None:
            columns |= {
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

    def _sky_shapes(self, x: np.ndarray, y: np.ndarray) -> SkyShapes:
        """Return the shapes of the galaxies on the sky, whatever celestial coordinates the image has."""
        sky, jacobians = jacobians_on_sky(
            lambda pixels: np.deg2rad(self.image.celestial(pixels)), np.stack([x, y], axis=1), STEP
        )
        return SkyShapes(sky[:, 0], sky[:, 1], *along_sky(self.fits.e1, self.fits.e2, jacobians))

    def metrics(self) -> dict[str, Any]:
        """Return numbers of objects and, against the truth of a simulated image, completeness and purity."""
        area = None
        if self.image.has_scale:
            area = float((self.image.mask == 0).sum()) * (self.image.pixel_scale / ARCMIN) ** 2
        numbers: dict[str, Any] = {
            "objects": len(self.objects),
            "stars": len(self.stars),
            "galaxies_fitted": len(self.galaxies),
            "usable": int(self.usable.sum()),
            "usable_per_arcmin2": None if area is None else float(self.usable.sum() / area),
            "star_half_light_radius_pixel": self.stars.half_light_radius,
        }
        if isinstance(self.psf, PsfModel) and self.psf.colour is not None:
            numbers["colour_probability"] = self.psf.colour.probability
        if self.warnings:
            numbers["warnings"] = list(self.warnings)
        if (
            self.shear is not None
            and (self.shear.weight > 0.0).sum() > 1
            and min(self.shear.r11.sum(), self.shear.r22.sum()) > 0.0
        ):
            mean = mean_shear(self.shear)
            numbers |= {name: getattr(mean, name) for name in ("g1", "g1_error", "g2", "g2_error")}
        truth = self.image.objects
        if len(truth.get("X", ())):
            # The truth counts pixels of the CCD, of which the image may be a part.
            x, y = np.stack([truth["X"], truth["Y"]]) - self.image.pixels_of_ccd(np.zeros(2))[:, None]
            match = match_positions(self.objects.x, self.objects.y, x, y, _MATCH)
            real = match >= 0
            star = real & np.asarray(truth["STAR"], dtype=bool)[np.maximum(match, 0)]
            magnitude = self._magnitudes()
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


@removed_arguments(**_REPLACED)
@check_arguments
def measure_image(
    image: CcdImage,
    *,
    psf: PsfModel | FocalPlanePsf | PiffPsf | PsfexPsf | None = None,
    recipe: RecipeName | Recipe | None = None,
    stars: ArrayLike | None = None,
    colours: ObjectColours | None = None,
    min_snr: float = 30.0,
    threads: int | None = None,
) -> ImageCatalogue:
    """Detect objects, select stars, model the PSF from them and fit all other objects.

    Parameters
    ----------
    image : CcdImage
        Image, such as one of ``pachon images`` or of :func:`~pachon.load_image`.
    psf : PsfModel, FocalPlanePsf, PiffPsf or PsfexPsf, optional
        Model of the PSF: of all CCDs, such as one fitted to :func:`~pachon.imaging.focal_plane_stars` of the images of
        the exposure, or of this one, its positions pixels of the image. By default one is fitted to the stars of the
        image. With a model stars are left out of the galaxies where there are any.
    recipe : str or Recipe, optional
        Kind of the model of the CCD, as of :meth:`~pachon.PsfModel.fit`: by default every pixel by kriging, which needs
        no choice, and a constant for fewer than ten stars; ``paper`` for that of Jee & Tyson (2011).
    stars : array, optional
        Pixels (x, y) of stars, such as of a catalogue, the first pixel's centre at (0, 0), [k, 2]; by default stars are
        selected by their size.
    colours : ObjectColours, optional
        Colours of stars, to which the model of the CCD is fitted, and of galaxies, for which it is drawn: each object
        with that of the nearest entry within 3 pixels, others with the mean. A model of Piff with one property takes
        them too. The functionals of the shear have one PSF
        for each part of the image, that of the mean colour of its galaxies.
    min_snr : float
        Least S/N of stars.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.

    Raises
    ------
    ConfigError
        If a recipe is chosen beside a model.
    DomainError
        If nothing is detected, there are fewer than three stars for a model, or the CCD is none of `psf`.
    """
    if psf is not None and recipe is not None:
        raise ConfigError("recipe is of a model of the CCD: expected none beside psf")
    objects = detected_objects(image)
    warnings: tuple[str, ...] = ()
    model: ImagePsf
    if psf is None:
        selected_stars = few_or_many_stars(image, objects, min_snr, stars)
        star_colours = None if colours is None else colours.at(selected_stars.positions)
        model = fit_image_psf(image, selected_stars, None if recipe is None else Recipe.of(recipe), star_colours)
        if len(selected_stars) < MANY_STARS:
            warnings = (few_stars_warning(selected_stars),)
        if (warning := undersampled_warning(objects, selected_stars)) is not None:
            warnings = (*warnings, warning)
    else:
        model = psf
        selected_stars = _stars_beside_model(image, objects, psf, min_snr, stars, colours)
    rows = np.setdiff1d(np.arange(len(objects)), selected_stars.index)
    if not len(rows):
        raise DomainError("all objects are stars: expected galaxies", subject=f"CCD {image.name}")
    places = np.stack([objects.x[rows], objects.y[rows]], axis=1)
    galaxy_colours: np.ndarray | None = None
    mean_colour: float | None = None
    if colours is not None:
        galaxy_colours = colours.at(places)
        mean_colour = ObjectColours(places, galaxy_colours).mean
        warnings = (*warnings, *_colour_warnings(colours.at(selected_stars.positions), galaxy_colours, model))

    def psfs_at(positions: np.ndarray) -> np.ndarray:
        """Return PSFs of unit sum at pixels of the image, for the mean colour of the galaxies."""
        return psfs_on(image, model, positions, threads, mean_colour)

    galaxy_psfs = psfs_on(image, model, places, threads, galaxy_colours)
    if psf is not None:
        step = max(1, len(galaxy_psfs) // _WIDTHS)
        if (warning := undersampled_model_warning(galaxy_psfs[::step])) is not None:
            warnings = (*warnings, warning)
    fits = fit_galaxies(
        image.image - objects.background,
        np.where(image.mask == 0, image.variance, 1.0),
        places[:, 0],
        places[:, 1],
        galaxy_psfs,
        half_light_radius=np.nan_to_num(objects.half_light_radius[rows], nan=selected_stars.half_light_radius),
        mask=image.mask,
        segmentation=objects.segmentation,
        threads=threads,
    )
    radius = np.nan_to_num(objects.half_light_radius[rows])
    # A saturated star is as wide as a galaxy.
    saturated = (objects.flags[rows] & ObjectFlag.SATURATED) != 0
    usable = usable_galaxies(fits, radius, selected_stars.half_light_radius) & ~saturated
    try:
        shear = object_shears(image, objects, psfs_at, threads=threads).take(rows) if image.has_scale else None
    except DomainError as error:
        shear, warnings = None, (*warnings, f"no shear of functionals: {error.problem}")
    return ImageCatalogue(image, objects, selected_stars, model, rows, fits, usable, shear, warnings, colours)


def _colour_warnings(star_colours: np.ndarray, galaxy_colours: np.ndarray, psf: ImagePsf) -> list[str]:
    """Return words for stars and galaxies without colours, and for a model that knows of none."""
    of_piff = isinstance(psf, PiffPsf) and len(psf.property_names) == 1
    if not of_piff and not (isinstance(psf, PsfModel) and psf.colour is not None):
        return ["colours change nothing: the PSF model has no dependence on them"]
    unknown = [int(np.isnan(values).sum()) for values in (star_colours, galaxy_colours)]
    if not any(unknown):
        return []
    return [
        f"{unknown[0]} of {len(star_colours)} stars and {unknown[1]} of {len(galaxy_colours)} galaxies have no colour "
        "and count as the mean"
    ]


def _stars_beside_model(
    image: CcdImage,
    objects: DetectedObjects,
    psf: ImagePsf,
    min_snr: float,
    positions: ArrayLike | None,
    colours: ObjectColours | None,
) -> StarSelection:
    """Return the stars of an image whose PSF is known; none, with the size of the PSF, where they have no locus."""
    try:
        return few_or_many_stars(image, objects, min_snr, positions)
    except DomainError:
        if positions is not None:
            raise
        middle = 0.5 * (np.array(image.image.shape[::-1]) - 1.0)
        stamps = psfs_on(image, psf, middle[None], None, None if colours is None else colours.mean)
        return StarSelection.empty(len(objects), float(half_light_radii(stamps)[0]), stamps.shape[1:])
