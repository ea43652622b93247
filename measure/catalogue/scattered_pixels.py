"""Scattered bad pixels of images and of objects: filled from good neighbours, and by the Gaussian of an object."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from ..adaptive_moments import MomentFlag, adaptive_moments
from ..masked_moments import MOST_MASKED
from ..pixel_masks import NEIGHBOURHOOD, fill_symmetric
from .cutouts import cut_out, first_pixel

# Least part of the neighbourhood of a scattered pixel that is good: it has more good than bad neighbours.
_GOOD_PART = 0.5
# Side of the stamps on which objects are filled [pixel]; beyond, their light changes slowly from pixel to pixel.
_SIDE = 31
# Stamps that are filled at a time, which bounds their memory.
_TOGETHER = 1024
#: Variance of a filled pixel over that of the pixels beside it: that of a sum in which the opposite pixel counts twice.
FILLED_VARIANCE = 3.0


def fill_scattered(
    image: np.ndarray, variance: np.ndarray, bad: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fill the bad pixels with mostly good neighbours by their mean.

    Parameters
    ----------
    image, variance, bad : array
        Pixels, their variance, and the bad ones, [ny, nx].

    Returns
    -------
    tuple of array
        Image and variance with filled pixels, and the scattered bad pixels that were filled, bool; [ny, nx] each.
    """
    good = ndimage.gaussian_filter((~bad).astype(np.float32), NEIGHBOURHOOD, mode="constant")
    scattered = bad & (good > _GOOD_PART)
    filled = [
        np.where(
            scattered,
            ndimage.gaussian_filter(np.where(bad, 0.0, values), NEIGHBOURHOOD, mode="constant")
            / np.where(scattered, good, 1.0),
            values,
        )
        for values in (image, variance)
    ]
    filled[1][scattered] *= FILLED_VARIANCE
    return filled[0], filled[1], scattered


def fill_objects(
    image: np.ndarray, bad: np.ndarray, segmentation: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fill the bad pixels of objects by their own light, and tell of which too little is left.

    Parameters
    ----------
    image : array
        Less its background, with first guesses in the bad pixels, [ny, nx].
    bad, segmentation : array
        Bad pixels, bool, and the pixels of each object i, which are i + 1, [ny, nx].
    x, y : array
        Places of the objects [pixel], [n].

    Returns
    -------
    tuple of array
        Filled image and the variance of what is filled in for want of a better model than a Gaussian, zero elsewhere,
        [ny, nx]; and the objects of which most of the core is bad, [n] bool.
    """
    filled, unsure, lost = image.copy(), np.zeros(image.shape), np.zeros(len(x), dtype=bool)
    numbers = np.unique(segmentation[bad])
    masked = numbers[numbers > 0] - 1
    for first in range(0, len(masked), _TOGETHER):
        rows = masked[first : first + _TOGETHER]
        px, py = x[rows], y[rows]
        labels = cut_out(segmentation, px, py, _SIDE, 0)
        member = labels == rows[:, None, None] + 1
        stamps, without_light = (
            cut_out(values, px, py, _SIDE, outside) for values, outside in ((image, 0.0), (bad, True))
        )
        dx, dy = (at - first_pixel(at, _SIDE) - 0.5 * (_SIDE - 1) for at in (px, py))
        stamps, residuals, lost[rows] = fill_stamps(stamps, without_light | ((labels != 0) & ~member), dx, dy)
        star, row, column = np.nonzero(member & without_light)
        pixels = first_pixel(py, _SIDE)[star] + row, first_pixel(px, _SIDE)[star] + column
        filled[pixels] = stamps[star, row, column]
        unsure[pixels] = residuals[star, row, column] ** 2
    return filled, unsure, lost


def fill_stamps(
    stamps: np.ndarray, bad: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fill bad pixels of objects by the Gaussian of their adaptive moments and by what the opposite pixel exceeds it.

    Parameters
    ----------
    stamps, bad : array
        Background-subtracted objects, and their bad pixels, bool, [n, ny, nx].
    x, y : array
        Places from the centre of the stamps [pixel], [n]: those of objects without moments, about which bad pixels hold
        the opposite ones.

    Returns
    -------
    tuple of array
        Filled stamps, and what their bad pixels exceed the Gaussian by, [n, ny, nx]; and the objects of which most of
        the core is bad, [n] bool.
    """
    ny, nx = stamps.shape[1:]
    moments = adaptive_moments(stamps, 1.0, bad, threads=1)
    usable = moments.usable
    g1, g2, sigma, flux = (
        np.where(usable, values, without)[:, None, None]
        for values, without in ((moments.g1, 0.0), (moments.g2, 0.0), (moments.sigma, 1.0), (moments.flux, 0.0))
    )
    centers = [np.where(usable, *at) for at in ((moments.x, x), (moments.y, y))]
    x_from = np.arange(nx) - 0.5 * (nx - 1) - centers[0][:, None, None]
    y_from = (np.arange(ny) - 0.5 * (ny - 1))[:, None] - centers[1][:, None, None]
    stretch = 2.0 * g1 * (x_from**2 - y_from**2) + 4.0 * g2 * x_from * y_from
    square = (1.0 + g1**2 + g2**2) * (x_from**2 + y_from**2) - stretch
    gaussian = np.exp(-0.5 * square / (sigma**2 * (1.0 - g1**2 - g2**2)))
    core = gaussian > 0.5
    lost = (core & bad).sum(axis=(1, 2)) > MOST_MASKED * core.sum(axis=(1, 2))
    lost |= moments.flags == MomentFlag.MASKED
    models = flux / (2.0 * np.pi * sigma**2) * gaussian
    residuals = np.where(bad, fill_symmetric(np.where(bad, 0.0, stamps - models), bad, *centers), 0.0)
    return np.where(bad, models + residuals, stamps), residuals, lost
