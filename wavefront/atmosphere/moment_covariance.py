r"""Covariances over the field of the second moments of the images of one exposure, by turbulence.

The moments of the image of a star about its centroid are means over pupil and exposure of products of slopes,
:math:`M_{ij} = \langle s_i s_j \rangle - \langle s_i \rangle \langle s_j \rangle`. The slopes s are Gaussian, and
Wick's theorem gives the covariance of the moments of two stars a lag d apart:

.. math:: \mathrm{cov}(M_{ij}, M'_{kl}) = \langle S_{ik} S_{jl} + S_{il} S_{jk} \rangle, \qquad
          S(u, \tau) = \sum_{layers} w \, S_{vK}(u - H d - V \tau).

The mean is one over the baselines u of the lit pupil, with the weight of its autocorrelation, and over the delays
:math:`\tau` in the exposure T, with the weight :math:`1 - |\tau|/T`. S is squared after the sum over layers: its cross
terms, of the ground with higher layers, are the largest that change over the field. What the mean slope takes away is
included but for its change over the pupil, which is some per cent of a tenth.

Moments of higher even orders n move ellipticity and size too, by :class:`.MomentResponse`. Those of different orders
are uncorrelated (Hermite polynomials of Gaussian slopes); their covariances are those parts of

.. math:: \left\langle \frac{(\mathbf{k} \cdot S \, \mathbf{k}')^n}{n!} \right\rangle

that go as cos 2phi, sin 2phi and no angle of both wavenumbers. In 15 s of the LSST the fourth order adds 3 % to the
variances and 7 to 10 % to half-variograms at 1', the sixth 0.1 % and 0.7 %. They are included as
moments of the second order of the same effect.

So are products of the third order with one slope of the optics' aberrations: in 15 s of DECam they add 2 % to the
variances and 3 % to half-variograms at 1'. Those of the first order are what the mean wavefront does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np
import warp as wp

from ...core.launch import launch
from ...core.warp_arrays import warp_array
from .atmosphere import Atmosphere
from .field_pupils import FieldPupils
from .moment_kernels import LANES, SLOPES, TERMS, average_products, baselines, products_with_mean_slope
from .slope_covariance import slope_covariance
from .turbulence import diffraction_otf

#: Components of the moments: p = Mxx - Myy, q = 2 Mxy, s = Mxx + Myy.
COMPONENTS = ("p", "q", "s")
#: Row and column of the six covariances of the components, in their order.
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
#: Shortest exposure whose moments are Gaussian [s]: below it few speckles add up.
LEAST_EXPOSURE = 5.0
# Drift up to which delays count as near zero [m]: peaks of the slopes' covariance are narrower.
_NEAR = 8.0
# Distance from the pupil's rim from which on the slopes of a layer, a hundredth of theirs, vary little over it [m].
_DISTANT = 8.0
# Steps of the shift of the lattice, in parts of its spacing: of the plastic number (Roberts 2018), which fill a square
# evenly.
_PLASTIC = 1.32471795724474602596
# Factors of the products of higher orders that act as p, q and s: 64 / n! and 16 / n! times means of powers of cosines.
_FOURTH = np.array([1.0 / 3.0, 1.0 / 3.0, 1.0 / 4.0])
_SIXTH = np.array([1.0 / 96.0, 1.0 / 96.0, 1.0 / 144.0])
# The same of the third order and a slope of the optics of any direction.
_THIRD = np.array([2.0 / 3.0, 2.0 / 3.0, 1.0 / 2.0])
# Slopes in microradians: the fourth powers of their covariances, in radians, are below the least number of float32.
MICRO = 1e-6


class MomentSampling(NamedTuple):
    """Baselines of the pupil, and delays between moments of the exposure, of which covariances are sums."""

    #: Spacing of the baselines at each delay [m]: their lattice is shifted from one to the next, so that together they
    #: lie much closer.
    spacing: float = 1.4
    near_spacing: float = 0.7  #: the same at delays near zero [m]
    drift: float = 1.4  #: largest drift of a layer from one delay to the next [m]
    near_drift: float = 0.5  #: the same near zero [m]
    least_delays: int = 64  #: on either side of zero
    #: Wind that the delays are chosen for [m/s]; by default the fastest. With one for all winds, covariances are smooth
    #: functions of them.
    wind: float | None = None


#: Sampling of covariances within a per cent, half-variograms at 1' among them.
FINE = MomentSampling()
#: Sampling of covariances within 2 %.
COARSE = MomentSampling(drift=2.8, near_drift=1.0, least_delays=32)


class ExposedAir(NamedTuple):
    """All of an exposure on which statistics of its moments depend; hashable, so that they can be stored."""

    altitudes: tuple[float, ...]
    weights: tuple[float, ...]
    velocities: tuple[tuple[float, float], ...]
    exposure: float
    r0: float
    outer_scale: float
    cutoff: float
    diameter: float
    obscuration: float

    @classmethod
    def of(cls, atmosphere: Atmosphere, diameter: float, obscuration: float) -> Self:
        """Return that of an atmosphere through a pupil of a diameter [m] and linear obscuration."""
        return cls(
            tuple(atmosphere.altitudes.tolist()),
            tuple(atmosphere.weights.tolist()),
            tuple((x, y) for x, y in atmosphere.velocities.tolist()),
            atmosphere.exposure,
            atmosphere.r0,
            atmosphere.outer_scale,
            atmosphere.cutoff,
            diameter,
            obscuration,
        )

    def on_ground(self) -> Self:
        """Return the same with the layers on the ground alone."""
        ground = [n for n, altitude in enumerate(self.altitudes) if altitude == 0.0]
        return self._replace(
            altitudes=(0.0,) * len(ground),
            weights=tuple(self.weights[n] for n in ground),
            velocities=tuple(self.velocities[n] for n in ground),
        )


class MomentResponse(NamedTuple):
    r"""Response of ellipticity and size, under a Gaussian weight, to the moments of a round image.

    With the image's transfer function T and the weight's rms width w, over wavenumbers k on the sky,
    :math:`J_n = \int T(k) \, e^{-w^2 k^2/2} \, k^{n+1} \, dk`, and Q is the weighted moment along an axis.
    """

    ellipticity: float  #: de1/dp and de2/dq, of e = (a - b)/(a + b) [1/rad^2]
    ln_size: float  #: d ln size/ds [1/rad^2]
    #: Response to k^4 and k^6 over that to k^2 of the transfer function's fluctuations, of e [1/rad^2, 1/rad^4].
    higher_ellipticity: tuple[float, float]
    higher_size: tuple[float, float]  #: the same of ln size
    #: Covariance of the slopes of the optics' aberrations at two points of the pupil, mean of both components' sum over
    #: all directions, at equal steps of distance from none to the diameter [rad^2].
    aberration: tuple[float, ...] = (0.0,)
    #: Part of the pairs of points at these distances that are both lit, of those in the annular pupil.
    lit: tuple[float, ...] = (1.0,)
    #: The same of stars of about as much light, from the darkest on.
    lit_levels: tuple[tuple[float, ...], ...] = ()
    pupils: FieldPupils | None = None  #: of stars; None where all have one pupil

    @classmethod
    def of(cls, wavenumber: np.ndarray, transfer: np.ndarray, weight_rms: float) -> Self:
        """Return that of a transfer function at equally spaced wavenumbers [rad/rad] and a weight's rms width [rad]."""
        power = transfer * np.exp(-0.5 * (weight_rms * wavenumber) ** 2)
        j0, j2, j4, j6, j8 = (float(np.sum(power * wavenumber ** (n + 1))) for n in (0, 2, 4, 6, 8))
        square = weight_rms**2
        q = square - 0.5 * square**2 * j2 / j0

        def size(low: float, high: float) -> float:
            return ((square - q) * low - 0.5 * square**2 * high) / (j0 * q)

        of_second = size(j2, j4)
        return cls(
            square**2 * j4 / (32.0 * q * j0),
            -of_second / 8.0,
            (j6 / j4, j8 / j4),
            (size(j4, j6) / of_second, size(j6, j8) / of_second),
        )

    @property
    def higher(self) -> np.ndarray:
        """Responses of e and ln size to :attr:`MomentCovariance.higher`, [3, 2]."""
        even = np.stack([self.higher_ellipticity, self.higher_size], axis=1)
        return np.concatenate([even, even[:1]])

    def shapes(self, covariance: np.ndarray) -> np.ndarray:
        """Return covariances of (e1, e2, ln size) from those of (p, q, s) [rad^4], [..., 3, 3]."""
        factor = np.array([self.ellipticity, self.ellipticity, self.ln_size])
        return covariance * factor * factor[:, None]


@dataclass(frozen=True, eq=False)
class MomentCovariance:
    """Covariances of the components of the moments of two stars."""

    second: np.ndarray  #: of :data:`PAIRS` of moments of the second order [rad^4], [n_lag, 6]
    #: Of those of the fourth and sixth that act as p, q and s, with a response of 1 [rad^8, rad^12], and of products of
    #: the third with the optics' aberrations [rad^8], [3, n_lag, 3].
    higher: np.ndarray

    def total(self, response: MomentResponse) -> np.ndarray:
        """Return covariances of moments with the effect of all orders [rad^4], [n_lag, 6], of :data:`PAIRS`."""
        out = self.second.copy()
        out[:, :3] += self.parts(response).sum(axis=0)
        return out

    def parts(self, response: MomentResponse) -> np.ndarray:
        """Return what the higher orders add to those of p, q and s [rad^4], [3, n_lag, 3]."""
        factor = np.square(response.higher)
        return self.higher * factor[:, None, [0, 0, 1]]


def as_matrices(pairs: np.ndarray) -> np.ndarray:
    """Return symmetric matrices [..., 3, 3] of values of :data:`PAIRS` [..., 6]."""
    out = np.empty((*pairs.shape[:-1], 3, 3))
    for k, (i, j) in enumerate(PAIRS):
        out[..., i, j] = out[..., j, i] = pairs[..., k]
    return out


def as_pairs(matrices: np.ndarray) -> np.ndarray:
    """Return the values of :data:`PAIRS` [..., 6] of symmetric matrices [..., 3, 3]."""
    return np.stack([matrices[..., i, j] for i, j in PAIRS], axis=-1)


def moment_covariance(
    air: ExposedAir,
    lags: np.ndarray,
    aberration: tuple[float, ...] = (0.0,),
    lit: tuple[float, ...] = (1.0,),
    threads: int | None = None,
    sampling: MomentSampling = FINE,
) -> MomentCovariance:
    """Return the covariances of the moments of two stars whose field slopes are lags [n, 2] [rad] apart.

    Aberration and lit pairs are those of :class:`MomentResponse`.
    """
    lag, delays = np.asarray(lags, dtype=np.float64).reshape(-1, 2), Delays.of(air, aberration, lit, sampling)
    # All stars share the layers on the ground.
    ground = np.zeros(delays.baseline.shape, dtype=np.float32)
    _, common = _averages(air.on_ground(), np.zeros((1, 2)), delays, np.zeros((0, TERMS)), ground, threads)
    squares, slopes = _averages(air, lag, delays, common[0], ground, threads)
    second = squares[:, :6] - by_mean_slope(slopes, delays, air.exposure, threads)
    factors = (_FOURTH * MICRO**8, _SIXTH * MICRO**12, _THIRD * MICRO**8)
    higher = [terms * factor for terms, factor in zip(np.split(squares[:, 6:], 3, axis=1), factors, strict=True)]
    return MomentCovariance(second * MICRO**4, np.stack(higher))


def ground_slopes(air: ExposedAir, delays: Delays) -> np.ndarray:
    """Return covariances a, b, c of slopes of the layers on the ground at the baselines, [3, n_packet, LANES].

    They are in microradians.
    """
    ground = np.zeros(delays.baseline.shape, dtype=np.float32)
    _averages(air.on_ground(), np.zeros((1, 2)), delays, np.zeros((0, TERMS)), ground, None)
    packets = len(delays.baseline)
    return np.moveaxis(ground.ravel()[: SLOPES * packets * LANES].reshape(packets, SLOPES, LANES), 1, 0)


def _averages(
    air: ExposedAir, lag: np.ndarray, delays: Delays, common: np.ndarray, ground: np.ndarray, threads: int | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return squares [n_lag, 15] and terms [n_lag, n_delay, 3] in microradians, see :func:`.average_products`.

    Without terms in common the terms are all eighteen.
    """
    table = slope_covariance(air.r0, air.outer_scale, air.cutoff)
    squares = np.zeros((len(lag), TERMS - SLOPES))
    terms = np.zeros((len(lag), len(delays.time), SLOPES if len(common) else TERMS))
    launch(
        average_products,
        len(lag),
        [
            warp_array(lag),
            warp_array(delays.time),
            warp_array(delays.weight),
            warp_array(delays.packet_start, wp.int32),
            warp_array(delays.baseline, baselines),
            warp_array(air.altitudes),
            warp_array(np.array(air.velocities, dtype=np.float64).reshape(-1, 2)),
            warp_array(air.weights, wp.float32),
            warp_array(np.stack([table.isotropic, table.directed], axis=1) / MICRO**2, wp.vec2f),
            1.0 / table.step,
            air.diameter + min(_DISTANT, table.reach),
            air.diameter + table.reach,
            warp_array(common),
            warp_array(ground, baselines),
            warp_array(np.zeros((len(lag), len(air.weights), 3)), wp.float32),
            warp_array(squares),
            warp_array(terms),
        ],
        threads=threads,
    )
    return squares, terms


@dataclass(frozen=True, eq=False)
class Delays:
    """Delays between two moments of an exposure, and baselines of the pupil for each."""

    time: np.ndarray  #: [s], rising, [n_delay]
    width: np.ndarray  #: of the interval that each stands for [s], [n_delay]
    weight: np.ndarray  #: of sum 1, [n_delay]
    packet_start: np.ndarray  #: first packet of each delay, and the number of packets, [n_delay + 1] int
    #: x, y [m], weights of sum 1 for each delay, and these times the aberration's covariance, float32,
    #: [n_packet, 4, LANES].
    baseline: np.ndarray

    @classmethod
    def of(
        cls, air: ExposedAir, aberration: tuple[float, ...], lit: tuple[float, ...], sampling: MomentSampling
    ) -> Self:
        """Return those of an exposure: dense near zero, where the slopes of all layers vary most."""
        fastest = sampling.wind
        if fastest is None:
            fastest = max((math.hypot(x, y) for x, y in air.velocities), default=0.0)
        # They depend on nothing else of the air.
        return cls._chosen(
            air._replace(altitudes=(), weights=(), velocities=(), r0=0.0, outer_scale=0.0, cutoff=0.0),
            aberration,
            lit,
            sampling._replace(wind=fastest),
        )

    @classmethod
    @lru_cache(maxsize=4)
    def _chosen(
        cls, air: ExposedAir, aberration: tuple[float, ...], lit: tuple[float, ...], sampling: MomentSampling
    ) -> Self:
        fastest = sampling.wind
        assert fastest is not None
        near = min(_NEAR / max(fastest, 1e-9), 0.5 * air.exposure)
        near_drift, drift = min(sampling.near_drift, air.diameter / 16.0), min(sampling.drift, air.diameter / 4.0)
        near_count = max(sampling.least_delays // 2, math.ceil(near * fastest / near_drift))
        far = air.exposure - near
        far_count = max(sampling.least_delays, math.ceil(far * fastest / drift))
        inner, outer = np.linspace(0.0, near, near_count + 1), np.linspace(near, air.exposure, far_count + 1)
        edges = np.concatenate([inner[:-1], outer])
        edges = np.concatenate([-edges[:0:-1], edges])
        time, width = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
        weight = (1.0 - np.abs(time) / air.exposure) * width
        near_by = np.abs(time) < near
        lattices = [
            _pupil_baselines(air.diameter, air.obscuration, spacing, len(time))
            for spacing in (sampling.spacing, sampling.near_spacing)
        ]
        sets = [lattices[int(n)][k] for k, n in enumerate(near_by)]
        start = np.concatenate([[0], np.cumsum([len(points) for points in sets])])
        baseline = np.concatenate(sets)
        distance = np.hypot(baseline[:, 0], baseline[:, 1]) / air.diameter
        both_lit, covariance = (np.interp(distance, np.linspace(0.0, 1.0, len(t)), t) for t in (lit, aberration))
        light = baseline[:, 2] * both_lit
        total = np.add.reduceat(light.sum(axis=1), start[:-1])
        light /= np.repeat(total, np.diff(start))[:, None]
        baseline = np.stack([baseline[:, 0], baseline[:, 1], light, light * covariance / MICRO**2], axis=1)
        baseline = baseline.astype(np.float32)
        return cls(time, width, weight / weight.sum(), start, baseline)


@lru_cache(maxsize=8)
def _pupil_baselines(diameter: float, obscuration: float, spacing: float, count: int) -> np.ndarray:
    """Return baselines x, y [m] with weights of sum 1, float32, a lattice for each delay [count, n, 3, LANES]."""
    spacing = min(spacing, diameter / 8.0)
    reach = math.ceil(diameter / spacing) + 1
    line = spacing * np.arange(-reach, reach + 1)
    grid = np.stack(np.meshgrid(line, line)).reshape(2, -1)
    grid = grid[:, np.hypot(*grid) < diameter + spacing]
    shift = np.arange(1, count + 1)[:, None] / np.array([_PLASTIC, _PLASTIC**2]) % 1.0 - 0.5
    packed = np.zeros((count, 3, -(-grid.shape[1] // LANES) * LANES), dtype=np.float32)
    points = packed[:, :2, : grid.shape[1]]
    points[:] = grid + spacing * shift[..., None]
    radius = np.linspace(0.0, 1.2 * diameter + 2.0 * spacing, 1024)
    weight = np.interp(np.hypot(points[:, 0], points[:, 1]), radius, diffraction_otf(radius, diameter, obscuration))
    packed[:, 2, : grid.shape[1]] = weight / weight.sum(axis=1, keepdims=True)
    return np.moveaxis(packed.reshape(count, 3, -1, LANES), 2, 1)


def wick_products(slopes: np.ndarray) -> np.ndarray:
    """Return Wick's products, of :data:`PAIRS`, [6, ...], of covariances a, b, c of slopes [3, ...]."""
    a, b, c = slopes
    return np.stack(
        [
            2.0 * (a * a + c * c - 2.0 * b * b),
            4.0 * (a * c + b * b),
            2.0 * (a * a + 2.0 * b * b + c * c),
            4.0 * b * (a - c),
            2.0 * (a * a - c * c),
            4.0 * b * (a + c),
        ]
    )


def by_mean_slope(slopes: np.ndarray, delays: Delays, exposure: float, threads: int | None = None) -> np.ndarray:
    """Return what the moments' covariances lose by the mean slope, of :data:`PAIRS`, [n_lag, 6].

    ``slopes`` [n_lag, n_delay, 3] are covariances a, b, c of slopes a delay apart, means over the baselines; they are
    overwritten.
    """
    edges = np.concatenate([[-exposure], np.cumsum(delays.width) - exposure])
    start_delay = edges[len(delays.time) // 2 :] - exposure
    start = np.searchsorted(edges, start_delay).clip(1, len(edges) - 1) - 1
    products = np.zeros((len(slopes), len(PAIRS)))
    launch(
        products_with_mean_slope,
        len(slopes),
        [
            warp_array(slopes, wp.vec3d),
            warp_array(delays.width),
            warp_array(start, wp.int32),
            warp_array((start_delay - edges[start]) / delays.width[start]),
            exposure,
            warp_array(products),
        ],
        threads=threads,
    )
    return products
