"""Length of the phase screens that the field of view and the wind cross during an exposure."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy.fft

from ...core.errors import ConfigError, DomainError
from ...models.camera.camera import Camera
from ...models.site import Site
from ...models.telescope import Telescope
from ...wavefront.atmosphere.layers import line_of_sight
from ...wavefront.chief_rays import fields_at
from ...wavefront.psf.engines import ENGINES
from ...wavefront.psf.fast import LEAST_SAMPLES, largest_screen_length, least_screen_size
from ..config import Configuration


def swept_lengths(config: Configuration, telescope: Telescope, camera: Camera, site: Site) -> np.ndarray:
    """Return the length of each layer crossed by the light to the chosen CCDs during the exposure [m], [n_layer].

    Sum of the drift by the wind, in any direction, and of the extent of field of view and pupil along x or y at the
    distance of the layer.
    """
    air = config.atmosphere
    slopes = np.tan(corner_fields(telescope, camera, config.ccds or ()))
    distances = line_of_sight(np.array(site.altitudes), air.ground_lift_m, math.radians(air.zenith_angle_deg))
    wind = np.array(site.wind_speeds) * air.exposure_s
    return wind + distances * np.ptp(slopes, axis=0).max() + telescope.pupil_diameter


def corner_fields(telescope: Telescope, camera: Camera, names: Sequence[str]) -> np.ndarray:
    """Return the field angles of the corners of CCDs [rad], [n, 2]; ConfigError names those beyond the field."""

    def fields(some: Sequence[str]) -> np.ndarray:
        angles = fields_at(telescope, camera.corners(camera.ccd_index(name) for name in some).reshape(-1, 2))
        telescope.check_field(*angles.T)
        return angles

    try:
        return fields(names)
    except DomainError:
        beyond = []
        for name in names:
            try:
                fields([name])
            except DomainError:
                beyond.append(name)
        listed = ", ".join(beyond[:6]) + (f" and {len(beyond) - 6} more" if len(beyond) > 6 else "")
        raise ConfigError(
            f"ccds: {listed or 'those chosen'} of {camera.name} reach beyond the field that {telescope.name} covers, "
            f"{math.degrees(telescope.field_limit):g} deg from the axis: expected CCDs within it"
        ) from None


def check_screens(config: Configuration, telescope: Telescope, camera: Camera, site: Site) -> None:
    """Raise ConfigError, with layer and length, if a periodic screen repeats within the light to the chosen CCDs."""
    air = config.atmosphere
    if not air.enabled or not ENGINES[config.psf.engine].screens:
        return
    swept = swept_lengths(config, telescope, camera, site)
    layer = int(np.argmax(swept))
    if swept[layer] <= air.screen_length_m:
        return
    least = math.ceil(swept[layer])
    size = scipy.fft.next_fast_len(math.ceil(air.screen_size * least / air.screen_length_m), real=True)
    raise ConfigError(
        f"atmosphere.exposure_s = {air.exposure_s:g}: the light to the chosen CCDs crosses {least} m of the layer at"
        f" {site.altitudes[layer]:g} m, whose periodic screen comes round after {air.screen_length_m:g} m: expected"
        f" atmosphere.screen_length_m of at least {least} (and atmosphere.screen_size = {size} to keep its pixel), or"
        " psf.engine = statistical, which has no screens"
    )


def check_samples(config: Configuration, telescope: Telescope) -> None:
    """Raise ConfigError if screens are too coarse for the pupil of a telescope."""
    air = config.atmosphere
    if not air.enabled or not ENGINES[config.psf.engine].screens:
        return
    least = least_screen_size(telescope.pupil_diameter, air.screen_length_m)
    if air.screen_size < least:
        longest = largest_screen_length(telescope.pupil_diameter, air.screen_size)
        raise ConfigError(
            f"atmosphere.screen_size = {air.screen_size}: expected at least {least}, "
            f"so that a pupil of {telescope.pupil_diameter:g} m has {LEAST_SAMPLES} samples across, or "
            f"atmosphere.screen_length_m of at most {longest:g}"
        )
