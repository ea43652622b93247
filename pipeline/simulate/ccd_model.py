"""PSF model of one CCD from its observed stars, compared with noise-free PSFs between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from ...core.errors import DomainError, PachonError, attempt
from ...core.groups import rows_of, slices_of
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
from .ccd_observation import CollectedStars, Observation, collected_images, observe_ccds
from .photometry import effective_fwhm, light_of_sky, signal_to_noise, vignetted
from .sky_axes import sky_jacobians
from .star_field import StarField

#: Stamps measured by one call: the memory of more would be mapped anew each time, which takes as long as measuring.
_STAMPS_TOGETHER = 1000


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


class _ExposedCcd(NamedTuple):
    """Stars of one CCD before they are observed."""

    exposure: CcdExposure
    stars: StarField  #: with magnitudes of the limit that vignetting leaves
    snr: np.ndarray
    collected: CollectedStars


class _ModelledCcd(NamedTuple):
    """Model of one CCD with its images of the stars."""

    exposed: _ExposedCcd
    observation: Observation
    model: PsfModel
    colours: np.ndarray | None  #: of the stars
    holdout_models: np.ndarray
    star_models: np.ndarray


class _ComparedCcd(NamedTuple):
    """Model of one CCD with adaptive moments of stars and of models."""

    modelled: _ModelledCcd
    holdout: tuple[AdaptiveMoments, AdaptiveMoments]  #: of noise-free PSFs, and of the model there
    observed: tuple[AdaptiveMoments, AdaptiveMoments]  #: of stars, and of the model there


_Ccd = TypeVar("_Ccd")
_Result = TypeVar("_Result")


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

    def produce(ccds: list[_ComparedCcd]) -> list[CcdProduct | PachonError]:
        jacobians = _jacobians(experiment, ccds)
        return [
            axes if isinstance(axes, PachonError) else attempt(_product, experiment, ccd, axes)
            for ccd, axes in zip(ccds, jacobians, strict=True)
        ]

    return _together(produce, _compared(experiment, exposures, noisy=noisy, every_star=True))


def fit_ccds(experiment: Experiment, exposures: Sequence[CcdExposure]) -> list[CcdFit | PachonError]:
    """Return how the models of :func:`model_ccds` fit, to the same digits, without what only products have."""
    return [
        ccd if isinstance(ccd, PachonError) else _fit(ccd)
        for ccd in _compared(experiment, exposures, noisy=True, every_star=False)
    ]


def _together(
    function: Callable[[list[_Ccd]], Sequence[_Result | PachonError]], ccds: Sequence[_Ccd | PachonError]
) -> list[_Result | PachonError]:
    """Return what a function of all CCDs without an error gives for each of them, with the error of a CCD in its place.

    No CCD may change a byte of another.
    """
    good = [ccd for ccd in ccds if not isinstance(ccd, PachonError)]
    results = iter(function(good) if good else ())
    return [ccd if isinstance(ccd, PachonError) else next(results) for ccd in ccds]


def _compared(
    experiment: Experiment, exposures: Sequence[CcdExposure], *, noisy: bool, every_star: bool
) -> list[_ComparedCcd | PachonError]:
    """Model the stars of CCDs, with noise and defects where `noisy`, and measure stars and models.

    Noise-free stars are those at the holdout positions, others those of the model or `every_star`.
    """
    exposed = [attempt(_exposed, experiment, exposure) for exposure in exposures]
    modelled = _together(partial(_modelled, experiment, noisy=noisy), exposed)
    return _together(partial(_measured, experiment, every_star=every_star), modelled)


def _exposed(experiment: Experiment, exposure: CcdExposure) -> _ExposedCcd:
    """Return the stars of one CCD with their light."""
    holdout, observed = exposure.holdout, exposure.observed
    # Positions do not depend on the magnitude limits, which follow from the vignetting of the stars.
    width = effective_fwhm(holdout.image, holdout.pixel_scale)
    least_light = float(observed.lit_fraction.min()) if len(observed.lit_fraction) else 1.0
    sky_light = light_of_sky(observed.lit_fraction)
    stars = ccd_stars(experiment, exposure.name, width, least_light=least_light)
    electrons = stars.electrons * observed.lit_fraction
    dimmed = stars.magnitude - 2.5 * np.log10(observed.lit_fraction)
    band, scale = vignetted(stars.band, sky_light), observed.pixel_scale
    snr = signal_to_noise(dimmed, band, experiment.config.atmosphere.exposure_s, width)
    images = collected_images(experiment, observed.image, scale, electrons, sky_light)
    return _ExposedCcd(exposure, stars, snr, CollectedStars(exposure.name, images, scale, electrons, sky_light))


def _modelled(experiment: Experiment, ccds: Sequence[_ExposedCcd], *, noisy: bool) -> list[_ModelledCcd | PachonError]:
    """Observe the stars of CCDs and model their PSF; DomainError for one with too few stars."""
    observations = observe_ccds(experiment, [ccd.collected for ccd in ccds], noisy=noisy)

    def stars_of(ccd: _ExposedCcd, observation: Observation | PachonError) -> tuple[_ExposedCcd, Observation, CcdStars]:
        if isinstance(observation, PachonError):
            raise observation
        return ccd, observation, model_stars(experiment, observation, ccd.stars, ccd.collected.electrons, ccd.snr)

    def fit(ccds: Sequence[tuple[_ExposedCcd, Observation, CcdStars]]) -> list[_ModelledCcd | PachonError]:
        models = fit_ccd_models(experiment, [stars for _, _, stars in ccds], noisy=noisy)
        return [
            model if isinstance(model, PachonError) else attempt(_model_images, experiment, exposed, observation, model)
            for (exposed, observation, _), model in zip(ccds, models, strict=True)
        ]

    return _together(fit, [attempt(stars_of, *pair) for pair in zip(ccds, observations, strict=True)])


def _model_images(
    experiment: Experiment, exposed: _ExposedCcd, observation: Observation, model: PsfModel
) -> _ModelledCcd:
    """Evaluate the model of one CCD at the holdout positions and at the stars."""
    # Noise-free PSFs are those of flat spectra.
    colours, flat = star_colours(experiment, exposed.stars), float(experiment.wavelengths.mean())
    holdout = exposed.exposure.positions.holdout
    positions = np.concatenate([holdout, exposed.stars.observed])
    of_stars = np.full(len(exposed.stars.observed), flat) if colours is None else colours
    images = model.at(positions, colour=np.concatenate([np.full(len(holdout), flat), of_stars]))
    return _ModelledCcd(exposed, observation, model, colours, *np.split(images, [len(holdout)]))


def _measured(experiment: Experiment, ccds: Sequence[_ModelledCcd], *, every_star: bool) -> list[_ComparedCcd]:
    """Measure stars and models of CCDs."""
    stamps = []
    for ccd in ccds:
        observation = ccd.observation
        rows = slice(None) if every_star else observation.used
        # Like e, g is not that of a star with a defect.
        clean_stars = np.where((observation.defects == 0)[rows, None, None], observation.images[rows], np.nan)
        holdout_images = ccd.exposed.exposure.holdout.image.astype(np.float64)
        stamps += [holdout_images, ccd.holdout_models, clean_stars, ccd.star_models[rows]]
    moments = _adaptive_of(experiment, stamps, ccds[0].exposed.exposure.holdout.pixel_scale)
    return [
        _ComparedCcd(ccd, (moments[i], moments[i + 1]), (moments[i + 2], moments[i + 3]))
        for i, ccd in zip(range(0, len(moments), 4), ccds, strict=True)
    ]


def _jacobians(experiment: Experiment, ccds: Sequence[_ComparedCcd]) -> list[list[np.ndarray] | PachonError | None]:
    """Return d(sky)/d(x, y) at the holdout positions and stars of each CCD, or its error; None without a pointing."""
    if experiment.pointing is None:
        return [None] * len(ccds)
    exposed = [ccd.modelled.exposed for ccd in ccds]
    groups = [[ccd.exposure.positions.holdout, ccd.stars.observed] for ccd in exposed]
    together = attempt(sky_jacobians, experiment, [positions for group in groups for positions in group])
    if isinstance(together, PachonError):  # of one CCD
        return [attempt(sky_jacobians, experiment, group) for group in groups]
    return [together[i : i + 2] for i in range(0, len(together), 2)]


def _adaptive_of(experiment: Experiment, stamps: Sequence[np.ndarray], pixel_scale: float) -> list[AdaptiveMoments]:
    """Measure groups of stamps of stars, many by one call, which costs as much as twenty stamps."""
    # From near the width of stars the iteration takes half the steps. Other CCDs are exposed meanwhile.
    measure = partial(
        adaptive_moments, pixel_scale=pixel_scale, start_sigma=experiment.weight_fwhm / FWHM_PER_RMS, threads=1
    )
    batches = np.cumsum([len(group) for group in stamps]) // _STAMPS_TOGETHER
    moments = []
    for batch in np.unique(batches):
        groups = [group for group, of_group in zip(stamps, batches, strict=True) if of_group == batch]
        together = measure(np.concatenate(groups))
        moments += [rows_of(together, rows) for rows in slices_of(groups)]
    return moments


def _fit(ccd: _ComparedCcd) -> CcdFit:
    """Return how the model of one CCD fits."""
    exposure = ccd.modelled.exposed.exposure
    holdout, observed = ModelledMoments.of(*ccd.holdout), ModelledMoments.of(*ccd.observed)
    return CcdFit(exposure.name, exposure.holdout.pixel_scale, holdout, observed)


def _product(experiment: Experiment, compared: _ComparedCcd, jacobians: Sequence[np.ndarray] | None) -> CcdProduct:
    """Compare the model of one CCD with its stars, and with the noise-free PSFs between them."""
    config, modelled = experiment.config, compared.modelled
    exposure, stars, snr, collected = modelled.exposed
    observation, model = modelled.observation, modelled.model
    name, positions, holdout, observed = exposure.name, exposure.positions, exposure.holdout, exposure.observed
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

    model_shapes = shapes_of(modelled.holdout_models)
    stamp = f"{experiment.stamp_size} x {experiment.stamp_size} pixels (psf.stamp)"
    if not holdout_shapes.usable.any():
        raise DomainError(f"no noise-free PSF has a shape on {stamp}: expected sharper ones, or more pixels")
    if not model_shapes.usable.any():
        reason = f"the PSF model has no shape, faint stars are lost in the noise of {stamp}"
        raise DomainError(f"{reason}: expected brighter stars (stars.snr_min), or fewer pixels")
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
            **_shape_columns(holdout_shapes, model_shapes),
            **_adaptive_columns(*compared.holdout),
            **_sky_columns(holdout_axes, holdout_shapes, compared.holdout[0]),
            fwhm=fwhm(holdout.image, holdout.pixel_scale),
        ),
        observed=ObservedStars(
            **_position_columns(experiment, stars.observed, observed.fields),
            **_shape_columns(observation.shapes, shapes_of(modelled.star_models)),
            **_adaptive_columns(*compared.observed),
            **_sky_columns(star_axes, observation.shapes, compared.observed[0]),
            **_leave_one_out_columns(used, shapes_of(left_out_models), left_out_moments),
            magnitude=stars.magnitude,
            electrons=collected.electrons,
            snr=snr,
            defects=observation.defects,
            used=used,
            colour=modelled.colours,
        ),
        holdout_images=holdout_images.astype(np.float32),
        observed_images=observation.images.astype(np.float32),
        model=model,
        noise_free_model=noise_free_model,
        rotator=experiment.rotator,
    )


def model_stars(
    experiment: Experiment, observation: Observation, stars: StarField, electrons: np.ndarray, snr: np.ndarray
) -> CcdStars:
    """Return the observed stars of one CCD that its model is fitted to; DomainError if they are too few.

    Collected `electrons` and S/N are those of all stars, [n].
    """
    recipe, used = experiment.config.reconstruction.psf_recipe(), observation.used
    require_stars(used, observation.defects, least_star_count(experiment.config))
    images, colours = observation.images[used], star_colours(experiment, stars)
    if recipe.interpolation.needs_noise:  # in electrons
        images = images * electrons[used, None, None]
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
