"""Sampling of time, pupil and image by the fast engine: each default against a finer run on the same screens.

    python benchmarks/convergence.py [--exposures 6] [--stars 25] [--screen-size 4096]

Stars over the whole field of the LSST, five wavelengths of the r band, CCD heights, 15 s. One sampling is made finer at
a time; printed are the rms differences of e1 and e2 (weight of 0.7 arcsec), the mean ratio of sizes, and the time of a
star on one thread, ray trace included.
"""

import argparse
import time

import numpy as np

import pachon
from pachon.core.units import ARCSEC

#: The engine's own defaults, and the finest values that a reference run takes.
DEFAULT = {"time_step": 0.05, "n_pupil": 334, "oversampling": 2}
REFERENCES = {
    "time_step": (0.005, (0.2, 0.1, 0.05, 0.025)),
    "n_pupil": (1328, (88, 160, 334)),
    "oversampling": (8, (1, 2, 4)),
}


class Field:
    """Stars and screens of some exposures, the same for every sampling."""

    def __init__(self, exposures, stars, size):
        self.telescope = pachon.load_telescope("lsst_v3.3_r")
        self.focal_plane = pachon.FocalPlane.from_budget("lsst", seed=1)
        self.atmospheres, self.fields = [], []
        rng = np.random.default_rng(5)
        centers = self.focal_plane.camera.centers
        for seed in range(exposures):
            screens = pachon.ScreenSampling(screen_size=size, screen_length=size * 1300 / 8192)
            self.atmospheres.append(pachon.Atmosphere.from_site("cerro_pachon", seed, screens=screens))
            ccds = rng.choice(np.flatnonzero(np.hypot(*centers.T) < 0.31), stars, replace=False)
            self.fields.append(pachon.fields_at(self.telescope, centers[ccds] + rng.uniform(-0.018, 0.018, (stars, 2))))

    def shapes(self, time_step, **sampling):
        """Return e1, e2, size of all stars and the seconds of a star."""
        measured, seconds = [], 0.0
        for seed, fields in enumerate(self.fields):
            # The screens do not depend on the time step, so one set serves all.
            atmosphere = self.atmospheres[seed]
            steps = round(atmosphere.exposure / time_step)
            times = (np.arange(steps) + 0.5) * (atmosphere.exposure / steps)
            atmosphere = atmosphere.at_times(times, atmosphere.exposure)
            atmosphere.screens("slopes")
            start = time.perf_counter()
            psfs = pachon.make_psfs(
                self.telescope,
                fields,
                np.linspace(545e-9, 703e-9, 5),
                focal_plane=self.focal_plane,
                atmosphere=atmosphere,
                threads=1,
                engine=pachon.FastEngine(**sampling),
            )
            seconds += time.perf_counter() - start
            shapes = pachon.measure_shapes(psfs.image, psfs.pixel_scale, 0.7 * ARCSEC)
            measured.append(np.stack([shapes.e1, shapes.e2, shapes.size], axis=1))
        return np.concatenate(measured), seconds / sum(len(f) for f in self.fields)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--exposures", type=int, default=6)
    parser.add_argument("--stars", type=int, default=25)
    parser.add_argument("--screen-size", type=int, default=4096)
    options = parser.parse_args()
    field = Field(options.exposures, options.stars, options.screen_size)
    print(f"pachon {pachon.__version__}: {options.exposures} exposures of {options.stars} stars")
    for name, (finest, values) in REFERENCES.items():
        reference, _ = field.shapes(**(DEFAULT | {name: finest}))
        print(f"{name}, against {finest} (others { ({k: v for k, v in DEFAULT.items() if k != name}) })")
        for value in values:
            shapes, seconds = field.shapes(**(DEFAULT | {name: value}))
            rms = np.sqrt(np.mean((shapes - reference)[:, :2] ** 2, axis=0))
            ratio = np.mean(shapes[:, 2] / reference[:, 2])
            print(
                f"  {value:8g}: rms of e1, e2 {rms[0]:.1e} {rms[1]:.1e}, size {ratio:.5f},"
                f" {1e3 * seconds:5.1f} ms a star"
            )


if __name__ == "__main__":
    main()
