"""Result of a fit of donuts: wavefronts, seeing, residual images, tables and pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units as u
from astropy.table import QTable

from ..core.plotting import figure_at, plain_text, styled
from ..core.result import Result
from ..core.units import arcseconds
from ..design.drawing import field_colors
from ..design.metrics.field_zernikes import name_terms
from .degrees import FreedomEstimate
from .exposure import ExposureWavefront
from .flags import DonutFlag

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Donuts of one picture unless others are asked for.
_SHOWN = 6
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
    "background": "uniform level left on the stamp",
    "fwhm": "full width at half maximum of the long exposure",
    "chi2": "sum of squares of the residuals over their variance",
    "n_pixels": "number of the pixels in that sum",
    "companion_ratio": "flux of the second star of a blend over that of the first",
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
        Covariance of `zernikes` [m^2]: the inverse of Fisher's information, the Cramer-Rao bound; with
        ``turbulence``, and the covariance of the air's own wavefront.
    noll : ndarray of int, shape [n_noll]
        Noll indices.
    flux, flux_error : ndarray, shape [n]
        Light of the star [electrons].
    center, center_error : ndarray, shape [n, 2]
        Place (x, y) of the chief ray from the centre of the stamp [pixels].
    background : ndarray, shape [n]
        Uniform level left on the stamp [electrons a pixel].
    fwhm, fwhm_error : ndarray, shape [n]
        Full width at half maximum of the long exposure [rad]; of zero error where it was given.
    chi2 : ndarray, shape [n]
        Sum of squares of the residuals over their variance.
    n_pixels : ndarray of int, shape [n]
        Number of the pixels in that sum.
    flags : ndarray of int, shape [n]
        :class:`DonutFlag` bits.
    companion : ndarray, shape [n, 3]
        Second star of a blend: flux over that of the first, and place (x, y) from it [pixels]; else NaN.
    images, model : ndarray, shape [n, ny, nx]
        Stamps and their best models [electrons]; NaN beside smaller stamps, and models of flagged donuts are NaN.
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
    exposure : ExposureWavefront or None
        Wavefronts of the light of the donuts, air and both sides of focus, of :class:`~pachon.ExposureDonuts`.
    """

    zernikes: np.ndarray
    covariance: np.ndarray
    noll: np.ndarray
    flux: np.ndarray
    flux_error: np.ndarray
    center: np.ndarray
    center_error: np.ndarray
    background: np.ndarray
    fwhm: np.ndarray
    fwhm_error: np.ndarray
    chi2: np.ndarray
    n_pixels: np.ndarray
    flags: np.ndarray
    companion: np.ndarray
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
        """Standard deviations of the Zernikes [m], shape [n, n_noll]: the Cramer-Rao bound of each."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def rms(self) -> np.ndarray:
        """Root of the summed squares of the Zernikes [m], shape [n]."""
        return np.sqrt((self.zernikes**2).sum(axis=1))

    def _label(self) -> str:
        return f"{len(self)} donuts, {int(self.usable.sum())} with results, Zernikes {self.noll[0]} to {self.noll[-1]}"

    def to_table(self) -> QTable:
        """Return one row a donut, with units: field, flags, Zernikes and their errors, and the star's own unknowns."""
        table = QTable()
        table["field_x"], table["field_y"] = np.rad2deg(self.fields).T * u.deg
        table["flags"], table["reasons"] = self.flags, [reasons or "ok" for reasons in self.reasons]
        table["flux"], table["flux_err"] = self.flux * u.electron, self.flux_error * u.electron
        for axis, name in enumerate("xy"):
            table[name], table[f"{name}_err"] = self.center[:, axis] * u.pix, self.center_error[:, axis] * u.pix
        table["background"] = self.background * u.electron / u.pix
        table["fwhm"], table["fwhm_err"] = arcseconds(self.fwhm) * u.arcsec, arcseconds(self.fwhm_error) * u.arcsec
        table["chi2"], table["n_pixels"] = self.chi2, self.n_pixels
        table["companion_ratio"] = self.companion[:, 0]
        for k, j in enumerate(self.noll):
            table[f"Z{j}"], table[f"Z{j}_err"] = self.zernikes[:, k] * 1e9 * u.nm, self.errors[:, k] * 1e9 * u.nm
        for name in table.colnames:
            table[name].info.description = _MEANINGS.get(name.removesuffix("_err"), _WAVEFRONT)
            if name.endswith("_err"):
                table[name].info.description = f"standard error of {name.removesuffix('_err')}"
        table.meta.update(
            telescope=self.telescope,
            wavelength_nm=(self.wavelengths * 1e9).tolist(),
            obscuration=self.obscuration,
            zernikes="annular, Noll, on the entrance pupil; positive where the wavefront leads",
        )
        return table

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit, of plain numbers and lists; None in place of NaN."""
        out: dict[str, Any] = {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelengths * 1e9,
            "obscuration": self.obscuration,
            "noll": self.noll,
            "field_deg": np.rad2deg(self.fields),
            "flags": self.flags,
            "reasons": self.reasons,
            "zernike_nm": self.zernikes * 1e9,
            "zernike_error_nm": self.errors * 1e9,
            "flux_electrons": self.flux,
            "center_pixels": self.center,
            "background_electrons": self.background,
            "fwhm_arcsec": arcseconds(self.fwhm),
            "chi2": self.chi2,
            "n_pixels": self.n_pixels,
            "companion_ratio": self.companion[:, 0],
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
            top = float(np.nanpercentile(image, 99.5)) if np.isfinite(image).any() else 0.0
            top = top if top > 0.0 else 1.0
            noise = np.sqrt(
                np.maximum(np.abs(model), 1.0) + np.nanvar(fit.residuals[i][model < 0.05 * top])
                if fit.usable[i]
                else 1.0
            )
            pull = np.where(fit.used[i], fit.residuals[i] / noise, np.nan)
            shown = panels[0, column].imshow(image, cmap="viridis", vmin=0.0, vmax=top)
            panels[1, column].imshow(model, cmap="viridis", vmin=0.0, vmax=top)
            spread = panels[2, column].imshow(pull, cmap="RdBu_r", vmin=-_RANGE, vmax=_RANGE)
            x, y = np.rad2deg(fit.fields[i])
            flag = DonutFlag(int(fit.flags[i])).reasons
            panels[0, column].set_title(f"({x:.3g}, {y:.3g})°" + (f"\n{flag}" if flag else ""), fontsize=8)
            if fit.usable[i]:
                seeing = float(arcseconds(fit.fwhm[i]))
                quality = fit.chi2[i] / fit.n_pixels[i]
                panels[2, column].set_xlabel(f'FWHM {seeing:.2f}"\nchi2/pixel {quality:.2f}', fontsize=8)
        for row, name in enumerate(("image", "model", "residual / noise")):
            panels[row, 0].set_ylabel(name)
        upper.colorbar(shown, ax=panels[:2], fraction=0.02, pad=0.01, label="electrons")
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
        bars.set_ylabel("coefficient = rms over the annulus [nm]")
        bars.legend(loc="best", ncols=3, fontsize=7)
        waves = ", ".join(f"{w * 1e9:.4g}" for w in fit.wavelengths)
        figure.suptitle(
            f"{plain_text(fit.telescope)}: donuts at {waves} nm, wavefront beyond the telescope's own", fontsize=11
        )
        return figure
