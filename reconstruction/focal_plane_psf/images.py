r"""Images of the PSF of a given shape, and principal components of residual stamps over the focal plane.

A change of second moments is a convolution with a narrow Gaussian, of positive or negative width,

.. math:: \tilde I(k) \to \tilde I(k) \, e^{-k^T S k / 2},

to lowest order the effect of turbulence on the image of the optics. S is found by Broyden's method, so that the
image has the predicted e1, e2 and size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...measure.shapes import measure_shapes
from .covariance import Covariance, Places
from .kriging import leave_one_out, map_on_threads, neighbourhood, neighbours_of
from .likelihood import blocks_of, fit_covariance
from .mean_star import edge_of, limited
from .mosaic import Mosaic

# The three deformations, as coefficients of kx^2, ky^2 and kx ky: along x, along x = y, and round.
_SHAPES = np.array([[1.0, -1.0, 0.0], [0.0, 0.0, 2.0], [1.0, 1.0, 0.0]])
_STEP = 0.02
_ITERATIONS = 7
# Least square of a step for an update of the Jacobian.
_SMALLEST = 1e-14
# Depth of dark rings about a star, of its peak, from which on they are of no PSF.
_RINGING = 0.1
# Chi-square by which predictions are better than zero, at least.
_LEAST_GAIN = 10.0
# Pixels of zeros about a stamp while it is convolved.
_ROOM = 8


@np.errstate(over="ignore", invalid="ignore")
def with_shapes(images: np.ndarray, values: np.ndarray, pixel_scale: float, weight_fwhm: float) -> np.ndarray:
    """Convolve images [n, ny, nx] to the shapes e1, e2, ln size [n, 3]; the result is of unit sum.

    Its centroids are the centres of the pixels [ny // 2, nx // 2].
    Where no image has the shape (:func:`has_shape`), it is of another one, or not finite.
    """
    ny, nx = images.shape[1:]
    padded = np.pad(images.astype(np.float64), ((0, 0), (_ROOM, _ROOM), (_ROOM, _ROOM)))
    spectrum = np.fft.rfft2(padded)
    ky = 2.0 * np.pi * np.fft.fftfreq(ny + 2 * _ROOM)[:, None]
    kx = 2.0 * np.pi * np.fft.rfftfreq(nx + 2 * _ROOM)
    forms = np.einsum("sp,pyx->syx", _SHAPES, np.stack(np.broadcast_arrays(kx**2, ky**2, kx * ky)))
    amounts, shift = np.zeros((len(images), 3)), np.zeros((len(images), 2))
    middle = np.array([nx // 2 - 0.5 * (nx - 1), ny // 2 - 0.5 * (ny - 1)])

    def image(amounts: np.ndarray, shift: np.ndarray) -> np.ndarray:
        exponent = -0.5 * np.einsum("ns,syx->nyx", amounts, forms)
        phase = kx * shift[:, 0, None, None] + ky * shift[:, 1, None, None]
        result = np.fft.irfft2(spectrum * np.exp(exponent + 1j * phase), s=padded.shape[1:])
        return result[:, _ROOM : ny + _ROOM, _ROOM : nx + _ROOM]

    def measured(stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moments = measure_shapes(stamps, pixel_scale, weight_fwhm)
        centroids = np.stack([moments.x, moments.y], axis=1)
        return np.stack([moments.e1, moments.e2, np.log(moments.size)], axis=1), centroids - middle

    image_shapes, centre = measured(image(amounts, shift))
    jacobian = np.empty((len(images), 3, 3))
    for shape in range(3):
        step = np.zeros(3)
        step[shape] = _STEP
        ends = [measured(image(amounts + sign * step, shift))[0] for sign in (1.0, -1.0)]
        jacobian[:, :, shape] = (ends[0] - ends[1]) / (2.0 * _STEP)
    for _ in range(_ITERATIONS):
        step = np.linalg.solve(jacobian, (values - image_shapes)[:, :, None])[:, :, 0]
        amounts, shift, before = amounts + step, shift + centre, image_shapes
        image_shapes, centre = measured(image(amounts, shift))
        # Broyden's update of the Jacobian, where there was a step.
        square = (step**2).sum(axis=1)
        missed = image_shapes - before - np.einsum("nfs,ns->nf", jacobian, step)
        moved = square > _SMALLEST
        jacobian[moved] += missed[moved, :, None] * (step / np.maximum(square, _SMALLEST)[:, None])[moved, None]
    result = image(amounts, shift)
    return result / result.sum(axis=(1, 2), keepdims=True)


def has_shape(images: np.ndarray) -> np.ndarray:
    """Return which images of :func:`with_shapes` [n, ny, nx] have theirs, bool [n].

    A shape far from that of the image, as noise makes them of faint stars, needs a Gaussian of so negative a width that
    rings outshine the star, or that the search ends in no image at all.
    """
    darkest, brightest = images.min(axis=(1, 2)), images.max(axis=(1, 2))
    return np.asarray(np.isfinite(images).all(axis=(1, 2)) & (darkest > -_RINGING * brightest))


@dataclass(frozen=True, eq=False)
class ResidualImages:
    """Principal components of stamps less the model, each interpolated over the focal plane as a random field.

    Attributes
    ----------
    mosaic : Mosaic
        The CCDs.
    components : ndarray, shape [k, ny, nx]
        Orthonormal components, of sum zero.
    places : Places
        Of the stars.
    coefficients, noise : ndarray, shape [n, k]
        Projections of the stars, and variances of their noise.
    covariances : tuple of Covariance
        Of each coefficient.
    """

    mosaic: Mosaic
    components: np.ndarray
    places: Places
    coefficients: np.ndarray
    noise: np.ndarray
    covariances: tuple[Covariance, ...]

    @classmethod
    def fit(
        cls,
        residuals: np.ndarray,
        places: Places,
        weight: np.ndarray,
        mosaic: Mosaic,
        count: int,
        threads: int | None,
        passed: np.ndarray | None = None,
    ) -> ResidualImages | None:
        """Fit up to `count` components of residual stamps [n, ny, nx] that predict stars left out; None without any.

        `weight` [n] are the inverse variances of the stars but for a factor. The noise of a pixel is that of the
        corners of the stamps: where photons of the star make more, components may be theirs, which predict nothing.
        Components are limited to the frequencies that are `passed` (:func:`~.mean_star.mean_star`).
        """
        n, ny, nx = residuals.shape
        flat = (residuals - residuals.mean(axis=(1, 2), keepdims=True)).reshape(n, -1)
        root = np.sqrt(weight / weight.mean())[:, None]
        _, values, rows = np.linalg.svd(flat * root, full_matrices=False)
        # Noise alone makes the largest singular value sigma (sqrt(n) + sqrt(pixels)) (Marchenko & Pastur 1967).
        sigma = float(np.std((flat * root)[:, edge_of((ny, nx)).ravel()]))
        keep = min(count, int((values > 1.05 * sigma * (np.sqrt(n) + np.sqrt(ny * nx))).sum()))
        if keep == 0:
            return None
        rows = rows[:keep]
        if passed is not None:
            rows = limited(rows.reshape(keep, ny, nx), passed).reshape(keep, -1)
            rows = np.linalg.qr(rows.T)[0].T
        signs = np.where(rows[range(keep), np.abs(rows).argmax(axis=1)] < 0, -1.0, 1.0)
        components = rows * signs[:, None]
        coefficients = np.einsum("np,kp->nk", flat, components)
        noise = np.repeat((sigma / root) ** 2, keep, axis=1)

        def covariance(k: int) -> Covariance | None:
            values, variances = coefficients[:, k], noise[:, k]
            fitted = fit_covariance(places, values, variances, max_iterations=25).covariance
            return fitted if _predicts(fitted, places, values, variances) else None

        fitted = dict(enumerate(map_on_threads(covariance, range(keep), threads)))
        covariances = {k: covariance for k, covariance in fitted.items() if covariance is not None}
        if not covariances:
            return None
        predicting = list(covariances)
        images = components.reshape(keep, ny, nx)[predicting]
        return cls(
            mosaic, images, places, coefficients[:, predicting], noise[:, predicting], tuple(covariances.values())
        )

    def at(self, places: Places, threads: int | None = None) -> np.ndarray:
        """Return the sum of the components at places, shape [n, ny, nx]."""
        amount = np.zeros((len(places), len(self.components)))

        def job(ccd: int) -> tuple[np.ndarray, np.ndarray]:
            at = np.flatnonzero(places.ccd == ccd)
            stars = neighbours_of(self.places, self.mosaic.centers[ccd])
            amounts = np.empty((len(at), len(self.components)))
            for k, covariance in enumerate(self.covariances):
                near = neighbourhood(covariance, self.places, self.coefficients[:, k], self.noise[:, k], stars)
                amounts[:, k] = near.predict(covariance.between(self.places[stars], places[at]))
            return at, amounts

        for at, amounts in map_on_threads(job, np.unique(places.ccd), threads):
            amount[at] = amounts
        return np.einsum("nk,kyx->nyx", amount, self.components)


def _predicts(covariance: Covariance, places: Places, values: np.ndarray, noise: np.ndarray) -> bool:
    """Return whether predictions of values [n] by the other stars of their blocks are better than zero.

    By chance those of noise are, in half of all cases.
    """
    left_out = np.empty(len(values))
    for index in blocks_of(places.xy):
        near = neighbourhood(covariance, places, values[:, None], noise[:, None], index)
        left_out[index] = leave_one_out(near)[0][:, 0]
    return bool((left_out**2 / noise).sum() < (values**2 / noise).sum() - _LEAST_GAIN)
