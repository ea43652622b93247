"""Galaxies of a configuration: a population, those of a catalogue, or stamps of a mosaic."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.errors import error_context
from ..core.units import ARCMIN, ARCSEC
from ..sky.catalogue import read_galaxies
from ..sky.cells import Region
from ..sky.galaxies import Galaxies
from ..sky.mosaic import GalaxyStamps, PlantedGalaxies, StampPopulation
from ..sky.population import GalaxyPopulation, counts
from .config import GalaxySourceConfig
from .draw import SIZES
from .exposure import Exposure
from .scene import REACH, check_density

#: Galaxies with xi and eta in two ranges [rad].
SkyGalaxies = Callable[[Any, Any], Galaxies | PlantedGalaxies]
#: Limits of the bins over which the light of a population is summed.
_MAGNITUDES = 200


@dataclass(frozen=True, eq=False)
class GalaxySource:
    """Galaxies of a configuration, its file read.

    Attributes
    ----------
    config : GalaxySourceConfig
        The configuration.
    exposure : Exposure
        Sky and pixels of the images: light of galaxies above that of the sky is refused.
    seed : int
        Seed of places, angles and galaxies.
    given : Galaxies, StampPopulation or None
        Those of the catalogue or of the mosaic; None for a random population.
    """

    config: GalaxySourceConfig
    exposure: Exposure
    seed: int
    given: Galaxies | StampPopulation | None

    @classmethod
    def read(
        cls, config: GalaxySourceConfig, exposure: Exposure, *, pointing: tuple[float, float] | None, seed: int
    ) -> GalaxySource:
        """Read the catalogue or the mosaic, where there is one.

        Parameters
        ----------
        config : GalaxySourceConfig
            The configuration.
        exposure : Exposure
            Sky and pixels of the images.
        pointing : (float, float) or None
            Right ascension and declination of the pointing [rad], for a catalogue that has them.
        seed : int
            Seed of places, angles and galaxies.

        Raises
        ------
        ProductError
            If a file cannot be read, a catalogue lacks a column, or a mosaic coordinates, zero point or objects.
        DomainError
            If a value is none of a galaxy, or galaxies would cover the sky or be brighter than it.
        """
        if config.catalogue is not None:
            galaxies = read_galaxies(
                config.catalogue, pointing=pointing, convention=config.convention, band=exposure.band
            )
            return cls(config, exposure, seed, galaxies)
        if config.mosaic is None:
            return cls(config, exposure, seed, None)
        stamps = GalaxyStamps.from_mosaic(
            config.mosaic,
            zero_point=config.mosaic_zero_point,
            psf_radius=None if config.mosaic_psf_arcsec is None else config.mosaic_psf_arcsec * ARCSEC,
            finest_pixel=exposure.pixel_scale,
            seed=seed,
        )
        with error_context(key="galaxies"):
            planted = config.density * stamps.surface_density
            mean = planted * exposure.pixel_scale**2 * float(exposure.electrons(stamps.magnitude).mean())
            check_density(mean, exposure, f"density = {config.density:g}: ")
            return cls(config, exposure, seed, stamps.population(seed, density=planted * ARCMIN**2))

    def down_to(self, faintest: float) -> SkyGalaxies:
        """Return the function that gives galaxies in ranges of xi and eta, down to an AB magnitude.

        Raises
        ------
        DomainError
            If the galaxies of a population would be brighter than the sky.
        """
        return self._population(faintest).galaxies_in if self.given is None else _FixedGalaxies(self.given, faintest)

    def _population(self, faintest: float) -> GalaxyPopulation:
        settings, exposure = self.config, self.exposure
        with error_context(key="galaxies"):
            population = GalaxyPopulation(faintest, self.seed, settings.brightest, settings.density)
            magnitude = np.linspace(settings.brightest, faintest, _MAGNITUDES)
            number = settings.density * np.diff(counts(magnitude)) * (exposure.pixel_scale / ARCMIN) ** 2
            light = number * exposure.electrons(0.5 * (magnitude[:-1] + magnitude[1:]))
            check_density(float(light.sum()), exposure, f"density = {settings.density:g}: ")
        return population


@dataclass(frozen=True, eq=False)
class _FixedGalaxies:
    """Galaxies of a catalogue or mosaic in ranges of xi and eta [rad]; a class, so that workers can unpickle it."""

    galaxies: Galaxies | StampPopulation
    faintest: float

    @property
    def reach(self) -> int:
        """Distance that their light reaches at most [pixel]."""
        return SIZES[-1] // 2 if isinstance(self.galaxies, Galaxies) else REACH

    def __call__(self, xi: Any, eta: Any) -> Galaxies | PlantedGalaxies:
        """Return those in two ranges that are no fainter than the limit."""
        fixed_galaxies = self.galaxies
        galaxies_in_area: Galaxies | PlantedGalaxies
        if isinstance(fixed_galaxies, Galaxies):
            galaxies_in_area = fixed_galaxies.take(
                np.flatnonzero(Region.between(xi, eta).contains(fixed_galaxies.xi, fixed_galaxies.eta))
            )
        else:
            galaxies_in_area = fixed_galaxies.galaxies_in(xi, eta)
        return galaxies_in_area.take(np.flatnonzero(galaxies_in_area.magnitude <= self.faintest))
