"""Obscuration that the holes of donuts show, beside that of the light of the telescope.

Both edges of a donut are where its mean profile about its middle crosses half of its level. What shadows and the
blur do to their ratio, they do as well to that of the telescope's own image. Diffraction, which that lacks, moves both
edges into the light by as much as that of a straight edge.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.special import fresnel

from ..core.errors import DomainError, PrescriptionWarning
from ..core.statistics import FWHM_PER_RMS
from ..models.telescope import Telescope
from .flags import DonutFlag
from .image_model import FLUX, NUISANCES, STRENGTH
from .light import Instrument
from .likelihood import model_image
from .pupil_cells import pupil_cells
from .result import DonutFit
from .star_fitter import StarSolution

#: Donuts that are looked at, the brightest.
_DONUTS = 5
#: Parts of a donut about the chief ray: neighbours and shadows are in some, another hole is in all.
_QUADRANTS = 4
#: Rms of the blur in which the middle of the light is found [pixels].
_SMOOTH = 1.5
#: Cells across the pupil.
_CELLS = 96
#: Difference of obscurations from which on it is said: 0.5 um of Z11 look like 0.04 in the LSST.
_DIFFERENCE = 0.05
#: Part of the obscuration below which what is left of a hole is no measure of it: the seeing fills it.
_FILLED = 0.5
#: Flags of donuts whose edges are not those of the pupil.
_UNFIT = DonutFlag.BLENDED | DonutFlag.CUT_OFF | DonutFlag.OTHER_SIZE
#: Least width of the lit ring over the FWHM of the blur.
_LEAST_WIDTH = 1.0
#: Least width of the lit ring [pixels].
_LEAST_PIXELS = 4.0
#: Least signal of a ring of pixels at the inner edge over its noise.
_LEAST_SIGNAL = 10.0
#: Reach of a diffracting edge, in Fresnel's unit.
_FAR = 20.0
#: Points at which its light is computed.
_POINTS = 4001


def warn_of_other_hole(instrument: Instrument, solutions: dict[int, StarSolution], fit: DonutFit) -> None:
    """Warn where donuts have another obscuration than the light of the telescope, all around."""
    telescope = instrument.telescope
    donut, model = _brightest_ratios(instrument, solutions, fit)
    relative = _relative(donut, model)
    # Obscurations are below 1, and differ by no more than these do.
    alike = np.abs(relative) <= _DIFFERENCE
    mixed = np.nanmin(relative, initial=0.0) < 0.0 < np.nanmax(relative, initial=0.0)
    # In a crowd a donut that seems to be alone may not be.
    crowded = 2 * len(donut) < min(len(solutions), _DONUTS)
    if not len(donut) or crowded or alike.any() or mixed:
        return
    lit = lit_obscuration(telescope, instrument.middle)
    if max(donut.max(), model.max()) < _FILLED * lit:
        return
    shown = np.where(model > 0.0, lit * (1.0 + relative), donut)
    differences = shown - lit
    if (np.abs(differences) > _DIFFERENCE).all() and np.ptp(np.sign(differences)) == 0.0:
        text = (
            f"{telescope.name}: donuts show an obscuration of {np.median(shown):.2f}, its light has {lit:.2f}: "
            "expected the annulus of the mirror, and pupil.obscuration, as they are; Zernikes are wrong unless the "
            "telescope has the spherical aberration (Z11, Z22) that is fitted"
        )
        warnings.warn(text, PrescriptionWarning, stacklevel=4)


def _brightest_ratios(
    instrument: Instrument, solutions: dict[int, StarSolution], fit: DonutFit
) -> tuple[np.ndarray, np.ndarray]:
    """Return inner over outer radii of the brightest donuts and of the telescope's images, quadrants, each [n, 4].

    Donuts without clear edges are left out, and all after one whose hole is in some quadrant as believed: it decides.
    """
    clear = [i for i in solutions if not DonutFlag(int(fit.flags[i])) & _UNFIT]
    brightest = sorted(clear, key=lambda i: -fit.flux[i])[:_DONUTS]
    ratios: list[np.ndarray] = []
    for i in brightest:
        of_donut = np.array(_ratios(instrument, solutions[i], fit, i))
        if np.isfinite(of_donut).all():
            ratios.append(of_donut)
            if (np.abs(_relative(*of_donut)) <= _DIFFERENCE).any():
                break
    donut, model = np.moveaxis(np.array(ratios).reshape(-1, 2, _QUADRANTS), 1, 0)
    return donut, model


def _relative(donut: np.ndarray, model: np.ndarray) -> np.ndarray:
    """Return how much larger holes of donuts are than those of the telescope's images; NaN where these tell no scale.

    Such an image has no hole.
    """
    scaled = model > 0.0
    return np.where(scaled, donut / np.where(scaled, model, 1.0) - 1.0, np.nan)


def lit_obscuration(telescope: Telescope, wavelength: float) -> float:
    """Return the inner over the outer edge of the light on the axis, in the pupil; NaN where it is dark."""
    try:
        cells = pupil_cells(telescope, np.array([0.0, 0.0, -1.0]), wavelength, _CELLS)
    except DomainError:
        return np.nan
    image = _image(cells.points / cells.side, cells.weights, _CELLS + 5, 2.0)
    ((inner, outer, _),) = _edges(image, np.zeros(image.shape, dtype=np.int64), np.zeros(2), 1)
    return float(inner / outer)


def _ratios(instrument: Instrument, star: StarSolution, fit: DonutFit, i: int) -> list[np.ndarray]:
    """Return inner over outer radius of a donut and of the telescope's image in the same seeing, quadrant by quadrant.

    NaN where the edges are not clear.
    """
    pixel, light = instrument.pixel, star.light
    rows, columns = (slice(*(np.flatnonzero(fit.used[i].any(axis=axis))[[0, -1]] + [0, 1])) for axis in (1, 0))
    image, used = fit.images[i][rows, columns] - fit.background[i], fit.used[i][rows, columns]
    fwhm = fit.fwhm[i] * light.scale / pixel
    unknowns = np.zeros(len(NUISANCES))
    unknowns[[FLUX, STRENGTH]] = 1.0, star.solution.stars[0][STRENGTH]
    grid = star.full.grid
    rays_alone = star.full if grid.rim_light is None else replace(star.full, grid=grid.of_rays_alone())
    telescope_image = model_image(rays_alone, unknowns, np.zeros(star.full.rays.count))
    inner, outer, level = _edges_of_quadrants(image, used)
    model = _edges_of_quadrants(telescope_image, np.ones(telescope_image.shape, dtype=bool))
    pixels = 2.0 * np.pi * np.maximum(inner, _LEAST_PIXELS) / _QUADRANTS
    noise = np.sqrt((fit.sky_variance[i] + fit.photon_variance[i] * np.maximum(level, 0.0)) / pixels)
    clear = (model[1] - model[0] > max(_LEAST_WIDTH * fwhm, _LEAST_PIXELS)) & (level > _LEAST_SIGNAL * noise)
    if not clear.all():
        return [np.full(_QUADRANTS, np.nan)] * 2
    shift = _edge_shift(fwhm / FWHM_PER_RMS, np.sqrt(0.5 * instrument.middle * abs(light.depth)) / pixel)
    return [np.maximum(inner - shift, 0.0) / (outer + shift), model[0] / model[1]]


def _edges_of_quadrants(image: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return inner and outer edges [pixels] of the quadrants about the middle of the light, and levels, [3, 4]."""
    y, x = (np.arange(n) - 0.5 * (n - 1) for n in image.shape)
    smooth = gaussian_filter(np.where(used, image, 0.0), _SMOOTH)
    lit = np.sort(smooth[smooth > 0.0])
    bright = smooth > 0.5 * _level(lit, lit)
    row, column = np.nonzero(bright)
    center = np.array([x[column].mean(), y[row].mean()]) if len(row) else np.zeros(2)
    right, upper = x[None] > center[0], y[:, None] > center[1]
    quadrant = np.where(used, 2 * right + upper, _QUADRANTS)
    return _edges(image, quadrant, center, _QUADRANTS).T


def _edge_shift(blur: float, unit: float) -> float:
    """Return how far inside the light a diffracting straight edge has half of its level.

    In the unit of `blur`, the rms of a Gaussian, and `unit`, the length sqrt(wavelength * distance / 2) of Fresnel's
    integrals (Born & Wolf, Principles of Optics, 8.7).
    """
    v, light = _straight_edge()
    if blur > 0.0:
        light = gaussian_filter1d(light, blur / unit / (v[1] - v[0]))
    return float(v[np.argmax(light > 0.5)] * unit)


@lru_cache(maxsize=1)
def _straight_edge() -> tuple[np.ndarray, np.ndarray]:
    """Return the light that a straight edge diffracts, by the distance from it in Fresnel's unit."""
    v = np.linspace(-_FAR, _FAR, _POINTS)
    sine, cosine = fresnel(v)
    return v, 0.5 * ((cosine + 0.5) ** 2 + (sine + 0.5) ** 2)


def _image(places: np.ndarray, weights: np.ndarray, size: int, fwhm: float) -> np.ndarray:
    """Return the light at places [n, 2] about the middle of a square of pixels, blurred by a Gaussian."""
    limits = [-0.5 * size, 0.5 * size]
    counts = np.histogram2d(places[:, 1], places[:, 0], bins=size, range=[limits, limits], weights=weights)[0]
    return np.asarray(gaussian_filter(counts, fwhm / FWHM_PER_RMS))


def _edges(image: np.ndarray, part: np.ndarray, center: np.ndarray, count: int) -> np.ndarray:
    """Return inner and outer edges [pixels] of mean profiles about a place from the middle, and levels, [count, 3].

    Each pixel is of one of so many parts of the image, or of none. Without a hole the inner edge is 0; without light
    all are NaN.
    """
    y, x = (np.arange(n) - 0.5 * (n - 1) for n in image.shape)
    radius = np.hypot(x[None] - center[0], y[:, None] - center[1]).astype(np.int64)
    rings = max(int(radius.max(initial=0)) + 1, 2)
    ring = (np.minimum(part, count) * rings + radius).ravel()
    shape = (count + 1, rings)
    pixels, light = (
        np.bincount(ring, weights=weights, minlength=shape[0] * rings).reshape(shape)[:count]
        for weights in (None, image.ravel())
    )
    return np.array([_edges_of_profile(light[k], pixels[k]) for k in range(count)])


def _edges_of_profile(light: np.ndarray, pixels: np.ndarray) -> tuple[float, float, float]:
    """Return inner and outer edge and level of a profile, from the light of rings of so many pixels."""
    last_ring = int(np.flatnonzero(pixels).max(initial=0))
    light, pixels = light[: last_ring + 1], pixels[: last_ring + 1]
    profile = light / np.maximum(pixels, 1)
    level = _level(profile, np.maximum(light, 0.0))
    if not level > 0.0:
        return np.nan, np.nan, np.nan
    bright = np.flatnonzero(profile > 0.5 * level)
    runs = np.split(bright, np.flatnonzero(np.diff(bright) > 1) + 1)
    first, last = max(runs, key=lambda run: light[run].sum())[[0, -1]]

    def crossing(inside: int, outside: int) -> float:
        high, low = profile[inside], profile[outside]
        return inside + 0.5 + (high - 0.5 * level) / (high - low) * (outside - inside)

    inner = crossing(first, first - 1) if first > 0 else 0.0
    outer = crossing(last, last + 1) if last + 1 < len(profile) else last + 1.0
    return float(inner), float(outer), level


def _level(values: np.ndarray, light: np.ndarray) -> float:
    """Return the median of values over the light that they stand for; NaN without light."""
    order = np.argsort(values, axis=None)
    below = np.cumsum(light.ravel()[order])
    return float(values.ravel()[order][np.searchsorted(below, 0.5 * below[-1])]) if below[-1:] > 0.0 else np.nan
