"""Values of a resolved configuration, and quantities that follow from it alone."""

from __future__ import annotations

from typing import TypeVar

from ..core.errors import ConfigError
from ..reconstruction.psf_model.basis import COMPONENTS
from .config import Configuration

_T = TypeVar("_T")


def resolved_value(value: _T | None) -> _T:
    """Return a value that a resolved configuration always has."""
    if value is None:
        raise ConfigError("the configuration is not resolved")
    return value


def noise_free_components(config: Configuration) -> int:
    """Return how many principal components describe the noise-free PSFs of a resolved configuration."""
    components = config.reconstruction.components
    return min(COMPONENTS, config.stars.truth - 1) if components is None else components


def least_star_count(config: Configuration) -> int:
    """Return how many observed stars the PSF model of a resolved configuration needs on a CCD."""
    recipe = config.reconstruction.psf_recipe()
    return max(recipe.basis.least_stars, recipe.interpolation.least_stars)


def require_drawn_stars(config: Configuration) -> None:
    """Raise ConfigError if a configuration has a catalogue of stars, where stars must be drawn."""
    if config.stars.catalogue is not None:
        raise ConfigError(f"stars.catalogue = {config.stars.catalogue}: expected none, these stars are drawn")
