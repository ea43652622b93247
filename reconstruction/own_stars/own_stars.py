"""From the stars of any image to a PSF model, and how well it predicts stars that were held out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np
from astropy.units import Quantity
from numpy.typing import ArrayLike, NDArray

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.number_text import counted
from ...core.random_streams import stream
from ...core.statistics import finite_median
from ...core.units import positive_angle, real_array, require_positive, require_seed
from ...measure.pixel_masks import clipped_stars, fill_symmetric
from ...measure.shapes import fwhm, measure_shapes
from ...measure.stamps import center_masks, decenter_masks, shift_to_middle
from ...measure.star_flux import fitted_fluxes, median_star, with_unit_flux
from ...measure.star_selection import StarFlag, flag_stars, require_stars
from ..psf_model import kriging
from ..psf_model.checks import as_extent
from ..psf_model.colour import as_colours
from ..psf_model.model import PsfModel, StarOptions
from ..psf_model.polynomial import as_positions
from .masked_stars import (
    FilledStars,
    apart_from_core,
    as_bad_pixels,
    fill_by_median_star,
    inner_pixels,
    predict_from_others,
    sky_of_stamps,
    weight_sigma,
)
from .result import OwnStars

#: Name of the model where no options are given.
DEFAULT_KIND = "kriging of pixels"
#: Fewest stars that a model is made of.
FEWEST_STARS = 5
#: Parts of the stars that are held out one after the other.
FOLDS = 5
#: Beyond this distance from the centre, as a fraction of the side, a stamp is sky.
SKY = 0.4
# Rim of a stamp that a shift may bring in from the other side [pixel].
_RIM = 2
# Least side of a PSF [pixel].
_LEAST_SIZE = 9
# Defects that may be masked in a star that stays.
_MASKABLE = StarFlag.NEIGHBOUR | StarFlag.COSMIC_RAY


@check_arguments
def fit_own_stars(
    stamps: ArrayLike,
    positions: ArrayLike,
    pixel_scale: float | Quantity,
    *,
    size: int | None = None,
    min_snr: float = 20.0,
    gain: float = 1.0,
    saturation: float | None = None,
    background: bool = True,
    masks: NDArray[np.bool_] | None = None,
    seed: int = 1,
    **options: Unpack[StarOptions],
) -> OwnStars:
    """Centre stars, mask or leave out defects, model the PSF, and predict each star from others.

    The model is kriging of pixels, which learns from the stars how smooth the PSF is, a constant included, or that of
    the options. A fifth of the stars at a time is predicted by the others; by kriging of pixels under the covariances
    and the response of the pixels to the shape of all stars, when the predictions are read, by other models with a fit
    of its own.

    Parameters
    ----------
    stamps, positions : array
        Stars [n, ny, nx] and places [n, 2], as :func:`~pachon.load_stars` reads them.
    pixel_scale : float or Quantity
        Side of a pixel [rad].
    size : int, optional
        Side of the PSF [pixel], odd; the largest that the stamps allow by default.
    min_snr : float
        Least S/N of a star.
    gain : float
        Electrons in a unit of the stamps.
    saturation : float, optional
        Level from which on a pixel is saturated; by default one at which three pixels of a star are equal.
    background : bool
        Whether to subtract the median of the outer pixels of each stamp. Wings go with it: at stamps of 6 FWHM the
        adaptive T of a Kolmogorov or Moffat PSF falls by 0.3 to 0.5 %, at 10 FWHM by 0.05 %. Of stamps whose sky is
        subtracted, False keeps them.
    masks : array of bool, optional
        [n, ny, nx], True for pixels to ignore, besides those that hold no light: not finite, or -1e29 or less (-1e30 of
        SExtractor), copies of dead columns (:func:`~pachon.measure.pixel_masks.copied_pixels`), and neighbours and
        cosmic rays of stars. They are left out of the sky, of fluxes and of noise, and filled before a star is
        centred: by the median star, then by what the other stars predict at its place. A star is lost only where they
        hold more than half of its light above half of its peak, or under the weight of the moments: with the flag of
        its neighbour or cosmic ray, else ``MASKED``.
    seed : int
        Of the parts that are held out.
    **options
        Options of :meth:`~.PsfModel.fit`, such as `recipe`, and `colour` of the stars, [n]; the `extent` of the CCD is
        by default that of the stars.

    Raises
    ------
    DomainError
        If stamps are too small, fewer than five stars are left, or the model cannot be made.
    """
    extent, colour = options.get("extent"), options.get("colour")
    model_options: dict[str, Any] = {key: value for key, value in options.items() if key not in ("extent", "colour")}
    raw_images, places = real_array(stamps, "stamps: expected real numbers [n, ny, nx]"), as_positions(positions)
    if raw_images.ndim != 3 or len(raw_images) != len(places):
        raise DomainError(
            f"stamps of shape {raw_images.shape}, {len(places)} positions: expected [n, ny, nx] and as many positions"
        )
    colours = None if colour is None else np.broadcast_to(as_colours(colour, len(places)), (len(places),))
    bad = as_bad_pixels(raw_images, masks)
    if bad.size and bad.all():
        raise DomainError(f"no pixel of {len(bad)} stamps has weight: all are masked, or no numbers")
    scale = positive_angle(pixel_scale, "pixel_scale")
    require_positive(gain, "gain", "electrons")
    if math.isnan(min_snr):
        raise DomainError("min_snr = nan: expected the least S/N of a star")
    side = min(raw_images.shape[1:])
    if size is None and side < _LEAST_SIZE + 2 * _RIM:
        raise DomainError(f"stamps of {side} pixels along a side: expected at least {_LEAST_SIZE + 2 * _RIM}, or size")
    if size is None:
        size = side - 2 * _RIM - 1 + (side % 2)
    if size % 2 == 0 or not _LEAST_SIZE <= size <= side:
        limits = f"{_LEAST_SIZE} to {side}, the side of the stamps"
        raise DomainError(f"size = {size}: expected an odd number of pixels from {limits}")

    def less_sky(bad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        level, rms = sky_of_stamps(raw_images, bad, SKY * side)
        sky = np.nan_to_num(level)[:, None, None] if background else 0.0
        return np.where(bad, 0.0, raw_images - sky)[inner], rms

    def masks_of(filled: FilledStars, chosen: np.ndarray) -> np.ndarray:
        return center_masks(bad[inner][chosen], filled.x[chosen], filled.y[chosen], size)

    def centre(filled: FilledStars, stars: Any = slice(None)) -> np.ndarray:
        return shift_to_middle(filled.images[stars], np.stack([filled.x[stars], filled.y[stars]], axis=1), size)

    def select(filled: FilledStars, flags: np.ndarray, apart: np.ndarray, centred: np.ndarray) -> _CentredStars:
        flags = np.where(filled.usable, flags, flags | StarFlag.UNUSABLE)
        flags = np.where(filled.lost, StarFlag.MASKED, flags)
        flux, snr = _flux_and_snr(centred, rms, gain)
        used = ((flags == 0) | (apart & ((flags & ~_MASKABLE) == 0))) & (snr >= min_snr)
        return _CentredStars(filled, centred, flags, apart, flux, snr, used)

    def predict_used(stars: _CentredStars, masks: np.ndarray) -> np.ndarray:
        flux, snr = stars.flux[stars.used], stars.snr[stars.used]
        unit = stars.images[stars.used] / flux[:, None, None]
        middle = int(np.argsort(snr, kind="stable")[len(snr) // 2])
        light = np.maximum(unit.mean(axis=0), 0.0) / (flux[middle] * gain)
        pixel_noise = (rms[stars.used][middle] / flux[middle]) ** 2 + light
        return predict_from_others(unit, masks, places[stars.used], (snr[middle] / snr) ** 2, pixel_noise)

    def fit(chosen: np.ndarray) -> PsfModel:
        span = as_extent(extent, places[stars.used])
        return PsfModel.fit(
            stars.images[chosen],
            places[chosen],
            extent=span,
            colour=colours_of(chosen),
            **({"gain": gain} | model_options),
        )

    def colours_of(chosen: np.ndarray) -> np.ndarray | None:
        return None if colours is None else colours[chosen]

    def refit() -> np.ndarray:
        predicted = np.empty((len(used_indices), size, size))
        for held_out_indices in parts:
            fitted_indices = np.setdiff1d(np.arange(len(used_indices)), held_out_indices)
            predicted_indices = used_indices[held_out_indices]
            part_model = fit(used_indices[fitted_indices])
            predicted[held_out_indices] = part_model.at(places[predicted_indices], colour=colours_of(predicted_indices))
        return predicted

    inner = np.s_[:, :, :]
    images, rms = less_sky(bad)
    filled = fill_symmetric(images, bad)
    wide = measure_shapes(filled, scale, 0.25 * side * scale)
    inner = inner_pixels(images.shape[1:], size, wide)
    images, filled = images[inner], filled[inner]
    widths = np.full(len(images), np.nan)
    widths[wide.usable] = fwhm(filled[wide.usable], scale)
    weight = finite_median(widths)
    if not np.isfinite(weight):
        raise DomainError(f"none of {counted(len(images), 'stamp')} has a star in its middle")

    def fill(earlier: FilledStars | None = None) -> FilledStars:
        filled_stars = fill_by_median_star(images, bad[inner], scale, weight, earlier)
        complete = wide.usable & ~filled_stars.lost
        if not complete.any():
            require_stars(complete, np.where(filled_stars.lost, StarFlag.MASKED, StarFlag.UNUSABLE), FEWEST_STARS)
        return filled_stars

    filled_stars = fill()
    centred = centre(filled_stars)
    selection = flag_stars(centred, np.where(rms > 0.0, rms, 1.0), gain=gain, saturation=saturation)
    clipped = np.zeros(len(images), dtype=bool) if saturation is not None else clipped_stars(raw_images, bad)
    flags = np.where(clipped, selection.flags | StarFlag.SATURATED, selection.flags)
    none_apart = np.zeros(len(images), dtype=bool)
    stars = select(filled_stars, flags, none_apart, centred)
    apart = stars.with_defects_apart(selection.masks, weight_sigma(scale, weight))
    if apart.any():
        defects = selection.masks & apart[:, None, None]
        bad = bad | decenter_masks(defects, filled_stars.x, filled_stars.y, bad.shape[1:])
        images, rms = less_sky(bad)
        filled_stars = fill(filled_stars)
        stars = select(filled_stars, flags, apart, centre(filled_stars))
    _require_used(stars, min_snr, gain)
    masked = np.flatnonzero(stars.used & bad.any(axis=(1, 2)))
    if len(masked):
        psfs = predict_used(stars, masks_of(stars.filled, stars.used))
        psfs = psfs[np.searchsorted(np.flatnonzero(stars.used), masked)]
        filled_stars = stars.filled.refilled(images, bad[inner], masked, psfs, scale, weight)
        # Bad pixels farther out than the width are no part of it.
        changed = masked[wide.usable[masked] & filled_stars.bad_within(bad[inner], masked, weight / scale)]
        if len(changed):
            widths[changed] = fwhm(filled_stars.images[changed], scale)
        weight = finite_median(widths[wide.usable & ~filled_stars.lost])
        centred = stars.images.copy()
        centred[masked] = centre(filled_stars, masked)
        stars = select(filled_stars, stars.flags, apart, centred)
    shapes = measure_shapes(stars.images, scale, weight)
    stars = stars.usable_ones(shapes.usable)
    _require_used(stars, min_snr, gain)
    used = stars.used
    _require_places_apart(places[used])
    used_indices = np.flatnonzero(used)
    parts = np.array_split(
        stream(require_seed(seed), "held-out stars").permutation(len(used_indices)), min(FOLDS, len(used_indices))
    )
    good = stars.images[used]
    used_masks = masks_of(stars.filled, used)
    model = fit(used_indices)
    unit_stars, flux = with_unit_flux(good)
    kriging.require_electrons(flux * gain, gain)
    return OwnStars(
        model,
        places,
        stars.snr,
        stars.flags,
        used,
        shapes,
        unit_stars,
        used_masks,
        flux * gain,
        parts,
        None if model.interpolation.predicts_left_out else refit(),
        scale,
        weight,
        "given" if model_options else DEFAULT_KIND,
    )


@dataclass(frozen=True, eq=False)
class _CentredStars:
    """Stars of which bad pixels are filled, centred, with their defects."""

    filled: FilledStars  #: before they are centred
    images: np.ndarray  #: [n, size, size]
    flags: np.ndarray  #: :class:`~.StarFlag` bits, [n]
    apart: np.ndarray  #: stars whose only defects are apart from their core, and masked, bool [n]
    flux: np.ndarray  #: [n]
    snr: np.ndarray  #: [n]
    used: np.ndarray  #: bool [n]

    def with_defects_apart(self, defects: np.ndarray, sigma: float) -> np.ndarray:
        """Return the stars whose only defects, bool [n, size, size], are apart from their core, bool [n].

        `sigma` is that of the weight of the moments.
        """
        good = self.flags == 0
        with_defects = ~good & ((self.flags & ~_MASKABLE) == 0)
        if not with_defects.any():
            return np.zeros(len(self.flags), dtype=bool)
        # Where hardly any star is without a neighbour, those of the others are at many places, and no part of a median.
        compared = self.images[good if good.sum() >= FEWEST_STARS else good | with_defects]
        star = median_star(compared.reshape(len(compared), -1)).reshape(compared.shape[1:])
        return with_defects & apart_from_core(defects, star, sigma)

    def usable_ones(self, usable: np.ndarray) -> _CentredStars:
        """Return the stars with those flagged, and left out, that have no shape."""
        flags = np.where(usable | self.filled.lost, self.flags, self.flags | StarFlag.UNUSABLE)
        return replace(self, flags=flags, used=self.used & usable)


def _require_used(stars: _CentredStars, min_snr: float, gain: float) -> None:
    """Raise DomainError, with the reasons, where fewer than :data:`FEWEST_STARS` are used."""
    faint = (stars.snr < min_snr) & (stars.flags == 0)
    reason = ""
    if faint.any():
        electrons = float(np.median(stars.images[faint].sum(axis=(1, 2)))) * gain
        reason = (
            f"{int(faint.sum())} of S/N below min_snr = {min_snr:g}, of {electrons:.3g} electrons in the median by "
            f"gain = {gain:g}"
        )
    require_stars(stars.used, np.where(stars.used, 0, stars.flags), FEWEST_STARS, reason)


def _require_places_apart(places: np.ndarray) -> None:
    """Raise DomainError where stars have one place [n, 2]: their doubles would predict those that are held out."""
    first = np.unique(places, axis=0, return_index=True)[1]
    doubles = np.setdiff1d(np.arange(len(places)), first)
    if len(doubles) and len(first) > 1:
        x, y = places[doubles[0]]
        raise DomainError(
            f"positions: {len(doubles)} of {counted(len(places), 'star')} stand there twice, such as that at "
            f"({x:g}, {y:g}): expected each once"
        )


def _flux_and_snr(stamps: np.ndarray, rms: np.ndarray, gain: float) -> tuple[np.ndarray, np.ndarray]:
    """Return flux and S/N of PSF photometry, [n], with the median star as the PSF; NaN where there is no light."""
    pixels = stamps.reshape(len(stamps), -1)
    psf = median_star(pixels)
    if not psf.any():
        return np.full(len(stamps), np.nan), np.full(len(stamps), np.nan)
    # The sum over a wide stamp has ten times the noise of the fit.
    flux, squares = fitted_fluxes(pixels, None, psf)
    flux = np.where(flux > 0.0, flux, np.nan)
    return flux, flux / np.sqrt(flux / gain + rms**2 / squares)
