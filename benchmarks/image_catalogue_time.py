"""Time from an image of a CCD to fitted galaxies: detection, star selection, PSF model, fits.

Run: python benchmarks/image_catalogue_time.py [--tiles N]

A tile of 512 x 512 pixels holds 169 Gaussians of random places, a third of them stars; N x N of them, under different
noise, are an image: 8 for the 4096 x 4096 pixels of a CCD.
"""

import argparse
import resource
import time

import numpy as np

import pachon

SIDE, STAR, SKY = 512, 1.5, 100.0  # pixels, rms width of a star [pixel], electrons


def make_tile(rng: np.random.Generator) -> np.ndarray:
    """Return the light of one tile [electrons]."""
    yy, xx = np.indices((SIDE, SIDE))
    at = np.arange(28, SIDE, 38)
    light = np.zeros((SIDE, SIDE))
    for i, (x, y) in enumerate(np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2) + rng.uniform(-4, 4, (169, 2))):
        a, c = (STAR**2, STAR**2) if i % 3 == 0 else STAR**2 + rng.uniform(1.0, 6.0, 2)
        flux = np.exp(rng.uniform(8.5, 11.0))
        light += flux / (2.0 * np.pi * np.sqrt(a * c)) * np.exp(-0.5 * ((xx - x) ** 2 / a + (yy - y) ** 2 / c))
    return light


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tiles", type=int, default=8)
    tiles = parser.parse_args().tiles
    rng = np.random.default_rng(1)
    variance = np.tile(make_tile(rng), (tiles, tiles)) + SKY
    image = variance + rng.normal(size=variance.shape) * np.sqrt(variance)
    print(f"pachon {pachon.__version__}, image of {image.shape[1]} x {image.shape[0]} pixels")
    start = time.perf_counter()
    objects = pachon.detect_objects(image, variance)
    print(f"detection and photometry: {len(objects)} objects, {time.perf_counter() - start:.1f} s")
    start = time.perf_counter()
    stars = pachon.select_stars(objects, image)
    print(f"star selection: {len(stars)} stars, {time.perf_counter() - start:.1f} s")
    start = time.perf_counter()
    model = pachon.PsfModel.fit(stars.stamps, stars.positions, n_components=3, order=1)
    psfs = model.at(np.stack([objects.x, objects.y], axis=1))
    print(f"PSF model, drawn at every object: {time.perf_counter() - start:.1f} s")
    start = time.perf_counter()
    fits = pachon.fit_galaxies(
        image - objects.background,
        variance,
        objects.x,
        objects.y,
        psfs,
        half_light_radius=objects.half_light_radius,
        segmentation=objects.segmentation,
    )
    print(f"fits: {time.perf_counter() - start:.1f} s, {fits.good.mean():.0%} without flags")
    print(f"peak memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GiB")


if __name__ == "__main__":
    main()
