"""Effect of silicon on the PSF of the LSST, and its cost in computing time.

    python benchmarks/silicon.py

Prints absorption and focus against wavelength, sizes and ellipticities of cool and hot stars in r, z and y with and
without silicon, in focus at its surface and refocused, and the processor time of the engines and of the OPD with and
without it. Some ten minutes; `python benchmarks/silicon.py times` prints the last alone.
"""

import argparse
import platform
import time

import numpy as np

import pachon
from pachon import fields_at
from pachon.core.units import ARCSEC

SILICON = pachon.models.Silicon()
#: Blackbodies of a cool and a hot star [K].
STARS = {"3500 K": 3500.0, "10000 K": 10000.0}
WEIGHT = 0.7 * ARCSEC


def spectrum(band, temperature, count=5):
    """Wavelengths of equal numbers of photons of a blackbody within a band [m]."""
    wavelength = np.linspace(*band, 2001)
    photons = pachon.blackbody_photons(temperature, wavelength)[0]
    below = np.concatenate([[0.0], np.cumsum(0.5 * (photons[1:] + photons[:-1]))])
    return np.interp((np.arange(count) + 0.5) / count, below / below[-1], wavelength)


def stars_over_the_field(telescope, count=40):
    """Field angles of CCDs from the centre to the edge."""
    centers = pachon.lsst_camera().centers
    return fields_at(telescope, centers[np.linspace(0, len(centers) - 1, count).astype(int)] + 5e-3)


def absorption():
    print("wavelength   index  absorption  absorbed  equivalent defocus       refocused at")
    print("      [nm]           length [um]           mean, rms [um]           height [um]")
    telescope = pachon.load_telescope("lsst_v3.3_r")
    for nanometres in (400, 620, 754, 870, 970, 1000, 1050):
        light = nanometres * 1e-9
        mean, rms = SILICON.defocus(light)
        model = telescope if nanometres < 700 else pachon.load_telescope("lsst_v3.3_y")
        print(
            f"{nanometres:10d} {SILICON.index(light):7.3f} {1e6 * SILICON.absorption_length(light):11.2f}"
            f" {SILICON.absorbed(light):9.3f} {1e6 * mean:11.2f} {1e6 * rms:6.2f}"
            f" {1e6 * pachon.wavefront.focus_height(model, SILICON, light):16.2f}"
        )


def shapes(telescope, wavelengths, silicon):
    psfs = pachon.make_psfs(
        telescope,
        stars_over_the_field(telescope),
        wavelengths,
        atmosphere=pachon.Atmosphere.from_site("cerro_pachon", seed=0),
        engine="long_exposure",
        stamps=pachon.Stamps(silicon=silicon),
    )
    found = pachon.measure_shapes(psfs.image, psfs.pixel_scale, WEIGHT)
    return np.stack([found.e1, found.e2]), found.size / ARCSEC, psfs.inside.mean()


def colours():
    print("\nband  star      silicon   mean size [arcsec]  rms e     charge a photon")
    for band in "rzy":
        telescope = pachon.load_telescope(f"lsst_v3.3_{band}")
        middle = 0.5 * sum(telescope.band)
        height = pachon.wavefront.focus_height(telescope, SILICON, middle)
        refocused = telescope.perturbed("Detector", shift=(0.0, 0.0, height))
        kept = {}
        for model, name, silicon in (
            (telescope, "none", None),
            (telescope, "in focus at the surface", SILICON),
            (refocused, "refocused", SILICON),
        ):
            for star, temperature in STARS.items():
                e, size, inside = shapes(model, spectrum(telescope.band, temperature), silicon)
                kept[star] = e, size
                rms = np.sqrt((e**2).sum(axis=0).mean())
                print(f"{band:5} {star:9} {name:24} {size.mean():.5f}  {rms:.2e}  {inside:.3f}")
            (cool, cool_size), (hot, hot_size) = kept.values()
            difference = np.sqrt(((cool - hot) ** 2).sum(axis=0).mean())
            print(
                f"{band:5} cool - hot: size {100 * (cool_size / hot_size - 1.0).mean():+.2f} %, e {difference:.1e} rms"
            )


def times():
    print("\nprocessor time a star, five wavelengths, one thread [ms]: without, with silicon, ratio")
    screens = pachon.ScreenSampling(screen_size=2048, screen_length=327.68)
    long = pachon.Atmosphere.from_site("cerro_pachon", seed=2, screens=screens)
    # The wave engine takes its screens whole, and seconds a star.
    short = pachon.Atmosphere.from_site("cerro_pachon", seed=2, exposure=7.0, screens=screens)
    for band in "rizy":
        telescope = pachon.load_telescope(f"lsst_v3.3_{band}")
        light = np.linspace(*telescope.band, 5)
        for engine, atmosphere, count, repeats in (
            ("long_exposure", long, 300, 7),
            ("fast", long, 60, 5),
            ("fast", None, 8, 5),
            ("wave", None, 1, 2),
            ("wave", short, 1, 1),
        ):
            fields = stars_over_the_field(telescope, count)
            spent = {None: [], SILICON: []}
            for _ in range(repeats + 1):
                for silicon, seconds in spent.items():
                    start = time.process_time()
                    pachon.make_psfs(
                        telescope,
                        fields,
                        light,
                        atmosphere=atmosphere,
                        threads=1,
                        engine=engine,
                        stamps=pachon.Stamps(silicon=silicon),
                    )
                    seconds.append(1e3 * (time.process_time() - start) / count)
            off, on = (min(seconds[1:]) for seconds in spent.values())
            name = engine + (" without air" if atmosphere is None else "")
            print(f"{band}  {name:18} {off:9.2f} {on:9.2f} {on / off:6.2f}", flush=True)
        opd_times(band, telescope)


def opd_times(band, telescope):
    field, light = np.deg2rad([0.5, 0.6]), 0.5 * sum(telescope.band)
    spent = {None: [], SILICON: []}
    for _ in range(8):
        for silicon, seconds in spent.items():
            start = time.process_time()
            for _ in range(20):
                pachon.wavefront_opd(telescope, field, light, silicon=silicon, threads=1)
            seconds.append(1e3 * (time.process_time() - start) / 20)
    off, on = (min(seconds[1:]) for seconds in spent.values())
    print(f"{band}  {'OPD of a field':18} {off:9.2f} {on:9.2f} {on / off:6.2f}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("only", nargs="?", choices=["times"], help="print the processor time alone")
    only = parser.parse_args().only
    print(f"pachon {pachon.__version__}, Python {platform.python_version()}, {platform.machine()}\n")
    if only is None:
        absorption()
        colours()
    times()
