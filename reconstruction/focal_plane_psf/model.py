"""One model of the PSF over the whole focal plane of an exposure: optics, CCD heights and turbulence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments, removed_arguments
from ...core.docstrings import Description, described
from ...core.errors import DomainError
from ...core.number_text import counted
from ...core.products import read_fits, write_fits
from ...core.progress import Reporter
from ...core.result import Result
from ...core.units import ARCSEC, positive_angle
from ...core.version import CREATOR
from ...models.camera.camera import Camera
from ...models.camera.focal_plane import FocalPlane
from ...models.telescope import Telescope
from ...wavefront.psf.stamps import Stamps
from .adaptive_shapes import AdaptiveShapes, adaptive_of_star
from .covariance import Covariance, Places
from .field import ShapeField
from .field_fit import LEAST_STARS, FittedField, fit_field, height_prior, mosaic_of
from .file import ModelFields, model_hdus, read_model
from .fit import SHAPES, ShapeData, Turbulence
from .images import ResidualImages, has_shape, with_shapes
from .layer_covariance import LayerCovariance
from .mean_star import mean_star
from .mosaic import Mosaic, PsfShapes
from .optics_prior import OpticsPrior
from .response import Instrument
from .stars import FocalPlaneStars, places_of, stars_of
from .static_heights import StaticHeights

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Images that are deformed at a time.
_BATCH = 512
# Brightest stars, from which the principal components of the residual stamps are made.
_PCA_STARS = 2000
# Fitted excess variance of a star over that of the stated noise, beyond which there is a warning.
_EXTRA_NOISE = 1.0
# Range of reduced chi-square outside of which there is a warning.
_CHI2 = (0.7, 1.4)
# Largest difference of the pixels of stamps and instrument, over these: scales of cameras are stated to a few per cent.
_OTHER_PIXELS = 0.05
# CCDs up to which stars may be less likely with the telescope that they were taken with than without any: of the nine
# of a raft in four of five exposures, by ln ratios of -8 to -16.
_FEW_CCDS = 30

# Where arguments of earlier versions stand.
_INSTRUMENT = "telescope=Instrument.of(telescope, {})"


@dataclass(frozen=True, eq=False)
class FocalPlanePsf(ModelFields, Result):
    """The PSF of one exposure over the whole focal plane.

    Made by :meth:`fit`; shapes of the PSF are e1, e2 and the weighted rms size.

    Attributes
    ----------
    field : ShapeField
        Shapes over the focal plane: the stars that the model was fitted to, covariances and optics.
    used : ndarray of bool
        Stars given to :meth:`fit` that the model was fitted to.
    leave_one_out : PsfShapes
        Prediction at each star given to :meth:`fit` from all others; NaN where a star was not used.
    chi2 : dict of str to float
        Reduced chi-square of these predictions, noise of the stars included, by shape.
    evidence : float
        Logarithm of the likelihood with the telescope over that without; NaN without a telescope.
    warnings : tuple of str
        Remarks on the fit.
    weight_fwhm, pixel_scale : float
        Weight of the moments, and pixel of the stamps [rad].
    stamp_size : int
        Pixels on a side of an image.
    mean_star : ndarray, shape [ny, nx], or None
        Mean of the stamps, of unit sum; None without stamps.
    pca : ResidualImages or None
        Principal components of what the stamps differ from the model by.
    """

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the shapes predicted at each star from the others."""
        return self.leave_one_out.plot(ax=ax)

    @classmethod
    @removed_arguments(
        wavelengths=_INSTRUMENT.format("wavelengths"),
        dispersion=_INSTRUMENT.format("Light(wavelengths, dispersion=...)"),
        atmosphere=_INSTRUMENT.format("atmosphere=..."),
        stamp_size=_INSTRUMENT.format("stamps=Stamps(size=...)"),
        budget="prior=OpticsPrior(budget=...)",
        **{n: _INSTRUMENT.format(f"stamps=Stamps({n}=...)") for n in ("pixel_size", "diffusion", "silicon", "jitter")},
    )
    @check_arguments
    def fit(
        cls,
        stars: Any,
        telescope: Telescope | Instrument | None = None,
        focal_plane: FocalPlane | StaticHeights | None = None,
        *,
        camera: str | Camera | None = None,
        weight_fwhm: ArrayLike | None = None,
        prior: OpticsPrior | None = None,
        turbulence: Turbulence = "exponential",
        components: int = 3,
        ccds: Sequence[str] | None = None,
        threads: int | None = None,
        reporter: Reporter | None = None,
    ) -> FocalPlanePsf:
        """Fit the model to the stars of one exposure.

        Parameters
        ----------
        stars : FocalPlaneStars, table, mapping or path
            The stars (:class:`~pachon.FocalPlaneStars`); or a table, the path of one, or the folder of a run.
        telescope : Telescope or Instrument, optional
            Telescope as it is believed to be; or an :class:`~pachon.Instrument`, which has wavelengths, the turbulence
            that the fit starts from, pixels, charge diffusion, silicon and jitter too, and the size of drawn images
            where the stars have no stamps. Its camera is rotated as that of the stars, where they state an angle and
            it is not rotated yet. Without it the model is turbulence, with a step, a slope and ripples of each CCD, and
            principal components.
        focal_plane : FocalPlane or StaticHeights, optional
            Heights that are known, or learnt from other exposures
            (:func:`~pachon.reconstruction.fit_static_heights`). By default they are unknown.
        camera : str or Camera, optional
            By default the telescope's. Without one positions must be lengths on one detector plane.
        weight_fwhm : float or Quantity, optional
            Weight of the moments [rad]; by default that of the stars, and where these state one no other. That of an
            instrument is not used.
        prior : OpticsPrior, optional
            Prior of unknown heights and of the residual wavefront; by default simulated heights and 0.2 um.
        turbulence : {"exponential", "layers", "forecast"}
            Covariance of what turbulence adds: two exponentials for each shape; or the theory of the layers of the
            instrument's atmosphere, their winds and strengths fitted, for all shapes together; or the same with winds
            near those of that atmosphere. Exposure time and altitudes are that atmosphere's.
        components : int
            Most principal components of the residual stamps.
        ccds : sequence of str, optional
            CCDs that should have stars: there is a remark on those that have none. By default all of the camera.
        threads : int, optional
            Number of threads; all processors by default. No byte depends on it.
        reporter : Reporter, optional
            Progress display; silent by default.

        Raises
        ------
        DomainError
            If there are fewer than 30 usable stars, a star lies outside the field of the telescope, stamps have other
            pixels than the instrument, or an argument is outside its range.
        """
        reporter = Reporter(quiet=True) if reporter is None else reporter
        prior = OpticsPrior() if prior is None else prior
        given_weight = None if weight_fwhm is None else positive_angle(weight_fwhm, "weight_fwhm")
        catalogue = stars_of(stars, given_weight)
        weight = given_weight or catalogue.weight_fwhm
        if catalogue.pixel_scale is not None and weight < catalogue.pixel_scale:
            raise DomainError(
                f"weight_fwhm = {weight / ARCSEC:.3g} arcsec: expected at least a pixel of the stamps,"
                f" {catalogue.pixel_scale / ARCSEC:.3g} arcsec, and better 2.5 of them"
            )
        if telescope is None and turbulence != "exponential":
            raise DomainError(f"turbulence = {turbulence!r}: expected a telescope, through whose pupil the layers act")
        mosaic = mosaic_of(catalogue, telescope, focal_plane, camera)
        used = catalogue.usable
        if used.sum() < LEAST_STARS:
            raise DomainError(
                f"{used.sum()} of {len(catalogue)} stars have position, shape and noise: expected {LEAST_STARS} or more"
            )
        usable_stars = catalogue.chosen(used)
        data = ShapeData(places_of(mosaic, usable_stars), usable_stars.values, usable_stars.noise**2)
        instrument = heights = None
        if telescope is not None:
            believed = Instrument.of(telescope, camera=mosaic.camera) if isinstance(telescope, Telescope) else telescope
            stamps = believed.stamps
            if catalogue.stamps is not None:
                stamps = replace(stamps, size=catalogue.stamps.shape[1])
            instrument = replace(believed, stamps=stamps, weight_fwhm=weight).with_rotator(catalogue.rotator)
            _check_pixels(catalogue, instrument)
            heights = height_prior(mosaic, focal_plane, prior.budget)
        stamp_size = Stamps().size if instrument is None else instrument.stamps.size
        if catalogue.stamps is not None:
            stamp_size = catalogue.stamps.shape[1]
        fitted = fit_field(mosaic, data, instrument, heights, prior.alignment_rms, turbulence, threads, reporter)
        field = fitted.field
        used[np.flatnonzero(used)[~fitted.consistent]] = False
        with reporter.stage("stars against the others"):
            good = field.inliers(threads)
            if not good.all():
                # Those that only the optics contradict hardly change the covariances.
                field = field.with_stars(good)
                used[np.flatnonzero(used)[~good]] = False
            residuals, variance = field.leave_one_out_residuals(threads)
        predicted = np.full((len(catalogue), 3), np.nan)
        predicted[used] = field.data.values - residuals
        chi2 = {name: float(v) for name, v in zip(SHAPES, (residuals**2 / variance).mean(axis=0), strict=True)}
        model = cls(
            field,
            used,
            PsfShapes.of_values(predicted),
            chi2,
            fitted.evidence,
            _fit_warnings(field, chi2, fitted, mosaic.names if ccds is None else ccds),
            weight,
            catalogue.pixel_scale,
            stamp_size,
        )
        return model._with_stamps(catalogue, components, threads, reporter)

    def _label(self) -> str:
        return f"{int(self.used.sum())} of {counted(len(self.used), 'star')}"

    def _columns(self) -> dict[str, Any]:
        predicted = self.leave_one_out
        return {"used": self.used, "e1": predicted.e1, "e2": predicted.e2, "size": predicted.size}

    def _described(self, name: str) -> Description:
        description = described(type(self) if name == "used" else PsfShapes, name)
        return (
            description
            if name == "used"
            else description._replace(text=f"Prediction from all other stars: {description.text}")
        )

    @property
    def mosaic(self) -> Mosaic:
        """The CCDs."""
        return self.field.mosaic

    @property
    def covariances(self) -> tuple[Covariance | LayerCovariance, ...]:
        """Covariances of what turbulence adds to e1, e2 and ln size: of each, or one of all with the layers found."""
        return self.field.covariances

    @property
    def heights(self) -> FocalPlane | None:
        """Fitted heights of the CCDs; None without a telescope."""
        return None if self.field.optics is None else self.field.optics.plane

    @check_arguments
    def shapes(self, ccd: str | Sequence[str], x: ArrayLike, y: ArrayLike, *, threads: int | None = None) -> PsfShapes:
        """Return the shapes of the PSF.

        Parameters
        ----------
        ccd : str or sequence of str
            CCD of all positions, or of each.
        x, y : array_like or Quantity
            Positions on the detector [m], or in pixels of the CCD (``astropy.units.pix``).
        """
        return PsfShapes.of_values(self.field.predict(self.field.mosaic.places(ccd, x, y), threads=threads)[0])

    @check_arguments
    def predict(
        self, ccd: str | Sequence[str], x: ArrayLike, y: ArrayLike, *, threads: int | None = None
    ) -> tuple[PsfShapes, PsfShapes]:
        """Return the shapes of :meth:`shapes` and their standard deviations of :meth:`uncertainty`, in one pass."""
        places = self.mosaic.places(ccd, x, y)
        values, variance = self.field.predict(places, variance=True, threads=threads)
        sigma = np.sqrt(np.maximum(np.zeros_like(values) if variance is None else variance, 0.0))
        return PsfShapes.of_values(values), PsfShapes(sigma[:, 0], sigma[:, 1], np.exp(values[:, 2]) * sigma[:, 2])

    @check_arguments
    def uncertainty(
        self, ccd: str | Sequence[str], x: ArrayLike, y: ArrayLike, *, threads: int | None = None
    ) -> PsfShapes:
        """Return standard deviations of e1, e2 and the size [rad]; arguments as for :meth:`shapes`.

        By how much stars scatter more than their stated noise is among them: those of held-out stars are these and the
        noise, in quadrature.
        """
        return self.predict(ccd, x, y, threads=threads)[1]

    @check_arguments
    def adaptive_shapes(self, shapes: PsfShapes) -> AdaptiveShapes:
        """Return the adaptive moments of PSFs of given shapes, such as those of :meth:`shapes`.

        They are those of the mean star convolved to each shape. Images of one weighted shape differ in their wings:
        those of :meth:`draw` have another g by 5e-4 a component in 15 s of turbulence, and are as far from the truth.
        """
        if self.mean_star is None or self.pixel_scale is None:
            raise DomainError("adaptive_shapes: expected a model of stars with stamps")
        return adaptive_of_star(self.mean_star, shapes, self.pixel_scale, self.weight_fwhm)

    @check_arguments
    def draw(self, ccd: str | Sequence[str], x: ArrayLike, y: ArrayLike, *, threads: int | None = None) -> np.ndarray:
        """Return images of the PSF, of unit sum and centred on a pixel, [n, ny, nx]; arguments as for :meth:`shapes`.

        Principal components of the residual stamps are added to the image of the optics under the mean of turbulence
        (without a telescope, to the mean star). The sum is convolved with the Gaussian, of positive or negative width,
        that gives it the predicted shape.
        """
        places = self.field.mosaic.places(ccd, x, y)
        values, _ = self.field.predict(places, threads=threads)
        return self._draw_places(places, values, threads)

    @check_arguments
    def draw_uncertainty(
        self, ccd: str | Sequence[str], x: ArrayLike, y: ArrayLike, *, threads: int | None = None
    ) -> np.ndarray:
        """Return the standard deviation of each pixel of :meth:`draw`, shape [n, ny, nx]."""
        places = self.field.mosaic.places(ccd, x, y)
        values, variance = self.field.predict(places, variance=True, threads=threads)
        assert variance is not None
        total = np.zeros((len(places), self.stamp_size, self.stamp_size))
        for shape in range(3):
            step = np.zeros((len(places), 3))
            step[:, shape] = np.sqrt(np.maximum(variance[:, shape], 0.0))
            ends = [self._draw_places(places, values + sign * step, threads) for sign in (1.0, -1.0)]
            total += (0.5 * (ends[0] - ends[1])) ** 2
        return np.sqrt(total)

    @check_arguments
    def write(self, path: str | Path) -> None:
        """Write the model as a FITS file, telescope included."""
        write_fits(Path(path), model_hdus(self), None, [CREATOR])

    @classmethod
    @check_arguments
    def read(cls, path: str | Path) -> FocalPlanePsf:
        """Read a model; ProductError if the file is missing, damaged or of another kind."""
        return read_model(cls, read_fits(Path(path)), Path(path))

    def _draw_places(self, places: Places, values: np.ndarray, threads: int | None) -> np.ndarray:
        """Return images of given shapes e1, e2 and ln size [n, 3]."""
        optics, mean = self.field.optics, self.mean_star
        scale = self.pixel_scale if optics is None else optics.pixel_scale
        if scale is None or (optics is None and mean is None):
            raise DomainError("draw: expected a telescope, or stars with stamps")
        images = np.empty((len(places), self.stamp_size, self.stamp_size))
        for first in range(0, len(places), _BATCH):
            batch = slice(first, first + _BATCH)
            batch_places = places[batch]
            base = np.asarray(mean) if optics is None else optics.images(batch_places, threads)
            if self.pca is not None:
                base = base + self.pca.at(batch_places, threads)
            images[batch] = with_shapes(
                np.broadcast_to(base, (len(batch_places), *images.shape[1:])), values[batch], scale, self.weight_fwhm
            )
        return images

    def _with_stamps(
        self, given: FocalPlaneStars, components: int, threads: int | None, reporter: Reporter
    ) -> FocalPlanePsf:
        """Return the model with the mean star and the principal components of the residual stamps."""
        if given.stamps is None or given.pixel_scale is None:
            return self
        finite = np.flatnonzero(np.isfinite(given.stamps[self.used]).all(axis=(1, 2)))
        if not finite.size:
            return self
        brightest = np.argsort(self.field.data.noise[finite, 0], kind="stable")[:_PCA_STARS]
        finite = np.sort(finite[brightest])
        stamps = given.stamps[self.used][finite].astype(np.float64)
        places, noise = replace(self.field.data.places[finite], amplitude=None), self.field.data.noise[finite]
        weight = 1.0 / np.maximum(noise[:, 0], np.percentile(noise[:, 0], 10))
        mean, passed = mean_star(stamps, weight)
        if not mean.any():
            return self
        model = replace(self, mean_star=mean, pixel_scale=given.pixel_scale)
        if components < 1:
            return model
        with reporter.stage("residual stamps"):
            plain = model._draw_places(places, self.field.data.values[finite], threads)
            reached = has_shape(plain)
            if not reached.any():
                return model
            # The sum over a thousand pixels of sky is off by far more than the light of a faint star is.
            flux = np.einsum("nyx,nyx->n", stamps, plain) / np.einsum("nyx,nyx->n", plain, plain)
            reached &= flux > 0.0
            residuals = stamps[reached] / flux[reached, None, None] - plain[reached]
            stars = places[reached], weight[reached]
            pca = ResidualImages.fit(residuals, *stars, self.field.mosaic, components, threads, passed)
        return replace(model, pca=pca)


def _check_pixels(stars: FocalPlaneStars, instrument: Instrument) -> None:
    """Raise DomainError where the stamps of stars have other pixels than an instrument, whose images are drawn."""
    scale, of_instrument = stars.pixel_scale, instrument.pixel_scale
    if stars.stamps is None or scale is None or abs(scale / of_instrument - 1.0) <= _OTHER_PIXELS:
        return
    pixel_um = 1e6 * instrument.stamps.pixel_size * scale / of_instrument
    raise DomainError(
        f"pixel_scale = {scale / ARCSEC:.4g} arcsec of the stamps: expected {of_instrument / ARCSEC:.4g}, the pixels of"
        f" the instrument; Instrument.of(telescope, stamps=Stamps(pixel_size=...)) has others: {pixel_um:.3g} um"
    )


def _fit_warnings(
    field: ShapeField, chi2: dict[str, float], fitted: FittedField, expected: Sequence[str]
) -> tuple[str, ...]:
    """Return remarks on a fit, a line each."""
    remarks = []
    if fitted.at_bounds:
        remarks.append(f"hyperparameters at their bounds: {', '.join(fitted.at_bounds)}")
    for name, value in chi2.items():
        if not _CHI2[0] < value < _CHI2[1]:
            remarks.append(
                f"reduced chi-square of {name} at the stars is {value:.2f}: the noise of the stars is not as stated"
            )
    nuggets = np.concatenate([np.atleast_1d(covariance.nugget) for covariance in field.covariances])
    for nugget, noise, name in zip(nuggets, field.data.noise.T, SHAPES, strict=True):
        if nugget > _EXTRA_NOISE * np.median(noise):
            ratio = np.sqrt(1.0 + nugget / np.median(noise))
            remarks.append(f"the stars scatter {ratio:.1f} times as much in {name} as the stated noise")
    ccds = np.unique(field.data.places.ccd)
    if np.isfinite(fitted.evidence) and fitted.evidence < 0.0:
        wrong = "it is not the one that they were taken with, or its heights are far smaller than their prior allows"
        of_few_ccds = f"{counted(len(ccds), 'CCD')} may be too few to tell it from turbulence; or "
        remarks.append(
            "the stars are less likely with this telescope than without any (ln ratio "
            f"{fitted.evidence:.0f}): {of_few_ccds if len(ccds) <= _FEW_CCDS else ''}{wrong}"
        )
    empty = [n for i, n in enumerate(field.mosaic.names) if i not in ccds and n in expected]
    if empty:
        shown = ", ".join(empty[:5]) + (", ..." if len(empty) > 5 else "")
        remarks.append(f"{counted(len(empty), 'CCD')} without stars, predicted from the others: {shown}")
    if len(ccds) == 1:
        remarks.append("all stars are on one CCD: elsewhere the prediction is their mean")
    return tuple(remarks)
