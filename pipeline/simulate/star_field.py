"""Stars of one CCD: holdout positions, and observed stars with their magnitudes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.errors import DomainError
from ...core.random_streams import stream
from ...core.units import metres
from . import photometry

COUNT_SLOPE = 0.2
"""Star counts go as 10^(0.2 m) (Jee & Tyson 2011, sec. 4)."""
SNR_LIMIT = 30.0
"""Least signal-to-noise ratio of an observed star (Jee & Tyson 2011, sec. 4)."""
PIXEL_SIZE = 10.0e-6
"""Side of an LSST pixel [m]."""


@dataclass(frozen=True)
class StarField:
    """The stars of one CCD.

    Parameters
    ----------
    ccd_name : str
        Name of the CCD.
    bounds : tuple of float
        (xmin, xmax, ymin, ymax) of the CCD on the focal plane [m], outer edges of its pixels.
    pixel_size : float
        [m].
    holdout, observed : array
        Focal-plane positions (x, y) [m], [n, 2].
    magnitude : array
        AB magnitudes of the observed stars.
    electrons : array
        Electrons that the observed stars give.
    band : str
        Name of the filter.
    exposure : float
        [s].
    bright, faint : float
        Magnitude limits of the observed stars.
    """

    ccd_name: str
    bounds: tuple[float, float, float, float]
    pixel_size: float
    holdout: np.ndarray
    observed: np.ndarray
    magnitude: np.ndarray
    electrons: np.ndarray
    band: str
    exposure: float
    bright: float
    faint: float

    @property
    def holdout_pixel(self) -> np.ndarray:
        """Holdout positions [pixel] on the CCD, [n, 2]."""
        return self.to_pixel(self.holdout)

    @property
    def observed_pixel(self) -> np.ndarray:
        """Positions of the observed stars [pixel] on the CCD, [n, 2]."""
        return self.to_pixel(self.observed)

    def to_pixel(self, positions: Any) -> np.ndarray:
        """Convert focal-plane positions [m] to CCD pixels: x to the right, y up, the first pixel's centre at (0, 0)."""
        corner = np.array([self.bounds[0], self.bounds[2]])
        return (np.asarray(positions, dtype=np.float64) - corner) / self.pixel_size - 0.5


def make_star_field(
    ccd_name: str,
    bounds: Any,
    n_holdout: int,
    n_observed: int,
    seed: int,
    *,
    fwhm: Any,
    band: str | photometry.Band = "r",
    exposure: float = 15.0,
    snr: float = SNR_LIMIT,
    bright: float | None = None,
    faint: float | None = None,
    margin: int = 20,
    pixel_size: Any = PIXEL_SIZE,
) -> StarField:
    """Draw the stars of one CCD.

    Every attribute of every CCD has its own random stream, named after the CCD. The stars do not depend on the other
    CCDs of a run, and the first n of them not on how many follow.

    Parameters
    ----------
    ccd_name : str
        Name of the CCD; part of the key of its streams.
    bounds : tuple of float or Quantity
        (xmin, xmax, ymin, ymax) of the CCD on the focal plane [m].
    n_holdout : int
        Holdout positions, uniform over the CCD.
    n_observed : int
        Observed stars, uniform over the CCD but for the margin, counts per magnitude going as 10^(0.2 m).
    seed : int
        Seed of the run.
    fwhm : float or Quantity
        Effective FWHM of the stars [rad], which sets the magnitude limits.
    band : str or Band
        Filter.
    exposure : float
        [s].
    snr : float
        Signal-to-noise ratio at the faint limit.
    bright, faint : float, optional
        Magnitude limits; where left out, the magnitude at which the brightest pixel saturates and the one at which the
        signal-to-noise ratio is `snr`.
    margin : int
        Pixels that observed stars keep from the edge of the CCD, so that their stamps fit.
    pixel_size : float or Quantity
        [m].

    Raises
    ------
    DomainError, UnknownNameError
        If a count is negative, the limits are in the wrong order, the margins leave no room, or the band is unknown.
    """
    band = photometry.band_named(band)
    edges = _edges(bounds)
    pixel = float(metres(pixel_size, "pixel_size"))
    if not (np.isfinite(pixel) and pixel > 0.0):
        raise DomainError(f"pixel_size = {pixel_size}: expected a positive length")
    for name, count in (("n_holdout", n_holdout), ("n_observed", n_observed), ("margin", margin)):
        if count < 0:
            raise DomainError(f"{name} = {count}: expected a number that is not negative")
    if 2 * margin * pixel >= min(edges[1] - edges[0], edges[3] - edges[2]):
        raise DomainError(f"margin = {margin}: expected less than half of the CCD, bounds = {edges} m")
    if bright is None:
        bright = photometry.saturation_magnitude(band, exposure, fwhm)
    if faint is None:
        faint = photometry.limiting_magnitude(snr, band, exposure, fwhm)
    if not bright < faint:
        raise DomainError(f"bright = {bright:.2f}, faint = {faint:.2f}: expected a bright limit above the faint one")
    inner = (edges[0] + margin * pixel, edges[1] - margin * pixel, edges[2] + margin * pixel, edges[3] - margin * pixel)
    magnitude = draw_magnitudes(stream(seed, "stars", ccd_name, "observed", "magnitude"), n_observed, bright, faint)
    return StarField(
        ccd_name=ccd_name,
        bounds=edges,
        pixel_size=pixel,
        holdout=_uniform(seed, ccd_name, "truth", n_holdout, edges),
        observed=_uniform(seed, ccd_name, "observed", n_observed, inner),
        magnitude=magnitude,
        electrons=photometry.electrons(magnitude, band, exposure),
        band=band.name,
        exposure=float(exposure),
        bright=float(bright),
        faint=float(faint),
    )


def draw_magnitudes(
    rng: np.random.Generator, count: int, bright: float, faint: float, slope: float = COUNT_SLOPE
) -> np.ndarray:
    """Draw magnitudes whose counts go as 10^(slope m) between two limits, through the inverse of their distribution.

    The first magnitudes of a stream stay as they are when `count` grows.
    """
    span = 10.0 ** (slope * (faint - bright)) - 1.0
    return bright + np.log10(1.0 + rng.random(count) * span) / slope


def _uniform(seed: int, ccd_name: str, kind: str, count: int, edges: tuple[float, float, float, float]) -> np.ndarray:
    """Draw positions evenly over a rectangle, x and y from streams of their own."""
    return np.stack(
        [
            edges[2 * axis]
            + (edges[2 * axis + 1] - edges[2 * axis]) * stream(seed, "stars", ccd_name, kind, key).random(count)
            for axis, key in enumerate(("x", "y"))
        ],
        axis=1,
    )


def _edges(bounds: Any) -> tuple[float, float, float, float]:
    """Return the bounds as four floats in metres."""
    values = metres(bounds, "bounds")
    if values.shape != (4,) or not np.all(np.isfinite(values)) or values[0] >= values[1] or values[2] >= values[3]:
        raise DomainError(f"bounds = {bounds}: expected (xmin, xmax, ymin, ymax), minima below maxima")
    xmin, xmax, ymin, ymax = (float(v) for v in values)
    return xmin, xmax, ymin, ymax
