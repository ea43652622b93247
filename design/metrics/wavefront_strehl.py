"""Strehl ratios of wavefronts: the irradiance at the brightest point of the image, over that without aberrations."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter

#: Step of the search in waves of tilt at the rim: a third of that to the first dark ring of a clear pupil, 0.61.
_STEP = 0.2
#: Largest tilt [waves] of the search: an image whose brightest point is farther off has a ratio of a few per cent.
_FARTHEST = 4.0
#: Tilt [waves] of the ring about an image that defocus has made dark in its middle.
_RING = 1.0
#: Slope of a wavefront at its rim, over its largest deviation.
_SLOPE = 3.0
#: Largest range of a wavefront [waves] over the root of the number of points. Beyond it, phases between neighbours
#: differ by more than half a wave at the rim, and points in a regular pattern add up to ratios that mean nothing.
_LARGEST = 0.2
#: Irradiance, over the largest found, of a maximum that may be the highest: between two steps a peak loses a fifth.
_CLOSE = 0.8
#: Maxima that are followed to their peaks, at most.
_PEAKS = 4
#: Steps of Newton's method from such a maximum.
_NEWTON = 5
#: Step [waves] that ends Newton's method; the ratio goes with its square.
_SMALL = 1e-6


def brightest_strehl(weight: np.ndarray, pupil: np.ndarray, waves: np.ndarray) -> float:
    """Return the largest squared modulus of the mean of exp(2 pi i (W - tilt)) over all tilts.

    A tilt of the wavefront is a shift of the image, so that this is the ratio at the brightest point. Where aberrations
    are small, that point is the one of the least-squares tilt; where coma is large, it is far from it.

    Parameters
    ----------
    weight : ndarray, shape [n]
        Weights of the points, of sum 1.
    pupil : ndarray, shape [n, 2]
        Points of the pupil in units of its radius.
    waves : ndarray, shape [n]
        Wavefront without piston and least-squares tilt, in waves.

    Returns
    -------
    float
        The ratio; NaN where the wavefront is too steep for so many points, or a ray misses the reference sphere.
    """
    if not np.ptp(waves) <= _LARGEST * np.sqrt(len(waves)):
        return float("nan")
    field = weight * np.exp(2j * np.pi * waves)
    # Points at a mean distance of sqrt(pi / n) do not represent steeper tilts than half a wave over that distance; the
    # slope of the wavefront itself, that of defocus here, takes its part of it.
    steepest, largest = 0.5 * np.sqrt(len(waves) / np.pi), float(np.abs(waves).max())
    reach = max(largest, min(_RING + _SLOPE * largest, steepest - 4.0 * largest))
    count = int(np.ceil(min(reach, steepest, _FARTHEST) / _STEP))
    amplitude = (_powers(pupil[:, 1], count) * field) @ _powers(pupil[:, 0], count).T
    irradiance = amplitude.real**2 + amplitude.imag**2
    highest = maximum_filter(irradiance, 3, mode="constant") == irradiance
    rows, columns = np.nonzero(highest & (irradiance >= _CLOSE * irradiance.max()))
    places = _STEP * np.stack([columns - count, rows - count], axis=-1)
    order = np.argsort(-irradiance[rows, columns], kind="stable")[:_PEAKS]
    return max(_peak(field, pupil, place) for place in places[order])


def _peak(field: np.ndarray, pupil: np.ndarray, place: np.ndarray) -> float:
    """Return the irradiance at the maximum near a place, by Newton's method."""
    best = 0.0
    for _ in range(_NEWTON):
        value, gradient, hessian = _with_derivatives(field, pupil, place)
        best = max(best, value)
        # Negative definite about a maximum; a point with a flat top is left as it is.
        if hessian[0, 0] >= 0.0 or np.linalg.det(hessian) <= 0.0:
            break
        move = np.linalg.solve(hessian, gradient)
        place = place - move
        if np.abs(move).max() < _SMALL:
            break
    return best


def _powers(u: np.ndarray, many: int) -> np.ndarray:
    """Return exp(-2 pi i k u STEP) for whole numbers k from -many to many, shape [2 many + 1, n]."""
    powers = np.empty((many + 1, len(u)), dtype=np.complex128)
    powers[0], powers[1:] = 1.0, np.exp(-2j * np.pi * _STEP * u)
    np.multiply.accumulate(powers, axis=0, out=powers)
    return np.concatenate([np.conj(powers[:0:-1]), powers])


def _with_derivatives(field: np.ndarray, pupil: np.ndarray, place: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the irradiance at a place, its gradient and its Hessian."""
    phasors = field * np.exp(-2j * np.pi * (pupil @ place))
    turned = -2j * np.pi * pupil
    amplitude, first, second = phasors.sum(), phasors @ turned, (turned * phasors[:, None]).T @ turned
    hessian = 2.0 * (np.conj(amplitude) * second + np.outer(np.conj(first), first)).real
    return float(abs(amplitude) ** 2), 2.0 * (np.conj(amplitude) * first).real, hessian
