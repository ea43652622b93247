"""Shear of galaxies on stamps from six linear functionals of the deconvolved image."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.launch import launch, load_kernels
from ...core.number_text import counted
from ...core.random_streams import stream
from ...core.threads import one_blas_thread, thread_count
from ...core.units import has_unit, positive_angle, real_array, require_count, require_seed
from ...core.warp_arrays import warp_array
from .functionals import FUNCTIONALS, noise_covariance, psf_frequencies, renoising, weight_transforms
from .noise import CorrelatedNoise, noise_power
from .shear_kernels import deconvolved_functionals, weight_values
from .shear_shapes import ShearShapes
from .weight import weight_width

#: C of e = M1/(M0 + C), in standard errors of M0: keeps noise of faint galaxies from dividing by zero.
CONSTANT = 4.0
#: Least side of a stamp over the rms width of the weight: on smaller ones the weight divided by the PSF is cut.
LEAST_SIDE = 12.0
#: Largest side of a stamp [pixel].
MOST_SIDE = 4096
#: Largest deviation of the sum of a PSF from 1.
_PSF_SUM_TOLERANCE = 1e-3
# M0, M1 and M2, of which ellipticities are made, and M1 to M5, which are their derivatives.
_MEASURED = np.arange(3)
_DERIVATIVES = np.arange(1, FUNCTIONALS)
# Signs of the former under a rotation by 90 degrees.
_QUARTER_TURN = np.diag([1.0, -1.0, -1.0])
#: Stamps of a block; fixed, so that no byte depends on the number of threads.
_BLOCK = 256


@check_arguments
class ShearEstimator:
    r"""Estimator of shear without models of galaxies, unbiased under noise.

    With the functionals M0 to M5 of the image before the PSF (their weights are a round Gaussian G, (x^2 - y^2) G,
    2 x y G, and the derivatives of these along a shear), the ellipticity and its response to shear are

    .. math:: e_i = \frac{M_i}{M_0 + C},\qquad
              R_{ij} = \frac{\partial M_i/\partial g_j}{M_0 + C} + \frac{M_i M_j}{(M_0 + C)^2}

    without approximation, as dM0/dg_j = -M_j. The mean of e over galaxies is the mean of R times the shear, to second
    order. Noise is not sheared with the image, so its functionals n must be kept out of the derivative: noise N of the
    same covariance, rotated by 90 degrees, is added in the space of functionals, and with

    .. math:: T = M + n + N,\qquad D = M + n - X

    e is that of T and the derivatives are those of D, with X, a linear function of N, for which T and D are
    independent (Li & Mandelbaum 2023; Li et al. 2024). The rotation removes what the noise of an elliptical PSF adds
    to e.

    Stamps whose PSF is not sampled are biased under any weight: by about 0.1 % where its FWHM is two pixels, -1 to -3 %
    at 1.5, -2 to -30 % at one (small galaxies most).

    Parameters
    ----------
    psf_images : array
        PSFs [n, m, m], or one [m, m]: unit sum, m odd, centred on a pixel, pixel included.
    pixel_scale : float or Quantity
        Side of a pixel [rad].
    noise : float, array or CorrelatedNoise
        White noise: rms of a pixel, of all or under each of the PSFs, in the unit of the stamps. Or noise with
        correlations of pixels, as of resampled images.
    sigma : float or Quantity, optional
        rms width of the weight before the PSF [rad]; by default 0.52 arcsec, or 1.2 half-light radii of the widest PSF
        where that is more. Ellipticities under different weights have different responses.
    side : int
        Pixels of a side of stamps.

    Raises
    ------
    DomainError
        If a PSF has an even side, no unit sum or is too wide for the weight, the noise is not positive, or stamps are
        too small for the weight.
    """

    def __init__(
        self,
        psf_images: ArrayLike,
        pixel_scale: ArrayLike,
        noise: ArrayLike | CorrelatedNoise,
        *,
        sigma: ArrayLike | None = None,
        side: int = 64,
    ) -> None:
        psfs = checked_psfs(psf_images)
        scale = positive_angle(pixel_scale, "pixel_scale")
        width = weight_width(sigma, psfs, scale)
        require_side(require_count(side, "side", 1, MOST_SIDE), width)
        self._side = int(side)
        self._frequencies, inverse = psf_frequencies(psfs, self._side, width)
        self._inverse = inverse.astype(np.complex64)
        weights = weight_transforms(self._frequencies, width)
        power = noise_power(noise, len(psfs), self._frequencies)
        self._covariance = noise_covariance(weights, inverse, power, self._frequencies)
        factors = self._frequencies.multiplicity / self._side**2
        self._weights = np.moveaxis(weights * factors, 0, -1).astype(np.float32)
        with one_blas_thread():
            self._noise = renoising(self._covariance, _MEASURED, _DERIVATIVES, _QUARTER_TURN)

    def __repr__(self) -> str:
        n = len(self._inverse)
        return f"<ShearEstimator: {counted(n, 'PSF')}, stamps of {self._side} pixels>"

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the functionals under the noise, of each PSF, [n, 6, 6]."""
        return self._covariance.copy()

    def moments(
        self,
        stamps: ArrayLike,
        offsets: ArrayLike,
        *,
        psf_index: ArrayLike | None = None,
        threads: int | None = None,
    ) -> np.ndarray:
        """Return the functionals M0 to M5 of stamps, [n, 6], in their unit.

        Parameters
        ----------
        stamps : array
            [n, side, side] pixels, background subtracted.
        offsets : array
            Centres x, y of the galaxies from those of their stamps, ``((side - 1)/2, (side - 1)/2)`` [pixel], [n, 2].
        psf_index : array of int, optional
            PSF of each galaxy, [n]; needed where there are several PSFs.
        threads : int, optional
            All processors by default. No byte depends on it.

        Raises
        ------
        DomainError
            If shapes differ or a number is not finite.
        """
        if has_unit(stamps):
            raise DomainError("stamps: expected numbers without a unit")
        images = np.asarray(stamps)
        if images.ndim != 3 or images.shape[1:] != (self._side, self._side):
            raise DomainError(f"stamps have shape {images.shape}: expected [n, {self._side}, {self._side}]")
        count = len(images)
        centres = real_array(offsets, "offsets: expected real numbers [n, 2]")
        if centres.shape != (count, 2) or not np.all(np.isfinite(centres)):
            raise DomainError(f"offsets have shape {centres.shape}: expected finite numbers [{count}, 2]")
        rows = self._psf_rows(psf_index, count)
        moments = np.empty((count, FUNCTIONALS))
        load_kernels(deconvolved_functionals)
        inverse, weights = warp_array(self._inverse, wp.vec2), warp_array(self._weights, weight_values)
        phases = [
            np.exp(1j * (0.5 * (self._side - 1) + centre)[:, None] * k.ravel()).astype(np.complex64)
            for centre, k in zip(centres.T, (self._frequencies.kx, self._frequencies.ky), strict=True)
        ]

        def fill(block: slice) -> None:
            spectra = self._frequencies.of(np.asarray(images[block], dtype=np.float32))
            launch(
                deconvolved_functionals,
                len(spectra),
                [
                    warp_array(spectra, wp.vec2),
                    warp_array(phases[0][block], wp.vec2),
                    warp_array(phases[1][block], wp.vec2),
                    inverse,
                    warp_array(rows[block], wp.int32),
                    weights,
                    warp_array(moments[block]),
                ],
                threads=1,
            )

        with ThreadPoolExecutor(thread_count(threads)) as pool:
            list(pool.map(fill, _blocks(count)))
        if not np.isfinite(moments).all():
            raise DomainError("stamps: expected finite pixels")
        return moments

    def ellipticity_and_response(
        self,
        moments: ArrayLike,
        *,
        psf_index: ArrayLike | None = None,
        seed: int | None = None,
        key: str | tuple[str | int, ...] = "shear",
        min_snr: float | None = None,
        snr_width: float = 4.0,
    ) -> ShearShapes:
        """Return ellipticities and their responses to shear, noise and selection included.

        Parameters
        ----------
        moments : array
            Functionals of :meth:`moments`, [n, 6].
        psf_index : array of int, optional
            PSF of each galaxy, [n]; needed where there are several PSFs.
        seed : int, optional
            Seed of the noise that is added to the functionals, once with each sign. By default none is, which is right
            for images without noise alone.
        key : str or tuple
            Name of its random stream. Galaxies under a shear and its opposite take the same one.
        min_snr : float, optional
            S/N of M0 from which galaxies have a weight above zero. By default all have the weight one.
        snr_width : float
            Range of S/N in which the weight rises to one.

        Raises
        ------
        DomainError
            If shapes differ, or the limits are not positive.
        """
        values = real_array(moments, "moments: expected real numbers [n, 6]")
        if values.ndim != 2 or values.shape[1] != FUNCTIONALS or not np.all(np.isfinite(values)):
            raise DomainError(f"moments have shape {values.shape}: expected finite numbers [n, {FUNCTIONALS}]")
        rows = self._psf_rows(psf_index, len(values))
        if min_snr is not None and not (min_snr > 0.0 and snr_width > 0.0):
            raise DomainError(f"min_snr = {min_snr}, snr_width = {snr_width}: expected positive numbers")
        error = np.sqrt(self._covariance[rows, 0, 0])
        if seed is None:
            return _shapes(values, values, error, min_snr, snr_width)
        names = (key,) if isinstance(key, str) else key
        normal = stream(require_seed(seed), *names).standard_normal((len(values), len(_MEASURED)))
        added, subtracted = (np.einsum("nij,nj->ni", matrices[rows], normal) for matrices in self._noise)
        pair = []
        for sign in (1.0, -1.0):
            measured, derivatives = values[:, _MEASURED] + sign * added, values.copy()
            derivatives[:, _DERIVATIVES] -= sign * subtracted
            pair.append(_shapes(measured, derivatives, error, min_snr, snr_width))
        return ShearShapes(*(0.5 * (getattr(pair[0], name) + getattr(pair[1], name)) for name in ShearShapes._table))

    def _psf_rows(self, psf_index: ArrayLike | None, count: int) -> np.ndarray:
        """Return the PSF of each galaxy, [n] int."""
        n = len(self._inverse)
        if psf_index is None:
            if n > 1:
                raise DomainError(f"psf_index: expected the PSF of each galaxy, as there are {n}", key="psf_index")
            return np.zeros(count, dtype=np.int32)
        index = np.asarray(psf_index)
        inside = index.dtype.kind in "iu" and (not index.size or (index.min() >= 0 and index.max() < n))
        if index.shape != (count,) or not inside:
            raise DomainError(f"psf_index: expected {count} integers from 0 to {n - 1}", key="psf_index")
        return index.astype(np.int32)


def require_side(side: int, sigma: float) -> None:
    """Raise DomainError for stamps that are too small for a weight of an rms width [pixel]."""
    if side < LEAST_SIDE * sigma:
        raise DomainError(
            f"side = {side}: too small for a weight of sigma = {sigma:.2f} pixels; expected at least "
            f"{int(np.ceil(LEAST_SIDE * sigma))} pixels",
            key="side",
        )


def smooth_step(snr: np.ndarray, least: float, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a step from 0 to 1 with two continuous derivatives, and its derivative."""
    u = np.clip((snr - least) / width, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2), 30.0 * (u * (1.0 - u)) ** 2 / width


def _shapes(
    total: np.ndarray, derivative: np.ndarray, error: np.ndarray, min_snr: float | None, snr_width: float
) -> ShearShapes:
    """Return shapes from functionals T [n, 3] of the ellipticities and D [n, 6] of their derivatives."""
    denominator = total[:, 0] + CONSTANT * error
    e1, e2 = total[:, 1] / denominator, total[:, 2] / denominator
    snr = total[:, 0] / error
    r11, r22, r12, r21 = (
        (derivative[:, change] + e * derivative[:, along]) / denominator
        for change, e, along in ((3, e1, 1), (4, e2, 2), (5, e1, 2), (5, e2, 1))
    )
    weight = np.ones(len(total))
    if min_snr is not None:
        weight, slope = smooth_step(snr, min_snr, snr_width)
        # dM0/dg is -M1 along x, -M2 along x = y.
        change1, change2 = (-slope * derivative[:, k] / error for k in (1, 2))
        r11, r22 = weight * r11 + e1 * change1, weight * r22 + e2 * change2
        r12, r21 = weight * r12 + e1 * change2, weight * r21 + e2 * change1
        e1, e2 = weight * e1, weight * e2
    return ShearShapes(e1, e2, r11, 0.5 * (r12 + r21), r22, weight, snr)


def checked_psfs(psf_images: ArrayLike) -> np.ndarray:
    """Return PSFs [n, m, m] of unit sum."""
    psfs = real_array(psf_images, "psf_images: expected real numbers [n, m, m]")
    psfs = psfs[None] if psfs.ndim == 2 else psfs
    if psfs.ndim != 3 or psfs.shape[1] != psfs.shape[2] or psfs.shape[1] % 2 == 0 or not len(psfs):
        raise DomainError(f"psf_images have shape {psfs.shape}: expected [n, m, m] with m odd")
    sums = psfs.sum(axis=(1, 2))
    if not np.all(np.abs(sums - 1.0) < _PSF_SUM_TOLERANCE):
        worst = int(np.argmax(np.nan_to_num(np.abs(sums - 1.0), nan=np.inf)))
        raise DomainError(f"psf_images[{worst}]: sum {sums[worst]:g}, expected 1")
    return psfs / sums[:, None, None]


def _blocks(count: int) -> Iterator[slice]:
    return (slice(i, i + _BLOCK) for i in range(0, count, _BLOCK))
