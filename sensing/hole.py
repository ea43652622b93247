"""Obscuration that the holes of donuts show, beside that of the light of the telescope.

Both edges of a donut are where its mean profile about its middle crosses half of its level. What shadows and the
blur do to their ratio, they do as well to that of the telescope's own image. Diffraction, which that lacks, moves both
edges into the light by as much as that of a straight edge.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

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
    lit = lit_obscuration(telescope, instrument.middle)
    shown = donut_obscurations(instrument, solutions, fit, lit)
    differences = shown - lit
    if len(shown) and (np.abs(differences) > _DIFFERENCE).all() and np.ptp(np.sign(differences)) == 0.0:
        text = (
            f"{telescope.name}: donuts show an obscuration of {np.median(shown):.2f}, its light has {lit:.2f}: "
            "expected the annulus of the mirror, and pupil.obscuration, as they are; Zernikes are wrong"
        )
        warnings.warn(text, PrescriptionWarning, stacklevel=4)


def donut_obscurations(
    instrument: Instrument, solutions: dict[int, StarSolution], fit: DonutFit, lit: float
) -> np.ndarray:
    """Return the obscurations that the brightest donuts show in each quadrant, shape [n, 4].

    Donuts without clear edges are left out; `lit` is the obscuration of the light of the telescope.
    """
    clear = [i for i in solutions if not DonutFlag(int(fit.flags[i])) & _UNFIT]
    brightest = sorted(clear, key=lambda i: -fit.flux[i])[:_DONUTS]
    ratios = np.array([_ratios(instrument, solutions[i], fit, i) for i in brightest]).reshape(-1, 2, _QUADRANTS)
    donut, model = np.moveaxis(ratios, 1, 0)
    # An image of the telescope that has no hole tells no scale.
    shown = np.where(model > 0.0, donut * lit / np.where(model > 0.0, model, 1.0), donut)
    return shown[np.isfinite(shown).all(axis=1)]


def lit_obscuration(telescope: Telescope, wavelength: float) -> float:
    """Return the inner over the outer edge of the light on the axis, in the pupil; NaN where it is dark."""
    try:
        cells = pupil_cells(telescope, np.array([0.0, 0.0, -1.0]), wavelength, _CELLS)
    except DomainError:
        return np.nan
    image = _image(cells.points / cells.side, cells.weights, _CELLS + 5, 2.0)
    inner, outer, _ = _edges(image, np.ones(image.shape, dtype=bool), np.zeros(2))
    return inner / outer


def _ratios(instrument: Instrument, star: StarSolution, fit: DonutFit, i: int) -> list[np.ndarray]:
    """Return inner over outer radius of a donut and of the telescope's image in the same seeing, quadrant by quadrant.

    NaN where the edges are not clear.
    """
    image, used, pixel, light = fit.images[i] - fit.background[i], fit.used[i], instrument.pixel, star.light
    fwhm = fit.fwhm[i] * light.scale / pixel
    unknowns = np.zeros(len(NUISANCES))
    unknowns[[FLUX, STRENGTH]] = 1.0, star.solution.stars[0][STRENGTH]
    grid = star.full.grid
    rays_alone = star.full if grid.rim_light is None else replace(star.full, grid=grid.of_rays_alone())
    telescope_image = model_image(rays_alone, unknowns, np.zeros_like(star.solution.waves[0]))
    inner, outer, level = _edges_of_quadrants(image, used)
    model = _edges_of_quadrants(telescope_image, np.ones(telescope_image.shape, dtype=bool))
    pixels = 2.0 * np.pi * np.maximum(inner, _LEAST_PIXELS) / _QUADRANTS
    noise = np.sqrt((fit.sky_variance[i] + np.maximum(level, 0.0)) / pixels)
    clear = (model[1] - model[0] > max(_LEAST_WIDTH * fwhm, _LEAST_PIXELS)) & (level > _LEAST_SIGNAL * noise)
    if not clear.all():
        return [np.full(_QUADRANTS, np.nan)] * 2
    shift = _edge_shift(fwhm / FWHM_PER_RMS, np.sqrt(0.5 * instrument.middle * abs(light.depth)) / pixel)
    return [np.maximum(inner - shift, 0.0) / (outer + shift), model[0] / model[1]]


def _edges_of_quadrants(image: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return inner and outer edges [pixels] of the quadrants about the middle of the light, and levels, [3, 4]."""
    y, x = (np.arange(n) - 0.5 * (n - 1) for n in image.shape)
    smooth = gaussian_filter(np.where(used, image, 0.0), _SMOOTH)
    bright = smooth > 0.5 * _level(smooth, np.maximum(smooth, 0.0))
    row, column = np.nonzero(bright)
    center = np.array([x[column].mean(), y[row].mean()]) if len(row) else np.zeros(2)
    right, upper = x[None] > center[0], y[:, None] > center[1]
    quadrants = [used & (right == first) & (upper == second) for first in (True, False) for second in (True, False)]
    return np.array([_edges(image, quadrant, center) for quadrant in quadrants]).T


def _edge_shift(blur: float, unit: float) -> float:
    """Return how far inside the light a diffracting straight edge has half of its level.

    In the unit of `blur`, the rms of a Gaussian, and `unit`, the length sqrt(wavelength * distance / 2) of Fresnel's
    integrals (Born & Wolf, Principles of Optics, 8.7).
    """
    v = np.linspace(-_FAR, _FAR, _POINTS)
    sine, cosine = fresnel(v)
    light = 0.5 * ((cosine + 0.5) ** 2 + (sine + 0.5) ** 2)
    if blur > 0.0:
        light = gaussian_filter1d(light, blur / unit / (v[1] - v[0]))
    return float(v[np.argmax(light > 0.5)] * unit)


def _image(places: np.ndarray, weights: np.ndarray, size: int, fwhm: float) -> np.ndarray:
    """Return the light at places [n, 2] about the middle of a square of pixels, blurred by a Gaussian."""
    limits = [-0.5 * size, 0.5 * size]
    counts = np.histogram2d(places[:, 1], places[:, 0], bins=size, range=[limits, limits], weights=weights)[0]
    return np.asarray(gaussian_filter(counts, fwhm / FWHM_PER_RMS))


def _edges(image: np.ndarray, used: np.ndarray, center: np.ndarray) -> tuple[float, float, float]:
    """Return inner and outer edge [pixels] of the mean profile about a place from the middle, and its level.

    Without a hole the inner edge is 0; without light all are NaN.
    """
    y, x = (np.arange(n) - 0.5 * (n - 1) for n in image.shape)
    ring = np.hypot(x[None] - center[0], y[:, None] - center[1]).astype(int)
    ring, values = ring[used], image[used]
    pixels = np.bincount(ring, minlength=2)
    light = np.bincount(ring, weights=values, minlength=2)
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
    return float(values.ravel()[order][np.searchsorted(below, 0.5 * below[-1])]) if below[-1] > 0.0 else np.nan
