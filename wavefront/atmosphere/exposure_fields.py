"""Random fields over the field of view of one exposure: moments of images by turbulence, and the mean wavefront.

Both are Gaussian, and fixed by the seed, the epoch and the air alone: a star has the same values whichever others are
asked for. They are drawn on periodic grids, wider than the field, and read by cubic splines.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.fft
import warp as wp

from ...core.buffers import empty
from ...core.errors import DomainError
from ...core.launch import launch
from ...core.random_streams import stream
from ...core.warp_arrays import warp_array
from ...models.zernike_polynomials import noll_to_nm
from .field_kernels import add_wavefronts, factor_spectra, pairs, read_splines, spread_over_grid, zernikes
from .ground_moments import GroundMoments, ground_factor
from .mean_wavefront import mean_sinc_squared, mean_wavefront_covariance, radial_transform
from .moment_covariance import (
    COARSE,
    ExposedAir,
    MomentCovariance,
    MomentResponse,
    as_matrices,
    as_pairs,
    moment_covariance,
)
from .polar_lags import PolarLags
from .turbulence import path_spectrum

#: Noll indices of the mean wavefront. On the LSST with 0.1 um of aberration Z12 to Z15 move ellipticities by 5e-4 (rms)
#: and add 1 to 3 % to half-variograms at 1'; Z16 to Z22 add less than 1 %.
NOLL = range(4, 16)
#: Side of the periodic grids over the diameter of the field.
_MARGIN = 1.5
#: Difference of covariances between directions half a period away, over the variance that changes over the field, from
#: which lags beyond count too: drift in the exposure, or a low layer, is longer than a period. Cut off there, spectra
#: of HSC and of the AuxTel in 30 s have negative parts of 7 %, and half-variograms at 1 arcmin are 22 % too large.
_UNEVEN = 0.02
#: Samples in the angle under which the highest layer crosses the pupil, at least. Half-variograms of the LSST's moments
#: from 0.5 arcmin on are those of the theory within 4 %, from 0.75 arcmin on within 2 %.
_SAMPLES = 4.5
#: Most samples on a side.
_MOST_SAMPLES = 2048
_LEAST_SAMPLES = 16
#: Side of the grid of a layer over the outer scale or the pupil, at least: longer modes are left out.
_LAYER_SIDE = 8.0
#: Least side of that grid over the pupil that suffices for any outer scale: Zernikes from Z4 on have 1/200^(7/3) = 4e-6
#: of their variance in longer modes, and 1e-3 where the wind averages the others.
_LONGEST_SIDE = 200.0
#: Largest frequency of the mean wavefront times the diameter of the pupil, and that of tables, from zero in so many
#: steps. Beyond the first Z4 to Z10 have 1 % of their variance, Z12 to Z15 a tenth, Z11, the smallest, a quarter: the
#: modes below, which are longer, are that much stronger.
_HIGHEST = 2.0
_LAST = 16.0
_TABLE = 8192
#: Samples of these fields in the angle of the pupil at their highest layer: more than two a mode, which splines would
#: weaken by a half.
_WAVEFRONT_SAMPLES = 4.5
#: Steps of the tables up to the modes that are drawn.
_DRAWN = round(_TABLE * _HIGHEST / _LAST)
#: Distance of stars whose differences tell the amplitude of moments through other pupils, in angles under which the
#: highest layer crosses the pupil, and its directions.
_CROSSINGS = 2.0
_DIRECTIONS = 4
#: Least variance of the differences of stars over that of their moments that is more than rounding.
_DIFFERENT = 1e-6
#: Factor of modes without frequency along x, and with the highest one: the inverse transform takes the mean of those at
#: a frequency along y and at its opposite.
_BOTH_SIGNS = np.float32(math.sqrt(2.0))


class FieldGrid(NamedTuple):
    """A periodic square grid over field slopes."""

    size: int  #: samples on a side
    side: float  #: [rad]

    @classmethod
    def of(cls, air: ExposedAir, field_radius: float) -> FieldGrid:
        """Return that for the moments over a field of a radius [rad]."""
        side = 2.0 * _MARGIN * field_radius
        highest = max(air.altitudes, default=0.0)
        return cls(_grid_size(side, highest, air.diameter, _SAMPLES), side)


@dataclass(frozen=True, eq=False)
class SplineFields:
    """Periodic fields as coefficients of cubic B-splines."""

    side: float  #: [rad]
    coefficients: np.ndarray  #: float32, [n_field, size, size]

    def at(self, slopes: np.ndarray) -> np.ndarray:
        """Return the values at field slopes [n, 2] [rad], [n, n_field]; each place by itself."""
        values = np.zeros((len(slopes), len(self.coefficients)))
        place = slopes * (self.coefficients.shape[1] / self.side)
        launch(
            read_splines,
            len(slopes),
            [warp_array(place), warp_array(self.coefficients, wp.float32), warp_array(values)],
            threads=1,
        )
        return values


class OpticsGain(NamedTuple):
    """Amplitudes of moments that change over the field, by the optics of a star, over the mean over the field.

    With less of the pupil fewer independent parts of the air are averaged.
    """

    share: np.ndarray  #: of the variances of p, q, s, that aberrations of the optics add, [3]
    lit: np.ndarray  #: lit fractions, rising, [n_level]
    amplitudes: np.ndarray  #: at these, [n_level, 3]

    def factors(self, square: np.ndarray, lit: np.ndarray) -> np.ndarray:
        """Return factors of the moments, [n, 3]; arguments as of :meth:`ExposureFields.moments_at`."""
        by_light = np.stack([np.interp(lit, self.lit, a) for a in self.amplitudes.T], axis=1)
        return np.sqrt(1.0 + self.share * (square[:, None] - 1.0)) * by_light


@dataclass(frozen=True, eq=False)
class ExposureFields:
    """Drawn fields of one exposure."""

    shared: GroundMoments  #: moments that all stars of one pupil share
    moments: SplineFields  #: those that change over the field
    by_optics: OpticsGain  #: factors of these
    common_wavefront: np.ndarray  #: Zernikes of :data:`NOLL` of the layers on the ground [m]
    wavefronts: tuple[SplineFields, ...]  #: of the others

    def moments_at(self, slopes: np.ndarray, square: np.ndarray, lit: np.ndarray) -> np.ndarray:
        """Return p = Mxx - Myy, q = 2 Mxy, s = Mxx + Myy beyond their mean [rad^2] at field slopes [n, 2], [n, 3].

        Stars have their squares of aberrations over the mean over the field, and lit fractions, [n] both.
        """
        return self.shared.at(slopes) + self.by_optics.factors(square, lit) * self.moments.at(slopes)

    def wavefronts_at(self, slopes: np.ndarray) -> np.ndarray:
        """Return Zernikes of :data:`NOLL` of the mean path [m] at field slopes [n, 2] [rad], [n, n_noll]."""
        values = np.repeat(self.common_wavefront[None], len(slopes), axis=0)
        for fields in self.wavefronts:
            values += fields.at(slopes)
        return values


@lru_cache(maxsize=2)
def draw_exposure(
    air: ExposedAir, response: MomentResponse, field_radius: float, seed: int, epoch: int
) -> ExposureFields:
    """Draw the fields of one exposure; those of the last two are stored."""
    grid = FieldGrid.of(air, field_radius)
    factors, shared, by_optics = moment_spectrum(air, response, grid)
    random = stream(seed, "atmosphere", epoch, "moments")
    of_nodes = stream(seed, "atmosphere", epoch, "pupils").standard_normal(len(shared) - 3)
    normal = np.concatenate([random.standard_normal(3), of_nodes])
    of_pupils = GroundMoments.draw(shared, response.pupils, normal)
    modes = [_white_modes(random, grid.size, grid.size // 2 + 1, grid.size) for _ in range(3)]
    moments = _fields((sum(f * m for f, m in zip(row, modes, strict=False)) for row in factors), 3, grid.size)
    ground, wavefronts = _draw_wavefronts(air, grid, seed, epoch)
    return ExposureFields(of_pupils, SplineFields(grid.side, moments), by_optics, ground, wavefronts)


@lru_cache(maxsize=4)
def moment_spectrum(
    air: ExposedAir, response: MomentResponse, grid: FieldGrid
) -> tuple[tuple[tuple[np.ndarray, ...], ...], np.ndarray, OpticsGain]:
    """Return lower Cholesky factors of the spectra of the moments on a grid, and that of what all stars share.

    Factors of row i are i + 1 arrays [size, size // 2 + 1] [rad^2], with the gain of splines; the other is that of
    :func:`.ground_factor`. The last result are the amplitudes of stars of other optics.
    """
    of_orders, polar_lags, polar, far = _polar_covariances(air, response, grid, 0.5)
    images = bool(np.any(np.ptp(far, axis=0)[:3] > _UNEVEN * (polar[0, 0] - far.mean(axis=0))[:3]))
    if images:
        of_orders, polar_lags, polar, far = _polar_covariances(air, response, grid, 1.5)
    # What stars that far apart share, all stars do.
    shared = _positive(as_matrices(far.mean(axis=0)))
    scale = float(polar[0, 0, 2])
    constant = as_pairs(shared)
    half = grid.size // 2 + 1
    covariance = np.empty((6, half, grid.size), dtype=np.float32)
    launch(
        spread_over_grid,
        half,
        [
            warp_array((polar - constant) / scale, pairs),
            grid.side / grid.size / polar_lags.unit,
            polar_lags.step,
            images,
            warp_array(covariance, wp.float32),
        ],
    )
    # Opposite lags have equal covariances: transforms of opposite rows are conjugates, and the spectra are real.
    spectra = scipy.fft.hfft(scipy.fft.rfft(covariance), grid.size, axis=1, overwrite_x=True)
    variance = np.maximum(polar[0, 0, :3], 1e-12 * scale)
    gain = OpticsGain(of_orders.parts(response)[2, 0] / variance, *amplitudes_by_light(air, response, 0.5 * grid.side))
    of_pupils = ground_factor(air, response.lit, response.pupils, shared + 1e-12 * scale * np.eye(3))
    return _factors(spectra, scale), of_pupils, gain


def _polar_covariances(
    air: ExposedAir, response: MomentResponse, grid: FieldGrid, sides: float
) -> tuple[MomentCovariance, PolarLags, np.ndarray, np.ndarray]:
    """Return covariances up to so many sides of a grid along its axes, their lags, and those on rings and spokes.

    The last result are those on the ring there, [spoke, 6].
    """
    lags = PolarLags.of(air, sides * math.sqrt(2.0) * grid.side)
    of_orders = moment_covariance(air, lags.lags, response.aberration, response.lit)
    polar = lags.table(of_orders.total(response))
    return of_orders, lags, polar, polar[np.searchsorted(lags.radius, sides * grid.side)]


def amplitudes_by_light(air: ExposedAir, response: MomentResponse, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Return lit fractions of stars [n_level], and amplitudes [n_level, 3] of the differences of their moments.

    They are those of stars two crossings of the highest layer apart, at most so far [rad], over those on the mean over
    the field. Fractions rise.
    """
    apart = min(_CROSSINGS * air.diameter / max(*air.altitudes, 1.0), most)
    angle = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    lags = np.concatenate([np.zeros((1, 2)), apart * np.stack([np.cos(angle), np.sin(angle)], axis=1)])

    def variances(lit: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
        total = moment_covariance(air, lags, response.aberration, lit, sampling=COARSE).total(response)[:, :3]
        return total[0] - total[1:].mean(axis=0), total[0]

    levels = response.lit_levels or (response.lit,)
    usual, whole = variances(response.lit)
    # Through a layer at the pupil alone stars have no differences.
    differ = usual > _DIFFERENT * whole
    relative = np.stack([variances(lit)[0] for lit in levels]) / np.where(differ, usual, 1.0)
    return np.array([lit[0] for lit in levels]), np.sqrt(np.where(differ, np.maximum(relative, 0.0), 1.0))


def _factors(spectra: np.ndarray, scale: float) -> tuple[tuple[np.ndarray, ...], ...]:
    """Return lower Cholesky factors of spectra of PAIRS [6, size, size // 2 + 1], with the gain of splines.

    The spectra are in units of a scale, and are overwritten.
    """
    size, sums = spectra.shape[1], np.zeros((spectra.shape[1], 2))
    launch(
        factor_spectra,
        size,
        [warp_array(_spline_gain(size), wp.float32), warp_array(spectra, wp.float32), warp_array(sums)],
    )
    wanted, drawn = sums.sum(axis=0)
    # Negative remainders count as zero: without this the variance would be a per cent too large.
    spectra *= np.float32(math.sqrt(scale * max(wanted, 0.0) / max(drawn, 1e-30)))
    first, second, middle, third, mixed, last = spectra
    return (first,), (second, middle), (third, mixed, last)


def _fields(spectra: Iterable[np.ndarray], count: int, size: int) -> np.ndarray:
    """Return the fields of so many spectra [size, size // 2 + 1], float32, [n_field, size, size]."""
    fields = empty((count, size, size), np.float32)
    # One by one: the memory of all at once takes longer to get than their transforms.
    for field, spectrum in zip(fields, spectra, strict=True):
        field[:] = scipy.fft.irfft2(spectrum, s=(size, size), overwrite_x=True)
    return fields


def _white_modes(random: np.random.Generator, rows: int, columns: int, size: int) -> np.ndarray:
    """Return modes of the real transform of white noise on a grid of a size, complex64, [rows, columns].

    Columns start at no frequency along x.
    """
    modes = random.standard_normal((rows, columns, 2), dtype=np.float32).view(np.complex64)[..., 0]
    modes *= np.float32(math.sqrt(0.5) * size)
    modes[:, :: size // 2] *= _BOTH_SIGNS
    return modes


def _positive(matrix: np.ndarray) -> np.ndarray:
    """Return the nearest symmetric matrix without negative eigenvalues."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _spline_gain(size: int) -> np.ndarray:
    """Return the gain along one axis that offsets smoothing by splines, for the frequencies of a transform, [size].

    It makes the mean square of a mode right over all places, where it would be too small with splines that pass through
    the samples: without a gain it is that of a spline of the seventh degree at its samples.
    """
    k = 2.0 * np.pi * np.fft.fftfreq(size)
    mean_square = (1208.0 + 1191.0 * np.cos(k) + 120.0 * np.cos(2.0 * k) + np.cos(3.0 * k)) / 2520.0
    return (1.0 / np.sqrt(mean_square)).astype(np.float32)


def _grid_size(side: float, distance: float, diameter: float, samples: float) -> int:
    """Return an even number of samples with quick transforms, at least so many a pupil; DomainError if too many.

    The grid has a side [rad], the pupil a diameter [m], and the highest layer is at a distance along the light [m].
    """
    pupils = side * distance / diameter
    if samples * pupils > _MOST_SAMPLES:
        raise DomainError(
            f"engine = 'statistical': at the highest layer, {1e-3 * distance:.0f} km away along the light, the field "
            f"is {pupils / _MARGIN:.0f} pupils wide; expected at most {_MOST_SAMPLES / samples / _MARGIN:.0f} (a "
            "smaller zenith angle has fewer; 'fast' has no such limit)"
        )
    count = max(math.ceil(samples * pupils), _LEAST_SAMPLES)
    return 2 * int(scipy.fft.next_fast_len(-(-count // 2), real=True))


def _draw_wavefronts(
    air: ExposedAir, grid: FieldGrid, seed: int, epoch: int
) -> tuple[np.ndarray, tuple[SplineFields, ...]]:
    """Draw Zernikes of the mean wavefront: of layers on the ground [n_noll] [m], and of the others."""
    least = min(_LAYER_SIDE * max(air.outer_scale, air.diameter), _LONGEST_SIDE * air.diameter)
    groups: dict[float, list[int]] = {}
    for n, altitude in enumerate(air.altitudes):
        if altitude > 0.0:
            groups.setdefault(max(grid.side, least / altitude), []).append(n)
    normal = stream(seed, "atmosphere", epoch, "mean wavefront").standard_normal(len(NOLL))
    ground = _ground_factor(air.on_ground()) @ normal
    return ground, tuple(_wavefront_fields(air, layers, side, seed, epoch) for side, layers in groups.items())


@lru_cache(maxsize=4)
def _ground_factor(air: ExposedAir) -> np.ndarray:
    """Return a square root of the covariance of Zernikes of layers on the ground [m], [n_noll, n_noll]."""
    covariance = mean_wavefront_covariance(air, (0.0, 0.0), NOLL, air.diameter, air.obscuration)[0, :, 0]
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _wavefront_fields(air: ExposedAir, layers: list[int], side: float, seed: int, epoch: int) -> SplineFields:
    """Draw the fields of some layers on a common grid of a side [rad]."""
    distance = np.array([air.altitudes[n] for n in layers])
    size = _grid_size(side, float(distance.max()), air.diameter, _WAVEFRONT_SAMPLES)
    # Of each layer only modes that its Zernikes have.
    reach = np.minimum(np.ceil(_HIGHEST * side * distance / air.diameter).astype(int), size // 2 - 1)
    noise = [
        _white_modes(stream(seed, "atmosphere", epoch, n, "mean wavefront"), 2 * k + 1, k + 1, size)
        for n, k in zip(layers, reach.tolist(), strict=True)
    ]
    drift = air.exposure * np.array([air.velocities[n] for n in layers])
    periods = drift / (side * distance)[:, None]
    long = np.hypot(*periods.T) > 1.0
    for number in np.flatnonzero(long):
        noise[number] *= _mean_smear(periods[number], int(reach[number]))
    # In microns: powers of path in metres are below the numbers of float32.
    scale = 1e6 * math.sqrt(float(path_spectrum(0.0, air.r0, air.outer_scale)) * air.outer_scale ** (-11.0 / 3.0))
    weights = np.array([air.weights[n] for n in layers])
    nu = np.linspace(0.0, _LAST / air.diameter, _TABLE + 1)
    root = (nu**2 + air.outer_scale**-2) ** (-11.0 / 12.0)
    radial = root[:, None] * np.stack([radial_transform(j, _LAST, _TABLE + 1, air.obscuration) for j in NOLL], axis=1)
    amplitude = scale * size * np.sqrt(weights) / (distance * side)
    strength = amplitude[:, None] * _compensation(nu, radial**2, np.hypot(*drift.T))
    spectrum = empty((len(NOLL), size, size // 2 + 1), np.complex64)
    launch(
        add_wavefronts,
        size,
        [
            warp_array(np.concatenate([modes.ravel() for modes in noise]), wp.vec2f),
            warp_array(np.cumsum([0, *(modes.size for modes in noise[:-1])]), wp.int32),
            warp_array(reach, wp.int32),
            warp_array(distance, wp.float32),
            warp_array(np.where(long[:, None], 0.0, drift), wp.float32),
            warp_array(strength, zernikes),
            1.0 / side,
            warp_array(radial[: _DRAWN + 2], zernikes),
            air.diameter * _TABLE / _LAST,
            warp_array([noll_to_nm(j)[1] for j in NOLL], wp.int32),
            warp_array(_spline_gain(size), wp.float32),
            1e-6,
            warp_array(spectrum, wp.vec2f),
        ],
    )
    return SplineFields(side, _fields(spectrum, len(NOLL), size))


def _mean_smear(periods: np.ndarray, reach: int) -> np.ndarray:
    """Return the root of the mean smear sinc^2 by the wind over the cells of modes, float32, [2 reach + 1, reach + 1].

    Where the wind blows a layer over more than a period of the grid, [2] periods, the lobe of the smear is narrower
    than the distance of the modes, and what these have of it is chance.
    """
    along = np.arange(-reach, reach + 1)[:, None] * periods[1] + np.arange(reach + 1) * periods[0]
    return np.sqrt(mean_sinc_squared(along, 0.5 * np.hypot(*periods))).astype(np.float32)


def _compensation(frequency: np.ndarray, power: np.ndarray, drift: np.ndarray) -> np.ndarray:
    """Return factors of the amplitudes of layers that make up for modes that are left out, [n_layer, n_noll].

    ``power`` [n_frequency, n_noll] is that of Zernikes at frequencies [1/m]; ``drift`` [n_layer] that in the exposure
    [m].
    """
    # The mean over directions of the smear sinc^2 by the wind, whose lobe is that narrow.
    ring = frequency / (1.0 + math.pi * frequency * drift[:, None])
    return np.sqrt((ring @ power) / (ring[:, :_DRAWN] @ power[:_DRAWN]))
