"""CCD heights of the LSST and the ellipticities that they cause with the optics alone: the picture of the README.

Run: python benchmarks/optics_alone_picture.py PICTURE.png [--check | --as-built]

Telescope, heights, wavelength and places are those of docs/examples/optics_alone.yaml (Jee & Tyson 2011, Fig. 8): 12
noise-free PSFs on each of the 189 CCDs, by wave optics. Pupil points lie 0.08 m apart and stamps have 31 pixels, in
place of 0.04 m and 63, which takes a sixth of the time. With --check five CCDs are computed both ways, and the
difference is printed. With --as-built the heights are those of LSSTCam as measured, moved into focus as a whole, and
the PSFs those of the r band in the mean of turbulence, with whiskers of g of adaptive moments. Other whiskers are of
the weighted e under 0.3", as in the paper: half of these images have no adaptive moments, as they are narrower than a
pixel or far from an ellipse.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from pachon import Configuration, Experiment, adaptive_moments, measure_shapes
from pachon.core.files import write_bytes
from pachon.core.plotting import new_figure, png_bytes, styled
from pachon.measure.focal_plane_axes import (
    draw_field_circle,
    draw_key_whisker,
    draw_outlines,
    draw_whiskers,
    frame_axes,
    key_ellipticity,
    whiskers,
)
from pachon.pipeline import load_configuration
from pachon.pipeline.config import with_options
from pachon.pipeline.report.focal_plane_plots import draw_heights, height_range
from pachon.pipeline.simulate.ccd_exposure import expose_positions, holdout_positions
from pachon.studies.shimming.shim import Motion, moved_whole
from pachon.wavefront.psf import wave

CONFIG = Path(__file__).parents[1] / "docs" / "examples" / "optics_alone.yaml"
#: CCDs of the check: the middle, the ring of the largest ellipticities, the edge of the field.
CHECKED = ("R22_S11", "R24_S11", "R12_S00", "R43_S22", "R01_S10")
#: Focus of LSSTCam as built, of `pachon shim --heights lsstcam`.
FOCUS = Motion(dz=-2.04e-06, rx=1.15e-06, ry=-9.67e-07)
#: Distance of pupil points [m], and pixels of a stamp along a side.
COARSE = (0.08, 31)
#: The same of the configuration.
FINE = (wave.LARGEST_SPACING_OPTICS, 63)


def experiment_of(ccds: tuple[str, ...], spacing: float, stamp: int) -> Experiment:
    wave.LARGEST_SPACING_OPTICS = spacing
    return Experiment.from_config(with_options(load_configuration(CONFIG), ccds=ccds, psf__stamp=stamp))


def ellipticities(experiment: Experiment) -> tuple[np.ndarray, np.ndarray]:
    """Return positions [m], [n, 2], and e1 + i e2 of the noise-free PSFs of the CCDs of an experiment, [n]."""
    names = experiment.config.ccds or ()
    positions = np.concatenate([holdout_positions(experiment, name) for name in names])
    stars = expose_positions(experiment, positions)
    shapes = measure_shapes(stars.image, stars.pixel_scale, experiment.weight_fwhm)
    return positions, shapes.e1 + 1j * shapes.e2


def in_turbulence() -> tuple[Experiment, np.ndarray, np.ndarray]:
    """Return the experiment of LSSTCam as built, positions [m], [n, 2], and g1 + i g2 of its PSFs, [n]."""
    options = {"ccds": ("all",), "focal_plane__heights": "lsstcam", "psf__engine": "long_exposure", "stars__truth": 15}
    experiment = Experiment.from_config(with_options(Configuration(), **options))
    experiment = replace(experiment, focal_plane=moved_whole(experiment.focal_plane, FOCUS))
    positions = np.concatenate([holdout_positions(experiment, name) for name in experiment.config.ccds or ()])
    stars = expose_positions(experiment, positions)
    moments = adaptive_moments(stars.image, stars.pixel_scale)
    return experiment, positions, moments.g1 + 1j * moments.g2


def check() -> None:
    values, seconds = [], []
    for way in (FINE, COARSE):
        start = time.process_time()
        values.append(ellipticities(experiment_of(CHECKED, *way))[1])
        seconds.append((time.process_time() - start) / len(values[-1]))
    difference = np.abs(values[0] - values[1])
    print(
        f"{len(difference)} stars: rms |e| {np.sqrt(np.mean(np.abs(values[0]) ** 2)):.4f}; difference rms "
        f"{np.sqrt(np.mean(difference**2)):.5f}, largest {difference.max():.5f}; "
        f"{seconds[0]:.3f} and {seconds[1]:.3f} s of processor time a star"
    )


def draw(experiment: Experiment, positions: np.ndarray, e: np.ndarray, title: str) -> bytes:
    plane = experiment.focal_plane
    camera, radius = plane.camera, experiment.field_radius_on_detector * 1e3
    edge = 1.03 * max(radius, 1e3 * camera.reach)
    limits = (-edge, edge, -edge, edge)
    key = key_ellipticity(np.abs(e))
    scale = 0.012 * 2.0 * edge / key
    with styled():
        figure = new_figure(9.0, 8.3, "compressed")
        axes = figure.subplots()
        image = draw_heights(axes, plane, limits, 900, alpha=0.35, bounds=height_range(plane))
        draw_outlines(axes, camera, range(len(camera)), "0.5", 0.5)
        draw_field_circle(axes, radius)
        draw_whiskers(axes, whiskers(*(1e3 * positions.T), e.real, e.imag, scale), "black", 0.7)
        frame_axes(axes, limits)
        axes.set_title(f"{title}; dashed: edge of the field", loc="left")
        draw_key_whisker(axes, key, scale, 1.0)
        figure.colorbar(image, ax=axes, fraction=0.04, pad=0.015, label="CCD height [µm]")
        return png_bytes(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", type=Path)
    parser.add_argument("--check", action="store_true", help="compare five CCDs with the configuration as it is")
    parser.add_argument("--as-built", action="store_true", help="LSSTCam as built, in the mean of turbulence")
    arguments = parser.parse_args()
    if arguments.check:
        check()
        return
    if arguments.as_built:
        title = "LSSTCam as built, in focus: g in r, mean of turbulence"
        write_bytes(arguments.picture, draw(*in_turbulence(), title))
        return
    experiment = experiment_of(("all",), *COARSE)
    positions, e = ellipticities(experiment)
    scale = experiment.telescope.field_radius / experiment.field_radius_on_detector
    radius = np.rad2deg(scale * np.hypot(*positions.T))
    for low, high in ((0.0, 0.3), (0.9, 1.1), (1.5, 1.7), (1.75, 2.2)):
        ring = np.abs(e[(radius >= low) & (radius < high)])
        print(f"{low:g} to {high:g} deg: mean |e| {ring.mean():.1%}, 95 % below {np.quantile(ring, 0.95):.1%}")
    print(f"{np.mean(np.abs(e) > 0.1):.0%} of {len(e)} stars exceed 10 %, the largest is {np.abs(e).max():.0%}")
    write_bytes(arguments.picture, draw(experiment, positions, e, "Weighted e of the optics alone, 624 nm"))


if __name__ == "__main__":
    main()
