"""From the stars of any image to a PSF model, and how well it predicts stars that were held out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np
from astropy.units import Quantity
from numpy.typing import ArrayLike, NDArray

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.random_streams import stream
from ...core.statistics import finite_median
from ...core.units import positive_angle, real_array, require_seed
from ...measure.pixel_masks import fill_symmetric
from ...measure.shapes import Shapes, fwhm, measure_shapes
from ...measure.stamps import center_masks, center_stamps, decenter_masks
from ...measure.star_selection import StarFlag, flag_stars, require_stars
from ..psf_model import kriging
from ..psf_model.checks import as_extent
from ..psf_model.colour import as_colours
from ..psf_model.model import PsfModel, StarOptions
from ..psf_model.polynomial import as_positions
from .masked_stars import (
    apart_from_core,
    as_bad_pixels,
    fill_by_median_star,
    fill_by_profiles,
    inner_pixels,
    profiles_of_psfs,
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
# Beyond this distance from the centre, as a fraction of the side, a stamp is sky.
_SKY = 0.4
# Rim of a stamp that a shift may bring in from the other side [pixel].
_RIM = 2
# Times that bad pixels are filled anew by the model of stars that were filled: the error of a pixel falls by the
# fraction of the stars in which it is bad each time.
_MODEL_PASSES = 2
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
    and the response of the pixels to the shape of all stars, by other models with a fit of its own.

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
        Level from which on a pixel is saturated.
    background : bool
        Whether to subtract the median of the outer pixels of each stamp.
    masks : array of bool, optional
        [n, ny, nx], True for pixels to ignore, besides those that hold no light: not finite, or -1e29 or less (-1e30 of
        SExtractor), copies of dead columns (:func:`~pachon.measure.pixel_masks.copied_pixels`), and neighbours and
        cosmic rays of stars. They are left out of the sky, of fluxes and of noise, and filled before a star is
        centred: by the median star, then by the model at the star's place. A star is lost only where they hold
        more than half of its light above half of its peak, or under the weight of the moments: with the flag of its
        neighbour or cosmic ray, else ``MASKED``.
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
    if not (np.isfinite(gain) and gain > 0.0):
        raise DomainError(f"gain = {gain}: expected a number of electrons above 0")
    side = min(raw_images.shape[1:])
    if size is None:
        size = max(side - 2 * _RIM - 1 + (side % 2), 0)
    if size % 2 == 0 or not 9 <= size <= side:
        raise DomainError(f"size = {size}: expected an odd number of pixels from 9 to {side}, the side of the stamps")

    def less_sky(bad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        level, rms = sky_of_stamps(raw_images, bad, _SKY * side)
        sky = np.nan_to_num(level)[:, None, None] if background else 0.0
        return np.where(bad, 0.0, raw_images - sky)[inner], rms

    def select(filled: np.ndarray, lost: np.ndarray, earlier: _CentredStars | None = None) -> _CentredStars:
        first = measure_shapes(filled, scale, weight)
        centred = center_stamps(filled, first.x, first.y, size=size, normalize=False)
        if earlier is None:
            noise = np.where(rms > 0.0, rms, 1.0)
            selection = flag_stars(centred, noise, gain=gain, saturation=saturation)
            flags, defects, apart = selection.flags, selection.masks, np.zeros(len(centred), dtype=bool)
        else:
            flags, defects, apart = earlier.flags, earlier.defects, earlier.apart
        shapes = measure_shapes(centred, scale, weight)
        flags = np.where(shapes.usable, flags, flags | StarFlag.UNUSABLE)
        flags = np.where(lost, StarFlag.MASKED, flags)
        snr = _signal_to_noise(centred, rms, gain)
        used = ((flags == 0) | (apart & ((flags & ~_MASKABLE) == 0))) & (snr >= min_snr)
        return _CentredStars(first, centred, shapes, flags, snr, used, defects, apart)

    def fit(chosen: np.ndarray, **further_options: Any) -> PsfModel:
        span = as_extent(extent, places[stars.used])
        return PsfModel.fit(
            stars.images[chosen],
            places[chosen],
            extent=span,
            colour=colours_of(chosen),
            **({"gain": gain} | model_options | further_options),
        )

    def fit_again(model: PsfModel | None, *, refined: bool = False) -> PsfModel:
        """Fit the used stars by the covariances of an earlier model of nearly the same ones, or searched from there."""
        interpolation = None if model is None else model.interpolation
        if not isinstance(interpolation, kriging.FittedKriging):
            return fit(np.flatnonzero(stars.used))
        earlier_covariances = kriging.KrigingOfCovariances(
            order=interpolation.order, covariances=interpolation.covariances, refined=refined
        )
        return fit(np.flatnonzero(stars.used), interpolation=earlier_covariances)

    def colours_of(chosen: np.ndarray) -> np.ndarray | None:
        return None if colours is None else colours[chosen]

    def predict(model: PsfModel) -> np.ndarray:
        predicted = np.empty((len(used_indices), size, size))
        for held_out_indices in parts:
            interpolation = model.interpolation.without(held_out_indices, model.coefficients)
            if interpolation is None:
                fitted_indices = np.setdiff1d(np.arange(len(used_indices)), held_out_indices)
                part_model = fit(used_indices[fitted_indices])
            else:
                part_model = replace(model, interpolation=interpolation)
            predicted_indices = used_indices[held_out_indices]
            predicted[held_out_indices] = part_model.at(places[predicted_indices], colour=colours_of(predicted_indices))
        return predicted

    inner = np.s_[:, :, :]
    images, rms = less_sky(bad)
    filled, lost = fill_symmetric(images, bad), np.zeros(len(images), dtype=bool)
    wide = measure_shapes(filled, scale, 0.25 * side * scale)
    inner = inner_pixels(images.shape[1:], size, wide)
    images, filled = images[inner], filled[inner]
    widths = np.full(len(images), np.nan)
    widths[wide.usable] = fwhm(filled[wide.usable], scale)
    weight = finite_median(widths)
    if not np.isfinite(weight):
        raise DomainError(f"none of {len(images)} stamps has a star in its middle")

    def width_of(complete: np.ndarray, filled: np.ndarray) -> float:
        """Return the median width of complete stars; only those with bad pixels differ from the stars before."""
        changed = complete & bad.any(axis=(1, 2))
        widths[changed] = fwhm(filled[changed], scale)
        return finite_median(widths[complete])

    def fill() -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        filled, median_star, lost = fill_by_median_star(images, bad[inner], scale, weight)
        complete = wide.usable & ~lost
        if not complete.any():
            require_stars(complete, np.where(lost, StarFlag.MASKED, StarFlag.UNUSABLE), FEWEST_STARS)
        return filled, median_star, lost, width_of(complete, filled)

    if bad.any():
        filled, median_star, lost, weight = fill()
    stars = select(filled, lost)
    stars = stars.with_defects_apart(weight_sigma(scale, weight))
    if stars.apart.any():
        first = stars.first
        bad = bad | decenter_masks(stars.defects, first.x, first.y, bad.shape[1:])
        images, rms = less_sky(bad)
        filled, median_star, lost, weight = fill()
        stars = select(filled, lost, stars)
    _require_used(stars, min_snr, gain)
    filling_model: PsfModel | None = None
    if bad.any():
        masked = np.asarray(bad.any(axis=(1, 2)))
        complete = wide.usable & ~lost
        for _ in range(_MODEL_PASSES):
            filling_model = fit_again(filling_model)
            psfs = filling_model.at(places[masked], colour=colours_of(masked))
            sigma = weight_sigma(scale, weight)
            filled[masked], lost[masked] = fill_by_profiles(
                images[masked],
                bad[inner][masked],
                profiles_of_psfs(psfs, median_star, sigma),
                stars.first.x[masked],
                stars.first.y[masked],
                sigma,
            )
            weight = width_of(complete, filled)
            stars = select(filled, lost, stars)
            _require_used(stars, min_snr, gain)
    used = stars.used
    used_indices = np.flatnonzero(used)
    parts = np.array_split(
        stream(require_seed(seed), "held-out stars").permutation(len(used_indices)), min(FOLDS, len(used_indices))
    )
    good = stars.images[used]
    used_masks = center_masks(bad[inner][used], stars.first.x[used], stars.first.y[used], size)
    weightless = used_masks if used_masks.any() else None
    model = fit_again(filling_model, refined=True)
    predicted = predict(model)
    psf = predicted.mean(axis=0)
    stamps_used = good / good.sum(axis=(1, 2), keepdims=True)
    deviations = (stamps_used - psf).reshape(len(used_indices), -1)
    filters = kriging.shape_numbers(psf, deviations, weight_sigma(scale, weight) ** 2)[1]
    # Shape numbers are twice the changes of e and of the logarithm of the size.
    sigma = 0.5 * np.sqrt(kriging.star_noise(good, deviations, psf, filters, gain, weightless))
    held_out = _spread(measure_shapes(predicted, scale, weight), used)
    sigmas = np.sqrt((sigma[:, :2] ** 2).mean(axis=1)), sigma[:, 2]
    return OwnStars(
        model,
        places,
        stars.snr,
        stars.flags,
        used,
        stars.shapes,
        held_out,
        stamps_used,
        predicted,
        used_masks,
        *sigmas,
        scale,
        weight,
        "given" if model_options else DEFAULT_KIND,
    )


@dataclass(frozen=True, eq=False)
class _CentredStars:
    """Stars of which bad pixels are filled, centred, with their defects."""

    first: Shapes  #: of the stamps before they are centred
    images: np.ndarray  #: [n, size, size]
    shapes: Shapes  #: of the centred stars
    flags: np.ndarray  #: :class:`~.StarFlag` bits, [n]
    snr: np.ndarray  #: [n]
    used: np.ndarray  #: bool [n]
    defects: np.ndarray  #: pixels of neighbours and cosmic rays, bool [n, size, size]
    apart: np.ndarray  #: stars whose only defects are apart from their core, and masked, bool [n]

    def with_defects_apart(self, sigma: float) -> _CentredStars:
        """Return the stars with those marked whose defects are apart from their core; `sigma` as of the moments."""
        good = self.images[self.flags == 0]
        with_defects = (self.flags != 0) & ((self.flags & ~_MASKABLE) == 0)
        if not len(good) or not with_defects.any():
            return self
        median_star = np.median(good / good.sum(axis=(1, 2), keepdims=True), axis=0)
        apart = with_defects & apart_from_core(self.defects, median_star, sigma)
        return replace(self, apart=apart, defects=self.defects & apart[:, None, None])


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


def _signal_to_noise(stamps: np.ndarray, rms: np.ndarray, gain: float) -> np.ndarray:
    """Return the S/N of PSF photometry, [n], with the median star as the PSF; NaN where there is no light."""
    total = stamps.sum(axis=(1, 2))
    psf = np.nanmedian(stamps / np.where(total > 0.0, total, np.nan)[:, None, None], axis=0)
    psf /= psf.sum()
    squares = (psf**2).sum()
    # The sum over a wide stamp has ten times the noise of the fit.
    flux = (stamps * psf).sum(axis=(1, 2)) / squares
    flux = np.where(flux > 0.0, flux, np.nan)
    return flux / np.sqrt(flux / gain + rms**2 / squares)


def _spread(shapes: Shapes, used: np.ndarray) -> Shapes:
    """Return shapes of some stars as those of all, NaN for the others."""
    values = {}
    for name, value in vars(shapes).items():
        all_stars = np.full(len(used), -1 if value.dtype.kind in "iu" else np.nan, dtype=value.dtype)
        all_stars[used] = value
        values[name] = all_stars
    return Shapes(**values)
