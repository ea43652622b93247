"""PSF model of one CCD from its observed stars, compared with noise-free PSFs between them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...core.errors import PachonError, attempt
from ...core.statistics import FWHM_PER_RMS
from ...measure.adaptive_moments import AdaptiveMoments, adaptive_moments
from ...measure.shapes import Shapes, fwhm, measure_shapes
from ...measure.star_selection import require_stars
from ...models.star_spectrum import blackbody_photons, effective_colour
from ...reconstruction.ccd_product import CcdProduct, HoldoutStars, ObservedStars
from ...reconstruction.psf_model.fit import CcdStars, fit_stars
from ...reconstruction.psf_model.model import CLIPPING, PsfModel
from ...sky.sky_shapes import along_sky
from ..experiment import Experiment
from ..resolved_values import least_star_count, noise_free_components
from .ccd_exposure import CcdExposure, ccd_stars
from .ccd_observation import Observation, collected_images, observe_ccd
from .photometry import effective_fwhm, signal_to_noise
from .sky_axes import sky_jacobians
from .star_field import StarField


class ModelledMoments(NamedTuple):
    """Adaptive moments of stars, and of their models, as :class:`.HoldoutStars` has them, each [n]."""

    sigma: np.ndarray  #: [rad]
    g1: np.ndarray
    g2: np.ndarray
    model_sigma: np.ndarray  #: [rad]
    model_g1: np.ndarray
    model_g2: np.ndarray

    @classmethod
    def of(cls, measured: AdaptiveMoments, model: AdaptiveMoments) -> ModelledMoments:
        """Return those of measurements."""
        return cls(measured.sigma, measured.g1, measured.g2, model.sigma, model.g1, model.g2)


class CcdFit(NamedTuple):
    """How the PSF model of one CCD fits: what of a :class:`.CcdProduct` the visits of a night keep."""

    name: str
    pixel_scale: float  #: angle of a pixel [rad]
    holdout: ModelledMoments  #: at the holdout positions
    observed: ModelledMoments  #: of the stars that the model is fitted to

    @classmethod
    def of(cls, product: CcdProduct) -> CcdFit:
        """Return that of a product."""
        holdout, observed, used = product.holdout, product.observed, product.observed.used
        keys = ModelledMoments._fields
        return cls(
            product.name,
            product.pixel_scale,
            ModelledMoments(*(getattr(holdout, key) for key in keys)),
            ModelledMoments(*(getattr(observed, key)[used] for key in keys)),
        )


class _ObservedCcd(NamedTuple):
    """Stars of one CCD before they are modelled."""

    exposure: CcdExposure
    stars: StarField  #: with magnitudes of the limit that vignetting leaves
    electrons: np.ndarray
    snr: np.ndarray
    observation: Observation
    model_stars: CcdStars  #: those that the model is fitted to


def model_ccd(experiment: Experiment, exposure: CcdExposure, *, noisy: bool = True) -> CcdProduct:
    """Add noise and defects to the stars of one CCD where `noisy`, and model the PSF from them.

    Without noise no pixel is rejected: deviations from the mean are the variation of the PSF.
    """
    product = model_ccds(experiment, [exposure], noisy=noisy)[0]
    if isinstance(product, PachonError):
        raise product
    return product


def model_ccds(
    experiment: Experiment, exposures: Sequence[CcdExposure], *, noisy: bool = True
) -> list[CcdProduct | PachonError]:
    """Return the products of CCDs as :func:`model_ccd` does, with the error of a CCD in its place.

    No CCD changes a byte of another: together they cost less, as covariances are searched and rays traced at once.
    """
    modelled = _modelled(experiment, exposures, noisy=noisy)
    jacobians = iter(_jacobians(experiment, [ccd[0] for ccd in modelled if not isinstance(ccd, PachonError)]))
    products: list[CcdProduct | PachonError] = []
    for ccd in modelled:
        if isinstance(ccd, PachonError):
            products.append(ccd)
            continue
        sky_axes = next(jacobians)
        products.append(
            sky_axes if isinstance(sky_axes, PachonError) else attempt(_product, experiment, *ccd, sky_axes)
        )
    return products


def fit_ccds(experiment: Experiment, exposures: Sequence[CcdExposure]) -> list[CcdFit | PachonError]:
    """Return how the models of :func:`model_ccds` fit, to the same digits, without what only products have."""
    return [
        ccd if isinstance(ccd, PachonError) else attempt(_fit, experiment, *ccd)
        for ccd in _modelled(experiment, exposures, noisy=True)
    ]


def _modelled(
    experiment: Experiment, exposures: Sequence[CcdExposure], *, noisy: bool
) -> list[tuple[_ObservedCcd, PsfModel] | PachonError]:
    """Return the stars of CCDs and their model, with the error of a CCD in its place."""
    ccds = [attempt(_observed, experiment, exposure, noisy=noisy) for exposure in exposures]
    stars = [ccd.model_stars for ccd in ccds if not isinstance(ccd, PachonError)]
    models = iter(fit_ccd_models(experiment, stars, noisy=noisy))
    modelled: list[tuple[_ObservedCcd, PsfModel] | PachonError] = []
    for ccd in ccds:
        if isinstance(ccd, PachonError):
            modelled.append(ccd)
            continue
        model = next(models)
        modelled.append(model if isinstance(model, PachonError) else (ccd, model))
    return modelled


def _observed(experiment: Experiment, exposure: CcdExposure, *, noisy: bool) -> _ObservedCcd:
    """Add noise and defects to the stars of one CCD where `noisy`; DomainError if too few are left for a model."""
    holdout, observed = exposure.holdout, exposure.observed
    # Positions do not depend on the magnitude limits, which follow from the vignetting of the stars.
    width = effective_fwhm(holdout.image, holdout.pixel_scale)
    stars = ccd_stars(experiment, exposure.name, width, least_light=float(observed.lit_fraction.min()))
    electrons = stars.electrons * observed.lit_fraction
    dimmed = stars.magnitude - 2.5 * np.log10(observed.lit_fraction)
    snr = signal_to_noise(dimmed, stars.band, experiment.config.atmosphere.exposure_s, width)
    collected = collected_images(experiment, observed.image, observed.pixel_scale, electrons)
    observation = observe_ccd(experiment, exposure.name, collected, observed.pixel_scale, electrons, noisy=noisy)
    return _ObservedCcd(exposure, stars, electrons, snr, observation, model_stars(experiment, observation, stars, snr))


def _jacobians(experiment: Experiment, ccds: Sequence[_ObservedCcd]) -> list[list[np.ndarray] | PachonError | None]:
    """Return d(sky)/d(x, y) at the holdout positions and stars of each CCD, or its error; None without a pointing."""
    if experiment.pointing is None:
        return [None] * len(ccds)
    groups = [[ccd.exposure.positions.holdout, ccd.stars.observed] for ccd in ccds]
    together = attempt(sky_jacobians, experiment, [positions for group in groups for positions in group])
    if isinstance(together, PachonError):  # of one CCD
        return [attempt(sky_jacobians, experiment, group) for group in groups]
    return [together[i : i + 2] for i in range(0, len(together), 2)]


class _Compared(NamedTuple):
    """Images of the model of one CCD, and adaptive moments of stars and models."""

    colours: np.ndarray | None  #: of the stars
    holdout_models: np.ndarray
    star_models: np.ndarray
    holdout: tuple[AdaptiveMoments, AdaptiveMoments]
    observed: tuple[AdaptiveMoments, AdaptiveMoments]


def _adaptive_of(experiment: Experiment, stamps: Sequence[np.ndarray], pixel_scale: float) -> list[AdaptiveMoments]:
    """Measure groups of stamps of stars by one call, which costs as much as twenty stamps."""
    # From near the width of stars the iteration takes half the steps. Other CCDs are exposed meanwhile.
    start = experiment.weight_fwhm / FWHM_PER_RMS
    together = adaptive_moments(np.concatenate(stamps), pixel_scale, start_sigma=start, threads=1)
    ends = np.cumsum([len(group) for group in stamps[:-1]])
    columns = [np.split(getattr(together, field.name), ends) for field in dataclasses.fields(AdaptiveMoments)]
    return [AdaptiveMoments(*group) for group in zip(*columns, strict=True)]


def _compared(experiment: Experiment, ccd: _ObservedCcd, model: PsfModel, rows: np.ndarray | slice) -> _Compared:
    """Compare the model of one CCD with noise-free PSFs at the holdout positions, and with the stars of some rows."""
    holdout, stars, observation = ccd.exposure.holdout, ccd.stars, ccd.observation
    # Noise-free PSFs are those of flat spectra.
    colours, flat = star_colours(experiment, stars), float(experiment.wavelengths.mean())
    holdout_models = model.at(ccd.exposure.positions.holdout, colour=flat)
    star_models = model.at(stars.observed, colour=colours)
    # Like e, g is not that of a star with a defect.
    clean_stars = np.where((observation.defects == 0)[rows, None, None], observation.images[rows], np.nan)

    stamps = [holdout.image.astype(np.float64), holdout_models, clean_stars, star_models[rows]]
    measured = _adaptive_of(experiment, stamps, holdout.pixel_scale)
    return _Compared(colours, holdout_models, star_models, (measured[0], measured[1]), (measured[2], measured[3]))


def _fit(experiment: Experiment, ccd: _ObservedCcd, model: PsfModel) -> CcdFit:
    """Return how the model of one CCD fits."""
    compared = _compared(experiment, ccd, model, ccd.observation.used)
    holdout, observed = ModelledMoments.of(*compared.holdout), ModelledMoments.of(*compared.observed)
    return CcdFit(ccd.exposure.name, ccd.exposure.holdout.pixel_scale, holdout, observed)


def _product(
    experiment: Experiment, ccd: _ObservedCcd, model: PsfModel, jacobians: Sequence[np.ndarray] | None
) -> CcdProduct:
    """Compare the model of one CCD with its stars, and with the noise-free PSFs between them."""
    config, stars, observation = experiment.config, ccd.stars, ccd.observation
    name, positions = ccd.exposure.name, ccd.exposure.positions
    holdout, observed = ccd.exposure.holdout, ccd.exposure.observed
    used = observation.used
    holdout_images = holdout.image.astype(np.float64)
    holdout_shapes = measure_shapes(holdout_images, holdout.pixel_scale, experiment.weight_fwhm)
    # Noise-free stars have no outliers: deviations from the mean are the variation of the PSF.
    noise_free_model = PsfModel.fit(
        holdout_images,
        positions.holdout,
        n_components=noise_free_components(config),
        order=config.reconstruction.truth_order,
        extent=positions.ccd.extent,
        clipping=None,
    )

    def shapes_of(images: np.ndarray) -> Shapes:
        return measure_shapes(images, observed.pixel_scale, experiment.weight_fwhm)

    compared = _compared(experiment, ccd, model, slice(None))
    left_out_models = model.leave_one_out()
    left_out_moments = _adaptive_of(experiment, [left_out_models], observed.pixel_scale)[0]
    x, y = experiment.camera.centers[experiment.camera.ccd_index(name)]
    holdout_axes, star_axes = (None, None) if jacobians is None else jacobians
    return CcdProduct(
        name=name,
        center=(float(x), float(y)),
        pixel_scale=holdout.pixel_scale,
        noise=observation.noise,
        holdout=HoldoutStars(
            **_position_columns(experiment, positions.holdout, holdout.fields),
            **_shape_columns(holdout_shapes, shapes_of(compared.holdout_models)),
            **_adaptive_columns(*compared.holdout),
            **_sky_columns(holdout_axes, holdout_shapes, compared.holdout[0]),
            fwhm=fwhm(holdout.image, holdout.pixel_scale),
        ),
        observed=ObservedStars(
            **_position_columns(experiment, stars.observed, observed.fields),
            **_shape_columns(observation.shapes, shapes_of(compared.star_models)),
            **_adaptive_columns(*compared.observed),
            **_sky_columns(star_axes, observation.shapes, compared.observed[0]),
            **_leave_one_out_columns(used, shapes_of(left_out_models), left_out_moments),
            magnitude=stars.magnitude,
            electrons=ccd.electrons,
            snr=ccd.snr,
            defects=observation.defects,
            used=used,
            colour=compared.colours,
        ),
        holdout_images=holdout_images.astype(np.float32),
        observed_images=observation.images.astype(np.float32),
        model=model,
        noise_free_model=noise_free_model,
        rotator=experiment.rotator,
    )


def model_stars(experiment: Experiment, observation: Observation, stars: StarField, snr: np.ndarray) -> CcdStars:
    """Return the observed stars of one CCD, S/N [n], that its model is fitted to; DomainError if they are too few."""
    recipe, used = experiment.config.reconstruction.psf_recipe(), observation.used
    require_stars(used, observation.defects, least_star_count(experiment.config))
    images, colours = observation.images[used], star_colours(experiment, stars)
    if recipe.interpolation.needs_noise:  # in electrons
        images = images * stars.electrons[used, None, None]
    return CcdStars(
        images,
        stars.observed[used],
        weights=recipe.star_weights(snr[used]),
        extent=stars.ccd.extent,
        colour=None if colours is None else colours[used],
    )


def fit_ccd_models(
    experiment: Experiment, ccds: Sequence[CcdStars], *, noisy: bool = True
) -> list[PsfModel | PachonError]:
    """Fit the PSF models of the configuration to the stars of CCDs, with the error of a CCD in its place."""
    recipe = experiment.config.reconstruction.psf_recipe()
    return fit_stars(PsfModel, ccds, recipe, gain=1.0, clipping=CLIPPING if noisy else None)


def star_colours(experiment: Experiment, stars: StarField) -> np.ndarray | None:
    """Return the mean wavelengths in the band of observed stars [m], NaN without a spectrum; None without any."""
    kelvin, wavelengths = stars.temperature, experiment.wavelengths
    if kelvin is None:
        return None
    return np.where(np.isnan(kelvin), np.nan, effective_colour(wavelengths, blackbody_photons(kelvin, wavelengths)))


def _position_columns(experiment: Experiment, positions: np.ndarray, fields: np.ndarray) -> dict[str, np.ndarray]:
    """Return positions on the detector and of the sky; celestial ones where the configuration has a pointing."""
    columns = {"x": positions[:, 0], "y": positions[:, 1], "field_x": fields[:, 0], "field_y": fields[:, 1]}
    aim = experiment.pointing
    if aim is not None:
        columns["ra"], columns["dec"] = aim.to_celestial(aim.to_sky(np.tan(fields))).T
    return columns


def _sky_columns(jacobians: np.ndarray | None, shapes: Shapes, adaptive: AdaptiveMoments) -> dict[str, np.ndarray]:
    """Return ellipticities along the axes of the sky, to which Jacobians [n, 2, 2] lead; none without them."""
    if jacobians is None:
        return {}
    e1, e2 = along_sky(shapes.e1, shapes.e2, jacobians)
    g1, g2 = along_sky(adaptive.g1, adaptive.g2, jacobians)
    return {"e1_sky": e1, "e2_sky": e2, "g1_sky": g1, "g2_sky": g2}


def _shape_columns(measured: Shapes, model: Shapes) -> dict[str, np.ndarray]:
    return {
        "e1": measured.e1,
        "e2": measured.e2,
        "size": measured.size,
        "flags": measured.flags,
        "model_e1": model.e1,
        "model_e2": model.e2,
        "model_size": model.size,
    }


def _adaptive_columns(measured: AdaptiveMoments, model: AdaptiveMoments) -> dict[str, np.ndarray]:
    return ModelledMoments.of(measured, model)._asdict() | {"adaptive_flags": measured.flags}


def _leave_one_out_columns(used: np.ndarray, shapes: Shapes, adaptive: AdaptiveMoments) -> dict[str, np.ndarray]:
    """Return shapes of models fitted without each used star in turn; NaN for the other stars."""
    values = {"e1": shapes.e1, "e2": shapes.e2, "g1": adaptive.g1, "g2": adaptive.g2, "sigma": adaptive.sigma}
    columns = {}
    for key, of_used in values.items():
        column = np.full(len(used), np.nan)
        column[used] = of_used
        columns[f"leave_one_out_{key}"] = column
    return columns
