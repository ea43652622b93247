"""Metrics of a focal plane with its telescope: CCD heights, defocus, PSFs and their reconstruction."""

from __future__ import annotations

import numpy as np

from ...core.units import ARCSEC
from ...measure.shapes import fwhm, measure_shapes
from ...pipeline.focal_plane_stage import apply_focal_plane_model
from ...pipeline.simulate.ccd_exposure import expose_ccd, expose_positions
from ...pipeline.simulate.ccd_model import model_ccd
from ...pipeline.summary import ccd_metrics
from ...wavefront.chief_rays import fields_at
from ...wavefront.pupil_optics import trace_pupils
from .metric import Metric, MetricTable
from .scene import Scene

#: Metrics of a telescope with a configuration.
CAMERA: MetricTable[Scene] = MetricTable()
#: Radius of the ring of the pupil on which the defocus is taken, in units of that of the pupil.
_RING = 0.9
#: Points of the ring.
_RING_POINTS = 8


@CAMERA.group("height", Metric("height", "um", "height", 1e-6))
def height(scene: Scene) -> dict[str, float]:
    """Return the height of every CCD at its centre, along +z of the telescope frame."""
    plane = scene.camera_experiment.focal_plane
    heights = plane.height(*plane.camera.centers.T) * 1e6
    return {f"height {name}": float(value) for name, value in zip(plane.names, heights, strict=True)}


@CAMERA.group("defocus", Metric("defocus", "nm", "path"))
def defocus(scene: Scene) -> dict[str, float]:
    """Return the change of the path by the height of every CCD, mean over a ring of the pupil."""
    plane = scene.camera_experiment.focal_plane
    angle = np.arange(_RING_POINTS) * (2.0 * np.pi / _RING_POINTS)
    ring = 0.5 * _RING * scene.telescope.pupil_diameter * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    fields = fields_at(scene.telescope, plane.camera.centers, scene.middle, threads=scene.threads)
    with_heights, flat = (
        trace_pupils(scene.telescope, fields, scene.middle, ring, focal_plane=p, threads=scene.threads)
        .path[:, 0]
        .mean(axis=1)
        for p in (plane, None)
    )
    change = (flat - with_heights) * 1e9
    return {f"defocus {name}": float(value) for name, value in zip(plane.names, change, strict=True)}


@CAMERA.group("psf", Metric("psf fwhm", "arcsec", "image", 1e-5), Metric("psf e", "", "image", 1e-6))
def psf(scene: Scene) -> dict[str, float]:
    """Return width and ellipticity of the PSF at the centres of the plan's CCDs."""
    experiment = scene.camera_experiment
    camera = experiment.camera
    centers = camera.centers[[camera.ccd_index(name) for name in scene.plan.ccds]]
    stars = expose_positions(experiment, centers, scene.threads)
    shapes = measure_shapes(stars.image, stars.pixel_scale, experiment.weight_fwhm)
    values = {"fwhm": fwhm(stars.image, stars.pixel_scale) / ARCSEC, "e1": shapes.e1, "e2": shapes.e2}
    return {f"psf {key} {name}": float(values[key][i]) for i, name in enumerate(scene.plan.ccds) for key in values}


@CAMERA.group("reconstruction", Metric("reconstruction", "", "model", 2e-6))
def reconstruction(scene: Scene) -> dict[str, float]:
    """Return the residuals of the PSF model on the plan's first CCD, from noise-free stars.

    A model of the whole focal plane is fitted to the stars of all CCDs of the plan. With noise, rounding could change
    the number of photons in a pixel, and with it all random numbers that follow.
    """
    experiment, name = scene.camera_experiment, scene.plan.ccds[0]
    together = experiment.config.reconstruction.model == "focal_plane"
    products = [
        model_ccd(experiment, expose_ccd(experiment, ccd, threads=scene.threads), noisy=False)
        for ccd in (scene.plan.ccds if together else [name])
    ]
    if together:
        products, _ = apply_focal_plane_model(experiment, products, threads=scene.threads)
    metrics = ccd_metrics(products[0])
    return {
        f"reconstruction {name} {key.replace('_', ' ')}": float(metrics[key])
        for key in ("mean_e_truth", "rms_residual_at_stars", "rms_residual_away")
    }
