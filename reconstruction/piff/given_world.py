"""World coordinates of a Piff file by a WCS that is given: tangent-plane positions about the pointing of the stars."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.units import ARCSEC
from .tables import PiffTables
from .world import star_columns

# Step along x and y to either side for derivatives [pixel]: of a scale that changes by 1e-3 in a pixel good to 1e-7.
_STEP = 0.5
# Largest distance of a star from where the file has it [arcsec]: programs differ by a pixel in where they count from.
_FARTHEST = 1.0


@dataclass(frozen=True, eq=False)
class GivenWorld:
    """Field positions and Jacobians by a celestial WCS, in the tangent plane of Piff: u to the west, v to the north.

    Attributes
    ----------
    wcs : object
        With `pixel_to_world_values`, as of astropy: degrees of right ascension and declination, pixels from 0.
    pointing : tuple of float
        Right ascension and declination of the tangent point [rad].
    error : float
        Largest distance of a star from its u and v in the file [arcsec].
    """

    wcs: Any
    pointing: tuple[float, float]
    error: float

    @classmethod
    def fit(cls, tables: PiffTables, chip: int | None, wcs: Any) -> GivenWorld:
        """Find the pointing by the stars of a file, on one chip of several; ProductError if the WCS is not theirs."""
        from scipy.optimize import least_squares  # a fifth of a second

        stars = star_columns(tables, chip)
        places, field = stars[:, :2], stars[:, 2:4]
        if len(stars) == 0:
            raise tables.error("no stars with u and v, by which the pointing is found: expected at least one")
        ra, dec = _middle(_sky(wcs, places))
        u, v = field.mean(axis=0) * ARCSEC
        start = np.array([ra + u / np.cos(dec), dec - v])

        def distances(pointing: np.ndarray) -> np.ndarray:
            return np.asarray(cls(wcs, (pointing[0], pointing[1]), 0.0)._field(places) - field)

        best = least_squares(lambda pointing: distances(pointing).ravel(), start, x_scale=ARCSEC, xtol=1e-15)
        error = float(np.hypot(*distances(best.x).T).max())
        if not error < _FARTHEST:
            chip_text = "" if chip is None else f" of chip {chip}"
            raise tables.error(
                f"wcs: puts stars {error:.3g} arcsec from their u, v in the file: expected the WCS{chip_text} of the "
                "image, within 1 arcsec"
            )
        return cls(wcs, (float(best.x[0] % (2.0 * np.pi)), float(best.x[1])), error)

    def at(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return u, v [arcsec], shape [n, 2], and Jacobians [arcsec/pixel], shape [n, 2, 2], at pixels [n, 2]."""
        steps = np.array([[_STEP, 0.0], [0.0, _STEP]])
        derivatives = [self._field(positions + step) - self._field(positions - step) for step in steps]
        return self._field(positions), np.stack(derivatives, axis=2) / (2.0 * _STEP)

    def _field(self, positions: np.ndarray) -> np.ndarray:
        """Return u, v [arcsec] at pixels [n, 2]: the gnomonic projection about the pointing."""
        ra, dec = _sky(self.wcs, positions).T
        ra0, dec0 = self.pointing
        cosine = np.sin(dec0) * np.sin(dec) + np.cos(dec0) * np.cos(dec) * np.cos(ra - ra0)
        u = -np.cos(dec) * np.sin(ra - ra0)
        v = np.cos(dec0) * np.sin(dec) - np.sin(dec0) * np.cos(dec) * np.cos(ra - ra0)
        return np.stack([u, v], axis=1) / cosine[:, None] / ARCSEC


def _middle(sky: np.ndarray) -> tuple[float, float]:
    """Return right ascension and declination of the mean direction of places [n, 2] [rad]."""
    ra, dec = sky.T
    # Right ascensions themselves have no mean where they begin anew.
    x, y, z = (np.mean(axis) for axis in (np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)))
    return float(np.arctan2(y, x)), float(np.arctan2(z, np.hypot(x, y)))


def _sky(wcs: Any, positions: np.ndarray) -> np.ndarray:
    """Return right ascension and declination [rad] of pixels [n, 2], the first one at 1."""
    return np.deg2rad(np.stack(wcs.pixel_to_world_values(*(positions.T - 1.0)), axis=1))
