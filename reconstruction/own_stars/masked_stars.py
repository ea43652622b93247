"""Bad pixels of star stamps: filled from the other stars, and stars of which too little is left."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.errors import DomainError
from ...core.quantization import dithered
from ...core.statistics import RMS_PER_MAD, finite_row_medians, masked_median, robust_rms
from ...core.threads import one_blas_thread
from ...measure.masked_moments import MOST_MASKED
from ...measure.pixel_masks import bad_pixels, copied_pixels, fill_symmetric
from ...measure.shapes import Shapes, measure_shapes
from ...measure.stamps import fourier_shifts, shift_masks
from ..psf_model.checks import as_extent
from ..psf_model.pixel_fields import Contrasts, SignalCovariance
from ..psf_model.polynomial import design_matrix, mapped

# Passes end when no centroid moves by more than this [pixel], a fifth of the error of a star of S/N 200.
_CONVERGED = 2e-3
# Most passes.
_MOST_PASSES = 10
# Passes with a new median star: later ones change it by less than its noise.
_MEDIAN_PASSES = 2
# Least part by which a step is expected to be shorter than the one before it: the rest is the masked part of the light.
_LEAST_FALL = 0.2
# Pixels beyond the stamp of the PSF on each side that shifts may bring in from the other side, or masks move.
_ROOM = 8
# Kernel (:data:`~.psf_model.covariance.COLUMNS`) of the pixels of stars, times what the stars show of it.
_EXPECTED_KERNEL = np.array([1.0, 0.7, 0.0, 2.7, 1.0])
# Degree of its trend.
_TREND_ORDER = 2
# Variance of a pixel is in proportion to its light, and at least that of this fraction of the brightest one's.
_FAINTEST = 1e-4
# Times that bad pixels are predicted anew from stars of which some were predicted: an error falls by the fraction of
# the stars in which a pixel is bad each time.
_PREDICTIONS = 3
# Fewest pixels of sky.
_FEWEST_SKY = 20
# Fraction of the good pixels, the farthest from the centre, that stands in where fewer are good.
_OUTERMOST = 0.25


def as_bad_pixels(images: np.ndarray, masks: Any) -> np.ndarray:
    """Return pixels of stamps that are masked, bad or copied (:mod:`~pachon.measure.pixel_masks`), bool [n, ny, nx]."""
    bad = bad_pixels(images)
    bad |= copied_pixels(np.where(bad, 0.0, images))
    if masks is None:
        return bad
    masked = np.asarray(masks)
    if masked.shape != images.shape or masked.dtype.kind != "b":
        raise DomainError(
            f"masks have shape {masked.shape} and type {masked.dtype}: expected bool {list(images.shape)} as the "
            "stamps, True is bad"
        )
    return bad | masked


def sky_of_stamps(images: np.ndarray, bad: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return median and rms noise of the good pixels beyond a radius from the centre [pixel], both [n].

    Where hardly any is good there, those of the farthest quarter of the good pixels; NaN without a good pixel.
    """
    y, x = np.indices(images.shape[1:]) - 0.5 * (np.array(images.shape[1:])[:, None, None] - 1.0)
    distance = np.hypot(x, y)
    outside = distance > radius
    pixels = dithered(images, bad)
    sky = np.where(bad[:, outside], np.nan, pixels.values[:, outside])
    sparse = (~bad[:, outside]).sum(axis=1) < min(_FEWEST_SKY, outside.sum())
    level, rms = np.full((2, len(images)), np.nan)
    level[~sparse] = finite_row_medians(sky[~sparse])
    rms[~sparse] = RMS_PER_MAD * finite_row_medians(np.abs(sky[~sparse] - level[~sparse, None]))
    for i in np.flatnonzero(sparse & ~bad.all(axis=(1, 2))):
        far = ~bad[i] & (distance >= np.quantile(distance[~bad[i]], 1.0 - _OUTERMOST))
        level[i] = np.median(pixels.values[i][far])
        rms[i] = robust_rms(pixels.values[i][far])
    return level, pixels.noise(rms)


def inner_pixels(shape: tuple[int, ...], size: int, wide: Shapes) -> tuple[slice, slice, slice]:
    """Return rows and columns of stamps of a shape (ny, nx) that have an influence on PSFs of a size, as an index.

    The rest is sky, which costs time. `wide` has the centroids of the stars. The middle stays the middle.
    """
    offsets = np.abs(np.stack([wide.x[wide.usable], wide.y[wide.usable]]))
    room = _ROOM + int(np.ceil(offsets.max(initial=0.0)))
    cuts = [max((n - size) // 2 - room, 0) for n in shape]
    return np.s_[:, cuts[0] : shape[0] - cuts[0], cuts[1] : shape[1] - cuts[1]]


@dataclass(frozen=True, eq=False)
class FilledStars:
    """Stars of which bad pixels are filled."""

    images: np.ndarray  #: [n, ny, nx]
    median_star: np.ndarray  #: [ny, nx], centred on pixel (ny // 2, nx // 2); zero where none has a bad pixel
    x: np.ndarray  #: centroids from the centre of the stamps [pixel], [n]; NaN where there is none
    y: np.ndarray
    usable: np.ndarray  #: stars that can be measured, [n] bool
    lost: np.ndarray  #: stars of which too little is left (`MOST_MASKED`), [n] bool

    def refilled(
        self,
        images: np.ndarray,
        bad: np.ndarray,
        masked: np.ndarray,
        psfs: np.ndarray,
        pixel_scale: float,
        weight_fwhm: float,
    ) -> FilledStars:
        """Return the stars with those of the indices `masked` filled by their PSFs, [n_masked, size, size].

        `images` and their `bad` pixels are [n, ny, nx].
        """
        sigma = weight_sigma(pixel_scale, weight_fwhm)
        filled, lost, usable, x, y = (v.copy() for v in (self.images, self.lost, self.usable, self.x, self.y))
        profiles = profiles_of_psfs(psfs, self.median_star, sigma)
        filled[masked], lost[masked] = fill_by_profiles(
            images[masked], bad[masked], profiles, x[masked], y[masked], sigma
        )
        near = np.stack([x[masked], y[masked]], axis=1)
        shapes = measure_shapes(filled[masked], pixel_scale, weight_fwhm, centers=near)
        x[masked], y[masked], usable[masked] = shapes.x, shapes.y, shapes.usable & ~lost[masked]
        return FilledStars(filled, self.median_star, x, y, usable, lost)

    def bad_within(self, bad: np.ndarray, chosen: np.ndarray, radius: float) -> np.ndarray:
        """Return whether stars of indices `chosen` have a bad pixel within a radius of their centroid [pixel]."""
        star, row, column = np.nonzero(bad[chosen])
        y, x = (
            pixel - 0.5 * (count - 1) - place[chosen][star]
            for pixel, count, place in zip((row, column), bad.shape[1:], (self.y, self.x), strict=True)
        )
        return np.bincount(star, np.hypot(x, y) < radius, len(chosen)) > 0.0


def fill_by_median_star(
    images: np.ndarray,
    bad: np.ndarray,
    pixel_scale: float,
    weight_fwhm: float,
    earlier: FilledStars | None = None,
) -> FilledStars:
    """Fill bad pixels of background-subtracted stamps [n, ny, nx] by the median star at each star's place and flux.

    Places depend on the filled pixels, so both are iterated, from the places and the median star of `earlier` ones
    where there are such. Stars that are lost hold the median star in their bad pixels; where no star can be measured,
    the first guess.
    """
    sigma = weight_sigma(pixel_scale, weight_fwhm)
    masked, lost = np.flatnonzero(bad.any(axis=(1, 2))), np.zeros(len(images), dtype=bool)
    if earlier is None:
        filled = fill_symmetric(images, bad)
        shapes = measure_shapes(filled, pixel_scale, weight_fwhm)
        x, y, usable, star = shapes.x, shapes.y, shapes.usable, np.zeros(images.shape[1:])
    else:
        filled, x, y = images.copy(), earlier.x.copy(), earlier.y.copy()
        usable, star = earlier.usable.copy(), earlier.median_star
        if not star.any():
            star = _median_star(images[usable], bad[usable], x[usable], y[usable], sigma)
        filled[masked] = fill_by_profiles(images[masked], bad[masked], star, x[masked], y[masked], sigma)[0]
    moving = masked
    places_before, steps_before = np.full((2, len(images), 2), np.nan)
    for number in range(_MOST_PASSES):
        if not (usable.any() and len(moving)):
            break
        if number < _MEDIAN_PASSES:
            star, moving = _median_star(filled[usable], bad[usable], x[usable], y[usable], sigma), masked
        places = np.stack([x[moving], y[moving]], axis=1)
        near_x, near_y = places.T
        filled[moving], lost[moving] = fill_by_profiles(images[moving], bad[moving], star, near_x, near_y, sigma)
        shapes = measure_shapes(filled[moving], pixel_scale, weight_fwhm, centers=places, tolerance=0.1 * _CONVERGED)
        x[moving], y[moving] = shapes.x, shapes.y
        usable[moving] = shapes.usable & ~lost[moving]
        steps = np.stack([shapes.x, shapes.y], axis=1) - places
        going = usable[moving] & (np.hypot(*steps.T) > _CONVERGED)
        moves, changes = places - places_before[moving], steps - steps_before[moving]
        places_before[moving], steps_before[moving] = places, steps
        moving, moves, changes, steps = moving[going], moves[going], changes[going], steps[going]
        # The fill pulls the centroid to where it was: steps fall like a series, whose sum is where they lead.
        squares = (moves**2).sum(axis=1)
        falls = np.divide(-(moves * changes).sum(axis=1), squares, out=np.ones(len(moving)), where=squares > 0.0)
        beyond = 1.0 / np.clip(falls, _LEAST_FALL, 1.0) - 1.0
        x[moving] += beyond * steps[:, 0]
        y[moving] += beyond * steps[:, 1]
    return FilledStars(filled, star, x, y, usable, lost)


def predict_from_others(
    stars: np.ndarray, bad: np.ndarray, positions: np.ndarray, noise: np.ndarray, pixel_noise: np.ndarray
) -> np.ndarray:
    """Predict centred stars each from the others, as far as these show that the PSF varies, [n, ny, nx].

    Parameters
    ----------
    stars, bad : array
        Stars of one flux and their bad pixels, which hold first guesses, [n, ny, nx].
    positions : array
        [n, 2].
    noise : array
        Variance of the stars' noise over that of the middle one, [n].
    pixel_noise : array
        Variance of the noise of the middle star's pixels, [ny, nx].
    """
    extent = as_extent(None, positions)
    terms = design_matrix(positions, extent, _TREND_ORDER)
    signal = SignalCovariance.of(_EXPECTED_KERNEL, mapped(positions, extent), terms)
    values, missing = stars.reshape(len(stars), -1), bad.reshape(len(stars), -1)
    with one_blas_thread():
        contrasts = Contrasts.of(signal.covariance, noise)
        mean = values.mean(axis=0)
        relative = np.maximum(mean, _FAINTEST * mean.max()) / pixel_noise.ravel()
        relative /= relative.max()
        variances = relative * contrasts.scale_of(values, relative, pixel_noise.ravel())[0]
        columns = np.flatnonzero(missing.any(axis=0))
        for _ in range(_PREDICTIONS - 1):
            of_columns = values[:, columns]
            predicted = of_columns - contrasts.differences(of_columns, variances[columns])
            values = values.copy()
            values[:, columns] = np.where(missing[:, columns], predicted, of_columns)
        return (values - contrasts.differences(values, variances)).reshape(stars.shape)


def fill_by_profiles(
    images: np.ndarray, bad: np.ndarray, profiles: np.ndarray, x: np.ndarray, y: np.ndarray, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fill bad pixels of stars by their profiles, and tell of which stars too little is left.

    Parameters
    ----------
    images, bad, profiles : array
        Background-subtracted stamps, their bad pixels, and the profile of each star, of any flux, centred on pixel
        (ny // 2, nx // 2); [n, ny, nx], profiles or one [ny, nx]. Stars have the flux of least squares in the good
        pixels under the weight.
    x, y : array
        Centroids from the centre of the stamps [pixel], [n]; NaN counts as the centre.
    sigma : float
        rms width of the weight of the moments [pixel].

    Returns
    -------
    tuple of array
        Filled stamps [n, ny, nx], and the stars that are lost (`MOST_MASKED`), [n] bool.
    """
    places = np.nan_to_num(np.stack([x, y], axis=1))
    at_places = fourier_shifts(profiles, *(places - _middle_pixel(images.shape[1:])).T)
    light = _weights(images.shape[1:], places, sigma) * at_places
    good_light = np.where(bad, 0.0, light)
    square, weighted_sum = ((good_light * values).sum(axis=(1, 2)) for values in (at_places, images))
    flux = np.divide(weighted_sum, square, out=np.zeros(len(images)), where=square > 0.0)
    filled = np.where(bad, flux[:, None, None] * at_places, images)
    core = np.where(at_places > 0.5 * at_places.max(axis=(1, 2), keepdims=True), at_places, 0.0)
    lost = np.zeros(len(images), dtype=bool)
    for star_light in (core, light):
        masked_light = np.where(bad, star_light, 0.0).sum(axis=(1, 2))
        lost |= masked_light > MOST_MASKED * star_light.sum(axis=(1, 2))
    return filled, lost


def apart_from_core(masks: np.ndarray, star: np.ndarray, sigma: float) -> np.ndarray:
    """Return which masks of defects leave their stars enough (`MOST_MASKED`), [n] bool.

    `masks` [n, ny, nx] and the median star [ny, nx] are centred on pixel (ny // 2, nx // 2); the weight of the moments
    has the rms width `sigma` [pixel].
    """
    light = _weight(star.shape, _middle_pixel(star.shape), sigma) * star
    core = np.where(star > 0.5 * star.max(), star, 0.0)
    fractions = [(masks * star_light).sum(axis=(1, 2)) / star_light.sum() for star_light in (core, light)]
    return np.asarray(np.max(fractions, axis=0) <= MOST_MASKED)


def profiles_of_psfs(psfs: np.ndarray, star: np.ndarray, sigma: float) -> np.ndarray:
    """Return PSFs [n, size, size] with the wings of the median star [ny, nx] around them, [n, ny, nx].

    They join by their light under the weight of rms width `sigma` [pixel]. All are centred on pixel (ny // 2, nx // 2).
    """
    rows, columns = (slice(n // 2 - psfs.shape[1] // 2, n // 2 + psfs.shape[1] // 2 + 1) for n in star.shape)
    weight = _weight(star.shape, _middle_pixel(star.shape), sigma)[rows, columns]
    flux = (weight * star[rows, columns]).sum() / (weight * psfs).sum(axis=(1, 2))
    profiles = np.repeat(star[None], len(psfs), axis=0)
    profiles[:, rows, columns] = psfs * flux[:, None, None]
    return profiles


def weight_sigma(pixel_scale: float, weight_fwhm: float) -> float:
    """Return the rms width of a Gaussian weight [pixel]."""
    return weight_fwhm / pixel_scale / 2.354820045


def _median_star(images: np.ndarray, bad: np.ndarray, x: np.ndarray, y: np.ndarray, sigma: float) -> np.ndarray:
    """Return the median of stars scaled to their light under the weight, centred on pixel (ny // 2, nx // 2)."""
    shape = images.shape[1:]
    middle = _middle_pixel(shape)
    shifts = middle - np.stack([x, y], axis=1)
    stars = fourier_shifts(images, *shifts.T)
    stars /= (_weight(shape, middle, sigma) * stars).sum(axis=(1, 2), keepdims=True)
    masks = shift_masks(bad, *shifts.T)
    masks[:, masks.all(axis=0)] = False  # a pixel that is bad in all stars has no better median
    return masked_median(stars, masks)


def _middle_pixel(shape: tuple[int, ...]) -> np.ndarray:
    """Return (x, y) of pixel (ny // 2, nx // 2) from the centre of the stamp [pixel]."""
    return np.array([n // 2 - (n - 1) / 2.0 for n in shape[::-1]])


def _weight(shape: tuple[int, ...], place: np.ndarray, sigma: float) -> np.ndarray:
    """Return a round Gaussian on pixels about a place from the centre of the stamp [pixel]."""
    return _weights(shape, place[None], sigma)[0]


def _weights(shape: tuple[int, ...], places: np.ndarray, sigma: float) -> np.ndarray:
    """Return a round Gaussian on pixels about each of places [n, 2] from the centre of the stamp [pixel]."""
    y, x = (np.arange(n) - (n - 1) / 2.0 - at[:, None] for n, at in zip(shape, places.T[::-1], strict=True))
    along_y, along_x = (np.exp(-0.5 * (distance / sigma) ** 2) for distance in (y, x))
    return np.asarray(along_y[:, :, None] * along_x[:, None])
