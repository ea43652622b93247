"""Scene of the metrics: telescope, focal plane, atmosphere, places, and quantities that several metrics share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from ...core.errors import ConfigError, DomainError, unknown_name
from ...core.schema import Positive, Real, Section
from ...design.metrics.distortion import Distortion, distortion
from ...measure.adaptive_moments import AdaptiveMoments, adaptive_moments
from ...measure.correlation import Correlation, SeparationBins, shear_correlation
from ...measure.shapes import Shapes, measure_shapes
from ...models.telescope import Telescope
from ...pipeline.experiment import Experiment
from ...pipeline.simulate.ccd_exposure import NoiseFreeStars, expose_positions, holdout_positions
from ...pipeline.summary import bins_up_to
from ...reconstruction.ccd_product import to_detector_axes
from ...wavefront.request import Request, field_points, wavelength_points

#: Fields of a plan, in units of the field's radius: not symmetric under any symmetry of a telescope.
_FIELDS = ((0.0, 0.0), (0.0, 0.5), (0.7, 0.0), (-0.5, 0.6), (0.0, 1.0))
#: Points of the pupil: place between inner and outer rim, and angle [deg].
_PUPIL = ((0.95, 20.0), (0.6, 140.0), (0.9, 260.0), (0.1, 340.0))
#: Number of CCDs of a plan, evenly through the camera.
_CCDS = 5
# Change of a path by rounding, over the length of the path.
_ROUNDING = 1e-13


class Plan(Section):
    """Places at which metrics of optics and camera are taken."""

    fields_deg: Annotated[tuple[tuple[Real, Real], ...], Field(min_length=1)] = Field(
        description="field angles (zemax projection) [deg]"
    )
    wavelengths_nm: Annotated[tuple[Positive, ...], Field(min_length=1)] = Field(
        description="wavelengths [nm]; monochromatic metrics take the middle one"
    )
    pupil: tuple[tuple[Real, Real], ...] = Field(description="points of the entrance pupil, in units of its radius")
    ccds: tuple[str, ...] = Field((), description="CCDs at whose centres the PSF is taken; the first is modelled")


def make_plan(
    telescope: Telescope,
    experiment: Experiment | None,
    fields: np.ndarray | None = None,
    wavelengths: Sequence[float] | None = None,
    ccds: Sequence[str] | None = None,
    pupil: Sequence[tuple[float, float]] | None = None,
) -> Plan:
    """Return a plan with its defaults; arguments are those of :func:`~pachon.studies.baseline.baseline.make_baseline`.

    A ConfigError says that CCDs need a configuration, for the focal plane that they lie in.
    """
    angles = field_points(telescope, np.array(_FIELDS) * telescope.field_radius if fields is None else fields)
    if wavelengths is None:
        wavelengths = sorted({*(telescope.band or ()), telescope.default_wavelength})
    wavelengths = wavelength_points(telescope, wavelengths).tolist()
    if pupil is None:
        inner = telescope.pupil_obscuration
        pupil = [
            ((inner + (1 - inner) * u) * np.cos(a), (inner + (1 - inner) * u) * np.sin(a))
            for u, a in ((u, np.deg2rad(degrees)) for u, degrees in _PUPIL)
        ]
    names: Sequence[str] = ()
    if experiment is not None:
        camera_ccds = experiment.camera.ccd_names
        count = min(_CCDS, len(camera_ccds))
        spread = [(2 * k + 1) * len(camera_ccds) // (2 * count) for k in range(count)]
        # The first is modelled: neither in the middle nor where much of the pupil is vignetted.
        names = [camera_ccds[i] for i in (*spread[1:], spread[0])] if ccds is None else ccds
        for name in names:
            if name not in camera_ccds:
                raise unknown_name("CCD", name, camera_ccds)
    elif ccds is not None:
        raise ConfigError("ccds: expected a configuration, for the focal plane that they lie in")
    return Plan(
        fields_deg=_pairs(np.rad2deg(angles), 6),
        wavelengths_nm=tuple(round(float(w) * 1e9, 4) for w in wavelengths),
        pupil=_pairs(pupil, 4),
        ccds=tuple(names),
    )


def _pairs(values: Any, digits: int) -> tuple[tuple[float, float], ...]:
    # Adding zero turns -0.0 into 0.0.
    return tuple((round(float(x), digits) + 0.0, round(float(y), digits) + 0.0) for x, y in values)


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
        axis = Request.of(self.telescope, np.zeros((1, 2)), threads=self.threads, one_wavelength=True)
        path = axis.bundles(axis.wavelength, self.pupil).chief_path
        if not np.isfinite(path).all():
            raise DomainError("no ray reaches the detector on the axis")
        return one_digit(_ROUNDING * float(path[0]))

    @cached_property
    def distortion(self) -> Distortion:
        """Scale and distortion over the field of view at the middle wavelength."""
        return distortion(self.telescope, wavelength=self.middle, threads=self.threads)

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
        return expose_positions(self.camera_experiment, np.concatenate(self.positions), self.threads)

    @cached_property
    def shapes(self) -> Shapes:
        """Shapes of the noise-free stars."""
        return measure_shapes(self.stars.image, self.stars.pixel_scale, self.camera_experiment.weight_fwhm)

    @cached_property
    def adaptive(self) -> AdaptiveMoments:
        """Adaptive moments of the noise-free stars."""
        return adaptive_moments(self.stars.image, self.stars.pixel_scale, threads=self.threads)

    @cached_property
    def correlation(self) -> Correlation:
        """Correlation of the weighted ellipticities of the noise-free stars, over all CCDs."""
        return self._correlation_of(self.shapes.e1, self.shapes.e2)

    @cached_property
    def correlation_g(self) -> Correlation:
        """Correlation of g of the adaptive moments of the noise-free stars, over all CCDs."""
        return self._correlation_of(self.adaptive.g1, self.adaptive.g2)

    @cached_property
    def bins(self) -> SeparationBins:
        """Bins of these correlations, of which only the number depends on the stars."""
        return bins_up_to(float(np.hypot(*np.ptp(self.stars.fields, axis=0))))

    def _correlation_of(self, first: np.ndarray, second: np.ndarray) -> Correlation:
        x, y = to_detector_axes(self.stars.fields.T, self.camera_experiment.rotator)
        return shear_correlation(x, y, first, second, bins=self.bins)


def one_digit(value: float) -> float:
    """Return a value rounded to one significant digit."""
    return float(f"{value:.0e}")
