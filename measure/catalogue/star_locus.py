"""Selection of stars by the stellar locus of half-light radius against magnitude (Jee & Tyson 2011, sec. 4.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntFlag
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.number_text import counted
from ...core.point_plots import draw_points
from ...core.result import Result
from ...core.statistics import RMS_PER_MAD
from ...core.units import real_array, require_count, require_positive
from ..masked_moments import MOST_MASKED
from ..pixel_masks import bad_pixels
from ..stamps import center_masks, center_stamps
from .cutouts import cut_out, first_pixel
from .objects import DetectedObjects
from .pixel_checks import flagged
from .scattered_pixels import fill_stamps

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Relative width of the interval of half-light radii with the most objects, which is the locus.
_INTERVAL = 0.08
# Least number of its objects, over that of equally wide intervals on either side of it.
_CONTRAST = 3.0
# Multiples of its radius between which those intervals lie.
_SIDE = (1.15, 1.75)
# Least width of the locus, relative: the PSF varies over a CCD.
_LEAST_WIDTH = 0.01
#: Least part of the objects of one size that are alike: galaxies of one size have many ellipticities.
ALIKE = 0.6
# Largest deviation of the isophotal ellipticity of stars, by the change of the PSF over a CCD.
_ELLIPTICITY = 0.1
# Side of the stamps of stars [pixel].
STAMP_SIDE = 31
# Half-light radii of stars for which that side is right [pixel].
_USUAL_RADII = (1.5, 3.5)
# Side of other stamps [half-light radii].
_STAMP_RADII = 9.0
# Least side: fewer pixels leave no sky around a star.
_LEAST_SIDE = 21
# Largest side: more hold neighbours.
_MOST_SIDE = 101
# Margin of a stamp for the light that its Fourier shift wraps around [pixel].
_MARGIN = 8
# Stars that are shifted at a time, which bounds the memory.
_TOGETHER = 1024


class StarCut(IntFlag):
    """Reasons for the rejection of an object as a star; zero for a selected one.

    ``FLAGGED``: edge, saturated, blended or masked, or masked pixels in most of the core or of the stamp, or a stamp
    that reaches beyond the image. ``FAINT``: below the least S/N.
    ``SIZE``, ``WIDTH``, ``SHAPE``: half-light radius, FWHM and ellipticity apart from those of the locus.
    ``NEIGHBOUR``: another object nearby. ``DEFECT``: a stamp that is not that of a single star.
    """

    SELECTED = 0
    FLAGGED = 1
    FAINT = 2
    SIZE = 4
    WIDTH = 8
    SHAPE = 16
    NEIGHBOUR = 32
    DEFECT = 64


@check_arguments
@dataclass(frozen=True)
class LocusSearch:
    """Which objects determine the stellar locus.

    Parameters
    ----------
    bright_snr : float
        Least S/N of the objects.
    min_stars : int
        Fewest stars that make a locus.
    radius_range : (float, float), optional
        Half-light radii between which the locus is known to lie [pixel].

    Raises
    ------
    DomainError
        If a number is not positive.
    """

    bright_snr: float = 60.0
    min_stars: int = 10
    radius_range: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        require_positive(self.bright_snr, "bright_snr")
        for radius in self.radius_range or ():
            require_positive(radius, "radius_range")


#: Search of the locus in most images.
_USUAL_LOCUS = LocusSearch()


@dataclass(frozen=True, eq=False)
class StarSelection(Result):
    """Stars among n objects.

    Parameters
    ----------
    index : array of int
        The selected objects, [k].
    cuts : array of int
        :class:`StarCut` bits of every object, [n].
    half_light_radius, width : float
        Middle of the stellar locus and its standard deviation [pixel].
    positions : array
        Centroids of the selected stars [pixel], [k, 2].
    snr : array
        Flux over its error, [k].
    stamps : array
        The selected stars shifted to the centre of a pixel, background subtracted, in the unit of the image, [k, size,
        size].
    masks : array of bool, optional
        Pixels of the stamps without weight, filled from the star's other ones, [k, size, size]; None without any.
    """

    _table = ("index", "positions", "snr")
    _images = ("stamps",)

    index: np.ndarray
    cuts: np.ndarray
    half_light_radius: float
    width: float
    positions: np.ndarray
    snr: np.ndarray
    stamps: np.ndarray
    masks: NDArray[np.bool_] | None = None

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the places of the selected stars, coloured by the logarithm of their S/N."""
        title = f"{counted(len(self), 'star')}, half-light radius {self.half_light_radius:.3g} pixel"
        x, y = self.positions.T
        color = {"color": np.log10(self.snr), "color_label": "log10 of S/N"}
        return draw_points(ax, x, y, ("x [pixel]", "y [pixel]"), **color, equal=True, title=title)

    def __len__(self) -> int:
        return len(self.index)

    @classmethod
    def of_objects(
        cls, objects: DetectedObjects, cuts: np.ndarray, radii: tuple[float, float], light: np.ndarray, size: int
    ) -> StarSelection:
        """Return the objects without cuts as stars, on stamps of an image less its background, NaN without weight.

        `radii`: middle and standard deviation of their half-light radii [pixel].
        """
        index = np.flatnonzero(cuts == 0)
        x, y = objects.x[index], objects.y[index]
        stamps, weightless = centered_stamps(light, x, y, size)
        return cls(
            index=index,
            cuts=cuts,
            half_light_radius=radii[0],
            width=radii[1],
            positions=np.stack([x, y], axis=1),
            snr=objects.snr[index],
            stamps=stamps,
            masks=weightless if weightless.any() else None,
        )

    @classmethod
    def empty(cls, n_objects: int, half_light_radius: float, stamp_shape: tuple[int, ...]) -> StarSelection:
        """Return a selection of no star of n objects, with the half-light radius of the PSF."""
        return cls(
            index=np.empty(0, dtype=np.int64),
            cuts=np.full(n_objects, int(StarCut.SIZE), dtype=np.int32),
            half_light_radius=half_light_radius,
            width=np.nan,
            positions=np.empty((0, 2)),
            snr=np.empty(0),
            stamps=np.empty((0, *stamp_shape)),
        )

    @check_arguments
    def without(self, defects: NDArray[np.bool_]) -> StarSelection:
        """Return the selection without those of its stars that have defects, [k] bool."""
        if defects.shape != self.index.shape:
            raise DomainError(f"defects has shape {defects.shape}: expected {self.index.shape}, one for each star")
        cuts, good = self.cuts.copy(), ~defects
        cuts[self.index[defects]] |= StarCut.DEFECT
        return replace(
            self,
            index=self.index[good],
            cuts=cuts,
            positions=self.positions[good],
            snr=self.snr[good],
            stamps=self.stamps[good],
            masks=None if self.masks is None else self.masks[good],
        )

    @check_arguments
    def completeness(self, is_star: ArrayLike | NDArray[np.bool_]) -> float:
        """Return the fraction of true stars of sufficient S/N that were selected; NaN where there are none.

        `is_star` [n] says which objects are stars in truth.
        """
        true = self._truth(is_star) & (self.cuts & StarCut.FAINT == 0)
        return float((self.cuts[true] == 0).mean()) if true.any() else np.nan

    @check_arguments
    def purity(self, is_star: ArrayLike | NDArray[np.bool_]) -> float:
        """Return the fraction of selected objects that are stars in truth; NaN where none were selected."""
        true = self._truth(is_star)
        return float(true[self.index].mean()) if len(self) else np.nan

    def _truth(self, is_star: ArrayLike | NDArray[np.bool_]) -> np.ndarray:
        true = np.asarray(is_star)
        if true.shape != self.cuts.shape or true.dtype.kind != "b":
            raise DomainError(f"is_star has shape {true.shape} and type {true.dtype}: expected bool {self.cuts.shape}")
        return true


@check_arguments
def select_stars(
    objects: DetectedObjects,
    image: ArrayLike,
    *,
    min_snr: float = 30.0,
    n_sigma: float = 4.0,
    max_ellipticity: float = 0.1,
    isolation: float = 12.0,
    locus: LocusSearch = _USUAL_LOCUS,
    size: int = STAMP_SIDE,
    mask: ArrayLike | NDArray[np.bool_] | None = None,
) -> StarSelection:
    """Select isolated stars by the stellar locus, and cut out their stamps.

    The locus is the mode of the half-light radii of bright objects, its width follows from their median absolute
    deviation. FWHM and ellipticity are compared with the medians of the objects of the locus.

    Parameters
    ----------
    objects : DetectedObjects
        As of :func:`~pachon.detect_objects`.
    image : array
        The image on which they were detected, [ny, nx]; their background is subtracted here.
    min_snr : float
        Least S/N of stars.
    n_sigma : float
        Largest deviations of half-light radius and FWHM [standard deviations of the locus and of the noise].
    max_ellipticity : float
        Largest deviation of the isophotal ellipticity.
    isolation : float
        Least distance to the nearest other object [pixel].
    locus : LocusSearch
        Objects that determine the locus: ten or more of an S/N of 60 by default, of any size.
    size : int
        Side of the stamps, odd [pixel].
    mask : array, optional
        [ny, nx], not zero for pixels without weight; those that are not finite, or -1e29 or less, are among them.

    Returns
    -------
    StarSelection
        Stamps and positions go to :meth:`pachon.PsfModel.fit` and :meth:`pachon.FocalPlaneStars.from_table` as they
        are.

    Raises
    ------
    DomainError
        If the image has another shape, an option is out of range, or there is no stellar locus: too few objects of one
        size, or of many ellipticities, which are galaxies.
    """
    pixels = real_array(image, "image: expected real numbers [ny, nx]")
    if pixels.shape != objects.segmentation.shape:
        raise DomainError(f"image has shape {pixels.shape}: expected {objects.segmentation.shape}, that of the objects")
    masked = flagged(mask, pixels.shape)
    if masked.shape != pixels.shape:
        raise DomainError(f"mask has shape {masked.shape}: expected {pixels.shape}, that of the image")
    bad = bad_pixels(pixels) | masked
    if require_count(size, "size", 1, 4096) % 2 == 0:
        raise DomainError(f"size = {size}: expected an odd number of pixels")
    for name, value in (
        ("min_snr", min_snr),
        ("n_sigma", n_sigma),
        ("max_ellipticity", max_ellipticity),
    ):
        require_positive(value, name)
    snr = np.where(np.isfinite(objects.half_light_radius), objects.snr, 0.0)
    radius = np.where(np.isfinite(objects.half_light_radius), objects.half_light_radius, 0.0)
    cuts = np.zeros(len(objects), dtype=np.int32)
    spoilt = spoilt_stars(bad, objects, size)
    cuts[(objects.flags != 0) | spoilt | ~np.isfinite(objects.fwhm)] |= StarCut.FLAGGED
    cuts[~(snr >= min_snr)] |= StarCut.FAINT
    bright = (cuts == 0) & (snr >= locus.bright_snr)
    if locus.radius_range is not None:
        low, high = locus.radius_range
        bright &= (radius >= low) & (radius <= high)
    center, width = _stellar_locus(radius[bright], locus.min_stars)
    noise = 1.0 / np.maximum(snr, 1.0)
    cuts[~(np.abs(radius - center) < n_sigma * np.hypot(width, center * noise))] |= StarCut.SIZE
    of_locus = bright & (cuts == 0)
    fwhm = median_and_sigma(objects.fwhm[of_locus])
    cuts[~(np.abs(objects.fwhm - fwhm[0]) < n_sigma * np.hypot(fwhm[1], fwhm[0] * noise))] |= StarCut.WIDTH
    e1, e2 = (e - np.median(e[of_locus]) for e in (objects.e1, objects.e2))
    deviation = np.hypot(e1, e2)
    alike, count = int((deviation[of_locus] < _ELLIPTICITY).sum()), int(of_locus.sum())
    if alike < ALIKE * count:
        raise DomainError(
            f"no stellar locus: {alike} of {count} bright objects of a half-light radius of {center:.3g} pixels have "
            f"one ellipticity, expected at least {int(np.ceil(ALIKE * count))}"
        )
    cuts[~(deviation < max_ellipticity)] |= StarCut.SHAPE
    cuts[objects.neighbour_distance < isolation] |= StarCut.NEIGHBOUR
    light = np.where(bad, np.nan, pixels - objects.background)
    return StarSelection.of_objects(objects, cuts, (center, width), light, size)


def spoilt_stars(bad: np.ndarray, objects: DetectedObjects, size: int) -> np.ndarray:
    """Return objects whose stamps reach beyond the image, or of which most of the core or of the stamp is bad."""
    x, y = objects.x, objects.y
    beyond = cut_out(np.zeros(bad.shape, dtype=bool), x, y, size, True).any(axis=(1, 2))
    stamps = cut_out(bad, x, y, size, True)
    dx, dy = ((np.arange(size) + first_pixel(at, size)[:, None] - at[:, None]) for at in (x, y))
    radius = np.fmax(objects.half_light_radius, 1.0)
    core = np.hypot(dx[:, None, :], dy[:, :, None]) <= radius[:, None, None]
    of_core = (core & stamps).sum(axis=(1, 2)) > MOST_MASKED * core.sum(axis=(1, 2))
    return np.asarray(beyond | of_core | (stamps.mean(axis=(1, 2)) > MOST_MASKED))


def _stellar_locus(radius: np.ndarray, least: int) -> tuple[float, float]:
    """Return middle and standard deviation of the stellar locus of half-light radii of bright objects."""
    if len(radius) < least:
        raise DomainError(f"no stellar locus: {len(radius)} bright objects without flags, expected at least {least}")
    ordered = np.sort(radius)
    inside = np.searchsorted(ordered, ordered * (1.0 + _INTERVAL), side="right") - np.arange(len(ordered))
    first, count = int(inside.argmax()), int(inside.max())
    center, width = median_and_sigma(ordered[first : first + count])
    nearness = np.abs(np.log(ordered / center))
    beside = (nearness > np.log(_SIDE[0])) & (nearness < np.log(_SIDE[1]))
    galaxies = max((beside & (ordered > center)).sum(), (beside & (ordered < center)).sum())
    expected = galaxies * np.log1p(_INTERVAL) / np.log(_SIDE[1] / _SIDE[0])
    if count < max(least, _CONTRAST * expected):
        raise DomainError(
            f"no stellar locus: {count} of {len(radius)} bright objects within {100.0 * _INTERVAL:g} % of a half-light "
            f"radius of {center:.3g} pixels, expected at least {max(least, int(np.ceil(_CONTRAST * expected)))}"
        )
    for _ in range(5):
        near = ordered[np.abs(ordered - center) < min(3.0 * max(width, _LEAST_WIDTH * center), _INTERVAL * center)]
        center, width = median_and_sigma(near)
    return center, max(width, _LEAST_WIDTH * center)


def stamp_side(half_light_radius: float) -> int:
    """Return the side of the stamps of stars of a half-light radius [pixel], odd: :data:`STAMP_SIDE` of most images."""
    if np.isnan(half_light_radius) or _USUAL_RADII[0] <= half_light_radius <= _USUAL_RADII[1]:
        return STAMP_SIDE
    side = 2 * int(0.5 * _STAMP_RADII * half_light_radius) + 1
    return min(max(side, _LEAST_SIDE), _MOST_SIDE)


def median_and_sigma(values: np.ndarray) -> tuple[float, float]:
    """Return the median, and the standard deviation by the median absolute deviation."""
    middle = float(np.median(values))
    return middle, RMS_PER_MAD * float(np.median(np.abs(values - middle)))


def centered_stamps(image: np.ndarray, x: np.ndarray, y: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return stars shifted to the centre of their middle pixel, and the pixels without weight, [n, size, size] each.

    Pixels of the image that are NaN have no weight: they are shifted as :func:`~.scattered_pixels.fill_stamps` fills
    them.
    """
    side = size + 2 * _MARGIN
    stamps, weightless = np.empty((len(x), size, size)), np.zeros((len(x), size, size), dtype=bool)
    for first in range(0, len(x), _TOGETHER):
        rows = slice(first, first + _TOGETHER)
        around = cut_out(image, x[rows], y[rows], side, 0.0)
        dx, dy = (at[rows] - first_pixel(at[rows], side) - 0.5 * (side - 1) for at in (x, y))
        bad = np.isnan(around)
        if bad.any():
            masked = np.flatnonzero(bad.any(axis=(1, 2)))
            around[masked] = fill_stamps(around[masked], bad[masked], dx[masked], dy[masked])[0]
            weightless[first + masked] = center_masks(bad[masked], dx[masked], dy[masked], size)
        stamps[rows] = center_stamps(around, dx, dy, size, normalize=False)
    return stamps, weightless
