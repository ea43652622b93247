"""The figures of a baseline: what they are, and how far each may move where nothing has changed.

A tolerance says what another processor, another compiler or another NumPy can do to a figure. None of them allows for
luck: random numbers hang on seeds, and figures that noise decides are taken without it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...core.errors import ConfigError, DomainError, PachonError
from ...design.images.encircled_energy import encircled_energy
from ...design.metrics.distortion import distortion
from ...design.metrics.field_zernikes import wavefront_zernikes
from ...design.metrics.spots import spots
from ...design.metrics.vignetting import vignetting
from ...models.telescope import Telescope
from ...pipeline.experiment import Experiment
from ...pipeline.measure.shapes import fwhm, measure_shapes
from ...pipeline.measure.summary import ccd_figures
from ...pipeline.simulate.ccd_exposure import expose_ccd, expose_places
from ...pipeline.simulate.ccd_model import model_ccd
from ...pipeline.simulate.photometry import ARCSEC
from ...wavefront.bundles import trace_bundles
from ...wavefront.opd import wavefront_opd
from ...wavefront.pupil_optics import fields_at, trace_pupils
from .file import BaselinePlan

#: Highest Zernike term.
_HIGHEST = 15
#: Pixels on a side of the images for the encircled energy, and points across the pupil: left to itself their number
#: would grow with the spots of a telescope that something is wrong with, to minutes of computing.
_EE_PIXELS, _EE_POINTS = 96, 192
#: Rays of each field for vignetting.
_VIGNETTING_RAYS = 4096
#: Where the wavefront's change by the height of a CCD is taken: a ring of the pupil, in units of its radius.
_RING, _RING_POINTS = 0.9, 8
# Path that rounding may move, over the length of the path.
_ROUNDING = 1e-13

#: Why tolerances are what they are.
REASONS = {
    "path": "Float64 path from the sky to the detector, 1e-13 of its length: each surface rounds at 1e-16 of it, and "
    "fused multiply-adds, vector width and the order of sums differ between machines.",
    "curve": "Curve of 300 points over an image of 96 x 96 pixels: sums of 1e5 terms round at 1e-12, on a slope.",
    "edge": "1.5 of 4096 rays: one that grazes an edge may fall to either side by rounding.",
    "height": "Sums of sines of some 10 um in float64 would round at 1e-15 um; 1 pm is what an optical path sees. The "
    "seed is fixed: a NumPy that drew other numbers from it would move heights by micrometres.",
    "image": "Stamps and Fourier sums of the long-exposure engine are float32 (6e-8), thousands of terms each.",
    "model": "Singular vectors of float32 stamps: those of the smallest singular values are theirs to rounding.",
}


class Quantity(NamedTuple):
    """A figure as it is now, and how far another machine may move it."""

    value: float
    unit: str
    tolerance: float
    reason: str


@dataclass(frozen=True)
class Scene:
    """What figures are taken of.

    Attributes
    ----------
    telescope : Telescope
        The telescope.
    plan : BaselinePlan
        Where.
    experiment : Experiment, optional
        Focal plane, atmosphere and reconstruction; without one there are figures of the telescope alone.
    threads : int, optional
        Number of threads; no byte depends on it.
    """

    telescope: Telescope
    plan: BaselinePlan
    experiment: Experiment | None = None
    threads: int | None = None

    @cached_property
    def fields(self) -> np.ndarray:
        """Field angles [rad], shape [n, 2]."""
        return np.deg2rad(self.plan.fields_deg)

    @cached_property
    def wavelengths(self) -> np.ndarray:
        """Wavelengths [m]."""
        return np.array(self.plan.wavelengths_nm) / 1e9

    @property
    def middle(self) -> float:
        """The wavelength of what takes one alone [m]."""
        return float(self.wavelengths[len(self.wavelengths) // 2])

    @cached_property
    def pupil(self) -> np.ndarray:
        """Points of the entrance pupil [m], shape [n, 2]."""
        return np.array(self.plan.pupil).reshape(-1, 2) * (0.5 * self.telescope.pupil_diameter)

    @cached_property
    def length_tolerance(self) -> float:
        """How far rounding may move a path or a landing point [m]."""
        path = trace_bundles(
            self.telescope, np.zeros((1, 2)), self.telescope.default_wavelength, self.pupil, threads=self.threads
        ).chief_path
        if not np.isfinite(path).all():
            raise DomainError("no ray reaches the detector on the axis")
        return _one_digit(_ROUNDING * float(path[0]))

    @property
    def camera_experiment(self) -> Experiment:
        """The experiment, for figures that need one."""
        if self.experiment is None:
            raise ConfigError("expected a configuration, for its focal plane, atmosphere and reconstruction")
        return self.experiment


def _opd(scene: Scene) -> dict[str, Quantity]:
    """Optical path difference of each field, wavelength and point of the pupil, where it is lit."""
    figures = {}
    for field, place in zip(scene.fields, scene.plan.fields_deg, strict=True):
        for wavelength, nm in zip(scene.wavelengths, scene.plan.wavelengths_nm, strict=True):
            opd = wavefront_opd(scene.telescope, tuple(field), wavelength, tuple(scene.pupil.T), threads=scene.threads)
            for value, point in zip(opd.value, scene.plan.pupil, strict=True):
                if np.isfinite(value):
                    name = f"opd {nm:g} nm field {_pair(place)} pupil {_pair(point)}"
                    figures[name] = Quantity(float(value) * 1e9, "nm", scene.length_tolerance * 1e9, "path")
    return figures


def _landing(scene: Scene) -> dict[str, Quantity]:
    """Where rays of the middle wavelength meet the detector; (0, 0) of the pupil is the chief ray."""
    bundles = trace_bundles(scene.telescope, scene.fields, scene.middle, scene.pupil, threads=scene.threads)
    landing = np.concatenate([bundles.chief_landing()[:, None], bundles.landing()], axis=1) * 1e3
    figures = {}
    for rays, place in zip(landing, scene.plan.fields_deg, strict=True):
        for ray, point in zip(rays, ((0.0, 0.0), *scene.plan.pupil), strict=True):
            for axis, value in zip("xy", ray, strict=True):
                if np.isfinite(value):
                    name = f"landing {axis} field {_pair(place)} pupil {_pair(point)}"
                    figures[name] = Quantity(float(value), "mm", scene.length_tolerance * 1e3, "path")
    return figures


def _zernike(scene: Scene) -> dict[str, Quantity]:
    """Annular Zernike terms of the whole pupil at the middle wavelength, Noll."""
    fit = wavefront_zernikes(scene.telescope, scene.fields, scene.middle, jmax=_HIGHEST, threads=scene.threads)
    return {
        f"zernike Z{j} field {_pair(place)}": Quantity(
            float(row[j - 1]) * 1e9, "nm", scene.length_tolerance * 1e9, "path"
        )
        for row, place in zip(fit.coefficients, scene.plan.fields_deg, strict=True)
        for j in range(4, _HIGHEST + 1)
    }


def _spot(scene: Scene) -> dict[str, Quantity]:
    """Root mean square radius of the spot of each field and wavelength."""
    figures = {}
    for wavelength, nm in zip(scene.wavelengths, scene.plan.wavelengths_nm, strict=True):
        radii = spots(scene.telescope, scene.fields, wavelength, threads=scene.threads).rms_radius * 1e6
        for value, place in zip(radii, scene.plan.fields_deg, strict=True):
            if np.isfinite(value):
                name = f"spot rms {nm:g} nm field {_pair(place)}"
                figures[name] = Quantity(float(value), "um", scene.length_tolerance * 1e6, "path")
    return figures


def _ee80(scene: Scene) -> dict[str, Quantity]:
    """Radius that holds 80 % of the light of the diffraction image at the middle wavelength."""
    energy = encircled_energy(
        scene.telescope,
        scene.fields,
        scene.middle,
        pixels=_EE_PIXELS,
        pupil_points=_EE_POINTS,
        threads=scene.threads,
    )
    return {
        f"ee80 field {_pair(place)}": Quantity(float(value), "um", _one_digit(1e-7 * float(value)), "curve")
        for value, place in zip(energy.radius_holding(0.8) * 1e6, scene.plan.fields_deg, strict=True)
        if np.isfinite(value)
    }


def _distortion(scene: Scene) -> dict[str, Quantity]:
    """Scale and distortion of the chief rays over the field of view, at the middle wavelength."""
    found = distortion(scene.telescope, wavelength=scene.middle, threads=scene.threads).summary()
    # Over slopes of 1e-4 for the scale on the axis, over the field's radius for all of them.
    near, far = scene.length_tolerance / 1e-4, scene.length_tolerance / scene.telescope.field_radius
    percent = _one_digit(100.0 * near / found["axis_focal_length_m"])
    tolerances = {
        "focal_length_m": ("m", _one_digit(far)),
        "axis_focal_length_m": ("m", _one_digit(near)),
        "largest_percent_of_axis_scale": ("percent", percent),
        "rms_shift_um": ("um", scene.length_tolerance * 1e6),
    }
    return {
        f"distortion {name.removesuffix('_' + unit).replace('_', ' ')}": Quantity(found[name], unit, tolerance, "path")
        for name, (unit, tolerance) in tolerances.items()
    }


def _vignetting(scene: Scene) -> dict[str, Quantity]:
    """Part of the pupil that lights the detector at the middle wavelength."""
    found = vignetting(scene.telescope, scene.fields, scene.middle, rays=_VIGNETTING_RAYS, threads=scene.threads)
    return {
        f"vignetting lit fraction field {_pair(place)}": Quantity(
            float(value), "", _one_digit(1.5 / _VIGNETTING_RAYS), "edge"
        )
        for value, place in zip(found.fraction, scene.plan.fields_deg, strict=True)
    }


def _height(scene: Scene) -> dict[str, Quantity]:
    """Height of every CCD at its centre, positive along +z of the telescope frame."""
    plane = scene.camera_experiment.focal_plane
    heights = plane.height(*plane.camera.centers.T) * 1e6
    return {
        f"height {name}": Quantity(float(value), "um", 1e-6, "height")
        for name, value in zip(plane.names, heights, strict=True)
    }


def _defocus(scene: Scene) -> dict[str, Quantity]:
    """How the height of every CCD changes the optical path difference, mean over a ring of the pupil."""
    plane = scene.camera_experiment.focal_plane
    angle = np.arange(_RING_POINTS) * (2.0 * np.pi / _RING_POINTS)
    ring = 0.5 * _RING * scene.telescope.pupil_diameter * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    fields = fields_at(scene.telescope, plane.camera.centers, scene.middle, threads=scene.threads)
    seen, flat = (
        trace_pupils(scene.telescope, fields, scene.middle, ring, p, threads=scene.threads).path[:, 0].mean(axis=1)
        for p in (plane, None)
    )
    return {
        f"defocus {name}": Quantity(float(value), "nm", scene.length_tolerance * 1e9, "path")
        for name, value in zip(plane.names, (flat - seen) * 1e9, strict=True)
        if np.isfinite(value)
    }


def _psf(scene: Scene) -> dict[str, Quantity]:
    """Width and ellipticity of the PSF at the centres of some CCDs."""
    experiment = scene.camera_experiment
    camera = experiment.camera
    centers = camera.centers[[camera.ccd_index(name) for name in scene.plan.ccds]]
    stars = expose_places(experiment, centers, scene.threads)
    shapes = measure_shapes(stars.image, stars.pixel_scale, experiment.weight_fwhm)
    width = fwhm(stars.image, stars.pixel_scale) / ARCSEC
    figures = {}
    for i, name in enumerate(scene.plan.ccds):
        for what, value, unit, tolerance in (
            ("fwhm", width[i], "arcsec", 1e-5),
            ("e1", shapes.e1[i], "", 1e-6),
            ("e2", shapes.e2[i], "", 1e-6),
        ):
            figures[f"psf {what} {name}"] = Quantity(float(value), unit, tolerance, "image")
    return figures


def _reconstruction(scene: Scene) -> dict[str, Quantity]:
    """Return what the PSF model of one CCD leaves, from stars without noise.

    How many photons a pixel holds hangs on rounding, and one more would draw anew all that follow it.
    """
    name = scene.plan.ccds[0]
    exposure = expose_ccd(scene.camera_experiment, name, threads=scene.threads)
    found = ccd_figures(model_ccd(scene.camera_experiment, exposure, noisy=False))
    return {
        f"reconstruction {name} {key.replace('_', ' ')}": Quantity(float(found[key]), "", 2e-6, "model")
        for key in ("mean_e_truth", "rms_residual_at_stars", "rms_residual_away")
    }


_GROUPS: dict[str, Callable[[Scene], dict[str, Quantity]]] = {
    "opd": _opd,
    "landing": _landing,
    "zernike": _zernike,
    "spot": _spot,
    "ee80": _ee80,
    "distortion": _distortion,
    "vignetting": _vignetting,
    "height": _height,
    "defocus": _defocus,
    "psf": _psf,
    "reconstruction": _reconstruction,
}
#: Kinds of figures, the first word of their names: of a telescope alone, and with a configuration.
OPTICS = ("opd", "landing", "zernike", "spot", "ee80", "distortion", "vignetting")
CAMERA = ("height", "defocus", "psf", "reconstruction")


def measure(
    scene: Scene, kinds: Iterable[str], advance: Callable[[], None] | None = None
) -> tuple[dict[str, Quantity], dict[str, str]]:
    """Compute figures.

    Parameters
    ----------
    scene : Scene
        What of.
    kinds : iterable of str
        Which kinds, of :data:`OPTICS` and :data:`CAMERA`.
    advance : callable, optional
        Called after each kind.

    Returns
    -------
    figures : dict of str to Quantity
        Figures by name.
    problems : dict of str to str
        Why a kind of figures cannot be had of this telescope, one line each.
    """
    figures: dict[str, Quantity] = {}
    problems: dict[str, str] = {}
    for kind in kinds:
        try:
            found = _GROUPS[kind](scene)
        except PachonError as error:
            problems[kind] = str(error)
        else:
            figures |= {name: q for name, q in found.items() if np.isfinite(q.value)}
        if advance is not None:
            advance()
    return figures, problems


def _pair(values: tuple[float, float]) -> str:
    return f"({values[0]:g}, {values[1]:g})"


def _one_digit(value: float) -> float:
    return float(f"{value:.0e}")
