"""The PSF model beside Piff on the stars of a run: errors of e and size at holdout positions, and time.

Run: python benchmarks/psf_model_vs_piff.py RUN [--order N] [--size N] [--ccds N]

RUN is the folder of a `pachon run` without options: its observed stars, 31 x 31 pixels, centred to a pixel, and its
noise-free PSFs at holdout positions on the same CCDs. Piff fits the same stamps, with the inverse variance of their
noise as weights, by PixelGrid of pixels of the same scale and BasisPolynomial of the same order. Both are then drawn at
the holdout positions, centred, and measured as the noise-free PSFs are. pachon runs without weights, as in Jee & Tyson
2011, with the stars' squared S/N as weights, which is nearer to Piff's, and by kriging, which has no order to choose.
The fits are timed alone, from stamps in
memory to a model in memory, in one process, in turns, one thread.
"""

import argparse
import time
from pathlib import Path

import galsim
import numpy as np
import piff
from threadpoolctl import threadpool_limits

import pachon
from pachon import measure_shapes
from pachon.core.units import ARCSEC
from pachon.reconstruction.ccd_product import read_product

PIXEL = 10.0e-6  # side of a pixel [m]
WEIGHT = 0.7 * ARCSEC
# Piff's polynomials are powers of its own world coordinates: these run from -1 to 1 over a CCD of 4000 pixels, so that
# the powers lose no digits.
WCS = galsim.PixelScale(1.0 / 2000.0)


def pixels(stars, product) -> list[tuple[int, int]]:
    """Return the pixels that stars lie on, from the centre of the CCD."""
    x, y = ((values - centre) / PIXEL for values, centre in zip((stars.x, stars.y), product.center, strict=True))
    return [(round(a), round(b)) for a, b in zip(x, y, strict=True)]


def piff_stars(product) -> list[piff.Star]:
    """Return the stars that the model was fitted to, as Piff's."""
    stars = product.observed
    median = np.median(product.observed_images[stars.used].astype(np.float64), axis=0)
    sky, noise = product.noise
    places, result = pixels(stars, product), []
    for i in np.flatnonzero(stars.used):
        electrons = stars.electrons[i]
        variance = (sky + noise**2 + electrons * np.maximum(median, 0.0)) / electrons**2
        # The stamp was shifted to put the star at the centre of its pixel.
        corner = {"xmin": places[i][0] - median.shape[1] // 2, "ymin": places[i][1] - median.shape[0] // 2}
        image = galsim.ImageD(product.observed_images[i].astype(np.float64), wcs=WCS, **corner)
        weight = galsim.ImageD(1.0 / variance, wcs=WCS, **corner)
        result.append(piff.Star(piff.StarData(image, galsim.PositionD(*places[i]), weight), None))
    return result


def fit_piff(stars: list[piff.Star], size: int, order: int) -> piff.SimplePSF:
    psf = piff.SimplePSF(piff.PixelGrid(WCS.scale, size), piff.BasisPolynomial(order))
    psf.set_context({0: WCS}, None)
    psf.fit(stars)
    return psf


def draw_piff(psf: piff.SimplePSF, product, size: int) -> np.ndarray:
    places = pixels(product.holdout, product)
    return np.stack([psf.draw(x, y, center=True, stamp_size=size).array for x, y in places])


def residuals(images: np.ndarray, product) -> np.ndarray:
    """Return e1, e2 and relative size of drawn PSFs less those of the noise-free ones, shape [3, n]."""
    drawn, expected = measure_shapes(images, product.pixel_scale, WEIGHT), product.holdout
    return np.stack([drawn.e1 - expected.e1, drawn.e2 - expected.e2, drawn.size / expected.size - 1.0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--order", type=int, default=3, help="of the polynomials of both")
    parser.add_argument("--size", type=int, default=25, help="pixels along Piff's grid, 25 as in the LSST pipelines")
    parser.add_argument("--ccds", type=int, default=9)
    arguments = parser.parse_args()
    order, size = arguments.order, arguments.size
    paths = sorted(arguments.run.glob("ccd_*.fits"))[: arguments.ccds]
    print(f"pachon {pachon.__version__}, Piff {piff.__version__}, order {order}, Piff's grid {size} x {size}")
    print("rms of e and of size, each: pachon without weights, with weights (S/N)^2, by kriging; Piff")
    fits = {name: [] for name in ("plain", "weighted", "kriging", "Piff")}
    times = dict.fromkeys(fits, 0.0)
    for path in paths:
        product = read_product(path)
        used = product.observed.used
        stamps = product.observed_images[used].astype(np.float64)
        places = np.stack([product.observed.x, product.observed.y], axis=1)[used]
        elsewhere = np.stack([product.holdout.x, product.holdout.y], axis=1)
        stars, options = piff_stars(product), {"recipe": "paper", "order": order, "extent": product.model.extent}
        weights, electrons = product.observed.snr[used] ** 2, product.observed.electrons[used, None, None]
        kriged = {"extent": product.model.extent}
        jobs = {
            "plain": lambda o=options, s=stamps, p=places: pachon.PsfModel.fit(s, p, **o),
            "weighted": lambda o=options, s=stamps, p=places, w=weights: pachon.PsfModel.fit(s, p, weights=w, **o),
            "kriging": lambda o=kriged, s=stamps * electrons, p=places: pachon.PsfModel.fit(s, p, **o),
            "Piff": lambda s=stars: fit_piff(s, size, order),
        }
        if path == paths[0]:
            jobs["plain"]()  # first calls load libraries
        for name, job in jobs.items():
            start = time.perf_counter()
            model = job()
            times[name] += time.perf_counter() - start
            drawn = draw_piff(model, product, stamps.shape[1]) if name == "Piff" else model.at(elsewhere)
            fits[name].append(residuals(drawn, product))
        print(f"{product.name:8s} {used.sum():3d} stars: {_row([each[-1] for each in fits.values()])}", flush=True)
    print(f"all: {_row([np.concatenate(each, axis=1) for each in fits.values()])}")
    print("time of a fit: " + ", ".join(f"{name} {1e3 * t / len(paths):.0f} ms" for name, t in times.items()))
    ratios = ", ".join(f"{name} {times['Piff'] / t:.0f}" for name, t in times.items() if name != "Piff")
    print(f"Piff's time over pachon's: {ratios}")


def _row(errors: list[np.ndarray]) -> str:
    """Return the rms of e, and of size, of each model."""
    parts = (slice(0, 2), slice(2, 3))
    return "; ".join(" ".join(f"{np.sqrt(np.nanmean(e[part] ** 2)):.2e}" for e in errors) for part in parts)


if __name__ == "__main__":
    with threadpool_limits(limits=1):
        main()
