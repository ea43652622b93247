"""Dispersion by the air of a configuration, and the corrector that takes it out."""

from __future__ import annotations

import math

import numpy as np

from ..core.errors import PrescriptionError
from ..models.site import Site
from ..models.telescope import Telescope
from ..raytrace.rays import field_direction
from ..wavefront.atmosphere.refraction import dispersion_shift
from ..wavefront.chief_rays import chief_rays
from .config import Configuration

#: Largest shift of a corrector over the diameter of the pupil.
_LARGEST = 0.05
#: Shift by which the effect of a corrector is measured [m]; it is linear in it.
_STEP = 1e-3


def zenith_direction(config: Configuration) -> float:
    """Return the direction of the zenith on the sky, from +x towards +y of the telescope [rad]."""
    zenith = config.atmosphere.zenith_position_angle_deg
    if zenith is None:
        return 0.0
    roll = 0.0 if config.pointing is None else config.pointing.position_angle_deg
    return math.radians(90.0 + roll - zenith)


def air_dispersion(config: Configuration, site: Site) -> np.ndarray | None:
    """Return the shift in field angle of each wavelength [rad], shape [n_wave, 2]; None without an atmosphere."""
    if not config.atmosphere.enabled:
        return None
    wavelengths = np.array(config.wavelengths_nm) * 1e-9
    return dispersion_shift(
        wavelengths,
        float(wavelengths[len(wavelengths) // 2]),
        math.radians(config.atmosphere.zenith_angle_deg),
        zenith_direction(config),
        site.weather,
    )


def with_dispersion_corrected(telescope: Telescope, config: Configuration, site: Site) -> Telescope:
    """Return a telescope whose corrector brings the outermost wavelengths together on the axis; others as they are."""
    name, shifts = telescope.dispersion_corrector, air_dispersion(config, site)
    if name is None or shifts is None or not shifts.any():
        return telescope
    wavelengths = np.array(config.wavelengths_nm) * 1e-9
    ends = int(np.argmin(wavelengths)), int(np.argmax(wavelengths))

    def separation(moved: Telescope) -> np.ndarray:
        """Return the landing point of the shortest wavelength less that of the longest [m]."""
        short, long = (
            chief_rays(moved, field_direction(*shifts[i : i + 1].T), float(wavelengths[i])).position[0] for i in ends
        )
        return np.asarray(short - long)

    direction = zenith_direction(config)
    along = np.array([math.cos(direction), math.sin(direction), 0.0])
    at_rest = separation(telescope)
    by_shift = (separation(telescope.perturbed(name, shift=_STEP * along)) - at_rest) / _STEP
    square = float(by_shift @ by_shift)
    shift = -float(at_rest @ by_shift) / square if square else math.inf
    if abs(shift) > _LARGEST * telescope.pupil_diameter:
        raise PrescriptionError(
            f"dispersion_corrector = {name}: a shift of {abs(shift):.3g} m would take out the dispersion at"
            f" {config.atmosphere.zenith_angle_deg:g} deg from the zenith: expected lenses that disperse more"
        )
    return telescope.perturbed(name, shift=shift * along)
