"""A donut on each CCD: the camera moved 1.5 mm out of focus, to one side and the other, as in full-array mode.

Run: python benchmarks/full_array_mode.py [CCDs] [sides] [picture.png] [electrons] [moved]

The LSST (r band), off by twice the tolerances of ``pachon align`` in each of fifty degrees of freedom, exposes one
star (5e6 electrons by default) on each of so many CCDs (all by default), with the heights of the camera as built, its
camera moved by +1.5 mm, and with ``sides`` 2 (the default) by -1.5 mm too; ``moved`` names another body (Detector), in
the images and in the fit. All donuts together give the degrees of freedom
(``fit_donuts(fit=TelescopeFreedoms(...))``). Printed: the wavefront over the field before and after they are taken off,
what the covariance of the fit expects, and processor time and memory.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np

import pachon
from pachon.core.files import write_bytes
from pachon.core.plotting import picture_bytes
from pachon.pipeline.simulate.donuts import STAMP_SIZE
from pachon.studies import AlignConfig
from pachon.studies.alignment.scene import AlignmentScene

PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
PARSER.add_argument("ccds", type=int, nargs="?", default=189, help="CCDs, of a donut each")
PARSER.add_argument("sides", type=int, nargs="?", default=2, help="sides of focus, 1 or 2")
PARSER.add_argument("picture", nargs="?", default="-", help="picture to write; - for none")
PARSER.add_argument("electrons", type=float, nargs="?", default=5e6, help="electrons of a star")
PARSER.add_argument("moved", nargs="?", default="Camera", help="body that makes the defocus")
ARGUMENTS = PARSER.parse_args()
COUNT = ARGUMENTS.ccds
SIDES = ARGUMENTS.sides
PICTURE = ARGUMENTS.picture if ARGUMENTS.picture != "-" else None
ELECTRONS = ARGUMENTS.electrons
MOVED = ARGUMENTS.moved
DEFOCUS, SKY, READ_NOISE, DIFFUSION = 1.5e-3, 300.0, 8.8, 4e-6


def main() -> None:
    scene = AlignmentScene.of(AlignConfig())
    telescope, freedoms = scene.telescope, scene.freedoms
    heights = pachon.FocalPlane.as_measured("lsstcam")
    camera = heights.camera
    every = np.arange(len(camera))
    fields = pachon.fields_at(telescope, np.stack(camera.from_local(every, 0.0 * every, 0.0 * every), axis=-1))
    fields = fields[np.linspace(0, len(fields) - 1, min(COUNT, len(fields))).round().astype(int)]
    count = len(fields)
    state = scene.config.errors.initial * np.random.default_rng(1).standard_normal(len(freedoms))
    true = freedoms.apply(telescope, state * scene.tolerances)
    images, defocus = [], []
    start = time.process_time()
    for side in (1.0, -1.0)[:SIDES]:
        moved = true.perturbed(MOVED, shift=(0.0, 0.0, side * DEFOCUS))
        images.append(
            pachon.draw_donuts(
                moved,
                fields,
                scene.wavelengths,
                focal_plane=heights,
                atmosphere=scene.atmosphere,
                electrons=ELECTRONS,
                sky=SKY,
                read_noise=READ_NOISE,
                seed=int(side > 0),
                stamps=pachon.Stamps(STAMP_SIZE, diffusion=DIFFUSION),
            ).images
        )
        defocus.append(np.full(count, side * DEFOCUS))
    drawn = time.process_time() - start
    # Twice the tolerances, and as much again: what the prior leaves is 1e-4 of what the donuts say.
    prior = 2.0 * scene.config.errors.initial * scene.tolerances
    start = time.process_time()
    fit = pachon.fit_donuts(
        telescope,
        np.concatenate(images),
        np.tile(fields, (SIDES, 1)),
        scene.wavelengths,
        sky_variance=SKY + READ_NOISE**2,
        model=pachon.DonutModel(
            detector=pachon.DonutDetector(
                diffusion=DIFFUSION, focal_plane=heights, defocus=np.concatenate(defocus), moved=MOVED
            ),
            diffraction=True,
        ),
        fit=pachon.sensing.TelescopeFreedoms(freedoms, prior=prior),
    )
    fitted = time.process_time() - start
    found = fit.degrees_of_freedom
    left = freedoms.apply(telescope, state * scene.tolerances - found.values)
    expected = scene.expected_wavefront(found.covariance / np.outer(scene.tolerances, scene.tolerances))
    before, after = (1e9 * scene.quality.means(t).added for t in (true, left))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"pachon {pachon.__version__}; {MOVED} moved; {fit.usable.sum()} of {SIDES * count} donuts used")
    error = found.values - state * scene.tolerances
    quality = error @ np.linalg.solve(found.covariance, error) / len(error)
    print(f"chi-square of the errors: {quality:.2f} a degree of freedom")
    print(f"wavefront over the field: {before:.0f} nm rms before, {after:.1f} after ({1e9 * expected:.1f} expected)")
    print(f"processor time: {drawn:.0f} s for the donuts, {fitted:.0f} s for the fit; memory {memory:.1f} GiB")
    quality = fit.chi2[fit.usable] / fit.n_pixels[fit.usable]
    print(f"chi-square a pixel: median {np.median(quality):.3f}, worst {quality.max():.3f}")
    beyond = np.tile(np.hypot(*fields.T) > telescope.field_radius, SIDES)[fit.usable]
    if beyond.any():
        edge = np.rad2deg(telescope.field_radius)
        print(f"of {beyond.sum()} donuts beyond {edge:.2f} degrees: worst {quality[beyond].max():.3f}")
    ratio = found.combinations()[0]
    print(f"combinations known to better than a sixth of the prior: {(ratio < 1 / 6).sum()} of {len(ratio)}")
    if PICTURE:
        write_bytes(Path(PICTURE), picture_bytes(_picture(fields, fit, scene, true), "png"))


def _picture(fields: np.ndarray, fit: pachon.sensing.DonutFit, scene: AlignmentScene, true: pachon.Telescope):
    """Draw Z4 to Z8 over the field as found, and found minus true."""
    from pachon.core.plotting import styled

    with styled():
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(2, 5, figsize=(14, 5.6), sharex=True, sharey=True)
        both = [
            pachon.wavefront_zernikes(t, fields, scene.wavelength, jmax=28).coefficients[:, fit.noll - 1]
            for t in (scene.telescope, true)
        ]
        truth = 1e9 * (both[1] - both[0])
        values = 1e9 * fit.zernikes[: len(fields)]
        x, y = np.rad2deg(fields).T
        for k in range(5):
            for row, v in zip(axes, (values[:, k], (values - truth)[:, k]), strict=True):
                most = float(np.abs(v).max())
                dots = row[k].scatter(x, y, c=v, s=26, marker="s", cmap="RdBu_r", vmin=-most, vmax=most)
                figure.colorbar(dots, ax=row[k], shrink=0.8)
                row[k].set_aspect("equal")
            axes[0, k].set_title(f"Z{fit.noll[k]} [nm]")
        axes[0, 0].set_ylabel("found; field y [deg]")
        axes[1, 0].set_ylabel("found - true; field y [deg]")
        for axis in axes[1]:
            axis.set_xlabel("field x [deg]")
        return figure


if __name__ == "__main__":
    main()
