"""Row of the table of visits and detectors: PSF, sky, zero point and depth of a CCD, as LSST's visit_detector has them.

Moments are adaptive ones of the noise-free PSF in the middle of the CCD, along the axes of its pixels. Definitions of
magLim (SMTN-002) and effTime (Neilsen et al. 2016) are those of LSST's ComputeExposureSummaryStatsTask.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...core.statistics import FWHM_PER_RMS, finite_median, rms
from ...core.units import ARCSEC
from ...measure.adaptive_moments import adaptive_moments
from ...measure.rho_statistics import trace_of_moments
from ...models.camera.camera import Camera
from ...pipeline.experiment import Experiment
from ...pipeline.simulate.ccd_exposure import NoiseFreeStars
from ...pipeline.simulate.ccd_model import CcdFit, ModelledMoments
from ...pipeline.simulate.photometry import instrument_noise, sky_electrons_per_pixel

#: Columns in order: unit in FITS notation, description.
COLUMNS = {
    "visitId": ("", "number of the visit"),
    "detector": ("", "number of the CCD in the camera, from 0"),
    "band": ("", "band"),
    "expMidptMJD": ("d", "middle of the exposure, TAI"),
    "expTime": ("s", "exposure time of all snaps"),
    "ra": ("deg", "right ascension of the middle of the CCD, ICRS"),
    "dec": ("deg", "declination of the middle of the CCD, ICRS"),
    "zenithDistance": ("deg", "zenith distance of the pointing"),
    "pixelScale": ("arcsec/pixel", "angle of a pixel in the middle of the CCD, root of its area"),
    "psfSigma": ("pixel", "determinant radius (Ixx Iyy - Ixy^2)^(1/4) of the PSF in the middle of the CCD"),
    "psfIxx": ("pixel2", "adaptive moment of the PSF along the pixels' x"),
    "psfIyy": ("pixel2", "along their y"),
    "psfIxy": ("pixel2", "mixed"),
    "psfArea": ("pixel2", "effective area of the PSF, (sum P)^2 / sum P^2"),
    "skyBg": ("adu", "sky of a pixel"),
    "skyNoise": ("adu", "rms of a pixel of the sky"),
    "zeroPoint": ("mag", "AB magnitude of 1 adu in the exposure, with vignetting"),
    "magLim": ("mag", "AB magnitude of a star of S/N 5"),
    "effTime": ("s", "time with the same depth in nominal seeing under a dark sky at the zenith"),
    "weight": ("nJy-2", "inverse variance of a pixel of the sky, or the weight of the list"),
    "nPsfStar": ("", "stars of the PSF model"),
    "psfStarDeltaE1Median": ("", "median of e1 of stars less the model's, e = (Ixx - Iyy)/(Ixx + Iyy)"),
    "psfStarDeltaE2Median": ("", "median of e2 of stars less the model's"),
    "psfStarDeltaE1Scatter": ("", "scatter of e1 of stars less the model's (1.4826 MAD)"),
    "psfStarDeltaE2Scatter": ("", "scatter of e2 of stars less the model's"),
    "psfStarDeltaSizeMedian": ("pixel", "median of the trace radius of stars less the model's"),
    "psfStarDeltaSizeScatter": ("pixel", "scatter of the trace radius of stars less the model's"),
    "modelDeltaE1Rms": ("", "rms of e1 of the noise-free PSF less the model's where no star is"),
    "modelDeltaE2Rms": ("", "rms of e2 of the noise-free PSF less the model's where no star is"),
    "modelDeltaSizeRms": ("pixel", "rms of the trace radius of the noise-free PSF less the model's where no star is"),
}
#: Columns of the model, NaN without one.
MODEL_COLUMNS = tuple(name for name in COLUMNS if name.startswith(("nPsfStar", "psfStar", "modelDelta")))
#: Geometric FWHM of nominal seeing [arcsec] by band, for effTime (SMTN-002, table 2).
_NOMINAL_FWHM = {"u": 0.81, "g": 0.77, "r": 0.73, "i": 0.71, "z": 0.69, "y": 0.68}
#: S/N of the limiting magnitude.
LIMIT_SNR = 5.0
#: AB magnitude of 1 nJy.
NANOJANSKY = 31.4
#: Standard deviation of a normal distribution over its median absolute deviation, to the digits that LSST's has.
_NORMAL_MAD = 1.4826022185056018


class PlaceShapes(NamedTuple):
    """Noise-free PSFs at places of a CCD, the first in its middle, along the axes of the focal plane."""

    xy: np.ndarray  #: places [m], [n, 2]
    sigma: np.ndarray  #: [CCD pixel]
    g1: np.ndarray
    g2: np.ndarray
    area: np.ndarray  #: effective area [CCD pixel^2]


def place_shapes(
    experiment: Experiment, xy: np.ndarray, stars: NoiseFreeStars, measured: ModelledMoments | None = None
) -> PlaceShapes:
    """Measure noise-free PSFs at places on the focal plane [m], if they are not `measured` already."""
    # Stamps may have finer pixels than the CCDs.
    ratio = experiment.pixel_size / experiment.camera.pixel_size
    moments = measured or adaptive_moments(stars.image.astype(np.float64), stars.pixel_scale, threads=1)
    total = stars.image.sum(axis=(1, 2), dtype=np.float64)
    area = total**2 / (stars.image.astype(np.float64) ** 2).sum(axis=(1, 2))
    return PlaceShapes(xy, moments.sigma * (ratio / stars.pixel_scale), moments.g1, moments.g2, area * ratio**2)


def moments_along_pixels(
    camera: Camera, ccd: int, sigma: np.ndarray, g1: np.ndarray, g2: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Ixx, Iyy, Ixy along the pixels of a CCD of shapes along the axes of the focal plane."""
    square = g1**2 + g2**2
    mean = 0.5 * trace_of_moments(sigma, g1, g2)
    e1, e2 = 2.0 * g1 / (1.0 + square), 2.0 * g2 / (1.0 + square)
    tensor = np.array([[mean * (1.0 + e1), mean * e2], [mean * e2, mean * (1.0 - e1)]])
    axes = camera.along_pixels(ccd, np.eye(2)).T  # columns: x and y of the focal plane along the pixels
    turned = np.einsum("ik,kl...,jl->ij...", axes, tensor, axes)
    return turned[0, 0], turned[1, 1], turned[0, 1]


def noise_columns(experiment: Experiment, lit_fraction: float) -> dict[str, float]:
    """Return sky, noise, zero point and inverse variance of a pixel in a CCD's middle, where light is vignetted."""
    band, seconds = experiment.band, experiment.config.atmosphere.exposure_s
    sky = lit_fraction * sky_electrons_per_pixel(band, seconds)
    variance = sky + instrument_noise(band, seconds) ** 2
    zero_point = band.zero_point + 2.5 * math.log10(seconds * lit_fraction / band.gain)
    nanojansky = 10.0 ** (0.4 * (NANOJANSKY - zero_point))  # of 1 adu
    return {
        "skyBg": sky / band.gain,
        "skyNoise": math.sqrt(variance) / band.gain,
        "zeroPoint": zero_point,
        "weight": 1.0 / (variance * (nanojansky / band.gain) ** 2),
    }


def limiting_magnitude(experiment: Experiment, area: float, sky: float, zero_point: float) -> float:
    """Return the magnitude of S/N 5 by effective area [pixel^2], sky [adu] and zero point (SMTN-002)."""
    band = experiment.band
    background = (sky * band.gain + band.read_noise**2) * area  # electrons
    counts = 0.5 * LIMIT_SNR**2 + math.sqrt(0.25 * LIMIT_SNR**4 + LIMIT_SNR**2 * background)
    return zero_point - 2.5 * math.log10(counts / band.gain)


def effective_time(experiment: Experiment, sigma: float, sky: float, zero_point: float, airmass: float) -> float:
    """Return the effective exposure time [s] by rms width [pixel], sky [adu] and zero point."""
    band, seconds = experiment.band, experiment.config.atmosphere.exposure_s
    nominal_sigma = _NOMINAL_FWHM[band.name] / FWHM_PER_RMS / (band.pixel_scale / ARCSEC)
    # The band of a visit has the extinction of its airmass in both.
    extinction = band.extinction / airmass
    nominal_zero_point = band.zero_point + extinction * (airmass - 1.0) - 2.5 * math.log10(band.gain)
    # That of the band is the sky of the visit.
    dark_sky = experiment.camera.photometry.dark_sky(band.name)
    nominal_sky = sky_electrons_per_pixel(band, 1.0, sky=dark_sky) / band.gain
    seeing = (sigma / nominal_sigma) ** -2
    transparency = 10.0 ** (-0.8 * (nominal_zero_point - (zero_point - 2.5 * math.log10(seconds))))
    return seconds * seeing * transparency * nominal_sky / (sky / seconds)


def model_columns(experiment: Experiment, fit: CcdFit | None) -> dict[str, float]:
    """Return how a PSF model fits stars and noise-free PSFs; NaN without a model."""
    if fit is None:
        return dict.fromkeys(MODEL_COLUMNS, math.nan)
    camera, ccd = experiment.camera, experiment.camera.ccd_index(fit.name)
    pixel = fit.pixel_scale * camera.pixel_size / experiment.pixel_size

    def differences(moments: ModelledMoments) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        shapes = []
        for sigma, g1, g2 in (moments[:3], moments[3:]):
            xx, yy, xy = moments_along_pixels(camera, ccd, sigma / pixel, g1, g2)
            shapes.append(np.stack([(xx - yy) / (xx + yy), 2.0 * xy / (xx + yy), np.sqrt(0.5 * (xx + yy))]))
        first, second, third = shapes[0] - shapes[1]
        return first, second, third

    columns: dict[str, float] = {"nPsfStar": float(len(fit.observed.sigma))}
    for name, values in zip(("E1", "E2", "Size"), differences(fit.observed), strict=True):
        columns[f"psfStarDelta{name}Median"] = median = finite_median(values)
        columns[f"psfStarDelta{name}Scatter"] = _NORMAL_MAD * finite_median(np.abs(values - median))
    for name, values in zip(("E1", "E2", "Size"), differences(fit.holdout), strict=True):
        columns[f"modelDelta{name}Rms"] = rms(values)
    return columns
