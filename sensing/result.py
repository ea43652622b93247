"""Result of a fit of donuts: wavefronts, seeing, residual images, tables and pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units as u
from astropy.table import QTable

from ..core.number_text import counted
from ..core.plotting import figure_at, plain_text, styled
from ..core.result import Result
from ..core.units import arcseconds
from ..design.drawing import field_colors
from ..design.metrics.field_zernikes import name_terms
from ..raytrace.rays import Projection
from .amplifier_steps import step_table, step_words
from .degrees import FreedomEstimate
from .exposure import ExposureWavefront
from .flags import DonutFlag
from .frames import DonutFrames, FrameName
from .observatory_zernikes import ObservatoryZernikes, ZernikeConvention, observatory_zernikes
from .rim_table import rim_table
from .star_errors import ErrorParts

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from ..models.telescope import Telescope

#: Donuts of one picture unless others are asked for.
_SHOWN = 6
#: Pixels shown beyond those that have a model.
_RIM = 8
#: Range of the residuals over their standard deviation.
_RANGE = 5.0
#: Meaning of the columns of the table.
_WAVEFRONT = "wavefront beyond that of the telescope, annular Zernike term of this Noll index"
_MEANINGS = {
    "field_x": "field angle along x",
    "field_y": "field angle along y",
    "flags": "bits of DonutFlag",
    "reasons": "flags in words",
    "flux": "light of the star",
    "x": "place of the chief ray from the centre of the stamp",
    "y": "place of the chief ray from the centre of the stamp",
    "background": "level of the background at the centre of the stamp",
    "background_slope_x": "slope of the background along x",
    "background_slope_y": "slope of the background along y",
    "fwhm": "full width at half maximum of the long exposure",
    "chi2": "sum of squares of the residuals over their variance",
    "n_pixels": "number of the pixels in that sum",
    "n_companions": "number of neighbours that were fitted too",
    "companion_ratio": "flux of the brightest neighbour over that of the star",
    **{
        f"error_{name}": f"root of the summed variances of the Zernikes by {cause}"
        for name, cause in (
            ("photons", "photons and terms fitted beside"),
            ("residuals", "what the model lacks"),
            ("air", "turbulence"),
            ("floor", "accuracy of the model and scatter of the donuts"),
            ("repeats", "what differs between donuts of the exposure, no part of the sum"),
        )
    },
}


@dataclass(frozen=True, eq=False, kw_only=True)
class DonutFit(Result):
    """Wavefronts of n donuts, one array element each; NaN where a flag says that there is no result.

    Attributes
    ----------
    zernikes : ndarray, shape [n, n_noll]
        Wavefront beyond that of the telescope [m], annular Zernikes of the entrance pupil: the coefficients of
        :func:`~pachon.wavefront_opd` of the true telescope minus those of the telescope given; positive where the
        wavefront leads.
    covariance : ndarray, shape [n, n_noll, n_noll]
        Covariance of `zernikes` [m^2], of photons, what the residuals say that the model lacks, air and the accuracy of
        the model.
    error_parts : ErrorParts
        The same by cause: ``photons``, the Cramer-Rao bound, ``residuals``, ``air``, ``floor``; and ``repeats``, the
        covariance of a donut about the others of its exposure.
    noll : ndarray of int, shape [n_noll]
        Noll indices.
    flux, flux_error : ndarray, shape [n]
        Light of the star [electrons, or the unit of images whose noise was not given].
    center, center_error : ndarray, shape [n, 2]
        Place (x, y) of the chief ray from the centre of the stamp [pixels].
    background : ndarray, shape [n]
        Background at the centre of the stamp [the same a pixel].
    background_slope : ndarray, shape [n, 2]
        Slopes of the background along x and y [the same a pixel, per pixel].
    response_slope, response_slope_error : ndarray, shape [n, 2]
        Slopes of the detector's response along x and y, relative, a pixel; NaN where they are not fitted.
    fwhm, fwhm_error : ndarray, shape [n]
        Full width at half maximum of the long exposure [rad]; of zero error where it was given.
    chi2 : ndarray, shape [n]
        Sum of squares of the residuals over their variance.
    n_pixels : ndarray of int, shape [n]
        Number of the pixels in that sum.
    sky_variance, photon_variance : ndarray, shape [n]
        Variance of a pixel without a star [squared electrons], and of light over its amount [electrons], which is 1 but
        where noise is measured and images are in other units.
    flags : ndarray of int, shape [n]
        :class:`DonutFlag` bits.
    companions : ndarray, shape [n, 5, 3]
        Neighbours of a blend, the brightest first: flux over that of the star, and place (x, y) from it [pixels]; NaN
        beyond those found.
    images, model : ndarray, shape [n, ny, nx]
        Stamps and their best models [electrons]; NaN beside smaller stamps. Models of flagged donuts are NaN, and those
        of others far from a donut on a stamp that is much larger.
    used : ndarray of bool, shape [n, ny, nx]
        Pixels that took part.
    fields : ndarray, shape [n, 2]
        Field angles [rad].
    wavelengths : ndarray, shape [n_wave]
        Vacuum wavelengths [m].
    pixel_size : float
        Side of a pixel [m].
    telescope : str
        Name of the telescope.
    obscuration : float
        Inner over outer radius of the annulus of the Zernikes.
    double_zernikes, double_zernike_covariance : ndarray, shapes [n_field_noll, n_noll], [same, same] or None
        Coefficients over the field and the pupil [m], and their covariance in that order, flattened.
    degrees_of_freedom : FreedomEstimate or None
        Degrees of freedom of the telescope.
    projection : str
        Meaning of the field angles.
    rims : QTable
        Rims and spiders that stand elsewhere than the prescription has them, one a row: number of the donut, surfaces,
        shift towards more light on the surface and on the image, and motions, with errors. Of joint fits, those of each
        donut by itself.
    amplifier_steps : QTable
        Steps of sky and gain along columns and rows that were fitted too, one a row, with errors.
    diffraction : bool
        Whether the model has light diffracted at the rims of the pupil.
    exposure : ExposureWavefront or None
        Wavefronts of the light of the donuts, air and both sides of focus, of :class:`~pachon.sensing.ExposureDonuts`.
    """

    zernikes: np.ndarray
    covariance: np.ndarray
    error_parts: ErrorParts
    noll: np.ndarray
    flux: np.ndarray
    flux_error: np.ndarray
    center: np.ndarray
    center_error: np.ndarray
    background: np.ndarray
    background_slope: np.ndarray
    response_slope: np.ndarray
    response_slope_error: np.ndarray
    fwhm: np.ndarray
    fwhm_error: np.ndarray
    chi2: np.ndarray
    n_pixels: np.ndarray
    sky_variance: np.ndarray
    photon_variance: np.ndarray
    flags: np.ndarray
    companions: np.ndarray
    images: np.ndarray
    model: np.ndarray
    used: np.ndarray
    fields: np.ndarray
    wavelengths: np.ndarray
    pixel_size: float
    telescope: str
    obscuration: float
    double_zernikes: np.ndarray | None = None
    double_zernike_covariance: np.ndarray | None = None
    degrees_of_freedom: FreedomEstimate | None = None
    projection: Projection = "zemax"
    rims: QTable = field(default_factory=lambda: rim_table({}))
    amplifier_steps: QTable = field(default_factory=lambda: step_table({}))
    diffraction: bool = False
    exposure: ExposureWavefront | None = None

    def __len__(self) -> int:
        """Return the number of donuts."""
        return len(self.flags)

    @property
    def usable(self) -> np.ndarray:
        """Donuts with results, shape [n] bool."""
        return np.array([DonutFlag(int(flag)).usable for flag in self.flags], dtype=bool)

    @property
    def reasons(self) -> list[str]:
        """Names of the flags of each donut, empty for a clean one."""
        return [DonutFlag(int(flag)).reasons for flag in self.flags]

    @property
    def residuals(self) -> np.ndarray:
        """Images minus models [electrons], shape [n, ny, nx]."""
        return self.images - self.model

    @property
    def errors(self) -> np.ndarray:
        """Standard deviations of the Zernikes [m], shape [n, n_noll], of all causes."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def repeat_errors(self) -> np.ndarray:
        """Standard deviations of the Zernikes about those of other donuts of the exposure [m], shape [n, n_noll]."""
        return np.sqrt(np.diagonal(self.error_parts.repeats, axis1=1, axis2=2))

    @property
    def rms(self) -> np.ndarray:
        """Root of the summed squares of the Zernikes [m], shape [n]."""
        return np.sqrt((self.zernikes**2).sum(axis=1))

    def zernikes_in(
        self,
        convention: ZernikeConvention = "pachon",
        frame: FrameName = "OCS",
        *,
        frames: DonutFrames | None = None,
        design: Telescope | None = None,
        wave: ArrayLike | None = None,
    ) -> ObservatoryZernikes:
        """Return the wavefronts in the convention and the frame of an observatory.

        Parameters
        ----------
        convention : {"pachon", "ts_wep", "donut"}
            Annular Zernikes [m]; the same [um], as LSST's `zk_deviation`; or circular ones in waves, as DECam's Donut.
        frame : {"OCS", "CCS", "DVCS", "ZCS", "sky"}
            Frame of the pupil's axes and of field angles.
        frames : DonutFrames, optional
            Angles of rotator and sky; zero by default.
        design : Telescope, optional
            Telescope in focus whose own wavefront is added: LSST's `zk` in place of `zk_deviation`.
        wave : float or Quantity, optional
            Length of a wave of ``donut`` [m]; 700 nm by default.

        Returns
        -------
        ObservatoryZernikes

        Raises
        ------
        ConfigError
            If a convention or a frame is unknown, or the frame lacks the parallactic angle.
        DomainError
            If a turned term lacks its partner of the same order among the fitted ones.
        """
        return observatory_zernikes(self, convention, frame, frames or DonutFrames(), design, wave)

    @property
    def in_electrons(self) -> bool:
        """Whether light is in electrons, as where the noise of the sky was given; else in the unit of the images."""
        return bool((self.photon_variance[np.isfinite(self.photon_variance)] == 1.0).all())

    def _error_sizes(self) -> dict[str, np.ndarray]:
        """Return the root of the summed variances of the Zernikes by cause [m], shape [n]."""
        names = ("photons", "residuals", "air", "floor", "repeats")
        traces = {name: np.trace(getattr(self.error_parts, name), axis1=1, axis2=2) for name in names}
        return {name: np.sqrt(np.maximum(trace, 0.0)) for name, trace in traces.items()}

    def _label(self) -> str:
        terms = f"Zernikes {self.noll[0]} to {self.noll[-1]}"
        return f"{counted(len(self), 'donut')}, {int(self.usable.sum())} with results, {terms}"

    def to_table(self) -> QTable:
        """Return one row a donut, with units: field, flags, Zernikes and their errors, and the star's own unknowns."""
        table = QTable()
        table["field_x"], table["field_y"] = np.rad2deg(self.fields).T * u.deg
        table["flags"], table["reasons"] = self.flags, [reasons or "ok" for reasons in self.reasons]
        light, unit = (
            (u.electron, "") if self.in_electrons else (u.dimensionless_unscaled, ", in the unit of the images")
        )
        table["flux"], table["flux_err"] = self.flux * light, self.flux_error * light
        for axis, name in enumerate("xy"):
            table[name], table[f"{name}_err"] = self.center[:, axis] * u.pix, self.center_error[:, axis] * u.pix
        table["background"] = self.background * light / u.pix
        for axis, name in enumerate("xy"):
            table[f"background_slope_{name}"] = self.background_slope[:, axis] * light / u.pix**2
        table["fwhm"], table["fwhm_err"] = arcseconds(self.fwhm) * u.arcsec, arcseconds(self.fwhm_error) * u.arcsec
        table["chi2"], table["n_pixels"] = self.chi2, self.n_pixels
        table["n_companions"] = np.isfinite(self.companions[:, :, 0]).sum(axis=1)
        table["companion_ratio"] = self.companions[:, 0, 0]
        for name, size in self._error_sizes().items():
            table[f"error_{name}"] = size * 1e9 * u.nm
        for k, j in enumerate(self.noll):
            table[f"Z{j}"], table[f"Z{j}_err"] = self.zernikes[:, k] * 1e9 * u.nm, self.errors[:, k] * 1e9 * u.nm
        for name in table.colnames:
            table[name].info.description = _MEANINGS.get(name.removesuffix("_err"), _WAVEFRONT)
            if name.endswith("_err"):
                table[name].info.description = f"standard error of {name.removesuffix('_err')}"
            elif name.startswith(("flux", "background")):
                table[name].info.description += unit
        table.meta.update(
            telescope=self.telescope,
            wavelength_nm=(self.wavelengths * 1e9).tolist(),
            obscuration=self.obscuration,
            diffraction=self.diffraction,
            zernikes="annular, Noll, on the entrance pupil; positive where the wavefront leads",
        )
        return table

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit, of plain numbers and lists; None in place of NaN."""
        light = "electrons" if self.in_electrons else "image_units"
        out: dict[str, Any] = {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelengths * 1e9,
            "obscuration": self.obscuration,
            "diffraction": self.diffraction,
            "noll": self.noll,
            "field_deg": np.rad2deg(self.fields),
            "flags": self.flags,
            "reasons": self.reasons,
            "zernike_nm": self.zernikes * 1e9,
            "zernike_error_nm": self.errors * 1e9,
            "error_parts_nm": {name: 1e9 * size for name, size in self._error_sizes().items()},
            f"flux_{light}": self.flux,
            "center_pixels": self.center,
            f"background_{light}": self.background,
            "fwhm_arcsec": arcseconds(self.fwhm),
            "chi2": self.chi2,
            "n_pixels": self.n_pixels,
            f"background_slope_{light}": self.background_slope,
            "response_slope": self.response_slope,
            "companions": self.companions,
            "moved_rims": [
                {"donut": int(row["donut"]), "rim": str(row["rim"])}
                | {f"{name}_mm": float(row[name].to_value("mm")) for name in ("outward", "outward_err")}
                | {name: float(row[name].value) for name in ("pixels", "pixels_err")}
                for row in self.rims
            ],
            "amplifier_steps": step_words(self.amplifier_steps),
        }
        if self.double_zernikes is not None:
            out["double_zernike_nm"] = self.double_zernikes * 1e9
        if self.degrees_of_freedom is not None:
            out["degrees_of_freedom"] = self.degrees_of_freedom.summary()
        if self.exposure is not None:
            out["exposure"] = self.exposure.summary()
        return out

    def plot(self, donuts: slice | list[int] | None = None, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw stamps, models and residuals of some donuts, the first six by default, and their Zernikes."""
        return _draw(self, donuts, ax)


def _levels(image: np.ndarray, background: float) -> tuple[float, float]:
    """Return background and brightest light of a stamp; of one without a result both from its pixels."""
    finite = image[np.isfinite(image)]
    if not finite.size:
        return 0.0, 1.0
    base = float(background if np.isfinite(background) else np.percentile(finite, 10.0))
    top = float(np.percentile(finite, 99.5))
    # Of a stamp without contrast one, or as much as a large number has beside itself.
    return base, top if top > base else base + max(1.0, 1e-6 * abs(base))


def _draw(fit: DonutFit, donuts: slice | list[int] | None, ax: Axes | Figure | None) -> Figure:
    """Draw a fit; see :meth:`DonutFit.plot`."""
    shown_donuts = np.arange(len(fit))[slice(_SHOWN) if donuts is None else donuts]
    n = len(shown_donuts)
    with styled():
        figure = figure_at(ax, max(7.0, 1.9 * n + 0.8), 9.2)
        parts: Any = figure.subfigures(2, 1, height_ratios=(1.75, 1.0))
        upper, lower = parts
        panels = upper.subplots(3, n, squeeze=False, sharex=True, sharey=True)
        for column, i in enumerate(shown_donuts):
            image, model = fit.images[i], fit.model[i]
            # Each star has a scale of its own, from its background on.
            base, top = _levels(image, fit.background[i])
            photon = fit.photon_variance[i]
            variance = np.maximum(fit.sky_variance[i] + photon * np.maximum(model - base, 0.0), photon)
            pull = np.where(fit.used[i], fit.residuals[i] / np.sqrt(variance), np.nan)
            shown = panels[0, column].imshow((image - base) / (top - base), cmap="viridis", vmin=0.0, vmax=1.0)
            panels[1, column].imshow((model - base) / (top - base), cmap="viridis", vmin=0.0, vmax=1.0)
            spread = panels[2, column].imshow(pull, cmap="RdBu_r", vmin=-_RANGE, vmax=_RANGE)
            x, y = np.rad2deg(fit.fields[i])
            flag = DonutFlag(int(fit.flags[i])).reasons
            panels[0, column].set_title(f"({x:.3g}, {y:.3g})°" + (f"\n{flag}" if flag else ""), fontsize=8)
            if fit.usable[i]:
                seeing = float(arcseconds(fit.fwhm[i]))
                quality = fit.chi2[i] / fit.n_pixels[i]
                panels[2, column].set_xlabel(f'x [pixel]\nFWHM {seeing:.2f}"\nchi2/pixel {quality:.2f}', fontsize=8)
        fitted = np.isfinite(fit.model[shown_donuts]).any(axis=0)
        if fitted.any():
            # Stamps may be many times as large as donuts.
            (bottom, top), (left, right) = (np.flatnonzero(fitted.any(axis=a))[[0, -1]] for a in (1, 0))
            panels[0, 0].set(xlim=(left - _RIM, right + _RIM), ylim=(bottom - _RIM, top + _RIM))
        for row, name in enumerate(("image", "model", "residual / noise")):
            panels[row, 0].set_ylabel(f"{name}\ny [pixel]")
        upper.colorbar(shown, ax=panels[:2], fraction=0.02, pad=0.01, label="light over each star's brightest")
        upper.colorbar(spread, ax=panels[2], fraction=0.02, pad=0.01)
        bars = lower.subplots()
        width = 0.85 / n
        for column, (i, color) in enumerate(zip(shown_donuts, field_colors(n), strict=True)):
            x, y = np.rad2deg(fit.fields[i])
            bars.bar(
                fit.noll + (column - 0.5 * (n - 1)) * width,
                fit.zernikes[i] * 1e9,
                width,
                yerr=fit.errors[i] * 1e9,
                color=color,
                error_kw={"linewidth": 0.7},
                label=f"({x:.3g}, {y:.3g})°",
            )
        name_terms(bars, fit.noll)
        bars.set_ylabel("rms over the annulus [nm], OCS")
        bars.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=6, fontsize=7, frameon=False)
        waves = ", ".join(f"{w * 1e9:.4g}" for w in fit.wavelengths)
        count = f"{n} of {len(fit)} donuts" if n < len(fit) else "donuts"
        figure.suptitle(
            f"{plain_text(fit.telescope)}: {count} at {waves} nm, wavefront beyond the telescope's own", fontsize=11
        )
        return figure
