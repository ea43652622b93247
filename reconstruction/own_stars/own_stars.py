"""From the stars of any image to a PSF model, and how well it predicts stars that were held out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from astropy.units import Quantity
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.random_streams import stream
from ...core.units import positive_angle, real_array, require_seed
from ...measure.shapes import Shapes, fwhm, measure_shapes
from ...measure.stamps import center_stamps
from ...measure.star_selection import StarFlag, flag_stars, require_stars
from ..psf_model import kriging
from ..psf_model.checks import as_extent
from ..psf_model.model import PsfModel
from ..psf_model.polynomial import as_positions
from .candidates import CANDIDATES, choose_candidate
from .result import OwnStars

#: Fewest stars that a model is made of.
FEWEST_STARS = 5
#: Parts of the stars that are held out one after the other.
FOLDS = 5
# Beyond this distance from the centre, as a fraction of the side, a stamp is sky.
_SKY = 0.4
# Rim of a stamp that a shift may bring in from the other side [pixel].
_RIM = 2


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
    extent: ArrayLike | None = None,
    seed: int = 1,
    **options: Any,
) -> OwnStars:
    """Centre stars, leave out those with defects, model the PSF, and predict each star from others.

    The kind of model is chosen by the stars that are held out: kriging of pixels, unless pixels of order 0 to 2 or
    principal components, with the noise of each star, predict them better by two standard errors.

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
    extent : tuple of float, optional
        (xmin, xmax, ymin, ymax) of the CCD in the unit of the positions; that of the stars by default.
    seed : int
        Of the parts that are held out.
    **options
        Options of :meth:`~.PsfModel.fit`, `recipe` and its keys among them, for a kind of model without a choice.

    Raises
    ------
    DomainError
        If stamps are too small, fewer than five stars are left, or the model cannot be made.
    """
    images, places = real_array(stamps, "stamps: expected real numbers [n, ny, nx]").copy(), as_positions(positions)
    if images.ndim != 3 or len(images) != len(places):
        raise DomainError(
            f"stamps of shape {images.shape}, {len(places)} positions: expected [n, ny, nx] and as many positions"
        )
    scale = positive_angle(pixel_scale, "pixel_scale")
    if not (np.isfinite(gain) and gain > 0.0):
        raise DomainError(f"gain = {gain}: expected a number of electrons above 0")
    side = min(images.shape[1:])
    if size is None:
        size = max(side - 2 * _RIM - 1 + (side % 2), 0)
    if size % 2 == 0 or not 9 <= size <= side:
        raise DomainError(f"size = {size}: expected an odd number of pixels from 9 to {side}, the side of the stamps")
    y, x = np.indices(images.shape[1:]) - 0.5 * (np.array(images.shape[1:])[:, None, None] - 1.0)
    sky = images[:, np.hypot(x, y) > _SKY * side]
    middle = np.nanmedian(sky, axis=1)
    if background:
        images -= middle[:, None, None]
    rms = 1.4826 * np.nanmedian(np.abs(sky - middle[:, None]), axis=1)
    wide = measure_shapes(images, scale, 0.25 * side * scale)
    weight = float(np.nanmedian(fwhm(images[wide.usable], scale))) if wide.usable.any() else np.nan
    if not np.isfinite(weight):
        raise DomainError(f"none of {len(images)} stamps has a star in its middle")
    first = measure_shapes(images, scale, weight)
    centred = center_stamps(images, first.x, first.y, size=size, normalize=False)
    shapes = measure_shapes(centred, scale, weight)
    flags = flag_stars(centred, np.where(rms > 0.0, rms, 1.0), gain=gain, saturation=saturation).flags
    flags = np.where(shapes.usable, flags, flags | StarFlag.UNUSABLE)
    snr = _signal_to_noise(centred, rms, gain)
    used = (flags == 0) & (snr >= min_snr)
    require_stars(used, flags, FEWEST_STARS)

    def fit(chosen: np.ndarray, kind: Mapping[str, Any]) -> PsfModel:
        return PsfModel.fit(centred[chosen], places[chosen], extent=span, **{"gain": gain, **kind})

    def predict(kind: Mapping[str, Any]) -> np.ndarray:
        predicted = np.empty((len(which), size, size))
        for part in parts:
            rest = np.setdiff1d(np.arange(len(which)), part)
            predicted[part] = fit(which[rest], kind).at(places[which[part]])
        return predicted

    span = as_extent(extent, places[used])
    which = np.flatnonzero(used)
    parts = np.array_split(stream(require_seed(seed), "held-out stars").permutation(len(which)), min(FOLDS, len(which)))
    if options:
        name, kind = "given", options
        predicted = predict(kind)
    else:
        name, predicted = choose_candidate(predict, centred[used], gain)
        kind = CANDIDATES[name]
    psf = predicted.mean(axis=0)
    variance = (weight / scale / 2.354820045) ** 2
    deviations = (centred[used] / centred[used].sum(axis=(1, 2), keepdims=True) - psf).reshape(len(which), -1)
    filters = kriging.shape_numbers(psf, deviations, variance)[1]
    # Shape numbers are twice the changes of e and of the logarithm of the size.
    sigma = 0.5 * np.sqrt(kriging.star_noise(centred[used], deviations, psf, filters, gain))
    held_out = _spread(measure_shapes(predicted, scale, weight), used)
    good = centred[used]
    stamps_used = good / good.sum(axis=(1, 2), keepdims=True)
    sigmas = np.sqrt((sigma[:, :2] ** 2).mean(axis=1)), sigma[:, 2]
    model = fit(which, kind)
    return OwnStars(
        model, places, snr, flags, used, shapes, held_out, stamps_used, predicted, *sigmas, scale, weight, name
    )


def _signal_to_noise(stamps: np.ndarray, rms: np.ndarray, gain: float) -> np.ndarray:
    """Return the S/N of PSF photometry, [n], with the median star as the PSF; NaN where there is no light."""
    flux = stamps.sum(axis=(1, 2))
    flux = np.where(flux > 0.0, flux, np.nan)
    psf = np.nanmedian(stamps / flux[:, None, None], axis=0)
    area = psf.sum() ** 2 / (psf**2).sum()
    return flux / np.sqrt(flux / gain + area * rms**2)


def _spread(shapes: Shapes, used: np.ndarray) -> Shapes:
    """Return shapes of some stars as those of all, NaN for the others."""
    values = {}
    for name, value in vars(shapes).items():
        whole = np.full(len(used), -1 if value.dtype.kind in "iu" else np.nan, dtype=value.dtype)
        whole[used] = value
        values[name] = whole
    return Shapes(**values)
