r"""Adaptive moments: ellipticities and sizes under an elliptical Gaussian weight that follows the image.

Those of GalSim's ``hsm.FindAdaptiveMom``, and so of the PSFs of DES, HSC and Rubin. The weight G, the centre and the
moments M are those for which

.. math:: G = \exp(-\tfrac12 (\mathbf x - \mathbf x_0)^T M^{-1} (\mathbf x - \mathbf x_0)), \qquad
          \sum G I \, (\mathbf x - \mathbf x_0) = 0, \qquad
          2 \sum G I \, (\mathbf x - \mathbf x_0) (\mathbf x - \mathbf x_0)^T = M \sum G I

(Bernstein & Jarvis 2002, AJ 123, 583, sec. 3.1; Hirata & Seljak 2003, MNRAS 343, 459): those of the elliptical Gaussian
that fits the image best. M of a Gaussian image is its own.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntFlag
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.launch import launch
from ..core.point_plots import draw_shapes
from ..core.result import Result
from ..core.threads import one_blas_thread
from ..core.units import ARCSEC, positive_angle, real_array, require_count, require_positive
from ..core.warp_arrays import warp_array
from .adaptive_kernels import ELLIPSE, LARGEST_RHO2, fit_ellipses
from .pixel_masks import bad_pixels
from .rho_statistics import trace_of_moments
from .shapes import stamp_cube

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: A star is flagged where masked pixels hold more than this part of the squared weight: it is mostly the model.
MOST_MASKED = 0.5
#: Largest rms width, as a part of the stamp's side: that of an even stamp without a star is 0.36 of it.
_WIDEST = 1.0 / 3.0
#: Start of the iteration: rms width of the weight [pixel], that of HSM.
_START_PIXELS = 5.0
# 8 MB a work array: the memory used does not grow with the number of stars.
_BATCH_PIXELS = 1 << 20
# Of the derivatives in natural units: below it, fewer pixels count than the six numbers that they determine.
_LEAST_DETERMINANT = 1e-12
# Powers of x and of y in the sums from which errors follow.
_POWERS = 5
# Functions that the fit is orthogonal to, as powers of x and y: amplitude, centre and moments of the Gaussian.
_X_POWER = np.array([0, 1, 0, 2, 1, 0])
_Y_POWER = np.array([0, 0, 1, 0, 1, 2])
# The derivative of exp(-rho^2/2) by an element of M^-1 dM M^-1: x^2/2, x y, y^2/2.
_DERIVATIVE = np.array([1.0, 1.0, 1.0, 0.5, 1.0, 0.5])


class MomentFlag(IntFlag):
    """Failures of adaptive moments; zero for a good measurement. The first four are those of :class:`~.ShapeFlag`.

    ``CENTROID_LEFT_STAMP``: the centre lies outside the stamp. ``NO_FLUX``: the weighted sum is not positive.
    ``TOO_WIDE``: an rms width exceeds a third of the stamp, so that its edge would be measured. ``MASKED``: masked
    pixels hold more than half of the squared weight, or the other ones do not determine the errors.
    """

    OK = 0
    NOT_CONVERGED = 1
    NEGATIVE_MOMENTS = 2
    CENTROID_LEFT_STAMP = 4
    NO_FLUX = 8
    TOO_WIDE = 16
    MASKED = 32


@dataclass(frozen=True)
class AdaptiveMoments(Result):
    """Adaptive moments of n images, one array element each; NaN where flagged.

    Parameters
    ----------
    g1, g2 : array
        Shear-like ellipticity (a - b)/(a + b), along x and along the diagonal: HSM's ``observed_shape.g1``.
    sigma : array
        ``(Mxx Myy - Mxy^2)^(1/4) = sqrt(a b)`` [rad]: HSM's ``moments_sigma``, of a Gaussian its rms width.
    rho4 : array
        Mean of rho^4 under the weight, 2 for a Gaussian, larger with wings: HSM's ``moments_rho4``.
    flux : array
        That of the Gaussian, in the units of the image: HSM's ``moments_amp``.
    x, y : array
        Centroid from the centre of the stamp [pixel].
    flags : array of int
        :class:`MomentFlag` bits.
    error_g1, error_g2 : array
        Standard errors; NaN without weights.
    error_sigma : array
        Standard error [rad]; NaN without weights.
    error_flux : array
        Standard error, in the units of the image; NaN without weights.
    error_x, error_y : array
        Standard errors [pixel]; NaN without weights.
    """

    _table = ("g1", "g2", "sigma", "rho4", "flux", "x", "y", "flags",
              "error_g1", "error_g2", "error_sigma", "error_flux", "error_x", "error_y")  # fmt: skip

    g1: np.ndarray
    g2: np.ndarray
    sigma: np.ndarray
    rho4: np.ndarray
    flux: np.ndarray
    x: np.ndarray
    y: np.ndarray
    flags: np.ndarray
    error_g1: np.ndarray
    error_g2: np.ndarray
    error_sigma: np.ndarray
    error_flux: np.ndarray
    error_x: np.ndarray
    error_y: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the ellipticities in their plane, coloured by the size."""
        return draw_shapes(ax, self.g1, self.g2, self.sigma / ARCSEC, "sigma [arcsec]", labels=("g1", "g2"))

    @property
    def T(self) -> np.ndarray:  # noqa: N802
        """Size ``Mxx + Myy = a^2 + b^2 = 2 sigma^2 (1 + |g|^2)/(1 - |g|^2)`` [rad^2]."""
        return trace_of_moments(self.sigma, self.g1, self.g2)

    @property
    def e1(self) -> np.ndarray:
        """Distortion ``(a^2 - b^2)/(a^2 + b^2) = 2 g/(1 + |g|^2)`` along x: HSM's ``observed_shape.e1``."""
        return np.asarray(2.0 * self.g1 / (1.0 + self.g1**2 + self.g2**2))

    @property
    def e2(self) -> np.ndarray:
        """Distortion (a^2 - b^2)/(a^2 + b^2) along the diagonal."""
        return np.asarray(2.0 * self.g2 / (1.0 + self.g1**2 + self.g2**2))

    @property
    def usable(self) -> np.ndarray:
        """Images without a flag, [n] bool."""
        return self.flags == 0

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.flags)


@check_arguments
def adaptive_moments(
    images: ArrayLike,
    pixel_scale: ArrayLike,
    mask: NDArray[np.bool_] | None = None,
    weight: ArrayLike | None = None,
    *,
    fill_masked: bool = True,
    start_sigma: ArrayLike | None = None,
    max_iterations: int = 400,
    tolerance: float = 1e-6,
    threads: int | None = None,
) -> AdaptiveMoments:
    r"""Measure elliptical Gaussian adaptive moments (Hirata & Seljak 2003), as GalSim's HSM.

    The iteration is HSM's, from a round Gaussian at the centre of the stamp, and so are the numbers, to 1e-6. Shapes
    are along the axes of the stamp, as those of :func:`~.measure_shapes`.

    Pixels that are masked, of weight 0, not finite, or -1e29 or less (SExtractor's mask) do not count. In their place
    is what the Gaussian has there that fits the other pixels best: the moments are those of a least-squares fit to the
    others, and a star is lost only where more than half of its squared weight is masked. HSM puts zeros there, which
    makes a star with a masked core elongated: ``fill_masked=False`` does so too.

    Parameters
    ----------
    images : array
        [n, ny, nx], or one image [ny, nx], background subtracted.
    pixel_scale : float or Quantity
        Side of a pixel [rad].
    mask : array of bool, optional
        True where a pixel is bad, of the shape of the images, or [ny, nx] for all.
    weight : array, optional
        Inverse variance of each pixel, 0 where it is bad, of the shape of the images, or [ny, nx] for all. From it come
        the errors; good pixels count alike, as in HSM.
    fill_masked : bool
        Whether bad pixels are filled by the Gaussian (or hold zero).
    start_sigma : float or Quantity, optional
        Rms width of the first weight [rad]; 5 pixels by default.
    max_iterations : int
        Most steps.
    tolerance : float
        The iteration ends with a step of the centre shorter than this, in units of the minor axis, and of the moments
        shorter than its square, in units of the axis squared, as in HSM.
    threads : int, optional
        All processors by default; no byte depends on it.

    Returns
    -------
    AdaptiveMoments
        Arrays of length n, also for one image (n = 1).

    Raises
    ------
    DomainError
        If an argument has the wrong shape, a weight is negative, or a number is not positive.
    """
    stack = stamp_cube(images)
    scale = positive_angle(pixel_scale, "pixel_scale")
    start = _START_PIXELS if start_sigma is None else positive_angle(start_sigma, "start_sigma") / scale
    max_iterations = require_count(max_iterations, "max_iterations", 1)
    tolerance = require_positive(tolerance, "tolerance")
    weights = _weights(weight, stack.shape)
    masked = _masked_pixels(mask, stack.shape)
    batch = max(1, _BATCH_PIXELS // (stack.shape[1] * stack.shape[2]))
    parts = []
    for first in range(0, max(len(stack), 1), batch):
        rows = slice(first, first + batch)
        pixels = np.array(stack[rows], dtype=np.float64, order="C")
        bad = bad_pixels(pixels)
        if masked is not None:
            bad |= masked[rows]
        if weights is not None:
            bad |= ~(weights[rows] > 0.0)
        pixels[bad] = 0.0
        ellipses, flags = np.zeros((len(pixels), ELLIPSE)), np.zeros(len(pixels), dtype=np.int32)
        in_stamp = bad.any(axis=(1, 2))
        launch(
            fit_ellipses,
            len(pixels),
            [
                warp_array(pixels),
                warp_array(bad if in_stamp.any() else np.zeros((len(pixels), 1, 1)), wp.uint8),
                warp_array(in_stamp, wp.uint8),
                fill_masked,
                start,
                max_iterations,
                tolerance,
                warp_array(ellipses),
                warp_array(flags, wp.int32),
            ],
            threads=threads,
        )
        flags[(flags == 0) & (ellipses[:, 7] > MOST_MASKED)] = MomentFlag.MASKED
        wide = (ellipses[:, 2] > (stack.shape[2] * _WIDEST) ** 2) | (ellipses[:, 4] > (stack.shape[1] * _WIDEST) ** 2)
        flags[(flags == 0) & wide] = MomentFlag.TOO_WIDE
        covariance = np.full((len(pixels), 6, 6), np.nan)
        if weights is not None:
            good = np.flatnonzero(flags == 0)
            counted = ~bad[good] if fill_masked else np.ones_like(bad[good])
            variance = np.divide(1.0, weights[rows][good], out=np.zeros(counted.shape), where=~bad[good])
            covariance[good] = _covariance(pixels[good], counted, variance, ellipses[good])
            flags[np.isnan(covariance[:, 0, 0]) & (flags == 0)] = MomentFlag.MASKED
        parts.append(_moments(ellipses, flags, covariance, scale))
    return AdaptiveMoments(
        **{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(AdaptiveMoments)}
    )


def _weights(weight: ArrayLike | None, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return weights of the shape of the images, or raise DomainError."""
    if weight is None:
        return None
    values = real_array(weight, "weight: expected an array of real numbers")
    if values.shape not in (shape, shape[1:]):
        raise DomainError(
            f"weight has shape {values.shape}: expected {shape} as the images, or {shape[1:]}", key="weight"
        )
    if (values < 0.0).any():
        raise DomainError(f"weight: the least is {np.nanmin(values):g}, expected no negative one", key="weight")
    if np.isinf(values).any():
        raise DomainError("weight has infinite values: expected inverse variances", key="weight")
    if values.size and not (values > 0.0).any():
        raise DomainError("weight is 0 in all pixels: expected inverse variances, 0 in bad pixels alone", key="weight")
    return np.broadcast_to(values, shape)


def _masked_pixels(mask: NDArray[np.bool_] | None, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return masked pixels of the shape of the images, or raise DomainError."""
    if mask is None:
        return None
    masked = np.asarray(mask, dtype=bool)
    if masked.shape not in (shape, shape[1:]):
        raise DomainError(f"mask has shape {masked.shape}: expected {shape} as the images, or {shape[1:]}", key="mask")
    return np.broadcast_to(masked, shape)


def _moments(ellipses: np.ndarray, flags: np.ndarray, covariance: np.ndarray, scale: float) -> AdaptiveMoments:
    """Return shapes of ellipses [n, ELLIPSE] with the covariance [n, 6, 6] of ln flux, x, y, Mxx, Mxy, Myy [pixel]."""
    values = np.where((flags == 0)[:, None], ellipses, np.nan)
    x, y, xx, xy, yy, amplitude, rho4, _ = values.T
    det = xx * yy - xy**2
    root = np.sqrt(det)
    norm = xx + yy + 2.0 * root
    g1, g2 = (xx - yy) / norm, 2.0 * xy / norm
    flux, sigma = 2.0 * amplitude, np.sqrt(root)
    zero, unity = np.zeros_like(xx), np.ones_like(xx)
    root_gradient = 0.5 * np.stack([yy, -2.0 * xy, xx], axis=1) / root[:, None]
    norm_gradient = np.stack([unity, zero, unity], axis=1) + 2.0 * root_gradient
    gradients = (
        (np.stack([unity, zero, -unity], axis=1) - g1[:, None] * norm_gradient) / norm[:, None],
        (np.stack([zero, 2.0 * unity, zero], axis=1) - g2[:, None] * norm_gradient) / norm[:, None],
        0.5 * root_gradient / sigma[:, None] * scale,
    )
    of_moments = covariance[:, 3:, 3:]
    errors = [np.sqrt((d * (of_moments * d[:, None, :]).sum(axis=2)).sum(axis=1)) for d in gradients]
    error_flux, error_x, error_y = (np.sqrt(covariance[:, i, i]) for i in range(3))
    return AdaptiveMoments(
        g1=g1,
        g2=g2,
        sigma=sigma * scale,
        rho4=rho4,
        flux=flux,
        x=x,
        y=y,
        flags=flags,
        error_g1=errors[0],
        error_g2=errors[1],
        error_sigma=errors[2],
        error_flux=flux * error_flux,
        error_x=error_x,
        error_y=error_y,
    )


def _gaussian_moments(xx: np.ndarray, xy: np.ndarray, yy: np.ndarray) -> np.ndarray:
    """Return the moments of Gaussians of unit sum and covariances [n] up to fourth order, [n, power of y, power of x].

    Those of a higher total order are zero here.
    """
    moments = np.zeros((len(xx), _POWERS, _POWERS))
    moments[:, 0, 0] = 1.0
    moments[:, 0, 2], moments[:, 1, 1], moments[:, 2, 0] = xx, xy, yy
    moments[:, 0, 4], moments[:, 4, 0] = 3.0 * xx**2, 3.0 * yy**2
    moments[:, 1, 3], moments[:, 3, 1] = 3.0 * xx * xy, 3.0 * xy * yy
    moments[:, 2, 2] = xx * yy + 2.0 * xy**2
    return moments


def _covariance(pixels: np.ndarray, counted: np.ndarray, variance: np.ndarray, ellipses: np.ndarray) -> np.ndarray:
    """Return the covariance [n, 6, 6] of ln flux, x, y, Mxx, Mxy, Myy [pixel] from the variance of the pixels.

    The fit solves F_k = sum(G (I - a G) phi_k) = 0 over the pixels that count, phi_k being 1, x, y, x^2, x y, y^2. As
    in HSM the sums of G^2 go on beyond the stamp. Noise n changes F_k by sum(G n phi_k), and the parameters by
    -J^-1 dF, J being the derivatives of F. NaN where the pixels do not determine them.
    """
    count, ny, nx = pixels.shape
    x0, y0, xx, xy, yy = (ellipses[:, i, None, None] for i in range(5))
    det = xx * yy - xy**2
    unit = det**0.25  # the sums are of numbers about 1
    x = (np.arange(nx) - 0.5 * (nx - 1) - x0) / unit
    y = (np.arange(ny)[:, None] - 0.5 * (ny - 1) - y0) / unit
    rho2 = (yy * x**2 - 2.0 * xy * x * y + xx * y**2) * (unit**2 / det)
    g = np.where(rho2 < float(LARGEST_RHO2), np.exp(-0.5 * rho2), 0.0)
    x_powers, y_powers = (np.stack([z**k for k in range(_POWERS)], axis=1) for z in (x[:, 0], y[:, :, 0]))
    with one_blas_thread():
        light, hidden, noise = (
            y_powers @ f @ x_powers.transpose(0, 2, 1) for f in (g * pixels, g**2 * ~counted, g**2 * variance)
        )  # [n, power of y, power of x]
    shape = np.stack([[xx[:, 0, 0], xy[:, 0, 0]], [xy[:, 0, 0], yy[:, 0, 0]]]).transpose(2, 0, 1) / unit**2
    p, q, r = shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]
    square = np.pi * unit**2 * _gaussian_moments(0.5 * p, 0.5 * q, 0.5 * r) - hidden
    at = (slice(None), _Y_POWER[:, None] + _Y_POWER, _X_POWER[:, None] + _X_POWER)
    peak = light[:, 0, 0] / square[:, 0, 0]
    jacobian = _DERIVATIVE * (light[at] - 2.0 * peak[:, None, None] * square[at])
    jacobian[:, :, 0] = -square[at][:, :, 0] * peak[:, None]  # by ln a
    jacobian /= light[:, :1, :1]  # numbers about 1
    determined = np.abs(np.linalg.det(jacobian)) > _LEAST_DETERMINANT
    inverse = np.linalg.inv(np.where(determined[:, None, None], jacobian, np.eye(6)))
    # The layout of noise[at] in memory depends on the number of images, and with it the order in which BLAS adds.
    of_equations = np.ascontiguousarray(noise[at] / light[:, :1, :1] ** 2)
    covariance = inverse @ of_equations @ inverse.transpose(0, 2, 1)
    # From M^-1 dx and M^-1 dM M^-1, in units of `unit`, to dx and dM; from ln a to the logarithm of the flux a |M|^1/2.
    change = np.zeros((count, 6, 6))
    change[:, 1:3, 1:3] = shape * unit
    change[:, 3:, 3:] = unit**2 * np.stack(
        [
            np.stack([p * p, 2.0 * p * q, q * q], axis=1),
            np.stack([p * q, p * r + q * q, q * r], axis=1),
            np.stack([q * q, 2.0 * q * r, r * r], axis=1),
        ],
        axis=1,
    )
    change[:, 0, 0] = 1.0
    change[:, 0, 3:] = 0.5 * np.stack([p, 2.0 * q, r], axis=1)  # tr(M^-1 dM) = tr(M H)
    result: np.ndarray = change @ covariance @ change.transpose(0, 2, 1)
    result[~determined] = np.nan
    return result
