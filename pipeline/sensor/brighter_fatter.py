r"""The brighter-fatter effect: charge in a pixel repels charge, so boundaries move towards pixels that hold more.

The boundary between two pixels moves in proportion to the charge q in the pixels about it (Antilogus et al. 2014, JINST
9, C03048; Guyonnet et al. 2015, A&A 575, A41),

.. math:: \delta = \sum_{ij} a_{ij} \, q_{ij}.

While a star is exposed, its charge grows in proportion to the time, so to first order the charge that is collected is
that within the boundaries at half the charge.

The coefficients are the mean displacements of the pixel boundaries in the electrostatic simulations of LSST sensors at
a back bias of 50 V that come with GalSim 2.8.5 (files ``share/sensors/lsst_itl_50_32.dat`` and
``lsst_e2v_50_32.dat``, by the Poisson_CCD code of Lage, Bradshaw & Tyson 2017, JINST 12, C03091; GalSim's licence is
BSD-style), there of a pixel of 10 um with 100 000 electrons, averaged over the symmetries of the pixel. As in GalSim's
``SiliconSensor``, charge up to three pixels away counts.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.units import pure_numbers
from .pixel_boundaries import collect, with_rim, without_rim

#: Side of the pixels that the coefficients belong to [m].
PIXEL_SIZE = 10e-6
SensorVendor = Literal["itl", "e2v"]
#: Displacement of a boundary towards the charge [1e-9 pixel per electron], along x (serial) and along y (parallel):
#: rows by the distance of the charge along the boundary, columns by that across it, 0 for the pixels at the boundary.
COEFFICIENTS: dict[SensorVendor, tuple[np.ndarray, np.ndarray]] = {
    "itl": (
        np.array(
            [
                [197.9, 36.3, 13.5, 5.85],
                [48.1, 23.3, 11.0, 5.12],
                [6.37, 9.27, 6.47, 3.55],
                [1.75, 3.66, 3.42, 2.20],
            ]
        ),
        np.array(
            [
                [332.8, 40.9, 14.2, 6.01],
                [38.4, 23.9, 11.3, 5.24],
                [5.54, 8.91, 6.41, 3.59],
                [1.66, 3.58, 3.35, 2.17],
            ]
        ),
    ),
    "e2v": (
        np.array(
            [
                [403.4, 92.0, 34.0, 14.7],
                [105.0, 57.8, 27.4, 12.8],
                [14.4, 22.4, 16.1, 8.93],
                [4.22, 9.00, 8.50, 5.56],
            ]
        ),
        np.array(
            [
                [689.8, 98.7, 35.1, 14.9],
                [107.2, 60.6, 28.1, 13.0],
                [14.8, 22.9, 16.3, 9.06],
                [4.28, 9.13, 8.59, 5.57],
            ]
        ),
    ),
}
_REACH = 4


def boundary_shifts(charge: np.ndarray, sensor: SensorVendor) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacements of the boundaries of pixels with a given charge.

    Parameters
    ----------
    charge : ndarray, shape [n, ny, nx]
        Electrons in each pixel. Beyond the rim it is that of the outermost pixels.
    sensor : {"itl", "e2v"}
        Make of the CCD.

    Returns
    -------
    shift_x, shift_y : ndarray, shapes [n, ny, nx + 1] and [n, ny + 1, nx]
        Displacements along x and along y [pixel].
    """
    along_x, along_y = COEFFICIENTS[sensor]
    return _shifts(charge, along_x), _shifts(charge.swapaxes(1, 2), along_y).swapaxes(1, 2)


def _shifts(charge: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Return the displacements of the boundaries across rows, [n, ny, nx + 1]."""
    # Charge on the left of a boundary draws it to the left, to negative displacements.
    across = np.concatenate([-coefficients[:, ::-1], coefficients], axis=1)
    kernel = 1e-9 * np.concatenate([across[:0:-1], across])
    padded = np.pad(charge, ((0, 0), (_REACH - 1, _REACH - 1), (_REACH, _REACH)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel.shape, axis=(1, 2))
    return np.einsum("nyxab,ab->nyx", windows, kernel)


@check_arguments
def brighter_fatter(
    images: np.ndarray, electrons: np.ndarray, *, sensor: SensorVendor = "itl", sky: float = 0.0
) -> np.ndarray:
    """Return images of stars as a CCD collects them under the brighter-fatter effect.

    Parameters
    ----------
    images : ndarray, shape [n, ny, nx]
        Expected light of the stars in pixels of 10 um, charge diffusion included, as fractions; columns (parallel
        transfer) run along y.
    electrons : ndarray, shape [n]
        Electrons of each star.
    sensor : {"itl", "e2v"}
        Make of the CCD.
    sky : float
        Electrons of the sky in a pixel. Even light moves no boundary, but it is collected within those that the star
        moves.

    Returns
    -------
    ndarray, shape [n, ny, nx]
        Expected charge less the sky, as fractions of the electrons of the star. It is the mean; how the noise of a
        pixel moves boundaries is left out.

    Raises
    ------
    ConfigError
        If the sensor is unknown.
    DomainError
        If shapes do not fit, electrons are not positive, or the sky is negative.
    """
    stamps = pure_numbers(images, "images")
    counts = pure_numbers(electrons, "electrons")
    if stamps.ndim != 3 or counts.shape != stamps.shape[:1]:
        raise DomainError(f"images, electrons of shapes {stamps.shape}, {counts.shape}: expected [n, ny, nx] and [n]")
    if not np.isfinite(stamps).all():
        raise DomainError("images: expected finite numbers")
    if not (np.isfinite(counts).all() and (counts > 0.0).all()):
        raise DomainError(f"electrons = {electrons}: expected positive numbers")
    if not (np.isfinite(sky) and sky >= 0.0):
        raise DomainError(f"sky = {sky}: expected a number of electrons that is not negative")
    light = with_rim(stamps * counts[:, None, None] + sky)
    collected = without_rim(collect(light, *boundary_shifts(0.5 * light, sensor)))
    return (collected - sky) / counts[:, None, None]
