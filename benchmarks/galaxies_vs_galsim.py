"""Fourier transforms of galaxies: pachon against GalSim, accuracy and time.

    python benchmarks/galaxies_vs_galsim.py

Prints transforms of random galaxies per second on 48 x 48 pixels of 0.2 arcsec, GalSim's on one thread between them,
the greatest difference of both, and the time to draw the galaxies of one CCD of the LSST to 29. Half a minute.
"""

import argparse
import os
import platform
import time

import galsim
import numpy as np
import warp as wp

import pachon
from pachon.core.units import ARCMIN, ARCSEC
from pachon.sky.sersic import sersic_table

SIZE = 48
PIXEL = 0.2 * ARCSEC
COUNT, PEER_COUNT = 6000, 30


def of_pachon(galaxies, threads):
    n = len(galaxies)
    jacobian = np.broadcast_to(np.eye(2) / PIXEL, (n, 2, 2))
    return galaxies.transform(np.arange(n), jacobian, np.zeros((n, 2)), SIZE, threads=threads)


def of_galsim(galaxies):
    """Return GalSim's transforms of the same frequencies, drawn as images in k."""
    step = 2.0 * np.pi / (SIZE * PIXEL)
    result = []
    for i in range(len(galaxies)):
        parts = []
        for c in range(galaxies.first[i], galaxies.first[i + 1]):
            part = galsim.Sersic(galaxies.sersic[c], half_light_radius=galaxies.component_radius[c])
            part = part.shear(g1=galaxies.e1[c], g2=galaxies.e2[c]).shift(galaxies.dx[c], galaxies.dy[c])
            parts.append(part.withFlux(galaxies.fraction[c]))
        image = galsim.ImageCD(galsim.BoundsI(0, SIZE // 2, -SIZE // 2, SIZE // 2 - 1), scale=step)
        result.append(np.fft.ifftshift(galsim.Sum(parts).drawKImage(image=image, recenter=False).array, axes=0))
    return np.array(result)


def main():
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print(f"pachon {pachon.__version__}, GalSim {galsim.__version__}, Warp {wp.__version__}, NumPy {np.__version__},")
    print(f"{platform.machine()}, {os.cpu_count()} processors; galaxies to 27, components counted together")
    start = time.perf_counter()
    sersic_table.__wrapped__()
    print(f"table of Sersic transforms: {1e3 * (time.perf_counter() - start):.0f} ms")
    galaxies = pachon.draw_galaxies(5.0 * ARCMIN, 27.0, 1, brightest=22.0).take(slice(COUNT))
    few = galaxies.take(slice(PEER_COUNT))
    # GalSim makes a table for every new Sersic index: other galaxies each time.
    fresh = iter([galaxies.take(slice(i * PEER_COUNT, (i + 1) * PEER_COUNT)) for i in range(1, 6)])
    of_pachon(few, 1)
    best = {}
    for _ in range(5):
        for name, call, n in (
            ("pachon, 1 thread", lambda: of_pachon(galaxies, 1), COUNT),
            ("pachon, 2 threads", lambda: of_pachon(galaxies, 2), COUNT),
            ("GalSim", lambda: of_galsim(next(fresh)), PEER_COUNT),
        ):
            start = time.perf_counter()
            call()
            best[name] = max(best.get(name, 0.0), n / (time.perf_counter() - start))
    print(f"{galaxies.first[-1] / COUNT:.2f} components a galaxy")
    for name, rate in best.items():
        print(f"{name:18s} {rate:8.0f} galaxies a second, {rate / best['GalSim']:.0f} times GalSim")
    print(f"greatest difference: {np.abs(of_pachon(few, 1) - of_galsim(few)).max():.1e} of the flux")
    start = time.perf_counter()
    ccd = pachon.draw_galaxies(6.8 * ARCMIN, 29.0, 1)
    print(f"{len(ccd)} galaxies of one CCD to 29 drawn in {time.perf_counter() - start:.2f} s")


if __name__ == "__main__":
    main()
