"""Adaptive moments beside GalSim's HSM: the largest differences, and stamps a second.

Run: python benchmarks/adaptive_moments.py [STAMPS]

Ten thousand stamps of 33 x 33 pixels by default: optics alone (obscured apertures), turbulence, both; with noise of 0.1
to 5 % of the peak; with 3 % of the pixels masked too. Both programs measure on one thread, in turns of a fifth of
the stamps. HSM puts zeros in the place of masked pixels; pachon by default the Gaussian that fits the others. The last
table has the errors that masks add to noise-free stars: the median and the 95th percentile of |g - g without mask|.
"""

import argparse
import time

import galsim
import numpy as np

import pachon

SIDE = 33
TURNS = 5


def stars(count: int, rng: np.random.Generator, kind: int) -> np.ndarray:
    """Return stars [count, SIDE, SIDE], sheared, off the centre: 0 optics alone, 1 turbulence, 2 both."""
    images = np.empty((count, SIDE, SIDE))
    for i in range(count):
        air = galsim.Kolmogorov(fwhm=rng.uniform(0.45, 1.1))
        optics = galsim.Airy(lam=620.0, diam=8.36 * rng.uniform(0.4, 1.0), obscuration=0.61)
        profile = (optics, air, galsim.Convolve(air, optics))[kind]
        profile = profile.shear(g1=rng.normal(0.0, 0.04), g2=rng.normal(0.0, 0.04))
        scale = 0.006 if kind == 0 else 0.2
        offset = rng.uniform(-0.5, 0.5, 2)
        images[i] = profile.drawImage(nx=SIDE, ny=SIDE, scale=scale, offset=offset, dtype=float).array
    return images


def hsm(images: np.ndarray, good: np.ndarray | None) -> np.ndarray:
    """Return g1, g2, sigma, rho4 of HSM, [n, 4]; NaN where it fails."""
    rows = np.full((len(images), 4), np.nan)
    for i, image in enumerate(images):
        weight = None if good is None else galsim.ImageI(good[i].astype(np.int32))
        try:
            m = galsim.hsm.FindAdaptiveMom(galsim.ImageD(image, scale=1.0), weight=weight)
        except galsim.GalSimHSMError:
            continue
        rows[i] = m.observed_shape.g1, m.observed_shape.g2, m.moments_sigma, m.moments_rho4
    return rows


def ours(images: np.ndarray, mask: np.ndarray | None, fill: bool = False) -> np.ndarray:
    """Return the same of pachon on one thread."""
    m = pachon.adaptive_moments(images, 1.0, mask, fill_masked=fill, threads=1)
    return np.stack([m.g1, m.g2, m.sigma, m.rho4], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stamps", type=int, nargs="?", default=10_000)
    count = parser.parse_args().stamps // 5
    rng = np.random.default_rng(1)
    sets = [(name, stars(count, rng, k), None) for k, name in enumerate(("optics alone", "turbulence", "both"))]
    clean = sets[2][1]
    noise = 10.0 ** rng.uniform(-3.0, -1.3, (count, 1, 1)) * clean.max(axis=(1, 2), keepdims=True)
    noisy = clean + noise * rng.normal(size=clean.shape)
    mask = rng.random(clean.shape) < 0.03
    sets += [("noise", noisy, None), ("noise, 3 % masked", noisy, mask)]
    ours(clean[:2], None)  # compiled before the clock runs
    print(
        f"pachon {pachon.__version__}, GalSim {galsim.__version__}; {5 * count} stamps of {SIDE} x {SIDE}, one thread"
    )
    print(f"{'':20s}{'largest |dg|':>14s}{'dsigma/sigma':>14s}{'drho4/rho4':>14s}{'fail: HSM, ours':>18s}"
          f"{'a second: HSM':>15s}{'ours':>9s}{'ratio':>7s}")  # fmt: skip
    for name, images, masked in sets:
        seconds, rows = np.zeros(2), ([], [])
        for turn in np.array_split(np.arange(count), TURNS):
            part = None if masked is None else masked[turn]
            for k, measure in enumerate((hsm, ours)):
                argument = ~part if k == 0 and part is not None else part
                start = time.perf_counter()
                rows[k].append(measure(images[turn], argument))
                seconds[k] += time.perf_counter() - start
        theirs, mine = (np.concatenate(r) for r in rows)
        difference = np.nanmax(np.abs(mine - theirs), axis=0)
        relative = np.nanmax(np.abs(mine / theirs - 1.0), axis=0)
        failures = [int(np.isnan(r[:, 0]).sum()) for r in (theirs, mine)]
        rates = count / seconds
        print(f"{name:20s}{difference[:2].max():14.1e}{relative[2]:14.1e}{relative[3]:14.1e}{failures!s:>18s}"
              f"{rates[0]:15.0f}{rates[1]:9.0f}{rates[1] / rates[0]:7.1f}")  # fmt: skip
    weight = 1.0 / (noise**2 * np.ones_like(noisy))
    start = time.perf_counter()
    pachon.adaptive_moments(noisy, 1.0, weight=weight, threads=1)
    print(f"with errors: {count / (time.perf_counter() - start):.0f} a second")
    whole = ours(clean, None)
    print("\nerror of g by masks of 3 % of the pixels, noise-free: median, 95th percentile")
    for name, fill in (("filled by the Gaussian", True), ("zeros, as HSM", False)):
        error = np.hypot(*(ours(clean, mask, fill) - whole)[:, :2].T)
        print(f"{name:24s}{np.nanmedian(error):10.1e}{np.nanquantile(error, 0.95):10.1e}")


if __name__ == "__main__":
    main()
