"""Metrics of the optics: wavefront, landing points, spots, encircled energy, distortion and vignetting."""

from __future__ import annotations

import numpy as np

from ...core.errors import DomainError
from ...design.images.diffraction import fft_psf
from ...design.images.encircled_energy import encircled_energy
from ...design.metrics.field_zernikes import wavefront_zernikes
from ...design.metrics.spots import spots
from ...design.metrics.vignetting import vignetting
from ...wavefront.opd import wavefront_opd
from ...wavefront.request import Request
from .metric import Metric, MetricTable
from .scene import Scene, one_digit

#: Metrics of a telescope alone.
OPTICS: MetricTable[Scene] = MetricTable()
#: Highest Zernike term, Noll.
_HIGHEST = 15
#: Pixels on a side of the images for the encircled energy. An adaptive number would grow with the spots of a faulty
#: telescope, to minutes of computing.
_EE_PIXELS = 96
#: Points across the pupil for the encircled energy, fixed for the same reason.
_EE_POINTS = 256
#: Rays of each field for vignetting.
_VIGNETTING_RAYS = 4096
#: Slope over which the scale on the axis is taken [rad].
_AXIS_SLOPE = 1e-4


@OPTICS.group("opd", Metric("opd", "nm", "path"))
def opd(scene: Scene) -> dict[str, float]:
    """Return the optical path difference of each field, wavelength and pupil point."""
    metrics = {}
    for field, place in zip(scene.fields, scene.plan.fields_deg, strict=True):
        for wavelength, nm in zip(scene.wavelengths, scene.plan.wavelengths_nm, strict=True):
            opd = wavefront_opd(scene.telescope, tuple(field), wavelength, tuple(scene.pupil.T), threads=scene.threads)
            for value, point in zip(opd.value, scene.plan.pupil, strict=True):
                metrics[f"opd {nm:g} nm field {_pair_text(place)} pupil {_pair_text(point)}"] = float(value) * 1e9
    return metrics


@OPTICS.group("landing", Metric("landing", "mm", "path"))
def landing(scene: Scene) -> dict[str, float]:
    """Return where rays of the middle wavelength land; pupil point (0, 0) is the chief ray."""
    request = Request.of(scene.telescope, scene.fields, scene.middle, threads=scene.threads)
    bundles = request.bundles(scene.middle, scene.pupil)
    points = np.concatenate([bundles.chief_landing()[:, None], bundles.landing()], axis=1) * 1e3
    return {
        f"landing {axis} field {_pair_text(place)} pupil {_pair_text(point)}": float(value)
        for rays, place in zip(points, scene.plan.fields_deg, strict=True)
        for ray, point in zip(rays, ((0.0, 0.0), *scene.plan.pupil), strict=True)
        for axis, value in zip("xy", ray, strict=True)
    }


@OPTICS.group("zernike", Metric("zernike", "nm", "path"))
def zernike(scene: Scene) -> dict[str, float]:
    """Return annular Zernike terms (Noll) at the middle wavelength of each field where enough of the pupil is lit.

    DomainError, the reason at the last field, if none is.
    """
    metrics: dict[str, float] = {}
    missed: DomainError | None = None
    for field, place in zip(scene.fields, scene.plan.fields_deg, strict=True):
        try:
            fit = wavefront_zernikes(scene.telescope, field[None], scene.middle, jmax=_HIGHEST, threads=scene.threads)
        except DomainError as error:
            missed = error
            continue
        row = fit.coefficients[0]
        metrics |= {f"zernike Z{j} field {_pair_text(place)}": float(row[j - 1]) * 1e9 for j in range(4, _HIGHEST + 1)}
    if missed is not None and not metrics:
        raise missed
    return metrics


@OPTICS.group("spot", Metric("spot", "um", "path"))
def spot(scene: Scene) -> dict[str, float]:
    """Return the rms spot radius of each field and wavelength."""
    metrics = {}
    for wavelength, nm in zip(scene.wavelengths, scene.plan.wavelengths_nm, strict=True):
        radii = spots(scene.telescope, scene.fields, wavelength, threads=scene.threads).rms_radius * 1e6
        for value, place in zip(radii, scene.plan.fields_deg, strict=True):
            metrics[f"spot rms {nm:g} nm field {_pair_text(place)}"] = float(value)
    return metrics


@OPTICS.group("ee80", Metric("ee80", "um", "curve", lambda _, value: one_digit(1e-7 * value)))
def ee80(scene: Scene) -> dict[str, float]:
    """Return the radius of 80 % of the diffraction image's light at the middle wavelength."""
    images = fft_psf(
        scene.telescope, scene.fields, scene.middle, pixels=_EE_PIXELS, n_pupil=_EE_POINTS, threads=scene.threads
    )
    radii = encircled_energy(images).radius_holding(0.8) * 1e6
    return {f"ee80 field {_pair_text(p)}": float(v) for v, p in zip(radii, scene.plan.fields_deg, strict=True)}


@OPTICS.group(
    "distortion",
    Metric("distortion focal", "m", "path", lambda s, _: one_digit(s.length_tolerance / s.telescope.field_radius)),
    Metric("distortion axis focal length", "m", "path", lambda s, _: one_digit(s.length_tolerance / _AXIS_SLOPE)),
    Metric(
        "distortion largest percent of axis scale",
        "percent",
        "path",
        lambda s, _: one_digit(100.0 * (s.length_tolerance / _AXIS_SLOPE) / s.distortion.axis_focal_length),
    ),
    Metric("distortion rms shift", "um", "path"),
)
def distortion(scene: Scene) -> dict[str, float]:
    """Return scale and distortion of the chief rays over the field of view."""
    field_distortion = scene.distortion
    return {
        "distortion focal length": field_distortion.focal_length,
        "distortion axis focal length": field_distortion.axis_focal_length,
        "distortion largest percent of axis scale": float(
            np.nanmax(np.abs(field_distortion.percent_of_axis_scale), initial=0.0)
        ),
        "distortion rms shift": field_distortion.rms_shift * 1e6,
    }


@OPTICS.group("vignetting", Metric("vignetting lit fraction", "", "edge", one_digit(1.5 / _VIGNETTING_RAYS)))
def lit_fraction(scene: Scene) -> dict[str, float]:
    """Return the fraction of the pupil that lights the detector at the middle wavelength."""
    pupil_vignetting = vignetting(
        scene.telescope, scene.fields, scene.middle, n_pupil=_VIGNETTING_RAYS, threads=scene.threads
    )
    return {
        f"vignetting lit fraction field {_pair_text(place)}": float(value)
        for value, place in zip(pupil_vignetting.lit_fraction, scene.plan.fields_deg, strict=True)
    }


def _pair_text(values: tuple[float, float]) -> str:
    return f"({values[0]:g}, {values[1]:g})"
