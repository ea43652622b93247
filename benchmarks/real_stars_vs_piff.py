"""Held-out stars of a real image: pachon's default PSF model beside Piff's PixelGrid at orders 0 to 2.

Run: python benchmarks/real_stars_vs_piff.py STARS [--pixel-arcsec S] [--gain G] [--size N] [--seeds N] [--folds N]

STARS is a table as of `pachon model`. Pixels without weight, copies of dead columns, neighbours and cosmic rays have no
weight for both. In turns, both fit the same four fifths of the stars and predict the others: pachon by `fit_own_stars`
without options, Piff by PixelGrid with pixels of the image's scale and BasisPolynomial, with the inverse variance of
the sky as weights. At each star that was held out the flux and the centre of either model are fitted to the good pixels
within 10 pixels, with the noise of sky and star; chi-square a pixel is that of the residual. e and T are those of star
and model under the same weight. Errors are those of the mean over stars, of each star's mean over the seeds. Times
are of one thread, of the processor: `fit_own_stars` selects and centres stars besides, and predicts each fifth of
them by the others only when that is read; `PsfModel.fit` makes one model, as Piff does. Ratios are medians over the
splits, of fits in turns: to one fit of Piff at the order that is its best by a figure, which nobody knows beforehand,
and to its fits at all orders, as our model chooses its own.
"""

import argparse
import time
import warnings
from collections import defaultdict
from pathlib import Path

import galsim
import numpy as np
import piff
from threadpoolctl import threadpool_limits

import pachon
from pachon.core.units import ARCSEC
from pachon.measure.pixel_masks import bad_pixels, copied_pixels
from pachon.measure.rho_statistics import trace_of_moments
from pachon.measure.shapes import fwhm
from pachon.measure.stamps import decenter_masks, fourier_shift
from pachon.reconstruction.own_stars.masked_stars import fill_by_median_star, sky_of_stamps

ORDERS = (0, 1, 2)
OURS = "pachon"
RADIUS, STEPS = 10.0, 4


class Stars:
    """Stars with their noise, without what has no weight, and their shapes."""

    def __init__(self, stamps: np.ndarray, positions: np.ndarray, scale: float, gain: float) -> None:
        bad = bad_pixels(stamps)
        bad |= copied_pixels(np.where(bad, 0.0, stamps))
        self.positions, self.scale, self.gain, self.side = positions, scale, gain, stamps.shape[1]
        level, rms = sky_of_stamps(stamps, bad, 0.4 * self.side)
        images = np.where(bad, 0.0, stamps - level[:, None, None])
        self.weight_fwhm = float(np.median(fwhm(images, scale)))
        first = fill_by_median_star(images, bad, scale, self.weight_fwhm)
        size = self.side - 4 - (self.side + 1) % 2
        centred = pachon.measure.center_stamps(first.images, first.x, first.y, size, normalize=False)
        selection = pachon.measure.flag_stars(centred, rms, gain=gain)
        bad |= decenter_masks(selection.masks, first.x, first.y, images.shape[1:])
        level, self.rms = sky_of_stamps(stamps, bad, 0.4 * self.side)
        self.bad, self.images = bad, np.where(bad, np.nan, stamps - level[:, None, None])
        self.shapes = pachon.measure_shapes(self.images, scale, self.weight_fwhm)

    def fit_ours(self, train: np.ndarray, size: int) -> pachon.reconstruction.OwnStars:
        return pachon.fit_own_stars(
            self.images[train], self.positions[train], self.scale, size=size, gain=self.gain, min_snr=1.0
        )

    def piff_stars(self, train: np.ndarray) -> list[piff.Star]:
        stars, half = [], self.side // 2
        for i in train:
            x, y = np.rint(self.positions[i]).astype(int).tolist()
            corner = {"xmin": x - half, "ymin": y - half, "wcs": self.wcs}
            image = galsim.ImageD(np.where(self.bad[i], 0.0, self.images[i]), **corner)
            weight = galsim.ImageD(np.where(self.bad[i], 0.0, self.rms[i] ** -2.0), **corner)
            centre = galsim.PositionD(x + self.shapes.x[i], y + self.shapes.y[i])
            stars.append(piff.Star(piff.StarData(image, centre, weight), None))
        return stars

    @property
    def wcs(self) -> galsim.PixelScale:
        # Piff's polynomials are powers of its world coordinates: these run over a few units across a CCD.
        return galsim.PixelScale(1.0 / 2000.0)

    def residuals(self, i: int, model: np.ndarray) -> tuple[float, float, float, float]:
        """Return chi-square a pixel, e1, e2 and relative T of a star less those of a model, centred on its pixel."""
        padded = np.zeros((self.side, self.side))
        first, size = self.side // 2 - model.shape[0] // 2, model.shape[0]
        padded[first : first + size, first : first + size] = model
        middle = self.side // 2 - (self.side - 1) / 2.0
        y, x = np.indices(padded.shape) - (self.side - 1) / 2.0
        centre = np.array([self.shapes.x[i], self.shapes.y[i]])
        good = ~self.bad[i] & (np.hypot(x - centre[0], y - centre[1]) < RADIUS)
        variance = np.full(padded.shape, self.rms[i] ** 2)
        for _ in range(STEPS):
            shifted = fourier_shift(padded, *(centre - middle))
            gradient = [(np.roll(shifted, 1, axis=axis) - np.roll(shifted, -1, axis=axis)) / 2.0 for axis in (1, 0)]
            terms = np.stack([shifted[good], *(g[good] for g in gradient)], axis=1)
            error = np.sqrt(variance[good])
            flux, dx, dy = np.linalg.lstsq(terms / error[:, None], self.images[i][good] / error, rcond=None)[0]
            centre = centre + np.clip(np.array([dx, dy]) / flux, -0.3, 0.3)
            variance = self.rms[i] ** 2 + np.maximum(flux * shifted, 0.0) / self.gain
        chi2 = ((self.images[i] - flux * shifted)[good] ** 2 / variance[good]).sum() / (good.sum() - 3)
        shape = pachon.measure_shapes(model, self.scale, self.weight_fwhm)
        star = self.shapes
        trace = trace_of_moments(star.size[i], star.e1[i], star.e2[i])
        model_trace = trace_of_moments(shape.size[0], shape.e1[0], shape.e2[0])
        return chi2, star.e1[i] - shape.e1[0], star.e2[i] - shape.e2[0], 1.0 - model_trace / trace


def compare(stars: Stars, size: int, seed: int, folds: int, residuals: dict, times: dict) -> None:
    """Fit and predict in folds; append each star's residuals and the times of the fits."""
    order = np.random.default_rng(seed).permutation(len(stars.positions))
    places = np.rint(stars.positions).astype(int)
    for held_out in np.array_split(order, folds):
        train = np.setdiff1d(order, held_out)
        start = time.process_time()
        own = stars.fit_ours(train, size)
        times["fit_own_stars"].append(time.process_time() - start)
        start = time.process_time()
        pachon.PsfModel.fit(own.stamps * 1e4, own.positions[own.used], masks=own.masks if own.masks.any() else None)
        times["PsfModel.fit"].append(time.process_time() - start)
        for star, model in zip(held_out, own.model.at(stars.positions[held_out]), strict=True):
            residuals[OURS][star].append(stars.residuals(star, model))
        for n in ORDERS:
            psf = piff.SimplePSF(piff.PixelGrid(stars.wcs.scale, size), piff.BasisPolynomial(n))
            psf.set_context({0: stars.wcs}, None)
            start = time.process_time()
            psf.fit(stars.piff_stars(train))
            times[f"Piff, order {n}"].append(time.process_time() - start)
            for star in held_out:
                model = psf.draw(*places[star].tolist(), center=True, stamp_size=size).array
                residuals[f"Piff, order {n}"][star].append(stars.residuals(star, model / model.sum()))


def show(residuals: dict, times: dict) -> None:
    """Print the table, and the differences from Piff at its best order."""
    means = {name: np.array([np.mean(values[s], axis=0) for s in sorted(values)]) for name, values in residuals.items()}
    for name, values in means.items():
        e, growth = values[:, 1:3], values[:, 3]
        # A star whose moments fail has none for any model.
        e, growth = e[np.isfinite(e).all(axis=1)], growth[np.isfinite(growth)]
        print(
            f"  {name:14s} chi2/pixel {values[:, 0].mean():.3f}, median {np.median(values[:, 0]):.3f}; "
            f"rms e {np.sqrt((e**2).mean()):.5f}, rms dT/T {np.sqrt((growth**2).mean()):.5f}"
        )
    theirs, best_by = [name for name in means if name != OURS], {}
    for label, figure in (
        ("chi2/pixel", lambda v: v[:, 0]),
        ("e^2 [1e-6]", lambda v: 1e6 * np.square(v[:, 1:3]).mean(axis=1)),
        ("(dT/T)^2 [1e-6]", lambda v: 1e6 * np.square(v[:, 3])),
    ):
        best = min(theirs, key=lambda name: np.nanmean(figure(means[name])))
        best_by.setdefault(best, label)
        difference = figure(means[OURS]) - figure(means[best])
        difference = difference[np.isfinite(difference)]
        error = difference.std(ddof=1) / np.sqrt(len(difference))
        print(f"  {label}: pachon less {best}, its best: {difference.mean():+.3f} +- {error:.3f}")
    print("  seconds a fit: " + ", ".join(f"{name} {np.median(values):.2f}" for name, values in times.items()))
    all_orders = np.sum([times[name] for name in theirs], axis=0)
    for name in ("fit_own_stars", "PsfModel.fit"):
        fits = [(f"{best} (best by {label})", times[best]) for best, label in best_by.items()]
        ratios = [
            f"{np.median(np.divide(seconds, times[name])):.1f} of {fit}"
            for fit, seconds in [*fits, ("Piff, all orders", all_orders)]
        ]
        print(f"  time over that of {name}: {', '.join(ratios)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("stars", type=Path)
    parser.add_argument("--pixel-arcsec", type=float, default=0.2)
    parser.add_argument("--gain", type=float, default=1.0)
    parser.add_argument("--size", type=int, default=21, help="pixels along both models")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--folds", type=int, default=5)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"pachon {pachon.__version__}, Piff {piff.__version__}, GalSim {galsim.__version__}; {arguments.stars.name}")
    stars = Stars(*pachon.load_stars(arguments.stars), arguments.pixel_arcsec * ARCSEC, arguments.gain)
    residuals, times = defaultdict(lambda: defaultdict(list)), defaultdict(list)
    with threadpool_limits(1):
        for seed in range(arguments.seeds):
            compare(stars, arguments.size, seed, arguments.folds, residuals, times)
    print(
        f"  {len(stars.positions)} stars, {arguments.seeds} x {arguments.folds} splits, {arguments.size} pixels a side"
    )
    show(residuals, times)


if __name__ == "__main__":
    main()
