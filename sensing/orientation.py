"""Check of the orientation of stamps against its mirror image and its quarter turns.

A wavefront is free to take any image of a donut near the axis. Away from it, vignetting, shadows of obstructions and
what the design itself does to a wavefront point to the axis, and stamps that are mirrored or turned about fit worse at
the same field angles. Fields and stamps that are mirrored together fit as well as before: no image tells that.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.number_text import counted
from ..core.plotting import BLUE, axes_at, styled
from ..core.result import Result
from ..core.threads import one_blas_thread, thread_count
from ..models.telescope import Telescope
from ..raytrace.rays import Projection
from ..wavefront.psf.light import Light
from .fit_star import coarse_fit
from .frames import along_camera, stamp_matrix
from .inputs import ObservedStar, ObservedStars
from .light import Instrument
from .model import DonutModel
from .noise import faint_level, measured_noise, smoothed
from .stamps import Pixels
from .terms import WavefrontTerms

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Axes of columns and rows of stamps, the given ones first: four turns, and their mirror images.
ORIENTATIONS = ("x,y", "y,x", "-x,y", "x,-y", "-y,-x", "-x,-y", "-y,x", "y,-x")
#: Terms of the wavefront: those up to the fourth degree are enough for shadows.
_TERMS = WavefrontTerms.of(np.arange(4, 12))
#: Cells across the pupil.
_CELLS = 40
#: Least gain in chi-square, over that of a pixel of the best fit, with which another orientation is better.
_LEAST_GAIN = 100.0
#: Least gain as a fraction of the number of pixels, where the best fit is good.
_LEAST_FRACTION = 0.02
#: The same of a poor fit, whose residuals are correlated over many pixels.
_LEAST_FRACTION_POOR = 0.1
#: Chi-square a pixel above which a fit is poor.
_POOR = 1.5
#: Least gains with which a first donut settles that the orientation is right.
_SETTLED = 3.0
#: Least light of a donut, as a fraction of the brightest one's.
_LEAST_LIGHT = 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class OrientationCheck(Result):
    """How well donuts fit in the orientation given, mirrored and turned about by quarters.

    Attributes
    ----------
    stamp_axes : ndarray of str, shape [8]
        Axes that columns and rows of the stamps would run along, in terms of those given; ``x,y`` is as given.
    excess : ndarray, shape [8]
        Chi-square over that of the best orientation, in units of the best one's chi-square of a pixel.
    chi2 : ndarray, shape [8]
        Chi-square a pixel.
    donuts : ndarray of int
        Indices of the donuts that were fitted.
    n_pixels : int
        Pixels of them, as many as are independent of each other.
    """

    _table = ("stamp_axes", "excess", "chi2")

    stamp_axes: np.ndarray
    excess: np.ndarray
    chi2: np.ndarray
    donuts: np.ndarray
    n_pixels: int

    @property
    def best(self) -> str:
        """Axes of the best orientation, ``x,y`` where the one given is the best."""
        return str(self.stamp_axes[int(np.argmin(self.excess))])

    @property
    def threshold(self) -> float:
        """Excess from which on an orientation is worse than the best one."""
        poor = self.n_pixels > 0 and self.chi2.min() > _POOR
        return max(_LEAST_GAIN, (_LEAST_FRACTION_POOR if poor else _LEAST_FRACTION) * self.n_pixels)

    @property
    def doubtful(self) -> bool:
        """Whether another orientation fits significantly better than the one given."""
        return bool(self.excess[0] > self.threshold)

    @property
    def decided(self) -> bool:
        """Whether every other orientation fits significantly worse than the best one."""
        return int((self.excess <= self.threshold).sum()) == 1

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw chi-square a pixel of the eight orientations."""
        with styled():
            figure, axes = axes_at(ax, 5.0, 3.5)
            axes.bar(range(len(self.chi2)), self.chi2, color=BLUE)
            axes.set_xticks(range(len(self.chi2)), [f"({names})" for names in self.stamp_axes], rotation=45)
            axes.set_xlabel("axes of the stamps, as given first")
            axes.set_ylabel("chi-square a pixel")
        return figure

    def _label(self) -> str:
        state = "another fits better" if self.doubtful else "confirmed" if self.decided else "not decided"
        return f"orientation of stamps: {state}, best {self.best}, {counted(len(self.donuts), 'donut')}"


@check_arguments
def check_orientation(
    telescope: Telescope,
    images: ArrayLike | Sequence[ArrayLike],
    fields: ArrayLike,
    wavelength: ArrayLike | Light | None = None,
    *,
    sky_variance: ArrayLike | None = None,
    model: DonutModel | None = None,
    mask: NDArray[np.bool_] | Sequence[NDArray[np.bool_]] | None = None,
    projection: Projection = "zemax",
    donuts: int = 3,
    threads: int | None = None,
) -> OrientationCheck:
    """Compare the fit of donuts with that of their mirror images and quarter turns.

    Parameters
    ----------
    telescope, images, fields, wavelength, sky_variance, model, mask, projection, threads
        As in :func:`~pachon.fit_donuts`. Stamps are fitted as rays, smoothed to coarse pixels.
    donuts : int
        Largest number of donuts that are fitted, from the one farthest from the axis on; fewer where they settle that
        the orientation is right.

    Returns
    -------
    OrientationCheck
    """
    model = _rays_alone((model or DonutModel()).with_light(wavelength))
    observed = ObservedStars.of(images, fields, sky_variance, mask, projection)
    instrument = Instrument.of(telescope, model, _TERMS)
    shifts = model.detector.shifts(len(observed))
    strength = model.air.strengths(instrument.seeing, 1)[0]
    telling_donuts = _telling(observed, donuts)
    chi2, n_pixels = np.empty((2, len(ORIENTATIONS), 0))
    check = _compared(chi2, n_pixels, telling_donuts[:0])
    with one_blas_thread(), ThreadPoolExecutor(thread_count(threads)) as pool:
        for count, index in enumerate(telling_donuts, start=1):
            fits = _fits(instrument, observed.star(int(index)), float(shifts[index]), strength, pool)
            chi2, n_pixels = np.column_stack([chi2, fits[:, 0]]), np.column_stack([n_pixels, fits[:, 1]])
            check = _compared(chi2, n_pixels, telling_donuts[:count])
            if np.sort(check.excess)[1] > _SETTLED * check.threshold and not check.excess[0]:
                break
    return check


def _fits(instrument: Instrument, star: ObservedStar, defocus: float, strength: float, pool: Executor) -> np.ndarray:
    """Return chi-square and number of independent pixels of one donut in all orientations, NaN and 0 without a fit."""
    none = np.tile([np.nan, 0.0], (len(ORIENTATIONS), 1))
    if np.hypot(*star.field) > instrument.telescope.field_limit:
        return none
    try:
        light = instrument.light(star.direction, defocus)
    except DomainError:
        return none
    used = np.isfinite(star.image) & ~star.masked
    image, variance, unit = np.where(used, star.image, 0.0), star.variance, 1.0
    if not star.known_noise and used.any():
        smooth = smoothed(image, used)
        level = faint_level(smooth, used)
        image = np.where(used, image - level, 0.0)
        noise = measured_noise(image, smooth - level, used, level)
        variance, unit = np.full(image.shape, noise.sky), noise.photon
    planes = (image / unit, variance / unit**2, used)

    def fitted(stamp_axes: str) -> tuple[float, float]:
        matrix = stamp_matrix(stamp_axes)
        turned_image, turned_variance, turned_used = (along_camera(plane, matrix) for plane in planes)
        fit = coarse_fit(instrument, light, Pixels(turned_image, turned_variance, turned_used), strength)
        return (np.nan, 0.0) if fit is None else (fit.loss, fit.n_independent)

    return np.array(list(pool.map(fitted, ORIENTATIONS)))


def _rays_alone(model: DonutModel) -> DonutModel:
    """Return the model of donuts of rays, each by itself in a seeing that is not known."""
    air, rims = replace(model.air, fwhm=None, atmosphere=None), replace(model.rims, search=False)
    return replace(model, air=air, diffraction=False, neighbours=False, rims=rims, n_pupil=_CELLS)


def _compared(chi2: np.ndarray, n_pixels: np.ndarray, donuts: np.ndarray) -> OrientationCheck:
    """Return the check of chi-squares of orientations and donuts, shape [8, n]; NaN where a fit has no result."""
    per_pixel = chi2 / np.where(n_pixels > 0, n_pixels, 1)
    fitted = np.isfinite(per_pixel).any(axis=0)
    per_pixel, pixels = per_pixel[:, fitted], n_pixels.max(axis=0)[fitted]
    # No result in one orientation is as bad as the worst one.
    per_pixel = np.where(np.isfinite(per_pixel), per_pixel, np.nanmax(per_pixel, axis=0, initial=0.0))
    least = np.maximum(per_pixel.min(axis=0), 1.0)
    total = (per_pixel / least * pixels).sum(axis=1)
    count = int(pixels.sum())
    return OrientationCheck(
        stamp_axes=np.array(ORIENTATIONS),
        excess=total - total.min(),
        chi2=(per_pixel * pixels).sum(axis=1) / max(count, 1),
        donuts=donuts[fitted],
        n_pixels=count,
    )


def _telling(observed: ObservedStars, most: int) -> np.ndarray:
    """Return indices of the donuts farthest from the axis that are not much fainter than the brightest."""
    light = np.array([np.nansum(np.where(m, 0.0, i)) for i, m in zip(observed.images, observed.masked, strict=True)])
    bright = np.flatnonzero(light > _LEAST_LIGHT * light.max())
    return bright[np.argsort(-np.hypot(*observed.fields[bright].T), kind="stable")][:most]
