"""Processor time of fits of donuts, by blur, size, telescope and diffraction.

Run: python benchmarks/donut_times.py [--blur PIXELS ...] [--repeats N] [--photons N]

Images are photons: rays through random points of the pupil of the bundled LSST (r band, M2 decentred by 0.2 mm), 1.5
mm behind focus unless said, each moved by a Gaussian of the blur and counted in pixels of 10 um, with a sky of 500
electrons. The fit knows the blur, or takes it for a seeing that it fits ("free"). Sizes are those of donuts 3 and 4.5
mm behind focus, and of DECam's (1.5 mm, pixels of 15 um, spiders). Diffraction is fitted to donuts of the long-exposure
engine. Each row is the least of some repeats, on one thread, in turns; errors
are those of Z4 to Z22 together.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import scipy

import pachon

WAVELENGTH, SKY = 622e-9, 500.0
FIELD = np.deg2rad([0.6, 0.9])
NOLL = np.arange(4, 23)


@dataclass(frozen=True)
class Donut:
    """A donut, the telescope that is believed in, and the wavefront beyond it [m]."""

    believed: pachon.Telescope
    image: np.ndarray
    field: np.ndarray
    pixel: float
    wavefront: np.ndarray


def telescopes(name: str, defocus: float) -> tuple[pachon.Telescope, pachon.Telescope]:
    """Return the telescope behind focus that is believed in, and the true one."""
    believed = pachon.load_telescope(name)
    mirror = "M2" if "lsst" in name else "PM"
    shift = (2e-4, 0.0, 0.0) if "lsst" in name else (1e-3, 0.0, 0.0)
    behind = believed.perturbed("Detector" if "lsst" in name else believed.surfaces[-1].name, shift=(0, 0, defocus))
    return behind, behind.perturbed(mirror, shift=shift)


def difference(true: pachon.Telescope, believed: pachon.Telescope, field: np.ndarray) -> np.ndarray:
    """Return the wavefront of one telescope beyond another's, Z4 to Z22 [m]."""
    after, before = (
        pachon.wavefront_zernikes(t, [field], WAVELENGTH, jmax=22).coefficients[0] for t in (true, believed)
    )
    return (after - before)[3:]


def photons(
    name: str, size: int, blur: float, count: int, defocus: float = 1.5e-3, pixel: float = 10e-6, seed: int = 1
) -> Donut:
    """Return a donut of so many photons, blurred by a Gaussian [pixels]."""
    believed, true = telescopes(name, defocus)
    field = FIELD if "lsst" in name else np.deg2rad([0.3, 0.4])
    rng = np.random.default_rng(seed)
    image = np.zeros((size, size))
    edges = np.arange(size + 1) - 0.5 * size
    radius = 0.5 * true.pupil_diameter
    while image.sum() < count:
        x, y = rng.uniform(-radius, radius, (2, 1_000_000))
        end = pachon.trace(true, pachon.launch_rays(true, field, WAVELENGTH, (x, y)))
        chief = pachon.trace(true, pachon.launch_rays(true, field, WAVELENGTH, (0.0, 0.0)))
        place = (end.position - chief.position)[end.status == 0, :2] / pixel
        place += rng.normal(0.0, blur, place.shape) if blur else 0.0
        image += np.histogram2d(place[:, 1], place[:, 0], [edges, edges])[0]
    image += rng.poisson(SKY, image.shape) - SKY
    return Donut(believed, image, field, pixel, difference(true, believed, field))


def waves(count: int) -> Donut:
    """Return a donut of the long-exposure engine."""
    believed, true = telescopes("lsst_v3.3_r", 1.5e-3)
    air = pachon.Atmosphere.from_site("cerro_pachon", seed=1)
    image = count * pachon.draw_donuts(true, [FIELD], [WAVELENGTH], atmosphere=air).psf.image[0]
    image = np.random.default_rng(1).poisson(image + SKY) - SKY
    return Donut(believed, image, FIELD, 10e-6, difference(true, believed, FIELD))


def fit(donut: Donut, model: pachon.DonutModel) -> pachon.sensing.DonutFit:
    """Fit a donut on one thread."""
    return pachon.fit_donuts(
        donut.believed, donut.image[None], [donut.field], WAVELENGTH, sky_variance=SKY, model=model, threads=1
    )


def report(label: str, donut: Donut, models: dict[str, pachon.DonutModel], repeats: int) -> None:
    """Print the time of fits of one donut by several models, in turns."""
    least = dict.fromkeys(models, np.inf)
    fits = {}
    for _ in range(repeats):
        for name, model in models.items():
            start = time.process_time()
            fits[name] = fit(donut, model)
            least[name] = min(least[name], time.process_time() - start)
    for name, result in fits.items():
        error, claimed = np.linalg.norm(result.zernikes[0] - donut.wavefront), np.linalg.norm(result.errors[0])
        print(
            f"{label:34} {name:12} {least[name]:7.2f} s {1e9 * error:7.1f} nm (claimed {1e9 * claimed:5.1f})"
            f" chi2 {result.chi2[0] / result.n_pixels[0]:5.3f} {result.reasons[0] or 'ok'}",
            flush=True,
        )


def known(blur: float, pixel: float) -> pachon.DonutModel:
    """Return a model of a known Gaussian blur [pixels], of rays."""
    detector = pachon.DonutDetector(pixel_size=pixel, diffusion=blur * pixel)
    return pachon.DonutModel(air=pachon.DonutAir(fwhm=0.0), detector=detector, diffraction=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--blur", type=float, nargs="+", default=[0.0, 0.2, 0.5, 1.0, 2.0, 3.5])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--photons", type=int, default=5_000_000)
    options = parser.parse_args()
    print(f"pachon {pachon.__version__}, numpy {np.__version__}, scipy {scipy.__version__}")
    lsst = "lsst_v3.3_r"
    fit(photons(lsst, 200, 2.0, 1_000_000), known(2.0, 10e-6))  # compiles
    for blur in options.blur:
        free = pachon.DonutModel(diffraction=False)
        models = {"known": known(blur, 10e-6), "free": free}
        report(f"200 x 200, blur {blur:g}", photons(lsst, 200, blur, options.photons), models, options.repeats)
    for size, defocus in ((400, 3e-3), (600, 4.5e-3)):
        for blur in (0.0, 2.0):
            donut = photons(lsst, size, blur, options.photons, defocus)
            report(f"{size} x {size}, blur {blur:g}", donut, {"known": known(blur, 10e-6)}, options.repeats)
    for blur in (0.0, 1.5):
        donut = photons("decam", 64, blur, options.photons // 5, pixel=15e-6)
        report(f"DECam 64 x 64, blur {blur:g}", donut, {"known": known(blur, 15e-6)}, options.repeats)
    by_diffraction = {f"{d}": pachon.DonutModel(diffraction=d) for d in (False, True, None)}
    report("long exposure, by diffraction", waves(options.photons), by_diffraction, options.repeats)


if __name__ == "__main__":
    main()
