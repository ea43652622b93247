"""PSF model of one CCD from its observed stars, compared with noise-free PSFs between them."""

from __future__ import annotations

import numpy as np

from ..ccd_product import CcdProduct, ObservedStars, TruthStars
from ..defaults import truth_components
from ..experiment import Experiment
from ..measure.shapes import Shapes, fwhm, measure_shapes
from ..psf_model.checks import snr_weights
from ..psf_model.model import CLIP_SIGMA, PsfModel
from ..psf_model.polynomial import term_count
from .ccd_exposure import CcdExposure, ccd_stars
from .ccd_observation import observe_ccd
from .photometry import effective_fwhm, signal_to_noise


def model_ccd(experiment: Experiment, exposure: CcdExposure, *, noisy: bool = True) -> CcdProduct:
    """Look at the stars of one CCD through noise, and model the PSF from what was seen.

    Parameters
    ----------
    experiment : Experiment
        Telescope, focal plane, atmosphere and settings.
    exposure : CcdExposure
        The stars.
    noisy : bool
        Without noise, what stands out is the PSF: no pixel is rejected, as for the truth.

    Raises
    ------
    PachonError
        If a stage fails.
    """
    config = experiment.config
    name, places, truth, observed = exposure.name, exposure.places, exposure.truth, exposure.observed
    truth_images = truth.image.astype(np.float64)
    truth_shapes = measure_shapes(truth_images, truth.pixel_scale, experiment.weight_fwhm)
    # Places do not depend on the limits of magnitude, which in turn need to know how much light the stars lose.
    width = effective_fwhm(truth.image, truth.pixel_scale)
    stars = ccd_stars(experiment, name, width, least_light=float(observed.light.min()))
    electrons = stars.electrons * observed.light
    snr = signal_to_noise(
        stars.magnitude - 2.5 * np.log10(observed.light), stars.band, config.atmosphere.exposure_s, width
    )
    seen = observe_ccd(experiment, name, observed.image, observed.pixel_scale, electrons, noisy=noisy)
    fit, used = config.reconstruction, seen.used
    least = 1 + (fit.components or 0) if fit.basis == "pca" else 2
    seen.require(max(least, term_count(fit.order or 0)))
    model = PsfModel.fit(
        seen.images[used],
        stars.observed[used],
        basis=fit.basis,
        interpolation=fit.interpolation,
        weights=snr_weights(fit.weights, snr[used]),
        n_components=fit.components,
        order=fit.order,
        extent=places.bounds,
        clip_sigma=CLIP_SIGMA if noisy else None,
    )
    # Noise-free stars have no outliers: what stands out there is the PSF.
    truth_model = PsfModel.fit(
        truth_images,
        places.truth,
        n_components=truth_components(config),
        order=fit.truth_order,
        extent=places.bounds,
        clip_sigma=None,
    )

    def shapes_of(images: np.ndarray) -> Shapes:
        return measure_shapes(images, observed.pixel_scale, experiment.weight_fwhm)

    at_truth, at_stars = shapes_of(model.at(places.truth)), shapes_of(model.at(stars.observed))
    x, y = experiment.camera.centers[experiment.camera.ccd_index(name)]
    left_out = shapes_of(model.leave_one_out())
    left_out_e1, left_out_e2 = np.full((2, len(used)), np.nan)
    left_out_e1[used], left_out_e2[used] = left_out.e1, left_out.e2
    return CcdProduct(
        name=name,
        center=(float(x), float(y)),
        pixel_scale=truth.pixel_scale,
        noise=seen.noise,
        truth=TruthStars(
            **_positions(places.truth, truth.fields),
            **_shapes(truth_shapes, at_truth),
            fwhm=fwhm(truth.image, truth.pixel_scale),
        ),
        observed=ObservedStars(
            **_positions(stars.observed, observed.fields),
            **_shapes(seen.shapes, at_stars),
            magnitude=stars.magnitude,
            electrons=electrons,
            snr=snr,
            defects=seen.defects,
            used=used,
            left_out_e1=left_out_e1,
            left_out_e2=left_out_e2,
        ),
        truth_images=truth_images.astype(np.float32),
        observed_images=seen.images.astype(np.float32),
        model=model,
        truth_model=truth_model,
    )


def _positions(positions: np.ndarray, fields: np.ndarray) -> dict[str, np.ndarray]:
    return {"x": positions[:, 0], "y": positions[:, 1], "field_x": fields[:, 0], "field_y": fields[:, 1]}


def _shapes(measured: Shapes, model: Shapes) -> dict[str, np.ndarray]:
    return {
        "e1": measured.e1,
        "e2": measured.e2,
        "size": measured.size,
        "flags": measured.flags,
        "model_e1": model.e1,
        "model_e2": model.e2,
        "model_size": model.size,
    }
