"""The fit of a PSF model: checks, stars without outliers, basis and interpolation over the CCD."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ...core.errors import ConfigError, DomainError, PachonError, attempt
from ...core.threads import one_blas_thread
from . import kriging
from .basis import FittedBasis
from .checks import as_extent, as_stamps, as_weights
from .clean_stars import CleanStars, cleaned_stars
from .cross_validation import choose_by_cross_validation
from .interpolation import FittedInterpolation, StarField
from .outliers import SigmaClipping
from .polynomial import as_positions, design_matrix, term_count
from .recipe import Recipe
from .shape_noise import ShapeNoise

_Model = TypeVar("_Model", bound="ModelFit")


@dataclass(frozen=True, eq=False, repr=False)
class ModelFit:
    """Attributes of :class:`~.PsfModel`, which describes them."""

    basis: FittedBasis
    interpolation: FittedInterpolation
    coefficients: np.ndarray
    unexplained: np.ndarray
    rejected: np.ndarray


class CcdStars(NamedTuple):
    """Stars of a CCD, as :meth:`~.PsfModel.fit` takes them."""

    stamps: Any
    positions: Any
    weights: Any = None
    masks: Any = None
    extent: Any = None
    colour: Any = None


def fit_stars(
    kind: type[_Model],
    ccds: Sequence[CcdStars],
    recipe: Recipe,
    *,
    gain: float | None,
    clipping: SigmaClipping | None,
) -> list[_Model | PachonError]:
    """Fit basis and interpolation of a recipe to the stars of each CCD, with the error of a CCD in its place.

    Arguments and errors are those of :meth:`~.PsfModel.fit`. No CCD changes a byte of another.
    """
    with one_blas_thread():
        fields = [attempt(_star_field, stars, recipe, gain=gain, clipping=clipping) for stars in ccds]
        good = [field[0] for field in fields if not isinstance(field, PachonError)]
        interpolations = iter(recipe.interpolation.fit_each(good))
    models: list[_Model | PachonError] = []
    for field in fields:
        if isinstance(field, PachonError):
            models.append(field)
            continue
        stars, unexplained, rejected = field
        interpolation = next(interpolations)
        if isinstance(interpolation, PachonError):
            models.append(interpolation)
        else:
            models.append(kind(stars.basis, interpolation, stars.coefficients, unexplained, rejected))
    return models


def _star_field(
    ccd: CcdStars, recipe: Recipe, *, gain: float | None, clipping: SigmaClipping | None
) -> tuple[StarField, np.ndarray, np.ndarray]:
    """Return the stars of a CCD in the basis of a recipe, what it leaves of each, and its rejected pixels, [n] both."""
    stamps, positions, weights, masks, extent, colour = ccd
    images, bad = as_stamps(stamps, masks)
    n_stars, ny, nx = images.shape
    points = as_positions(positions)
    if len(points) != n_stars:
        raise DomainError(f"positions: {len(points)} given, expected one for each of the {n_stars} stamps")
    _check_gain(gain)
    basis, interpolation = recipe.basis, recipe.interpolation
    count = basis.component_count(n_stars, ny * nx)
    weights = recipe.star_weights() if weights is None else weights
    star_weights = None if isinstance(weights, str) else as_weights(weights, n_stars)
    interpolation.check_stars(points, weights)
    fixed_order = interpolation.fixed_order
    automatic = fixed_order is None or basis.automatic
    orders = interpolation.orders(n_stars)
    needed_order = orders[-1] if fixed_order is None else fixed_order
    by_noise = isinstance(weights, str) or (automatic and star_weights is None)
    span = as_extent(extent, points)
    terms = design_matrix(points, span, max(orders[-1], needed_order))
    colours = None if colour is None or recipe.colour is None else recipe.colour.of_stars(colour, n_stars)
    smooth_terms = terms[:, : term_count(interpolation.smooth_order)]
    if colours is not None:
        # A star of an extreme colour is no outlier.
        coloured_terms = np.hstack([smooth_terms, colours.terms(points, span)])
        if np.linalg.matrix_rank(coloured_terms) == coloured_terms.shape[1]:
            smooth_terms = coloured_terms

    def basis_of(stars: CleanStars, weights: np.ndarray | None, count: int) -> FittedBasis:
        return basis.fit(stars, (ny, nx), count, weights)

    interpolation.check_terms(terms[:, : term_count(needed_order)], needed_order, points, star_weights)
    stars = cleaned_stars(images, bad, smooth_terms, clipping)
    masked = bad if bad.any() else None
    electrons = _electrons(stars.flux, gain, needed=interpolation.needs_noise)
    chosen_order, basis_weights = orders[-1], None
    if by_noise or automatic:
        mean = stars.mean.reshape(ny, nx)
        shapes = ShapeNoise.of(electrons, stars.deviations, mean, masked)
        if automatic:
            counts = np.arange(1, count + 1) if basis.automatic else np.array([count])
            chosen_order, count = choose_by_cross_validation(
                stars, terms, shapes, orders, counts, basis_of, star_weights
            )
        if by_noise:
            basis_weights = shapes.star_weights(stars.deviations, terms[:, : term_count(chosen_order)])
            stars = stars.about_weighted_mean(basis_weights)
            star_weights = basis_weights
    order = chosen_order if fixed_order is None else fixed_order
    fitted_basis = basis_of(stars, basis_weights, count)
    coefficients, unexplained = fitted_basis.project(stars)
    order_terms = terms[:, : term_count(order)]
    field = StarField(
        points, span, order, order_terms, coefficients, star_weights, fitted_basis, electrons, masked, colours
    )
    return field, unexplained, stars.rejected.sum(axis=1)


def _check_gain(gain: float | None) -> None:
    """Raise ConfigError for a gain that is out of range."""
    if gain is not None and not (np.isfinite(gain) and gain > 0.0):
        raise ConfigError(f"gain = {gain}: expected a number of electrons above 0, or None for no photon noise")


def _electrons(flux: np.ndarray, gain: float | None, *, needed: bool) -> np.ndarray | None:
    """Return the electrons of stars, [n]; None for stamps that are not in electrons, whose photon noise is unknown.

    DomainError for such ones where photon noise is needed; none is asked for without a gain.
    """
    if gain is None:
        return None
    if needed:
        kriging.require_electrons(flux * gain, gain)
    return flux * gain if np.median(flux) * gain >= kriging.FEWEST_ELECTRONS else None
