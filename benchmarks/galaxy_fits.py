"""Galaxies a second: fits of PSF-convolved Gaussians beside GalSim's REGAUSS, on the same stamps, in turns.

Run: python benchmarks/galaxy_fits.py [--galaxies N] [--side N] [--threads N] [--rounds N]

Exponential galaxies of half-light radii of 1.5 to 3 pixels, S/N of 15 to 150, one PSF of 3.4 pixels FWHM (0.7 arcsec of
the LSST). pachon fits all stamps in one call, from arrays in memory to parameters and their covariance; GalSim's
EstimateShear takes one stamp at a time on one thread, from an array in memory to a shape and one error.
"""

import argparse
import os
import time

import galsim
import numpy as np

import pachon


def make_stamps(count: int, side: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray, float]:
    """Return noisy stamps [n, side, side], the PSF [33, 33] and the variance of a pixel."""
    rng = np.random.default_rng(seed)
    profile = galsim.Kolmogorov(fwhm=3.4).shear(g1=0.02, g2=-0.01)
    psf = galsim.Convolve(profile, galsim.Pixel(1.0))
    image = psf.drawImage(nx=33, ny=33, scale=1.0, method="no_pixel", dtype=float).array
    stamps = np.empty((count, side, side))
    kinds = 50  # rendering takes longer than fitting: as many galaxies, under noise of their own
    drawn = []
    for _ in range(kinds):
        galaxy = galsim.Exponential(half_light_radius=rng.uniform(1.5, 3.0), flux=np.exp(rng.uniform(6.0, 8.3)))
        galaxy = galaxy.shear(g=rng.uniform(0.0, 0.5), beta=rng.uniform(0.0, np.pi) * galsim.radians)
        galaxy = galsim.Convolve(galaxy.shift(*rng.uniform(-0.5, 0.5, 2)), psf)
        drawn.append(galaxy.drawImage(nx=side, ny=side, scale=1.0, method="no_pixel", dtype=float).array)
    noise = 3.0
    for i in range(count):
        stamps[i] = drawn[i % kinds] + rng.normal(0.0, noise, (side, side))
    return stamps, image / image.sum(), noise**2


def regauss(stamps: np.ndarray, psf: np.ndarray, variance: float) -> int:
    """Measure stamps one after the other and return how many succeeded."""
    psf_image = galsim.ImageD(psf.copy(), scale=1.0)
    good = 0
    for stamp in stamps:
        found = galsim.hsm.EstimateShear(
            galsim.ImageD(stamp, scale=1.0), psf_image, sky_var=variance, shear_est="REGAUSS", strict=False
        )
        good += found.error_message == ""
    return good


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--galaxies", type=int, default=4000)
    parser.add_argument("--side", type=int, default=32)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    stamps, psf, variance = make_stamps(arguments.galaxies, arguments.side)
    print(f"pachon {pachon.__version__}, GalSim {galsim.__version__}, NumPy {np.__version__}, {os.cpu_count()} cores")
    print(f"{arguments.galaxies} stamps of {arguments.side} x {arguments.side} pixels, load {os.getloadavg()[0]:.1f}")
    start = time.perf_counter()
    pachon.measure.fit_galaxy_stamps(stamps[:8], variance, psf)
    print(f"first call, with the compilation where it was not cached: {time.perf_counter() - start:.1f} s")
    own_psfs = np.repeat(psf[None], len(stamps), axis=0)
    few = stamps[: max(200, arguments.galaxies // 10)]
    for _ in range(arguments.rounds):
        rates = {}
        for threads in (1, arguments.threads):
            start = time.perf_counter()
            fits = pachon.measure.fit_galaxy_stamps(stamps, variance, psf, threads=threads)
            rates[threads] = len(stamps) / (time.perf_counter() - start)
        start = time.perf_counter()
        pachon.measure.fit_galaxy_stamps(stamps, variance, own_psfs, threads=arguments.threads)
        own = len(stamps) / (time.perf_counter() - start)
        start = time.perf_counter()
        measured = regauss(few, psf, variance)
        peer = len(few) / (time.perf_counter() - start)
        ours = ", ".join(f"{rate:.0f} on {threads} threads" for threads, rate in rates.items())
        print(
            f"galaxies a second: pachon {ours}, {own:.0f} with a PSF each; REGAUSS {peer:.0f} on 1; "
            f"ratio {rates[1] / peer:.2f} thread by thread, {rates[arguments.threads] / peer:.2f} in all"
        )
    print(
        f"pachon: {fits.evaluations.mean():.1f} models a galaxy, {fits.good.mean():.1%} without flags, median S/N "
        f"{np.median(fits.snr):.0f}; REGAUSS: {measured / len(few):.1%} without an error"
    )


if __name__ == "__main__":
    main()
