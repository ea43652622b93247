"""Strehl ratios: from the rms wavefront, from the wavefront itself, and from the peak of the diffraction image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE
from ...core.threads import one_blas_thread
from ...models.camera.focal_plane import FocalPlane
from ...models.telescope import Telescope
from ...raytrace.rays import Projection
from ...wavefront.chief_rays import reference_rays
from ...wavefront.pupil_sampling import PupilSampling, SamplingName
from ...wavefront.request import Request
from ..drawing import finish_axes, wavelength_colors
from ..images.diffraction import fft_psf
from ..metrics.wavefront_strehl import brightest_strehl
from .analysis import Analysis, Columns

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class StrehlRatios(Analysis):
    """Strehl ratios of field points and wavelengths.

    Attributes
    ----------
    rms_wavefront : ndarray, shape [n_field, n_wave]
        Root mean square of the wavefront over the lit pupil without piston and tilt [m].
    wavefront : ndarray, shape [n_field, n_wave]
        Squared modulus of the mean of exp(2 pi i W / wavelength) over the lit pupil, with the tilt that makes it
        largest: the brightest point of the image. Light is even over the entrance pupil. NaN where the wavefront is too
        steep for so many points.
    psf : ndarray, shape [n_field, n_wave]
        Peak of the diffraction image over that of the same lit pupil with a perfect wavefront; NaN where not asked
        for, or where aberrations are too large for an image.
    """

    rms_wavefront: np.ndarray
    wavefront: np.ndarray
    psf: np.ndarray

    @property
    def marechal(self) -> np.ndarray:
        """Marechal's approximation in Mahajan's form, exp(-(2 pi rms / wavelength)^2), shape [n_field, n_wave].

        Mahajan 1983, J. Opt. Soc. Am. 73, 860; good to some per cent above 0.3.
        """
        return np.exp(-((2.0 * np.pi * self.rms_wavefront / self.wavelengths) ** 2))

    @property
    def _title(self) -> str:
        return "Strehl ratio"

    def _table_columns(self) -> Columns:
        return {
            **self._field_columns(1),
            "wavelength": (self.wavelengths * 1e9, "nm", "vacuum wavelength"),
            "rms_wavefront": (self.rms_wavefront * 1e9, "nm", "rms wavefront without piston and tilt"),
            "strehl_of_rms": (self.marechal, "", "Strehl ratio of a small wavefront error of this rms"),
            "strehl_of_wavefront": (self.wavefront, "", "Strehl ratio of the wavefront"),
            "strehl_of_psf": (self.psf, "", "peak of the PSF over that of a perfect wavefront"),
        }

    def _values(self) -> dict[str, Any]:
        return {
            "rms_wavefront_nm": self.rms_wavefront * 1e9,
            "rms_wavefront_waves": self.rms_wavefront / self.wavelengths,
            "strehl_of_rms": self.marechal,
            "strehl_of_wavefront": self.wavefront,
            "strehl_of_psf": self.psf,
        }

    def _draw(self, panels: Sequence[Axes]) -> None:
        (axes,) = panels
        distance, label = self.axis_distances()
        order = np.argsort(distance, kind="stable")
        colors = wavelength_colors(self.wavelengths) if len(self.wavelengths) > 1 else [BLUE]
        for w, color in enumerate(colors):
            name = f"{self.wavelengths[w] * 1e9:.4g} nm"
            axes.plot(distance[order], self.wavefront[order, w], "-", color=color, label=f"{name}, wavefront")
            axes.plot(distance[order], self.marechal[order, w], ":", color=color, label=f"{name}, exp(-(2πσ)²)")
            if np.isfinite(self.psf[:, w]).any():
                axes.plot(distance[order], self.psf[order, w], "o", color=color, markersize=4, label=f"{name}, PSF")
        axes.axhline(0.8, color="0.5", linewidth=0.7)
        finish_axes(axes, xlim=(0, None), ylim=(0, 1.02), xlabel=label, ylabel="Strehl ratio")
        axes.legend(fontsize=7)


@check_arguments
@one_blas_thread()
def strehl(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    from_psf: bool = True,
    sampling: SamplingName | PupilSampling | None = None,
    n_pupil: int | None = None,
    focal_plane: FocalPlane | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
) -> StrehlRatios:
    """Compute Strehl ratios from wavefronts and diffraction images.

    Parameters
    ----------
    telescope, fields, wavelengths, sampling, n_pupil, projection, threads
        As in :meth:`pachon.Request.of`; the points of the pupil are those of the wavefronts.
    from_psf : bool
        Make diffraction images too (:func:`pachon.fft_psf`).
    focal_plane : FocalPlane, optional
        CCD surfaces, as in :meth:`pachon.Request.on`; the nominal detector surface without it.

    Raises
    ------
    DomainError
        If no light of a field passes, or a chief ray does not reach the image.
    """
    request = Request.of(
        telescope, fields, wavelengths, sampling=sampling, n_pupil=n_pupil, projection=projection, threads=threads
    ).on(focal_plane)
    shape = (len(request.fields), len(request.wavelengths))
    rms, ratio, peak = (np.full(shape, np.nan) for _ in range(3))
    for w, wavelength in enumerate(map(float, request.wavelengths)):
        # Wavefronts are those about the chief rays, vignetted or not.
        reference_rays(request, wavelength)
        bundles = request.bundles(wavelength)
        opd = bundles.opd(request.telescope.sphere_radius)
        for i, lit in enumerate(bundles.lit):
            rms[i, w], ratio[i, w] = _rms_and_strehl(opd[i], lit, request, wavelength)
        if from_psf:
            peak[:, w] = _image_peaks(replace(request, wavelengths=np.array([wavelength]), weights=np.ones(1)))
    return StrehlRatios(request, rms, ratio, peak)


def _image_peaks(request: Request) -> np.ndarray:
    """Return the Strehl ratios of diffraction images, shape [n_field]; NaN where aberrations are too large for one."""
    try:
        return fft_psf(request, pixels=64).strehl
    except DomainError as error:
        if error.key != "n_pupil":
            raise
    count = len(request.fields)
    if count == 1:
        return np.full(1, np.nan)
    return np.concatenate([_image_peaks(request.at_fields(slice(i, i + 1))) for i in range(count)])


def _rms_and_strehl(opd: np.ndarray, lit: np.ndarray, request: Request, wavelength: float) -> tuple[float, float]:
    """Return rms [m] about the best plane and Strehl ratio of a wavefront over its lit points."""
    if lit.sum() < 3:
        return np.nan, np.nan
    weight = request.pupil.weights[lit] / request.pupil.weights[lit].sum()
    root = np.sqrt(weight)
    plane = np.stack([np.ones(len(weight)), *request.unit_pupil[lit].T], axis=-1) * root[:, None]
    value = opd[lit] * root
    residual = (value - plane @ np.linalg.lstsq(plane, value, rcond=None)[0]) / root
    peak = brightest_strehl(weight, request.unit_pupil[lit], residual / wavelength)
    return float(np.sqrt((weight * residual**2).sum())), peak
