"""Time of a star through six moving screens, beside GalSim's photons: per sample, and for the same noise.

Run: python benchmarks/psf_vs_galsim.py [--size N] [--length METRES] [--rounds N]

Both have six screens of their own over 15 s, made beforehand, on one thread, in turns in one process. pachon's
fast engine runs twice: "LSST", as production runs it (lsst_v3.3_r, five wavelengths, rays traced, charge diffusion),
and "ideal", one wavelength without optics. GalSim shoots photons of one wavelength in the geometric approximation with
its own second kick, through the annular pupil, without optics.

a. Per sample: GalSim shoots as many photons a star as pachon has pairs of a pupil point and a time step. pachon's five
   wavelengths share those pairs, which are counted once.
b. For the same noise in ellipticity (weighted moments, 0.7 arcsec, 0.2 arcsec pixels; rms of a component):
   - GalSim's is the scatter of e when the same stars are shot repeatedly with other photons through the same
     screens. Its variance is inversely proportional to the number of photons, as the output shows.
   - pachon draws no photons; its error is the rms difference of e from the same stars through the same screens with ten
     times the time steps and four times the pupil points, over several exposures.
   The ratio is the time of GalSim with so many photons that the two are equal, over pachon's. It is also the ratio in
   (a) times the number of photons over the number of samples; the photons are shot, and the time is not extrapolated.
"""

import argparse
import time

import galsim
import numpy as np
from atmosphere_vs_galsim import (
    FIELD,
    SITE,
    WAVELENGTH,
    ellipticity,
    galsim_layers,
    galsim_stars,
    long_paraboloid,
    through_screens,
)

import pachon
from pachon import Atmosphere, ScreenSampling
from pachon.core.units import ARCSEC
from pachon.wavefront.psf.fast import PUPIL_POINTS

PIXEL, STAMP, STARS = 0.2 * ARCSEC, 31, 64
FINE = {"engine": pachon.FastEngine(n_pupil=1300)}
FINE_STEP = 0.005


def timed(job) -> tuple[float, np.ndarray]:
    start = time.perf_counter()
    result = job()
    return time.perf_counter() - start, result


def noise_of_photons(layers: galsim.PhaseScreenList, fields: np.ndarray, photons: int, repeats: int) -> float:
    """Return the variance of a component of e when the same stars are shot again."""
    rng = galsim.BaseDeviate(photons)
    e = [
        ellipticity(galsim_stars(layers, fields, rng, photons, pixel=PIXEL, stamp=STAMP), PIXEL) for _ in range(repeats)
    ]
    return 0.5 * float(np.var(e, axis=0, ddof=1).mean())


def error_of_samples(engine, atmosphere: Atmosphere, fine: Atmosphere, fields: np.ndarray, exposures: int) -> float:
    """Return the rms difference of a component of e from fine sampling of the same exposures."""
    screens = atmosphere.screens("slopes")
    square = []
    for exposure in range(exposures):
        start = 60.0 * exposure
        coarse_e, fine_e = (
            ellipticity(engine(through_screens(a, screens, times=a.times + start), fields, **options), PIXEL)
            for a, options in ((atmosphere, {}), (fine, FINE))
        )
        square.append(np.mean(np.abs(coarse_e - fine_e) ** 2))
    return float(np.sqrt(0.5 * np.mean(square)))


def main() -> None:
    parser = argparse.ArgumentParser(description="Stars through the atmosphere, against GalSim's photons.")
    parser.add_argument("--size", type=int, default=8192, help="samples on a side of a screen: 2^n or 3 x 2^n")
    parser.add_argument("--length", type=float, default=1300.0, help="side of a screen in metres")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--exposures", type=int, default=6, help="exposures over which the error is averaged")
    arguments = parser.parse_args()
    # Slightly less than the side: one sample more by rounding would double GalSim's grid.
    length = arguments.length * (1.0 - 1e-12)
    screens = ScreenSampling(screen_size=arguments.size, screen_length=length)
    atmosphere = Atmosphere.from_site(SITE, 1, screens=screens)
    fine = Atmosphere.from_site(SITE, 1, time_step=FINE_STEP, screens=screens)
    atmosphere.screens("slopes")
    fields = np.random.default_rng(0).uniform(-FIELD, FIELD, (STARS, 2))
    samples = PUPIL_POINTS * len(atmosphere.times)
    print(f"pachon {pachon.__version__}, GalSim {galsim.__version__}; one thread each")
    print(
        f"{PUPIL_POINTS} pupil points x {len(atmosphere.times)} time steps = {samples} samples a star; six screens of"
        f" {arguments.size}^2 over {arguments.length:g} m"
    )
    lsst, ideal = pachon.load_telescope("lsst_v3.3_r"), long_paraboloid()

    def through_lsst(atmosphere, fields, **more):
        waves = np.linspace(545e-9, 703e-9, 5)
        return pachon.make_psfs(lsst, fields, waves, atmosphere=atmosphere, threads=1, **more).image

    def through_ideal(atmosphere, fields, **more):
        stamps = pachon.Stamps(STAMP, PIXEL * ideal.reference_sphere_radius, diffusion=0.0)
        plane = {"stamps": stamps, "atmosphere": atmosphere, "threads": 1}
        return pachon.make_psfs(ideal, fields, [WAVELENGTH], **plane, **more).image

    engines = {"LSST": through_lsst, "ideal": through_ideal}
    with galsim.utilities.single_threaded():
        layers = galsim_layers(atmosphere, 1)
        error = {
            name: error_of_samples(e, atmosphere, fine, fields, arguments.exposures) for name, e in engines.items()
        }
        print("noise of a component of e with GalSim's photons, variance x photons:")
        counts = (samples // 4, samples, 4 * samples)
        products = [
            n * noise_of_photons(layers, fields[:8], n, repeats)
            for n, repeats in zip(counts, (160, 80, 40), strict=True)
        ]
        print("   " + ", ".join(f"{n} photons: {p:.3f}" for n, p in zip(counts, products, strict=True)))
        constant = float(np.mean(products))
        rng = galsim.BaseDeviate(5)
        for name, engine in engines.items():
            needed = round(constant / error[name] ** 2)
            engine(atmosphere, fields[:2])
            times = []
            for _ in range(arguments.rounds):
                ours = timed(lambda e=engine: e(atmosphere, fields))[0] / STARS
                same = timed(lambda: galsim_stars(layers, fields[:4], rng, samples, pixel=PIXEL, stamp=STAMP))[0] / 4
                equal = timed(lambda n=needed: galsim_stars(layers, fields[:1], rng, n, pixel=PIXEL, stamp=STAMP))[0]
                times.append((ours, same, equal))
            table = np.array(times)
            ours, same, equal = np.median(table, axis=0)
            print(f"{name}:")
            print(f"   pachon {ours * 1e3:8.2f} ms a star, {ours / samples * 1e9:6.1f} ns a sample")
            print(f"   GalSim {same * 1e3:8.2f} ms a star, {same / samples * 1e9:6.1f} ns a sample, as many samples")
            print(f"   GalSim {equal * 1e3:8.0f} ms a star, {needed} photons, as much noise")
            print(f"   error of pachon's sampling, rms of a component of e: {error[name]:.1e}")
            for label, ratios in (("per sample", table[:, 1] / table[:, 0]), ("same noise", table[:, 2] / table[:, 0])):
                print(f"   ratio, {label} {np.median(ratios):7.1f} (from {ratios.min():.1f} to {ratios.max():.1f})")


if __name__ == "__main__":
    main()
