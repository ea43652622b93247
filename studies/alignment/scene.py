"""The constants of a loop: telescope, degrees of freedom, sensors, turbulence, tolerances."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ...core.errors import ConfigError, error_context
from ...design.optimize.sensitivity import sensitivity
from ...models.io.prescription import ENDINGS, load_telescope, prescription_digest
from ...models.parameters.degrees_of_freedom import DegreesOfFreedom
from ...models.parameters.degrees_of_freedom_file import load_degrees_of_freedom
from ...models.telescope import Telescope
from ...sensing.degrees import silent_names
from ...wavefront.atmosphere.atmosphere import Atmosphere
from ...wavefront.atmosphere.mean_wavefront import mean_wavefront_covariance
from ...wavefront.atmosphere.screen_sampling import ScreenSampling
from ...wavefront.corner_stars import CornerStars, corner_stars
from ...wavefront.request import wavelength_points
from .config import AlignConfig, Heights
from .field_quality import FieldQuality

#: Noll indices of the wavefront of a donut: bending modes reach Z23, and what is not fitted moves what is.
NOLL = np.arange(4, 29)


@dataclass(frozen=True, eq=False)
class AlignmentScene:
    """Telescope, sensors and turbulence of a loop."""

    config: AlignConfig
    telescope: Telescope
    freedoms: DegreesOfFreedom
    freedoms_source: str  #: their bundled name, or the path of their file
    wavelengths: np.ndarray  #: [n_wave] m
    atmosphere: Atmosphere
    stars: CornerStars  #: on the sensors as they stand
    believed: CornerStars  #: on the sensors as the fit takes them to stand
    folder: Path | None = None  #: that relative paths in the configuration start from

    @classmethod
    def of(cls, config: AlignConfig, folder: Path | None = None) -> AlignmentScene:
        """Make the models of a configuration; relative paths in it start from the folder.

        Raises
        ------
        PachonError
            If a name does not exist or the models do not fit together: one line with the key.
        """
        with error_context(key="telescope"):
            telescope = load_telescope(_path(config.telescope, folder))
        if telescope.camera != "lsst":
            raise ConfigError(f"telescope = {config.telescope}: expected a model with the LSST's camera")
        with error_context(key="degrees_of_freedom"):
            source = _path(config.degrees_of_freedom, folder)
            freedoms = load_degrees_of_freedom(source)
            freedoms.parameter_matrix(telescope)
        with error_context(key="errors.tolerances"):
            freedoms.vector(config.errors.tolerances)
        nanometres = config.wavelengths_nm
        with error_context(key="wavelengths_nm"):
            waves = wavelength_points(telescope, None if nanometres is None else 1e-9 * np.array(nanometres))
        air, donuts = config.air, config.donuts
        atmosphere = Atmosphere.from_site(
            _path(air.site, folder),
            config.seed,
            r0=air.r0_m,
            outer_scale=air.outer_scale_m,
            exposure=air.exposure_s,
            screens=ScreenSampling(screen_length=max(1300.0, 25.0 * air.exposure_s)),
        )

        def on_sensors(heights: Heights) -> CornerStars:
            return corner_stars(telescope, heights=heights, n=donuts.per_sensor)

        believed = donuts.heights if donuts.believed_heights is None else donuts.believed_heights
        sensors = on_sensors(donuts.heights), on_sensors(believed)
        return cls(config, telescope, freedoms, source, waves, atmosphere, *sensors, folder)

    @cached_property
    def inputs(self) -> dict[str, str]:
        """Hashes of the contents of files that the configuration names, by key: no bundled models."""
        named = {
            "telescope": self.config.telescope,
            "degrees_of_freedom": self.config.degrees_of_freedom,
            "air.site": self.config.air.site,
        }
        files = {key: _path(name, self.folder) for key, name in named.items()}
        return {key: prescription_digest(f) for key, f in files.items() if Path(f).suffix.lower() in ENDINGS}

    @property
    def wavelength(self) -> float:
        """The middle wavelength [m]."""
        return float(self.wavelengths[len(self.wavelengths) // 2])

    @cached_property
    def quality(self) -> FieldQuality:
        """Measure of the telescope over its field."""
        return FieldQuality(self.telescope, self.wavelengths, self.atmosphere)

    @cached_property
    def field_response(self) -> np.ndarray:
        """Wavefront over the field per unit of each degree of freedom [m], shape [n_field * n_zernike, n].

        The root of the sum of squares of a column is an rms over the field.
        """
        fields = self.quality.fields
        matrix = sensitivity(self.telescope, self.freedoms, fields, self.wavelength, n_zernike=28).matrix[:, 3:]
        return np.asarray(matrix.reshape(-1, len(self.freedoms)) / np.sqrt(len(fields)))

    @cached_property
    def tolerances(self) -> np.ndarray:
        """Tolerances, each in its unit, shape [n]."""
        errors = self.config.errors
        rms = np.sqrt((self.field_response**2).sum(axis=0))
        stated = self.freedoms.vector(errors.tolerances)
        silent = [name for name in silent_names(self.freedoms, rms) if name not in errors.tolerances]
        if silent:
            raise ConfigError(
                f"errors.tolerances: expected those of {', '.join(silent)}, which change no wavefront",
                key="errors.tolerances",
            )
        return np.where(stated > 0.0, stated, 1e-9 * errors.tolerance_nm / np.where(stated > 0.0, 1.0, rms))

    @cached_property
    def steps(self) -> np.ndarray:
        """Rms drift of each degree of freedom from visit to visit [tolerances], shape [n]."""
        errors = self.config.errors
        warm = np.array([name.endswith("_dz") or "_B" in name for name in self.freedoms.names])
        return np.hypot(errors.gravity, errors.thermal * warm)

    @cached_property
    def sensitivity(self) -> np.ndarray:
        """Zernikes of the donuts by the state [m per tolerance], shape [n_star * n_noll, n]."""
        last = int(NOLL[-1])
        response = sensitivity(self.telescope, self.freedoms, self.stars.fields, self.wavelength, n_zernike=last)
        return np.asarray((response.matrix[:, NOLL - 1] * self.tolerances).reshape(-1, len(self.freedoms)))

    @cached_property
    def turbulence(self) -> np.ndarray:
        """Covariance of the Zernikes that turbulence leaves in the mean of an exposure [m^2], [n_data, n_data]."""
        size = len(self.stars) * len(NOLL)
        if not self.config.air.wavefront:
            return np.zeros((size, size))
        pupil = self.telescope.pupil_diameter, self.telescope.pupil_obscuration
        covariance = mean_wavefront_covariance(self.atmosphere, np.tan(self.stars.fields), NOLL, *pupil)
        return covariance.reshape(size, size)

    def expected_wavefront(self, covariance: np.ndarray) -> float:
        """Return the rms over the field [m] of the wavefront of states of a covariance [tolerances^2]."""
        response = self.field_response * self.tolerances
        return float(np.sqrt(np.einsum("dn,nm,dm->", response, covariance, response)))


def _path(name: str, folder: Path | None) -> str:
    """Return a bundled name as it is, and the path of a file as an absolute one."""
    return str(((folder or Path()) / name).resolve()) if Path(name).suffix.lower() in (".yaml", ".yml") else name
