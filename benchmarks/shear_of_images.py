"""Bias of the shear of whole images: detection and blends in the response.

Run: python benchmarks/shear_of_images.py [--images N] [--realisations N] [--faintest M] [--radius R]

Discs of the population of the sky, 44 pixels in radius, stand apart on images under one PSF of telescope and atmosphere
and the noise of 100 visits. Each is sheared about its middle, galaxies and their places, by a shear and its opposite
with the same noise, and again rotated by 90 degrees. Peaks are detected on every image anew. With --radius 0 each disc
is one galaxy: detection alone.
"""

import argparse
import time
from dataclasses import replace

import numpy as np
from shear_estimator import SCALE, drawn, telescope_psfs

import pachon

STAMP = 64


class Discs:
    """Discs of the sky on a grid of places that are random to a pixel."""

    def __init__(self, radius: float, per_side: int, faintest: float, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.per_side, self.spacing = per_side, 2.0 * radius + 48.0
        self.side = int(per_side * self.spacing)
        tile = 2.0 * max(radius, 8.0) * SCALE
        galaxies = pachon.draw_galaxies(per_side * tile, faintest, seed)
        if radius == 0.0:
            galaxies = galaxies.take(rng.permutation(len(galaxies))[: per_side**2])
            column, row = np.divmod(np.arange(len(galaxies)), per_side)
            self.galaxies = replace(galaxies, xi=np.zeros(len(galaxies)), eta=np.zeros(len(galaxies)))
        else:
            from_corner = np.stack([galaxies.xi, galaxies.eta], axis=1) / tile + 0.5 * per_side
            cell = np.floor(from_corner).astype(int)
            place = (from_corner - cell - 0.5) * tile
            inside = (np.hypot(*place.T) < radius * SCALE) & ((cell >= 0) & (cell < per_side)).all(axis=1)
            column, row = cell[inside].T
            galaxies = galaxies.take(inside)
            self.galaxies = replace(galaxies, xi=place[inside, 0], eta=place[inside, 1])
        middles = (np.arange(per_side) + 0.5) * self.spacing
        shift = rng.uniform(-0.5, 0.5, (2, per_side, per_side))
        self.middle = np.stack([middles[column], middles[row]], axis=1) + shift[:, column, row].T

    def image(self, psf: np.ndarray, exposure: pachon.Exposure, turn: float, g: complex) -> np.ndarray:
        """Image without noise, the discs rotated and sheared about their middles."""
        galaxies = self.galaxies.rotated(turn, positions=True).sheared(g.real, g.imag, positions=True)
        places = np.stack([galaxies.xi, galaxies.eta], axis=1) / SCALE + self.middle
        corners, electrons = np.rint(places).astype(int), exposure.electrons(galaxies.magnitude)
        image = np.zeros((self.side + 2 * STAMP,) * 2)
        for rows in np.array_split(np.arange(len(galaxies)), max(1, len(galaxies) // 512)):
            stamps = drawn(galaxies.take(rows), places[rows] - corners[rows], psf[None], np.zeros(len(rows), int))
            for row, stamp in zip(rows, stamps, strict=True):
                x, y = corners[row] + STAMP // 2
                image[y : y + STAMP, x : x + STAMP] += electrons[row] * stamp
        return image[STAMP:-STAMP, STAMP:-STAMP]

    def row_of(self, y: np.ndarray) -> np.ndarray:
        """Row of discs of each place."""
        return np.minimum((y / self.spacing).astype(int), self.per_side - 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--discs", type=int, default=12, help="along a side of an image")
    parser.add_argument("--realisations", type=int, default=4, help="of the noise of each image, an even number")
    parser.add_argument("--faintest", type=float, default=26.5)
    parser.add_argument("--radius", type=float, default=44.0, help="of the discs [pixel]")
    parser.add_argument("--shear", type=float, default=0.01)
    parser.add_argument("--min-snr", type=float, default=10.0)
    parser.add_argument("--visits", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    exposure, psf = pachon.Exposure(exposures=arguments.visits), telescope_psfs(2)[1]
    noise, parts, labels = exposure.noise_rms, {1: [], -1: []}, {1: [], -1: []}
    start, peaks, galaxies = time.perf_counter(), 0.0, 0
    for number in range(arguments.images):
        discs = Discs(arguments.radius, arguments.discs, arguments.faintest, arguments.seed + number)
        galaxies += len(discs.galaxies)
        direction = (1.0, 1j)[number % 2]
        for turn in range(2):
            for sign in (1, -1):
                clean = discs.image(psf, exposure, 0.5 * np.pi * turn, sign * arguments.shear * complex(direction))
                for k in range(max(1, arguments.realisations)):
                    rng = np.random.default_rng([arguments.seed, number, k // 2])
                    image, seed = clean, None
                    if arguments.realisations:
                        seed = arguments.seed + 1000 * number + k
                        image = clean + (-1) ** k * noise * rng.standard_normal(clean.shape)
                    found = pachon.measure.detect_shear(
                        image, psf, SCALE, noise, seed=seed,
                        min_snr=arguments.min_snr, threads=1,
                    )  # fmt: skip
                    parts[sign].append(found.shapes)
                    labels[sign].append(number * arguments.discs + discs.row_of(found.y))
                    peaks += float(found.weight.sum())
        if number % 2 or number + 1 == arguments.images:
            show(arguments, parts, labels, f"{number + 1} images, {galaxies} galaxies to {arguments.faintest}", peaks)
    print(f"{time.perf_counter() - start:.0f} s")


def show(arguments, parts: dict, labels: dict, heading: str, peaks: float) -> None:
    """Print the bias of the images so far, of which every other one is sheared along x = y."""
    plus, minus = (type(parts[1][0]).joined(parts[sign]) for sign in (1, -1))
    patch, minus_patch = (np.concatenate(labels[sign]) for sign in (1, -1))
    image_of_patch = np.union1d(patch, minus_patch) // arguments.discs
    directions = arguments.shear * np.eye(2)[image_of_patch % 2]
    bias = pachon.measure.shear_bias(plus, minus, *directions.T, patch=patch, minus_patch=minus_patch)
    print(f"{heading}, {peaks:.0f} peaks above S/N {arguments.min_snr:g}, g = {arguments.shear}")
    print(f"m = {bias.m.mean():+.4f} +- {0.5 * np.hypot(*bias.m_error):.4f}; {bias}", flush=True)


if __name__ == "__main__":
    main()
