"""PSFs of one visit, true and from a model of its stars, at points of the sky and along the axes of the stack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...core.errors import DomainError, PachonError, attempt, error_context
from ...core.progress import Reporter
from ...core.units import ARCSEC
from ...models.telescope import Telescope
from ...pipeline import listed_visit
from ...pipeline.config import PointingConfig, with_options
from ...pipeline.experiment import Experiment
from ...pipeline.focal_plane_stage import fit_focal_plane_model
from ...pipeline.resolved_values import resolved_value
from ...pipeline.simulate.ccd_exposure import CcdExposure, ccd_outline
from ...pipeline.simulate.ccd_loop import simulate_ccds
from ...pipeline.simulate.ccd_model import fit_ccd_models, model_stars
from ...pipeline.simulate.ccd_observation import CollectedStars, Observation, collected_images, observe_ccd
from ...pipeline.simulate.photometry import (
    effective_fwhm,
    electrons,
    light_of_sky,
    limiting_magnitude,
    saturation_magnitude,
    signal_to_noise,
    vignetted,
)
from ...pipeline.simulate.screen_cover import check_screens
from ...pipeline.simulate.star_field import StarField, magnitudes_at
from ...pipeline.wide_stamps import stamp_side
from ...reconstruction.focal_plane_psf.stars import CcdStars, FocalPlaneStars
from ...reconstruction.psf_model.fit import CcdStars as ModelStars
from ..night.detector_row import noise_columns
from .plan import Visit
from .resample import resample_stamps
from .sky_points import SkyPoints
from .visit_figures import VisitFigures

#: FWHM of the magnitude limits of the stars, which are the same in every visit, good or bad.
NOMINAL_FWHM = 0.7 * ARCSEC
# Least distance of stars from the edge of a CCD [pixel].
_STAR_MARGIN = 20
# Least distance of places without a star from the edge of a CCD [pixel].
_PLACE_MARGIN = 2


@dataclass(frozen=True, eq=False)
class StackFrame:
    """Axes and pixels of the stack: those of the detector in the middle of the field, without a roll.

    Attributes
    ----------
    matrix : ndarray, shape [2, 2]
        d(x, y of the stack [pixel])/d(xi, eta).
    size : int
        Pixels on a side of a stamp.
    """

    matrix: np.ndarray
    size: int

    @classmethod
    def of(cls, experiment: Experiment, pixels: int) -> StackFrame:
        """Return the frame of an experiment, with stamps as wide on the sky as so many pixels of the LSST."""
        center = Visit(0, 0).jacobians(experiment.telescope, np.zeros((1, 2)), middle_wavelength(experiment))[0]
        u, scale, vt = np.linalg.svd(center)
        size = stamp_side(pixels, experiment.band.pixel_scale)
        return cls(u @ vt * scale.mean() / experiment.pixel_size, size)

    @property
    def pixel_scale(self) -> float:
        """Angle of a pixel of the stack [rad]."""
        return float(1.0 / np.sqrt(abs(np.linalg.det(self.matrix))))

    def to_stamp(self, experiment: Experiment, visit: Visit, sky: np.ndarray, threads: int | None = None) -> np.ndarray:
        """Return d(x, y of a stamp of the visit)/d(x, y of the stack) at positions of the sky, shape [n, 2, 2]."""
        on_detector = visit.jacobians(experiment.telescope, sky, middle_wavelength(experiment), threads)
        return on_detector / experiment.pixel_size @ np.linalg.inv(self.matrix)


@dataclass(frozen=True, eq=False)
class VisitPsfs:
    """PSFs of a visit at those points of the sky that fall on its CCDs, along the axes of the stack, of unit sum."""

    index: np.ndarray  #: of the points, [n]
    true: np.ndarray  #: noise-free PSFs, [n, size, size]
    model: np.ndarray  #: those of the model, likewise
    left_out: dict[str, str]  #: CCDs that could not be modelled, and the reasons
    figures: VisitFigures  #: of these PSFs
    weight: float | None = None  #: in stacks, an inverse variance; None where all visits have the same


class _CcdResult(NamedTuple):
    exposure: CcdExposure
    observation: Observation
    electrons: np.ndarray
    true: np.ndarray
    model: np.ndarray | None  # without one of its own where one of all CCDs is wanted


def visit_experiment(experiment: Experiment, visit: Visit) -> Experiment:
    """Return the experiment of a visit: own turbulence, residual aberration, noise and, where it has one, rotator.

    That of a visit of a list has the list's pointing, angles, air, time and sky too.
    """
    if visit.listed is not None:
        return listed_visit.visit_experiment(experiment.config, visit.listed)
    config = with_options(experiment.config, atmosphere__epoch=visit.epoch, rotator_deg=visit.rotator_deg)
    if config.atmosphere.zenith_position_angle_deg is not None:
        # The zenith stands still on the sky, while the telescope rolls.
        aim = config.pointing or PointingConfig()
        rolled = aim.model_copy(update={"position_angle_deg": float(np.rad2deg(visit.roll))})
        config = config.model_copy(update={"pointing": rolled})
    return Experiment.from_config(config)


def visit_telescope(experiment: Experiment, visit: Visit) -> Telescope:
    """Return the telescope of all visits, its camera at the angle of a visit."""
    if visit.rotator_deg is None:
        return experiment.telescope
    return experiment.telescope.with_rotator(np.deg2rad(visit.rotator_deg - experiment.config.rotator_deg))


def check_rotators(experiment: Experiment, visits: Sequence[Visit]) -> None:
    """Raise ConfigError if screens are too short for the camera at the angle of a visit."""
    for visit in visits:
        if visit.rotator_deg is not None:
            telescope = visit_telescope(experiment, visit)
            with error_context(subject=f"{visit.label}, rotator {visit.rotator_deg:g} deg"):
                check_screens(experiment.config, telescope, experiment.camera, experiment.site)


def visit_psfs(
    experiment: Experiment,
    visit: Visit,
    points: SkyPoints,
    frame: StackFrame,
    *,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> VisitPsfs:
    """Make the PSFs of a visit, and the model of its stars on each CCD, or on all of them together.

    Parameters
    ----------
    experiment : Experiment
        The experiment of the visit, see :func:`visit_experiment`. Its configuration says how stars are modelled.
    visit : Visit
        Pointing and roll.
    points : SkyPoints
        Stars, to which the model is fitted, and places, where it is only compared.
    frame : StackFrame
        Axes of the result.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    reporter : Reporter, optional
        Progress display; silent by default.

    Raises
    ------
    PachonError
        If a CCD cannot be exposed, or none can be modelled.
    """
    config = experiment.config
    together = config.reconstruction.model == "focal_plane"
    fields, index = _star_fields(experiment, visit, points, threads)

    def observed(exposure: CcdExposure) -> tuple[_CcdResult, ModelStars | None]:
        """Return a CCD without its model, and the stars of this where it has one of its own."""
        stars, observed_psfs = exposure.positions, exposure.observed
        counts = stars.electrons * observed_psfs.lit_fraction
        scale, sky_light = observed_psfs.pixel_scale, light_of_sky(observed_psfs.lit_fraction)
        images = collected_images(experiment, observed_psfs.image, scale, counts, sky_light)
        collected = CollectedStars(exposure.name, images, scale, counts, sky_light)
        observation = observe_ccd(experiment, collected, noisy=True)
        true = np.concatenate([exposure.holdout.image, resolved_value(exposure.centered).image])
        result = _CcdResult(exposure, observation, counts, true, None)
        if together:
            return result, None
        width = effective_fwhm(true, scale)
        dimmed = stars.magnitude - 2.5 * np.log10(observed_psfs.lit_fraction)
        snr = signal_to_noise(dimmed, vignetted(stars.band, sky_light), config.atmosphere.exposure_s, width)
        return result, model_stars(experiment, observation, stars, counts, snr)

    def modelled(exposures: Sequence[CcdExposure]) -> list[_CcdResult | PachonError]:
        ccds = [attempt(observed, exposure) for exposure in exposures]
        stars = [ccd[1] for ccd in ccds if not isinstance(ccd, PachonError) and ccd[1] is not None]
        models = iter(fit_ccd_models(experiment, stars))
        results: list[_CcdResult | PachonError] = []
        for ccd in ccds:
            if isinstance(ccd, PachonError):
                results.append(ccd)
                continue
            result, own_stars = ccd
            model = None if own_stars is None else next(models)
            if isinstance(model, PachonError):
                results.append(model)
                continue
            images = None if model is None else model.at(_positions_in_order(result.exposure.positions))
            results.append(result._replace(model=images))
        return results

    with experiment.screens(threads, reporter):
        simulated = simulate_ccds(
            experiment,
            modelled,
            list(fields),
            fields=fields,
            centered=True,
            strict=False,
            threads=threads,
            reporter=reporter,
        )
    ccd_results = simulated.results
    if not ccd_results:
        reasons = [f"CCD {name}: {reason}" for name, reason in simulated.not_modelled.items()]
        raise DomainError("; ".join(reasons[:1]) or "no star falls on a CCD")
    true = [result.true for result in ccd_results.values()]
    if together:
        model = [_focal_plane_images(experiment, ccd_results, threads, reporter)]
    else:
        model = [result.model for result in ccd_results.values() if result.model is not None]
    rows = np.concatenate([index[name] for name in ccd_results])
    matrix = frame.to_stamp(experiment, visit, points.sky[rows], threads)

    def turned(images: list[np.ndarray]) -> np.ndarray:
        stamps = resample_stamps(np.concatenate(images), matrix, frame.size, threads=threads)
        return np.asarray(stamps / stamps.sum(axis=(1, 2), keepdims=True, dtype=np.float64).astype(np.float32))

    true_psfs, modelled_psfs = turned(true), turned(model)
    figures = VisitFigures.of(true_psfs, modelled_psfs, points.star[rows], frame.pixel_scale, experiment.weight_fwhm)
    weight = stack_weight(experiment, visit)
    return VisitPsfs(rows, true_psfs, modelled_psfs, simulated.not_modelled, figures, weight)


def stack_weight(experiment: Experiment, visit: Visit) -> float | None:
    """Return the weight of a visit of a list: that of the list, or the inverse variance of a pixel of its sky."""
    if visit.listed is None:
        return None
    weight = visit.listed.weight
    return weight if np.isfinite(weight) else noise_columns(experiment, 1.0)["weight"]


def _star_fields(
    experiment: Experiment, visit: Visit, points: SkyPoints, threads: int | None
) -> tuple[dict[str, StarField], dict[str, np.ndarray]]:
    """Return the stars of each CCD and, as its holdout positions, the places on it; and the indices of both."""
    camera, config = experiment.camera, experiment.config
    xy = visit.on_detector(experiment.telescope, points.sky, middle_wavelength(experiment), threads)
    band, seconds = experiment.band, config.atmosphere.exposure_s
    bright, faint = visit.star_limits or magnitude_limits(experiment)
    fields, index = {}, {}
    # Beyond its field of view a telescope may have no light.
    lit = np.hypot(*xy.T) <= experiment.field_radius_on_detector
    for name in config.ccds or ():
        depth = camera.depth(camera.ccd_index(name), *xy.T)
        stars = np.flatnonzero((depth >= _STAR_MARGIN * camera.pixel_size) & points.star & lit)
        places = np.flatnonzero((depth >= _PLACE_MARGIN * camera.pixel_size) & ~points.star & lit)
        if not len(stars):
            continue
        magnitude = magnitudes_at(points.quantile[stars], bright, faint)
        fields[name] = StarField(
            ccd=ccd_outline(camera, name),
            holdout=xy[places],
            observed=xy[stars],
            magnitude=magnitude,
            electrons=electrons(magnitude, band, seconds),
            band=band,
            exposure=seconds,
            bright=bright,
            faint=faint,
        )
        index[name] = np.concatenate([places, stars])
    return fields, index


def _positions_in_order(stars: StarField) -> np.ndarray:
    """Return the positions of places and of stars, in the order of their indices."""
    return np.concatenate([stars.holdout, stars.observed])


def magnitude_limits(experiment: Experiment) -> tuple[float, float]:
    """Return the magnitude limits of the stars, bright and faint, which are the same in every visit."""
    config = experiment.config
    bright = saturation_magnitude(experiment.band, config.atmosphere.exposure_s, NOMINAL_FWHM)
    return bright, stack_limit(experiment, config.stars.snr_min, 1)


def stack_limit(experiment: Experiment, snr: float, visits: int) -> float:
    """Return the magnitude of a star of a signal-to-noise ratio in a stack of visits of nominal seeing."""
    config = experiment.config
    visit_limit = limiting_magnitude(snr, experiment.band, config.atmosphere.exposure_s, NOMINAL_FWHM)
    return float(visit_limit + 1.25 * np.log10(visits))


def _focal_plane_images(
    experiment: Experiment, ccd_results: dict[str, _CcdResult], threads: int | None, reporter: Reporter | None
) -> np.ndarray:
    """Return the PSFs of one model of all CCDs at the points."""
    stars = FocalPlaneStars.of_ccds(
        [
            CcdStars(
                name,
                result.exposure.positions.observed[:, 0],
                result.exposure.positions.observed[:, 1],
                result.observation.shapes,
                result.electrons,
                result.observation.noise,
                result.observation.images,
                result.observation.used,
            )
            for name, result in ccd_results.items()
        ],
        next(iter(ccd_results.values())).exposure.observed.pixel_scale,
        experiment.weight_fwhm,
    )
    model = fit_focal_plane_model(experiment, stars, ccds=list(ccd_results), threads=threads, reporter=reporter)
    places = {name: _positions_in_order(result.exposure.positions) for name, result in ccd_results.items()}
    names = [name for name, xy in places.items() for _ in range(len(xy))]
    return model.draw(names, *np.concatenate(list(places.values())).T, threads=threads)


def middle_wavelength(experiment: Experiment) -> float:
    """Return the vacuum wavelength to which positions refer [m]."""
    return float(experiment.wavelengths[len(experiment.wavelengths) // 2])
