r"""Covariances over the field of the Zernikes of turbulence, averaged over an exposure.

Layers drift across the pupil, and the mean of the path over an exposure of length T has Zernike coefficients

.. math:: c_j = \int \hat\psi(\nu) \, Q_j(\nu) \, \mathrm{sinc}(\nu \cdot v T) \, e^{2 \pi i \nu \cdot x} \, d^2\nu,

with the transform Q of a Zernike over the annulus and the place x where the light of a star crosses the layer. With the
von Karman spectrum W the covariances of two stars, whose light crosses at a distance d, are

.. math:: \langle c_i c_j \rangle = \sum_{layers} w \int W Q_i Q_j^* \, \mathrm{sinc}^2(\nu \cdot v T)
          \, e^{-2 \pi i \nu \cdot d} \, d^2\nu.

At T = 0 these are the coefficients of Noll (1976, J. Opt. Soc. Am. 66, 207); beyond the time in which the wind crosses
the pupil they fall as 1/T. A single donut cannot separate this wavefront from that of the telescope.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import jv, sici

from ...core.errors import DomainError
from ...models.zernike_polynomials import annular_zernikes, noll_to_nm
from .atmosphere import Atmosphere
from .moment_covariance import ExposedAir
from .turbulence import path_spectrum

# Frequencies times the diameter of the pupil: lowest, highest and number, on a logarithmic scale.
_FREQUENCIES = (0.005, 40.0, 100)
# The same up to which frequencies follow the waves of two stars: of a long exposure's Z4 to Z10, 0.4 % of the variance
# at most lies beyond, and of Z11, the smallest, a tenth.
_FOLLOWED = 4.0
# Largest distance of two stars' light over the diameter of the pupil that they follow.
_FARTHEST = 200.0
# Directions over half the plane: enough for the narrow lobe of a long exposure, which is 1/300 rad wide at 1 cycle/m
# after 15 s of 20 m/s. Of narrower ones the mean between directions is taken.
_DIRECTIONS = 768
# Least half-width of a cell over which a mean of sinc^2 is taken from its integral: below, its middle is as good.
_LEAST_CELL = 1e-3
# Values between which frequencies are interpolated, and steps of Newton's from there.
_TABLE = 4096
_NEWTON_STEPS = 3
# Nodes of the integral over the radius of the pupil.
_RADII = 60
# Distance, in outer scales, beyond which the light of two stars crosses independent turbulence.
_INDEPENDENT = 5.0


def mean_wavefront_covariance(
    atmosphere: Atmosphere | ExposedAir, fields: ArrayLike, noll: ArrayLike, diameter: float, obscuration: float
) -> np.ndarray:
    """Return the covariance of the Zernikes of the mean wavefront of an exposure [m^2].

    Parameters
    ----------
    atmosphere : Atmosphere or ExposedAir
        Layers, winds, Fried parameter, outer scale and exposure time; its screens are not used.
    fields : array_like, shape [n_star, 2]
        Field slopes of the stars (tx, ty) [rad].
    noll : array_like of int, shape [n_noll]
        Noll indices, from 4.
    diameter, obscuration : float
        Outer diameter of the entrance pupil [m], and its linear obscuration.

    Returns
    -------
    ndarray, shape [n_star, n_noll, n_star, n_noll]
        Stars whose light crosses a layer more than five outer scales apart share nothing of it.

    Raises
    ------
    DomainError
        If there are no Noll indices, or one is below 4.
    """
    indices = np.atleast_1d(np.asarray(noll, dtype=np.int64))
    if not indices.size or indices.min() < 4:
        raise DomainError(f"noll = {indices.tolist()}: expected Noll indices from 4")
    slopes = np.atleast_2d(np.asarray(fields, dtype=np.float64))
    n_star, n_noll = len(slopes), len(indices)
    lags = (slopes[:, None] - slopes).reshape(-1, 2)
    farthest = _farthest(atmosphere.altitudes, lags, atmosphere.outer_scale, diameter)
    frequency, width = (values / diameter for values in _frequencies(farthest))
    angle = _directions()
    transform = _zernike_transforms(tuple(indices.tolist()), obscuration, farthest)
    plane = frequency[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    # The other half of the plane is the complex conjugate.
    area = 2.0 * (np.pi / _DIRECTIONS) * frequency * width
    power = area * path_spectrum(frequency, atmosphere.r0, atmosphere.outer_scale)
    covariance = np.zeros((n_star, n_noll, n_star, n_noll))
    velocities = np.reshape(atmosphere.velocities, (-1, 2))
    for altitude, weight, velocity in zip(atmosphere.altitudes, atmosphere.weights, velocities, strict=True):
        layer_power = weight * power[:, None] * _smear(frequency, angle, velocity * atmosphere.exposure)
        apart = altitude * (slopes[:, None] - slopes)
        covariance_at: dict[tuple[float, float], np.ndarray] = {}
        for a in range(n_star):
            for b in range(a, n_star):
                distance = apart[a, b]
                if np.hypot(*distance) > _INDEPENDENT * atmosphere.outer_scale:
                    continue
                key = (float(distance[0]), float(distance[1]))
                if key not in covariance_at:
                    shifted = transform * (layer_power * np.exp(-2j * np.pi * (plane @ distance)))[..., None]
                    covariance_at[key] = np.tensordot(shifted, transform.conj(), axes=((0, 1), (0, 1))).real
                covariance[a, :, b] += covariance_at[key]
                if a != b:
                    covariance[b, :, a] += covariance_at[key].T
    return covariance


def covariance_by_wavefront(air: ExposedAir, lags: np.ndarray, noll: ArrayLike, products: np.ndarray) -> np.ndarray:
    """Return covariances of quantities that are linear in the mean wavefront of layers above the ground.

    Parameters
    ----------
    air : ExposedAir
        The exposure.
    lags : ndarray, shape [n_lag, 2]
        Field slopes from one star to the other [rad].
    noll : array_like of int, shape [n_noll]
        Noll indices, from 4.
    products : ndarray, shape [n_pair, n_noll, n_noll]
        Products of the derivatives of both quantities of a pair with respect to the coefficients [1/m^2].

    Returns
    -------
    ndarray, shape [n_lag, n_pair]
        Mean over a lag and its opposite.
    """
    farthest, angle = _farthest(air.altitudes, lags, air.outer_scale, air.diameter), _directions()
    frequency, width = (values / air.diameter for values in _frequencies(farthest))
    plane = (frequency[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).reshape(-1, 2)
    indices = tuple(np.atleast_1d(np.asarray(noll, dtype=np.int64)).tolist())
    transform = _zernike_transforms(indices, air.obscuration, farthest).reshape(len(plane), len(indices))
    area = 2.0 * (np.pi / _DIRECTIONS) * frequency * width
    power = np.repeat(area * path_spectrum(frequency, air.r0, air.outer_scale), _DIRECTIONS)
    spectra = np.stack([((transform @ matrix) * transform.conj()).sum(axis=1).real for matrix in products], axis=1)
    spectra *= power[:, None]
    scale = float(np.abs(spectra).max()) or 1.0
    out = np.zeros((len(lags), len(products)))
    for altitude, weight, velocity in zip(air.altitudes, air.weights, air.velocities, strict=True):
        distance = altitude * lags
        near = np.flatnonzero(np.hypot(*distance.T) <= _INDEPENDENT * air.outer_scale)
        if altitude == 0.0:
            continue
        smear = _smear(frequency, angle, np.array(velocity) * air.exposure).reshape(-1, 1)
        drifted = (weight * smear * spectra) / scale
        # Cosines in single precision, in a fifth of the time: phases of 4000 rad are right to 3e-4.
        single, turns = drifted.astype(np.float32), (2.0 * np.pi * plane.T).astype(np.float32)
        for some in np.array_split(near, max(1, len(near) // 16)):
            out[some] += scale * (np.cos(distance[some].astype(np.float32) @ turns) @ single)
    return out


def _smear(frequency: np.ndarray, angle: np.ndarray, drift: np.ndarray) -> np.ndarray:
    """Return sinc^2 of the drift [2] [m] at frequencies [1/m] and directions [rad], [n_frequency, n_angle]."""
    along, across = (
        np.cos(angle) * drift[0] + np.sin(angle) * drift[1],
        np.cos(angle) * drift[1] - np.sin(angle) * drift[0],
    )
    turns = frequency[:, None] * along
    smear = np.sinc(turns) ** 2
    step = np.pi / _DIRECTIONS
    # Values of sinc^2 less than a cycle apart have its integral; of those farther apart the sum is chance.
    coarse = frequency * np.hypot(*drift) * step > 1.0
    smear[coarse] = mean_sinc_squared(turns[coarse], 0.5 * step * np.abs(frequency[coarse, None] * across))
    return smear


def mean_sinc_squared(middle: np.ndarray, half: ArrayLike) -> np.ndarray:
    """Return the mean of sin^2(pi t)/(pi t)^2 over cells of t, by their middles and half-widths."""
    width = np.broadcast_to(half, middle.shape)
    wide = width > _LEAST_CELL
    mean = np.sinc(middle) ** 2
    ends = middle[wide] + np.multiply.outer([-1.0, 1.0], width[wide])
    # The integral from zero, Si(2 pi t)/pi - sin^2(pi t)/(pi^2 t).
    integral = sici(2.0 * np.pi * ends)[0] / np.pi - ends * np.sinc(ends) ** 2
    mean[wide] = np.maximum(integral[1] - integral[0], 0.0) / (2.0 * width[wide])
    return mean


def _farthest(altitudes: ArrayLike, lags: np.ndarray, outer_scale: float, diameter: float) -> float:
    """Return the distance that frequencies have to follow, over the diameter of the pupil.

    Of stars that are lags [n, 2] [rad] apart it is the largest one in layers at altitudes [m] at which they share
    turbulence, rounded up to a power of two: few transforms are then computed anew.
    """
    distances = np.multiply.outer(np.asarray(altitudes, dtype=np.float64), np.hypot(*lags.T)) / diameter
    shared = distances[(distances > 0.0) & (distances <= _INDEPENDENT * outer_scale / diameter)]
    return float(min(2.0 ** np.ceil(np.log2(shared.max())), _FARTHEST)) if shared.size else 0.0


@lru_cache(maxsize=4)
def _frequencies(farthest: float) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies times the diameter of the pupil, and the intervals that they stand for, [n_frequency] both.

    They stand on a logarithmic scale, but closer where the waves of two stars so many diameters apart would alias:
    beyond a few cycles a diameter little is left. The trapezoidal rule in a smooth function of the frequency is right
    to all orders.
    """
    low, high, count = _FREQUENCIES
    step = np.log(high / low) / (count - 1)
    frequency = np.geomspace(low, high, count)
    if not farthest:
        return frequency, step * frequency
    closest = 1.0 / (2.0 * farthest + 4.0)

    def interval(frequency: np.ndarray) -> np.ndarray:
        return np.asarray(1.0 / (1.0 / (step * frequency) + 1.0 / (closest * (1.0 + (frequency / _FOLLOWED) ** 2))))

    def number(frequency: np.ndarray) -> np.ndarray:
        return np.asarray(np.log(frequency) / step + _FOLLOWED / closest * np.arctan(frequency / _FOLLOWED))

    first, last = number(frequency[[0, -1]])
    numbers = np.linspace(first, last, int(np.ceil(last - first)) + 1)
    table = np.geomspace(low, high, _TABLE)
    frequency = np.interp(numbers, number(table), table)
    for _ in range(_NEWTON_STEPS):
        frequency = frequency - (number(frequency) - numbers) * interval(frequency)
    return frequency, interval(frequency) * (numbers[1] - numbers[0])


@lru_cache(maxsize=2)
def _zernike_transforms(indices: tuple[int, ...], obscuration: float, farthest: float) -> np.ndarray:
    """Return means over the annulus of Zernikes times a plane wave, [n_frequency, n_angle, n_noll].

    They are at the frequencies of :func:`_frequencies` and the directions of :func:`mean_wavefront_covariance`, which
    are stored, as they do not depend on the atmosphere.
    """
    frequency, angle = 0.5 * _frequencies(farthest)[0], _directions()
    out = np.empty((len(frequency), len(angle), len(indices)), dtype=np.complex128)
    for k, j in enumerate(indices):
        _, m = noll_to_nm(j)
        order = abs(m)
        around = np.cos(order * angle) if m >= 0 else np.sin(order * angle)
        out[:, :, k] = 1j**order * _radial_means(j, frequency, obscuration)[:, None] * around
    return out


def _directions() -> np.ndarray:
    """Return the directions of frequencies over half the plane [rad], [n_angle]."""
    return np.pi * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS


def _radial_means(noll: int, frequency: np.ndarray, obscuration: float) -> np.ndarray:
    """Return means over the annulus of a Zernike's radial part times a wave's, at cycles per radius of the pupil."""
    node, weight = np.polynomial.legendre.leggauss(_RADII)
    radius = 0.5 * ((1.0 - obscuration) * node + 1.0 + obscuration)
    weight = weight * (1.0 - obscuration) * radius / (1.0 - obscuration**2)
    _, m = noll_to_nm(noll)
    order = abs(m)
    # Along this direction the cosine or the sine of the Zernike is 1.
    crest = 0.0 if m >= 0 else 0.5 * np.pi / order
    radial = annular_zernikes(noll, radius * np.cos(crest), radius * np.sin(crest), obscuration)[-1]
    return np.asarray(jv(order, 2.0 * np.pi * np.outer(frequency, radius)) @ (weight * radial))


@lru_cache(maxsize=32)
def radial_transform(noll: int, highest: float, count: int, obscuration: float) -> np.ndarray:
    """Return means over the annulus of a Zernike times a plane wave, without their angular part and i^m, [count].

    They are at evenly spaced frequencies from 0 to ``highest`` cycles per diameter of the pupil.
    """
    return _radial_means(noll, 0.5 * np.linspace(0.0, highest, count), obscuration)
