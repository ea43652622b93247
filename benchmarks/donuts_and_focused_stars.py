"""Fifty degrees of freedom from the pixels of eight corner donuts, alone and with stars in focus, in one likelihood.

Run: python benchmarks/donuts_and_focused_stars.py [stars] [picture.png]

The LSST (r band), off by the tolerances of ``pachon align`` in each degree of freedom, exposes a star of 5e6 electrons
on each of the eight halves of its wavefront sensors, and so many (40) of 2e5 electrons in focus in the middle of CCDs,
all through the mean of turbulence. Printed for both sets: the combinations that are known, the wavefront over the field
that is left, by tracing and as the covariance of the fit expects, the chi-square of the errors, and processor time. The
picture has the posterior over the prior standard deviation of the combinations.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

import pachon
from pachon.core.files import write_bytes
from pachon.core.plotting import BLUE, ORANGE, picture_bytes, styled
from pachon.studies import AlignConfig
from pachon.studies.alignment.scene import AlignmentScene

PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
PARSER.add_argument("stars", type=int, nargs="?", default=40, help="stars in focus")
PARSER.add_argument("picture", nargs="?", default=None, help="picture to write")
ARGUMENTS = PARSER.parse_args()
STARS = ARGUMENTS.stars
PICTURE = ARGUMENTS.picture
DEFOCUS, ELECTRONS, FOCUSED, SKY, READ_NOISE, DIFFUSION = 1.5e-3, 5e6, 2e5, 300.0, 8.8, 4e-6
#: Rms of the degrees of freedom, and standard deviation of their prior [tolerances].
SIZE, PRIOR = 1.0, 2.0


def main() -> None:
    scene = AlignmentScene.of(AlignConfig())
    telescope, freedoms, tolerances = scene.telescope, scene.freedoms, scene.tolerances
    state = SIZE * np.random.default_rng(3).standard_normal(len(freedoms))
    true = freedoms.apply(telescope, state * tolerances)
    camera = pachon.FocalPlane.flat("lsst").camera
    every = np.arange(len(camera))
    ccds = pachon.fields_at(telescope, np.stack(camera.from_local(every, 0.0 * every, 0.0 * every), axis=-1))
    ccds = ccds[np.hypot(*ccds.T) < telescope.field_radius]
    corners, nominal = scene.stars.fields, scene.stars.heights
    sets = [
        (corners[nominal > 0.0], DEFOCUS, ELECTRONS, 181),
        (corners[nominal < 0.0], -DEFOCUS, ELECTRONS, 181),
        (ccds[np.linspace(0, len(ccds) - 1, STARS).round().astype(int)], 0.0, FOCUSED, 41),
    ]
    images, fields, defocus = [], np.concatenate([at for at, *_ in sets]), []
    for k, (at, height, electrons, side) in enumerate(sets):
        drawn = pachon.draw_donuts(
            true.perturbed("Detector", shift=(0.0, 0.0, height)),
            at,
            scene.wavelengths,
            atmosphere=scene.atmosphere,
            electrons=electrons,
            sky=SKY,
            read_noise=READ_NOISE,
            seed=k,
            stamps=pachon.Stamps(side, diffusion=DIFFUSION),
        )
        images += list(drawn.images)
        defocus += [height] * len(at)
    known = {}
    before = 1e9 * scene.quality.means(true).added
    print(f"pachon {pachon.__version__}; wavefront over the field before: {before:.0f} nm rms")
    for name, count in (("eight donuts", 8), (f"and {STARS} stars in focus", 8 + STARS)):
        start = time.process_time()
        fit = pachon.fit_donuts(
            telescope,
            images[:count],
            fields[:count],
            scene.wavelengths,
            sky_variance=SKY + READ_NOISE**2,
            model=pachon.DonutModel(
                detector=pachon.DonutDetector(diffusion=DIFFUSION, defocus=defocus[:count]), diffraction=True
            ),
            fit=pachon.sensing.TelescopeFreedoms(freedoms, prior=PRIOR * tolerances),
        )
        spent = time.process_time() - start
        found = fit.degrees_of_freedom
        covariance = found.covariance / np.outer(tolerances, tolerances)
        error = found.values / tolerances - state
        ratio = known[name] = found.combinations()[0]
        left = 1e9 * scene.quality.means(freedoms.apply(telescope, -error * tolerances)).added
        print(f"{name}: {fit.usable.sum()} of {count} used, {spent:.0f} s of processor time")
        print(f"  wavefront left {left:.1f} nm rms, {1e9 * scene.expected_wavefront(covariance):.1f} expected")
        quality = error @ np.linalg.solve(covariance, error) / len(error)
        print(f"  chi-square of the errors {quality:.2f} a degree of freedom")
        print(f"  chi-square a pixel {np.sum(fit.chi2[fit.usable]) / np.sum(fit.n_pixels[fit.usable]):.4f}")
        counts = ", ".join(f"{(ratio < 1 / k).sum()} to 1/{k}" for k in (2, 6, 20, 60))
        print(f"  combinations known to a part of the prior: {counts}")
    if PICTURE:
        with styled():
            import matplotlib.pyplot as plt

            figure, axis = plt.subplots(figsize=(6, 3.6))
            for (name, ratio), color in zip(known.items(), (BLUE, ORANGE), strict=True):
                axis.semilogy(np.arange(len(ratio)) + 1, ratio, "o-", color=color, markersize=3, label=name)
            axis.axhline(1.0, color="0.3", linewidth=0.7)
            axis.set(xlabel="combination, best known first", ylabel="posterior / prior standard deviation")
            axis.legend()
            write_bytes(Path(PICTURE), picture_bytes(figure, "png"))


if __name__ == "__main__":
    main()
