"""Checks of the input of a PSF model: stars, masks, weights, positions."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...core.errors import ConfigError, DomainError
from ...core.units import real_array
from ...measure.pixel_masks import bad_pixels
from ...measure.star_flux import star_fluxes
from .polynomial import Extent, term_count

#: Signal-to-noise ratio above which softened weights grow no more.
SOFTENING = 100.0
# Largest distance of a star from the middle of the extent, in its sides: powers of more have no digits left.
_FARTHEST = 1e3


def as_stamps(stamps: Any, masks: Any = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the stamps as finite float64, masked pixels zero, and the masks as bool, both [n, ny, nx].

    Pixels that are not finite, or -1e29 or less, are masked besides those of `masks`.
    """
    images = real_array(stamps, "stamps: expected real numbers [n, ny, nx]")
    if images.ndim != 3 or len(images) < 2:
        raise DomainError(f"stamps have shape {images.shape}: expected [n, ny, nx] with at least 2 stars")
    bad = bad_pixels(images)
    lightless = bad.all(axis=(1, 2))
    if lightless.any():
        raise DomainError(f"stamps[{lightless.argmax()}] has pixels that are not finite, and no others")
    if masks is not None or bad.any():
        bad = _checked_masks(masks, bad)
        images = np.where(bad, 0.0, images)
    dark = images.sum(axis=(1, 2)) <= 0.0
    if dark.any():
        pixels = images.reshape(len(images), -1)
        dark &= ~(star_fluxes(pixels, ~bad.reshape(pixels.shape) if bad.any() else None) > 0.0)
    if dark.any():
        unmasked = " outside its mask" if bad.any() else ""
        raise DomainError(f"stamps[{dark.argmax()}] has no light{unmasked}: expected a star")
    return images, bad


def _checked_masks(masks: Any, lightless: np.ndarray) -> np.ndarray:
    """Return the masks as bool [n, ny, nx], True where a pixel is not to be used; lightless ones are not."""
    bad = np.zeros(lightless.shape, dtype=bool) if masks is None else np.asarray(masks)
    if bad.shape != lightless.shape or bad.dtype.kind != "b":
        raise DomainError(
            f"masks have shape {bad.shape} and type {bad.dtype}: expected bool {list(lightless.shape)} as the stamps, "
            "True is bad"
        )
    bad = bad | lightless
    if bad.all():
        raise DomainError("masks: every pixel of every star is masked, no star is left")
    blind = bad.all(axis=(1, 2))
    if blind.any():
        raise DomainError(f"masks[{blind.argmax()}] masks the whole star: expected it to be left out")
    never = bad.all(axis=0)
    if never.any():
        y, x = np.argwhere(never)[0]
        raise DomainError(f"masks: pixel [{y}, {x}] is masked in every star, so that the PSF is unknown there")
    return bad


def as_weights(weights: Any, n_stars: int) -> np.ndarray | None:
    """Return one weight for each star, or None where none are given."""
    if weights is None:
        return None
    values = real_array(weights, f"weights: expected {n_stars} numbers, one for each star")
    if values.shape != (n_stars,):
        raise DomainError(f"weights have shape {values.shape}: expected [{n_stars}], one for each star")
    wrong = ~(np.isfinite(values) & (values >= 0.0))
    if wrong.any():
        first = wrong.argmax()
        raise DomainError(f"weights[{first}] = {values[first]}: expected a finite number that is not negative")
    return values


def snr_weights(kind: str, snr: np.ndarray) -> np.ndarray | None:
    """Return weights of stars in the polynomials from their signal-to-noise ratios S, [n]; None for equal ones.

    ``snr`` is S^2, the inverse variance of the noise; ``softened`` is 1/(1/S^2 + 1/100^2), since the residual of the
    polynomial itself does not fall with brightness. Another kind raises ConfigError.
    """
    if kind == "equal":
        return None
    if kind not in ("snr", "softened"):
        raise ConfigError(f"weights = {kind!r}: expected one of equal, snr, softened")
    return snr**2 if kind == "snr" else 1.0 / (snr**-2.0 + SOFTENING**-2.0)


def as_extent(extent: Any, positions: np.ndarray) -> Extent:
    """Return the given extent, or that of the positions, as four floats."""
    if extent is None:
        (xmin, ymin), (xmax, ymax) = positions.min(axis=0).tolist(), positions.max(axis=0).tolist()
        if xmin == xmax or ymin == ymax:
            name, place = ("x", xmin) if xmin == xmax else ("y", ymin)
            raise DomainError(f"positions: all stars are at {name} = {place:g}; expected stars all over the image")
    else:
        try:
            xmin, xmax, ymin, ymax = (float(v) for v in extent)
        except (TypeError, ValueError) as error:
            raise DomainError(f"extent = {extent!r}: expected (xmin, xmax, ymin, ymax)") from error
    if not (xmin < xmax and ymin < ymax and np.all(np.isfinite([xmin, xmax, ymin, ymax]))):
        raise DomainError(
            f"extent = {(xmin, xmax, ymin, ymax)}: expected (xmin, xmax, ymin, ymax), minima below maxima"
        )
    away = np.abs(positions - [0.5 * (xmin + xmax), 0.5 * (ymin + ymax)]) / [xmax - xmin, ymax - ymin]
    if away.max() > _FARTHEST:
        star = int(away.max(axis=1).argmax())
        x, y = positions[star].tolist()
        raise DomainError(
            f"positions: star {star} at ({x:g}, {y:g}) is {away.max():.3g} times the extent away from its middle; "
            f"expected at most {_FARTHEST:g}"
        )
    return float(xmin), float(xmax), float(ymin), float(ymax)


def check_terms(terms: np.ndarray, order: int, positions: np.ndarray, weights: np.ndarray | None = None) -> None:
    """Raise an error if the stars do not determine the polynomials of total degree `order`.

    `terms` [n, n_terms] are those of the polynomials at the stars; stars of weight zero count as absent.
    """
    if weights is not None:
        terms, positions = terms[weights > 0.0], positions[weights > 0.0]
    n_stars, n_terms = terms.shape
    if n_stars < n_terms:
        raise ConfigError(f"order = {order}: its {n_terms} polynomial terms need as many stars, {n_stars} given")
    if np.linalg.matrix_rank(terms) < n_terms:
        pair = coincident_positions(positions)
        twice = f" ({_pair_text(positions, pair)})" if pair else ""
        raise DomainError(
            f"positions: the {n_stars} stars do not determine the {term_count(order)} polynomial terms{twice}"
        )


def check_distinct_positions(positions: np.ndarray, interpolation: str) -> None:
    """Raise an error for two stars at one position: a noise-free process cannot pass through both."""
    pair = coincident_positions(positions)
    if pair:
        raise DomainError(
            f"positions: {_pair_text(positions, pair)}; expected places apart for interpolation = {interpolation!r}"
        )


def coincident_positions(positions: np.ndarray) -> tuple[int, int] | None:
    """Return the indices of the first two stars at one position, or None."""
    first: dict[tuple[float, float], int] = {}
    for index, (x, y) in enumerate(positions.tolist()):
        earlier = first.setdefault((x, y), index)
        if earlier != index:
            return earlier, index
    return None


def _pair_text(positions: np.ndarray, pair: tuple[int, int]) -> str:
    x, y = positions[pair[0]].tolist()
    return f"stars {pair[0]} and {pair[1]} are both at ({x:.9g}, {y:.9g})"
