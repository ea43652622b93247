"""Time to make six phase screens of 8192 x 8192 over 1.3 km, beside GalSim's.

Run: python benchmarks/screens_vs_galsim.py [--size N] [--length METRES]

Layer by layer the two take turns in one process, under the same load of the machine. Both make the modes of geometric
shooting and no more, each up to its own cut-off (printed; pachon's is the higher one). GalSim's screens hold the
path in double precision; pachon's hold both slopes, in 16 bits each, as its fast engine reads them. pachon's high
screen of each layer, which only its wave engine reads, is timed apart and then counted in. GalSim works on one thread;
pachon is shown on one and on two. Ratios are GalSim's time over pachon's.
"""

import argparse
import time

import galsim
import numpy as np

import pachon
from pachon import Atmosphere, ScreenSampling

WAVELENGTH = 620.0


def timed(job) -> float:
    start = time.perf_counter()
    job()
    return time.perf_counter() - start


def galsim_cutoff(atmosphere: Atmosphere) -> float:
    """Return the cut-off of GalSim's PhaseScreenPSF for photon shooting [cycles/m]: 0.2 over the Fried parameter."""
    return 0.2 / (atmosphere.r0 * (WAVELENGTH / 500.0) ** 1.2)


def galsim_screen(atmosphere: Atmosphere, layer: int) -> None:
    screen = galsim.AtmosphericScreen(
        screen_size=atmosphere.screen_length,
        screen_scale=atmosphere.screen_pixel,
        altitude=atmosphere.altitudes[layer] / 1e3,
        r0_500=atmosphere.r0 * atmosphere.weights[layer] ** -0.6,
        L0=atmosphere.outer_scale,
        vx=atmosphere.velocities[layer, 0],
        vy=atmosphere.velocities[layer, 1],
        rng=galsim.BaseDeviate(layer + 1),
    )
    screen.instantiate(kmax=galsim_cutoff(atmosphere))
    assert screen.npix == atmosphere.screen_size, "GalSim rounds its screens up to 2^n or 3 x 2^n samples"


def main() -> None:
    parser = argparse.ArgumentParser(description="Making phase screens, against GalSim.")
    parser.add_argument("--size", type=int, default=8192, help="samples on a side: 2^n or 3 x 2^n")
    parser.add_argument("--length", type=float, default=1300.0, help="side in metres")
    arguments = parser.parse_args()
    # Slightly less than the side: one sample more by rounding would double GalSim's grid.
    length = arguments.length * (1.0 - 1e-12)
    atmosphere = Atmosphere.from_site(
        "cerro_pachon", 1, screens=ScreenSampling(screen_size=arguments.size, screen_length=length)
    )
    print(
        f"pachon {pachon.__version__}, GalSim {galsim.__version__}; {atmosphere.layer_count} screens of"
        f" {arguments.size}^2 over {arguments.length:g} m, high screens of {atmosphere.fine_size}^2"
    )
    theirs = 2.0 * np.pi * galsim_cutoff(atmosphere)
    print(f"modes up to {atmosphere.cutoff:.2f} rad/m (pachon), {theirs:.2f} rad/m (GalSim)")
    out = np.empty((arguments.size, arguments.size), dtype=np.int32)
    times: dict[str, list[float]] = {name: [] for name in ("galsim", "one", "two", "high", "high two")}
    with galsim.utilities.single_threaded():
        for layer in range(atmosphere.layer_count):
            for name, threads in (("one", 1), ("two", 2)):
                times[name].append(timed(lambda n=layer, t=threads: atmosphere.slope_screen(n, threads=t, out=out)))
            times["galsim"].append(timed(lambda n=layer: galsim_screen(atmosphere, n)))
            for name, threads in (("high", 1), ("high two", 2)):
                times[name].append(timed(lambda n=layer, t=threads: atmosphere.high_screen(n, threads=t)))
    table = {name: np.array(values) for name, values in times.items()}
    print(f"GalSim  {np.median(table['galsim']):7.2f} s a screen, {table['galsim'].sum():7.1f} s for all, one thread")
    for name, label in (("one", "one thread"), ("two", "two threads")):
        high = table["high" if name == "one" else "high two"]
        low, both = table[name], table[name] + high
        print(
            f"pachon  {np.median(low):7.2f} s a screen, {low.sum():7.1f} s for all, {label}"
            f" (high screens {high.sum():.1f} s more)"
        )
        for text, ours in (("slopes", low), ("slopes and high screens", both)):
            ratios = table["galsim"] / ours
            print(
                f"ratio   {np.median(ratios):7.1f} (from {ratios.min():.1f} to {ratios.max():.1f}), {label}, {text};"
                f" all six {table['galsim'].sum() / ours.sum():.1f}"
            )


if __name__ == "__main__":
    main()
