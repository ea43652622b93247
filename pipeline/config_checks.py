"""Checks of a resolved configuration across several values."""

from __future__ import annotations

from ..core.errors import ConfigError
from ..core.schema import json_text
from ..models.media.silicon import WAVELENGTH_RANGE as SILICON_RANGE
from ..models.telescope import Telescope
from ..reconstruction.psf_model.polynomial import term_count
from ..wavefront.psf.engines import ENGINES
from ..wavefront.psf.statistical import StatisticalEngine, check_exposure
from .config import Configuration, FocalPlaneConfig, StarsConfig
from .resolved_values import noise_free_components, resolved_value
from .sensor.brighter_fatter import PIXEL_SIZE as BRIGHTER_FATTER_PIXEL
from .star_list import NAMES

#: Pixels in the FWHM of the weight of the moments for accurate sums.
WEIGHT_PIXELS = 2.5


def check_combinations(config: Configuration, telescope: Telescope, pixel_arcsec: float) -> None:
    """Raise ConfigError for the first combination of values that is impossible.

    `pixel_arcsec` is the pixel of the stamps.
    """
    _check_wavelengths(config, telescope)
    if resolved_value(config.psf.stamp) % 2 == 0:
        raise ConfigError(f"psf.stamp = {config.psf.stamp}: expected an odd number of pixels")
    if config.sensor.brighter_fatter is not None and config.psf.pixel_um != BRIGHTER_FATTER_PIXEL * 1e6:
        raise ConfigError(
            f"psf.pixel_um = {config.psf.pixel_um:g}: expected {BRIGHTER_FATTER_PIXEL * 1e6:g}, whose boundaries"
            f" sensor.brighter_fatter = {config.sensor.brighter_fatter} moves"
        )
    _check_reconstruction(config, pixel_arcsec)
    _check_catalogue(config.stars)
    _check_star_counts(config)
    _check_focal_plane(config.focal_plane)
    if ENGINES[config.psf.engine].needs_atmosphere and not config.atmosphere.enabled:
        raise ConfigError(f"psf.engine = {config.psf.engine}: expected atmosphere.enabled = true, whose mean it takes")
    if config.psf.engine == StatisticalEngine.name:
        check_exposure(config.atmosphere.exposure_s, key="atmosphere.exposure_s")
    if config.atmosphere.time_step_s > config.atmosphere.exposure_s:
        raise ConfigError(
            f"atmosphere.time_step_s = {config.atmosphere.time_step_s:g}: expected at most the exposure, "
            f"atmosphere.exposure_s = {config.atmosphere.exposure_s:g}"
        )


def _check_wavelengths(config: Configuration, telescope: Telescope) -> None:
    for i, wavelength in enumerate(resolved_value(config.wavelengths_nm)):
        low, high = (1e9 * w for w in telescope.wavelength_range)
        if not low <= wavelength <= high:
            raise ConfigError(
                f"wavelengths_nm[{i}] = {wavelength:g}: expected {low:g} to {high:g}, which {telescope.name} covers"
            )
        low, high = (1e9 * w for w in SILICON_RANGE)
        if config.detector.silicon and not low <= wavelength <= high:
            raise ConfigError(
                f"wavelengths_nm[{i}] = {wavelength:g}: expected {low:g} to {high:g} with detector.silicon = true"
            )
    if not config.wavelengths_nm:
        raise ConfigError("wavelengths_nm = []: expected at least one wavelength in nm")


def _check_reconstruction(config: Configuration, pixel_arcsec: float) -> None:
    fit = config.reconstruction
    if not resolved_value(fit.weight_fwhm_arcsec) >= pixel_arcsec:
        raise ConfigError(
            f"reconstruction.weight_fwhm_arcsec = {fit.weight_fwhm_arcsec:g}: expected at least {pixel_arcsec:.3g}, a"
            f" pixel, and better {WEIGHT_PIXELS * pixel_arcsec:.3g}"
        )
    if fit.model == "focal_plane" and not config.atmosphere.enabled:
        raise ConfigError("reconstruction.model = focal_plane: expected atmosphere.enabled = true, whose mean it takes")
    if fit.turbulence != "exponential" and fit.model != "focal_plane":
        raise ConfigError(f"reconstruction.turbulence = {fit.turbulence}: expected model = focal_plane, whose it is")


def _check_catalogue(stars: StarsConfig) -> None:
    if stars.catalogue is None:
        for key in ("columns", "brightest", "faintest"):
            if getattr(stars, key) not in (None, {}):
                raise ConfigError(f"stars.{key} = {json_text(getattr(stars, key))}: expected stars.catalogue")
    else:
        for key in stars.columns:
            if key not in NAMES:
                raise ConfigError(
                    f"stars.columns.{key} = {json_text(stars.columns[key])}: expected keys of {', '.join(NAMES)}"
                )
        if not resolved_value(stars.brightest) < resolved_value(stars.faintest):
            raise ConfigError(
                f"stars.faintest = {stars.faintest:g}: expected more than stars.brightest = {stars.brightest:g}"
            )


def _check_star_counts(config: Configuration) -> None:
    fit, stars, recipe = config.reconstruction, config.stars, config.reconstruction.psf_recipe()
    for kind in ("truth",) if stars.catalogue else ("observed", "truth"):
        count = getattr(stars, kind)
        # The noise-free PSFs are always described by principal components.
        components = noise_free_components(config) if kind == "truth" else fit.components
        if components is not None and components > count - 1 and (kind == "truth" or recipe.basis.ordered):
            raise ConfigError(
                f"reconstruction.components = {components}: expected at most {count - 1}, one less than "
                f"stars.{kind} = {count}"
            )
        key = "order" if kind == "observed" else "truth_order"
        terms = term_count(getattr(fit, key))
        if terms > count and (kind == "truth" or not recipe.interpolation.needs_noise):
            raise ConfigError(
                f"reconstruction.{key} = {getattr(fit, key)}: its {terms} terms need as many stars, "
                f"stars.{kind} = {count}"
            )


def _check_focal_plane(plane: FocalPlaneConfig) -> None:
    if plane.budget == "flat" and plane.sizes:
        raise ConfigError(
            "focal_plane.budget = flat: expected simulated or specification where sizes of its terms are given"
        )
    if plane.heights is not None and plane.changed:
        key = plane.changed[0]
        value = plane.model_dump(by_alias=True)[key]
        raise ConfigError(
            f"focal_plane.{key} = {json_text(value)}: expected no budget with measured heights, "
            f"focal_plane.heights = {plane.heights}"
        )
