"""Stars of one CCD: holdout positions, and observed stars with their magnitudes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.errors import DomainError
from ...core.random_streams import stream
from ...core.units import metres, require_positive
from ...models.camera.photometry import Band
from . import photometry

COUNT_SLOPE = 0.2
"""Star counts go as 10^(0.2 m) (Jee & Tyson 2011, sec. 4)."""


@dataclass(frozen=True)
class CcdOutline:
    """Place of a CCD on the focal plane.

    Attributes
    ----------
    name : str
        Name of the CCD.
    bounds : tuple of float or Quantity
        (xmin, xmax, ymin, ymax), outer edges of the pixels, not turned [m].
    pixel_size : float or Quantity
        Side of a pixel [m].
    turn : float
        Angle of the CCD about its centre, quarter turns left out, from +x towards +y [rad].

    Raises
    ------
    DomainError
        If the bounds are no rectangle, or the pixels have no size.
    """

    name: str
    bounds: tuple[float, float, float, float]
    pixel_size: float
    turn: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "bounds", _edges_in_metres(self.bounds))
        pixel = require_positive(metres(self.pixel_size, "pixel_size"), "pixel_size", "metres")
        object.__setattr__(self, "pixel_size", pixel)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """(xmin, xmax, ymin, ymax) that hold all of the CCD [m]."""
        xmin, xmax, ymin, ymax = self.bounds
        corners = self.turned(np.array([(x, y) for x in (xmin, xmax) for y in (ymin, ymax)]))
        (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
        return float(x0), float(x1), float(y0), float(y1)

    def turned(self, positions: np.ndarray) -> np.ndarray:
        """Return positions [n, 2] within `bounds` as they stand on the turned CCD."""
        return _rotated(positions, self.bounds, self.turn)

    def to_pixel(self, positions: Any) -> np.ndarray:
        """Convert focal-plane positions [m] to CCD pixels: x to the right, y up, the first pixel's centre at (0, 0).

        Rows are those that lie along x of the focal plane, but for `turn`.
        """
        corner = np.array([self.bounds[0], self.bounds[2]])
        along = _rotated(np.asarray(positions, dtype=np.float64), self.bounds, -self.turn)
        return (along - corner) / self.pixel_size - 0.5


@dataclass(frozen=True)
class Depth:
    """Depth of an exposure: band, time, and magnitude limits of the stars.

    Attributes
    ----------
    band : str or Band
        Photometric band.
    exposure : float
        Exposure time [s].
    snr : float
        Signal-to-noise ratio at the faint limit; 30 as in Jee & Tyson 2011, sec. 4.
    bright, faint : float, optional
        Magnitude limits; by default the magnitude at which the brightest pixel saturates and the one at which the
        signal-to-noise ratio is `snr`.

    Raises
    ------
    UnknownNameError
        If there is no such band.
    """

    band: str | Band = "r"
    exposure: float = 15.0
    snr: float = 30.0
    bright: float | None = None
    faint: float | None = None

    def limits(self, fwhm: Any) -> tuple[float, float]:
        """Return the bright and the faint limit for stars of an effective FWHM [rad]; DomainError if out of order."""
        bright, faint = self.bright, self.faint
        if bright is None:
            bright = photometry.saturation_magnitude(self.band, self.exposure, fwhm)
        if faint is None:
            faint = photometry.limiting_magnitude(self.snr, self.band, self.exposure, fwhm)
        if not bright < faint:
            text = f"bright = {bright:.2f}, faint = {faint:.2f}: expected a bright limit above the faint one"
            raise DomainError(text, key="faint")
        return float(bright), float(faint)


@dataclass(frozen=True)
class StarField:
    """Stars of one CCD."""

    ccd: CcdOutline
    holdout: np.ndarray  #: focal-plane positions (x, y) [m], [n, 2]
    observed: np.ndarray  #: likewise
    magnitude: np.ndarray  #: AB, of the observed stars
    electrons: np.ndarray  #: of the observed stars
    band: Band
    exposure: float  #: [s]
    bright: float  #: magnitude limits of the observed stars
    faint: float
    temperature: np.ndarray | None = None  #: of the observed stars [K]; NaN, None: flat spectra

    @property
    def observed_pixel(self) -> np.ndarray:
        """Positions of the observed stars [pixel] on the CCD, [n, 2]."""
        return self.ccd.to_pixel(self.observed)


def make_star_field(
    ccd: CcdOutline, n_holdout: int, n_observed: int, seed: int, *, fwhm: Any, depth: Depth, margin: int = 20
) -> StarField:
    """Draw the stars of one CCD, uniform over it; counts per magnitude of the observed ones go as 10^(0.2 m).

    Every attribute of every CCD has its own random stream, with the name of the CCD in its key. The stars do not depend
    on the other CCDs of a run, and the first n of them not on how many follow.

    Parameters
    ----------
    ccd : CcdOutline
        The CCD.
    n_holdout, n_observed : int
        Numbers of holdout positions and of observed stars.
    seed : int
        Seed of the run.
    fwhm : float or Quantity
        Effective FWHM of the stars [rad], which sets the magnitude limits.
    depth : Depth
        Band, exposure time and magnitude limits.
    margin : int
        Distance of observed stars from the edge of the CCD [pixel], so that their stamps fit.

    Raises
    ------
    DomainError
        If a number is outside its range.
    """
    band = photometry.band_named(depth.band)
    edges, pixel = ccd.bounds, ccd.pixel_size
    for name, count in (("n_holdout", n_holdout), ("n_observed", n_observed), ("margin", margin)):
        if count < 0:
            raise DomainError(f"{name} = {count}: expected a number that is not negative")
    if 2 * margin * pixel >= min(edges[1] - edges[0], edges[3] - edges[2]):
        raise DomainError(f"margin = {margin}: expected less than half of the CCD, bounds = {edges} m")
    bright, faint = depth.limits(fwhm)
    inner = (edges[0] + margin * pixel, edges[1] - margin * pixel, edges[2] + margin * pixel, edges[3] - margin * pixel)
    magnitude = draw_magnitudes(stream(seed, "stars", ccd.name, "observed", "magnitude"), n_observed, bright, faint)
    return StarField(
        ccd=ccd,
        holdout=ccd.turned(_uniform_positions(seed, ccd.name, "truth", n_holdout, edges)),
        observed=ccd.turned(_uniform_positions(seed, ccd.name, "observed", n_observed, inner)),
        magnitude=magnitude,
        electrons=photometry.electrons(magnitude, band, depth.exposure),
        band=band,
        exposure=float(depth.exposure),
        bright=bright,
        faint=faint,
    )


def draw_magnitudes(rng: np.random.Generator, count: int, bright: float, faint: float) -> np.ndarray:
    """Draw magnitudes whose counts go as 10^(0.2 m) between two limits, through the inverse of their distribution.

    The first magnitudes of a stream stay as they are when `count` grows.
    """
    return magnitudes_at(rng.random(count), bright, faint)


def magnitudes_at(quantile: np.ndarray, bright: float, faint: float) -> np.ndarray:
    """Return the magnitudes at quantiles, 0 to 1, of counts that go as 10^(0.2 m) between two limits."""
    span = 10.0 ** (COUNT_SLOPE * (faint - bright)) - 1.0
    return bright + np.log10(1.0 + quantile * span) / COUNT_SLOPE


def _uniform_positions(
    seed: int, ccd_name: str, kind: str, count: int, edges: tuple[float, float, float, float]
) -> np.ndarray:
    """Draw positions evenly over a rectangle, x and y from streams of their own."""
    return np.stack(
        [
            edges[2 * axis]
            + (edges[2 * axis + 1] - edges[2 * axis]) * stream(seed, "stars", ccd_name, kind, key).random(count)
            for axis, key in enumerate(("x", "y"))
        ],
        axis=1,
    )


def _rotated(positions: np.ndarray, bounds: tuple[float, float, float, float], turn: float) -> np.ndarray:
    """Return positions [n, 2] turned about the centre of a rectangle."""
    if turn == 0.0:
        return positions
    center = 0.5 * np.array([bounds[0] + bounds[1], bounds[2] + bounds[3]])
    cosine, sine = np.cos(turn), np.sin(turn)
    return center + (positions - center) @ np.array([[cosine, sine], [-sine, cosine]])


def _edges_in_metres(bounds: Any) -> tuple[float, float, float, float]:
    """Return the bounds as four floats in metres."""
    values = metres(bounds, "bounds")
    if values.shape != (4,) or not np.all(np.isfinite(values)) or values[0] >= values[1] or values[2] >= values[3]:
        raise DomainError(f"bounds = {bounds}: expected (xmin, xmax, ymin, ymax), minima below maxima")
    xmin, xmax, ymin, ymax = (float(v) for v in values)
    return xmin, xmax, ymin, ymax
