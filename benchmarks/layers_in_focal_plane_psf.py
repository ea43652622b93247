"""Turbulence of the focal-plane model by fitted exponentials and by the theory of layers, beside one another.

Run: python benchmarks/layers_in_focal_plane_psf.py [--seeds 11 12 13] [--heights unknown] [--stars 40]

Exposures of 15 s of the LSST through screens, by the fast engine at one wavelength. On each CCD there are observed
stars with noise of 1/SNR (30 to 1000, as counts of stars have them), and fifty places without noise, where both models
are compared with what was simulated: rms of e1, e2 and ln size, and mean square over the predicted variance, within
1.75 degrees and beyond, where vignetting changes within a CCD. Directions of the wind are not given to the fit. One
line a model with the time of its fit, and the winds found beside the true ones.
"""

import argparse
import time

import numpy as np

import pachon
from pachon import FocalPlanePsf
from pachon.reconstruction import Instrument

WAVELENGTHS = [620e-9]
HELD_OUT = 50
BATCH = 1000
FAINTEST, BRIGHTEST, SLOPE = 30.0, 1000.0, 0.8


class Exposure:
    """Shapes of one exposure."""

    def __init__(self, seed: int, stars: int) -> None:
        self.telescope = pachon.load_telescope("lsst_v3.3_r")
        self.plane = pachon.FocalPlane.from_budget("lsst", seed=seed)
        self.air = pachon.Atmosphere.from_site("cerro_pachon", seed)
        camera, rng = self.plane.camera, np.random.default_rng(seed)
        self.ccd = np.repeat(np.arange(len(camera)), stars + HELD_OUT)
        self.xy = camera.from_uv(self.ccd, rng.uniform(-0.98, 0.98, (len(self.ccd), 2)))
        self.observed = np.tile(np.arange(stars + HELD_OUT) < stars, len(camera))
        self.instrument = Instrument.of(self.telescope, WAVELENGTHS, self.air, camera="lsst")
        fields = self.instrument.fields(self.xy)
        self.truth = np.concatenate([self._shapes(fields[k : k + BATCH]) for k in range(0, len(fields), BATCH)])
        most = 1.0 - (BRIGHTEST / FAINTEST) ** -SLOPE
        self.noise = (1.0 - most * rng.uniform(size=len(self.ccd))) ** (1.0 / SLOPE) / FAINTEST
        self.values = self.truth + self.noise[:, None] * rng.standard_normal(self.truth.shape)
        self.names = np.array(camera.ccd_names)[self.ccd]

    def _shapes(self, fields: np.ndarray) -> np.ndarray:
        psfs = pachon.make_psfs(
            self.telescope,
            fields,
            WAVELENGTHS,
            focal_plane=self.plane,
            atmosphere=self.air,
            stamps=self.instrument.stamps,
        )
        shapes = pachon.measure_shapes(psfs.image, psfs.pixel_scale, self.instrument.weight_fwhm)
        return np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=1)

    def stars(self) -> pachon.FocalPlaneStars:
        seen = self.observed
        table = {"ccd": self.names[seen].tolist(), "x": self.xy[seen, 0], "y": self.xy[seen, 1]}
        table |= {"e1": self.values[seen, 0], "e2": self.values[seen, 1], "size": np.exp(self.values[seen, 2])}
        table |= {f"{shape}_noise": self.noise[seen] for shape in ("e1", "e2", "size")}
        return pachon.FocalPlaneStars.from_table(table)

    def compare(self, turbulence: str, known: bool) -> FocalPlanePsf:
        """Fit a model and print its line."""
        start = time.perf_counter(), time.process_time()
        heights = self.plane if known else None
        model = FocalPlanePsf.fit(self.stars(), self.instrument, heights, turbulence=turbulence, components=0)
        wall, processor = time.perf_counter() - start[0], time.process_time() - start[1]
        at = ~self.observed
        shapes, sigma = model.predict(self.names[at].tolist(), self.xy[at, 0], self.xy[at, 1])
        left = np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=1) - self.truth[at]
        over = left / np.stack([sigma.e1, sigma.e2, sigma.size / shapes.size], axis=1)
        within = np.hypot(*self.instrument.fields(self.xy[at]).T) < np.deg2rad(1.75)
        parts = []
        for place in (within, ~within):
            rms, chi2 = 1e3 * np.sqrt((left[place] ** 2).mean(axis=0)), (over[place] ** 2).mean(axis=0)
            parts.append(" ".join(f"{v:.3f}" for v in rms) + "  chi2 " + " ".join(f"{v:.2f}" for v in chi2))
        print(f"{turbulence:12s} [1e-3] {parts[0]}   beyond {parts[1]}   {wall:.0f} s, {processor:.0f} s", flush=True)
        return model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12, 13, 14, 15])
    parser.add_argument("--heights", choices=["known", "unknown"], default="known")
    parser.add_argument("--stars", type=int, default=40, help="observed stars of a CCD")
    options = parser.parse_args()
    print(f"pachon {pachon.__version__}, heights {options.heights}, {options.stars} stars of each of 189 CCDs")
    for seed in options.seeds:
        exposure = Exposure(seed, options.stars)
        print(f"seed {seed}")
        for turbulence in ("exponential", "layers"):
            model = exposure.compare(turbulence, options.heights == "known")
        found = model.covariances[0].air
        for altitude, true, wind in zip(found.altitudes, exposure.air.velocities, found.velocities, strict=True):
            numbers = ", ".join(f"{v:.1f}" for v in (*true, *wind))
            print(f"    {altitude:6.0f} m: wind x, y, found x, y [m/s]: {numbers}")


if __name__ == "__main__":
    main()
