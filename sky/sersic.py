"""Table of the Fourier transforms of Sersic profiles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import gammaincinv, gammaln, loggamma

from ..core.threads import one_blas_thread

#: Least Sersic index, that of GalSim.
LEAST_INDEX = 0.3
#: Greatest Sersic index, that of GalSim.
GREATEST_INDEX = 6.2
#: What is expected of an index.
INDICES = f"{LEAST_INDEX} to {GREATEST_INDEX}"
# Steps of the table. Interpolation with four points each way is off by 4e-6 of the flux at most, at an index of 0.3,
# whose transform oscillates.
_INDICES = 48
_WAVE_NUMBERS = 476
# Below exp(-9) / radius the transform is 1 to 5e-7, beyond exp(10) / radius less than 3e-6.
_LOG_WAVE_NUMBERS = (-9.0, 10.0)
# Real part of the path of the Mellin-Barnes integral.
_REAL = 1.0
# Step of the trapezoidal rule along the path.
_STEP = 0.15
# End of the trapezoidal rule.
_END = 80.0


@dataclass(frozen=True)
class SersicTable:
    """Fourier transform of the untruncated Sersic profile of unit flux and half-light radius 1.

    Steps are even in the logarithms of the Sersic index and of the wave number.
    """

    values: np.ndarray  #: [index, wave number], single precision
    log_index: tuple[float, float]  #: of the first row, and step
    log_wave_number: tuple[float, float]  #: of the first column, and step


@lru_cache(maxsize=1)
def sersic_table() -> SersicTable:
    """Return the table, made once in a process."""
    log_index = np.linspace(np.log(LEAST_INDEX), np.log(GREATEST_INDEX), _INDICES)
    log_wave_number = np.linspace(*_LOG_WAVE_NUMBERS, _WAVE_NUMBERS)
    return SersicTable(
        values=sersic_transform(np.exp(log_index), np.exp(log_wave_number)).astype(np.float32),
        log_index=(float(log_index[0]), float(log_index[1] - log_index[0])),
        log_wave_number=(float(log_wave_number[0]), float(log_wave_number[1] - log_wave_number[0])),
    )


def sersic_brightness(index: float | np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return the brightness of Sersic profiles of unit flux and half-light radius 1 at distances from their centres.

    The exponent b is good to 1e-3 (Ciotti & Bertin 1999).
    """
    b = 2.0 * index - 1.0 / 3.0 + 4.0 / (405.0 * index)
    middle = np.exp(2.0 * index * np.log(b) - gammaln(2.0 * index)) / (2.0 * np.pi * index)
    return middle * np.exp(-b * distance ** (1.0 / index))


def sersic_transform(index: np.ndarray, wave_number: np.ndarray) -> np.ndarray:
    """Compute Fourier transforms of Sersic profiles of unit flux and half-light radius 1.

    The profile is exp(-b r^(1/n)) with half of its light within r = 1 (Sersic 1963; Ciotti & Bertin 1999, for b). With
    the Mellin transforms of the profile, n b^(-n s) Gamma(n s), and of J0, 2^(s-1) Gamma(s/2) / Gamma(1 - s/2),
    Parseval's formula for Mellin transforms gives its Hankel transform as

        F(k) = 1/(2 pi i) int 2^(s-1) Gamma(s/2) / Gamma(1 - s/2) Gamma(n (2 - s)) / Gamma(2n) (b^n / k)^s ds

    along Re s = 1. The integrand falls exponentially and has no singularity nearby, so that the trapezoidal rule is
    accurate to 1e-12.

    Parameters
    ----------
    index : ndarray, shape [n]
        Sersic index.
    wave_number : ndarray, shape [k]
        Angular wave number times half-light radius, 1e-5 and more: below, the sum loses digits.

    Returns
    -------
    ndarray, shape [n, k]
    """
    t = np.arange(0.0, _END, _STEP)
    s = _REAL + 1j * t
    n = np.asarray(index, dtype=np.float64)[:, None]
    bessel = (s - 1.0) * np.log(2.0) + loggamma(0.5 * s) - loggamma(1.0 - 0.5 * s)
    profile = loggamma(n * (2.0 - s)) - loggamma(2.0 * n) + s * n * np.log(gammaincinv(2.0 * n, 0.5))
    # The integrand at -t is the complex conjugate of that at t.
    weight = np.full(len(t), _STEP / np.pi)
    weight[0] *= 0.5
    integrand = np.exp(bessel + profile) * weight
    power = np.exp(-np.outer(s, np.log(wave_number)))
    with one_blas_thread():
        return integrand.real @ power.real - integrand.imag @ power.imag
