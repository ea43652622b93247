"""Stars of the study of PSF models: noise-free, with noise, and the models fitted to them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...core.progress import Reporter
from ...core.random_streams import stream
from ...core.statistics import finite_mean
from ...core.units import ARCSEC
from ...measure.adaptive_moments import AdaptiveMoments, adaptive_moments
from ...measure.shapes import Shapes, measure_shapes
from ...measure.stamps import observe_stamps
from ...pipeline.experiment import Experiment
from ...pipeline.simulate.ccd_exposure import CcdExposure
from ...pipeline.simulate.ccd_loop import one_by_one, simulate_ccds
from ...pipeline.simulate.ccd_observation import CollectedStars, Observation, collected_images, observe_ccd
from ...pipeline.simulate.photometry import (
    effective_fwhm,
    instrument_noise,
    light_of_sky,
    limiting_magnitude,
    signal_to_noise,
    sky_electrons_per_pixel,
    vignetted,
)
from ...pipeline.simulate.star_field import Depth, make_star_field
from ...reconstruction.psf_model.model import CLIPPING, PsfModel
from .plan import NOISE_FREE, Case

#: Start of the adaptive moments [rad], near the width of stars: a third of the steps from that of HSM.
_START = 0.3 * ARCSEC


@dataclass(frozen=True)
class SimulatedCcd:
    """Stars of a CCD without noise."""

    exposure: CcdExposure
    holdout: Shapes  #: of the PSFs at the holdout positions
    noise_free: Observation  #: of the stars to be observed

    @cached_property
    def holdout_moments(self) -> AdaptiveMoments:
        """Adaptive moments of the PSFs at the holdout positions."""
        return star_moments(self.exposure.holdout.image, self.exposure.holdout.pixel_scale)

    @cached_property
    def noise_free_moments(self) -> AdaptiveMoments:
        """Adaptive moments of the stars to be observed."""
        return star_moments(self.noise_free.images, self.exposure.observed.pixel_scale)


@dataclass(frozen=True)
class ObservedCcd:
    """Stars of a CCD with noise."""

    observation: Observation
    moments: AdaptiveMoments  #: of the centred stamps
    electrons: np.ndarray
    snr: np.ndarray
    variance: np.ndarray  #: of the noise of one component of the weighted e
    variance_g: np.ndarray  #: of the noise of one component of g


def simulate(experiment: Experiment, threads: int | None, reporter: Reporter) -> list[SimulatedCcd]:
    """Return the noise-free stars of all CCDs."""

    def measured(exposure: CcdExposure) -> SimulatedCcd:
        holdout = measure_shapes(exposure.holdout.image, exposure.holdout.pixel_scale, experiment.weight_fwhm)
        return SimulatedCcd(exposure, holdout, _centered_and_measured(experiment, exposure, exposure.observed.image))

    with experiment.screens(threads, reporter):
        simulated = simulate_ccds(
            experiment,
            lambda exposures: one_by_one(measured, exposures),
            title="stars",
            threads=threads,
            reporter=reporter,
        )
    return list(simulated.results.values())


def _centered_and_measured(experiment: Experiment, exposure: CcdExposure, images: np.ndarray) -> Observation:
    """Centre and measure images of the stars of a CCD, noise included."""
    scale = exposure.observed.pixel_scale
    return observe_ccd(
        experiment, CollectedStars(exposure.name, images, scale, exposure.positions.electrons), noisy=False
    )


def observe(experiment: Experiment, ccd: SimulatedCcd, snr_min: float, draw: int) -> ObservedCcd:
    """Return the stars of a CCD with one draw of the noise.

    `snr_min` is the signal-to-noise ratio of the faintest star where the lit fraction is least; infinite for no noise.
    """
    exposed, places, name = ccd.exposure.observed, ccd.exposure.positions, ccd.exposure.name
    n_stars = len(exposed.image)
    if snr_min == NOISE_FREE:
        unlimited = np.full(n_stars, np.inf)
        nothing = np.zeros(n_stars)
        return ObservedCcd(ccd.noise_free, ccd.noise_free_moments, unlimited, unlimited, nothing, nothing)
    seed, light = experiment.config.seed, exposed.lit_fraction
    width = effective_fwhm(ccd.exposure.holdout.image, ccd.exposure.holdout.pixel_scale)
    sky_light = light_of_sky(light)
    at_rim = vignetted(places.band, float(light.min()))
    faint = limiting_magnitude(snr_min, at_rim, places.exposure, width) + 2.5 * np.log10(light.min())
    # The same stars in the same order; the limit alone changes.
    depth = Depth(places.band, places.exposure, faint=faint)
    stars = make_star_field(places.ccd, 0, n_stars, seed, fwhm=width, depth=depth)
    band = vignetted(places.band, sky_light)
    sky = sky_electrons_per_pixel(band, places.exposure, exposed.pixel_scale)
    rng = stream(seed, "study", "noise", name, draw)
    electrons = stars.electrons * light
    collected = collected_images(experiment, exposed.image, exposed.pixel_scale, electrons, sky_light)
    images = observe_stamps(collected, electrons, sky, instrument_noise(places.band, places.exposure), rng)
    observation = _centered_and_measured(experiment, ccd.exposure, images)
    snr = signal_to_noise(stars.magnitude - 2.5 * np.log10(light), band, places.exposure, width)
    moments, noise_free = star_moments(observation.images, exposed.pixel_scale), ccd.noise_free_moments
    # The noise of e and of g is proportional to 1/(S/N); the factor is that of all stars together.
    noise = np.stack(
        [observation.shapes.e1 - ccd.noise_free.shapes.e1, observation.shapes.e2 - ccd.noise_free.shapes.e2]
    )
    noise_g = np.stack([moments.g1 - noise_free.g1, moments.g2 - noise_free.g2])
    variance, variance_g = (finite_mean((v * snr)[:, observation.used] ** 2) / snr**2 for v in (noise, noise_g))
    return ObservedCcd(observation, moments, electrons, snr, variance, variance_g)


def star_moments(images: np.ndarray, pixel_scale: float, threads: int | None = 1) -> AdaptiveMoments:
    """Return the adaptive moments of images of stars."""
    return adaptive_moments(images, pixel_scale, start_sigma=_START, threads=threads)


def fit(case: Case, ccd: SimulatedCcd, observed: ObservedCcd) -> PsfModel:
    """Fit the PSF model of a case to the first stars of a CCD."""
    used = used_stars(case, observed)
    recipe = case.recipe()
    images = observed.observation.images[used]
    photons = recipe.interpolation.needs_noise and case.snr != NOISE_FREE
    if photons:
        images = images * observed.electrons[used, None, None]
    return PsfModel.fit(
        images,
        ccd.exposure.positions.observed[used],
        recipe=recipe,
        # A star that is not usable costs one principal component.
        n_components=min(case.components, int(used.sum()) - 1) if recipe.basis.ordered else None,
        weights=recipe.star_weights(observed.snr[used]),
        gain=1.0 if photons else None,
        extent=ccd.exposure.positions.ccd.extent,
        clipping=None if case.snr == NOISE_FREE else CLIPPING,  # without noise there are no outliers
    )


def used_stars(case: Case, observed: ObservedCcd) -> np.ndarray:
    """Return which stars a case fits: the first ones, where usable."""
    return observed.observation.used & (np.arange(len(observed.snr)) < case.stars)
