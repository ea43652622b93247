"""The fit of a PSF model: checks, description of the stars, interpolation over the CCD."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from ...core.errors import ConfigError, DomainError
from ...core.threads import one_blas_thread
from . import gaussian_process, kriging
from .basis import BASES, Basis
from .checks import as_extent, as_stamps, as_weights, check_distinct_positions, check_terms
from .clean_stars import CleanStars, cleaned_stars, make_basis, project_stars
from .cross_validation import automatic_orders, choose_by_cross_validation
from .polynomial import MOST_ORDER, as_positions, design_matrix, mapped, term_count
from .shape_noise import ShapeNoise

#: Components of principal components and of shapelets where no number is given (Jee & Tyson 2011, sec. 3).
COMPONENTS = 20
#: Ways from the stars' coefficients to those of any place.
INTERPOLATIONS = ("polynomial", "gp", "kriging")
#: Degree of the polynomials, or of the trend under a process, where none is given.
ORDERS = {"polynomial": 3, "gp": 0, "kriging": kriging.ORDER}
# Order of the polynomials that predict outliers and masked pixels in kriging, and where the order is to be chosen.
_SMOOTH_ORDER = 2
#: Most components from which an automatic choice is made.
_MOST_COMPONENTS = 65
# Variance of a star's noise over that of its shape, at least: stars without noise would make the covariance singular.
_LEAST_NOISE = 1e-6


def fit_fields(
    stamps: Any,
    positions: Any,
    *,
    basis: str,
    interpolation: str,
    weights: Any,
    masks: Any,
    n_components: Any,
    order: int | str | None,
    extent: Any,
    scale: float | None,
    gain: float | None,
    clip_sigma: float | None,
    max_iterations: int,
    replacement: str,
) -> dict[str, Any]:
    """Return the fields of a model; arguments and errors as those of :meth:`~.PsfModel.fit`."""
    images, bad = as_stamps(stamps, masks)
    n_stars, ny, nx = images.shape
    points = as_positions(positions)
    if len(points) != n_stars:
        raise DomainError(f"positions: {len(points)} given, expected one for each of the {n_stars} stamps")
    _check_options(basis, interpolation, replacement, scale, clip_sigma, max_iterations, gain)
    limit = min(n_stars - 1, ny * nx)
    count = _component_count(basis, n_components, n_stars, limit, ny * nx)
    star_weights = None if isinstance(weights, str) else as_weights(weights, n_stars)
    if interpolation != "polynomial":
        if weights is not None:
            raise ConfigError(
                f"weights: expected none with interpolation = {interpolation!r}, which fits the noise itself"
            )
        if order == "auto":
            raise ConfigError(f"order = 'auto': expected a number or None with interpolation = {interpolation!r}")
        check_distinct_positions(points, interpolation)
    fixed = None if order == "auto" else int(ORDERS[interpolation] if order is None else order)
    if fixed is not None and not 0 <= fixed <= MOST_ORDER:
        raise ConfigError(f"order = {fixed}: expected a polynomial order from 0 to {MOST_ORDER}")
    automatic = fixed is None or n_components == "auto"
    # Those of polynomials; under a process they serve to choose components, and to weigh stars in eigen-PSFs.
    orders = [fixed] if interpolation == "polynomial" and fixed is not None else automatic_orders(n_stars)
    needed = orders[-1] if fixed is None else fixed
    by_noise = isinstance(weights, str) or interpolation == "gp" or (automatic and star_weights is None)
    span = as_extent(extent, points)
    terms = design_matrix(points, span, max(orders[-1], needed))
    with one_blas_thread():
        if interpolation != "kriging":  # which shrinks terms that the stars do not determine
            check_terms(terms[:, : term_count(needed)], needed, points, star_weights)
        # Few stars would follow their own outliers under a high order.
        smooth = _SMOOTH_ORDER if interpolation == "kriging" or fixed is None else fixed
        stars = cleaned_stars(
            images,
            bad,
            terms[:, : term_count(smooth)],
            clip_sigma=clip_sigma,
            max_iterations=max_iterations,
            replacement=replacement,
        )

        def basis_of(some: CleanStars, weights: np.ndarray | None, count: int) -> Basis:
            return make_basis(some, (ny, nx), basis, count, scale, weights)

        shapes = None
        if by_noise or automatic:
            shapes = ShapeNoise.of(images, stars.deviations, stars.mean.reshape(ny, nx), _checked_gain(images, gain))
        chosen = min(orders[-1], _SMOOTH_ORDER) if interpolation == "gp" else orders[-1]
        if shapes is not None and automatic:
            counts = np.arange(1, count + 1) if n_components == "auto" else np.array([count])
            chosen, count = choose_by_cross_validation(stars, terms, shapes, orders, counts, basis_of, star_weights)
        basis_weights = None
        if shapes is not None and by_noise:
            basis_weights = shapes.star_weights(stars.deviations, terms[:, : term_count(chosen)])
            stars = stars.about_weighted_mean(basis_weights)
            star_weights = basis_weights
        order = chosen if fixed is None else fixed
        found = basis_of(stars, basis_weights, count)
        coefficients, unexplained = project_stars(stars, found, basis)
        places, own = mapped(points, span), terms[:, : term_count(order)]
        if interpolation == "gp" and shapes is not None:
            between = _gaussian_process(places, coefficients, own, shapes.noise, shared=basis == "pixels")
        elif interpolation == "kriging":
            deviations = coefficients if basis == "pixels" else coefficients @ found.vectors
            between = _kriging(places, coefficients, own, images, found.mean.reshape(ny, nx), deviations, gain)
        else:
            q, r = np.linalg.qr(weighted(own, star_weights))
            polynomial = scipy.linalg.solve_triangular(r, q.T @ weighted(coefficients, star_weights))
            between = _Interpolated(polynomial, star_weights)
        return dict(
            mean=found.mean.reshape(ny, nx),
            components=found.vectors.reshape(-1, ny, nx),
            coefficients=coefficients,
            polynomial=between.polynomial,
            eigenvalues=found.spectrum[:limit] ** 2 / (n_stars - 1),
            positions=points,
            order=order,
            extent=span,
            unexplained=unexplained,
            rejected=stars.rejected.sum(axis=1),
            basis=basis,
            scale=found.scale,
            weights=between.weights,
            kernel=between.kernel,
            alpha=between.alpha,
        )


class _Interpolated(NamedTuple):
    """Coefficients between the stars: of the polynomials, weights of the stars, and kernel and weights of a process."""

    polynomial: np.ndarray
    weights: np.ndarray | None
    kernel: np.ndarray | None = None
    alpha: np.ndarray | None = None


def _gaussian_process(
    places: np.ndarray, coefficients: np.ndarray, terms: np.ndarray, noise: np.ndarray, *, shared: bool
) -> _Interpolated:
    """Return Gaussian processes through the coefficients of stars of some noise."""
    kernel = gaussian_process.fit_kernels(places, coefficients, terms, noise, shared=shared)
    polynomial, alpha, _ = gaussian_process.krige(places, coefficients, terms, kernel, noise)
    return _Interpolated(polynomial, 1.0 / noise, kernel, alpha)


def _kriging(
    places: np.ndarray,
    coefficients: np.ndarray,
    terms: np.ndarray,
    images: np.ndarray,
    mean: np.ndarray,
    deviations: np.ndarray,
    gain: float | None,
) -> _Interpolated:
    """Return kriging of the coefficients by the covariance of the shapes of stars that deviate from a mean."""
    numbers, filters = kriging.shape_numbers(mean, deviations)
    noise = kriging.star_noise(images, deviations, mean, filters, gain)
    noise = np.maximum(noise, _LEAST_NOISE * (numbers**2).mean(axis=0) + np.finfo(float).tiny)
    covariance = kriging.fit_kernel(places, numbers, noise, terms)
    star_noise = (noise / np.median(noise, axis=0)).mean(axis=1)
    polynomial, alpha, _ = kriging.krige(places, coefficients, terms, covariance, star_noise)
    return _Interpolated(polynomial, 1.0 / star_noise, np.tile(covariance, (coefficients.shape[1], 1)), alpha)


def _check_options(
    basis: str,
    interpolation: str,
    replacement: str,
    scale: float | None,
    clip_sigma: float | None,
    max_iterations: int,
    gain: float | None,
) -> None:
    """Raise ConfigError for an option that is none, or does not belong to the others."""
    for option, value, known in (
        ("basis", basis, BASES),
        ("interpolation", interpolation, INTERPOLATIONS),
        ("replacement", replacement, ("mean", "polynomial")),
    ):
        if value not in known:
            raise ConfigError(f"{option} = {value!r}: expected one of {', '.join(known)}")
    if scale is not None and (basis != "shapelets" or not (np.isfinite(scale) and scale > 0.0)):
        raise ConfigError(f"scale = {scale}: expected a positive number of pixels, for shapelets only")
    if clip_sigma is not None and not clip_sigma > 0.0:
        raise ConfigError(f"clip_sigma = {clip_sigma}: expected a positive number or None")
    if max_iterations < 1:
        raise ConfigError(f"max_iterations = {max_iterations}: expected at least 1")
    if gain is not None and not (np.isfinite(gain) and gain > 0.0):
        raise ConfigError(f"gain = {gain}: expected a number of electrons above 0, or None for no photon noise")


def _checked_gain(images: np.ndarray, gain: float | None) -> float | None:
    """Return the gain; None for stamps that are not in electrons, whose photon noise is unknown."""
    return gain if gain is not None and np.median(images.sum(axis=(1, 2))) * gain >= kriging.FEWEST_ELECTRONS else None


def weighted(rows: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
    """Return rows of equations times the roots of their weights, for least squares."""
    return rows if weights is None else rows * np.sqrt(weights)[:, None]


def _component_count(basis: str, n_components: Any, n_stars: int, limit: int, n_pixels: int) -> int:
    """Return how many components to make."""
    if basis == "pixels":
        if n_components is not None:
            raise ConfigError(f"n_components = {n_components}: expected None with basis = 'pixels', which has them all")
        return n_pixels
    most = limit if basis == "pca" else n_pixels - 1
    if n_components == "auto":
        return min(most, _MOST_COMPONENTS)
    count = COMPONENTS if n_components is None else n_components
    if isinstance(count, bool) or not isinstance(count, (int, np.integer)):
        raise ConfigError(f"n_components = {n_components!r}: expected a whole number, 'auto' or None")
    if not 1 <= count <= most:
        reason = f"the stars ({n_stars}) less one" if basis == "pca" else f"the pixels ({n_pixels}) less one"
        raise ConfigError(f"n_components = {count}: expected 1 to {most}, no more than {reason}")
    return int(count)
