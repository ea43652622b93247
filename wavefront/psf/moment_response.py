"""Response of ellipticity and size of a telescope's images to the second moments of turbulence."""

from __future__ import annotations

import math

import numpy as np

from ..atmosphere.moment_covariance import MomentResponse
from ..atmosphere.turbulence import coherence, diffraction_otf, structure_function
from .engine import PsfInputs
from .image_plane import square_transfer
from .pupil_means import PupilMeans

# Wavenumbers of the response, and the largest in units of one over the weight's rms width.
_WAVENUMBERS = 512
_HIGHEST = 6.0


def moment_response(inputs: PsfInputs, means: PupilMeans, focal_length: float, weight_fwhm: float) -> MomentResponse:
    """Return the response under a weight [rad] of the mean image, with the blur of the optics' aberrations.

    The inputs have an atmosphere, and the means are theirs; the focal length [m] is that of pixels on the sky.
    """
    air, plane, telescope = inputs.atmosphere, inputs.plane, inputs.telescope
    assert air is not None, "the response needs one"
    wavelength = np.asarray(inputs.wavelengths, dtype=np.float64)[:, None]
    weight = weight_fwhm / math.sqrt(8.0 * math.log(2.0))
    k = np.linspace(0.0, _HIGHEST / weight, _WAVENUMBERS)
    baseline = wavelength * k / (2.0 * math.pi)
    diffraction = diffraction_otf(baseline, telescope.pupil_diameter, telescope.pupil_obscuration)
    on_detector = k / focal_length
    pixel = square_transfer(on_detector, 0.0 * k, plane.pixel_size)
    spread = np.exp(-0.5 * (plane.diffusion**2 + plane.jitter**2) * on_detector**2)
    turbulence = coherence(structure_function(baseline, air.r0, air.outer_scale), wavelength)
    mean = (turbulence * diffraction).mean(axis=0)
    spread = spread * np.exp(-0.25 * means.aberration[0] * k**2)
    response = MomentResponse.of(k, mean * pixel * spread, weight)
    return response._replace(
        aberration=means.aberration, lit=means.lit, lit_levels=means.lit_levels, pupils=means.pupils
    )
