"""CCDs of a focal plane by name, where positions of stars and predictions belong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units as u
from numpy.typing import ArrayLike

from ...core.errors import DomainError, unknown_name
from ...core.point_plots import draw_shapes
from ...core.units import ARCSEC, broadcast_together, metres
from ...models.camera.camera import Camera
from .covariance import Places

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Distance outside the rim of a CCD, in halves of its side, at which a position still counts as on it.
_RIM = 1e-3


@dataclass(frozen=True, eq=False)
class Mosaic:
    """Names, centres and size of the CCDs.

    Attributes
    ----------
    names : tuple of str
        Names of the CCDs.
    centers : ndarray, shape [n_ccd, 2]
        Their centres on the detector [m].
    half_size : float
        Half the side of a CCD [m], where there is no camera.
    camera : Camera or None
        The camera, if known: it converts positions on the detector to those on a CCD, and pixels to both.
    """

    names: tuple[str, ...]
    centers: np.ndarray
    half_size: float
    camera: Camera | None = None

    @classmethod
    def of_camera(cls, camera: Camera) -> Mosaic:
        """Return the CCDs of a camera."""
        return cls(camera.ccd_names, camera.centers, 0.5 * camera.shortest_side, camera)

    @classmethod
    def of_stars(cls, names: Sequence[str], xy: np.ndarray) -> Mosaic:
        """Return CCDs about the stars [n, 2] of each name: as large as the largest extent of stars on one of them."""
        different = tuple(sorted(set(names)))
        labels = np.asarray(names)
        low, high = (np.array([f(xy[labels == n], axis=0) for n in different]) for f in (np.min, np.max))
        half = 0.5 * float(np.max(high - low))
        return cls(different, 0.5 * (low + high), half if half > 0.0 else 1.0)

    def index(self, names: str | Sequence[str]) -> np.ndarray:
        """Return the numbers of CCDs of given names; UnknownNameError for another name."""
        listed = [names] if isinstance(names, str) else list(names)
        numbers = {name: i for i, name in enumerate(self.names)}
        for name in listed:
            if str(name) not in numbers:
                raise unknown_name("CCD", str(name), self.names)
        return np.array([numbers[str(name)] for name in listed], dtype=np.int64)

    def places(self, ccd: str | Sequence[str], x: Any, y: Any) -> Places:
        """Return places of given coordinates.

        Parameters
        ----------
        ccd : str or sequence of str
            CCD of all, or of each.
        x, y : array_like or Quantity
            Position on the detector: lengths [m]; or pixels of the CCD (``astropy.units.pix``), the centre of the first
            one at (0, 0).
        """
        numbers = self.index(ccd)
        in_pixels = [isinstance(value, u.Quantity) and value.unit == u.pix for value in (x, y)]
        if any(in_pixels) and (not all(in_pixels) or self.camera is None):
            axis = "xy"[in_pixels.index(True)]
            raise DomainError(f"{axis} in pixels: expected a camera, or positions on the detector in metres")
        px, py = (x.value, y.value) if all(in_pixels) else (metres(x, "x"), metres(y, "y"))
        px, py, numbers = broadcast_together({"x": np.atleast_1d(px), "y": np.atleast_1d(py), "ccd": numbers})
        xy, numbers = np.stack([px.ravel(), py.ravel()], axis=1), numbers.ravel()
        if all(in_pixels) and self.camera is not None:
            xy = self.camera.from_pixel(numbers, xy)
        if not np.isfinite(xy).all():
            raise DomainError(f"x, y: {np.count_nonzero(~np.isfinite(xy).all(axis=1))} positions are not finite")
        places = self.at(xy, numbers)
        off = np.flatnonzero((np.abs(places.uv) > 1.0 + _RIM).any(axis=1))
        if self.camera is not None and off.size:
            first = off[0]
            raise DomainError(
                f"{off.size} positions are not on the CCD that they name, the first of them"
                f" {self.names[places.ccd[first]]} at x, y = {1e3 * xy[first, 0]:.3f}, {1e3 * xy[first, 1]:.3f} mm"
            )
        return places

    def at(self, xy: np.ndarray, ccd: np.ndarray) -> Places:
        """Return the places at positions on the detector [m] on CCDs of given numbers."""
        if self.camera is not None:
            return Places(xy, ccd, self.camera.to_uv(ccd, xy))
        return Places(xy, ccd, (xy - self.centers[ccd]) / self.half_size)

    def from_uv(self, ccd: int, uv: np.ndarray) -> np.ndarray:
        """Return the position on the detector [m] of a place of a CCD in halves of its side, [2]."""
        if self.camera is not None:
            return self.camera.from_uv(ccd, uv)
        return self.centers[ccd] + self.half_size * uv


@dataclass(frozen=True, eq=False)
class PsfShapes:
    """Shapes of the PSF at places, one array element each.

    Attributes
    ----------
    e1, e2 : ndarray
        Ellipticity (a - b)/(a + b), along x and along the diagonal.
    size : ndarray
        Weighted rms size [rad], as :func:`~pachon.measure_shapes` defines it.
    """

    e1: np.ndarray
    e2: np.ndarray
    size: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the ellipticities in their plane, coloured by the size."""
        return draw_shapes(ax, self.e1, self.e2, self.size / ARCSEC, "weighted rms size [arcsec]")

    @classmethod
    def of_values(cls, values: ArrayLike) -> PsfShapes:
        """Return the shapes of e1, e2 and ln size [n, 3]."""
        e1, e2, log_size = np.asarray(values, dtype=np.float64).T
        return cls(e1, e2, np.exp(log_size))

    def __len__(self) -> int:
        return len(self.e1)
