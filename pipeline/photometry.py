"""Photometry of a configuration: the camera's zero point, sky and noise where it names none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..core.errors import ConfigError, DomainError, error_context
from ..core.units import ARCSEC
from ..design.metrics.vignetting import vignetting
from ..models.camera.camera import Camera
from ..models.camera.photometry import BANDS, Band
from ..models.telescope import Telescope
from ..raytrace.rays import field_direction
from ..wavefront.chief_rays import image_jacobians
from .config import AtmosphereConfig, BandName, PhotometryConfig

#: Keys of the configuration and attributes of a band; pixels are in other units.
_SAME = {
    "zero_point": "zero_point",
    "dark_sky": "dark_sky",
    "extinction": "extinction",
    "read_noise_e": "read_noise",
    "dark_current_e_s": "dark_current",
    "full_well_e": "full_well",
    "gain": "gain",
    "source": "source",
}
#: Rays to the lit part of the pupil on the axis, which is good to 3e-3 behind the vanes of DECam.
_AXIS_RAYS = 4096


def resolved_photometry(
    section: PhotometryConfig, telescope: Telescope, camera: Camera, band: BandName, ends: tuple[float, float]
) -> PhotometryConfig:
    """Return the section with the camera's numbers where there are none; `ends` are those of the light [m]."""
    open_keys = [key for key, value in section.model_dump().items() if value is None]
    values: dict[str, float | str] = {}
    if set(open_keys).intersection(_SAME):
        if not ends[1] > ends[0]:
            ends = camera.photometry.edges(band)
        area = 0.25 * math.pi * telescope.pupil_diameter**2 * (1.0 - telescope.pupil_obscuration**2)
        with error_context(key="band"):
            camera_band = camera.photometry.band(camera.name, band, area, ends)
        values = {key: getattr(camera_band, name) for key, name in _SAME.items()}
    if "pixel_arcsec" in open_keys:
        # To a thousandth, as cameras state it: 0.2 for the LSST; smaller ones to three digits.
        pixel_arcsec = pixel_angle(telescope, camera.pixel_size) / ARCSEC
        values["pixel_arcsec"] = round(pixel_arcsec, max(3, 2 - math.floor(math.log10(pixel_arcsec))))
    return section.model_copy(update={key: values[key] for key in open_keys})


def airmass_of(air: AtmosphereConfig) -> float:
    """Return the secant of the zenith angle."""
    return 1.0 / math.cos(math.radians(air.zenith_angle_deg))


def band_of(name: BandName, section: PhotometryConfig, airmass: float = 1.0) -> Band:
    """Return the band of a resolved section at an airmass; ConfigError where it is not resolved."""
    values = {attribute: getattr(section, key) for key, attribute in _SAME.items()}
    if section.pixel_arcsec is None or None in values.values():
        raise ConfigError("the configuration is not resolved")
    band = replace(BANDS[name], pixel_scale=section.pixel_arcsec * ARCSEC, **values)
    return band.at_airmass(airmass)


def pixel_angle(telescope: Telescope, pixel_size: float) -> float:
    """Return the angle of a pixel [m] in the middle of the field [rad]."""
    axis = field_direction([0.0], [0.0])
    jacobian = image_jacobians(telescope, axis, telescope.default_wavelength)[0]
    return pixel_size / math.sqrt(abs(float(np.linalg.det(jacobian))))


def lit_fraction_on_axis(telescope: Telescope, wavelength: float, threads: int | None = None) -> float:
    """Return the part of the entrance pupil [m of wavelength] that is lit on the axis, 1 where none is.

    Zero points are measured there, behind the vanes and rims that take light from all stars alike.
    """
    try:
        return vignetting(telescope, [[0.0, 0.0]], wavelength, n_pupil=_AXIS_RAYS, threads=threads).axis_fraction
    except DomainError:  # an off-axis field, which the axis is no part of
        return 1.0
