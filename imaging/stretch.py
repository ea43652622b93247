"""Drawing of images of CCDs: asinh stretch, arrows to north and east, axes in arc seconds."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning
from astropy.wcs import WCS

from ..core.errors import ConfigError
from ..core.plotting import ORANGE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Pixels along a side of the picture of a whole CCD, at most.
_MOST = 1024
#: Softening of the asinh stretch [rms of the background].
_SOFT = 3.0
#: Upper end of the asinh stretch [rms of the background].
_TOP = 150.0


def draw_image(axes: Axes, image: np.ndarray, variance: np.ndarray, header: fits.Header) -> None:
    """Draw an image, binned to about a thousand pixels, axes in arcsec from its middle; in pixels without a WCS."""
    data = image - sky_level(header)
    step = -(-max(data.shape) // _MOST)
    ny, nx = (n // step * step for n in data.shape)
    binned = data[:ny, :nx].reshape(ny // step, step, nx // step, step).mean(axis=(1, 3))
    noise = float(np.sqrt(np.median(variance))) / step
    if has_celestial(header):
        show_stretched(axes, binned, noise, pixel_scale_of(header) * step)
        draw_compass(axes, header)
    else:
        show_stretched(axes, binned, noise, step, "pixel")


def sky_level(header: fits.Header) -> float:
    """Return the background that is left in an image [ADU]."""
    return 0.0 if header.get("SKYSUB", True) else float(header["SKY"])


def world_coordinates(header: fits.Header) -> WCS:
    """Return the world coordinates of a header; those of other programs may have cards that astropy warns of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)
        return WCS(header)


def has_celestial(header: fits.Header) -> bool:
    """Return whether a header has celestial world coordinates."""
    return world_coordinates(header).has_celestial


def pixel_scale_of(header: fits.Header) -> float:
    """Return the side of a pixel at the reference point, or that of PIXSCALE without world coordinates [arcsec]."""
    wcs = world_coordinates(header)
    if not wcs.has_celestial:
        if "PIXSCALE" not in header:
            raise ConfigError("the header has neither world coordinates nor PIXSCALE: expected one", key="PIXSCALE")
        return float(header["PIXSCALE"])
    return float(np.sqrt(abs(np.linalg.det(wcs.pixel_scale_matrix)))) * 3600.0


def show_stretched(axes: Axes, data: np.ndarray, noise: float, scale: float, unit: str = "arcsec") -> None:
    """Draw an image with an asinh stretch in units of its noise; pixels of a size in a unit."""
    height, width = (0.5 * scale * n for n in data.shape)
    stretched = np.arcsinh(data / (_SOFT * noise)) / np.arcsinh(_TOP / _SOFT)
    axes.imshow(stretched, cmap="gray", vmin=-0.12, vmax=1.0, extent=(-width, width, -height, height), origin="lower")
    axes.set_xlabel(f"x [{unit}]")
    axes.set_ylabel(f"y [{unit}]")


def draw_compass(axes: Axes, header: fits.Header) -> None:
    """Draw arrows towards north and east in a corner."""
    # Columns of the inverse of CD are the steps in pixels for a step in xi (east) and in eta (north).
    wcs = world_coordinates(header)
    rows = [wcs.wcs.lng, wcs.wcs.lat]
    steps = np.linalg.inv(wcs.pixel_scale_matrix[rows])
    start, length = np.array([0.88, 0.12]), 0.07
    for label, step in zip("EN", steps.T, strict=True):
        end = start + length * step / np.hypot(*step)
        arrow = {"arrowstyle": "->", "color": ORANGE}
        axes.annotate("", tuple(end), tuple(start), "axes fraction", "axes fraction", arrowprops=arrow)
        x, y = start + 1.25 * (end - start)
        axes.text(x, y, label, color=ORANGE, ha="center", va="center", transform=axes.transAxes)
