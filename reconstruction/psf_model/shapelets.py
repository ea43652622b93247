"""Shapelets: Gauss-Hermite functions as the basis of the stars of a CCD (Refregier 2003)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import ConfigError
from .basis import COMPONENTS, Basis, FittedBasis, eigenvalues_of
from .clean_stars import CleanStars
from .file_parts import ModelParts

# Scales of shapelets tried first, over the rms width of the mean star, before the best is refined.
_SCALES = np.geomspace(0.4, 1.6, 13)
# Most components for the choice of the scale: with many, the residual hardly depends on it.
_FOR_SCALE = 20
# Fraction of an interval at which the golden section divides it.
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


@check_arguments
@dataclass(frozen=True)
class Shapelets(Basis):
    """Gauss-Hermite functions by total order; they truncate the wings (Jee & Tyson 2011, sec. 3).

    `scale` is the rms width of the Gaussian [pixel]; None chooses the one with the least squares of the residuals of
    all stars.
    """

    name = "shapelets"
    words = "shapelets a CCD"

    n_components: int | Literal["auto"] | None = COMPONENTS
    scale: float | None = None

    def __post_init__(self) -> None:
        if self.scale is not None and not (np.isfinite(self.scale) and self.scale > 0.0):
            raise ConfigError(f"scale = {self.scale}: expected a positive number of pixels")

    def most_components(self, n_stars: int, n_pixels: int) -> tuple[int, str]:
        """Return the largest number of components, and what limits it."""
        return n_pixels - 1, f"the pixels ({n_pixels}) less one"

    def fit(
        self, stars: CleanStars, shape: tuple[int, int], count: int, weights: np.ndarray | None = None
    ) -> GaussHermite:
        """Return the first `count` + 1 shapelets by total order as a mean and `count` components.

        They are sampled at the centres of the pixels about the middle one, and restricted to unit sum. The mean is the
        projection of the mean star: what the shapelets truncate is left out, as in the shapelet method that Jee & Tyson
        2011, sec. 3, compare with. ConfigError if the stamps have too few pixels for independent shapelets.
        """
        mean, deviations = stars.mean, stars.deviations
        scale = self.scale
        if scale is None:
            scale = _best_scale(mean + deviations, min(count, _FOR_SCALE), shape)
        base, vectors = _unit_sum_shapelets(count, shape, scale)
        projected_mean = base + (vectors @ (mean - base)) @ vectors
        singular = np.linalg.svd(deviations, compute_uv=False)
        return GaussHermite(
            projected_mean.reshape(shape), vectors.reshape(-1, *shape), eigenvalues_of(singular, stars), float(scale)
        )


@dataclass(frozen=True, eq=False)
class GaussHermite(FittedBasis, kind=Shapelets):
    """Mean and shapelets of a scale."""

    scale: float = np.nan  #: rms width of the Gaussian [pixel]

    def _deviations_of(self, stars: CleanStars) -> np.ndarray:
        return np.asarray(stars.deviations + (stars.mean - self.mean.ravel()))

    def parts(self) -> ModelParts:
        """Return what the basis has in a FITS file."""
        parts = super().parts()
        return ModelParts(
            parts.cards | {"SCALE": (self.scale, "[pixel] rms width of the shapelets' Gaussian")}, parts.images
        )

    @classmethod
    def _options_of(cls, parts: ModelParts) -> dict[str, Any]:
        return {"scale": float(parts.cards["SCALE"])}


def shapelet_images(count: int, shape: tuple[int, int], scale: float) -> np.ndarray:
    """Return the first shapelets by total order, [count, ny, nx], sampled at the centres of the pixels.

    They are centred on pixel (ny // 2, nx // 2), where stars are. Within an order the one along x comes first. Each has
    unit square integral over the plane [pixel^-1]. `scale` is the rms width of the Gaussian of order zero [pixel].
    """
    # An order's amplitude is exp(-r^2 / 2 beta^2): the Gaussian of order zero has rms width beta.
    order = 0
    while (order + 1) * (order + 2) // 2 < count:
        order += 1
    along_y, along_x = (_hermite_functions(order, (np.arange(n) - n // 2) / scale) for n in shape)
    pairs = [(total - m, m) for total in range(order + 1) for m in range(total + 1)][:count]
    return np.stack([along_y[m][:, None] * along_x[n] for n, m in pairs]) / scale


def _hermite_functions(order: int, x: np.ndarray) -> np.ndarray:
    """Return H_n(x) exp(-x^2/2) / sqrt(2^n n! sqrt(pi)) for n = 0 to `order`, by their recurrence."""
    rows = [np.pi**-0.25 * np.exp(-0.5 * x**2)]
    rows.append(np.sqrt(2.0) * x * rows[0])
    for n in range(1, order):
        rows.append(np.sqrt(2.0 / (n + 1)) * x * rows[n] - np.sqrt(n / (n + 1)) * rows[n - 1])
    return np.stack(rows[: order + 1])


def _unit_sum_shapelets(count: int, shape: tuple[int, int], scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the Gaussian of unit sum [n_pixels] and orthonormal combinations of sum zero [count, n_pixels].

    The first m components span the same combinations of sum zero as the first m + 1 shapelets.
    """
    images = shapelet_images(count + 1, shape, scale).reshape(count + 1, -1)
    base = images[0] / images[0].sum()
    changes = images[1:] - images[1:].sum(axis=1)[:, None] * base
    q, r = np.linalg.qr(changes.T)
    size = np.abs(np.diagonal(r))
    if count > len(base) - 1 or size.min() < 1e-8 * size.max():
        raise ConfigError(
            f"n_components = {count}: stamps of {shape[1]} x {shape[0]} pixels do not resolve that many shapelets "
            f"of scale {scale:.3g} pixels"
        )
    return base, (q * np.where(np.diagonal(r) < 0.0, -1.0, 1.0)).T


def _best_scale(stars: np.ndarray, count: int, shape: tuple[int, int]) -> float:
    """Return the scale with the least residual of the stars [n, n_pixels], by golden section."""
    width = _rms_width(stars.mean(axis=0).reshape(shape))

    def squared_residual(log_scale: float) -> float:
        try:
            base, vectors = _unit_sum_shapelets(count, shape, float(np.exp(log_scale)))
        except ConfigError:
            return np.inf
        deviations = stars - base
        return float(((deviations - (deviations @ vectors.T) @ vectors) ** 2).sum())

    log_scales = np.log(_SCALES * width)
    values = [squared_residual(t) for t in log_scales]
    best = int(np.argmin(values))
    if not np.isfinite(values[best]):
        _unit_sum_shapelets(count, shape, width)  # raises the error
    low, high = log_scales[max(best - 1, 0)], log_scales[min(best + 1, len(log_scales) - 1)]
    a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_a, at_b = squared_residual(a), squared_residual(b)
    while high - low > 1e-9:
        if at_a < at_b:
            high, b, at_b = b, a, at_a
            a = high - _GOLDEN * (high - low)
            at_a = squared_residual(a)
        else:
            low, a, at_a = a, b, at_b
            b = low + _GOLDEN * (high - low)
            at_b = squared_residual(b)
    return float(np.exp(0.5 * (low + high)))


def _rms_width(image: np.ndarray) -> float:
    """Return the rms width [pixel] of the part of a star above a tenth of its peak, without the wings."""
    y, x = np.indices(image.shape)
    light = np.where(image > 0.1 * image.max(), image, 0.0).ravel()
    light /= light.sum()
    x0, y0 = (light * x.ravel()).sum(), (light * y.ravel()).sum()
    return float(np.sqrt(0.5 * (light * ((x.ravel() - x0) ** 2 + (y.ravel() - y0) ** 2)).sum() + 0.25))
