"""Scene of the metrics: telescope, focal plane, atmosphere, places, and quantities that several metrics share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...core.errors import ConfigError, DomainError
from ...core.units import ARCMIN
from ...design.metrics.distortion import distortion
from ...models.telescope import Telescope
from ...pipeline.experiment import Experiment
from ...pipeline.measure.correlation import Correlation, shear_correlation
from ...pipeline.measure.shapes import Shapes, measure_shapes
from ...pipeline.measure.summary import SHORTEST_ARCMIN
from ...pipeline.simulate.ccd_exposure import NoiseFreeStars, expose_places, holdout_positions
from ...wavefront.request import Request
from .plan import Plan, make_plan

# Change of a path by rounding, over the length of the path.
_ROUNDING = 1e-13
_CORRELATION_BINS = 15


@dataclass(frozen=True)
class Scene:
    """Telescope, places and stars of which metrics are taken; only metrics of the optics do without an experiment."""

    telescope: Telescope
    experiment: Experiment | None = None  #: focal plane, atmosphere and reconstruction
    given_plan: Plan | None = None  #: places of the metrics of optics and camera; see :attr:`plan`
    threads: int | None = None

    @cached_property
    def plan(self) -> Plan:
        """The given plan, or the default one."""
        return make_plan(self.telescope, self.experiment) if self.given_plan is None else self.given_plan

    @cached_property
    def fields(self) -> np.ndarray:
        """Field angles of the plan [rad], shape [n, 2]."""
        return np.deg2rad(self.plan.fields_deg)

    @cached_property
    def wavelengths(self) -> np.ndarray:
        """Wavelengths of the plan [m], shape [n]."""
        return np.array(self.plan.wavelengths_nm) / 1e9

    @property
    def middle(self) -> float:
        """Middle wavelength of the plan [m], for monochromatic metrics."""
        return float(self.wavelengths[len(self.wavelengths) // 2])

    @cached_property
    def pupil(self) -> np.ndarray:
        """Points of the plan in the entrance pupil [m], shape [n, 2]."""
        return np.array(self.plan.pupil).reshape(-1, 2) * (0.5 * self.telescope.pupil_diameter)

    @cached_property
    def length_tolerance(self) -> float:
        """Change of a path or a landing point by rounding [m]."""
        axis = Request.of(self.telescope, np.zeros((1, 2)), threads=self.threads)
        path = axis.bundles(axis.wavelength, self.pupil).chief_path
        if not np.isfinite(path).all():
            raise DomainError("no ray reaches the detector on the axis")
        return one_digit(_ROUNDING * float(path[0]))

    @cached_property
    def distortion(self) -> dict[str, float]:
        """Scale and distortion over the field of view at the middle wavelength."""
        return distortion(self.telescope, wavelength=self.middle, threads=self.threads).summary()

    @property
    def camera_experiment(self) -> Experiment:
        """The experiment; a ConfigError where the scene has none."""
        if self.experiment is None:
            raise ConfigError("expected a configuration, for its focal plane, atmosphere and reconstruction")
        return self.experiment

    @property
    def ccds(self) -> tuple[str, ...]:
        """Names of the CCDs of the configuration."""
        return self.camera_experiment.config.ccds or ()

    @cached_property
    def positions(self) -> list[np.ndarray]:
        """Detector positions of the noise-free stars of each CCD [m], shape [n, 2]."""
        return [holdout_positions(self.camera_experiment, name) for name in self.ccds]

    @cached_property
    def stars(self) -> NoiseFreeStars:
        """Noise-free stars at :attr:`positions`."""
        return expose_places(self.camera_experiment, np.concatenate(self.positions), self.threads)

    @cached_property
    def shapes(self) -> Shapes:
        """Shapes of the noise-free stars."""
        return measure_shapes(self.stars.image, self.stars.pixel_scale, self.camera_experiment.weight_fwhm)

    @cached_property
    def correlation(self) -> Correlation:
        """Correlation of the ellipticities of the noise-free stars, over all CCDs."""
        fields, shapes = self.stars.fields, self.shapes
        longest = max(float(np.hypot(*np.ptp(fields, axis=0))), 2.0 * SHORTEST_ARCMIN * ARCMIN)
        (x, y), shortest = fields.T, SHORTEST_ARCMIN * ARCMIN
        return shear_correlation(
            x, y, shapes.e1, shapes.e2, min_sep=shortest, max_sep=longest, n_bins=_CORRELATION_BINS
        )


def one_digit(value: float) -> float:
    """Return a value rounded to one significant digit."""
    return float(f"{value:.0e}")
