"""Metrics of a telescope without a camera: spots, wavefront, encircled energy, modulation transfer, throughput.

Means over the fields have the weights that the design data state, where the fields are those of the design.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...design.images.diffraction import fft_psf
from ...design.images.encircled_energy import encircled_energy
from ...design.images.mtf import mtf
from ...design.metrics.spots import spot_diagram
from ...design.metrics.vignetting import vignetting
from ...design.optimize.merit import Beams, WavefrontMerit
from ...models.telescope import Telescope
from ...wavefront.request import Request
from .metric import THROUGHPUT, Metric, MetricTable

#: Metrics of a telescope without a camera.
TELESCOPE_METRICS: MetricTable[TelescopeScene] = MetricTable()
#: Rings of pupil points for spots and wavefront.
_RINGS = 6
#: Pixels on a side of the images for the encircled energy.
_PIXELS = 96
#: Points across the pupil for the encircled energy.
_ACROSS = 256
#: Rays of each field for the throughput.
_RAYS = 4096
#: Fraction of the light within the radius of encircled energy.
_ENERGY = 0.8
#: Contrast at the frequency of the modulation transfer.
_CONTRAST = 0.5


@dataclass(frozen=True)
class TelescopeScene:
    """A telescope with field points [rad] and wavelengths [m]; None stands for its own."""

    telescope: Telescope
    fields: np.ndarray | None = None
    wavelengths: np.ndarray | None = None
    threads: int | None = None

    @property
    def request(self) -> Request:
        """Rays of all fields and wavelengths."""
        return Request.of(self.telescope, self.fields, self.wavelengths, n_pupil=_RINGS, threads=self.threads)


@TELESCOPE_METRICS.group(
    "spots",
    Metric("spot_rms_um", "um", meaning="rms spot radius about the centroid, rms over the fields with their weights"),
    Metric("spot_worst_um", "um", meaning="rms spot radius about the centroid, largest of the fields"),
)
def spots(scene: TelescopeScene) -> dict[str, float]:
    """Return the rms spot radius over the fields, and the largest."""
    request = scene.request
    radii = spot_diagram(request).rms_radius * 1e6
    return {"spot_rms_um": float(np.sqrt(request.field_weights @ radii**2)), "spot_worst_um": float(radii.max())}


@TELESCOPE_METRICS.group(
    "wavefront",
    Metric("wavefront_rms_nm", "nm", meaning="rms wavefront without piston and tilt, over fields and wavelengths"),
)
def wavefront(scene: TelescopeScene) -> dict[str, float]:
    """Return the rms wavefront without piston and tilt, over fields and wavelengths."""
    beams = Beams.of(scene.telescope, scene.fields, scene.wavelengths, n_pupil=_RINGS, threads=scene.threads)
    residuals = WavefrontMerit(scene.telescope, beams).residuals(scene.telescope)
    return {"wavefront_rms_nm": float(np.linalg.norm(residuals)) * 1e9}


@TELESCOPE_METRICS.group(
    "ee80",
    Metric(
        "ee80_um", "um", meaning="radius of 80 % of the light with diffraction, middle wavelength, mean of the fields"
    ),
    Metric("ee80_worst_um", "um", meaning="radius of 80 % of the light with diffraction, largest of the fields"),
)
def ee80(scene: TelescopeScene) -> dict[str, float]:
    """Return the radius of 80 % of the light with diffraction at the middle wavelength, mean and largest."""
    images = fft_psf(
        scene.telescope, scene.fields, scene.request.middle, pixels=_PIXELS, n_pupil=_ACROSS, threads=scene.threads
    )
    energy = encircled_energy(images)
    radii = energy.radius_holding(_ENERGY) * 1e6
    return {"ee80_um": float(scene.request.field_weights @ radii), "ee80_worst_um": float(radii.max())}


@TELESCOPE_METRICS.group(
    "mtf",
    Metric("mtf50_per_mm", "1/mm", meaning="frequency of contrast 0.5, mean over fields, tangential and sagittal"),
    Metric("mtf50_worst_per_mm", "1/mm", meaning="frequency of contrast 0.5, least of fields and directions"),
)
def transfer(scene: TelescopeScene) -> dict[str, float]:
    """Return the frequency at which the contrast falls to a half, mean and least over fields and two directions."""
    frequencies = (
        mtf(scene.telescope, scene.fields, scene.wavelengths, threads=scene.threads).frequency_at(_CONTRAST) * 1e-3
    )
    mean = float(scene.request.field_weights @ frequencies.reshape(len(frequencies), -1).mean(axis=1))
    return {"mtf50_per_mm": mean, "mtf50_worst_per_mm": float(frequencies.min())}


@TELESCOPE_METRICS.group("throughput", *THROUGHPUT)
def throughput(scene: TelescopeScene) -> dict[str, float]:
    """Return mean and minimum of the lit fraction of the pupil over the fields."""
    request = scene.request
    lit = vignetting(scene.telescope, request.fields, request.middle, n_pupil=_RAYS, threads=scene.threads).lit_fraction
    return {"throughput_mean": float(request.field_weights @ lit), "throughput_min": float(lit.min())}
