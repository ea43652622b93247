"""Exposures with the noise of a stack of visits: of equal ones, or of those of a list with skies, times and weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...imaging.exposure import Exposure
from ...pipeline.experiment import Experiment
from ...pipeline.simulate.photometry import instrument_noise, limiting_magnitude, sky_electrons_per_pixel
from .plan import Visit
from .psf_visit import NOMINAL_FWHM, stack_limit, stack_weight, visit_experiment


def stack_exposure(experiment: Experiment, visits: Sequence[Visit], pixel_scale: float) -> Exposure:
    """Return the exposure whose noise is that of the weighted mean of visits, per electron of a source.

    Visits of a list have skies, times, snaps, airmasses and weights of their own. The time is that in which a source
    has the photon noise that it has in the mean; the sky has the noise of all pixels, read noise among it.
    """
    exposure = Exposure.of_run(experiment, len(visits), gain=1.0, pixel_scale=pixel_scale)
    if visits[0].listed is None:
        return exposure
    nominal = experiment.band
    weight, time, variance = np.array([_noise_of(experiment, visit, pixel_scale) for visit in visits]).T
    share = weight / weight.sum()
    # Of means of electrons a second of a source at the zero point of the run.
    effective_time = float(1.0 / np.sum(share**2 / time))
    sky = effective_time**2 * float(np.sum(share**2 * variance / time**2))
    at_zero = sky_electrons_per_pixel(nominal, effective_time, pixel_scale, sky=0.0)
    quiet = replace(nominal, read_noise=0.0, dark_current=0.0)
    return replace(
        exposure,
        time=effective_time / len(visits),
        sky=float(2.5 * np.log10(at_zero / sky)),
        read_noise=0.0,
        dark_current=0.0,
        photometry=quiet,
    )


def faintest_galaxies(experiment: Experiment, visits: Sequence[Visit], exposure: Exposure, snr: float) -> float:
    """Return the magnitude of a star of a signal-to-noise ratio in the stack of visits, its exposure given."""
    if visits[0].listed is None:
        return stack_limit(experiment, snr, len(visits))
    visit_limit = limiting_magnitude(
        snr,
        exposure.photometry or exposure.band,
        exposure.time,
        NOMINAL_FWHM,
        pixel_scale=exposure.pixel_scale,
        sky=exposure.sky,
    )
    return float(visit_limit + 1.25 * np.log10(exposure.exposures))


def _noise_of(experiment: Experiment, visit: Visit, pixel_scale: float) -> tuple[float, float, float]:
    """Return weight, time that a source has as many electrons in at the run's zero point [s], variance of a pixel."""
    visit_run = visit_experiment(experiment, visit)
    band, seconds = visit_run.band, visit_run.config.atmosphere.exposure_s
    variance = sky_electrons_per_pixel(band, seconds, pixel_scale) + instrument_noise(band, seconds) ** 2
    dimming = 10.0 ** (0.4 * (band.zero_point - experiment.band.zero_point))
    return float(stack_weight(visit_run, visit) or 0.0), seconds * dimming, variance
