"""Noise of pixels of any correlation: its power spectrum, from an image or from a correlation function."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter

from ...core.arguments import check_arguments
from ...core.errors import DomainError, shown
from ...core.plotting import axes_at, styled
from ...core.result import Values
from ...core.units import pure_numbers, real_array, require_count, require_positive
from ..catalogue.pixel_checks import check_pixels
from .functionals import Frequencies

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Standard deviations from the median beyond which pixels belong to objects: noise alone has one in 16 000 there.
_CLIP = 4.0
#: Pixels around those of objects that are left out with them.
_GROWTH = 3
#: Fewest pixels of the sky: their correlations are known to 0.03.
_FEWEST = 1000
#: Largest farthest distance of correlated pixels [pixel].
_FARTHEST = 64
#: Largest deviation of a correlation function from its mirror image, and of its middle from 1.
_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class CorrelatedNoise(Values):
    """Noise that is the same everywhere on an image, with correlations between pixels.

    Parameters
    ----------
    rms : float
        Standard deviation of a pixel, in the unit of the image.
    correlation : array
        Correlation of two pixels by their distance (dx, dy), [m, m] with m odd, dx = dy = 0 in the middle, where it is
        1. Zero beyond.

    Raises
    ------
    DomainError
        If the rms is not positive, or the correlation has another shape, is not 1 in the middle, or differs between
        opposite distances.
    """

    rms: float
    correlation: np.ndarray

    def __post_init__(self) -> None:
        """Check the values."""
        require_positive(self.rms, "rms")
        values = real_array(self.correlation, "correlation: expected real numbers [m, m]")
        if values.ndim != 2 or values.shape[0] != values.shape[1] or values.shape[0] % 2 == 0:
            raise DomainError(f"correlation has shape {values.shape}: expected [m, m] with m odd", key="correlation")
        middle = values[len(values) // 2, len(values) // 2]
        if not (np.isfinite(values).all() and abs(middle - 1.0) < _TOLERANCE):
            raise DomainError(
                f"correlation: {middle:g} in the middle, expected finite numbers and 1", key="correlation"
            )
        if np.abs(values - values[::-1, ::-1]).max() > _TOLERANCE:
            raise DomainError("correlation: expected the same of (dx, dy) and (-dx, -dy)", key="correlation")
        object.__setattr__(self, "correlation", values)

    @classmethod
    @check_arguments
    def of_image(
        cls, image: ArrayLike, *, mask: ArrayLike | NDArray[np.bool_] | None = None, reach: int = 4
    ) -> CorrelatedNoise:
        """Estimate the noise from the sky of an image.

        Pixels of objects, more than four standard deviations from the median, are left out with those around them.
        Objects that are fainter remain, and are taken for noise.

        Parameters
        ----------
        image : array
            [ny, nx], background subtracted.
        mask : array, optional
            [ny, nx], not zero for pixels without value, or of objects.
        reach : int
            Largest distance of correlated pixels along x or y [pixel].

        Raises
        ------
        DomainError
            If fewer than a thousand pixels of sky are left, or their noise is zero.
        """
        pixels, _, ignored = check_pixels(image, 1.0, mask)
        farthest = require_count(reach, "reach", 0, _FARTHEST)
        sky = ~ignored
        if sky.sum() >= _FEWEST:
            level = np.median(pixels[sky])
            scatter = 1.4826 * np.median(np.abs(pixels[sky] - level))
            objects = np.where(sky, np.abs(pixels - level), 0.0) > _CLIP * scatter
            sky &= ~maximum_filter(objects, size=2 * _GROWTH + 1)
        if sky.sum() < _FEWEST:
            raise DomainError(f"image: {sky.sum()} pixels of sky, expected at least {_FEWEST}", key="image")
        values = np.where(sky, pixels - pixels[sky].mean(), 0.0)
        variance = float(np.mean(values[sky] ** 2))
        if variance == 0.0:
            raise DomainError("image: the noise of its sky is zero", key="image")
        correlation = np.zeros((2 * farthest + 1,) * 2)
        for dy in range(farthest + 1):
            for dx in range(-farthest, farthest + 1):
                pair = _shifted(values, dx, dy)
                both = _shifted(sky, dx, dy)
                pairs = max(int(np.count_nonzero(both[0] & both[1])), 1)
                covariance = np.vdot(*pair) / pairs
                correlation[farthest + dy, farthest + dx] = correlation[farthest - dy, farthest - dx] = covariance
        correlation /= variance
        correlation[farthest, farthest] = 1.0
        return cls(float(np.sqrt(variance)), correlation)

    @property
    def neighbour_correlation(self) -> float:
        """Largest correlation of a pixel with one of its four neighbours; 0 of white noise."""
        half = len(self.correlation) // 2
        if half == 0:
            return 0.0
        return float(np.max(np.abs([self.correlation[half, half + 1], self.correlation[half + 1, half]])))

    def power(self, frequencies: Frequencies) -> np.ndarray:
        """Return the variance of the transform of noise, over the number of pixels, at frequencies, [ny, nx]."""
        half = len(self.correlation) // 2
        distance = np.arange(-half, half + 1)
        along_x = np.exp(-1j * distance[:, None] * frequencies.kx)
        along_y = np.exp(-1j * frequencies.ky * distance)
        # A correlation function that is cut, or measured, may have small negative powers.
        return np.asarray(self.rms**2 * np.maximum((along_y @ self.correlation @ along_x).real, 0.0))

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the correlation by the distance of pixels."""
        half = len(self.correlation) // 2 + 0.5
        with styled():
            figure, axes = axes_at(ax, 4.6, 4.0)
            image = axes.imshow(
                self.correlation, origin="lower", extent=(-half, half, -half, half), vmin=-1.0, vmax=1.0
            )
            axes.set_xlabel("dx [pixel]")
            axes.set_ylabel("dy [pixel]")
            figure.colorbar(image, ax=axes, label="correlation")
        return figure


def noise_power(noise: ArrayLike | CorrelatedNoise, count: int, frequencies: Frequencies) -> np.ndarray:
    """Return the power of the noise under each of so many PSFs, [count, 1 or ny, 1 or nx].

    Raises
    ------
    DomainError
        If rms values are not positive, or neither one nor one of each PSF.
    """
    if isinstance(noise, CorrelatedNoise):
        return np.broadcast_to(noise.power(frequencies), (count, len(frequencies.ky), frequencies.most + 1))
    rms = pure_numbers(noise, "noise")
    if rms.shape not in ((), (count,)) or not np.all((rms > 0.0) & np.isfinite(rms)):
        raise DomainError(
            f"noise = {shown(noise)}: expected a positive rms of the pixels, of all or of each of {count} PSFs",
            key="noise",
        )
    return np.asarray(np.broadcast_to(rms, (count,))[:, None, None] ** 2)


def _shifted(values: np.ndarray, dx: int, dy: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the parts of an image whose pixels are (dx, dy) apart, dy not negative."""
    height, width = values.shape
    first = values[: height - dy, max(0, -dx) : width - max(0, dx)]
    second = values[dy:, max(0, dx) : width - max(0, -dx)]
    return first, second
