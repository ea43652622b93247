"""Time of galaxies and stars on a CCD, beside GalSim drawing the same ones with the same PSF images.

Run: python benchmarks/images_vs_galsim.py [--galaxies N] [--stars N] [--rounds N] [--whole]

Galaxies of the random population to magnitude 29 and stars on one CCD, in turns in one process, on one thread each.
GalSim convolves sums of galsim.Sersic with a galsim.InterpolatedImage of the PSF at the galaxy's place and draws them
on stamps of the same size, with its default accuracy. Both have the PSF of each galaxy from the same components. Stars
are images of the PSF engine, made beforehand, at their places between pixels: pachon adds them as they are, GalSim
draws an InterpolatedImage. ``--whole`` also times a whole CCD with all galaxies on all processors, both ways.
"""

import argparse
import resource
import time

import galsim
import numpy as np

import pachon
from pachon import Window, draw_galaxies
from pachon.core.units import ARCSEC
from pachon.imaging.draw import add_stamps, grid_sizes
from pachon.imaging.scene import galaxies_near
from pachon.pipeline.simulate.ccd_exposure import expose_positions

CCD = "R22_S11"
RUN = {
    "ccds": (CCD,),
    "stars": {"truth": 100},
    "psf": {"stamp": 63},
    "atmosphere": {"screen_size": 1024, "screen_length_m": 560.0, "time_step_s": 0.25},
}


def timed(job) -> tuple[float, np.ndarray]:
    start = time.perf_counter()
    result = job()
    return time.perf_counter() - start, result


def galsim_image(galaxies, electrons, psf, wcs, sizes, pixels) -> np.ndarray:
    """Return the image of a CCD as GalSim draws it."""
    image = galsim.ImageF(wcs.shape[1], wcs.shape[0], xmin=0, ymin=0)
    jacobians = wcs.jacobians(pixels) * ARCSEC
    for i, (x, y) in enumerate(pixels):
        stamp = galsim.Image(psf.model.at((x, y))[0].astype(np.float32), scale=1.0)
        star = galsim.InterpolatedImage(stamp, normalization="flux")
        parts = []
        for j in range(galaxies.first[i], galaxies.first[i + 1]):
            # GalSim tabulates each index by itself; two digits keep its tables few, as its manual advises.
            part = galsim.Sersic(
                round(float(galaxies.sersic[j]), 2),
                half_light_radius=galaxies.component_radius[j] / ARCSEC,
                flux=electrons[i] * galaxies.fraction[j],
            )
            part = part.shear(g1=galaxies.e1[j], g2=galaxies.e2[j])
            parts.append(part.shift(galaxies.dx[j] / ARCSEC, galaxies.dy[j] / ARCSEC))
        # The Jacobian maps arcseconds of the sky to pixels; fluxes stay as they are.
        galaxy = galsim.Transform(
            galsim.Sum(parts), jac=jacobians[i], flux_ratio=1.0 / abs(np.linalg.det(jacobians[i]))
        )
        both = galsim.Convolve(galaxy, star)
        center = galsim.PositionD(x, y)
        size, (column, row) = int(sizes[i]), np.rint((x, y)).astype(int) - sizes[i] // 2
        bounds = galsim.BoundsI(column, column + size - 1, row, row + size - 1) & image.bounds
        if bounds.isDefined():
            both.drawImage(
                image[bounds], center=center, method="no_pixel", add_to_image=True, wcs=galsim.PixelScale(1.0)
            )
    return image.array


def galsim_stars(image, stamps, pixels) -> np.ndarray:
    """Draw stars with GalSim: stamps that hold them at their places between pixels, on the same number of pixels."""
    drawn = galsim.ImageF(image.shape[1], image.shape[0], xmin=0, ymin=0)
    half = stamps.shape[1] // 2
    for stamp, (x, y) in zip(stamps, np.rint(pixels).astype(int), strict=True):
        bounds = galsim.BoundsI(x - half, x + half, y - half, y + half) & drawn.bounds
        star = galsim.InterpolatedImage(galsim.Image(stamp, scale=1.0), normalization="flux")
        star.drawImage(drawn[bounds], center=galsim.PositionD(x, y), method="no_pixel", add_to_image=True)
    return drawn.array


def main() -> None:
    parser = argparse.ArgumentParser(description="Galaxies on a CCD, against GalSim.")
    parser.add_argument("--galaxies", type=int, default=300)
    parser.add_argument("--stars", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--whole", action="store_true", help="also time a whole CCD on all processors")
    arguments = parser.parse_args()
    print(f"pachon {pachon.__version__}, GalSim {galsim.__version__}, NumPy {np.__version__}; one thread each")
    experiment = pachon.Experiment.from_config(pachon.Configuration(**RUN))
    with experiment.screens():
        psf = pachon.imaging.PsfField.of_run(experiment, CCD)
        places = np.random.default_rng(2).uniform(100.0, 3990.0, (arguments.stars, 2))
        camera = experiment.camera
        positions = (places - 2047.5) * camera.pixel_size + camera.centers[camera.ccd_index(CCD)]
        stamps = expose_positions(experiment, positions, room=64, offsets=places - np.rint(places)).image
    wcs = pachon.ccd_wcs(experiment.telescope, experiment.camera, CCD)
    exposure = pachon.Exposure("r", 15.0)
    everything = Window(0, 0, *wcs.shape)
    population = pachon.GalaxyPopulation(29.0, seed=1)
    seconds, galaxies = timed(lambda: galaxies_near(population.galaxies_in, wcs, everything))
    pixels = wcs.to_pixel(np.stack([galaxies.xi, galaxies.eta], axis=1))
    inside = np.flatnonzero(everything.contains(pixels, -40))
    print(f"{len(galaxies)} galaxies to magnitude 29 on and around the CCD, drawn in {seconds:.2f} s")
    some = galaxies.take(np.sort(np.random.default_rng(1).choice(inside, arguments.galaxies, replace=False)))
    pixels = wcs.to_pixel(np.stack([some.xi, some.eta], axis=1))
    electrons = exposure.electrons(some.magnitude)
    scale = np.sqrt(np.abs(np.linalg.det(wcs.jacobians(pixels))))
    sizes = grid_sizes(some, electrons, scale, psf.profile(), exposure.noise_rms)

    def ours() -> np.ndarray:
        return draw_galaxies(some, electrons, psf, wcs, noise=exposure.noise_rms, threads=1)

    def theirs() -> np.ndarray:
        return galsim_image(some, electrons, psf, wcs, sizes, pixels)

    ours()
    ratios = []
    for _ in range(arguments.rounds):
        (a, image), (b, other) = timed(ours), timed(theirs)
        ratios.append(b / a)
        print(
            f"{arguments.galaxies} galaxies: pachon {a * 1e3 / arguments.galaxies:.3f} ms a galaxy, GalSim "
            f"{b * 1e3 / arguments.galaxies:.2f} ms, ratio {b / a:.1f}"
        )
    worst = np.abs(image - other).max()
    difference = (worst / image.max(), worst / exposure.noise_rms)
    print("largest difference {:.1e} of the peak, {:.1e} of the noise".format(*difference))
    print(f"ratio {np.median(ratios):.1f} (from {min(ratios):.1f} to {max(ratios):.1f})")
    ratios = []
    blank = np.zeros(wcs.shape, dtype=np.float32)
    corners = np.rint(places).astype(np.int64) - stamps.shape[1] // 2
    for _ in range(arguments.rounds):
        (a, _), (b, other) = (
            timed(lambda: add_stamps(blank, stamps, corners)),
            timed(lambda: galsim_stars(blank, stamps, places)),
        )
        ratios.append(b / a)
    ours_ms, theirs_ms = (t * 1e3 / len(stamps) for t in (a, b))
    print(f"{len(stamps)} stars: pachon {ours_ms:.3f} ms a star, GalSim {theirs_ms:.2f} ms")
    print(f"ratio {np.median(ratios):.0f} (from {min(ratios):.0f} to {max(ratios):.0f})")
    if arguments.whole:
        light = exposure.electrons(galaxies.magnitude)
        for way in ("direct", "eigen"):
            seconds, image = timed(
                lambda way=way: draw_galaxies(galaxies, light, psf, wcs, noise=exposure.noise_rms, way=way)
            )
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
            print(f"whole CCD, {way}: {seconds:.1f} s, peak memory of the process {peak:.2f} GiB")


if __name__ == "__main__":
    main()
