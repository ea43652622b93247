"""Bias and speed of the shear estimator on isolated galaxies under the PSFs of telescope and atmosphere.

Run: python benchmarks/shear_estimator.py [--galaxies N] [--realisations N] [--min-snr S] [--noise KIND] [--speed]

Galaxies of the population of the sky, each at its sub-pixel place, beside it the same galaxy and place rotated by 90
degrees, under a shear and its opposite with the same noise: that of the sky of 100 visits, several times for each
galaxy. It is drawn on pixels: white, or "resampled" by half a pixel along both axes by cubic convolution, which
"resampled_as_white" takes for white noise of the same variance; or as the "functionals" of white noise. With --speed,
galaxies a second of the estimator, of Gaussian fits and of GalSim's regauss, interleaved.
"""

import argparse
import time

import numpy as np
from scipy import fft

import pachon
from pachon.measure.shear.estimator import ShearEstimator

ARCSEC = np.pi / 648000
SCALE = 0.2 * ARCSEC
SIDE = 64
BLOCK = 1024


def telescope_psfs(count: int) -> np.ndarray:
    """PSFs of a decentred LSST and of the atmosphere at random places of the field, with ellipticities of per cents."""
    rng = np.random.default_rng(3)
    telescope = pachon.load_telescope("lsst_v3.3_r").perturbed("M2", shift=(300e-6, -200e-6, 5e-6))
    radius, angle = np.sqrt(rng.uniform(0.05, 1.0, count)) * np.deg2rad(1.6), rng.uniform(0.0, 2.0 * np.pi, count)
    fields = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    air = pachon.Atmosphere.from_site("cerro_pachon", seed=2)
    psfs = pachon.make_psfs(
        telescope,
        fields,
        [580e-9, 620e-9, 660e-9],
        atmosphere=air,
        engine="long_exposure",
        stamps=pachon.Stamps(SIDE - 1),
    )
    images = np.asarray(psfs.image, dtype=float)
    return images / images.sum(axis=(1, 2), keepdims=True)


def drawn(galaxies, offsets: np.ndarray, psfs: np.ndarray, psf_index: np.ndarray) -> np.ndarray:
    """Stamps of unit flux [n, side, side] of galaxies at offsets from the middle pixel."""
    wide = np.zeros((len(psfs), 2 * SIDE, 2 * SIDE), dtype=np.float32)
    first = SIDE - psfs.shape[1] // 2
    wide[:, first : first + psfs.shape[1], first : first + psfs.shape[2]] = psfs
    transforms = fft.rfft2(wide)
    jacobian = np.broadcast_to(np.eye(2) / SCALE, (len(galaxies), 2, 2))
    spectra = galaxies.transform(np.arange(len(galaxies)), jacobian, offsets, 2 * SIDE, threads=1)
    spectra *= transforms[psf_index]
    half = SIDE // 2
    return fft.irfft2(spectra, s=(2 * SIDE, 2 * SIDE))[:, half:-half, half:-half]


def paired_shapes(estimator, stamps, offsets, psf_index, noise_moments, seed, min_snr):
    """Shapes under a shear and its opposite, for every realisation of the noise."""
    pairs = []
    for images in stamps:
        moments = estimator.moments(images, offsets + 0.5, psf_index=psf_index, threads=1)
        pairs.append(
            [
                estimator.ellipticity_and_response(
                    moments + noise, psf_index=psf_index, seed=seed, key=("renoise", k), min_snr=min_snr
                )
                for k, noise in enumerate(noise_moments)
            ]
        )
    return [type(shapes[0]).joined(shapes) for shapes in pairs]


class PixelNoise:
    """Noise of stamps: white, or resampled by half a pixel along both axes by cubic convolution."""

    def __init__(self, rms: float, resampled: bool) -> None:
        self.weights = (np.array([-1.0, 9.0, 9.0, -1.0]) / 16.0 if resampled else np.ones(1)).astype(np.float32)
        along_axis = np.correlate(self.weights, self.weights, "full")
        self.white_rms, self.rms = np.float32(rms), rms * float(along_axis.max())
        self.correlation = np.outer(along_axis, along_axis) / along_axis.max() ** 2

    def stamps(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Noise [count, side, side]."""
        wide = SIDE + len(self.weights) - 1
        white = self.white_rms * rng.standard_normal((count, wide, wide), np.float32)
        along_x = sum(w * white[:, :, i : i + SIDE] for i, w in enumerate(self.weights))
        return sum(w * along_x[:, i : i + SIDE] for i, w in enumerate(self.weights))


def show_bias(arguments, psfs: np.ndarray, exposure: pachon.Exposure) -> None:
    pixel_noise = PixelNoise(exposure.noise_rms, arguments.noise.startswith("resampled"))
    correlated = pachon.measure.CorrelatedNoise(pixel_noise.rms, pixel_noise.correlation)
    noise = correlated if arguments.noise == "resampled" else pixel_noise.rms
    estimator = ShearEstimator(psfs, SCALE, noise)
    amplitude = np.sqrt(estimator.covariance[:, 0, 0]).mean() / pixel_noise.rms
    print(f"{len(psfs)} PSFs, noise of M0 {amplitude:.1f} that of a pixel; {exposure.exposures} exposures")
    factors = np.linalg.cholesky(estimator.covariance)
    population = pachon.draw_galaxies(arguments.field * ARCSEC, arguments.faintest, arguments.seed)
    rng = np.random.default_rng(arguments.seed)
    rows = rng.permutation(len(population))[: arguments.galaxies // 2]
    cuts = [None, *arguments.min_snr]
    sums = {cut: [[], []] for cut in cuts}
    start = time.perf_counter()
    for block, members in enumerate(np.array_split(rows, max(1, len(rows) * 2 // BLOCK))):
        half = population.take(members)
        galaxies = type(half).concatenate([half, half.rotated(np.pi / 2)])
        count = len(galaxies)
        along_diagonal = np.tile(np.arange(len(half)) % 2, 2)
        g = arguments.shear * np.where(along_diagonal, 1j, 1.0)
        offset = rng.uniform(-0.5, 0.5, (len(half), 2))
        offsets = np.concatenate([offset, offset[:, ::-1] * (-1.0, 1.0)])
        psf_index = np.tile(rng.integers(0, len(psfs), len(half)), 2)
        electrons = exposure.electrons(galaxies.magnitude).astype(np.float32)[:, None, None]
        stamps = [
            drawn(galaxies.sheared(s * g.real, s * g.imag), offsets, psfs, psf_index) * electrons for s in (1, -1)
        ]
        # Functionals are linear: those of the noise of the pixels are added to those of the galaxies without.
        noise_moments = [np.zeros((count, 6))]
        if arguments.realisations:
            noise_moments = []
            for _ in range(arguments.realisations // 2):
                if arguments.noise == "functionals":
                    moments = np.einsum("nij,nj->ni", factors[psf_index], rng.standard_normal((count, 6)))
                else:
                    pixels = pixel_noise.stamps(count, rng)
                    moments = estimator.moments(pixels, offsets + 0.5, psf_index=psf_index, threads=1)
                # Noise and its negative are equally likely, and their mean scatters less.
                noise_moments += [moments, -moments]
        for cut in cuts:
            seed = block if arguments.realisations else None
            pair = paired_shapes(estimator, stamps, offsets, psf_index, noise_moments, seed, cut)
            for shapes, blocks in zip(pair, sums[cut], strict=True):
                component = np.tile(along_diagonal, len(noise_moments))
                blocks.append([shapes.sums[component == k].sum(axis=0) for k in range(2)])
    seconds = time.perf_counter() - start
    pairs = len(rows) * 2 * max(1, arguments.realisations)
    print(f"{2 * len(rows)} galaxies, {pairs} pairs, g = {arguments.shear}, {seconds:.0f} s")
    for cut in cuts:
        plus, minus = (np.array(blocks) for blocks in sums[cut])
        show(f"S/N above {cut:g}" if cut else "all galaxies", plus, minus, arguments.shear)


def show(label: str, plus: np.ndarray, minus: np.ndarray, shear: float) -> None:
    """Print biases of sums [blocks, 2, 5] with jackknife errors over the blocks."""

    def biases(sums: np.ndarray) -> np.ndarray:
        values = []
        for k, total in enumerate(np.moveaxis(sums, -3, 0)):
            response = 2 + 2 * k
            both = total[..., 0, :] + total[..., 1, :]
            difference = total[..., 0, k] - total[..., 1, k]
            values += [difference / both[..., response] / shear - 1.0, both[..., k] / both[..., response]]
        # One m of both components together.
        return np.stack([*values, 0.5 * (values[0] + values[2])], axis=-1)

    pair = np.stack([plus, minus], axis=2)  # [blocks, component, sign, 5]
    total = pair.sum(axis=0)
    values, without = biases(total), biases(total - pair)
    errors = np.sqrt((len(pair) - 1) / len(pair) * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
    m1, c1, m2, c2, m = zip(values, errors, strict=True)
    print(
        f"{label}: m = {m[0]:+.5f} +- {m[1]:.5f} (m1 {m1[0]:+.5f} +- {m1[1]:.5f}, m2 {m2[0]:+.5f} +- {m2[1]:.5f}), "
        f"c1 = {c1[0]:+.1e} +- {c1[1]:.1e}, c2 = {c2[0]:+.1e} +- {c2[1]:.1e}",
        flush=True,
    )


def show_speed(psfs: np.ndarray, exposure: pachon.Exposure) -> None:
    import galsim

    count = 1024
    galaxies = pachon.draw_galaxies(120 * ARCSEC, 25.5, 5)
    galaxies = galaxies.take(np.arange(count) % len(galaxies))
    rng = np.random.default_rng(1)
    offsets, psf_index = rng.uniform(-0.5, 0.5, (count, 2)), rng.integers(0, len(psfs), count)
    electrons = exposure.electrons(galaxies.magnitude).astype(np.float32)[:, None, None]
    rms = exposure.noise_rms
    stamps = drawn(galaxies, offsets, psfs, psf_index) * electrons
    stamps += np.float32(rms) * rng.standard_normal(stamps.shape, np.float32)
    estimator = ShearEstimator(psfs, SCALE, rms)
    psf_stamps = [galsim.Image(psf, scale=0.2) for psf in psfs]

    def functionals():
        moments = estimator.moments(stamps, offsets + 0.5, psf_index=psf_index, threads=1)
        estimator.ellipticity_and_response(moments, psf_index=psf_index, seed=1, min_snr=10.0)
        return count

    def gaussians():
        pachon.measure.fit_galaxy_stamps(stamps[:256], rms**2, psfs, psf_index=psf_index[:256], threads=1)
        return 256

    def regauss():
        for image, p in zip(stamps[:256], psf_index, strict=False):
            galsim.hsm.EstimateShear(galsim.Image(image, scale=0.2), psf_stamps[p], strict=False)
        return 256

    peers = {"functionals": functionals, "fits of Gaussians": gaussians, "regauss of GalSim": regauss}
    seconds = {name: [] for name in peers}
    for peer in peers.values():
        peer()
    for _ in range(5):
        for name, peer in peers.items():
            start = time.process_time()
            done = peer()
            seconds[name].append((time.process_time() - start) / done)
    print(f"pachon {pachon.__version__}, GalSim {galsim.__version__}, 64 x 64 pixels, processor time, median of 5")
    for name, times in seconds.items():
        ratio = np.median(times) / np.median(seconds["functionals"])
        print(f"{name}: {1 / np.median(times):.0f} galaxies a second a thread ({ratio:.1f} of the time)")
    start = time.process_time()
    for _ in range(20):
        ShearEstimator(psfs, SCALE, rms)
    print(f"{1e3 * (time.process_time() - start) / 20 / len(psfs):.2f} ms to prepare a PSF")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--galaxies", type=int, default=8192)
    parser.add_argument("--realisations", type=int, default=8, help="of the noise, an even number; 0 for none")
    kinds = ("white", "resampled", "resampled_as_white", "functionals")
    parser.add_argument("--noise", choices=kinds, default="white")
    parser.add_argument("--min-snr", type=float, nargs="*", default=[10.0])
    parser.add_argument("--shear", type=float, default=0.01)
    parser.add_argument("--faintest", type=float, default=26.0)
    parser.add_argument("--field", type=float, default=1200.0, help="side of the field of the galaxies [arcsec]")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--psfs", type=int, default=4)
    parser.add_argument("--visits", type=int, default=100)
    parser.add_argument("--speed", action="store_true")
    arguments = parser.parse_args()
    psfs, exposure = telescope_psfs(arguments.psfs), pachon.Exposure(exposures=arguments.visits)
    if arguments.speed:
        show_speed(psfs, exposure)
    else:
        show_bias(arguments, psfs, exposure)


if __name__ == "__main__":
    main()
